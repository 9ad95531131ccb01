"""Light loses exp(−σ t) along every leg of a path, in the medium that it is in; what contradicts itself is refused."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.variants import switch

from mi_refract.plugins import medium_tracking
from validation.run.context import SCENES

EXTERIOR = '<float name="ext_absorption" value="0.1"/>'
TUMBLER = {  # of `nested.xml`: what follows the indices of glass in air, glass in water, and water in air
    '<string name="ext_ior" value="air"/>': '<float name="int_absorption" value="0.5"/>',
    '<string name="ext_ior" value="water"/>': f'<float name="int_absorption" value="0.5"/>{EXTERIOR}',
    '<string name="int_ior" value="water"/>': '<float name="int_absorption" value="0.1"/>',
}
THICKNESS = 2.0
PLACE = mi.ScalarTransform4f


def glass(**parameters):
    return {"type": "refract", "int_ior": 1.5, "ext_ior": 1.0} | parameters


def matched(**parameters):
    return glass(int_ior=1.0) | parameters


def box(bsdf, thickness=THICKNESS, z=0.0, **more):
    place = PLACE().translate([0, 0, z]).scale([20, 20, thickness / 2])
    return {"type": "cube", "to_world": place, "bsdf": bsdf} | more


def sheet(bsdf, z):
    return {"type": "rectangle", "to_world": PLACE().translate([0, 0, z]).scale(20), "bsdf": bsdf}


def scene(camera=5.0, sensor=None, light=None, integrator=None, **parts):
    """One pixel whose rays go down along the z axis, towards light from everywhere."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "component_format": "float32"}
    eye = {"type": "orthographic", "near_clip": 1e-3, "film": film | {"pixel_format": "rgb"}}
    eye["to_world"] = PLACE().look_at([0.1, 0.2, camera], [0.1, 0.2, camera - 1], [0, 1, 0]).scale(1e-3)
    method = {"type": "refract_path", "deterministic": True, "split_weight": 1 / 4096} | (integrator or {})
    whole = {
        "type": "scene",
        "sensor": eye | (sensor or {}),
        "integrator": method,
        "light": light or {"type": "constant"},
    }
    return mi.load_dict(whole | parts)


def radiance(*arguments, spp=1, **parts):
    image = np.array(mi.render(scene(*arguments, **parts), spp=spp), dtype=float).ravel()
    return image[:3] if not mi.is_monochromatic else image[:1]


def white():
    """What light of equal power at all wavelengths is in the film."""
    return radiance(spp=4096 if mi.is_spectral else 1)


# What is left of the light ------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0, 0.3, 4.0, 40.0])
def test_what_a_slab_leaves_is_exp_of_minus_sigma_d(sigma, rgb_variant):
    found = radiance(slab=box(matched(int_absorption=sigma)))
    assert found == pytest.approx(math.exp(-sigma * THICKNESS), rel=4e-6, abs=1e-30)


def test_in_glass_each_reflection_goes_to_and_fro(rgb_variant):
    """R + T² a/(1 − R a), a = exp(−σ d), with R and T of normal incidence."""
    sigma, r = 0.3, 0.04
    a = math.exp(-sigma * THICKNESS)
    found = radiance(slab=box(glass(int_absorption=sigma)))
    assert found == pytest.approx(r + (1 - r) ** 2 * a / (1 - r * a), abs=1e-4)  # 1/4096 of some paths is dropped


def test_each_wavelength_and_colour_has_its_own_sigma(rgb_variant):
    sigma = np.array([0.1, 0.5, 2.0])
    found = radiance(slab=box(matched(int_absorption={"type": "rgb", "value": sigma.tolist()})))
    assert found == pytest.approx(np.exp(-sigma * THICKNESS), rel=4e-6)


