"""Partial reflections: the tree of paths is complete, each leg is counted once, and no power is lost."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.planar_scenes import SLAB, SQUARE, ball, beam, polygon, scene

from mi_refract.planar import Event, Segments, path_tree, trace
from mi_refract.planar.light import Light
from mi_refract.planar.path_tree import count, follow, follow_scene, summary, with_rays
from mi_refract.planar.segments import REFLECT_BITS

OBLIQUE = math.cos(0.6), math.sin(0.6)
GLASS, DENSER = polygon(SLAB, 1.5), polygon(SLAB, 1.6)


def through_slab(most, **how):
    return follow(GLASS, np.array([[-2.0, 0]]), np.array([OBLIQUE]), 20, most, **how)


def final_weights(tree):
    return tree.paths.weights[np.arange(len(tree.rays)), tree.last]


@pytest.mark.parametrize("most", [0, 1, 2, 7])
def test_the_paths_of_a_slab_carry_all_the_power(most):
    """R outside, T² Rᵏ after k reflections inside: in total 1 − T Rᵏ⁺¹ for at most k reflections, T² for none."""
    tree = through_slab(most, least=0.0)
    t = tree.paths.polarised[0, 1]  # of the s and p waves
    assert 0.9 < t.mean() < 0.99
    expected = np.mean(t**2 if most == 0 else 1 - t * (1 - t) ** (most + 1))
    assert final_weights(tree).sum() == pytest.approx(expected, abs=1e-14)
    inside = [(1 << k + 1) - 2 for k in range(1, most + 1)]
    assert sorted(tree.reflect.tolist()) == [0, 1, *inside][: most + 2 if most else 1]


def test_reflections_below_the_limit_are_not_followed():
    weights = final_weights(through_slab(9))
    assert (weights > 0.9 * path_tree.LEAST).all()
    assert 1e-9 < 1 - weights.sum() < path_tree.LEAST


def test_the_primary_rainbow_is_the_path_with_bit_one():
    """A ray at height sin i is deviated by π + 2i − 4r (Descartes) with weight T R T (Fresnel)."""
    height, n = 0.86, 1.333
    tree = follow(ball(n), np.array([[-3.0, height]]), np.array([[1.0, 0]]), 8, 1)
    (primary,) = np.flatnonzero(tree.reflect == 0b10)
    turned = -(math.pi + 2 * math.asin(height) - 4 * math.asin(height / n))  # clockwise, as it meets the upper half
    np.testing.assert_allclose(tree.paths.directions[primary], [math.cos(turned), math.sin(turned)], atol=1e-14)
    t = tree.paths.polarised[primary, 1]
    assert final_weights(tree)[primary] == pytest.approx(np.mean(t**2 * (1 - t)), rel=1e-12)


def test_the_tree_contains_every_path_once():
    tree = follow(ball(1.5), beam(9, 0.9), np.tile([1.0, 0], (9, 1)), 12, 2, least=1e-4)
    points, events = tree.paths.points, tree.paths.events
    place = {name: i for i, name in enumerate(zip(tree.rays.tolist(), tree.reflect.tolist(), strict=True))}
    assert len(place) == len(tree.rays) > 9
    for (ray, bits), i in place.items():
        if bits:  # up to the last partial reflection it coincides with its parent's path
            last = bits.bit_length() - 1
            parent = place[ray, bits ^ 1 << last]
            np.testing.assert_array_equal(points[i, : last + 2], points[parent, : last + 2])
            assert (events[parent, last], events[i, last]) == (Event.REFRACTED, Event.REFLECTED)
            assert tree.first[i] == last + 1 and not tree.own[i, : last + 1].any()


def test_counts_and_summary():
    """The direct path meets 2 boundaries, the path with a reflection inside meets 3; they share 2."""
    split = scene(GLASS, [[-2.0, 0]], OBLIQUE, branches=1)
    assert +count(follow_scene(split)) == {"REFRACTED": 3, "ESCAPED": 3}
    square = polygon(SQUARE, 2.0)
    wrong = scene(replace(square, n_left=np.array([2.0, 1.7, 2.0, 2.0])), [[-1, 0.5]], (1, 0))
    for ending, text in (
        (split, "1 ray, 3 paths, 3 hits, 3 escaped"),
        (replace(split, branches=0), "1 ray, 2 hits, 1 escaped"),
        (
            scene(square, [[0.5, 0.25]], (1, 1.1), max_depth=6),
            "1 ray, 6 hits, 6 reflected totally, 1 stopped at max_depth",
        ),
        (wrong, "1 ray, 2 hits, 1 stopped by a medium mismatch"),
    ):
        assert summary(ending, follow_scene(ending)) == text
    np.testing.assert_allclose(follow_scene(wrong)[0].tips, [[1, 0.5]])


def test_more_legs_than_the_limit_are_an_error():
    """The legs of all paths, colours and partial reflections are counted before they are traced."""
    light = Light(("red", "blue"))
    two_colours = scene((GLASS, DENSER), beam(16, 1.0), (1, 0), max_depth=9, branches=1, light=light)
    assert [len(branches.rays) for branches in follow_scene(two_colours, most=960)] == [48, 48]
    zero_reflections = "32 paths of up to 9 boundaries with up to 0 partial reflections; expected"
    for call, match in (
        (lambda: follow_scene(two_colours, most=950), "up to 950 legs in total, including 480 of other colours"),
        (lambda: follow_scene(two_colours, most=319), zero_reflections),
        (lambda: with_rays(two_colours, 2**22), "up to 33554432 legs in total"),
        (lambda: through_slab(-1), "branches = -1; expected"),
    ):
        with pytest.raises(ValueError, match=match):
            call()


def fan(angles):
    return np.column_stack([np.cos(np.radians(angles)), np.sin(np.radians(angles))])


def test_added_rays_lie_between_those_of_the_beam():
    origins = np.concatenate([beam(3, 1.0), [[0, 5]], np.zeros((3, 2))])
    directions = np.concatenate([np.tile([1.0, 0], (3, 1)), [[0, -1]], fan([170, 190, 210])])
    more = with_rays(scene(ball(1.5), origins, directions, beams=np.array([0, 0, 0, 1, 2, 2, 2])), 5)
    assert more.beams.tolist() == [0] * 5 + [1] + [2] * 5
    np.testing.assert_allclose(more.origins[:5], beam(5, 1.0))
    expected = [[0, -1], *fan([170, 180, 190, 200, 210])]
    np.testing.assert_allclose(more.directions[5:], expected, atol=1e-15)


@pytest.mark.parametrize("angles", [(-170.0, 170.0), (0.0, 360.0), (170.0, -170.0), (10.0, 20.0)])
@pytest.mark.parametrize("count", [2, 3, 9])
def test_added_rays_of_a_fan_keep_its_sense_of_rotation(angles, count):
    """Also where the file's rays are 180° or more apart."""
    fan_scene = scene(ball(1.5), np.zeros((count, 2)), fan(np.linspace(*angles, count)), fans=(angles,))
    assert with_rays(fan_scene, 7).directions == pytest.approx(fan(np.linspace(*angles, 7)), abs=1e-12)
    assert with_rays(fan_scene, 1).directions == pytest.approx(fan([np.mean(angles)]), abs=1e-12)  # as in a scene file


