"""Gradients of images in the parameters of `refract`: of several views, by several integrators, in a frozen step."""

import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import camera, glass_ball, sky
from support.variants import switch

from mi_refract.plugins import integrator_context

VIEWS = 3
NUMBER = {"int_ior": 1.5, "specular_transmittance": 0.7, "specular_reflectance": 0.5}
TEXTURE = {"int_ior": {"type": "checkerboard", "color0": 1.3, "color1": 1.6}}
DISPERSIVE = {"int_ior": "cauchy(1.5, 4000)"}


@pytest.fixture(autouse=True)
def _said(monkeypatch):
    monkeypatch.setattr(integrator_context, "warned", set())


def load(integrator="refract_path", **glass):
    views = {f"view {i}": camera(12, 20, (5 * np.sin(i), 0.3 * i, 5 * np.cos(i))) for i in range(VIEWS)}
    ball = {"type": "sphere", "bsdf": {"type": "refract", "ext_ior": 1.0} | glass}
    method = {"type": integrator, "max_depth": 5}
    return mi.load_dict({"type": "scene", "integrator": method, **views, "sky": sky(), "ball": ball})


def parameter(params, name):
    (key,) = [key for key in params.keys() if name in key]  # noqa: SIM118  no dictionary
    return key


def loss(scene, params, view, spp=16, seed=1):
    image = mi.render(scene, params, sensor=view, spp=spp, seed=seed)
    weights = np.random.default_rng(3).random(image.shape).astype(np.float32)
    return dr.mean(image * mi.TensorXf(weights), axis=None)


def numbers(x):
    return np.array(x, dtype=float).ravel()


# Several views -------------------------------------------------------------------------------------------------------

CASES = [
    ("llvm_ad_rgb", "refract_path", NUMBER, "eta"),
    ("llvm_ad_rgb", "path", NUMBER, "eta"),
    ("llvm_ad_rgb", "volpath", NUMBER, "eta"),
    ("llvm_ad_rgb", "refract_path", NUMBER, "specular_transmittance"),
    ("llvm_ad_rgb", "prb", NUMBER, "specular_transmittance"),
    ("llvm_ad_rgb", "refract_path", TEXTURE, "color0"),
    ("llvm_ad_rgb", "path", DISPERSIVE, "int_ior_A"),
    ("llvm_ad_spectral", "refract_path", DISPERSIVE, "int_ior_B"),
]


@pytest.mark.parametrize("update", [True, False], ids=["update", "no update"])
@pytest.mark.parametrize("forward", [False, True], ids=["backward", "forward"])
@pytest.mark.parametrize(("variant", "integrator", "glass", "name"), CASES, ids=lambda x: x if type(x) is str else "")
def test_every_view_has_its_gradient(variant, integrator, glass, name, forward, update, needs_variant):
    """One `enable_grad` for all views: each `backward` frees the graph that it walks. Bound: the order of sums."""
    if forward and integrator == "volpath":
        pytest.skip("Mitsuba: volpath has no forward mode")
    needs_variant(variant)
    switch(variant)

    def gradients(views):
        scene = load(integrator, **glass)
        params = mi.traverse(scene)
        key, found = parameter(params, name), []
        dr.enable_grad(params[key])
        if update:
            params.update()
        for view in views:
            image = loss(scene, params, view)
            if forward:
                dr.set_grad(params[key], 1)
                found.append(numbers(dr.forward_to(image))[0])
            else:
                dr.backward(image)
                found.append(numbers(dr.grad(params[key]))[0])
            dr.clear_grad(params[key])
        return found

    together = gradients([0, 1, 2, 0])
    alone = [gradients([view])[0] for view in range(VIEWS)]
    assert together == pytest.approx([*alone, alone[0]], rel=1e-3)
    assert len({round(x, 7) for x in alone}) == VIEWS and np.abs(alone).min() > 0


