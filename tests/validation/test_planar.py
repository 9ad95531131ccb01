"""The planar study: its retrace is right by closed formulas, and its rows see planted defects."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from mi_refract.backend import detect
from mi_refract.planar import Event, Paths, Segments, path_loop, shapes
from mi_refract.planar import tracer as tracer
from mi_refract.planar.intersect_arcs import ConicArcs
from validation.planar import against_retrace, closed_paths, extruded_scenes, joints, times
from validation.planar.error_growth import _transfer, growth
from validation.reference.planar_retrace import retrace
from validation.run.array_settings import settings
from validation.run.metrics import WRONG_PATH, WRONG_PATH_FAR

LD = np.longdouble
THROUGH, MIRRORED = Event.REFRACTED, Event.REFLECTED


@pytest.fixture
def scalar(scalar_context):
    return settings(scalar_context())[0]


def as_paths(exact):
    return Paths(exact.points, exact.directions, exact.hits, exact.events, exact.indices)


# The retrace ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("beyond", [-1e-12, 1e-12])
def test_total_reflection_begins_at_the_critical_angle(beyond):
    plane = Segments(np.array([[-9.0, 0]]), np.array([[9.0, 0]]), [1.0], [1.5])
    angle = np.arcsin(1 / LD(1.5)) + LD(beyond)
    path = retrace(plane, [[0.0, -1.0]], np.array([[np.sin(angle), np.cos(angle)]]), 1)
    assert path.events[0, 0] == (MIRRORED if beyond > 0 else THROUGH)
    if beyond > 0:
        assert np.abs(path.directions[0] - [np.sin(angle), -np.cos(angle)]).max() < 1e-18


@pytest.mark.parametrize("name", closed_paths.CLOSED)
def test_the_retrace_ends_where_closed_answers_do(name):
    """To the rounding of what describes the shape in double precision."""
    closed = closed_paths.CLOSED[name](60)
    assert closed.error(as_paths(closed.case.exact)).max() < 8 * 2.0**-53


def test_the_retrace_unfolds_in_the_box():
    case = closed_paths.box(300, 4)
    path = retrace(case.segments, case.origins, case.directions, 300)
    assert (path.hits == case.exact.hits).all() and (path.events == case.exact.events).all()
    assert np.abs(path.points - case.exact.points).max() < 1e-14
    assert np.abs(path.legs - case.exact.legs).max() < 1e-16


def test_the_transfer_is_the_derivative():
    """Of place and angle behind three boundaries of a drop, against paths displaced by 1e-9."""
    closed, step = closed_paths.rainbow(30), LD(1e-9)
    case, exact = closed.case, closed.case.exact
    g, h_factor, phi_factor, _ = _transfer(exact)
    for column, shift in enumerate(np.eye(2)):
        h, phi = np.full((2, 30), shift[:, None])
        for j in range(3):
            h = h + np.hypot(*(exact.points[:, j + 1] - exact.points[:, j]).T) * phi
            h, phi = h_factor[:, j] * h, g[:, j] * phi + phi_factor[:, j] * h
        moved = case.origins + step * np.array([0, shift[0]]), case.directions + step * np.array([0, shift[1]])
        other = retrace(case.segments, *moved, 3, reflect=case.reflect)
        d, off = exact.directions, other.points[:, 3] - exact.points[:, 3]
        turned = d[:, 0] * other.directions[:, 1] - d[:, 1] * other.directions[:, 0]
        assert (turned / step).astype(float) == pytest.approx(phi.astype(float), rel=1e-5), column
        across = d[:, 0] * off[:, 1] - d[:, 1] * off[:, 0]
        assert (across / step).astype(float) == pytest.approx(h.astype(float), rel=1e-5), column


def test_the_bound_of_a_direction_behind_a_plane_is_the_sum_of_what_was_added():
    """At 60°, in units of 2u: φ' = g φ + 1 + |g| + 1/|d'_n| + |1 − g| S/ℓ, φ = 1, ℓ = 4, S = 2 the segment's end."""
    plane = Segments([[0.0, -2]], [[0.0, 2]], [1.0], [1.5])
    angle = np.radians(60)
    path = retrace(plane, [[-1.0, -1.0]], [[0.5, np.sin(angle)]], 1)
    behind = np.sqrt(1 - (np.sin(angle) / 1.5) ** 2)
    g = 0.5 / (1.5 * behind)
    expected = 2 * (g + 1 + g + 1 / behind + (1 - g) * 2 / 4)
    assert growth(path, plane)[1][0] == pytest.approx([2, expected])


