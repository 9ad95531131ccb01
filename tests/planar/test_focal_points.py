"""Focal points and spots, against bundles of lines whose focus is known."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from support.planar_scenes import SLAB, ball, beam, polygon, scene

from mi_refract.planar import Segments, focal_points, shapes
from mi_refract.planar.curves import affine
from mi_refract.planar.paraxial import Cardinal
from mi_refract.planar.path_tree import follow_scene

ANGLES = np.radians([20, 31, 35, 47])
FAN = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
AT = np.array([3.0, -2.0])


@pytest.mark.parametrize("distance, virtual", [(5.0, False), (-5.0, True)])
def test_rays_through_a_point(distance, virtual):
    found = focal_points.spread(AT - distance * FAN, FAN)
    assert found.virtual is virtual
    np.testing.assert_allclose([found.focus, found.spot], [AT, AT], atol=1e-14)
    assert found.rms < found.largest < 1e-14


def test_a_far_focus_keeps_its_digits():
    """Of rays 1e-5 rad apart: 1024 away they are as near to one another as rounding lets them be."""
    tilt = 1e-5 * np.array([-1.0, -0.3, 0.45, 1.0])
    directions = np.column_stack([np.cos(tilt), np.sin(tilt)])
    focus = np.array([1000.0, 0.3])
    found = focal_points.spread(focus - 1024 * directions, directions)
    np.testing.assert_allclose([found.focus, found.spot], [focus, focus], rtol=0, atol=2e-11)
    assert found.largest < 1e-15


def test_parallel_rays_have_a_spot_and_no_focus():
    found = focal_points.spread(beam(5, 1.0), np.tile([1.0, 0], (5, 1)))
    assert found.focus is None
    assert not found.virtual
    assert found.rms == pytest.approx(math.sqrt(0.5))
    assert found.largest == 1.0


def test_one_ray_is_no_spot():
    found = focal_points.spread(AT[None], FAN[:1])
    assert (found.rays, found.focus, found.spot, found.rms) == (1, None, None, None)


def test_rays_all_around_have_a_focus_and_no_spot():
    around = np.array([(1, 0), (0, 1), (-1, 0.1)]) / np.array([[1], [1], [math.hypot(1, 0.1)]])
    found = focal_points.spread(AT + 2 * around, around)
    np.testing.assert_allclose(found.focus, AT, atol=1e-14)
    assert found.virtual
    assert found.spot is None


def test_the_spot_is_the_smallest():
    """Of lines in disorder; the plane is moved along the mean direction and must not find a smaller one."""
    rng = np.random.default_rng(5)
    angles = rng.uniform(-0.4, 0.6, 30)
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    origins = rng.normal(size=(30, 2)) * [0.1, 1.0]
    found = focal_points.spread(origins, directions)
    axis = directions.mean(axis=0) / np.hypot(*directions.mean(axis=0))

    def rms(step):
        place = np.array(found.spot) + step * axis
        t = ((place - origins) @ axis) / (directions @ axis)
        heights = (origins + t[:, None] * directions - place) @ [-axis[1], axis[0]]
        return heights.std()

    assert found.rms == pytest.approx(rms(0), rel=1e-12)
    assert rms(0) < min(rms(1e-3), rms(-1e-3))

    def squares(place):
        x, y = (place - origins).T
        return np.sum((directions[:, 0] * y - directions[:, 1] * x) ** 2)

    focus = np.array(found.focus)
    for step in 1e-3 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]):
        assert squares(focus + step) > squares(focus)


def crossing_of_ball(h, n):
    """Where a ray at height h meets the axis of the unit ball: by the law of sines in the last triangle."""
    i, r = math.asin(h), math.asin(h / n)
    return h / math.sin(2 * (i - r))


def test_the_ball_has_its_marginal_and_paraxial_foci():
    n, half = 1.5, 0.7
    given = scene(ball(n), beam(101, half), (1, 0))
    (group,) = focal_points.groups(given, follow_scene(given))
    spread = group.spread
    assert (group.colour, group.beam, group.reflect, spread.rays) == ("", 0, 0, 101)
    np.testing.assert_allclose(spread.marginal, [crossing_of_ball(half, n), 0], atol=1e-13)
    np.testing.assert_allclose(spread.paraxial, [n / (2 * (n - 1)), 0], atol=1e-14)
    assert spread.marginal[0] < spread.focus[0] < spread.paraxial[0]


def test_a_beam_off_the_axis_has_no_marginal_focus():
    given = scene(ball(1.5), beam(11, 0.2, y=0.5), (1, 0))
    (group,) = focal_points.groups(given, follow_scene(given))
    assert group.spread.focus is not None
    assert (group.spread.marginal, group.spread.paraxial) == (None, None)


def test_groups_are_by_colour_beam_and_reflections():
    origins = np.concatenate([beam(3, 0.3), beam(2, 0.1, y=0.5), [[-3, 2.0]]])
    given = scene(
        (ball(1.5), ball(1.6)),
        origins,
        (1, 0),
        beams=np.array([0, 0, 0, 1, 1, 1]),
        colours=("red", "blue"),
        branches=1,
    )
    found = focal_points.groups(given, follow_scene(given))
    named = [(g.colour, g.beam, g.reflect, g.spread.rays) for g in found]
    rays = {0: 3, 1: 2}  # the sixth meets nothing
    assert named == [(c, b, bits, rays[b]) for c in ("red", "blue") for b in (0, 1) for bits in (0, 1, 2)]
    lines = focal_points.table(found).splitlines()
    assert len(lines) == 2 * 13
    assert lines[0].split()[:3] == ["colour", "beam", "reflected"]
    assert lines[3].split()[:4] == ["red", "0", "1", "3"]


def test_a_slab_only_moves_a_beam():
    given = scene(polygon(SLAB, 1.5), beam(5, 1.0, x=-2), (1, 0.3))
    (group,) = focal_points.groups(given, follow_scene(given))
    assert (group.spread.focus, group.spread.marginal) == (None, None)
    lines = focal_points.table([group]).splitlines()
    assert lines[1].split()[4] == "–"
    assert group.spread.cardinal == Cardinal(afocal=True) and group.spread.paraxial is None
    assert lines[3].split()[3:] == ["infinite", "–", "–", "–", "–"]


# The paraxial limit --------------------------------------------------------------------------------------------


def cardinal(segments, half, x=-30.0, turn=0.0, at=(0.0, 0.0), **given):
    """The points of a system along x, which is turned by `turn` degrees and moved, and the spread of its first beam."""
    rotation = affine(turn)
    moved = {name: getattr(segments, name) @ rotation.T + at for name in ("start", "end", "control")}
    segments = Segments(
        moved["start"], moved["end"], segments.n_left, segments.n_right, moved["control"], segments.weight
    )
    made = scene(segments, beam(4, half, x) @ rotation.T + at, rotation[:, 0], **given)
    group = focal_points.groups(made, follow_scene(made))[0]
    return group.spread.cardinal, group.spread


@pytest.mark.parametrize("turn", [0.0, 33.3])
@pytest.mark.parametrize("curvature", [(0.02, -0.03), (0.05, 0.01), (-0.04, 0.0)])
def test_a_thick_lens_has_the_focal_length_of_its_makers_formula(curvature, turn):
    """And n = n' on both sides, its principal points at f (n − 1) t c / n from its faces."""
    (c1, c2), t, n = curvature, 8.0, 1.6
    found, spread = cardinal(shapes.lens(curvature, t, radius=4.0).between(n, 1.0), 3.0, turn=turn, at=(2.0, 1.0))
    f = 1 / ((n - 1) * (c1 - c2 + (n - 1) * t * c1 * c2 / n))
    first, second = (-f * (n - 1) * t * c / n for c in (c2, c1))
    assert not found.afocal
    expected = [f, f + second, -f + first]
    lengths = [found.focal_length, found.back_focal_length, found.front_focal_length]
    assert lengths == pytest.approx(expected, rel=1e-13)
    places = [found.front_focus, found.principal[0], found.principal[1], found.back_focus, spread.paraxial]
    along = np.array([first - f, first, t + second, t + second + f, t + second + f])
    exact = along[:, None] * affine(turn)[:, 0] + (2.0, 1.0)
    np.testing.assert_allclose(places, exact, atol=1e-11)


