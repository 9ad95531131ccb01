"""`refract_path` renders what `path` does, in every variant, with less; it splits without bias and differentiates."""

import dataclasses
import functools
import gc
import math
import signal
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.stats import chi2_contingency
from support.glass_scenes import BLACK, GLASS, PLACE, SKY, camera, equal_means, glass_ball, parameter, refusal, render

from mi_refract.image_diff import pixelwise, tile_statistics
from mi_refract.numerics import mitsuba_mesh
from mi_refract.plugins import path_loop, refract_path, sampling, scene_features
from mi_refract.rendering import scene_files
from validation.run.context import SCENES

LIT = {"type": "envmap", "bitmap": mi.Bitmap(SKY)}


def load(name, resolution=32, **parameters):
    return mi.load_file(str(SCENES / f"{name}.xml"), **scene_files.REPRODUCIBLE, res=resolution, **parameters)


def by_path(scene, spp=16, seed=0, **parameters):
    return render(scene, spp, seed, **parameters, type="path")


# The same image ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "parameters"), [("sphere", {}), ("nested", {"max_depth": 6, "rr_depth": 1})])
def test_where_nothing_is_left_out_numbers_and_image_are_those_of_path(name, parameters, each_variant, monkeypatch):
    """With Russian roulette and emitter sampling both integrators draw the same numbers in the same order."""
    if name == "nested" and not each_variant.endswith("rgb"):
        pytest.skip("RGB variants stand for the others")

    def everything(scene, sensor):
        changed = {"both_numbers": True, "plain_environment": False, "delta_extent": math.inf}
        return dataclasses.replace(scene_features.inspect(scene), **changed)

    monkeypatch.setattr(refract_path, "inspect", everything)
    vectorised = dr.is_jit_v(mi.Float)
    scene, spp = load(name, 24 if vectorised else 4), 16 if vectorised else 2
    ours, theirs = render(scene, spp, **parameters), by_path(scene, spp, **parameters)
    assert theirs.std() > 0
    assert pixelwise.changes(theirs, ours, 1e-4).share <= 1e-3


TILT = np.array([0.5 + 0.5 * np.sin(np.radians(20)), 0.5, 0.5 + 0.5 * np.cos(np.radians(20))])
NORMAL_MAP = {"type": "bitmap", "bitmap": mi.Bitmap(TILT.reshape(1, 1, 3).astype(np.float32)), "raw": True}
STEPS = {"type": "bitmap", "bitmap": mi.Bitmap(np.linspace(0, 1, 16, dtype=np.float32).reshape(4, 4, 1)), "raw": True}
WRAPPED = {  # where a wrapper chooses between two glasses, or refuses a lobe
    "two glasses": {"type": "blendbsdf", "weight": 0.3, "a": GLASS, "b": GLASS | {"int_ior": 1.8}},
    "glass and mirror": {"type": "blendbsdf", "weight": 0.3, "a": GLASS, "b": {"type": "conductor"}},
    "normal map": {"type": "normalmap", "normalmap": NORMAL_MAP, "b": GLASS},
    "normal map of dielectric": {"type": "normalmap", "normalmap": NORMAL_MAP, "b": {"type": "dielectric"}},
    "bump map": {"type": "bumpmap", "arbitrary": STEPS, "scale": 20.0, "b": GLASS},
    "mask": {"type": "mask", "opacity": 0.5, "b": GLASS},
}
FOLLOWED = [(name, {}) for name in ("balls", "slab", "sphere", "nested")]
FOLLOWED += [(name, {"split_depth": 1}) for name in ("balls", "sphere")]
FOLLOWED += [(name, {"split_depth": 4, "rr_depth": 3}) for name in ("slab", "lightpipe", "nested")]
FOLLOWED += [(name, x) for name in ("sphere", "slab") for x in ({"hide_emitters": True}, {"max_depth": 1})]
FOLLOWED += [(name, {"split_depth": depth, "rr_depth": 100}) for name in WRAPPED for depth in (0, 3)]

SPP = 16, 64  # the latter in a wrapper


def made(name):  # not kept: Mitsuba traces calls of every texture that is alive
    if name not in WRAPPED:
        return load(name)
    oblique = PLACE().rotate([0, 1, 0], 70).scale(9)  # the camera sees the sheet from 20° above it
    return glass_ball(sky=LIT, ball={"type": "rectangle", "to_world": oblique, "bsdf": WRAPPED[name]})


@functools.cache
def stack_of_path(name, parameters):
    scene = made(name)
    return np.stack([by_path(scene, SPP[name in WRAPPED], seed, **dict(parameters)) for seed in range(8)])


