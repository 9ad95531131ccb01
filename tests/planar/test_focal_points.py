"""Focal points and spots, against lines with a known focus and systems with a known focal length."""

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


def groups(traced_scene, plane=None):
    return focal_points.groups(traced_scene, follow_scene(traced_scene), plane)


@pytest.mark.parametrize(
    ("at", "distance", "directions", "tolerance"),
    [
        (AT, 5.0, FAN, 1e-14),
        (AT, -5.0, FAN, 1e-14),
        # Lines 1e-5 rad apart, from a distance of 1024: the error comes from the rounding of the origins.
        (np.array([1000.0, 0.3]), 1024.0, unit(1e-5 * np.array([-1.0, -0.3, 0.45, 1.0])), 2e-11),
    ],
)
def test_the_focus_of_rays_through_a_point_is_that_point_to_rounding(at, distance, directions, tolerance):
    spread = focal_points.spread(at - distance * directions, directions)
    assert spread.virtual is (distance < 0)
    np.testing.assert_allclose([spread.focus, spread.spot], [at, at], rtol=0, atol=tolerance)
    assert spread.rms < spread.largest < min(tolerance, 1e-14)


def test_rays_that_have_no_focus_or_no_spot():
    parallel = focal_points.spread(beam(5, 1.0), np.tile([1.0, 0], (5, 1)))
    assert (parallel.focus, parallel.virtual) == (None, False)
    assert (parallel.rms, parallel.largest) == (pytest.approx(math.sqrt(0.5)), 1.0)
    single = focal_points.spread(AT[None], FAN[:1])
    assert (single.rays, single.focus, single.spot, single.rms) == (1, None, None, None)
    directions = unit([0, math.pi / 2, 3.0])
    diverging = focal_points.spread(AT + 2 * directions, directions)
    np.testing.assert_allclose(diverging.focus, AT, atol=1e-14)
    assert diverging.virtual and diverging.spot is None


def test_no_other_plane_has_a_smaller_spot():
    """For random lines: moving the plane along the mean direction makes the RMS radius larger."""
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


def test_a_ball_has_its_known_marginal_and_paraxial_foci_and_mirror_focal_length():
    """A ray at height h meets the axis of the unit ball at h / sin(2 (asin h − asin(h/n))), by the law of sines."""
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


def test_rays_are_grouped_by_colour_beam_and_reflections():
    origins, beams = np.concatenate([beam(3, 0.3), beam(2, 0.1, y=0.5), [[-3, 2.0]]]), np.array([0, 0, 0, 1, 1, 1])
    ray_groups = groups(
        scene((ball(1.5), ball(1.6)), origins, (1, 0), beams=beams, colours=("red", "blue"), branches=1)
    )
    keys = [(g.colour, g.beam, g.reflect, g.spread.rays) for g in ray_groups]
    rays = {0: 3, 1: 2}  # the sixth ray meets no boundary
    assert keys == [(c, b, bits, rays[b]) for c in ("red", "blue") for b in (0, 1) for bits in (0, 1, 2)]
    lines = focal_points.table(ray_groups).splitlines()
    assert len(lines) == 13 + 1 + 13  # two tables and a blank line between them
    assert lines[0].split()[:3] == ["colour", "beam", "reflected"]
    assert lines[3].split()[:4] == ["red", "0", "1", "3"]


def test_a_slab_is_afocal():
    (group,) = groups(scene(polygon(SLAB, 1.5), beam(5, 1.0, x=-2), (1, 0.3)))
    assert (group.spread.focus, group.spread.marginal, group.spread.paraxial) == (None, None, None)
    assert group.spread.cardinal == Cardinal(afocal=True)
    lines = focal_points.table([group]).splitlines()
    assert lines[1].split()[4] == "–"
    assert lines[4].split()[3:] == ["infinite", "–", "–", "–", "–"]


def test_rays_that_are_parallel_up_to_rounding_have_no_focus(needs_variant):
    """Of a lens that turns a fan of rays into parallel ones."""
    needs_variant("llvm_ad_rgb")
    lens = shapes.ellipse_lens(1.5, 9.0, 4.0, 3.0).between(1.5, 1.0)
    collimated = scene(lens, np.zeros((10, 2)), unit(np.radians(np.linspace(170, 190, 10))))
    exact, rounded = (
        focal_points.groups(collimated, follow_scene(collimated, precision=precision, backend="llvm"))[0].spread
        for precision in ("float64", "float32")
    )
    for spread in (exact, rounded):
        assert (spread.rays, spread.focus, spread.marginal, spread.paraxial) == (10, None, None, None)
    assert (rounded.rms, rounded.largest) == pytest.approx((exact.rms, exact.largest), rel=1e-5)


# The paraxial limit --------------------------------------------------------------------------------------------


def cardinal(segments, half, turn=0.0, at=(0.0, 0.0)):
    """The cardinal points and the spread of a system along x, turned by `turn` degrees and moved to `at`."""
    rotation = affine(turn)
    start, end, control = (x @ rotation.T + at for x in (segments.start, segments.end, segments.control))
    segments = Segments(start, end, segments.n_left, segments.n_right, control, segments.weight)
    spread = groups(scene(segments, beam(4, half, -30.0) @ rotation.T + at, rotation[:, 0]))[0].spread
    return spread.cardinal, spread


