"""Paths through dispersive boundaries: one wavelength goes on for all of them, and no light is lost or made."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import SKY, camera, parameter
from support.glass_scenes import render as rendered

from mi_refract import media
from mi_refract.image_diff import pixelwise
from mi_refract.plugins import integrator_context, path_loop

GLASS = "cauchy(1.5, 20000)"
FAR = mi.ScalarTransform4f().translate([0, 0, 99])


def glass(**parameters):
    return {"type": "refract", "int_ior": GLASS, "ext_ior": 1.0} | parameters


def ball(**parameters):
    return {"type": "sphere", "bsdf": glass(**parameters)}


def scene(resolution=8, light=None, **parts):
    """Seen from 5 radii away, in light that is the same from everywhere."""
    sensor = camera(resolution, 22, component_format="float32")
    return mi.load_dict({"type": "scene", "sensor": sensor, "light": light or {"type": "constant"}} | parts)


def render(made, spp=256, seed=0, **parameters):
    return rendered(made, spp, seed, **{"max_depth": -1, "rr_depth": 10_000} | parameters)[..., :3]


METHODS = {
    "by chance": {},
    "both lobes": {"split_depth": 2},
    "deterministic": {"deterministic": True, "split_weight": 1 / 4096},
}


@pytest.mark.parametrize("method", METHODS)
def test_in_a_white_furnace_glass_is_not_seen(method, spectral_variant):
    """Also behind a second dispersive surface, where the weight must not be taken again. Bound: five deviations."""
    if not dr.is_jit_v(mi.Float):
        pytest.skip("a scalar variant would render for minutes")
    inner = ball(int_ior="cauchy(1.3, 8000)", ext_ior=GLASS) | {"radius": 0.5}
    made, empty = scene(ball=ball(), inner=inner), scene(far=ball() | {"to_world": FAR})
    whites = np.stack([render(empty, 2048, 100 + seed).mean((0, 1)) for seed in range(8)])
    images = np.stack([render(made, 256, seed, **METHODS[method]).mean((0, 1)) for seed in range(8)])
    error = np.sqrt((images.var(0, ddof=1) + whites.var(0, ddof=1)) / len(images))
    assert (error < 0.01 * whites.mean(0)).all()
    assert (np.abs(images.mean(0) - whites.mean(0)) < 5 * error).all()


@pytest.fixture
def end(llvm_spectral, monkeypatch):
    """`end(scene)`: the state of the lanes of its paths at their end."""

    def call(made):
        ends, run = [], path_loop.PathLoop.run
        with monkeypatch.context() as patch:
            patch.setattr(path_loop.PathLoop, "run", lambda *arguments: ends.append(run(*arguments)) or ends[-1])
            image = mi.render(made, integrator=mi.load_dict({"type": "refract_path"}), spp=4)
            dr.eval(image, *(x for x in (ends[0].depth, ends[0].wavelength_count) if x is not None))
        return ends[0]

    return call


def test_light_that_is_only_reflected_keeps_all_of_its_wavelengths(end):
    state = end(scene(ball=ball(specular_transmittance=0.0)))
    count, depth = np.array(state.wavelength_count), np.array(state.depth)
    assert (depth == 2).any() and (count[depth == 2] == 4).all()  # reflected, and then in the sky
    assert 1 in count[depth == 1]  # refracted, and black


def test_through_glass_one_wavelength_is_left(end):
    state = end(scene(ball=ball()))
    count, depth = np.array(state.wavelength_count), np.array(state.depth)
    assert set(count[depth >= 3].tolist()) == {1.0}  # into the ball, out of it, and in the sky
    assert set(count[depth == 2].tolist()) == {4.0}  # reflected


def test_what_is_behind_glass_that_is_not_dispersive_keeps_them(end):
    state = end(scene(ball=ball(int_ior=1.5), far=ball() | {"to_world": FAR}))
    assert (np.array(state.wavelength_count)[np.array(state.depth) >= 1] == 4).all()


def test_scenes_without_dispersion_or_absorption_have_no_state_of_them(end):
    state = end(scene(ball=ball(int_ior=1.5)))
    assert state.wavelength_count is None and state.sigma is None and state.skipped is None


def test_the_image_is_that_of_one_render_per_wavelength(llvm_spectral):
    """Light of one wavelength: the index of it as a number. Each is a narrow band, 5 nm; one pixel in 10⁶ by chance."""
    wavelength = 450.0
    band = {"type": "irregular", "wavelengths": "447, 447.1, 452.9, 453", "values": "0, 1, 1, 0"}
    place = mi.ScalarTransform4f().translate([0.5, 0.3, -4]).scale(0.8)
    lamp = {"type": "sphere", "to_world": place, "emitter": {"type": "area", "radiance": band}}
    images = {}
    for name, ior in (("dispersive", GLASS), ("number", float(media.index(GLASS, wavelength)))):
        made = scene(light=lamp, ball=ball(int_ior=ior))
        images[name] = np.stack([render(made, 4096, seed).mean((0, 1)) for seed in range(6)])
    one, two = images.values()
    error = np.sqrt(one.var(0, ddof=1) + two.var(0, ddof=1)) / np.sqrt(6)
    strongest = two.mean(0).argmax()
    assert error[strongest] < 0.05 * two.mean(0)[strongest]
    assert abs(one.mean(0) - two.mean(0))[strongest] < 5 * error[strongest]


def test_path_has_the_d_line_and_is_warned_once(llvm_spectral, monkeypatch):
    said = []
    monkeypatch.setattr(integrator_context, "warned", set())
    monkeypatch.setattr(mi, "Log", lambda level, text: said.append(text))
    sky = {"type": "envmap", "bitmap": mi.Bitmap(SKY)}
    number = float(media.index(GLASS, media.LINES["d"]))
    made, expected = scene(light=sky, ball=ball()), scene(light=sky, ball=ball(int_ior=number))
    path = {"type": "path", "max_depth": 16}
    images = [render(x, 16, **path) for x in (made, expected, made)]
    assert pixelwise.changes(images[1], images[0], 1e-4).share <= 1e-2
    (text,) = [text for text in said if "expected the integrator refract_path" in text]
    assert "all light has the index of the d line" in text


@pytest.mark.parametrize("key", ["int_ior_B", "int_absorption.value"])
def test_the_derivative_of_an_image_is_that_of_differences(key, llvm_spectral):
    """Σ weight · pixel: within 2 %. No edge is inside the image. Differences follow both lobes: they have no noise of
    the choice, which jumps with the reflectance; derivatives have a deviation of about 0.6 %.
    """
    glass = ball(int_ior="cauchy(1.5, 4000)", int_absorption=0.1) | {"radius": 3}
    made = scene(16, {"type": "envmap", "bitmap": mi.Bitmap(SKY)}, ball=glass)
    params, weights = mi.traverse(made), np.random.default_rng(3).random((16, 16, 3)).astype(np.float32)
    key = parameter(params, key)
    start, kind = dr.detach(params[key]), type(params[key])

    def total(value, spp, seed, **method):
        params[key] = value
        params.update()
        integrator = mi.load_dict({"type": "refract_path", "max_depth": 3, "rr_depth": 100} | method)
        image = mi.render(made, params, integrator=integrator, spp=spp, seed=seed)[..., :3]
        return dr.sum(image * mi.TensorXf(weights), axis=None)

    step = 400.0 if "ior" in key else 5e-3
    both = {"deterministic": True, "split_weight": 1 / 4096}
    ends = [float(total(kind(start + sign * step), 1024, 7, **both).array[0]) for sign in (1, -1)]
    found = []
    for seed in range(4):
        value = kind(start)
        dr.enable_grad(value)
        dr.backward(total(value, 8192, seed))
        found.append(float(np.ravel(np.array(dr.grad(value)))[0]))
    assert np.mean(found) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.02)