@pytest.mark.parametrize(("name", "parameters"), FOLLOWED, ids=str)
def test_other_numbers_give_the_same_mean(name, parameters, llvm_variant):
    """Welch's test on tiles, one false alarm in 1000 images; and of the whole, one in 10,000."""
    theirs = stack_of_path(name, tuple(x for x in parameters.items() if x[0] != "split_depth"))
    scene = made(name)
    ours = np.stack([render(scene, SPP[name in WRAPPED], 100 + seed, **parameters) for seed in range(8)])
    assert tile_statistics.compare_stacks(theirs, ours, 8, 1e-3, 1e-5).alarms == 0
    assert equal_means(theirs, ours)


@pytest.mark.parametrize("light", [LIT, {"type": "directional", "direction": [0.1, 0, -1]}], ids=lambda x: x["type"])
@pytest.mark.parametrize("change", ["merged", "moved"])
def test_shadows_of_surfaces_that_mitsubas_bounds_leave_out(light, change, rgb_variant):
    """A wide lid above the camera takes all light, though Mitsuba's shadow rays end below it."""
    far, near = PLACE().translate([0, 0, 50]).scale(1e5), PLACE().translate([0, 9, 0]).scale(0.1)
    sheet, matt = {"type": "rectangle", "bsdf": {"type": "ref", "id": "matt"}}, {"type": "diffuse", "id": "matt"}
    floor, lid = (sheet | {"to_world": x} for x in (PLACE().scale(3), far if change == "merged" else near))
    parts = {"sensor": camera(8), "matt": matt, "light": light, "floor": floor, "lid": lid}
    scene = mi.load_dict({"type": "scene"} | parts, optimize=change == "merged")
    assert len(scene.shapes()) == (1 if change == "merged" else 2)
    if change == "moved":
        assert render(scene).mean() > 0.05
        params = mi.traverse(scene)
        params["lid.to_world"] = mi.Transform4f(far)
        params.update()
    assert by_path(scene).mean() > 0.05 > 1e3 * render(scene).mean()


def lamps():
    """A wall in a constant sky and three lamps before it, one of them small and bright, one that has no surface."""
    parts = {
        "wall": {"type": "rectangle", "to_world": PLACE().translate([0, 0, -2]).scale(4)},
        "sky": {"type": "constant", "radiance": 0.2},
        "spot": {"type": "point", "position": [0, 3, 2], "intensity": 4.0},
    }
    for i, (x, size, radiance) in enumerate([(-1.5, 0.6, 3.0), (1.5, 0.1, 40.0)]):
        emitter = {"type": "area", "radiance": radiance, "sampling_weight": 1.0 + i}
        where = PLACE().translate([x, 2, 1]).rotate([0, 1, 0], 180).scale(size)
        parts[f"lamp {i}"] = {"type": "rectangle", "to_world": where, "emitter": emitter}
    return parts


@pytest.mark.parametrize("shape", ["sphere", "rectangle"])
def test_hidden_lamps_in_a_row_are_looked_past(shape, rgb_variant):
    """A closed lamp has two surfaces. Equal means, one false alarm in 10,000."""
    glow = {"type": shape, "emitter": {"type": "area", "radiance": 9.0}}
    parts = {f"lamp {z}": glow | {"to_world": PLACE().translate([0, 0, z]).scale(0.6)} for z in (1, 3)}
    wall = {"type": "rectangle", "to_world": PLACE().translate([0, 0, -2]).scale(4)}
    bulb = {"type": "point", "position": [3, 0, 0], "intensity": 9.0}
    scene = mi.load_dict({"type": "scene", "sensor": camera(4, 12), "wall": wall, "bulb": bulb} | parts)
    ways = (by_path, 0), (render, 100)
    theirs, ours = ([f(scene, 16, first + i, max_depth=2, hide_emitters=True) for i in range(8)] for f, first in ways)
    assert np.mean(theirs) > 0.05 and equal_means(theirs, ours)


@pytest.mark.parametrize("split_depth", [0, 2])
def test_lamps_are_chosen_by_their_weights_and_the_sky_is_met(split_depth, typical_variant):
    """Welch's test on one tile, one false alarm in 1000."""
    vectorised = dr.is_jit_v(mi.Float)
    scene, spp = glass_ball(24 if vectorised else 4, **lamps()), 64 if vectorised else 8
    theirs = np.stack([by_path(scene, spp, i) for i in range(8)])
    ours = np.stack([render(scene, spp, 100 + i, split_depth=split_depth, caustics="path") for i in range(8)])
    assert tile_statistics.compare_stacks(theirs, ours, theirs.shape[1], 1e-3, 1e-5).alarms == 0


