"""The path loop of `refract_path`, one path at a time: the random numbers are given, so that its light is known.

In `scalar_rgb`: the loop is the same in every variant, and nothing is compiled.
"""

import math

import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import GLASS, PLACE

from mi_refract.plugins import path_loop, sampling
from mi_refract.rendering.scene_files import REPRODUCIBLE

pytestmark = pytest.mark.usefixtures("scalar_variant")

REFLECTED, TRANSMITTED, UPWARD = (0.0, 0.5), (0.999, 0.5), (0.5, 0.5)
ALBEDO, RADIANCE = 0.5, 3.0


class Given:
    """Random numbers: at each vertex the next of `points`, whose x chooses the lobe; 1/2 for all else.

    Keeps the keys of the numbers that choose lobes, as unsigned numbers have them elsewhere.
    """

    def __init__(self, *points):
        self.points, self.keys = [*points], []

    def next(self):
        return self.points.pop(0) if self.points else UPWARD

    def next_1d(self, sampler, key):
        if key % 4 != 1:
            return 0.5
        self.keys.append(key % 2**32)
        return self.next()[0]

    def next_2d(self, sampler, key):
        return mi.Point2f(*self.next()) if key % 4 == 2 else mi.Point2f(0.5)


def sheet(z, size=10.0, x=0.0, turn=0, **parts):
    """A square across the z axis, which faces upward."""
    place = PLACE().translate([x, 0, z]).rotate([1, 0, 0], turn).scale(size)
    return {"type": "rectangle", "to_world": place} | parts


def lamp(z, x=0.0):
    """A square of the area 1 that shines downward: its density from below is far from 0 and from infinity."""
    return sheet(z, 0.5, x, 180, emitter={"type": "area", "radiance": RADIANCE})


def wall():
    return sheet(-1, bsdf={"type": "diffuse", "reflectance": ALBEDO})


def follow(parts, numbers, o=(0, 0, 1), d=(0.6, 0, -0.8), **parameters):
    """The radiance and the alpha of one sample along a ray. `numbers`: points, or what gives numbers."""
    scene, method = mi.load_dict({"type": "scene"} | parts), mi.load_dict({"type": "refract_path"} | parameters)
    features = method.path_features(method.scene_features(scene))
    numbers = Given(*numbers) if isinstance(numbers, list) else numbers
    end = path_loop.PathLoop(mi.scalar_rgb, scene, features, numbers).run(mi.Ray3f(o, d), None, True)
    return np.array(end.result), bool(end.valid_ray)


def reflectance(cosine, k):
    """The unpolarised reflectance from an index to another, `k` times smaller: Fresnel's formulas as printed."""
    other = math.sqrt(1 - k * k * (1 - cosine**2))
    return (((k * cosine - other) / (k * cosine + other)) ** 2 + ((cosine - k * other) / (cosine + k * other)) ** 2) / 2


# From z = 1 down to glass at z = 0, and up again: the reflected ray is at x = 2.25 where z = 2.
SLANTED = reflectance(0.8, 1 / 1.5)


def test_light_that_a_popped_branch_meets_counts_whole():
    """The other branch has ended beyond a matt wall, whose samples share their light with emitter samples."""
    parts = {"glass": sheet(0, bsdf=GLASS), "wall": wall(), "lamp": lamp(2, 2.25)}
    found, _ = follow(parts, [TRANSMITTED, UPWARD], max_depth=3, split_depth=1)
    assert found == pytest.approx(SLANTED * RADIANCE, rel=1e-5)


@pytest.mark.parametrize(("weight", "splits"), [(0.0, True), (0.004, True), (0.007, False), (0.04, False)])
def test_a_popped_branch_splits_again_where_its_share_is_large_enough(weight, splits):
    """It has met glass only, whatever the branch before it met. It goes on from inside the second sheet into air.

    Its share is that of the reflected light, 5 %, of which the second sheet reflects 11 %. Without a split chance picks
    that, and the lamp beyond is not met.
    """
    sine = 0.6 * 1.5
    beyond = lamp(3, 2.25 + sine / math.sqrt(1 - sine**2))
    parts = {"glass": sheet(0, bsdf=GLASS), "wall": wall(), "second": sheet(2, bsdf=GLASS), "lamp": beyond}
    points = [TRANSMITTED, UPWARD, REFLECTED]
    found, _ = follow(parts, points, max_depth=3, split_depth=2, split_weight=weight)
    assert SLANTED * reflectance(0.8, 1.5) == pytest.approx(0.0054, abs=1e-3)
    expected = splits * SLANTED * (1 - reflectance(0.8, 1.5)) * RADIANCE * 1.5**2  # n² times the radiance inside
    assert found == pytest.approx(expected, rel=1e-5)


def test_no_two_vertices_of_branches_have_the_same_random_number():
    """Four sheets of glass, of which each splits, two of them on either side."""
    numbers, parts = Given(), {f"sheet {z}": sheet(z, bsdf=GLASS) for z in range(4)}
    follow(parts, numbers, (0, 0, 1.5), split_depth=4, split_weight=1e-3, max_depth=7)
    assert len(numbers.keys) > 10
    assert len(set(numbers.keys)) == len(numbers.keys)


