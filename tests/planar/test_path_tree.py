"""Partial reflections: the tree of paths is complete, each of its legs is counted once, and its power is all there."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from support.planar_scenes import SLAB, ball, beam, polygon, scene

from mi_refract.backend import detect
from mi_refract.planar import Event, Segments, path_tree, trace
from mi_refract.planar.light import Light
from mi_refract.planar.path_tree import as_data, count, follow, follow_scene, summary, with_rays
from mi_refract.planar.segments import REFLECT_BITS

OBLIQUE = math.cos(0.6), math.sin(0.6)


def through_slab(most, **how):
    return follow(polygon(SLAB, 1.5), np.array([[-2.0, 0]]), np.array([OBLIQUE]), 20, most, **how)


def final_weights(found):
    return found.paths.weights[np.arange(len(found.rays)), found.last]


@pytest.mark.parametrize("most", [0, 1, 2, 7])
def test_the_power_is_all_there(most):
    """R outside, T² Rᵏ after k reflections inside: 1 − T Rᵏ⁺¹ altogether, for at most k of them; T² for none."""
    found = through_slab(most, least=0.0)
    t = found.paths.polarised[0, 1]  # of the s and of the p wave
    assert 0.9 < t.mean() < 0.99
    expected = np.mean(t**2 if most == 0 else 1 - t * (1 - t) ** (most + 1))
    assert final_weights(found).sum() == pytest.approx(expected, abs=1e-14)
    inside = [(1 << k + 1) - 2 for k in range(1, most + 1)]
    assert sorted(found.reflect.tolist()) == [0, 1, *inside][: most + 2 if most else 1]


def test_what_carries_less_is_cut():
    found = through_slab(9)
    assert (final_weights(found) > 0.9 * path_tree.LEAST).all()
    cut = 1 - final_weights(found).sum()
    assert 1e-9 < cut < path_tree.LEAST


def test_the_primary_rainbow_is_bit_one():
    """Deviation π + 2i − 4r of a ray at height sin i, weight T R T; Descartes, Fresnel."""
    height, n = 0.86, 1.333
    found = follow(ball(n), np.array([[-3.0, height]]), np.array([[1.0, 0]]), 8, 1)
    (primary,) = np.flatnonzero(found.reflect == 0b10)
    i, r = math.asin(height), math.asin(height / n)
    turned = -(math.pi + 2 * i - 4 * r)  # clockwise, for it meets the upper half
    np.testing.assert_allclose(found.paths.directions[primary], [math.cos(turned), math.sin(turned)], atol=1e-14)
    t = found.paths.polarised[primary, 1]
    assert final_weights(found)[primary] == pytest.approx(np.mean(t**2 * (1 - t)), rel=1e-12)


def test_the_tree_holds_every_path_once():
    found = follow(ball(1.5), beam(9, 0.9), np.tile([1.0, 0], (9, 1)), 12, 2, least=1e-4)
    named = list(zip(found.rays.tolist(), found.reflect.tolist(), strict=True))
    assert len(set(named)) == len(named) > 9
    place = {name: i for i, name in enumerate(named)}
    for (ray, bits), i in place.items():
        if bits:  # up to the last partial reflection it is its parent's path
            last = bits.bit_length() - 1
            parent = place[ray, bits ^ 1 << last]
            np.testing.assert_array_equal(found.paths.points[i, : last + 2], found.paths.points[parent, : last + 2])
            assert found.paths.events[parent, last] == Event.REFRACTED
            assert found.paths.events[i, last] == Event.REFLECTED
            assert found.first[i] == last + 1
            assert not found.own[i, : last + 1].any()


def test_no_leg_is_counted_twice():
    given = scene(polygon(SLAB, 1.5), [[-2.0, 0]], OBLIQUE, branches=1)
    traced = follow_scene(given)
    # The direct path meets 2 boundaries, that with a reflection inside meets one more.
    assert count(traced) == {
        "REFRACTED": 3,
        "ESCAPED": 3,
        "NONE": 0,
        "REFLECTED": 0,
        "MAX_DEPTH": 0,
        "MEDIUM_MISMATCH": 0,
    }
    assert summary(given, traced) == "1 ray, 3 paths, 3 hits, 3 escaped"
    assert summary(given, follow_scene(replace(given, branches=0))) == "1 ray, 2 hits, 1 escaped"


def test_paths_end_in_every_way():
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    inside = scene(polygon(square, 2.0), [[0.5, 0.25]], (1, 1.1), max_depth=6)
    assert summary(inside, follow_scene(inside)) == "1 ray, 6 hits, 6 reflected totally, 1 stopped at max_depth"
    wrong = polygon(square, 2.0)
    wrong = replace(wrong, n_left=np.array([2.0, 1.7, 2.0, 2.0]))
    given = scene(wrong, [[-1, 0.5]], (1, 0))
    traced = follow_scene(given)
    assert summary(given, traced) == "1 ray, 2 hits, 1 stopped by a medium mismatch"
    np.testing.assert_allclose(traced[0].tips, [[1, 0.5]])


def test_more_legs_than_fit_in_memory_are_refused():
    """Of all paths, colours and partial reflections: counted before they are traced."""
    colours = {"light": Light(("red", "blue"))}
    given = scene((polygon(SLAB, 1.5), polygon(SLAB, 1.6)), beam(16, 1.0), (1, 0), max_depth=9, branches=1, **colours)
    assert [len(branches.rays) for branches in follow_scene(given, most=960)] == [48, 48]
    with pytest.raises(ValueError, match="950 legs altogether, of which other colours take 480"):
        follow_scene(given, most=950)
    with pytest.raises(ValueError, match="32 paths of up to 9 boundaries with up to 0 partial reflections; expected"):
        follow_scene(given, most=319)
    with pytest.raises(ValueError, match="33554432 legs altogether"):
        with_rays(given, 2**22)
    with pytest.raises(ValueError, match="branches = -1; expected"):
        through_slab(-1)


def test_the_data_is_strict_json():
    given = scene((polygon(SLAB, 1.5), polygon(SLAB, 1.6)), beam(2, 1.0), OBLIQUE, branches=1, colours=("red", "blue"))
    traced = follow_scene(given)
    data = json.loads(json.dumps(as_data(given, traced), allow_nan=False))
    assert [entry["colour"] for entry in data["colours"]] == ["red", "blue"]
    assert data["counts"]["escaped"] == 12
    path = data["colours"][1]["paths"][0]
    assert (path["ray"], path["beam"], path["reflect"]) == (0, 0, 0)
    assert path["events"] == ["refracted", "refracted", "escaped"]
    assert path["indices"] == [1.0, 1.6, 1.0]
    assert path["points"] == traced[1].paths.points[0, :3].tolist()
    assert len(path["hits"]) == 2
    assert path["weights"][0] == 1.0 > path["weights"][1] > path["weights"][2] > 0.8


def test_more_rays_lie_between_those_of_the_beam():
    fan = np.radians([170, 190, 210])
    origins = np.concatenate([beam(3, 1.0), [[0, 5]], np.zeros((3, 2))])
    directions = np.concatenate([np.tile([1.0, 0], (3, 1)), [[0, -1]], np.column_stack([np.cos(fan), np.sin(fan)])])
    given = scene(ball(1.5), origins, directions, beams=np.array([0, 0, 0, 1, 2, 2, 2]))
    more = with_rays(given, 5)
    assert more.beams.tolist() == [0] * 5 + [1] + [2] * 5
    np.testing.assert_allclose(more.origins[:5], beam(5, 1.0))
    np.testing.assert_allclose(more.directions[5], [0, -1], atol=1e-15)
    angles = np.degrees(np.arctan2(*more.directions[6:].T[::-1])) % 360
    np.testing.assert_allclose(angles, [170, 180, 190, 200, 210])


# More boundaries than bits ---------------------------------------------------------------------------------------


def slabs(boundaries):
    """Parallel walls at x = 0, 1, 2, …, between air and a thin glass in turn."""
    x, far = np.arange(boundaries, dtype=float), np.full(boundaries, 1e4)
    even = np.arange(boundaries) % 2 == 0
    # Walls run upwards: their left is the side of smaller x.
    walls = np.column_stack([x, -far]), np.column_stack([x, far])
    return Segments(*walls, np.where(even, 1.0, 1.1), np.where(even, 1.1, 1.0))


def test_only_the_boundaries_that_have_a_bit_reflect_in_part():
    """Of 40 boundaries the first 32: each reflection has a bit of its own, and no path is there twice."""
    found = follow(slabs(40), np.array([[-1.0, 0]]), np.array([OBLIQUE]), 80, 1, least=0.0, backend="scalar")
    assert found.paths.events[0].tolist().count(Event.REFRACTED) == 40
    assert sorted(found.reflect.tolist()) == [0, *(1 << j for j in range(REFLECT_BITS))]


@pytest.mark.parametrize("backend", ["scalar", "llvm"])
def test_the_last_bit_is_that_of_one_boundary(backend):
    """Reflected at the 32nd boundary, a ray refracts at all that it meets on its way back."""
    if backend != "scalar" and not detect()[backend].usable:
        pytest.skip(detect()[backend].reason)
    asked = np.array([0, 1 << (REFLECT_BITS - 1)])
    paths = trace(slabs(40), [(-1.0, 0)] * 2, [OBLIQUE] * 2, 80, reflect=asked, backend=backend)
    assert np.flatnonzero(paths.events[1] == Event.REFLECTED).tolist() == [REFLECT_BITS - 1]
    assert (paths.events[1] == Event.REFRACTED).sum() == 2 * (REFLECT_BITS - 1)
    assert (paths.events == Event.ESCAPED).sum(1).tolist() == [1, 1]


@pytest.mark.parametrize("angles", [(-170.0, 170.0), (0.0, 360.0), (170.0, -170.0), (10.0, 20.0)])
@pytest.mark.parametrize("count", [2, 3, 9])
def test_more_rays_of_a_fan_go_the_same_way_round(angles, count):
    """Whatever number of rays the file has: steps of 180° and more."""
    fan = np.radians(np.linspace(*angles, count))
    directions = np.column_stack([np.cos(fan), np.sin(fan)])
    found = with_rays(scene(ball(1.5), np.zeros((count, 2)), directions, fans=(angles,)), 7).directions
    expected = np.radians(np.linspace(*angles, 7))
    assert found == pytest.approx(np.column_stack([np.cos(expected), np.sin(expected)]), abs=1e-12)


def test_s_and_p_never_mix():
    """Ten plates at Brewster's angle: p goes through whole, s loses R_s at each of 20 boundaries."""
    n, y = 1.5, np.repeat(np.arange(10.0), 2) + np.tile([0.0, 0.5], 10)
    far = 1e3
    starts = np.column_stack([np.full(20, -far), -y])
    ends = np.column_stack([np.full(20, far), -y])
    left, right = np.tile([1.0, n], 10), np.tile([n, 1.0], 10)
    brewster = np.arctan(n)
    paths = trace(
        Segments(starts, ends, left, right), [[0.0, 1.0]], [[np.sin(brewster), -np.cos(brewster)]], 20, weights=True
    )
    r_s = ((n * n - 1) / (n * n + 1)) ** 2
    assert paths.polarised[0, 20] == pytest.approx([(1 - r_s) ** 20, 1.0], rel=1e-6)
    assert paths.weights[0, 20] == pytest.approx(((1 - r_s) ** 20 + 1) / 2, rel=1e-6)