def test_a_scene_that_was_differentiated_leaves_no_damage(needs_variant):
    """`backward` leaves kernels for later. Where they trace rays and the scene has gone by then, the process ends."""
    needs_variant("llvm_ad_rgb")
    program = f"""
import faulthandler, sys
faulthandler.enable()
sys.path[:0] = {sys.path!r}
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from test_gradients import *
for integrator in ("refract_path", "volpath", "path", *["refract_path"] * 6):
    scene = load(integrator, **NUMBER)
    params = mi.traverse(scene)
    moment = mi.load_dict({{"type": "moment", "inner": {{"type": integrator}}}})
    params[parameter(params, "eta")] = 1.4
    params.update()
    dr.eval(mi.render(scene, integrator=moment, spp=4))
    dr.enable_grad(params[parameter(params, "eta")])
    params.update()
    for view in (0, 1, 2):
        dr.backward(loss(scene, params, view, 4))
        if integrator != "refract_path":  # Mitsuba's own trace rays in the dropped scene where nobody reads this
            numbers(dr.grad(params[parameter(params, "eta")]))
    del scene, params
"""
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {__file__.rpartition('/')[0]!r}){program}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_double_precision_survives_what_is_no_edit(llvm_variant):
    """`update` after `enable_grad` says that eta may have changed: what float32 rounds to the same number has not."""
    bsdf = mi.load_dict({"type": "refract", "int_ior": 1.0003 + 3e-8, "ext_ior": 1.0003})
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f((1 - 1e-8) ** 0.5, 0, 1e-4)

    def bent():
        return numbers(bsdf.sample(mi.BSDFContext(), si, 1.0, [0.5, 0.5])[0].wo)[2]

    before, params = bent(), mi.traverse(bsdf)
    dr.enable_grad(params["eta"])
    params.update()
    assert bent() == before
    params["eta"] = mi.Float(params["eta"])
    params.update()
    assert bent() == before
    params["eta"] = 1 + 2**-23
    params.update()
    assert bent() != before


@pytest.mark.parametrize("matt", [True, False])
def test_a_moving_edge_in_the_view_of_a_matt_point_is_a_warning(matt, llvm_variant, monkeypatch):
    """Of a lamp that is seen through glass: its derivative is missing, in Mitsuba's integrators as well."""
    said = []
    monkeypatch.setattr(mi, "Log", lambda level, text: said.append(text))
    lamp = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 3]).rotate([0, 1, 0], 180)}
    floor = {"floor": {"type": "rectangle", "bsdf": {"type": "diffuse"}}} if matt else {}
    scene = glass_ball(12, lamp=lamp | {"emitter": {"type": "area"}}, **floor)
    params, method = mi.traverse(scene), mi.load_dict({"type": "refract_path", "max_depth": 3})
    dr.enable_grad(params[parameter(params, ".eta")])
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, integrator=method, spp=1), axis=None))
    assert np.isfinite(numbers(dr.grad(params[parameter(params, ".eta")]))).all()
    lines = [text for text in said if "derivatives leave out edges of area lights that move" in text]
    assert len(lines) == matt


# What prb and its kin can give ---------------------------------------------------------------------------------------

FIXED = ["prb", "prb_basic", "prb_projective", "prbvolpath"]


def derivatives(integrator, names, spp=16):
    scene = load(integrator, **NUMBER)
    params = mi.traverse(scene)
    keys = [parameter(params, name) for name in names]
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    dr.backward(loss(scene, params, 0, spp))
    return [numbers(dr.grad(params[key]))[0] for key in keys]


