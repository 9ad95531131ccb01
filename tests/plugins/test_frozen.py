"""Renders within `dr.freeze`: what is replayed is what is traced anew, also after an edit.

Dr.Jit must see every array that a BSDF in memory gathers from, of other scenes as well.
"""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import BLACK, glass_ball, parameter, sky

# A parameter of each, and a value to set.
GLASSES = {
    "a number": ({"int_ior": 1.5}, "eta", 1.3),
    "a dispersive medium": ({"int_ior": "cauchy(1.5, 4000)"}, "int_ior_A", 1.3),
    "a texture": ({"int_ior": {"type": "checkerboard", "color0": 1.3, "color1": 1.6}}, "int_ior.color0.value", 1.5),
    "absorption": ({"int_ior": 1.5, "int_absorption": 0.5}, "absorption.value", 2.0),
    "a colour": ({"int_ior": 1.5, "int_colour": 0.5, "int_colour_distance": 1.0}, "colour.value", 0.9),
    "a tint": ({"int_ior": 1.5, "specular_transmittance": 0.5}, "transmittance.value", 0.9),
}


@pytest.fixture(autouse=True)
def _no_collection():
    """A scene that the garbage collector finds while Dr.Jit records ends the process, Mitsuba's own as well."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def ball(parameters, integrator, **method):
    tiles = {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([8, 4, 1])}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).scale(3)}
    wall |= {"bsdf": {"type": "diffuse", "reflectance": tiles}}
    glass = {"type": "sphere", "bsdf": {"type": "refract", "ext_ior": 1.0} | parameters}
    integrator = {"type": integrator, "rr_depth": 100} | method
    return glass_ball(integrator=integrator, sky={"type": "constant"}, wall=wall, ball=glass)


def frozen(scene):
    @dr.freeze
    def image(params, seed):
        return mi.render(scene, params, spp=4, seed=seed)

    return image


INTEGRATORS = ("path", "refract_path")
ABSORBING = ("absorption", "a colour")  # for which `path` refuses
CASES = [(glass, method) for glass in GLASSES for method in INTEGRATORS if glass not in ABSORBING or method != "path"]


@pytest.mark.parametrize(("glass", "integrator"), CASES)
def test_a_frozen_render_is_the_traced_one_and_follows_an_edit(glass, integrator, llvm_variant):
    given, name, value = GLASSES[glass]
    scene = ball(given, integrator)
    params = mi.traverse(scene)
    key = parameter(params, name)
    image, before = frozen(scene), None
    for seed in range(4):
        if seed == 2:
            params[key] = type(params[key])(value)
            params.update()
        replayed = np.array(image(params, dr.opaque(mi.UInt32, seed)))
        traced = np.array(mi.render(scene, spp=4, seed=mi.UInt32(seed)))
        assert replayed == pytest.approx(traced, abs=1e-5), seed
        assert seed != 2 or np.abs(replayed - before).max() > 0.05
        before = replayed
    assert image.n_recordings <= 3  # the third knows what varies, and the integrator what the scene needs


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("glass", GLASSES)
def test_another_scene_in_memory_does_not_hinder(glass, integrator, llvm_variant):
    other = ball(GLASSES[glass][0], "refract_path")
    scene = ball({"int_ior": 1.5}, integrator)
    params, image = mi.traverse(scene), frozen(scene)
    for seed in range(2):
        replayed = np.array(image(params, dr.opaque(mi.UInt32, seed)))
        assert replayed == pytest.approx(np.array(mi.render(scene, spp=4, seed=mi.UInt32(seed))), abs=1e-5)
    del other


@pytest.mark.parametrize("split_depth", [0, 2])
def test_a_frozen_render_follows_the_index_and_a_lamp_that_turns_grey(split_depth, llvm_variant):
    """What is recorded must hold for any value: a lamp's black surface counts as one that may reflect."""
    lamp = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).scale(9)}
    method = {"type": "refract_path", "max_depth": 5, "rr_depth": 100, "split_depth": split_depth}
    scene = glass_ball(integrator=method, sky=sky(), lamp=lamp | {"emitter": {"type": "area"}, "bsdf": BLACK})
    params, before, image = mi.traverse(scene), None, frozen(scene)
    for name, value in ((".eta", 1.5), (".eta", 1.3), ("reflectance.value", 0.8), (".eta", 1.7)):
        key = parameter(params, name)
        params[key] = type(params[key])(value)
        params.update()
        means = [np.array(image(params, dr.opaque(mi.UInt32, seed))).mean() for seed in range(4)]
        # Without the recording a black lamp needs no emitter sample: other numbers, the same mean.
        traced = [np.array(mi.render(scene, spp=4, seed=seed)).mean() for seed in range(4)]
        assert np.mean(means) == pytest.approx(np.mean(traced), rel=0.01)
        assert before is None or abs(np.mean(means) / before - 1) > 0.002
        before = np.mean(means)
    assert image.n_recordings <= 2