# Planted defects -----------------------------------------------------------------------------------------------


def document_slip(d, l, k):  # noqa: E741
    """What document 004 prints: X = k R/(1 + R²) for sin(atan R) = R/√(1 + R²)."""
    along_n, along_l = l[0] * d[1] - l[1] * d[0], l[0] * d[0] + l[1] * d[1]
    r = along_l / along_n
    return right(d, l, k / math.sqrt(1 + r * r))


def inverted(d, l, k):  # noqa: E741
    return right(d, l, 1 / k)


def off_by_a_little(d, l, k):  # noqa: E741
    return right(d, l, k * (1 + 1e-8))


right = path_loop.refract_2d


@pytest.mark.parametrize("defect", [document_slip, inverted, off_by_a_little])
@pytest.mark.parametrize("name", closed_paths.CLOSED)
def test_a_wrong_formula_breaks_every_closed_answer(name, defect, scalar, monkeypatch):
    row = closed_paths._row(scalar, name, closed_paths.CLOSED[name](6))
    assert (row.verdict, row.values[WRONG_PATH]) == ("pass", 0)
    monkeypatch.setattr(path_loop, "refract_2d", defect)
    assert closed_paths._row(scalar, name, closed_paths.CLOSED[name](6)).broken


def traced_otherwise(case, **changes):
    """The case, its tracer given other segments."""
    other = dataclasses.replace(case.segments, **changes)
    paths = tracer.trace(other, case.origins, case.directions, case.max_depth, reflect=case.reflect, backend="scalar")
    return against_retrace.judge(paths, case, 2.0**-53)


def test_swapped_media_a_moved_vertex_and_a_gap_are_seen():
    case = against_retrace.case_of(against_retrace.FOLDER / "prism.toml", 3)
    s = case.segments
    assert against_retrace.judge(case.trace(settings_of("scalar")), case, 2.0**-53)[WRONG_PATH] == 0
    assert traced_otherwise(case, n_left=s.n_right, n_right=s.n_left)[WRONG_PATH] > 0
    assert traced_otherwise(case, start=s.start + 1e-9 * case.extent)["error / bound"] > 1e3
    hit = case.exact.hits[0, 0]
    gone = s.end.copy()
    gone[hit] = s.start[hit]
    assert traced_otherwise(case, end=gone)[WRONG_PATH_FAR] > 0


def test_a_leak_at_a_vertex_is_seen():
    """Rays along the axes exactly at the vertices of an octagon, whose sides end short of them for the tracer."""
    corners = np.array([[3, 1], [1, 3], [-1, 3], [-3, 1], [-3, -1], [-1, -3], [1, -3], [3, -1.0]])
    octagon = Segments(corners, np.roll(corners, -1, 0), np.full(8, 1.5), np.ones(8))
    d = np.repeat([[1.0, 0], [-1, 0], [0, 1], [0, -1]], 2, axis=0)
    origins = -10 * d + np.tile([[-1.0], [1.0]], (4, 1)) * d[:, ::-1]
    case = against_retrace.Case("octagon", octagon, origins, d, 8, np.zeros(8, int))
    assert (case.exact.met >= 2).all() and traced_otherwise(case)[WRONG_PATH] == 0
    short = 1e-12 * (octagon.end - octagon.start)
    assert traced_otherwise(case, start=corners + short, end=octagon.end - short)[WRONG_PATH] > 0


def settings_of(backend):
    import drjit as dr

    from validation.run.array_settings import Setting

    return Setting(backend, np.float64, getattr(dr, backend).Array3f64)


@pytest.mark.parametrize("field", ["points", "directions", "hits", "events"])
def test_what_is_missing_is_not_equal(field):
    case = against_retrace.case_of(against_retrace.FOLDER / "prism.toml", 3)
    whole = as_paths(case.exact)
    assert against_retrace.judge(whole, case, 2.0**-53)["difference"] == 0
    values = getattr(whole, field).copy()
    values[0] = -1 if field == "hits" else 0 if field == "events" else np.nan
    found = against_retrace.judge(dataclasses.replace(whole, **{field: values}), case, 2.0**-53)
    assert found[WRONG_PATH] == 1 if field in ("hits", "events") else not found["difference"] < 1