def test_nothing_to_see_is_black(rgb_variant):
    for parts in ({}, {"ball": {"type": "sphere"}}, {"ball": {"type": "sphere", "bsdf": {"type": "refract"}}}):
        scene = mi.load_dict({"type": "scene", "sensor": camera(4)} | parts)
        for parameters in ({}, {"split_depth": 2, "max_depth": -1}):
            assert (render(scene, 2, **parameters) == 0).all()
    assert (render(glass_ball(sky=LIT), 2, max_depth=0) == 0).all()


def fans(to_world, corners=2048):
    """A disk of glass whose faces are a thousand times as long as they are high."""
    angle, number = 2 * np.pi * np.arange(corners) / corners, np.arange(corners)
    ring = np.c_[np.cos(angle), np.sin(angle)]
    vertices = np.r_[np.c_[ring, 0 * angle - 0.5], np.c_[ring, 0 * angle + 0.5]]
    first, i, j = 0 * number, number, (number + 1) % corners
    faces = np.r_[np.c_[first, j, i], np.c_[first, i, j] + corners, np.c_[i, j, j + corners]]
    faces = np.r_[faces, np.c_[i, j + corners, i + corners]]
    matrix, glass = np.array(to_world.matrix), mi.Properties()
    glass["bsdf"] = mi.load_dict(GLASS)
    return mitsuba_mesh.make(mi, vertices @ matrix[:3, :3].T + matrix[:3, 3], faces, properties=glass)


WHITE_FLOOR = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": 1.0}}


@pytest.mark.parametrize(
    ("shape", "scale", "place", "far"),
    [
        ("cube", (1, 1, 5e-5), (0, 0, 0), 4),
        ("cube", (1, 1, 5e-4), (12, 0, 0), 4),
        ("cube", (1, 1, 2e-3), (100, 30, 5), 4),
        ("cube", (1, 1, 1), (0, 0, 1000), 4),
        ("cube", (1000, 1000, 1000), (1, 2, 3), 4),
        ("sphere", (1e-4, 1e-4, 1e-4), (0, 0, 0), 4),
        ("sphere", (1000, 1000, 1000), (0, 0, 1000), 4),
        ("cube", (1, 1, 1), (0, 0, 0), 2000),
        ("sphere", (1, 1, 1), (0, 0, 0), 300),
        ("sphere", (1, 1, 1), (0, 0, 0), 2000),
        ("cube", (1, 1, 3e-4), (0, 0, 0), 1000),
        ("fans", (1, 1, 1), (0, 0, 0), 4),
    ],
)
@pytest.mark.parametrize("floor", [False, True])
def test_glass_in_even_light_is_invisible_however_thin_and_far(shape, scale, place, far, floor, rgb_variant):
    """Each boundary is met once: a ray that steps over one, or meets it again, carries 1.5² times too much or less.

    `far`: distance of the camera, in sizes of the shape.
    """
    at = PLACE().translate([*place]).rotate([0.48, 0.6, 0.64], 40)
    to_world = at.scale([*scale])
    glass = fans(to_world) if shape == "fans" else {"type": shape, "to_world": to_world, "bsdf": GLASS}
    parts = {"glass": glass, "sky": {"type": "constant"}}
    size = max(scale)
    if floor:
        parts["floor"] = WHITE_FLOOR | {"to_world": at.translate([0, 0, -4 * size]).scale(20 * size)}
    origin = at @ mi.ScalarPoint3f(0.3 * size, 0.2 * size, far * size)
    eye = camera(16, origin=origin, target=place, fov=math.degrees(2 * math.atan(1 / far)))
    count = 16 if dr.is_jit_v(mi.Float) else 1
    image = render(mi.load_dict({"type": "scene", "sensor": eye} | parts), count, max_depth=-1, rr_depth=1000)
    assert image == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("gap", [0, 1e-5, 1e-4])
def test_glass_just_above_a_floor_is_invisible(gap, rgb_variant):
    """A ray from the floor starts below the glass: one that starts within it carries 1.5² times too much."""
    cube = {"type": "cube", "to_world": PLACE().translate([0, 0, 1 + gap]), "bsdf": GLASS}
    parts = {"glass": cube, "floor": WHITE_FLOOR | {"to_world": PLACE().scale(2)}, "sky": {"type": "constant"}}
    scene = mi.load_dict({"type": "scene", "sensor": camera(16, origin=(1.5, -1, 6), target=(0, 0, 1))} | parts)
    image = render(scene, 16 if dr.is_jit_v(mi.Float) else 1, max_depth=-1, rr_depth=1000)
    assert image == pytest.approx(1, abs=1e-3)


