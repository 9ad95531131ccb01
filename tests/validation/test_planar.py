"""The planar studies: their reference is right by closed formulas, and their rows see planted defects."""

import dataclasses
import math

import numpy as np
import pytest

from mi_refract.backend import detect
from mi_refract.planar import Event, Paths, Segments, shapes
from mi_refract.planar import tracer as planar_tracer
from validation.planar import against_retrace, closed_paths, extruded_scenes, joints, times
from validation.planar.rounding import growth, transfer
from validation.reference.planar_retrace import retrace
from validation.run.array_settings import Setting, settings
from validation.run.metrics import ERROR_OVER_BOUND, WRONG_PATH, WRONG_PATH_FAR

DIFFERENCE = against_retrace.DIFFERENCE
SCALAR = Setting.of("scalar", "float64")


def case_of(name, rays):
    return against_retrace.case_of(against_retrace.FOLDER / f"{name}.toml", rays)


def as_paths(exact, **changes):
    known = {name: getattr(exact, name) for name in ("points", "directions", "hits", "events")}
    return Paths(**known | changes)


def judged(paths, case, u=2.0**-53):
    return against_retrace.judge(paths, case, u)


# The reference -------------------------------------------------------------------------------------------------


def test_the_retrace_ends_where_closed_answers_do_and_unfolds_in_the_box():
    """To the rounding of what describes the shape in double precision."""
    for make in closed_paths.CLOSED.values():
        answer = make(60)
        assert answer.error(as_paths(answer.case.exact)).max() < 8 * 2.0**-53
    case = closed_paths.box(300, 4)
    path = retrace(case.segments, case.origins, case.directions, 300)
    assert (path.hits == case.exact.hits).all() and (path.events == case.exact.events).all()
    assert np.abs(path.points - case.exact.points).max() < 1e-14
    assert np.abs(path.legs - case.exact.legs).max() < 1e-16


def test_the_growth_of_an_error_is_the_derivative():
    """Of place and angle behind three boundaries of a drop, against paths displaced by 1e-9."""
    case, step = closed_paths.CLOSED["rainbow"](30).case, np.longdouble(1e-9)
    exact = case.exact
    g, h_factor, phi_factor = transfer(exact)
    for shift in np.eye(2):
        h, phi = np.full((2, 30), shift[:, None])
        for j in range(3):
            h = h + np.hypot(*(exact.points[:, j + 1] - exact.points[:, j]).T) * phi
            h, phi = h_factor[:, j] * h, g[:, j] * phi + phi_factor[:, j] * h
        moved = case.origins + step * np.array([0, shift[0]]), case.directions + step * np.array([0, shift[1]])
        other = retrace(case.segments, *moved, 3, reflect=case.reflect)
        d, off = exact.directions, other.points[:, 3] - exact.points[:, 3]
        for measured, expected in ((other.directions, phi), (off, h)):
            across = d[:, 0] * measured[:, 1] - d[:, 1] * measured[:, 0]
            assert (across / step).astype(float) == pytest.approx(expected.astype(float), rel=1e-5)


def test_the_bound_of_a_direction_behind_a_plane_is_the_sum_of_what_was_added():
    """At 60°, in units of 2u: φ' = g φ + 1 + |g| + 1/|d'_n| + |1 − g| S/ℓ, φ = 1, ℓ = 4, S = 2 the segment's end."""
    plane = Segments([[0.0, -2]], [[0.0, 2]], [1.0], [1.5])
    angle = np.radians(60)
    path = retrace(plane, [[-1.0, -1.0]], [[0.5, np.sin(angle)]], 1)
    behind = np.sqrt(1 - (np.sin(angle) / 1.5) ** 2)
    g = 0.5 / (1.5 * behind)
    assert growth(path, plane)[1][0] == pytest.approx([2, 2 * (g + 1 + g + 1 / behind + (1 - g) * 2 / 4)])


# Planted defects -----------------------------------------------------------------------------------------------


right = planar_tracer.refract_2d


def document_slip(d, l, k):  # noqa: E741
    """What document 004 prints: X = k R/(1 + R²) for sin(atan R) = R/√(1 + R²)."""
    r = (l[0] * d[0] + l[1] * d[1]) / (l[0] * d[1] - l[1] * d[0])
    return right(d, l, k / math.sqrt(1 + r * r))


