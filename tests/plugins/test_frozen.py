"""Renders within `dr.freeze`: what is replayed is what is traced anew, also after an edit.

Dr.Jit must see every array that a BSDF in memory gathers from, of other scenes as well.
"""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_refract  # noqa: F401  (registers the plugins)

# A parameter of each, and a value to set.
GLASSES = {
    "a number": ({"int_ior": 1.5}, "eta", 1.3),
    "a dispersive medium": ({"int_ior": "cauchy(1.5, 4000)"}, "int_ior_A", 1.3),
    "a texture": ({"int_ior": {"type": "checkerboard", "color0": 1.3, "color1": 1.6}}, "color0.value", 1.5),
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


def ball(parameters, integrator):
    lamps = {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([8, 4, 1])}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": integrator, "rr_depth": 100},
            "sensor": {
                "type": "perspective",
                "fov": 30,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 24, "height": 24, "pixel_format": "rgb"},
            },
            "sky": {"type": "constant"},
            "wall": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).scale(3),
                "bsdf": {"type": "diffuse", "reflectance": lamps},
            },
            "ball": {"type": "sphere", "bsdf": {"type": "refract", "ext_ior": 1.0} | parameters},
        }
    )


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
    (key,) = (key for key in [*params.keys()] if key.startswith("ball.bsdf") and key.endswith(name))
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