def test_a_lamp_lights_a_floor_once_through_glass_just_above_it(llvm_variant):
    """Pane of 4 mm at 100 m: a shadow ray that starts beyond it finds the lamp, and so does the path through it.

    Light is doubled then. The standard errors of both images are below 3 %.
    """
    at = PLACE().translate([100, 0, 0])
    parts = {
        "sensor": camera(16, origin=(101.2, -1.2, 1), target=(100, 0, 0), fov=10),
        "floor": WHITE_FLOOR | {"to_world": at.scale(0.5)},
        "pane": {"type": "cube", "to_world": at.translate([0, 0, 0.004]).scale([0.6, 0.6, 0.002]), "bsdf": GLASS},
    }
    lamp = {"type": "rectangle", "to_world": at.translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(0.4)}

    def mean(sampling_weight):
        emitter = {"type": "area", "radiance": 10.0, "sampling_weight": sampling_weight}
        scene = {"type": "scene", "sky": {"type": "constant", "radiance": 1e-6}, "lamp": lamp | {"emitter": emitter}}
        return render(mi.load_dict(scene | parts), 256, max_depth=16).mean()

    assert mean(1.0) == pytest.approx(mean(0.0), rel=0.2)


# Splitting -----------------------------------------------------------------------------------------------------


def test_splitting_takes_noise_away_and_scalars_do_it_too(rgb_variant):
    scene, spp = (load("balls", 16), 16) if dr.is_jit_v(mi.Float) else (load("balls", 6), 4)
    one, split = (np.var([render(scene, spp, seed, split_depth=x) for seed in range(4)], axis=0).mean() for x in (0, 3))
    assert split < 0.8 * one


def multijitter(pixels):
    """12 samples a pixel; numbers of one dimension and of two by key, pixel by pixel."""
    sampler = mi.load_dict({"type": "independent", "sample_count": 12})
    sampler.seed(3, 12 * pixels)
    numbers = sampling.KeyedMultijitter(mi, sampling.seeds_of(mi, sampler), 12 * pixels, 12)

    def one(key):
        return np.array(numbers.next_1d(sampler, mi.UInt32(key))).reshape(pixels, 12)

    def two(key):
        return np.array(numbers.next_2d(sampler, mi.UInt32(key))).reshape(2, pixels, 12)

    return one, two


def test_strata_are_those_of_correlated_multi_jitter(llvm_variant):
    """Every stratum holds one sample, of rows, columns and cells; a number depends on its key alone.

    Of 3 rows all 6 orders, of 4 columns the 8 that Kensler's function has, one independent of the other (chi-square,
    one false alarm in 10,000 keys).
    """
    one, two = multijitter(400)
    seen = []
    for key in (8, 9):
        x, y = two(key)
        for strata_of in (one(7), x, y):
            assert (np.sort(np.floor(strata_of * 12), axis=1) == np.arange(12)).all()
        column, row = np.floor(x * 4).astype(int), np.floor(y * 3).astype(int)
        assert (np.sort(column * 3 + row, axis=1) == np.arange(12)).all()
        inner_row, inner_column = np.floor(x * 12).astype(int) % 3, np.floor(y * 12).astype(int) % 4
        orders = [
            [tuple(inner[p, np.unique(outer[p], return_index=True)[1]].tolist()) for p in range(400)]
            for inner, outer in ((inner_row, row), (inner_column, column))
        ]
        assert [len(set(order)) for order in orders] == [6, 8]
        numbers = [np.unique(order, axis=0, return_inverse=True)[1].ravel() for order in orders]
        assert chi2_contingency(np.histogram2d(*numbers, bins=(6, 8))[0]).pvalue > 1e-4
        seen.append(orders)
    assert all(first != second for first, second in zip(*seen, strict=True))
    assert (np.argsort(one(7), axis=1) != np.argsort(one(9), axis=1)).any(axis=1).all()
    assert (np.argsort(one(7)[0]) != np.argsort(one(7)[1])).any()
    assert (one(7) == one(7)).all()  # whatever was drawn before


def test_a_deterministic_image_errs_by_what_it_says_was_truncated(llvm_variant):
    """The ball from one point: no noise but the position in the pixel, which is its centre in every sample."""
    sensor = camera() | {"sampler": {"type": "multijitter", "jitter": False}}
    scene = glass_ball(sky=LIT, sensor=sensor)
    exact, coarse = (render(scene, 1, deterministic=True, split_weight=w, max_depth=64) for w in (2.5e-4, 0.05))
    assert exact.shape == (24, 24, 4)
    bound = coarse[..., 3:] * SKY.max()
    off = np.abs(coarse - exact)[..., :3]
    assert (off <= bound + exact[..., 3:] * SKY.max() + 1e-5).all()
    assert coarse[..., 3].max() > 10 * exact[..., 3].max() > 0
    assert off.max() > 1e-3
    assert exact[..., 3].max() < 0.01