SLIPS = (document_slip, lambda *v: right(*v[:2], 1 / v[2]), lambda *v: right(*v[:2], v[2] * (1 + 1e-8)))


@pytest.mark.parametrize("name", closed_paths.CLOSED)
def test_a_wrong_formula_breaks_every_closed_answer(name, monkeypatch):
    row = closed_paths.row(SCALAR, name, closed_paths.CLOSED[name](6))
    assert (row.verdict, row.values[WRONG_PATH]) == ("pass", 0)
    for defect in SLIPS:
        monkeypatch.setattr(planar_tracer, "refract_2d", defect)
        assert closed_paths.row(SCALAR, name, closed_paths.CLOSED[name](6)).broken, defect


def test_swapped_media_a_moved_vertex_a_gap_and_a_leak_are_seen():
    case = case_of("prism", 3)
    s = case.segments

    def otherwise(case, **changes):
        """The case, its tracer given other segments."""
        other = dataclasses.replace(case, segments=dataclasses.replace(case.segments, **changes))
        return judged(other.trace(SCALAR), case)

    assert otherwise(case)[WRONG_PATH] == 0
    assert otherwise(case, n_left=s.n_right, n_right=s.n_left)[WRONG_PATH] > 0
    assert otherwise(case, start=s.start + 1e-9 * case.extent)[ERROR_OVER_BOUND] > 1e3
    hit, gone = case.exact.hits[0, 0], s.end.copy()
    gone[hit] = s.start[hit]
    assert otherwise(case, end=gone)[WRONG_PATH_FAR] > 0
    # Rays along the axes exactly at the vertices of an octagon, whose sides end short of them for the tracer.
    corners = np.array([[3, 1], [1, 3], [-1, 3], [-3, 1], [-3, -1], [-1, -3], [1, -3], [3, -1.0]])
    octagon = Segments(corners, np.roll(corners, -1, 0), np.full(8, 1.5), np.ones(8))
    d = np.repeat([[1.0, 0], [-1, 0], [0, 1], [0, -1]], 2, axis=0)
    origins = -10 * d + np.tile([[-1.0], [1.0]], (4, 1)) * d[:, ::-1]
    case = against_retrace.Case("octagon", octagon, origins, d, 8, np.zeros(8, int))
    assert (case.exact.met >= 2).all() and otherwise(case)[WRONG_PATH] == 0
    short = 1e-12 * (octagon.end - octagon.start)
    assert otherwise(case, start=corners + short, end=octagon.end - short)[WRONG_PATH] > 0


def test_what_is_missing_is_not_equal_and_a_wrong_path_far_from_every_vertex_is_seen():
    case = case_of("prism", 3)
    assert judged(as_paths(case.exact), case)[DIFFERENCE] == 0
    for field, none in (("points", np.nan), ("directions", np.nan), ("hits", -1), ("events", 0)):
        values = getattr(case.exact, field).copy()
        values[0] = none
        row = judged(as_paths(case.exact, **{field: values}), case)
        assert row[WRONG_PATH] == 1 if field in ("hits", "events") else not row[DIFFERENCE] < 1
    hits = case.exact.hits.copy()
    hits[0, 0] = (hits[0, 0] + 1) % len(case.segments)
    assert judged(as_paths(case.exact, hits=hits), case, 2.0**-24)[WRONG_PATH_FAR] == 1


def test_what_rounding_may_decide_later_does_not_excuse_a_path_that_leaves_the_box_before():
    """In float32 a bound of 2000 reflections reaches a corner: later than a path that leaves at its fourth boundary."""
    case, u = closed_paths.box(2000, 4), 2.0**-24
    for ends, far in ((3, 1), (1990, 0)):
        events, hits = case.exact.events.copy(), case.exact.hits.copy()
        events[0, ends:], hits[0, ends:] = Event.NONE, -1
        events[0, ends] = Event.ESCAPED
        for changes in ({"events": events, "hits": hits}, {"events": events}):
            row = judged(as_paths(case.exact, **changes), case, u)
            assert (row[WRONG_PATH], row[WRONG_PATH_FAR]) == (1, far)