@pytest.mark.parametrize("others", [[], ["specular_transmittance"]], ids=["alone", "with another"])
@pytest.mark.parametrize("integrator", [*FIXED, "volpath", "path", "refract_path"])
def test_a_derivative_in_the_index_is_no_number_where_directions_are_fixed(
    integrator, others, llvm_variant, monkeypatch
):
    said = []
    monkeypatch.setattr(mi, "Log", lambda level, text: said.append(text))
    (eta, *rest) = derivatives(integrator, ["eta", *others])
    lines = [text for text in said if "derivative in the index" in text]
    assert np.isfinite(rest).all() and np.all(rest)
    if integrator in FIXED:
        assert not np.isfinite(eta)
        (line,) = lines
        assert "refract_path or volpath, or path, which is biased" in line and "\n" not in line
    else:
        assert np.isfinite(eta) and eta != 0
        assert not lines


@pytest.mark.parametrize("integrator", FIXED)
@pytest.mark.parametrize("name", ["specular_reflectance", "specular_transmittance"])
def test_tints_have_the_derivatives_of_refract_path(integrator, name, llvm_variant):
    """Of 12² · 256 paths each: t of 8 seeds a side, one false alarm in 10⁴ (14 degrees of freedom: 5.36)."""

    def stack(kind, first):
        scene = load(kind, **NUMBER)
        params, found = mi.traverse(scene), []
        key = parameter(params, name)
        dr.enable_grad(params[key])
        for seed in range(first, first + 8):
            dr.backward(loss(scene, params, 0, 256, seed))
            found.append(numbers(dr.grad(params[key]))[0])
            dr.clear_grad(params[key])
        return np.array(found)

    ours, theirs = stack("refract_path", 100), stack(integrator, 200)
    error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / 8)
    assert error < 0.02 * abs(ours.mean())
    assert abs(ours.mean() - theirs.mean()) < 5.36 * error


# A frozen step -------------------------------------------------------------------------------------------------------

STEPS = [
    (NUMBER, {"eta": 1.4}),
    (NUMBER, {"eta": 1.4, "specular_transmittance": 0.6}),
    (TEXTURE, {"color0": 1.35}),
]


@pytest.mark.parametrize("integrator", ["refract_path", "path"])
@pytest.mark.parametrize(("glass", "start"), STEPS, ids=["index", "index and tint", "texture"])
def test_a_step_of_an_optimisation_can_be_frozen(glass, start, integrator, llvm_variant):
    """Six steps of Adam within `dr.freeze` and without: the same numbers, but for the order of sums."""
    target = mi.render(load(integrator, **glass), spp=16, seed=9)

    def optimise(freeze):
        scene = load(integrator, **glass)
        params = mi.traverse(scene)
        adam = mi.ad.Adam(lr=0.02)
        for name, value in start.items():
            key = parameter(params, name)
            adam[key] = type(params[key])(value)

        def step(scene, adam, seed):
            params = mi.traverse(scene)
            params.update(adam)
            image = mi.render(scene, params, spp=16, seed=seed)
            error = dr.mean(dr.square(image - target), axis=None)
            dr.backward(error)
            adam.step()
            return error

        step, trace = dr.freeze(step) if freeze else step, []
        for seed in range(6):
            step(scene, adam, dr.opaque(mi.UInt32, seed))
            trace.append([numbers(adam[key])[0] for key in adam])
        if freeze:
            assert step.n_recordings <= 3
        return np.array(trace)

    frozen, plain = optimise(True), optimise(False)
    assert frozen == pytest.approx(plain, abs=2e-3)
    assert np.abs(plain[-1] - plain[0]).min() > 0.01


def test_an_index_that_is_none_is_no_image_in_a_frozen_step(llvm_variant):
    scene = load("refract_path", int_ior=1.5)
    params = mi.traverse(scene)
    key = parameter(params, "eta")

    @dr.freeze
    def image(params, value):
        params[key] = value
        params.update()
        return mi.render(scene, params, spp=4, seed=1)

    right = [image(params, mi.Float(x)) for x in (1.5, 1.4, 1.3)][-1]
    assert np.isfinite(right).all()
    middle = np.array(image(params, mi.Float(-1.0)))[6, 6]
    assert np.isnan(middle).all() or (middle == 0).all()