def test_what_is_truncated_bounds_what_a_tilted_plate_loses(typical_variant):
    """At 60° a boundary reflects s-polarised light almost twice as well as the mean of both polarisations."""
    tilted = mi.ScalarTransform4f().rotate([1, 0, 0], 60).scale([1e3, 1e3, 1])
    plate = {"type": "cube", "to_world": tilted, "bsdf": {"type": "refract", "int_ior": 1.52}}
    parts = {"sensor": camera(1, fov=0.01), "plate": plate, "sky": {"type": "constant"}}
    scene = mi.load_dict({"type": "scene"} | parts)
    exact, coarse = (render(scene, 1, deterministic=True, split_weight=w, max_depth=64) for w in (1 / 4096, 0.01))
    lost = (exact - coarse)[..., 0].item()
    assert 0.005 < lost <= coarse[..., -1].item() + 1e-6


BLEND = {"type": "blendbsdf", "weight": 0.5, "a": {"type": "refract"}, "b": {"type": "conductor"}}


@pytest.mark.parametrize(
    ("other", "kind"),
    [
        ({"bsdf": {"type": "diffuse"}}, "SmoothDiffuse"),
        ({"bsdf": {"type": "thindielectric"}}, "ThinDielectric"),
        ({"bsdf": BLEND}, "BlendBSDF"),
        ({"type": "instance", "group": {"type": "ref", "id": "group"}}, "Instance"),
    ],
)
def test_what_would_be_left_to_chance_is_refused_by_name(other, kind, llvm_variant):
    group = {"type": "shapegroup", "id": "group", "ball": {"type": "sphere", "bsdf": BLACK}}
    scene = glass_ball(sky=LIT, group=group, other={"type": "sphere"} | other)
    text = f"refract_path: deterministic = true: {kind} at 'other'; expected only smooth dielectrics and conductors"
    assert refusal(render, scene, 1, deterministic=True) == text


def test_in_a_frozen_function_no_diffuse_counts_as_black(llvm_variant, no_collection):
    """So an area lamp needs another BSDF there; Mitsuba gives it a black diffuse."""
    method, behind = mi.load_dict({"type": "refract_path", "deterministic": True}), PLACE().translate([0, 0, -2])

    def image(**parts):
        lamp = {"type": "rectangle", "to_world": behind, "emitter": {"type": "area"}} | parts
        scene = glass_ball(lamp=lamp)
        frozen = dr.freeze(lambda seed: mi.render(scene, integrator=method, spp=1, seed=seed))
        return np.array(frozen(dr.opaque(mi.UInt32, 1)))

    assert image(bsdf={"type": "conductor", "specular_reflectance": 0.0}).any()
    text = "SmoothDiffuse at 'lamp' in a frozen function, where no diffuse counts as black; expected only smooth"
    assert text in refusal(image)
    assert "RoughConductor at 'lamp'; expected only smooth" in refusal(image, bsdf={"type": "roughconductor"})


def test_what_no_instance_shows_is_not_left_to_chance(llvm_variant):
    group = {"type": "shapegroup", "matt": {"type": "sphere"}}
    with_group, without = (render(glass_ball(sky=LIT, **parts), deterministic=True) for parts in ({"g": group}, {}))
    np.testing.assert_array_equal(with_group, without)


# What is left out, and what is refused -------------------------------------------------------------------------


def operations(scene, **method):
    method = mi.load_dict({"type": "refract_path", "max_depth": 16, "rr_depth": 16} | method)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(mi.render(scene, integrator=method, spp=4))
        return max(entry.get("operation_count", 0) for entry in dr.kernel_history()), str(method)


def test_what_is_left_out_is_not_in_the_kernel_and_is_said(llvm_variant, monkeypatch):
    gc.collect()  # Dr.Jit compiles whatever BSDF is alive: differences are compared, not counts
    scene = load("balls")
    (lean, said), (theirs, _) = operations(scene), operations(scene, type="path")
    assert "emitter sampling (every BSDF has delta lobes only)" in said
    assert theirs - lean > 250
    full = dataclasses.replace(scene_features.inspect(scene), smooth=True)
    monkeypatch.setattr(refract_path, "inspect", lambda scene, sensor: full)
    assert operations(scene)[0] > lean + 0.6 * (theirs - lean)


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"max_depth": -2}, "max_depth = -2; expected -1 (no limit) or an integer ≥ 0"),
        ({"max_depth": 2.5}, "max_depth = 2.5"),
        ({"max_depth": True}, "max_depth = True"),
        ({"max_depth": "deep"}, "max_depth = 'deep'"),
        ({"rr_depth": 0}, "rr_depth = 0; expected an integer ≥ 1"),
        ({"samples_per_pass": 0}, "samples_per_pass = 0; expected an integer ≥ 1"),
        ({"split_depth": -1}, "split_depth = -1; expected an integer ≥ 0"),
        ({"split_depth": 13, "split_weight": 0.0}, "split into 8.19e+03 paths; expected 2^split_depth or "),
        ({"split_depth": 65}, "and split_depth up to 64"),
        ({"split_weight": 1.5}, "split_weight = 1.5; expected a number from 0 to 1"),
        ({"split_weight": float("nan")}, "split_weight = nan"),
        ({"split_weight": True}, "split_weight = True"),
        ({"split_weight": "half"}, "split_weight = 'half'"),
        ({"deterministic": 1}, "deterministic = 1; expected true or false"),
        ({"max_dept": 3}, "unreferenced"),
    ],
    ids=str,
)
def test_what_cannot_be_is_refused_in_one_line(parameters, said, rgb_variant):
    assert said in refusal(mi.load_dict, {"type": "refract_path"} | parameters)


