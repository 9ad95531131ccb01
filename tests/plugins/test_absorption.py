"""Absorption parameters of `refract`: accepted values, and the σ that they give."""

import math
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import GLASS, attached, camera, refusal, rgb, sampled, surface, vector

from mi_refract.plugins import check_integrator
from mi_refract.plugins.absorption import BEYOND, HERE
from mi_refract.plugins.refract import followed_context

SPECTRUM = {"type": "irregular", "wavelengths": "360, 830", "values": "0.36, 0.83"}
WAVELENGTHS = 400.0, 500.0, 600.0, 700.0


def load(**parameters):
    return mi.load_dict(GLASS | parameters)


def sigma(side=BEYOND, outside=True, **parameters):
    """Return σ of one side of a boundary with these parameters, seen from outside or from inside."""
    si = surface((0.6, 0, 0.8 if outside else -0.8), WAVELENGTHS)
    return vector(load(**parameters).eval_attribute(side, si, True))


def test_attributes_follow_the_side_that_light_comes_from(each_variant):
    both = {"int_absorption": 40.0, "ext_absorption": 0.25}
    assert sigma(HERE, **both) == pytest.approx(0.25) == sigma(BEYOND, outside=False, **both)
    assert sigma(BEYOND, **both) == pytest.approx(40) == sigma(HERE, outside=False, **both)
    assert (sigma(ext_absorption=0.25) == 0).all()
    assert not load().has_attribute(BEYOND)
    assert sigma(int_colour=0.25, int_colour_distance=2.0) == pytest.approx(math.log(4) / 2, rel=1e-6)


def test_rgb_colours_and_spectra_give_sigma(each_variant):
    if mi.is_monochromatic:
        pytest.skip("no colours")
    values, colours, distance = [0.4, 0.5, 0.6, 0.7], [0.4, 0.5, 0.6, 0.7], 1.0
    absorption = colour = SPECTRUM
    if not mi.is_spectral:
        values, colours, distance = [0.5, 2, 4], [0.25, 1, 0.5], 0.5
        absorption, colour = ({"type": "rgb", "value": x} for x in (values, colours))
    assert sigma(int_absorption=absorption) == pytest.approx(values, rel=1e-6)
    expected = -np.log(colours) / distance
    assert sigma(int_colour=colour, int_colour_distance=distance) == pytest.approx(expected, rel=1e-5, abs=1e-12)


def test_a_file_with_k_gives_4_pi_k_over_wavelength(each_variant, tmp_path, logged):
    """In the scene's unit. Outside the table k has its value at the table's end, with a warning."""
    (tmp_path / "k.csv").write_text("nm,n,k\n400,1.5,4e-6\n600,1.5,6e-6\n700,1.5,7e-6\n")
    absorption = sigma(int_absorption=f"hold(file:{tmp_path}/k.csv)", int_absorption_unit=1e-3)
    assert absorption == pytest.approx(4 * math.pi * 1e-8 * 1e6, rel=1e-5 if mi.is_spectral else 0.3)
    (text,) = [text for text in logged if "int_absorption" in text]
    assert "k from 400 to 700 nm; other light (0.5% of the colour) has the absorption of the range's end" in text


@pytest.mark.parametrize("wavelengths", [(360, 830), (300, 900), (360.00001, 400, 400.000001, 830)])
def test_k_is_linear_between_the_wavelengths_of_a_file(wavelengths, tmp_path, spectral_variant):
    """σ is not: between 360 and 830 nm a line in σ is off by up to 18 %."""
    (tmp_path / "k.csv").write_text("nm,n,k\n" + "".join(f"{w},1.5,{w * 1e-9 + 1e-6}\n" for w in wavelengths))
    absorption = sigma(int_absorption=f"hold(file:{tmp_path}/k.csv)", int_absorption_unit=1e-3)
    expected = [4e6 * math.pi * (1e-6 / w + 1e-9) for w in WAVELENGTHS]
    assert absorption == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("k", "parameters", "warns"),
    [(1e-6, {}, True), (1e-8, {}, False), (1e-6, {"int_absorption": 0.5}, False), (0, {}, False)],
)
def test_a_visible_k_that_is_not_rendered_is_a_warning(llvm_variant, tmp_path, logged, k, parameters, warns):
    """Half is left after ln 2 · 600 nm/(4π · 1e-6) = 33 mm."""
    (tmp_path / "k.csv").write_text(f"nm,n,k\n380,1.5,0\n599,1.5,0\n600,1.5,{k}\n601,1.5,0\n780,1.5,0\n")
    load(int_ior=f"file:{tmp_path}/k.csv", **parameters)
    texts = [text for text in logged if "has k" in text]
    assert len(texts) == warns
    assert all("at 600 nm half is left after 0.033 m" in text and "int_absorption_unit" in text for text in texts)


