"""Gradients of images in the parameters of `refract`, and renders in `dr.freeze`.

Gradients are tested for several views and integrators, also in a frozen step. A replayed function must give the image
of a new trace, also after an edit: Dr.Jit must know every array that BSDFs in memory read, also those of other scenes.
"""

import functools
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import BLACK, GLASS, PLACE, attached, camera, glass_ball, parameter, sampled, sky, vector

VIEWS = 3
NUMBER = {"int_ior": 1.5, "specular_transmittance": 0.7, "specular_reflectance": 0.5}
TEXTURE = {"int_ior": {"type": "checkerboard", "color0": 1.3, "color1": 1.6}}
DISPERSIVE = {"int_ior": "cauchy(1.5, 4000)"}


def load(integrator="refract_path", **glass):
    views = {f"view {i}": camera(12, 20, (5 * np.sin(i), 0.3 * i, 5 * np.cos(i))) for i in range(VIEWS)}
    ball = {"type": "sphere", "bsdf": {"type": "refract", "ext_ior": 1.0} | glass}
    method = {"type": integrator, "max_depth": 5}
    return mi.load_dict({"type": "scene", "integrator": method, **views, "sky": sky(), "ball": ball})


def loss(scene, params, view=0, spp=16, seed=1):
    image = mi.render(scene, params, sensor=view, spp=spp, seed=seed)
    weights = np.random.default_rng(3).random(image.shape).astype(np.float32)
    return dr.mean(image * mi.TensorXf(weights), axis=None)


def grad(params, key):
    return vector(dr.grad(params[key]))[0]


# Several views -------------------------------------------------------------------------------------------------------

CASES = [
    ("llvm_ad_rgb", "refract_path", NUMBER, "eta"),
    ("llvm_ad_rgb", "path", NUMBER, "eta"),
    ("llvm_ad_rgb", "refract_path", NUMBER, "specular_transmittance"),
    ("llvm_ad_rgb", "prb", NUMBER, "specular_transmittance"),
    ("llvm_ad_rgb", "refract_path", TEXTURE, "color0"),
    ("llvm_ad_rgb", "path", DISPERSIVE, "int_ior_A"),
    ("llvm_ad_spectral", "refract_path", DISPERSIVE, "int_ior_B"),
]
WAYS = ("backward", "backward without update", "forward")


@pytest.mark.parametrize(("forward", "update"), [(False, True), (False, False), (True, True)], ids=WAYS)
@pytest.mark.parametrize(
    ("variant", "integrator", "glass", "name"), CASES, indirect=["variant"], ids=lambda x: x if type(x) is str else ""
)
def test_every_view_has_its_gradient(variant, integrator, glass, name, forward, update):
    """One `enable_grad` serves all views, although `backward` frees its graph. Bound: the order of sums."""

    def gradients(views):
        scene = load(integrator, **glass)
        params = mi.traverse(scene)
        key, derivatives = parameter(params, name), []
        dr.enable_grad(params[key])
        if update:
            params.update()
        for view in views:
            image = loss(scene, params, view)
            if forward:
                dr.set_grad(params[key], 1)
                derivatives.append(vector(dr.forward_to(image))[0])
            else:
                dr.backward(image)
                derivatives.append(grad(params, key))
            dr.clear_grad(params[key])
        return derivatives

    together = gradients([0, 1, 2, 0])
    alone = [gradients([view])[0] for view in range(VIEWS)]
    assert together == pytest.approx([*alone, alone[0]], rel=1e-3)
    assert len({round(x, 7) for x in alone}) == VIEWS and np.abs(alone).min() > 0


def test_a_differentiated_scene_can_be_freed(needs_variant):
    """`backward` defers kernels. If such a kernel traced rays in a scene that was freed, the process would crash."""
    needs_variant("llvm_ad_rgb")
    program = f"""
import faulthandler, sys
faulthandler.enable()
sys.path[:0] = {[__file__.rpartition("/")[0], *sys.path]!r}
import mi_refract
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
    params, (key,) = attached(scene, "eta")
    for view in (0, 1, 2):
        dr.backward(loss(scene, params, view, 4))
        if integrator != "refract_path":  # Mitsuba's own trace rays in the dropped scene where nobody reads this
            grad(params, key)
    del scene, params
"""
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)
    assert process.returncode == 0, process.stderr[-2000:]