def test_in_spectral_variants_it_is_the_sigma_of_the_wavelength(spectral_variant):
    if not dr.is_jit_v(mi.Float):
        pytest.skip("a scalar variant would render for minutes")
    found = radiance(slab=box(matched(int_absorption=0.4)), spp=4096)
    assert found == pytest.approx(white() * math.exp(-0.4 * THICKNESS), rel=1e-5)


def test_a_colour_is_what_is_left_after_its_distance(rgb_variant):
    found = radiance(slab=box(matched(int_colour=0.25, int_colour_distance=1.0)))
    assert found == pytest.approx(0.25**THICKNESS, rel=1e-5)


def test_nested_media_count_for_the_way_in_each(rgb_variant):
    """An inner slab of 0.5 within one of 2."""
    outer = box(matched(int_absorption=0.2))
    inner = box(matched(int_absorption=0.9, ext_absorption=0.2), 0.5)
    assert radiance(outer=outer, inner=inner) == pytest.approx(math.exp(-0.2 * 1.5 - 0.9 * 0.5), rel=1e-5)


def test_touching_media_share_a_boundary(rgb_variant):
    """Three sheets: air, σ = 0.2 for a way of 1, σ = 0.9 for 1, air. A sheet's inside is below it."""
    parts = {
        "top": sheet(matched(int_absorption=0.2), 1),
        "middle": sheet(matched(int_absorption=0.9, ext_absorption=0.2), 0),
        "bottom": sheet(matched(ext_absorption=0.9), -1),
    }
    assert radiance(**parts) == pytest.approx(math.exp(-1.1), rel=1e-5)


def test_a_camera_inside_says_so(rgb_variant):
    slab = box(matched(int_absorption=0.7))
    for inside in ({"camera_absorption": 0.7}, {"camera_colour": math.exp(-0.7), "camera_colour_distance": 1.0}):
        assert radiance(0.5, slab=slab, integrator=inside) == pytest.approx(math.exp(-0.7 * 1.5), rel=1e-5)


def test_a_camera_inside_may_have_a_medium(rgb_variant):
    medium = {"type": "homogeneous", "albedo": 0.0, "sigma_t": 0.7}
    found = radiance(0.5, {"medium": medium}, slab=box(matched(int_absorption=0.7)))
    assert found == pytest.approx(math.exp(-0.7 * 1.5), rel=1e-5)


def test_a_medium_that_scatters_is_refused(rgb_variant):
    medium = {"type": "homogeneous", "albedo": 0.5, "sigma_t": 0.7}
    said = refusal(camera=0.5, sensor={"medium": medium}, slab=box(matched(int_absorption=0.7)))
    assert said.endswith("the sensor's medium scatters or varies; expected a homogeneous medium with an albedo of 0")


def test_on_the_way_to_a_lamp_inside_light_is_absorbed(rgb_variant):
    """A matt floor, a lamp that is a point, and the camera, all within: to the floor and from it."""
    sigma, height = 0.7, 0.4
    point = {"type": "point", "position": [0.1, 0.2, -0.9 + height], "intensity": 1.0}
    floor = {"type": "rectangle", "to_world": PLACE().translate([0, 0, -0.9]), "bsdf": {"type": "diffuse"}}
    method = {"deterministic": False, "split_weight": 1e-2, "camera_absorption": sigma, "max_depth": 2}
    slab = box(matched(int_absorption=sigma))
    found = radiance(0.5, light=point, slab=slab, floor=floor, integrator=method, spp=64)
    way = 1.4 + height
    assert found == pytest.approx(0.5 / math.pi / height**2 * math.exp(-sigma * way), rel=1e-3)


def test_light_from_without_end_leaves_an_absorbing_world(rgb_variant):
    """Within a medium that has no end nothing comes from the sky."""
    assert radiance(light={"type": "constant"}, integrator={"camera_absorption": 0.1}) == pytest.approx(0, abs=1e-30)


# Contradictions -----------------------------------------------------------------------------------------------