def test_a_ray_that_is_far_from_every_vertex_must_not_take_a_wrong_path():
    case = against_retrace.case_of(against_retrace.FOLDER / "lens.toml", 3)
    hits = case.exact.hits.copy()
    hits[0, 0] = (hits[0, 0] + 1) % len(case.segments)
    found = against_retrace.judge(dataclasses.replace(as_paths(case.exact), hits=hits), case, 2.0**-24)
    assert found[WRONG_PATH_FAR] == 1


@pytest.mark.parametrize("height", [1 - 1e-9, 1 + 1e-9, 1 + 1e-3])
def test_rounding_may_decide_what_touches_a_circle(height):
    """A path that passes by, judged by one that meets the circle, or the reverse: right within 1e-6 of the top."""
    ball = shapes.circle(1.0).between(1.5, 1.0)
    case = against_retrace.Case("ball", ball, np.array([[-3, height]]), np.array([[1.0, 0]]), 4, np.zeros(1, int))
    other = retrace(ball, [[-3, 1 - 1e-9 if height > 1 else 1 + 1e-9]], case.directions, 4)
    found = against_retrace.judge(as_paths(other), case, 2.0**-24)
    assert (found[WRONG_PATH], found[WRONG_PATH_FAR]) == (1, height == 1 + 1e-3)


@pytest.mark.parametrize("beyond", [1e-9, 1e-3])
def test_rounding_may_decide_at_the_critical_angle(beyond):
    plane = Segments(np.array([[-9.0, 0]]), np.array([[9.0, 0]]), [1.0], [1.5])
    angle = np.arcsin(1 / 1.5) + beyond
    d = np.array([[np.sin(angle), np.cos(angle)]])
    case = against_retrace.Case("plane", plane, np.array([[0.1, -1]]), d, 1, np.zeros(1, int))
    through = retrace(plane, case.origins, [[0.0, 1.0]], 1)
    found = against_retrace.judge(as_paths(dataclasses.replace(through, hits=case.exact.hits)), case, 2.0**-24)
    assert (found[WRONG_PATH], found[WRONG_PATH_FAR]) == (1, beyond == 1e-3)


def test_either_segment_is_right_at_their_vertex():
    """The axis of document 004's lens passes two vertices: whichever arc is hit there, the path is the same."""
    case = against_retrace.case_of(against_retrace.FOLDER / "lens.toml", 13)
    ray = int(np.argmin(np.abs(case.origins[:, 0]) + 1e3 * np.abs(case.directions[:, 0])))
    hits, met = case.exact.hits.copy(), case.exact.hits[ray, 1]
    neighbours = np.flatnonzero(
        (case.segments.start == case.segments.end[met]).all(1) | (case.segments.end == case.segments.start[met]).all(1)
    )
    there = [
        against_retrace.judge(dataclasses.replace(as_paths(case.exact), hits=put(hits, ray, n)), case, 2.0**-53)[
            WRONG_PATH
        ]
        for n in neighbours
    ]
    assert sorted(there) == [0, 1]


def put(hits, ray, segment):
    hits = hits.copy()
    hits[ray, 1] = segment
    return hits


def test_the_wrong_root_behind_a_joint_is_seen(scalar, monkeypatch):
    """Sides of the ends from shares that are kept off the joint by 1e-14, the other root from those that are not."""
    aimed = "joints", scalar, (20.0,), (0,)
    monkeypatch.setattr(joints, "SCALAR_SHARE", 10)
    assert joints.row(*aimed).verdict == "pass"
    plain = ConicArcs.start

    def clamped(self, ray):
        start = plain(self, ray)
        start.other = abs(start.sides[1]) * ray.r, abs(start.sides[0]) * ray.s
        return start

    monkeypatch.setattr(ConicArcs, "_shares", lambda self, ray: (max(ray.s, 1e-14), max(ray.r, 1e-14)))
    monkeypatch.setattr(ConicArcs, "start", clamped)
    assert WRONG_PATH_FAR in joints.row(*aimed).broken


# Extruded ------------------------------------------------------------------------------------------------------