def test_an_update_without_an_edit_keeps_double_precision(llvm_variant):
    """`update` after `enable_grad` reports a change of eta. If eta is the same in float32, it was not edited."""
    bsdf = mi.load_dict({"type": "refract", "int_ior": 1.0003 + 3e-8, "ext_ior": 1.0003})

    def refracted():
        return sampled(bsdf, ((1 - 1e-8) ** 0.5, 0, 1e-4), 1.0).wo[2]

    before = refracted()
    params, (key,) = attached(bsdf, "eta")
    assert refracted() == before
    for value, same in ((mi.Float(params[key]), True), (1 + 2**-23, False)):
        params[key] = value
        params.update()
        assert (refracted() == before) == same


@pytest.mark.parametrize("matt", [True, False])
def test_a_moving_edge_seen_from_a_matt_surface_is_a_warning(matt, llvm_variant, logged):
    """The edge of a lamp seen through glass: its derivative is missing, in Mitsuba's integrators as well."""
    lamp = {"type": "rectangle", "to_world": PLACE().translate([0, 0, 3]).rotate([0, 1, 0], 180)}
    floor = {"floor": {"type": "rectangle", "bsdf": {"type": "diffuse"}}} if matt else {}
    scene = glass_ball(12, lamp=lamp | {"emitter": {"type": "area"}}, **floor)
    params, (key,) = attached(scene, ".eta")
    method = mi.load_dict({"type": "refract_path", "max_depth": 3})
    dr.backward(dr.mean(mi.render(scene, params, integrator=method, spp=1), axis=None))
    assert np.isfinite(grad(params, key))
    assert sum("derivatives leave out edges of area lights that move" in text for text in logged) == matt


@pytest.mark.parametrize("name", ["instance.to_world", "ball.to_world"])
def test_a_derivative_in_the_place_of_an_instance_is_a_warning(name, llvm_variant, logged):
    group = {"type": "shapegroup", "ball": {"type": "sphere", "bsdf": GLASS}}
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    parts = {"sensor": camera(12, 20), "sky": sky(), "group": group, "instance": instance}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "refract_path", "max_depth": 5}} | parts)
    params, (key,) = attached(scene, name)
    dr.backward(loss(scene, params, spp=1))
    missing = name.startswith("instance")
    assert (np.abs(vector(dr.grad(params[key].matrix))).max() < 1e-6) == missing
    assert sum("does not differentiate to_world of an instance" in text for text in logged) == missing


def test_differentiating_a_deterministic_render_is_an_error(llvm_variant):
    scene, method = glass_ball(sky=sky()), mi.load_dict({"type": "refract_path", "deterministic": True})
    params, _ = attached(scene, ".eta")
    with pytest.raises(ValueError, match="such a render cannot be differentiated"):
        dr.backward(dr.mean(mi.render(scene, params, integrator=method, spp=4), axis=None))


# Derivatives of prb and its variants ---------------------------------------------------------------------------------

FIXED = ["prb", "prb_basic", "prb_projective", "prbvolpath"]


@pytest.mark.parametrize("others", [[], ["specular_transmittance"]], ids=["alone", "with another"])
@pytest.mark.parametrize("integrator", [*FIXED, "volpath", "path", "refract_path"])
def test_a_derivative_in_the_index_is_infinite_if_directions_are_fixed(integrator, others, llvm_variant, logged):
    scene = load(integrator, **(NUMBER if others else {"int_ior": 1.5}))
    params, keys = attached(scene, "eta", *others)
    dr.backward(loss(scene, params))
    eta, *rest = (grad(params, key) for key in keys)
    lines = [text for text in logged if "derivative in the index" in text]
    assert np.isfinite(rest).all() and np.all(rest)
    assert np.isfinite(eta) == (integrator not in FIXED) and eta != 0
    assert len(lines) == (integrator in FIXED)
    assert all("refract_path or volpath, or path, which is biased" in line and "\n" not in line for line in lines)


