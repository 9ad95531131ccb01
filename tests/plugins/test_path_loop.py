"""The path loop of `refract_path`, one path at a time, with fixed random numbers, so that the radiance is known.

The tests run in `scalar_rgb`: the loop is the same in every variant, and nothing is compiled.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import GLASS, PLACE

from mi_refract.plugins import path_loop, sampling
from mi_refract.rendering.scene_files import REPRODUCIBLE

pytestmark = pytest.mark.usefixtures("scalar_variant")

REFLECTED, TRANSMITTED, UPWARD = (0.0, 0.5), (0.999, 0.5), (0.5, 0.5)
ALBEDO, RADIANCE = 0.5, 3.0


class FixedNumbers:
    """Random numbers: at each vertex the next of `points`, whose x selects the lobe; 1/2 for all other numbers.

    `keys`: the keys of the numbers that select lobes, modulo 2³² as in compiled variants.
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
    """Return a square across the z axis, which faces upward."""
    place = PLACE().translate([x, 0, z]).rotate([1, 0, 0], turn).scale(size)
    return {"type": "rectangle", "to_world": place} | parts


def lamp(z, x=0.0):
    """Return an area light of size 1 that faces downward; its density from below is far from 0 and from infinity."""
    return sheet(z, 0.5, x, 180, emitter={"type": "area", "radiance": RADIANCE})


def wall():
    return sheet(-1, bsdf={"type": "diffuse", "reflectance": ALBEDO})


def follow(parts, numbers, o=(0, 0, 1), d=(0.6, 0, -0.8), **parameters):
    """Return the radiance and the alpha of one sample along a ray. `numbers`: a list of points, or a sampler."""
    scene, method = mi.load_dict({"type": "scene"} | parts), mi.load_dict({"type": "refract_path"} | parameters)
    features = method.path_features(method.scene_features(scene))
    numbers = FixedNumbers(*numbers) if isinstance(numbers, list) else numbers
    end = path_loop.PathLoop(mi.scalar_rgb, scene, features, numbers).run(mi.Ray3f(o, d), None, True)
    return np.array(end.result), bool(end.valid_ray)


def reflectance(cosine, k):
    """Return the unpolarised Fresnel reflectance, for an index that is `k` times smaller on the other side."""
    cos_t = math.sqrt(1 - k * k * (1 - cosine**2))
    return (((k * cosine - cos_t) / (k * cosine + cos_t)) ** 2 + ((cosine - k * cos_t) / (cosine + k * cos_t)) ** 2) / 2


# From z = 1 down to glass at z = 0, and up again: the reflected ray is at x = 2.25 for z = 2.
SLANTED = reflectance(0.8, 1 / 1.5)


def test_emission_that_a_popped_branch_hits_has_the_weight_1():
    """The other branch has ended beyond a matt wall, whose BSDF samples share their weight with emitter samples."""
    parts = {"glass": sheet(0, bsdf=GLASS), "wall": wall(), "lamp": lamp(2, 2.25)}
    radiance, _ = follow(parts, [TRANSMITTED, UPWARD], max_depth=3, split_depth=1)
    assert radiance == pytest.approx(SLANTED * RADIANCE, rel=1e-5)


@pytest.mark.parametrize(("weight", "splits"), [(0.0, True), (0.004, True), (0.007, False), (0.04, False)])
def test_a_popped_branch_splits_again_if_its_share_is_large_enough(weight, splits):
    """The branch has hit glass only, whatever the branch before it hit. It leaves the second sheet into air.

    Its share is that of the reflected light, 5 %, of which the second sheet reflects 11 %. Without a split the random
    number selects the reflection, and the lamp is not hit.
    """
    sine = 0.6 * 1.5
    beyond = lamp(3, 2.25 + sine / math.sqrt(1 - sine**2))
    parts = {"glass": sheet(0, bsdf=GLASS), "wall": wall(), "second": sheet(2, bsdf=GLASS), "lamp": beyond}
    points = [TRANSMITTED, UPWARD, REFLECTED]
    radiance, _ = follow(parts, points, max_depth=3, split_depth=2, split_weight=weight)
    assert SLANTED * reflectance(0.8, 1.5) == pytest.approx(0.0054, abs=1e-3)
    expected = splits * SLANTED * (1 - reflectance(0.8, 1.5)) * RADIANCE * 1.5**2  # n² times the radiance inside
    assert radiance == pytest.approx(expected, rel=1e-5)