def test_a_vertex_excuses_only_what_is_met_there():
    """A ray through a square, 1e-9 below its corner, that ends in another way behind it."""
    square, direction = shapes.circle(1.0).faceted(4).between(1.5, 1.0), np.array([[1.0, 0]])
    case = against_retrace.Case("", square, np.array([[-3, 1 - 1e-9]]), direction, 4, np.zeros(1, int))
    events, end = case.exact.events.copy(), case.exact.met[0]
    assert end > 0 and events[0, end] == Event.ESCAPED
    events[0, end] = Event.MEDIUM_MISMATCH
    row = judged(as_paths(case.exact, events=events), case, 2.0**-24)
    assert (row[WRONG_PATH], row[WRONG_PATH_FAR]) == (1, 1)


@pytest.mark.parametrize(("beyond", "far"), [(-1e-9, False), (1e-9, False), (1e-3, True)])
@pytest.mark.parametrize("curve", [shapes.circle(1.0), shapes.circle(1.0).faceted(4)])
def test_rounding_may_decide_what_touches_a_body_and_at_the_critical_angle(curve, beyond, far):
    """A path that passes a circle or a square's corner, judged by one that meets it, or the reverse."""
    body, plane = curve.between(1.5, 1.0), Segments([(-9, 0)], [(9, 0)], [1.0], [1.5])
    case = against_retrace.Case("", body, np.array([[-3, 1 + beyond]]), np.array([[1.0, 0]]), 4, np.zeros(1, int))
    other = retrace(body, [[-3, 1 - 1e-9 if beyond > 0 else 1 + 1e-9]], case.directions, 4)
    angle = np.arcsin(1 / 1.5) + abs(beyond)
    d = np.array([[np.sin(angle), np.cos(angle)]])
    reflected = against_retrace.Case("", plane, np.array([[0.1, -1]]), d, 1, np.zeros(1, int))
    through = as_paths(retrace(plane, reflected.origins, [[0.0, 1.0]], 1), hits=reflected.exact.hits)
    for paths, judge in ((as_paths(other), case), (through, reflected)):
        row = judged(paths, judge, 2.0**-24)
        assert (row[WRONG_PATH], row[WRONG_PATH_FAR]) == (1, far)
    past = as_paths(reflected.exact, hits=np.full_like(reflected.exact.hits, -1))
    assert judged(past, reflected, 2.0**-24)[WRONG_PATH_FAR] == 1  # the critical angle hides no boundary


def test_either_segment_is_right_at_their_vertex():
    """The axis of document 004's lens passes two vertices: whichever arc is hit there, the path is the same."""
    case = case_of("lens", 13)
    ray = int(np.argmin(np.abs(case.origins[:, 0]) + 1e3 * np.abs(case.directions[:, 0])))
    s, met, wrong = case.segments, case.exact.hits[ray, 1], []
    for n in np.flatnonzero((s.start == s.end[met]).all(1) | (s.end == s.start[met]).all(1)):
        hits = case.exact.hits.copy()
        hits[ray, 1] = n
        wrong.append(judged(as_paths(case.exact, hits=hits), case)[WRONG_PATH])
    assert sorted(wrong) == [0, 1]


def test_a_wrong_arc_and_a_wrong_place_behind_a_joint_are_seen(monkeypatch):
    aimed, circle = ("joints", SCALAR, (20.0,), (0,)), list(joints.AIMS["joints"](20.0))[:3]
    monkeypatch.setitem(joints.AIMS, "joints", lambda turn: circle)
    monkeypatch.setattr(joints, "SCALAR_SHARE", 10)
    assert joints.row(*aimed).verdict == "pass"

    class Wrong(planar_tracer.Tracer):
        def __call__(self, *rays, **options):
            paths = super().__call__(*rays, **options)
            paths.points[0, 1] += 1e-6
            paths.hits[1, 0] = (paths.hits[1, 0] + 1) % 4
            return paths

    monkeypatch.setattr(joints, "Tracer", Wrong)
    assert joints.row(*aimed).broken.keys() == {WRONG_PATH_FAR, ERROR_OVER_BOUND}