def test_parameters_and_their_defaults_are_written_out(scalar_variant):
    names = ("max_depth", "rr_depth", "hide_emitters", "split_depth", "split_weight", "deterministic")
    names += ("caustics", "light_paths")
    plain = "auto", 0.25
    for parameters, values in (
        ({}, (-1, 5, False, 0, 0.01, False, *plain)),
        (
            {"max_depth": 7, "rr_depth": 3, "hide_emitters": True, "split_depth": 2},
            (7, 3, True, 2, 0.01, False, *plain),
        ),
        ({"max_depth": 0, "deterministic": True}, (0, 5, False, 64, 0.001, True, *plain)),
        ({"split_depth": 12, "split_weight": 0.0}, (-1, 5, False, 12, 0.0, False, *plain)),
        ({"split_depth": 64, "split_weight": 1 / 4096}, (-1, 5, False, 64, 1 / 4096, False, *plain)),
        ({"caustics": "lamp", "light_paths": 2}, (-1, 5, False, 0, 0.01, False, "lamp", 2.0)),
    ):
        lines = [f"  {name} = {value}," for name, value in zip(names, values, strict=True)]
        said = str(mi.load_dict({"type": "refract_path"} | parameters))
        assert said.splitlines() == ["RefractPath[", *lines, "  left out = no scene seen yet,", "]"]


def test_samples_of_a_scalar_render_share_their_loop(scalar_variant, monkeypatch):
    """Making it takes half of the time of a sample. Each block is rendered by a thread of its own."""
    made, start = [], path_loop.PathLoop.__init__
    monkeypatch.setattr(path_loop.PathLoop, "__init__", lambda self, *more: made.append(self) or start(self, *more))
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads interrupt each other as often as possible
    try:
        for count in range(1, 21):
            render(glass_ball(8, sky=LIT), 1, split_depth=1, block_size=2)
            assert len(made) == count
    finally:
        sys.setswitchinterval(interval)
    assert made[0].branch is made[1].branch  # making a class takes ten times as long as a sample


def test_a_scalar_render_of_another_scene_meanwhile_has_a_loop_of_its_own(scalar_variant):
    """As two threads do with one integrator: their samples alternate."""
    method, sampler = mi.load_dict({"type": "refract_path"}), mi.load_dict({"type": "independent"})
    scenes = [mi.load_dict({"type": "scene", "sky": {"type": "constant", "radiance": x}}) for x in (1.0, 2.0, 1.0)]
    method.begin_render(mi.load_dict({"type": "perspective"}))
    seen = [method.sample(scene, sampler, mi.Ray3f([0, 0, 0], [0, 0, 1]))[0][0] for scene in scenes]
    assert seen == [1, 2, 1]


# Where flags, tangents and seeds were taken for granted ---------------------------------------------------------

POLARIZER = {"type": "polarizer", "theta": 20.0}
MAPPED = {"type": "normalmap", "normalmap": NORMAL_MAP, "b": {"type": "conductor"}}


@pytest.mark.parametrize(
    ("variant", "shape", "bsdf"),
    [
        ("llvm_ad_rgb", "disk", MAPPED),
        ("llvm_ad_rgb", "sphere", MAPPED),
        ("llvm_ad_spectral_polarized", "disk", POLARIZER),
        ("llvm_ad_spectral_polarized", "cube", POLARIZER),
    ],
    indirect=["variant"],
)
def test_what_needs_a_tangent_has_it_in_a_scene_of_glass_only(variant, shape, bsdf):
    """A matt ball out of sight changes nothing: with it a hit has all its parts."""
    second = {"type": "sphere", "center": [0, 0, -3], "bsdf": GLASS}
    if bsdf is POLARIZER:  # light that is polarised by another one behind it
        behind = PLACE().translate([0, 0, -3]).scale(3)
        second = {"type": "rectangle", "to_world": behind, "bsdf": POLARIZER | {"theta": 70.0}}
    front = {"type": "sphere", "center": [0, 0, 2], "radius": 0.8, "bsdf": GLASS | {"int_ior": 1.01}}
    far = {"far": {"type": "sphere", "center": [0, 0, 90], "bsdf": {"type": "diffuse"}}}
    part = {"type": shape, "to_world": PLACE().rotate([1, 2, 0], 30), "bsdf": bsdf}
    parts = {"ball": part, "front": front, "second": second, "sky": LIT}
    alone, beside = ([render(glass_ball(**parts, **x), 64, seed) for seed in range(6)] for x in ({}, far))
    assert equal_means(beside, alone)


