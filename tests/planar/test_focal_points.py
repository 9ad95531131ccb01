"""Focal points and spots, against bundles of lines whose focus is known, and systems whose focal length is."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from support.planar_scenes import SLAB, ball, beam, polygon, scene, together

from mi_refract.planar import Segments, focal_points, shapes
from mi_refract.planar.curves import affine
from mi_refract.planar.focal_points import Cardinal, Plane
from mi_refract.planar.path_tree import follow_scene

AT = np.array([3.0, -2.0])


def unit(angles):
    return np.column_stack([np.cos(angles), np.sin(angles)])


FAN = unit(np.radians([20, 31, 35, 47]))


def groups(made, plane=None):
    return focal_points.groups(made, follow_scene(made), plane)


@pytest.mark.parametrize(
    ("at", "distance", "directions", "apart"),
    [
        (AT, 5.0, FAN, 1e-14),
        (AT, -5.0, FAN, 1e-14),
        # 1e-5 rad apart: 1024 away they are as near to one another as rounding lets them be.
        (np.array([1000.0, 0.3]), 1024.0, unit(1e-5 * np.array([-1.0, -0.3, 0.45, 1.0])), 2e-11),
    ],
)
def test_rays_through_a_point_keep_their_digits(at, distance, directions, apart):
    spread = focal_points.spread(at - distance * directions, directions)
    assert spread.virtual is (distance < 0)
    np.testing.assert_allclose([spread.focus, spread.spot], [at, at], rtol=0, atol=apart)
    assert spread.rms < spread.largest < min(apart, 1e-14)


def test_rays_that_have_no_focus_or_no_spot():
    parallel = focal_points.spread(beam(5, 1.0), np.tile([1.0, 0], (5, 1)))
    assert (parallel.focus, parallel.virtual) == (None, False)
    assert (parallel.rms, parallel.largest) == (pytest.approx(math.sqrt(0.5)), 1.0)
    one = focal_points.spread(AT[None], FAN[:1])
    assert (one.rays, one.focus, one.spot, one.rms) == (1, None, None, None)
    around = unit([0, math.pi / 2, 3.0])
    every_way = focal_points.spread(AT + 2 * around, around)
    np.testing.assert_allclose(every_way.focus, AT, atol=1e-14)
    assert every_way.virtual and every_way.spot is None


def test_the_spot_is_the_smallest():
    """Of lines in disorder; the plane is moved along the mean direction and must not find a smaller one."""
    rng = np.random.default_rng(5)
    directions, origins = unit(rng.uniform(-0.4, 0.6, 30)), rng.normal(size=(30, 2)) * [0.1, 1.0]
    spread = focal_points.spread(origins, directions)
    axis = directions.mean(axis=0) / np.hypot(*directions.mean(axis=0))

    def rms(step):
        place = np.array(spread.spot) + step * axis
        t = ((place - origins) @ axis) / (directions @ axis)
        return ((origins + t[:, None] * directions - place) @ [-axis[1], axis[0]]).std()

    def squares(place):
        x, y = (place - origins).T
        return np.sum((directions[:, 0] * y - directions[:, 1] * x) ** 2)

    assert spread.rms == pytest.approx(rms(0), rel=1e-12)
    assert rms(0) < min(rms(1e-3), rms(-1e-3))
    focus = np.array(spread.focus)
    assert all(squares(focus + step) > squares(focus) for step in 1e-3 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]))


def test_the_ball_has_its_marginal_and_paraxial_foci_and_a_mirror_of_half_its_radius():
    """Where a ray at height h meets the axis of the unit ball: by the law of sines in the last triangle."""
    n, half = 1.5, 0.7
    direct, mirror, _ = groups(scene(ball(n), beam(101, half), (1, 0), branches=1))
    spread, turn = direct.spread, 2 * (math.asin(half) - math.asin(half / n))
    assert (direct.colour, direct.beam, direct.reflect, spread.rays) == ("", 0, 0, 101)
    np.testing.assert_allclose(spread.marginal, [half / math.sin(turn), 0], atol=1e-13)
    np.testing.assert_allclose(spread.paraxial, [n / (2 * (n - 1)), 0], atol=1e-14)
    assert spread.marginal[0] < spread.focus[0] < spread.paraxial[0]
    assert mirror.reflect == 1 and mirror.spread.cardinal.focal_length == pytest.approx(-0.5, rel=1e-14)
    np.testing.assert_allclose(mirror.spread.paraxial, [-0.5, 0], atol=1e-14)
    (off,) = groups(scene(ball(n), beam(11, 0.2, y=0.5), (1, 0)))
    assert off.spread.focus and (off.spread.marginal, off.spread.paraxial) == (None, None)


def test_groups_are_by_colour_beam_and_reflections():
    origins, beams = np.concatenate([beam(3, 0.3), beam(2, 0.1, y=0.5), [[-3, 2.0]]]), np.array([0, 0, 0, 1, 1, 1])
    made = groups(scene((ball(1.5), ball(1.6)), origins, (1, 0), beams=beams, colours=("red", "blue"), branches=1))
    named = [(g.colour, g.beam, g.reflect, g.spread.rays) for g in made]
    rays = {0: 3, 1: 2}  # the sixth meets nothing
    assert named == [(c, b, bits, rays[b]) for c in ("red", "blue") for b in (0, 1) for bits in (0, 1, 2)]
    lines = focal_points.table(made).splitlines()
    assert len(lines) == 13 + 1 + 13  # two tables and a line between
    assert lines[0].split()[:3] == ["colour", "beam", "reflected"]
    assert lines[3].split()[:4] == ["red", "0", "1", "3"]


def test_a_slab_only_moves_a_beam():
    (group,) = groups(scene(polygon(SLAB, 1.5), beam(5, 1.0, x=-2), (1, 0.3)))
    assert (group.spread.focus, group.spread.marginal, group.spread.paraxial) == (None, None, None)
    assert group.spread.cardinal == Cardinal(afocal=True)
    lines = focal_points.table([group]).splitlines()
    assert lines[1].split()[4] == "–"
    assert lines[4].split()[3:] == ["infinite", "–", "–", "–", "–"]


# The paraxial limit --------------------------------------------------------------------------------------------


def cardinal(segments, half, turn=0.0, at=(0.0, 0.0)):
    """The points of a system along x, which is turned by `turn` degrees and moved, and the spread of its first beam."""
    rotation = affine(turn)
    start, end, control = (x @ rotation.T + at for x in (segments.start, segments.end, segments.control))
    segments = Segments(start, end, segments.n_left, segments.n_right, control, segments.weight)
    spread = groups(scene(segments, beam(4, half, -30.0) @ rotation.T + at, rotation[:, 0]))[0].spread
    return spread.cardinal, spread


@pytest.mark.parametrize("turn", [0.0, 33.3])
@pytest.mark.parametrize("curvature", [(0.02, -0.03), (0.05, 0.01), (-0.04, 0.0)])
def test_a_thick_lens_has_the_focal_length_of_its_makers_formula(curvature, turn):
    """And n = n' on both sides, its principal points at f (n − 1) t c / n from its faces."""
    (c1, c2), t, n = curvature, 8.0, 1.6
    points, spread = cardinal(shapes.lens(curvature, t, radius=4.0).between(n, 1.0), 3.0, turn=turn, at=(2.0, 1.0))
    f = 1 / ((n - 1) * (c1 - c2 + (n - 1) * t * c1 * c2 / n))
    first, second = (-f * (n - 1) * t * c / n for c in (c2, c1))
    assert not points.afocal
    lengths = [points.focal_length, points.back_focal_length, points.front_focal_length]
    assert lengths == pytest.approx([f, f + second, -f + first], rel=1e-13)
    places = [points.front_focus, points.principal[0], points.principal[1], points.back_focus, spread.paraxial]
    along = np.array([first - f, first, t + second, t + second + f, t + second + f])
    np.testing.assert_allclose(places, along[:, None] * affine(turn)[:, 0] + (2.0, 1.0), atol=1e-11)