@pytest.mark.parametrize("scale", [0.1, 1.0, 20.0])
def test_an_rgb_colour_becomes_a_spectrum_in_proportion(scale, spectral_variant):
    """As for Mitsuba's emitters: twice the largest value × the spectrum of a colour whose largest value is 1/2."""
    colour = np.array([0.1, 0.3, 0.2]) * scale
    absorption = sigma(int_absorption={"type": "rgb", "value": colour.tolist()})
    half = mi.load_dict({"type": "srgb", "color": (colour / colour.max() / 2).tolist()})
    spectrum = vector(half.eval(surface(wavelengths=WAVELENGTHS)))
    assert absorption == pytest.approx(2 * colour.max() * spectrum, rel=1e-5)
    assert absorption[1] > 2 * absorption[3] > 0  # more at 500 nm, green, than at 700 nm, red
    assert (sigma(int_absorption={"type": "rgb", "value": 0.0}) < 1e-6).all()


def test_absorption_of_a_colour_of_0_is_finite(spectral_variant):
    """A spectrum is 0 outside its range."""
    colour = {"type": "irregular", "wavelengths": "450, 650", "values": "0.5, 0.5"}
    half, largest = math.log(2), 30 * math.log(10)
    absorption = sigma(int_colour=colour, int_colour_distance=1.0)
    assert absorption == pytest.approx([largest, half, half, largest], rel=1e-5)


def test_absorption_is_differentiable(llvm_variant):
    bsdf = load(int_colour=0.25, int_colour_distance=2.0)
    params, (key,) = attached(bsdf, "int_colour.value")
    dr.backward(bsdf.eval_attribute(BEYOND, surface(), True).x)
    assert dr.grad(params[key])[0] == pytest.approx(-1 / 0.25 / 2)


def test_an_edit_of_an_rgb_colour_means_what_the_scene_does(rgb_variant):
    bsdf = load(int_absorption=rgb(0.5, 2, 4))
    params = mi.traverse(bsdf)
    key = "int_absorption.value"
    assert vector(params[key]) == pytest.approx([0.5, 2, 4])
    params[key] = mi.Color3f(3, 1, 0.25)
    params.update()
    assert vector(bsdf.eval_attribute(BEYOND, surface(), True)) == pytest.approx([3, 1, 0.25])


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"int_absorption": -0.1}, "int_absorption = -0.1; expected a number or a spectrum ≥ 0"),
        ({"ext_absorption": math.nan}, "ext_absorption = nan; expected"),
        ({"int_absorption": math.inf}, "int_absorption = inf; expected"),
        ({"int_absorption": "red"}, "int_absorption = red; expected"),
        ({"int_absorption": {"type": "checkerboard"}}, "int_absorption = .*; expected .*no texture"),
        ({"int_absorption": rgb(1, -1, 1)}, "int_absorption = .*; expected"),
        ({"int_colour": 0.0, "int_colour_distance": 1.0}, "int_colour = 0.0; expected .* above 0 and up to 1"),
        ({"int_colour": 1.5, "int_colour_distance": 1.0}, "int_colour = 1.5; expected .* above 0 and up to 1"),
        ({"int_colour": rgb(1, 0, 1), "int_colour_distance": 1.0}, "int_colour = .*; expected"),
        ({"int_colour": 0.5}, "int_colour and int_colour_distance: int_colour_distance is not given"),
        ({"ext_colour_distance": 0.5}, "ext_colour is not given; expected both, or neither"),
        ({"int_colour": 0.5, "int_colour_distance": 0.0}, "int_colour_distance = 0.0; expected a positive finite"),
        ({"int_colour": 0.5, "int_colour_distance": math.inf}, "int_colour_distance = inf; expected"),
        ({"int_absorption": "file:no.csv"}, "int_absorption = 'file:no.csv': no.csv: No such file"),
        (
            {"int_absorption": "hold(file:{nk})"},
            "int_absorption = 'hold.*': int_absorption_unit is missing; expected the scene's unit in metres: 0.001",
        ),
        ({"int_absorption": "hold(file:{nk})", "int_absorption_unit": -1.0}, "int_absorption_unit = -1.0; expected"),
        ({"int_absorption": 1.0, "int_absorption_unit": 1.0}, "int_absorption = 1.0; expected .* a file with k"),
        ({"int_absorption": "SCHOTT:F2", "int_absorption_unit": 1.0}, "int_absorption = 'SCHOTT:F2'; expected .*k"),
        ({"int_absorption": "file:{nk}", "int_absorption_unit": 1.0}, "has k from 400 to 700 nm: 0.5% .* hold"),
        ({"int_colour": 0.5, "int_absorption": 1.0}, "int_absorption and int_colour are both set; expected one"),
        ({"int_color": 0.5, "int_color_distance": 1.0}, "unknown parameter int_color; expected int_colour"),
        ({"ext_color_distance": 1.0}, "unknown parameter ext_color_distance; expected ext_colour_distance"),
        ({"specular_transmittance": -1.0}, "specular_transmittance = -1.0; expected a number, a spectrum or a texture"),
        ({"specular_reflectance": math.nan}, "specular_reflectance = nan; expected .* ≥ 0 and finite"),
        ({"specular_reflectance": rgb(1, -1, 1)}, "specular_reflectance = .*; expected .* ≥ 0 and finite"),
    ],
)
def test_invalid_parameters_are_errors(typical_variant, parameters, message, tmp_path):
    (tmp_path / "nk.csv").write_text("nm,n,k\n400,1.5,0\n700,1.5,0\n")
    parameters = {k: x.format(nk=tmp_path / "nk.csv") if isinstance(x, str) else x for k, x in parameters.items()}
    assert re.search(message, refusal(load, **parameters))