AROUND = {"moment": {"type": "moment"}, "aov": {"type": "aov", "aovs": "d:depth"}, "alone": {}}


def within(around, **parameters):
    """`refract_path`, called by another integrator or not."""
    inner = {"type": "refract_path"} | parameters
    return mi.load_dict(AROUND[around] | {"inner": inner} if AROUND[around] else inner)


@pytest.mark.parametrize(("sampler", "split_depth"), [("independent", 1), ("multijitter", 0)])
@pytest.mark.parametrize("around", AROUND)
def test_other_seeds_have_other_numbers_whatever_calls(around, sampler, split_depth, llvm_variant):
    """The mean of 16 images has 1/16 of the squared error of one; numbers that repeat leave most of it."""
    scene, method = load("balls", 24, sampler=sampler), within(around, max_depth=8, split_depth=split_depth)
    images = np.array([np.array(mi.render(scene, integrator=method, spp=4, seed=s))[..., :3] for s in range(16)])
    whole = np.mean([render(scene, 1024, 100 + seed, max_depth=8, split_depth=1) for seed in range(2)], axis=0)
    assert np.square(images.mean(axis=0) - whole).mean() < np.square(images - whole).mean() / 8


def test_light_paths_lie_in_all_strata_whatever_the_seed_is(llvm_variant):
    """One of 10⁶ keys has a permutation whose seed is near 2³²; 1000 intervals hold 100 numbers each, within rounding.

    Mitsuba adds the seed to the index, modulo 2³²: a third of the intervals might be empty.
    """
    count = 100_003  # no power of two
    numbers = sampling.KeyedMultijitter(mi, mi.UInt32(5), count, count)
    hashes = np.array(sampling.mixed(numbers.pixel[0] + dr.arange(mi.UInt32, 10**6) * sampling.GOLDEN))
    key = int(hashes.argmax())
    assert hashes[key] > 2**32 - count / 2
    held = np.bincount((np.array(numbers.next_1d(None, key), float) * 1000).astype(int), minlength=1000)
    assert np.abs(held - count / 1000).max() < 3


@pytest.mark.parametrize("sampler", ["independent", "multijitter", "ldsampler"])
def test_every_pass_has_a_seed_also_of_samplers_with_seeds_of_their_own(sampler, llvm_variant):
    samplers = [mi.load_dict({"type": sampler, "seed": own}) for own in range(3)]
    seeds = [sampling.seed_of_pass(mi, own, seed, p)[0] for own in samplers for seed in range(8) for p in range(8)]
    assert len(set(seeds)) == 3 * 8 * 8


@pytest.mark.parametrize(("sampler", "split_depth"), [("independent", 1), ("multijitter", 0)])
def test_passes_of_the_film_have_other_numbers(sampler, split_depth, llvm_variant):
    """64 samples in passes have the noise of 64 at once within a factor of 4; 16 passes that repeat have 7 times."""
    scene, passes = load("balls", 24, sampler=sampler), ({}, {"samples_per_pass": 4}, {"samples_per_pass": 16})
    once, *others = (
        np.var([render(scene, 64, seed, split_depth=split_depth, max_depth=8, **x) for seed in range(6)], axis=0).mean()
        for x in passes
    )
    assert max(others) < 4 * once


@pytest.mark.parametrize(("sampler", "split_depth"), [("independent", 1), ("multijitter", 0)])
def test_other_seeds_need_no_other_kernels(sampler, split_depth, llvm_variant):
    scene, kernels = load("balls", 8, sampler=sampler), []
    for seed in (10, 11, 12):  # the first render prepares the sky
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            render(scene, 4, seed, split_depth=split_depth)
            kernels.append([kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])])
    assert kernels[1] == kernels[2] != []


@pytest.mark.parametrize("around", AROUND)
def test_an_interruption_after_a_render_is_one(around, llvm_variant):
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        mi.render(load("balls", 8), integrator=within(around), spp=1)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, former)