def test_all_vertices_of_branches_have_different_random_numbers():
    """Four sheets of glass split the path, two on either side of the camera."""
    numbers, parts = FixedNumbers(), {f"sheet {z}": sheet(z, bsdf=GLASS) for z in range(4)}
    follow(parts, numbers, (0, 0, 1.5), split_depth=4, split_weight=1e-3, max_depth=7)
    assert len(numbers.keys) > 10
    assert len(set(numbers.keys)) == len(numbers.keys)


@pytest.mark.parametrize(("lobe", "lit"), [(REFLECTED, False), (TRANSMITTED, True)])
def test_no_path_splits_after_a_matt_wall(lobe, lit):
    """From the wall straight up to glass: only the sampled lobe is followed, and the lamp is beyond the glass."""
    parts = {"glass": sheet(0, bsdf=GLASS), "wall": wall(), "lamp": lamp(2)}
    depths = {"max_depth": 4, "split_depth": 4}
    radiance, _ = follow(parts, [UPWARD, lobe], (0, 0, -0.5), (0, 0, -1), split_weight=0.01, **depths)
    # The wall is inside the glass, where radiance is n² times that in air.
    assert radiance == pytest.approx(ALBEDO * RADIANCE * 1.5**2 if lit else 0, rel=1e-5)


def test_roulette_ignores_the_share_of_a_branch():
    """Throughput / share is 1, although the share R is 5 %: the branch survives with the probability 0.95."""
    parts = {"glass": sheet(0, bsdf=GLASS), "lamp": lamp(2, 2.25)}
    radiance, _ = follow(parts, [REFLECTED], max_depth=3, rr_depth=1, split_depth=1)
    assert radiance == pytest.approx(SLANTED * RADIANCE / 0.95, rel=1e-5)


def test_roulette_ends_a_path_whose_throughput_is_not_a_number():
    """Without an end, a render between mirrors would never return."""
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((1, 1, 3), np.nan, np.float32)), "raw": True}
    mirror = {"type": "twosided", "a": {"type": "conductor", "material": "none", "specular_reflectance": texture}}
    numbers = FixedNumbers()
    follow({str(z): sheet(z, bsdf=mirror) for z in (0, 2)}, numbers, max_depth=50, rr_depth=1)
    assert len(numbers.keys) == 1


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
def test_a_pixel_is_transparent_if_light_passes_straight_through(bsdf, point, alpha):
    assert follow({"pane": sheet(0, bsdf=bsdf)}, [point], max_depth=4)[1] == alpha


@pytest.mark.parametrize(
    ("a", "b", "weight"),
    [(3, 4, 9 / 25), (4, 3, 16 / 25), (1, 0, 1), (0, 1, 0), (0, 0, 0), (math.inf, 1, 0), (1, math.inf, 0)],
)
def test_the_power_heuristic(a, b, weight):
    """The weight of an infinite density is 0, as in Mitsuba's `path`."""
    assert path_loop.power_heuristic(float(a), float(b)) == pytest.approx(weight)