@functools.cache
def derivatives(integrator, name, first):
    """Return the derivatives of eight images with seeds from `first`."""
    scene, gradients = load(integrator, **NUMBER), []
    params, (key,) = attached(scene, name)
    for seed in range(first, first + 8):
        dr.backward(loss(scene, params, 0, 256, seed))
        gradients.append(grad(params, key))
        dr.clear_grad(params[key])
    return np.array(gradients)


@pytest.mark.parametrize("integrator", FIXED)
@pytest.mark.parametrize("name", ["specular_reflectance", "specular_transmittance"])
def test_tints_have_the_derivatives_of_refract_path(integrator, name, llvm_variant):
    """Student's t for 8 seeds of 12² · 256 paths a side; one false alarm in 10⁴ (14 degrees of freedom: 5.36)."""
    ours, theirs = derivatives("refract_path", name, 100), derivatives(integrator, name, 200)
    error = np.sqrt((ours.var(ddof=1) + theirs.var(ddof=1)) / 8)
    assert error < 0.02 * abs(ours.mean())
    assert abs(ours.mean() - theirs.mean()) < 5.36 * error


SHEET = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(np.full((4, 4, 1), 0.6, np.float32))}


@pytest.mark.parametrize("opacity", [None, 0.6, SHEET], ids=["plastic", "mask", "textured mask"])
@pytest.mark.parametrize("name", ["diffuse_reflectance", "specular_reflectance"])
def test_probabilities_of_lobes_are_detached(name, opacity, llvm_variant):
    """`plastic` selects a lobe by its colours. The derivative of an image that is linear in a colour is I(1) − I(0).

    With 12² · 256 paths, of which the lobe gets at least a tenth, 5 % is seven standard deviations.
    """
    plastic = {"type": "plastic", "diffuse_reflectance": 0.4, "specular_reflectance": 0.5}
    ball = {"type": "sphere", "bsdf": {"type": "mask", "opacity": opacity, "b": plastic} if opacity else plastic}
    method = {"type": "refract_path", "max_depth": 2}
    scene = mi.load_dict({"type": "scene", "integrator": method, "view": camera(12, 20), "sky": sky(), "ball": ball})
    params, (key,) = attached(scene, name)
    dr.backward(loss(scene, params, 0, 256))
    backward = grad(params, key)
    dr.set_grad(params[key], 1)
    params.update()
    image = loss(scene, params, 0, 256)
    dr.forward(params[key])
    ends = []
    for value in (0.0, 1.0):
        params[key] = value
        params.update()
        ends.append(vector(loss(scene, params, 0, 256))[0])
    expected = pytest.approx(ends[1] - ends[0], rel=0.05)
    assert backward == expected and vector(dr.grad(image))[0] == expected


def test_a_null_lobe_within_a_mask_is_not_its_opacity(llvm_variant):
    """A thin pane that reflects an even sky before black: the image does not depend on what it transmits."""
    pane = {"type": "thindielectric", "int_ior": 1.5, "ext_ior": 1.0, "specular_transmittance": 0.5}
    masked = {"type": "mask", "opacity": 0.6, "b": pane}
    wall = {"type": "rectangle", "to_world": PLACE().translate([0, 0, -1]).scale(50), "bsdf": BLACK}
    parts = {"pane": {"type": "rectangle", "bsdf": masked}, "wall": wall, "sky": {"type": "constant"}}
    method = {"type": "refract_path", "max_depth": 3}
    scene = mi.load_dict({"type": "scene", "integrator": method, "view": camera(12, 2)} | parts)
    params, (opacity, transmittance) = attached(scene, "opacity.value", "specular_transmittance.value")
    dr.backward(loss(scene, params, 0, 256))
    assert grad(params, opacity) > 0 and abs(grad(params, transmittance)) < 1e-6


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"], indirect=True)
def test_prb_projective_equals_prb_if_no_edge_moves(variant):
    """Its first part equals `prb`, with the same random numbers. It does not support polarised variants."""
    gradients = []
    for integrator in ("prb", "prb_projective"):
        scene = load(integrator, **NUMBER)
        params, (key,) = attached(scene, "specular_transmittance")
        dr.backward(loss(scene, params))
        gradients.append(grad(params, key))
    assert gradients[0] == pytest.approx(gradients[1], rel=1e-4) and gradients[0] != 0