# Walls ---------------------------------------------------------------------------------------------------------


def walls(x, n):
    """Parallel vertical walls at `x` between air and glass in turn; the left of a wall is the side of smaller x."""
    far, even = np.full(len(x), 1e4), np.arange(len(x)) % 2 == 0
    ends = np.column_stack([x, -far]), np.column_stack([x, far])
    return Segments(*ends, np.where(even, 1.0, n), np.where(even, n, 1.0))


def test_only_the_first_32_boundaries_reflect_in_part():
    """Of 40 boundaries the first 32 reflect: each has its own bit, and no path occurs twice."""
    rays = np.array([[-1.0, 0]]), np.array([OBLIQUE])
    tree = follow(walls(np.arange(40.0), 1.1), *rays, 80, 1, least=0.0, backend="scalar")
    assert tree.paths.events[0].tolist().count(Event.REFRACTED) == 40
    assert sorted(tree.reflect.tolist()) == [0, *(1 << j for j in range(REFLECT_BITS))]


@pytest.mark.parametrize("backend", ["scalar", "llvm"])
def test_the_last_bit_reflects_at_one_boundary_only(backend, needs_variant):
    """A ray that is reflected at the 32nd boundary is refracted at all boundaries on its way back."""
    needs_variant({"scalar": "scalar_rgb", "llvm": "llvm_ad_rgb"}[backend])
    reflect = np.array([0, 1 << (REFLECT_BITS - 1)])
    rays = [(-1.0, 0)] * 2, [OBLIQUE] * 2
    paths = trace(walls(np.arange(40.0), 1.1), *rays, 80, reflect=reflect, backend=backend)
    assert np.flatnonzero(paths.events[1] == Event.REFLECTED).tolist() == [REFLECT_BITS - 1]
    assert (paths.events[1] == Event.REFRACTED).sum() == 2 * (REFLECT_BITS - 1)
    assert (paths.events == Event.ESCAPED).sum(1).tolist() == [1, 1]


def test_s_and_p_never_mix():
    """Ten plates at Brewster's angle: p passes without loss, s loses R_s at each of 20 boundaries."""
    n = 1.5
    paths = trace(walls(np.arange(20) / 2, n), [[-1.0, 0]], [[1, n]], 20, weights=True)
    transmitted = (1 - ((n * n - 1) / (n * n + 1)) ** 2) ** 20
    assert paths.polarised[0, 20] == pytest.approx([transmitted, 1.0], rel=1e-6)
    assert paths.weights[0, 20] == pytest.approx((transmitted + 1) / 2, rel=1e-6)
