"""Paths through dispersive boundaries: one wavelength goes on for all of them, and no light is lost or made."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.variants import switch

from mi_refract import media
from mi_refract.image_diff import pixelwise
from mi_refract.plugins import integrator_context

GLASS = "cauchy(1.5, 20000)"
PLACE = mi.ScalarTransform4f
BOX = {"type": "box"}
AROUND = 0.6 + 0.4 * np.sin(np.arange(64) * 2 * np.pi / 64 + 0.3)
SKY = (AROUND[None, :, None] + np.linspace(0, 0.7, 32)[:, None, None]).astype(np.float32) * np.ones(3, np.float32)


def glass(**parameters):
    return {"type": "refract", "int_ior": GLASS, "ext_ior": 1.0} | parameters


def scene(resolution=8, light=None, filter=BOX, fov=22, **parts):
    """A ball seen from 5 radii away, in light that is the same from everywhere."""
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "pixel_format": "rgb", "rfilter": filter}
    place = PLACE().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    eye = {"type": "perspective", "fov": fov, "to_world": place, "film": film | {"component_format": "float32"}}
    parts = parts or {"ball": {"type": "sphere", "bsdf": glass()}}
    return mi.load_dict({"type": "scene", "sensor": eye, "light": light or {"type": "constant"}} | parts)


def render(made, spp=256, seed=0, **parameters):
    method = mi.load_dict({"type": "refract_path", "rr_depth": 10_000} | parameters)
    return np.array(mi.render(made, integrator=method, spp=spp, seed=seed), dtype=float)[..., :3]


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
    ball = {"type": "sphere", "bsdf": glass()}
    inner = {"type": "sphere", "radius": 0.5, "bsdf": glass(int_ior="cauchy(1.3, 8000)", ext_ior=GLASS)}
    made = scene(ball=ball, inner=inner)
    empty = scene(far=ball | {"to_world": PLACE().translate([0, 0, 99])})
    whites = np.stack([render(empty, 2048, 100 + seed).mean((0, 1)) for seed in range(8)])
    images = np.stack([render(made, 256, seed, **METHODS[method]).mean((0, 1)) for seed in range(8)])
    error = np.sqrt((images.var(0, ddof=1) + whites.var(0, ddof=1)) / len(images))
    assert (error < 0.01 * whites.mean(0)).all()
    assert (np.abs(images.mean(0) - whites.mean(0)) < 5 * error).all()


def count(made, spp=4):
    """How many lanes of the paths carry one wavelength at the end, and how many carry all."""
    from mi_refract.plugins import path_loop

    ends = []
    run = path_loop.PathLoop.run

    def recorded(self, *arguments):
        ends.append(run(self, *arguments))
        dr.eval(ends[-1].result, ends[-1].depth, ends[-1].wavelength_count)
        return ends[-1]

    path_loop.PathLoop.run = recorded
    try:
        dr.eval(mi.render(made, integrator=mi.load_dict({"type": "refract_path"}), spp=spp))
    finally:
        path_loop.PathLoop.run = run
    return ends


def llvm_spectral(needs_variant):
    needs_variant("llvm_ad_spectral")
    switch("llvm_ad_spectral")


def test_light_that_is_only_reflected_keeps_all_of_its_wavelengths(needs_variant):
    llvm_spectral(needs_variant)
    ball = {"type": "sphere", "bsdf": glass(specular_transmittance=0.0)}
    (end,) = count(scene(ball=ball))
    carried, depth = np.array(end.wavelength_count), np.array(end.depth)
    assert (depth == 2).any() and (carried[depth == 2] == 4).all()  # reflected, and then in the sky
    assert 1 in carried[depth == 1]  # refracted, and black


def test_through_glass_one_wavelength_is_left(needs_variant):
    llvm_spectral(needs_variant)
    (end,) = count(scene())
    carried, depth = np.array(end.wavelength_count), np.array(end.depth)
    assert set(carried[depth >= 3].tolist()) == {1.0}  # into the ball, out of it, and in the sky
    assert set(carried[depth == 2].tolist()) == {4.0}  # reflected


def test_what_is_behind_glass_that_is_not_dispersive_keeps_them(needs_variant):
    llvm_spectral(needs_variant)
    ball = {"type": "sphere", "bsdf": glass(int_ior=1.5)}
    far = {"type": "sphere", "to_world": PLACE().translate([0, 0, 99]), "bsdf": glass()}
    (end,) = count(scene(ball=ball, far=far))
    assert (np.array(end.wavelength_count)[np.array(end.depth) >= 1] == 4).all()


def test_the_image_is_that_of_one_render_per_wavelength(needs_variant):
    """Light of one wavelength: the index of it as a number. Each is a narrow band, 5 nm; one pixel in 10⁶ by chance."""
    llvm_spectral(needs_variant)
    wavelength = 450.0
    band = {"type": "irregular", "wavelengths": "447, 447.1, 452.9, 453", "values": "0, 1, 1, 0"}
    lamp = {"type": "sphere", "to_world": PLACE().translate([0.5, 0.3, -4]).scale(0.8)}
    lamp |= {"emitter": {"type": "area", "radiance": band}}
    images = {}
    for name, ior in (("dispersive", GLASS), ("number", float(media.index(GLASS, wavelength)))):
        ball = {"type": "sphere", "bsdf": glass(int_ior=ior)}
        made = scene(light=lamp, ball=ball)
        images[name] = np.stack([render(made, 4096, seed).mean((0, 1)) for seed in range(6)])
    one, two = images.values()
    error = np.sqrt(one.var(0, ddof=1) + two.var(0, ddof=1)) / np.sqrt(6)
    strongest = two.mean(0).argmax()
    assert error[strongest] < 0.05 * two.mean(0)[strongest]
    assert abs(one.mean(0) - two.mean(0))[strongest] < 5 * error[strongest]


def test_path_has_the_d_line_and_is_warned_once(needs_variant, monkeypatch):
    llvm_spectral(needs_variant)
    said = []
    monkeypatch.setattr(integrator_context, "_said", set())
    monkeypatch.setattr(mi, "Log", lambda level, text: said.append(text))
    ball = {"type": "sphere", "bsdf": glass()}
    made = scene(light={"type": "envmap", "bitmap": mi.Bitmap(SKY)}, ball=ball)
    number = scene(
        light={"type": "envmap", "bitmap": mi.Bitmap(SKY)},
        ball={"type": "sphere", "bsdf": glass(int_ior=float(media.index(GLASS, media.LINES["d"])))},
    )
    path = {"type": "path", "max_depth": 16}
    found, expected = (render(each, 16, **path) for each in (made, number))
    render(made, 16, **path)
    assert pixelwise.changes(expected, found, 1e-4).share <= 1e-2
    (text,) = [text for text in said if "expected the integrator refract_path" in text]
    assert "all light has the index of the d line" in text


# Derivatives ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["int_ior_B", "int_ior_A", "int_absorption"])
def test_the_derivative_of_an_image_is_that_of_differences(key, needs_variant):
    """Σ weight · pixel: within 2 %. No edge is inside the image. Differences follow both lobes: they have no noise of
    the choice, which jumps with the reflectance; derivatives have a deviation of about 0.6 %.
    """
    llvm_spectral(needs_variant)
    ball = {"type": "sphere", "radius": 3, "bsdf": glass(int_ior="cauchy(1.5, 4000)", int_absorption=0.1)}
    made = scene(16, {"type": "envmap", "bitmap": mi.Bitmap(SKY)}, ball=ball)
    parameters = mi.traverse(made)
    (full,) = [name for name in parameters.keys() if key in name]  # noqa: SIM118
    weights = mi.TensorXf(np.random.default_rng(3).random((16, 16, 3)).astype(np.float32))
    start, kind = dr.detach(parameters[full]), type(parameters[full])

    def total(value, spp, seed, **method):
        parameters[full] = value
        parameters.update()
        integrator = mi.load_dict({"type": "refract_path", "max_depth": 3, "rr_depth": 100} | method)
        image = mi.render(made, parameters, integrator=integrator, spp=spp, seed=seed)[..., :3]
        return dr.sum(image * weights, axis=None)

    step = {"int_ior_B": 400.0, "int_ior_A": 2e-3, "int_absorption": 5e-3}[key]
    both = {"deterministic": True, "split_weight": 1 / 4096}
    ends = [float(total(kind(start + sign * step), 1024, 7, **both).array[0]) for sign in (1, -1)]
    found = []
    for seed in range(4):
        value = kind(start)
        dr.enable_grad(value)
        dr.backward(total(value, 8192, seed))
        found.append(float(np.ravel(np.array(dr.grad(value)))[0]))
    assert np.mean(found) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.02)


def test_scenes_without_dispersion_or_absorption_have_no_state_of_them(needs_variant):
    llvm_spectral(needs_variant)
    (end,) = count(scene(ball={"type": "sphere", "bsdf": glass(int_ior=1.5)}))
    assert {field.name for field in dataclasses.fields(end)} >= {"wavelength_count", "sigma", "skipped"}
    assert end.wavelength_count is None and end.sigma is None and end.skipped is None