@pytest.mark.parametrize(("lobe", "lit"), [(REFLECTED, False), (TRANSMITTED, True)])
def test_no_path_splits_after_a_matt_wall(lobe, lit):
    """From the wall straight up to glass: only the lobe that chance picks is followed, and the lamp is beyond it."""
    parts = {"glass": sheet(0, bsdf=GLASS), "wall": wall(), "lamp": lamp(2)}
    found, _ = follow(parts, [UPWARD, lobe], (0, 0, -0.5), (0, 0, -1), max_depth=4, split_depth=4, split_weight=0.01)
    # The wall is inside the glass, where radiance is n² times that in air.
    assert found == pytest.approx(ALBEDO * RADIANCE * 1.5**2 if lit else 0, rel=1e-5)


def test_roulette_does_not_end_a_branch_for_being_one_of_several():
    """It is judged by what it lost beside its share R = 5 %, which is nothing: it survives with probability 0.95."""
    parts = {"glass": sheet(0, bsdf=GLASS), "lamp": lamp(2, 2.25)}
    found, _ = follow(parts, [REFLECTED], max_depth=3, rr_depth=1, split_depth=1)
    assert found == pytest.approx(SLANTED * RADIANCE / 0.95, rel=1e-5)


@pytest.mark.parametrize(
    ("bsdf", "point", "alpha"),
    [
        ({"type": "null"}, UPWARD, False),
        ({"type": "thindielectric"}, TRANSMITTED, False),
        ({"type": "thindielectric"}, REFLECTED, True),
        (GLASS, TRANSMITTED, True),
    ],
    ids=str,
)
def test_a_pixel_is_transparent_where_light_goes_straight_through(bsdf, point, alpha):
    assert follow({"pane": sheet(0, bsdf=bsdf)}, [point], max_depth=4)[1] == alpha


@pytest.mark.parametrize(
    ("a", "b", "weight"),
    [(3, 4, 9 / 25), (4, 3, 16 / 25), (1, 0, 1), (0, 1, 0), (0, 0, 0), (math.inf, 1, 0), (1, math.inf, 0)],
)
def test_samples_are_weighted_by_their_densities(a, b, weight):
    """An infinite density has no weight, as in Mitsuba's `path`."""
    assert path_loop.power_heuristic(float(a), float(b)) == pytest.approx(weight)


@pytest.mark.parametrize("weights", [(1.0,), (1.0, 3.0), (0.0, 2.0, 2.0)])
def test_lamps_are_sampled_as_if_there_were_no_sky(weights):
    """By their weights: as Mitsuba samples the same lamps without the sky."""
    emitters = ({"type": "area", "radiance": 1.0 + i, "sampling_weight": x} for i, x in enumerate(weights))
    lamps = {f"lamp{i}": lamp(2, 3.0 * i) | {"emitter": emitter} for i, emitter in enumerate(emitters)}
    # Mitsuba orders merged meshes by address: of two scenes, the lamps would not always be in the same order.
    dark, lit = (
        mi.load_dict({"type": "scene"} | lamps | x, **REPRODUCIBLE) for x in ({}, {"sky": {"type": "constant"}})
    )
    ours = sampling.NonConstantEmitters(mi.scalar_rgb, lit)
    si = dark.ray_intersect(mi.Ray3f([0.1, 0, -2], [0, 0, 1]))
    si.p = mi.Point3f(0.1, 0.2, -1)
    for x in (0.1, 0.3, 0.6, 0.9):
        ds, radiance = ours.sample(si, mi.Point2f(x, 0.4), True)
        expected, light = dark.sample_emitter_direction(si, mi.Point2f(x, 0.4), False, True)
        assert np.allclose(ds.p, expected.p, atol=1e-5)
        assert (ds.pdf, [*radiance]) == (pytest.approx(expected.pdf), pytest.approx([*light]))
        assert ours.pdf(si, ds, True) == pytest.approx(ds.pdf) and ours.pdf(si, ds, False) == 0
    sky = lit.environment().sample_direction(si, mi.Point2f(0.1, 0.2), True)[0]
    assert sky.pdf > 0 and ours.pdf(si, sky, True) == 0


@pytest.mark.parametrize(("max_depth", "lit"), [(-1, True), (800, False), (900, True)])
def test_minus_one_is_no_limit_of_the_depth(max_depth, lit):
    """Between mirrors 1/64 apart a ray meets one at each 3/256 of its way in x: 853 until it leaves at 10."""
    mirror = {"type": "conductor", "material": "none"}
    parts = {"lower": sheet(0, bsdf=mirror), "upper": sheet(1 / 64, bsdf=mirror), "sky": {"type": "constant"}}
    parts = parts | {name: parts[name] | {"bsdf": {"type": "twosided", "a": mirror}} for name in ("lower", "upper")}
    found, _ = follow(parts, [], (0, 0, 1 / 128), max_depth=max_depth, rr_depth=10**6)
    assert found == pytest.approx(1 if lit else 0)