@pytest.mark.parametrize("around", AROUND)
def test_an_edit_is_seen_whatever_calls(around, llvm_variant):
    """A black floor that turns grey."""
    floor = {"type": "rectangle", "to_world": PLACE().translate([0, 0, -2]).scale(9), "bsdf": BLACK}
    scene = glass_ball(floor=floor, spot={"type": "point", "position": [0, 4, 4], "intensity": 30.0})
    method, params, means = within(around, max_depth=5, caustics="path"), mi.traverse(scene), []
    for grey in (0.0, 0.5):
        params[parameter(params, "reflectance.value")] = grey
        params.update()
        means.append(np.array(mi.render(scene, integrator=method, spp=16))[..., :3].mean())
    assert means == [0, pytest.approx(by_path(scene, 64, max_depth=5).mean(), rel=0.05)]


@pytest.mark.parametrize(
    "bsdf", [{"type": "mask", "opacity": 0.2, "b": {"type": "diffuse"}}, {"type": "null"}], ids=str
)
def test_at_the_last_vertex_what_is_transparent_is_so(bsdf, rgb_variant):
    """Alpha with a `max_depth` of 1 is the opacity: 16 σ of the samples."""
    vectorised = dr.is_jit_v(mi.Float)
    sheet = {"type": "rectangle", "to_world": PLACE().scale(9), "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "sensor": camera(8, pixel_format="rgba"), "sheet": sheet})
    spp = 64 if vectorised else 8
    alpha = render(scene, spp, max_depth=1, hide_emitters=True)[..., 3].mean()
    opacity = bsdf.get("opacity", 0.0)
    assert alpha == pytest.approx(opacity, abs=16 * np.sqrt(opacity * (1 - opacity) / 64 / spp))


@pytest.mark.parametrize("shape", ["rectangle", "cube"])
def test_hidden_lamps_do_not_hide_a_wall_4_mm_behind_them(shape, rgb_variant):
    """At 100 m Mitsuba's distance is 9 mm."""
    place = PLACE().translate([0, 0, 100])
    lamp = {"type": shape, "to_world": place @ PLACE().scale(0.5), "emitter": {"type": "area"}}
    behind = place @ PLACE().translate([0, 0, -0.004 - (0.5 if shape == "cube" else 0)])
    wall = {"type": "rectangle", "to_world": behind, "bsdf": {"type": "diffuse"}}
    view = camera(8, pixel_format="rgba", origin=(0, 0, 104), target=(0, 0, 100), fov=10)
    scene = mi.load_dict({"type": "scene", "sensor": view, "lamp": lamp, "wall": wall})
    assert (render(scene, 4, hide_emitters=True)[..., 3] == 1).all()


ROUGH = {  # rough metal is in the study `gradients`
    "rough glass": ({"type": "roughdielectric", "alpha": 0.3}, "alpha.value", 0.3),
    "grey": ({"type": "diffuse", "reflectance": 0.0}, "reflectance.value", 0.0),
}


@pytest.mark.parametrize("name", ROUGH)
def test_derivatives_off_the_glass_are_those_of_finite_differences(name, llvm_variant):
    """A sheet between two lamps with edges, in a patchy sky; 8 seeds, t-test, one false alarm in 10,000 a case."""
    bsdf, end, value = ROUGH[name]
    sheet = {"type": "rectangle", "to_world": PLACE().rotate([1, 0, 0], -30).scale(3), "bsdf": bsdf}
    light = {"type": "rectangle", "emitter": {"type": "area", "radiance": 1.0}}
    places = [0, 3.5, 2], [0, 0.5, -4]
    above, below = (light | {"to_world": PLACE().look_at(x, [0, 0, 0], [1, 0, 0]).scale(0.8)} for x in places)
    patches = np.random.default_rng(0).random((8, 16, 1)).astype(np.float32) * np.ones(3, np.float32)
    patchy = {"type": "envmap", "bitmap": mi.Bitmap(patches)}  # what a direction meets depends on it
    scene = glass_ball(16, ball=sheet, above=above, below=below, sky=patchy)
    params, step, gradients, expected = mi.traverse(scene), 0.02, [], []
    key = f"ball.bsdf.{end}"
    kind = type(params[key])

    def mean(x, spp, seed):
        params[key] = x
        params.update()
        method = mi.load_dict({"type": "refract_path", "max_depth": 4, "rr_depth": 100})
        return dr.mean(mi.render(scene, params, integrator=method, spp=spp, seed=seed), axis=None)

    for seed in range(8):
        ends = [float(mean(kind(x), 1024, seed).array[0]) for x in (value - step * (value > 0), value + step)]
        expected.append((ends[1] - ends[0]) / (step * (1 + (value > 0))))
        x = kind(value)
        dr.enable_grad(x)
        dr.backward(mean(x, 256, 50 + seed))
        gradients.append(dr.mean(dr.grad(x), axis=None))
    assert abs(np.mean(expected)) > 1e-3
    assert equal_means(expected, np.array(gradients).ravel())
