"""Absorption as parameters of `refract`: what they may be, and what is made of them."""

import math
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import GLASS, camera, refusal

from mi_refract.plugins import integrator_context
from mi_refract.plugins.absorption import BEYOND, HERE

SPECTRUM = {"type": "irregular", "wavelengths": "360, 830", "values": "0.36, 0.83"}
WAVELENGTHS = 400.0, 500.0, 600.0, 700.0


def load(**parameters):
    return mi.load_dict(GLASS | parameters)


def sigma(bsdf, name, outside=True):
    """What the boundary says of a side, seen from outside or from inside."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0.6, 0, 0.8 if outside else -0.8)
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(*WAVELENGTHS)
    return np.array(bsdf.eval_attribute(name, si, True), dtype=float).ravel()


def test_each_side_is_here_or_beyond(each_variant):
    bsdf = load(int_absorption=0.5, ext_absorption=0.25)
    assert sigma(bsdf, HERE) == pytest.approx(0.25) == sigma(bsdf, BEYOND, outside=False)
    assert sigma(bsdf, BEYOND) == pytest.approx(0.5) == sigma(bsdf, HERE, outside=False)


def test_a_side_of_which_nothing_is_said_does_not_absorb(typical_variant):
    bsdf = load(ext_absorption=0.25)
    assert (sigma(bsdf, BEYOND) == 0).all()
    assert sigma(bsdf, HERE) == pytest.approx(0.25)
    assert not load().has_attribute(BEYOND)


def test_sigma_may_be_greater_than_1(each_variant):
    assert sigma(load(int_absorption=40.0), BEYOND) == pytest.approx(40)


def test_a_colour_is_what_is_left_after_a_distance(each_variant):
    assert sigma(load(int_colour=0.25, int_colour_distance=2.0), BEYOND) == pytest.approx(math.log(4) / 2, rel=1e-6)


def test_of_three_colours(rgb_variant):
    values = {"type": "rgb", "value": [0.5, 2, 4]}
    assert sigma(load(int_absorption=values), BEYOND) == pytest.approx([0.5, 2, 4], rel=1e-6)
    colour = {"type": "rgb", "value": [0.25, 1, 0.5]}
    found = sigma(load(int_colour=colour, int_colour_distance=0.5), BEYOND)
    assert found == pytest.approx([2 * math.log(4), 0, 2 * math.log(2)], rel=1e-6, abs=1e-12)


def test_of_a_spectrum(spectral_variant):
    assert sigma(load(int_absorption=SPECTRUM), BEYOND) == pytest.approx([0.4, 0.5, 0.6, 0.7], rel=1e-6)
    found = sigma(load(int_colour=SPECTRUM, int_colour_distance=1.0), BEYOND)
    assert found == pytest.approx(-np.log([0.4, 0.5, 0.6, 0.7]), rel=1e-5)


@pytest.mark.parametrize("scale", [0.1, 1.0, 20.0])
def test_three_colours_become_a_spectrum_in_proportion(scale, spectral_variant):
    """As Mitsuba's emitters have it: twice the largest colour, times the spectrum of a colour whose largest is 1/2."""
    colour = np.array([0.1, 0.3, 0.2]) * scale
    found = sigma(load(int_absorption={"type": "rgb", "value": colour.tolist()}), BEYOND)
    half = mi.load_dict({"type": "srgb", "color": (colour / colour.max() / 2).tolist()})
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wavelengths = type(si.wavelengths)(*WAVELENGTHS)
    assert found == pytest.approx(2 * colour.max() * np.array(half.eval(si), dtype=float).ravel(), rel=1e-5)
    assert found[1] > 2 * found[3] > 0  # more of green at 500 nm than of red at 700
    assert (sigma(load(int_absorption={"type": "rgb", "value": 0.0}), BEYOND) < 1e-6).all()


def test_parameters_are_differentiable(llvm_variant):
    bsdf = load(int_colour=0.25, int_colour_distance=2.0)
    parameters = mi.traverse(bsdf)
    dr.enable_grad(parameters["int_colour.value"])
    parameters.update()
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0, 0, 1)
    dr.backward(bsdf.eval_attribute(BEYOND, si, True).x)
    assert dr.grad(parameters["int_colour.value"])[0] == pytest.approx(-1 / 0.25 / 2)