# Frozen --------------------------------------------------------------------------------------------------------------


STEPS = [(NUMBER, {"eta": 1.4}), (NUMBER, {"eta": 1.4, "specular_transmittance": 0.6})]
STEPS += [(TEXTURE, {"color0": 1.35}), (DISPERSIVE, {"int_ior_A": 1.45})]


@pytest.mark.parametrize("integrator", ["refract_path", "path"])
@pytest.mark.parametrize(("glass", "start"), STEPS, ids=["index", "index and tint", "texture", "dispersive"])
def test_a_step_of_an_optimisation_can_be_frozen(glass, start, integrator, llvm_variant):
    """Six steps of Adam give the same numbers in `dr.freeze` and without it, up to the order of sums."""
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
            trace.append([vector(adam[key])[0] for key in adam])
        assert not freeze or step.n_recordings <= 3
        return np.array(trace)

    frozen, plain = optimise(True), optimise(False)
    assert frozen == pytest.approx(plain, abs=2e-3)
    assert np.ptp(plain, axis=0).min() > 0.01


def test_an_invalid_index_loses_its_light_in_a_frozen_step(llvm_variant):
    scene = load("refract_path", int_ior=1.5)
    params = mi.traverse(scene)
    key = parameter(params, "eta")

    @dr.freeze
    def image(params, value):
        params[key] = value
        params.update()
        return mi.render(scene, params, spp=4, seed=1)

    valid = [image(params, mi.Float(x)) for x in (1.5, 1.4, 1.3)][-1]
    assert np.isfinite(valid).all()
    middle = np.array(image(params, mi.Float(-1.0)))[6, 6]
    assert np.isnan(middle).all() or (middle == 0).all()


# Parameters of glass, one of them, and a new value for it.
GLASSES = {
    "a number": ({"int_ior": 1.5}, ".eta", 1.3),
    "a dispersive medium": ({"int_ior": "cauchy(1.5, 4000)"}, "int_ior_A", 1.3),
    "a texture": (TEXTURE, "int_ior.color0.value", 1.5),
    "absorption": ({"int_ior": 1.5, "int_absorption": 0.5}, "absorption.value", 2.0),
    "a colour": ({"int_ior": 1.5, "int_colour": 0.5, "int_colour_distance": 1.0}, "colour.value", 0.9),
    "a tint": ({"int_ior": 1.5, "specular_transmittance": 0.5}, "transmittance.value", 0.9),
}
INTEGRATORS = ("path", "refract_path")
ABSORBING = ("absorption", "a colour")  # not supported by `path`


def walled(parameters, integrator):
    tiles = {"type": "checkerboard", "to_uv": PLACE().scale([8, 4, 1])}
    wall = {"type": "rectangle", "to_world": PLACE().translate([0, 0, -2]).scale(3)}
    wall |= {"bsdf": {"type": "diffuse", "reflectance": tiles}}
    glass = {"type": "sphere", "bsdf": {"type": "refract", "ext_ior": 1.0} | parameters}
    return glass_ball(integrator={"type": integrator, "rr_depth": 100}, sky={"type": "constant"}, wall=wall, ball=glass)


def recorded(scene):
    @dr.freeze
    def image(params, seed):
        return mi.render(scene, params, spp=4, seed=seed)

    return image


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("glass", GLASSES)
def test_a_frozen_render_equals_a_new_trace_also_after_an_edit(glass, integrator, llvm_variant, no_collection):
    """Another scene in memory has another glass. `path` renders "a number" with absorbing glass in that scene."""
    (parameters, name, value), kinds = GLASSES[glass], [*GLASSES]
    others = GLASSES[kinds[kinds.index(glass) - 1]][0]
    if glass in ABSORBING and integrator == "path":
        others, (parameters, name, value) = parameters, GLASSES["a number"]
    scene, other = walled(parameters, integrator), walled(others, "refract_path")
    params, image, before = mi.traverse(scene), recorded(scene), None
    key = parameter(params, name)
    for seed in range(4):
        if seed == 2:
            params[key] = type(params[key])(value)
            params.update()
        replayed = np.array(image(params, dr.opaque(mi.UInt32, seed)))
        traced = np.array(mi.render(scene, spp=4, seed=mi.UInt32(seed)))
        assert replayed == pytest.approx(traced, abs=1e-5), seed
        assert seed != 2 or np.abs(replayed - before).max() > 0.05
        before = replayed
    assert image.n_recordings <= 3  # by then Dr.Jit knows what varies, and the integrator which features are needed
    del other