def extruded(case, spawn="along the ray", segments=None):
    spawn, offset = extruded_scenes.SPAWNS[spawn]
    paths = extruded_scenes.trace(extruded_scenes.extrude(segments or case.segments), case, spawn)
    return against_retrace.judge(paths, case, extruded_scenes.U, offset)


@pytest.mark.parametrize("spawn", extruded_scenes.SPAWNS)
def test_walls_do_what_segments_do(spawn, llvm_variant):
    case = extruded_scenes.faceted(against_retrace.case_of(against_retrace.FOLDER / "prism.toml", 30))
    found = extruded(case, spawn)
    assert found[WRONG_PATH] == 0 and found["error / bound"] <= 1


def test_wrong_walls_are_seen(llvm_variant):
    """Rays moved along the normal without leave, swapped media, an index off by 1e-5, and a wall that is not there."""
    case = extruded_scenes.faceted(against_retrace.case_of(against_retrace.FOLDER / "prism.toml", 30))
    paths = extruded_scenes.trace(extruded_scenes.extrude(case.segments), case, extruded_scenes.SPAWNS["spawn_ray"][0])
    assert against_retrace.judge(paths, case, extruded_scenes.U)["error / bound"] > 1
    s = case.segments
    assert extruded(case, segments=Segments(s.start, s.end, s.n_right, s.n_left))[WRONG_PATH_FAR] > 0
    assert extruded(case, segments=Segments(s.start, s.end, s.n_left * (1 + 1e-5), s.n_right))["error / bound"] > 1
    hit = case.exact.hits[0, 0]
    kept = np.arange(len(s)) != hit
    fewer = Segments(*(getattr(s, name)[kept] for name in ("start", "end", "n_left", "n_right")))
    assert extruded(case, segments=fewer)[WRONG_PATH_FAR] > 0


# Times ---------------------------------------------------------------------------------------------------------


def test_methods_that_differ_in_a_bit_are_seen(scalar_context):
    context = scalar_context(scalar_rays=4)
    setting = settings(context)[0]
    rows = times.measure(context, setting, (10,))
    assert [row.verdict for row in rows if row.budgets] == ["pass", "pass"]
    tracer, _ = times._tracer(setting, "brute", 10)
    paths = tracer(*times.field(10).beam(4, shuffled=False), 2)
    nudged = dataclasses.replace(paths, points=np.nextafter(paths.points, 9))
    assert times.differing(paths, nudged) == 4
    assert times.differing(paths, paths) == 0


@pytest.mark.parametrize(("size", "side"), [(0, 1), (100, 1), (9000, 3)])
def test_a_field_of_lenses_is_met_twice_by_every_ray(size, side):
    field = times.field(size)
    assert field.side == side
    rays = field.beam(40, shuffled=False)
    path = retrace(field.segments, *rays, 2)
    assert (path.met == 2).all() and (path.events[:, :2] == THROUGH).all()
    lens = np.round(path.points[:, 1] / field.pitch)
    assert (np.diff(lens[:, 1] * side + lens[:, 0]) >= 0).all()
    again = field.beam(40, shuffled=True)[0]
    assert (np.sort(again, 0) == np.sort(rays[0], 0)).all() and (again != rays[0]).any()


# The study -----------------------------------------------------------------------------------------------------


def test_every_scene_file_is_in_the_study(scalar_context, monkeypatch):
    monkeypatch.setattr(against_retrace, "SCALAR_RAYS", 1)
    setting = settings(scalar_context())[0]
    rows = against_retrace.setting_rows(scalar_context(), setting)
    assert {row.verdict for row in rows} == {"pass"}
    cases = {row.case for row in rows}
    assert cases == {path.stem for path in Path(against_retrace.FOLDER).glob("*.toml")} | {"clutter"}


def test_the_box_and_what_cannot_run(scalar, scalar_context):
    assert closed_paths._box_row(scalar, 20, 3).verdict == "pass"
    off = {name: dataclasses.replace(b, usable=False, reason="off") for name, b in detect().items()}
    context = dataclasses.replace(scalar_context(), backends=off)
    for study in (against_retrace, closed_paths, extruded_scenes, joints, times):
        rows = [row for task in study.tasks(context) if "scalar" not in task.name for row in task.run()]
        assert rows and {row.verdict for row in rows} == {"not run"}
