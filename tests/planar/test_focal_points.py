"""Focal points and spots, against bundles of lines whose focus is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.planar_scenes import SLAB, ball, beam, polygon, scene

from mi_refract.planar import focal_points
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
    np.testing.assert_allclose(spread.paraxial, [crossing_of_ball(half / 50, n), 0], atol=1e-11)
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
    assert len(lines) == 13
    assert lines[0].split()[:3] == ["colour", "beam", "reflected"]
    assert lines[3].split()[:4] == ["red", "0", "1", "3"]


def test_a_slab_only_moves_a_beam():
    given = scene(polygon(SLAB, 1.5), beam(5, 1.0, x=-2), (1, 0.3))
    (group,) = focal_points.groups(given, follow_scene(given))
    assert (group.spread.focus, group.spread.marginal) == (None, None)
    assert focal_points.table([group]).splitlines()[1].split()[4] == "–"


def test_numbers_that_are_zero_but_for_rounding():
    assert focal_points._text((2.0, 1e-16)) == "2, 0"
    assert focal_points._text((0.0, -1e-16)) == "0, -1e-16"