@pytest.mark.parametrize("split_depth", [0, 2])
def test_a_frozen_render_follows_edits_of_index_and_reflectance(split_depth, llvm_variant, no_collection):
    """A recording must be valid for any value: the black surface of a lamp counts as one that may reflect."""
    lamp = {"type": "rectangle", "to_world": PLACE().translate([0, 0, -2]).scale(9)}
    method = {"type": "refract_path", "max_depth": 5, "rr_depth": 100, "split_depth": split_depth}
    scene = glass_ball(integrator=method, sky=sky(), lamp=lamp | {"emitter": {"type": "area"}, "bsdf": BLACK})
    params, before, image = mi.traverse(scene), None, recorded(scene)
    for name, value in ((".eta", 1.5), (".eta", 1.3), ("reflectance.value", 0.8), (".eta", 1.7)):
        key = parameter(params, name)
        params[key] = type(params[key])(value)
        params.update()
        mean = np.mean([np.array(image(params, dr.opaque(mi.UInt32, seed))).mean() for seed in range(4)])
        # Without a recording a black lamp needs no emitter samples: other random numbers, the same mean.
        traced = [np.array(mi.render(scene, spp=4, seed=seed)).mean() for seed in range(4)]
        assert mean == pytest.approx(np.mean(traced), rel=0.01)
        assert before is None or abs(mean / before - 1) > 0.002
        before = mean
    assert image.n_recordings <= 2


@pytest.mark.parametrize("weights", [(1.0,), (1.0, 0.0, 3.0)])
def test_lamps_in_an_even_sky_can_be_frozen(weights, llvm_variant, no_collection):
    parts = {"wall": {"type": "rectangle", "to_world": PLACE().translate([0, 0, -2]).scale(9)}}
    for i, weight in enumerate(weights):
        emitter = {"type": "area", "radiance": 1.0 + i, "sampling_weight": weight}
        where = PLACE().translate([2 * i - 2, 2, 1]).rotate([0, 1, 0], 180).scale(0.5)
        parts[f"lamp {i}"] = {"type": "rectangle", "to_world": where, "emitter": emitter}
    scene = glass_ball(8, integrator={"type": "refract_path", "max_depth": 4}, sky={"type": "constant"}, **parts)
    params, image = mi.traverse(scene), recorded(scene)
    for seed in range(3):
        frozen = np.array(image(params, dr.opaque(mi.UInt32, seed)))
        assert frozen == pytest.approx(np.array(mi.render(scene, spp=4, seed=mi.UInt32(seed))), abs=1e-5)


@pytest.mark.parametrize(
    ("parts", "warning"),
    [
        ({"interior": {"type": "homogeneous", "albedo": 0.5, "sigma_t": 2.0}}, "whether a medium scatters"),
        ({"bsdf": GLASS | {"ext_absorption": 0.5}}, "whether absorption is consistent"),
    ],
    ids=["medium", "absorption"],
)
def test_a_frozen_render_says_what_it_cannot_tell(parts, warning, llvm_variant, no_collection, logged):
    ball = {"type": "sphere", "bsdf": GLASS} | parts
    scene = glass_ball(8, integrator={"type": "refract_path", "max_depth": 8}, sky={"type": "constant"}, ball=ball)
    recorded(scene)(mi.traverse(scene), dr.opaque(mi.UInt32, 0))
    assert sum(f"a frozen function cannot tell {warning}" in text for text in logged) == 1