@pytest.mark.parametrize("turn", [0.0, 33.3])
@pytest.mark.parametrize("curvature", [(0.02, -0.03), (0.05, 0.01), (-0.04, 0.0)])
def test_a_thick_lens_has_the_focal_length_of_the_lensmakers_formula(curvature, turn):
    """Its principal points are at f (n − 1) t c / n from its faces, c the curvature of the other face."""
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


def test_a_boundary_has_a_focal_length_in_each_of_its_media():
    """f = n' R/(n' − n) behind it and n R/(n' − n) before it; the numerical aperture contains n'."""
    n, behind, radius = 1.33, 1.6, 5.0
    arc = shapes.polyline([(1.0, 3.0), (1.0, -3.0)], [2 * math.degrees(math.asin(3.0 / radius))]).between(behind, n)
    points, spread = cardinal(arc, 1.0)
    angle = math.asin(1 / radius) - math.asin(n / behind / radius)
    assert spread.aperture == pytest.approx(behind * math.sin(angle), rel=1e-13)
    sag = radius - math.sqrt(radius**2 - 9)
    assert points.focal_length == points.back_focal_length == pytest.approx(behind * radius / (behind - n), rel=1e-13)
    assert points.front_focal_length == pytest.approx(-n * radius / (behind - n), rel=1e-13)
    np.testing.assert_allclose(points.principal, [(1 - sag, 0)] * 2, atol=1e-12)


@pytest.mark.parametrize("turn", [0.0, 33.3])
def test_keplers_telescope_is_afocal(turn):
    """The back focus of one lens is the front focus of the next."""
    lens = shapes.lens((0.05, -0.05), 3.0, radius=3.0)
    single, _ = cardinal(lens.between(1.5, 1.0), 1.0)
    distance = single.back_focus[0] - single.front_focus[0]

    def telescope(distance):
        return together(lens.between(1.5, 1.0), lens.mapped(affine(), (distance, 0.0)).between(1.5, 1.0))

    points, spread = cardinal(telescope(distance), 0.5, turn=turn)
    assert points == Cardinal(afocal=True) and spread.paraxial is None
    defocused, _ = cardinal(telescope(distance + 1e-6), 0.5)
    assert defocused.focal_length == pytest.approx(-(single.focal_length**2) / 1e-6, rel=1e-6)


def test_rays_from_a_point_meet_in_its_image():
    """1/b = 1/f − 1/a, from the principal points; the focal length is that for parallel rays."""
    lens = shapes.lens((0.05, -0.05), 3.0, radius=3.0).between(1.5, 1.0)
    parallel, _ = cardinal(lens, 1.0)
    (group,) = groups(scene(lens, np.tile([-50.0, 0.0], (4, 1)), unit(np.radians([-2, -1, 1, 2]))))
    first, second = (x for x, _ in parallel.principal)
    exact = second + 1 / (1 / parallel.focal_length - 1 / (first + 50))
    assert group.spread.paraxial[0] == pytest.approx(exact, rel=1e-12)
    assert group.spread.cardinal.focal_length == pytest.approx(parallel.focal_length, rel=1e-13)


def test_the_double_gauss_has_the_image_distance_of_code_v():
    """Its last thickness is the paraxial image distance in 16 digits; the focal length is from a paraxial trace."""
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
    """Rays through a point are at 2 tan θ on a vertical plane 2 behind it, at 1/tan θ on a horizontal plane 1 above."""
    tangent = np.array([-0.2, 0.1, 0.3])
    d = unit(np.arctan(tangent))
    spot = focal_points.spot(AT - 3 * d, d, Plane((AT[0] + 2, 7.0)))
    heights = AT[1] + 2 * tangent
    np.testing.assert_allclose(spot.centre, [AT[0] + 2, heights.mean()], atol=1e-14)
    assert (spot.rms, spot.extent) == pytest.approx((heights.std(), 1.0), rel=1e-13)
    turned = focal_points.spot(AT - 3 * d, d, Plane((AT[0], AT[1] + 1), 90.0))
    assert turned.extent == pytest.approx(1 / 0.1 + 1 / 0.2, rel=1e-13)
    assert focal_points.spot(AT - d, [(1.0, 0.0)] * 3, Plane((0.0, 0.0), 90.0)) is None


def test_a_plane_through_the_smallest_spot_has_that_spot():
    ball_scene = scene(ball(1.5), beam(11, 0.5), (1, 0))
    (first,) = groups(ball_scene)
    (group,) = groups(ball_scene, Plane(first.spread.spot))
    assert group.spread.on_plane.rms == pytest.approx(first.spread.rms, rel=1e-9)
    assert group.spread.on_plane.extent == pytest.approx(2 * first.spread.largest, rel=1e-9)
    assert focal_points.table([group]).splitlines()[-2].split()[-6:] == ["on", "the", "plane", "at", "rms", "extent"]