def refusal(**parts):
    """The error that others have been raised from: Dr.Jit wraps what is raised within an operation."""
    with pytest.raises((ValueError, RuntimeError)) as caught:
        radiance(**parts)
    error = caught.value
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error)


def test_a_camera_inside_that_says_nothing_is_refused(rgb_variant):
    said = refusal(camera=0.5, slab=box(matched(int_absorption=0.7), id="aquarium"))
    assert "refract_path: light comes to 'aquarium' through another absorption than its BSDF says" in said
    assert said.endswith("accepted: camera_absorption, or the sensor's medium, as the camera's surroundings absorb; "
                         "ext_absorption (or ext_colour) as the medium around it absorbs")  # fmt: skip


def test_a_neighbour_that_says_something_else_is_refused_by_name(rgb_variant):
    parts = {"outer": box(matched(int_absorption=0.2), id="outer"), "inner": box(matched(), 0.5, id="inner")}
    said = refusal(**parts)
    assert "light comes to 'inner' through another" in said
    assert "accepted: ext_absorption (or ext_colour) as the medium around it absorbs" in said


def test_within_a_wrapper_absorption_is_refused(rgb_variant):
    wrapped = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    method = {"deterministic": False, "split_weight": 1e-2}
    radiance(slab=box(matched(int_absorption=0.2)), wall=sheet(wrapped, -4), integrator=method)
    mask = {"type": "mask", "opacity": 0.5, "bsdf": matched(int_absorption=0.2)}
    said = refusal(slab=box(mask, id="masked"), integrator=method)
    assert "refract_path: 'masked' has an absorbing BSDF within a MaskBSDF" in said
    assert said.endswith("accepted: absorption of the shape's own BSDF")


@pytest.mark.parametrize(
    ("crossed", "wrong", "refused"),
    [(1, 1, True), (2, 1, True), (9, 2, False), (9, 3, True), (10_000, 99, False), (10_000, 101, True), (5, 0, False)],
)
def test_few_rays_beside_an_edge_are_no_contradiction(crossed, wrong, refused):
    assert medium_tracking._contradicts(crossed, wrong) == refused


def test_three_media_may_meet_at_an_edge(needs_variant):
    """A tumbler of water: next to its rim one ray in 30,000 misses a boundary."""
    needs_variant("llvm_ad_rgb")
    switch("llvm_ad_rgb")
    text = (SCENES / "nested.xml").read_text()
    for side, sigma in TUMBLER.items():
        assert side in text
        text = text.replace(side, f"{side}{sigma}", 1)
    for count, named in ((1, "tumbler_wet"), (0, "")):
        found = text.replace(EXTERIOR, "") if count else text
        made = mi.load_string(
            found.replace('value="meshes', f'value="{SCENES}/meshes'), res=64, integrator="refract_path"
        )
        if not named:
            assert np.isfinite(np.array(mi.render(made, spp=256))).all()
            continue
        with pytest.raises(RuntimeError) as caught:
            mi.render(made, spp=16)
        assert f"light comes to '{named}'" in str(caught.value.__cause__)


# Derivatives --------------------------------------------------------------------------------------------------


def test_the_image_has_a_derivative_in_sigma(needs_variant):
    """d/dσ exp(−σ d) = −d exp(−σ d)."""
    needs_variant("llvm_ad_rgb")
    switch("llvm_ad_rgb")
    made = scene(slab=box(matched(int_absorption=0.3)), integrator={"deterministic": False, "split_weight": 1e-2})
    parameters = mi.traverse(made)
    (key,) = [key for key in parameters.keys() if "int_absorption" in key]  # noqa: SIM118
    dr.enable_grad(parameters[key])
    parameters.update()
    dr.backward(dr.mean(mi.render(made, parameters, spp=4), axis=None))
    assert float(dr.grad(parameters[key]).array[0]) == pytest.approx(-THICKNESS * math.exp(-0.3 * THICKNESS), rel=1e-4)