def test_a_boundary_between_two_media_has_a_focal_length_in_each():
    """f = n' R/(n' − n) behind it, n R/(n' − n) before."""
    n, behind, radius = 1.33, 1.6, 5.0
    arc = shapes.polyline([(1.0, 3.0), (1.0, -3.0)], [2 * math.degrees(math.asin(3.0 / radius))]).between(behind, n)
    found, _ = cardinal(arc, 1.0)
    sag = radius - math.sqrt(radius**2 - 9)
    assert found.focal_length == found.back_focal_length == pytest.approx(behind * radius / (behind - n), rel=1e-13)
    assert found.front_focal_length == pytest.approx(-n * radius / (behind - n), rel=1e-13)
    np.testing.assert_allclose(found.principal, [(1 - sag, 0)] * 2, atol=1e-12)


def test_a_ball_that_reflects_is_a_mirror_of_half_its_radius():
    made = scene(ball(1.5), beam(4, 0.3), (1, 0), branches=1)
    (mirror,) = (g.spread for g in focal_points.groups(made, follow_scene(made)) if g.reflect == 1)
    assert mirror.cardinal.focal_length == pytest.approx(-0.5, rel=1e-14)
    np.testing.assert_allclose(mirror.paraxial, [-0.5, 0], atol=1e-14)


def joined(*parts):
    fields = ("start", "end", "n_left", "n_right", "control", "weight")
    return Segments(*(np.concatenate([getattr(part, name) for part in parts]) for name in fields))