BAD = [
    ({"int_absorption": -0.1}, "int_absorption = -0.1; expected a number or a spectrum ≥ 0"),
    ({"ext_absorption": math.nan}, "ext_absorption = nan; expected"),
    ({"int_absorption": math.inf}, "int_absorption = inf; expected"),
    ({"int_absorption": "red"}, "int_absorption = red; expected"),
    ({"int_absorption": {"type": "checkerboard"}}, "int_absorption = .*; expected .*no texture"),
    ({"int_absorption": {"type": "rgb", "value": [1, -1, 1]}}, "int_absorption = .*; expected"),
    ({"int_colour": 0.0, "int_colour_distance": 1.0}, "int_colour = 0.0; expected .* above 0 and up to 1"),
    ({"int_colour": 1.5, "int_colour_distance": 1.0}, "int_colour = 1.5; expected .* above 0 and up to 1"),
    ({"int_colour": {"type": "rgb", "value": [1, 0, 1]}, "int_colour_distance": 1.0}, "int_colour = .*; expected"),
    ({"int_colour": 0.5}, "int_colour and int_colour_distance: int_colour_distance is not given"),
    ({"ext_colour_distance": 0.5}, "ext_colour is not given; expected both, or neither"),
    ({"int_colour": 0.5, "int_colour_distance": 0.0}, "int_colour_distance = 0.0; expected a positive finite length"),
    ({"int_colour": 0.5, "int_colour_distance": math.inf}, "int_colour_distance = inf; expected"),
    (
        {"int_colour": 0.5, "int_colour_distance": 1.0, "int_absorption": 1.0},
        "int_absorption and int_colour are both set; expected one of them",
    ),
]


@pytest.mark.parametrize(("parameters", "said"), BAD)
def test_what_is_refused_is_named(typical_variant, parameters, said):
    assert re.search(said, refusal(load, **parameters))


def test_a_negative_value_of_a_spectrum_is_refused(each_variant):
    """Of `<spectrum>` by us; of a plugin `irregular` by Mitsuba."""
    text = '<bsdf type="refract" version="3.0.0"><spectrum name="int_absorption" value="400:0.3, 700:-0.1"/></bsdf>'
    with pytest.raises(RuntimeError, match="int_absorption"):
        mi.load_string(text)


def test_an_integrator_that_does_not_track_media_is_refused(each_variant, monkeypatch):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(0, 0, 1)
    bsdf = load(ext_colour=0.5, ext_colour_distance=1.0)
    _, weight = bsdf.sample(integrator_context.context(), si, 0.5, [0.5, 0.5])
    assert np.isfinite(np.array(weight)).all()
    if not dr.is_jit_v(mi.Float):
        with pytest.raises(RuntimeError, match=r"refract: ext_colour; expected the integrator refract_path"):
            bsdf.sample(mi.BSDFContext(), si, 0.5, [0.5, 0.5])
        return
    monkeypatch.setattr(integrator_context, "warned", said := set())
    _, weight = bsdf.sample(mi.BSDFContext(), si, 0.5, [0.5, 0.5])
    assert np.isinf(np.array(mi.unpolarized_spectrum(weight))).all()
    (text,) = said
    assert text.startswith("refract: ext_colour; expected the integrator refract_path, or no absorption")


def test_with_path_light_that_meets_absorption_is_infinite_and_no_other_scene(llvm_variant, monkeypatch):
    """Also while the absorbing scene is in memory."""
    monkeypatch.setattr(integrator_context, "warned", set())
    whole = {"type": "scene", "sensor": camera(8, 60), "light": {"type": "constant"}, "integrator": {"type": "path"}}
    glass = {"type": "refract", "int_ior": 1.5}
    absorbing = mi.load_dict(whole | {"ball": {"type": "sphere", "bsdf": glass | {"int_absorption": 0.5}}})
    clear = mi.load_dict(whole | {"ball": {"type": "sphere", "bsdf": glass}})
    assert np.isfinite(np.array(mi.render(clear, spp=4))).all()
    image = np.array(mi.render(absorbing, spp=4))
    assert not np.isfinite(image[4, 4]).any() and np.isfinite(image[0, 0]).all()
    assert np.isfinite(np.array(mi.render(clear, spp=4))).all()