def test_a_negative_value_of_a_spectrum_is_an_error(each_variant):
    """We raise it for `<spectrum>`; Mitsuba does for a plugin `irregular`."""
    text = '<bsdf type="refract" version="3.0.0"><spectrum name="int_absorption" value="400:0.3, 700:-0.1"/></bsdf>'
    with pytest.raises(RuntimeError, match="int_absorption"):
        mi.load_string(text)


@pytest.mark.parametrize("colour", [0.5, 1.0])  # 1 absorbs nothing, but can be edited
def test_sampling_without_following_media_is_an_error(each_variant, colour):
    bsdf = load(ext_colour=colour, ext_colour_distance=1.0)
    assert np.isfinite(sampled(bsdf, (0, 0, 1), 0.5, followed_context()).weight).all()
    assert refusal(sampled, bsdf, (0, 0, 1), 0.5).startswith("refract: ext_colour; expected the integrator ")


def two_balls(**parameters):
    """Return a scene of two balls, each with its own BSDF."""
    glass = GLASS | parameters
    first = {"type": "sphere", "bsdf": glass}
    second = {"type": "sphere", "center": [1, 0, 0], "bsdf": glass | {"int_ior": 1.4}}
    parts = {"sensor": camera(8, 60), "light": {"type": "constant"}, "integrator": {"type": "path"}}
    return mi.load_dict({"type": "scene"} | parts | {"ball": first, "other": second})


@pytest.mark.parametrize("integrator", ["path", "volpath", "prb", "ptracer"])
def test_a_scene_with_absorption_that_is_not_followed_gives_one_warning(integrator, llvm_variant, logged):
    """All scenes are in memory. An image without a warning is finite."""
    clear, inside, outside = two_balls(), two_balls(int_absorption=1.0), two_balls(ext_absorption=2.0)
    message = "; expected the integrator refract_path, or no absorption; where light meets it, the image is not"
    expected = ((clear, ""), (inside, "int_absorption"), (outside, "ext_absorption"), (inside, ""), (clear, ""))
    for scene, parameter in expected:
        logged.clear()
        image = np.array(mi.render(scene, integrator=mi.load_dict({"type": integrator}), spp=4))
        assert [text.startswith(f"refract: {parameter}{message}") for text in logged] == [True] * bool(parameter)
        assert np.isfinite(image).all() == (scene is clear)
        if integrator == "path":
            assert np.isfinite(image[0, 0]).all() and np.isfinite(image[4, 4]).any() == (scene is clear)


def test_a_frozen_function_gives_the_warning_too(llvm_variant, logged):
    scene = two_balls(int_absorption=1.0)
    dr.freeze(lambda seed: mi.render(scene, spp=4, seed=seed))(dr.opaque(mi.UInt32, 1))
    # One a BSDF. Dr.Jit traces whatever BSDF is alive, so those of earlier tests may be among them.
    assert sum("int_absorption; expected the integrator refract_path" in text for text in logged) >= 2


@pytest.mark.parametrize("inner", ["refract_path", "path"])
@pytest.mark.parametrize("outer", [{"type": "moment"}, {"type": "aov", "aovs": "d:depth"}], ids=lambda x: x["type"])
def test_nested_integrators_are_checked(outer, inner, rgb_variant):
    ball = {"type": "sphere", "bsdf": GLASS | {"int_absorption": 1.0}}
    scene = mi.load_dict({"type": "scene", "ball": ball, "integrator": outer | {"inner": {"type": inner}}})
    if inner == "path":
        assert "refract: int_absorption; expected the integrator" in refusal(check_integrator, scene)
    else:
        check_integrator(scene)