def test_walls_do_what_segments_do_and_wrong_walls_are_seen(llvm_variant):
    """Rays moved along the normal without leave, swapped media, an index off by 1e-5, and a wall that is not there."""
    case = extruded_scenes.faceted(case_of("prism", 30))

    def extruded(spawn="along the ray", segments=case.segments, allowed=True):
        spawn, offset = extruded_scenes.SPAWNS[spawn]
        paths = extruded_scenes.trace(extruded_scenes.extrude(segments), case, spawn)
        return against_retrace.judge(paths, case, extruded_scenes.U, offset if allowed else 0)

    for spawn in extruded_scenes.SPAWNS:
        row = extruded(spawn)
        assert row[WRONG_PATH] == 0 and row[ERROR_OVER_BOUND] <= 1
    assert extruded("spawn_ray", allowed=False)[ERROR_OVER_BOUND] > 1
    s = case.segments
    assert extruded(segments=Segments(s.start, s.end, s.n_right, s.n_left))[WRONG_PATH_FAR] > 0
    assert extruded(segments=Segments(s.start, s.end, s.n_left * (1 + 1e-5), s.n_right))[ERROR_OVER_BOUND] > 1
    kept = np.arange(len(s)) != case.exact.hits[0, 0]
    fewer = Segments(*(getattr(s, name)[kept] for name in ("start", "end", "n_left", "n_right")))
    assert extruded(segments=fewer)[WRONG_PATH_FAR] > 0


# Times ---------------------------------------------------------------------------------------------------------


def test_methods_that_differ_in_a_bit_are_seen(scalar_context, monkeypatch):
    context = scalar_context(scalar_rays=4)
    monkeypatch.setitem(times.ROUNDS, context.profile.name, 6)

    def verdicts():
        return {row.case: row.verdict for row in times.measure(context, SCALAR, (10,)) if row.budgets}

    assert verdicts() == {"document 004": "pass", "M = 10": "pass"}

    class Nudged(planar_tracer.Tracer):
        def __call__(self, *rays, **options):
            paths = super().__call__(*rays, **options)
            if self.mesh:
                paths.points[0, 1] = np.nextafter(paths.points[0, 1], 9)
            return paths

    monkeypatch.setattr(times, "Tracer", Nudged)
    assert set(verdicts().values()) == {"fail"}


@pytest.mark.parametrize(("size", "side"), [(0, 1), (100, 1), (9000, 3)])
def test_a_field_of_lenses_is_met_twice_by_every_ray(size, side):
    field = times.field(size)
    assert field.side == side
    rays = field.beam(40, shuffled=False)
    path = retrace(field.segments, *rays, 2)
    assert (path.met == 2).all() and (path.events[:, :2] == Event.REFRACTED).all()
    lens = np.round(path.points[:, 1] / field.pitch)
    assert (np.diff(lens[:, 1] * side + lens[:, 0]) >= 0).all()
    again = field.beam(40, shuffled=True)[0]
    assert (np.sort(again, 0) == np.sort(rays[0], 0)).all() and (again != rays[0]).any()


# The studies ---------------------------------------------------------------------------------------------------


def test_every_scene_file_is_in_the_study_and_what_cannot_run_says_so(scalar_context, monkeypatch):
    monkeypatch.setattr(against_retrace, "SCALAR_RAYS", 1)
    context = scalar_context(scalar_rays=4)
    rows = against_retrace.setting_rows(context, settings(context)[0])
    assert {row.verdict for row in rows} == {"pass"}
    assert {row.case for row in rows} == {path.stem for path in against_retrace.FOLDER.glob("*.toml")} | {"clutter"}
    assert closed_paths.row(SCALAR, "box, 20", closed_paths.box(20, 3)).verdict == "pass"
    off = {name: dataclasses.replace(b, usable=False, reason="off") for name, b in detect().items()}
    context = dataclasses.replace(context, backends=off)
    for study in (against_retrace, closed_paths, extruded_scenes, joints, times):
        rows = [row for task in study.tasks(context) if "scalar" not in task.name for row in task.run()]
        assert rows and {row.verdict for row in rows} == {"not run"}