def test_a_boundary_between_two_media_has_a_focal_length_in_each():
    """f = n' R/(n' − n) behind it, n R/(n' − n) before."""
    n, behind, radius = 1.33, 1.6, 5.0
    arc = shapes.polyline([(1.0, 3.0), (1.0, -3.0)], [2 * math.degrees(math.asin(3.0 / radius))]).between(behind, n)
    points, _ = cardinal(arc, 1.0)
    sag = radius - math.sqrt(radius**2 - 9)
    assert points.focal_length == points.back_focal_length == pytest.approx(behind * radius / (behind - n), rel=1e-13)
    assert points.front_focal_length == pytest.approx(-n * radius / (behind - n), rel=1e-13)
    np.testing.assert_allclose(points.principal, [(1 - sag, 0)] * 2, atol=1e-12)


@pytest.mark.parametrize("turn", [0.0, 33.3])
def test_an_afocal_system_says_so(turn):
    """Kepler's telescope: the back focus of one lens is the front focus of the next."""
    lens = shapes.lens((0.05, -0.05), 3.0, radius=3.0)
    one, _ = cardinal(lens.between(1.5, 1.0), 1.0)
    apart = one.back_focus[0] - one.front_focus[0]

    def telescope(apart):
        return together(lens.between(1.5, 1.0), lens.mapped(affine(), (apart, 0.0)).between(1.5, 1.0))

    points, spread = cardinal(telescope(apart), 0.5, turn=turn)
    assert points == Cardinal(afocal=True) and spread.paraxial is None
    off, _ = cardinal(telescope(apart + 1e-6), 0.5)
    assert off.focal_length == pytest.approx(-(one.focal_length**2) / 1e-6, rel=1e-6)