@pytest.mark.parametrize("turn", [0.0, 33.3])
def test_an_afocal_system_says_so(turn):
    """Kepler's telescope: the back focus of one lens is the front focus of the next."""
    lens = shapes.lens((0.05, -0.05), 3.0, radius=3.0)
    one, _ = cardinal(lens.between(1.5, 1.0), 1.0)
    apart = one.back_focus[0] - one.front_focus[0]
    telescope = joined(lens.between(1.5, 1.0), lens.mapped(affine(), (apart, 0.0)).between(1.5, 1.0))
    found, spread = cardinal(telescope, 0.5, turn=turn)
    assert found == Cardinal(afocal=True) and spread.paraxial is None
    off, _ = cardinal(joined(lens.between(1.5, 1.0), lens.mapped(affine(), (apart + 1e-6, 0.0)).between(1.5, 1.0)), 0.5)
    assert off.focal_length == pytest.approx(-(one.focal_length**2) / 1e-6, rel=1e-6)


def test_rays_from_a_point_have_the_image_of_that_point():
    """1/b = 1/f − 1/a from the principal points; the lens does not change."""
    lens = shapes.lens((0.05, -0.05), 3.0, radius=3.0).between(1.5, 1.0)
    parallel, _ = cardinal(lens, 1.0)
    angle = np.radians([-2, -1, 1, 2])
    fan = np.column_stack([np.cos(angle), np.sin(angle)])
    made = scene(lens, np.tile([-50.0, 0.0], (4, 1)), fan)
    (group,) = focal_points.groups(made, follow_scene(made))
    first, second = (x for x, _ in parallel.principal)
    exact = second + 1 / (1 / parallel.focal_length - 1 / (first + 50))
    assert group.spread.paraxial[0] == pytest.approx(exact, rel=1e-12)
    assert group.spread.cardinal.focal_length == pytest.approx(parallel.focal_length, rel=1e-13)


def test_the_double_gauss_has_the_image_distance_that_code_v_printed():
    """Its last thickness is the paraxial one, printed in 16 digits; the focal length is that of a trace of y and u."""
    path = Path(__file__).parents[2] / "validation" / "reference" / "double_gauss_codev.json"
    surfaces = json.loads(path.read_text())["prescription"]
    parts, place, n, y, u = [], 0.0, 1.0, 1.0, 0.0
    for curvature, thickness, index in surfaces:
        turn = -2 * math.degrees(math.asin(20 * curvature))
        sag = shapes.sag(20.0, curvature)
        points = [(place + sag, -20.0), (place + sag, 20.0)]
        if index != n:
            parts.append(shapes.polyline(points, [turn]).between(n, index))
        u = (n * u - y * curvature * (index - n)) / index
        place, n, y = place + thickness, index, y + thickness * u
    parts = [part if part.curved else straight_arcs(part) for part in parts]
    found, spread = cardinal(joined(*parts), 5.0)
    assert found.back_focal_length == pytest.approx(surfaces[-1][1], rel=1e-12)
    assert spread.paraxial[0] == pytest.approx(place, rel=1e-12)
    assert found.focal_length == pytest.approx(-1 / u, rel=1e-12) == pytest.approx(100.00375702793, rel=1e-12)


def straight_arcs(part):
    return Segments(part.start, part.end, part.n_left, part.n_right, (part.start + part.end) / 2, np.ones(len(part)))


# A chosen plane ------------------------------------------------------------------------------------------------


def test_a_spot_on_a_plane():
    """Of rays through a point: 2 tan θ from it on an upright plane 2 behind it, 1/tan θ on a level one."""
    tangent = np.array([-0.2, 0.1, 0.3])
    d = np.column_stack([np.ones(3), tangent]) / np.hypot(1, tangent)[:, None]
    found = focal_points.spot(AT - 3 * d, d, focal_points.Plane((AT[0] + 2, 7.0)))
    heights = AT[1] + 2 * tangent
    np.testing.assert_allclose(found.centre, [AT[0] + 2, heights.mean()], atol=1e-14)
    assert (found.rms, found.extent) == pytest.approx((heights.std(), 1.0), rel=1e-13)
    turned = focal_points.spot(AT - 3 * d, d, focal_points.Plane((AT[0], AT[1] + 1), 90.0))
    assert turned.extent == pytest.approx(1 / 0.1 + 1 / 0.2, rel=1e-13)
    assert focal_points.spot(AT - d, [(1.0, 0.0)] * 3, focal_points.Plane((0.0, 0.0), 90.0)) is None


def test_a_plane_at_the_smallest_spot_has_that_spot():
    made = scene(ball(1.5), beam(11, 0.5), (1, 0))
    traced = follow_scene(made)
    (first,) = focal_points.groups(made, traced)
    (group,) = focal_points.groups(made, traced, focal_points.Plane(first.spread.spot))
    assert group.spread.on_plane.rms == pytest.approx(first.spread.rms, rel=1e-9)
    assert group.spread.on_plane.extent == pytest.approx(2 * first.spread.largest, rel=1e-9)
    lines = focal_points.table([group]).splitlines()
    assert lines[-2].split()[-6:] == ["on", "the", "plane", "at", "rms", "extent"]