@pytest.mark.parametrize("weights", [(1.0,), (1.0, 3.0), (0.0, 2.0, 2.0)])
def test_lamps_beside_a_constant_sky_are_sampled_by_their_weights(weights):
    """As Mitsuba samples the same lamps without the sky."""
    emitters = ({"type": "area", "radiance": 1.0 + i, "sampling_weight": x} for i, x in enumerate(weights))
    lamps = {f"lamp{i}": lamp(2, 3.0 * i) | {"emitter": emitter} for i, emitter in enumerate(emitters)}
    # By default Mitsuba orders merged meshes by address: the order of lamps could differ between the scenes.
    dark, lit = (
        mi.load_dict({"type": "scene"} | lamps | sky, **REPRODUCIBLE) for sky in ({}, {"sky": {"type": "constant"}})
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
def test_a_max_depth_of_minus_one_is_no_limit(max_depth, lit):
    """Between mirrors 1/64 apart a ray hits one after each 3/256 in x: 853 mirrors until it leaves at x = 10."""
    mirror = {"type": "conductor", "material": "none"}
    parts = {"lower": sheet(0, bsdf=mirror), "upper": sheet(1 / 64, bsdf=mirror), "sky": {"type": "constant"}}
    parts = parts | {name: parts[name] | {"bsdf": {"type": "twosided", "a": mirror}} for name in ("lower", "upper")}
    radiance, _ = follow(parts, [], (0, 0, 1 / 128), max_depth=max_depth, rr_depth=10**6)
    assert radiance == pytest.approx(1 if lit else 0)


def test_a_sample_along_the_surface_has_the_weight_0_also_in_renders_that_are_differentiated(llvm_variant):
    """Its direction may be above the surface after rounding; the derivative of its cosine over it would be 10⁷."""
    random = np.random.default_rng(2041)
    si = mi.SurfaceInteraction3f()
    si.sh_frame = mi.Frame3f(mi.Normal3f(dr.normalize(mi.Vector3f(random.normal(size=(3, 1000))))))
    si.wi = mi.Vector3f(0, 0, 1)
    bsdf, context = mi.load_dict({"type": "diffuse"}), mi.BSDFContext()
    bs, weight = bsdf.sample(context, si, 0.5, mi.Point2f(0, 0.5))
    assert dr.all(bs.wo.z == 0) and dr.all(weight == 0, axis=None)
    d = si.to_world(bs.wo)
    assert dr.any(si.to_local(d).z > 0)
    weight, *_ = path_loop.at_fixed_direction(mi, context, si, bsdf, bs, weight, d, True, False, False)
    assert dr.all(weight == 0, axis=None)


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_mono_polarized"], indirect=True)
def test_a_differentiated_sample_has_the_weight_of_the_sample(variant):
    """Also as a Mueller matrix of the world's frame."""
    random = np.random.default_rng(2042)
    si = mi.SurfaceInteraction3f()
    si.sh_frame = mi.Frame3f(mi.Normal3f(dr.normalize(mi.Vector3f(random.normal(size=(3, 1000))))))
    si.wi = dr.normalize(mi.Vector3f(0.6, 0.3, 0.8))
    bsdf, context = mi.load_dict({"type": "roughconductor", "alpha": 0.3}), mi.BSDFContext()
    bs, weight = bsdf.sample(context, si, 0.5, mi.Point2f(random.random((2, 1000))))
    expected = si.to_world_mueller(weight, -bs.wo, si.wi) if "polarized" in variant else weight
    d = si.to_world(bs.wo)
    found, *_ = path_loop.at_fixed_direction(mi, context, si, bsdf, bs, expected, d, True, False, False)
    np.testing.assert_allclose(np.array(found), np.array(expected), rtol=1e-3, atol=1e-4)


def test_a_mask_of_a_mesh_attribute_within_another_bsdf_has_odds_of_its_own(llvm_variant):
    """Mitsuba says that a mesh attribute does not vary over a surface."""
    matt = {"type": "diffuse"}
    for opacity, own in (({"type": "mesh_attribute", "name": "vertex_opacity"}, True), (0.5, False)):
        mask = {"type": "mask", "opacity": opacity, "a": matt}
        assert path_loop.has_own_odds(mi.load_dict({"type": "blendbsdf", "a": mask, "b": matt, "weight": 0.5})) == own