def test_rays_from_a_point_have_the_image_of_that_point():
    """1/b = 1/f − 1/a from the principal points; the lens does not change."""
    lens = shapes.lens((0.05, -0.05), 3.0, radius=3.0).between(1.5, 1.0)
    parallel, _ = cardinal(lens, 1.0)
    (group,) = groups(scene(lens, np.tile([-50.0, 0.0], (4, 1)), unit(np.radians([-2, -1, 1, 2]))))
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
        x, turn = place + shapes.sag(20.0, curvature), -2 * math.degrees(math.asin(20 * curvature))
        if index != n:
            parts.append(shapes.polyline([(x, -20.0), (x, 20.0)], [turn]).between(n, index))
        u = (n * u - y * curvature * (index - n)) / index
        place, n, y = place + thickness, index, y + thickness * u
    points, spread = cardinal(together(*parts), 5.0)
    assert points.back_focal_length == pytest.approx(surfaces[-1][1], rel=1e-12)
    assert spread.paraxial[0] == pytest.approx(place, rel=1e-12)
    assert points.focal_length == pytest.approx(-1 / u, rel=1e-12) == pytest.approx(100.00375702793, rel=1e-12)


# A chosen plane ------------------------------------------------------------------------------------------------


def test_a_spot_on_a_plane():
    """Of rays through a point: 2 tan θ from it on an upright plane 2 behind it, 1/tan θ on a level one."""
    tangent = np.array([-0.2, 0.1, 0.3])
    d = unit(np.arctan(tangent))
    spot = focal_points.spot(AT - 3 * d, d, Plane((AT[0] + 2, 7.0)))
    heights = AT[1] + 2 * tangent
    np.testing.assert_allclose(spot.centre, [AT[0] + 2, heights.mean()], atol=1e-14)
    assert (spot.rms, spot.extent) == pytest.approx((heights.std(), 1.0), rel=1e-13)
    turned = focal_points.spot(AT - 3 * d, d, Plane((AT[0], AT[1] + 1), 90.0))
    assert turned.extent == pytest.approx(1 / 0.1 + 1 / 0.2, rel=1e-13)
    assert focal_points.spot(AT - d, [(1.0, 0.0)] * 3, Plane((0.0, 0.0), 90.0)) is None


def test_a_plane_at_the_smallest_spot_has_that_spot():
    made = scene(ball(1.5), beam(11, 0.5), (1, 0))
    (first,) = groups(made)
    (group,) = groups(made, Plane(first.spread.spot))
    assert group.spread.on_plane.rms == pytest.approx(first.spread.rms, rel=1e-9)
    assert group.spread.on_plane.extent == pytest.approx(2 * first.spread.largest, rel=1e-9)
    assert focal_points.table([group]).splitlines()[-2].split()[-6:] == ["on", "the", "plane", "at", "rms", "extent"]
