"""Light loses exp(−σ t) along every leg of a path, in the medium that it is in; what contradicts itself is refused."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import GLASS, camera, equal_means, parameter
from support.glass_scenes import refusal as refused
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
CHANCE = {"deterministic": False, "split_weight": 1e-2}
CLEAR = {"type": "homogeneous", "albedo": 0.0, "sigma_t": 0.7}


def matched(**parameters):
    return GLASS | {"int_ior": 1.0} | parameters


def box(bsdf, thickness=THICKNESS, z=0.0, **more):
    place = PLACE().translate([0, 0, z]).scale([20, 20, thickness / 2])
    return {"type": "cube", "to_world": place, "bsdf": bsdf} | more


def sheet(bsdf, z):
    return {"type": "rectangle", "to_world": PLACE().translate([0, 0, z]).scale(20), "bsdf": bsdf}


def grouped(**parts):
    """An instance of a group of these."""
    group = {"type": "shapegroup", "id": "g"} | parts
    return {"group": group, "instance": {"type": "instance", "group": {"type": "ref", "id": "g"}}}


def scene(height=5.0, sensor=None, light=None, integrator=None, **parts):
    """One pixel whose rays go down along the z axis, towards light from everywhere."""
    eye = camera(1, kind="orthographic", component_format="float32")
    eye["to_world"] = PLACE().look_at([0.1, 0.2, height], [0.1, 0.2, height - 1], [0, 1, 0]).scale(1e-3)
    method = {"type": "refract_path", "deterministic": True, "split_weight": 1 / 4096} | (integrator or {})
    whole = {"type": "scene", "sensor": eye | {"near_clip": 1e-3} | (sensor or {}), "integrator": method}
    return mi.load_dict(whole | {"light": light or {"type": "constant"}} | parts)


def radiance(*arguments, spp=1, **parts):
    image = np.array(mi.render(scene(*arguments, **parts), spp=spp), dtype=float).ravel()
    return image[:3] if not mi.is_monochromatic else image[:1]


def refusal(*arguments, **parts):
    return refused(radiance, *arguments, **parts)


def white():
    """What light of equal power at all wavelengths is in the film."""
    return radiance(spp=4096 if mi.is_spectral else 1)


# What is left of the light ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bsdf", "left"),
    [
        ({"int_absorption": 0.0}, 1.0),
        ({"int_absorption": 0.3}, math.exp(-0.3 * THICKNESS)),
        ({"int_absorption": 40.0}, math.exp(-40.0 * THICKNESS)),
        ({"int_absorption": {"type": "rgb", "value": [0.1, 0.5, 2.0]}}, np.exp(np.array([-0.1, -0.5, -2]) * THICKNESS)),
        ({"int_colour": 0.25, "int_colour_distance": 1.0}, 0.25**THICKNESS),
    ],
    ids=str,
)
def test_what_a_slab_leaves_is_exp_of_minus_sigma_d(bsdf, left, rgb_variant):
    assert radiance(slab=box(matched(**bsdf))) == pytest.approx(left, rel=1e-5, abs=1e-30)


def test_in_glass_each_reflection_goes_to_and_fro(rgb_variant):
    """R + T² a/(1 − R a), a = exp(−σ d), with R and T of normal incidence."""
    sigma, r = 0.3, 0.04
    a = math.exp(-sigma * THICKNESS)
    found = radiance(slab=box(GLASS | {"int_absorption": sigma}))
    assert found == pytest.approx(r + (1 - r) ** 2 * a / (1 - r * a), abs=1e-4)  # 1/4096 of some paths is dropped


def test_in_spectral_variants_it_is_the_sigma_of_the_wavelength(spectral_variant):
    if not dr.is_jit_v(mi.Float):
        pytest.skip("a scalar variant would render for minutes")
    found = radiance(slab=box(matched(int_absorption=0.4)), spp=4096)
    assert found == pytest.approx(white() * math.exp(-0.4 * THICKNESS), rel=1e-5)


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


@pytest.mark.parametrize(
    "inside",
    [
        {"integrator": {"camera_absorption": 0.7}},
        {"integrator": {"camera_colour": math.exp(-0.7), "camera_colour_distance": 1.0}},
        {"sensor": {"medium": CLEAR}},
    ],
    ids=str,
)
def test_a_camera_inside_says_so(inside, rgb_variant):
    assert radiance(0.5, slab=box(matched(int_absorption=0.7)), **inside) == pytest.approx(math.exp(-1.05), rel=1e-5)


def test_a_medium_that_scatters_is_refused(rgb_variant):
    said = refusal(0.5, {"medium": CLEAR | {"albedo": 0.5}}, slab=box(matched(int_absorption=0.7)))
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


@pytest.mark.parametrize(
    "light",
    [
        {"type": "constant"},
        {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))},
        {"type": "directional", "direction": [0, 0, -1]},
    ],
    ids=lambda light: light["type"],
)
def test_light_from_without_end_leaves_an_absorbing_world(light, rgb_variant):
    """Within a medium that has no end nothing comes from the sky: not along the ray, and not to a matt floor."""
    assert radiance(light=light, integrator={"camera_absorption": 0.1}) == pytest.approx(0, abs=1e-30)
    floor = sheet({"type": "diffuse"}, -1)
    method = {"deterministic": False, "split_weight": 1e-2, "camera_absorption": 0.1}
    assert radiance(light=light, floor=floor, integrator=method) == pytest.approx(0, abs=1e-30)


# Contradictions -----------------------------------------------------------------------------------------------


def test_a_camera_inside_that_says_nothing_is_refused(rgb_variant):
    said = refusal(0.5, slab=box(matched(int_absorption=0.7), id="aquarium"))
    assert "refract_path: inconsistent absorption at 'aquarium': the medium that light arrives in differs from" in said
    assert said.endswith("expected camera_absorption, or the sensor's medium, as the camera's surroundings absorb; "
                         "ext_absorption (or ext_colour) as the medium around it absorbs")  # fmt: skip


def test_a_neighbour_that_says_something_else_is_refused_by_name(rgb_variant):
    parts = {"outer": box(matched(int_absorption=0.2), id="outer"), "inner": box(matched(), 0.5, id="inner")}
    said = refusal(**parts)
    assert "inconsistent absorption at 'inner': the medium that light arrives in differs" in said
    assert "expected ext_absorption (or ext_colour) as the medium around it absorbs" in said


def test_within_a_wrapper_absorption_is_refused(rgb_variant):
    wrapped = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    radiance(slab=box(matched(int_absorption=0.2)), wall=sheet(wrapped, -4), integrator=CHANCE)
    mask = {"type": "mask", "opacity": 0.5, "bsdf": matched(int_absorption=0.2)}
    for parts in ({"slab": box(mask, id="masked")}, grouped(slab=box(mask, id="masked"))):
        said = refusal(**parts, integrator=CHANCE)
        assert "refract_path: 'masked' has an absorbing BSDF within a MaskBSDF" in said
        assert said.endswith("expected absorption of the shape's own BSDF")


@pytest.mark.parametrize(
    ("crossed", "wrong", "contradicts"),
    [(1, 1, True), (2, 1, True), (9, 2, False), (9, 3, True), (10_000, 99, False), (10_000, 101, True), (5, 0, False)],
)
def test_few_rays_beside_an_edge_are_no_contradiction(crossed, wrong, contradicts, scalar_variant):
    made = scene(slab=box(matched()))
    crossings = medium_tracking.Crossings(mi.scalar_rgb, made)
    for i in range(crossed):
        crossings.add(made.shapes()[0], 1, True, i < wrong, False)
    if contradicts:
        assert "inconsistent absorption at 'slab': " in refused(crossings.refuse)
    else:
        crossings.refuse()


def test_three_media_may_meet_at_an_edge(llvm_variant):
    """A tumbler of water: next to its rim one ray in 30,000 misses a boundary."""
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
        assert f"inconsistent absorption at '{named}': " in refused(mi.render, made, spp=16)


# Derivatives --------------------------------------------------------------------------------------------------


def test_the_image_has_a_derivative_in_sigma(llvm_variant):
    """d/dσ exp(−σ d) = −d exp(−σ d)."""
    made = scene(slab=box(matched(int_absorption=0.3)), integrator=CHANCE)
    parameters = mi.traverse(made)
    key = parameter(parameters, "int_absorption.value")
    dr.enable_grad(parameters[key])
    parameters.update()
    dr.backward(dr.mean(mi.render(made, parameters, spp=4), axis=None))
    assert float(dr.grad(parameters[key]).array[0]) == pytest.approx(-THICKNESS * math.exp(-0.3 * THICKNESS), rel=1e-4)


# Ways and media that were left out ------------------------------------------------------------------------------


@pytest.mark.parametrize("height", [0.5, 1, 2.5, 4])
def test_the_way_to_a_hidden_lamp_is_absorbed_too(height, rgb_variant):
    """From z = 5 in a medium that ends at a boundary at 0.4, past a lamp that lets light through, to the sky."""
    lamp = sheet({"type": "null"}, 5 - height) | {"emitter": {"type": "area"}}
    end = sheet(matched(ext_absorption=1.0), 0.4)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))}
    for hide in (False, True):
        method = CHANCE | {"camera_absorption": 1.0, "hide_emitters": hide}
        found = radiance(lamp=lamp, end=end, light=sky, integrator=method, spp=4)
        assert found == pytest.approx(math.exp(-4.6) + (not hide) * math.exp(-height), rel=1e-3)


@pytest.mark.parametrize("near", [1e-3, 0.3, 0.9])
@pytest.mark.parametrize("kind", ["orthographic", "perspective"])
def test_the_way_to_the_near_plane_is_absorbed_too(kind, near, rgb_variant):
    """In a medium of σ = 0.7 whose end is 5 units away."""
    view = PLACE().look_at([0.1, 0.2, 2], [0.1, 0.2, 1], [0, 1, 0])
    lens = {"to_world": view, "fov": 0.01} if kind == "perspective" else {"to_world": view.scale([0.01, 0.01, 1])}
    sensor = {"type": kind, "near_clip": near} | lens
    found = radiance(sensor=sensor, slab=box(matched(int_absorption=0.7), 6.0), integrator={"camera_absorption": 0.7})
    assert found == pytest.approx(math.exp(-0.7 * 5), rel=1e-4)


def test_a_medium_of_a_shape_is_absorption(rgb_variant):
    """Tinted glass as other scenes have it: a boundary with a medium that does not scatter, and one of `null`."""
    expected = math.exp(-0.7 * THICKNESS)
    assert radiance(slab=box(matched(), interior=CLEAR)) == pytest.approx(expected, rel=1e-5)
    assert radiance(slab=box({"type": "null"}, interior=CLEAR), integrator=CHANCE) == pytest.approx(expected, rel=1e-5)
    ball = box(matched(), 0.5)  # of glass that says nothing, in the medium: as for `volpath` it is filled with it
    assert radiance(slab=box(matched(), interior=CLEAR), ball=ball) == pytest.approx(expected, rel=1e-5)
    inside = radiance(0.5, {"medium": CLEAR}, slab=box(matched(), interior=CLEAR))
    assert inside == pytest.approx(math.exp(-0.7 * 1.5), rel=1e-5)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_spectral_polarized"])
def test_tinted_glass_is_that_of_volpath(variant, needs_variant):
    """By independent renders, one false alarm in 10,000 for each colour."""
    needs_variant(variant)
    switch(variant)
    tint = {"type": "homogeneous", "albedo": 0.0, "sigma_t": {"type": "rgb", "value": [0.2, 0.5, 1.0]}}
    made = scene(slab=box(GLASS, interior=tint), integrator=CHANCE)
    renders = []
    for seed, method in enumerate(({"type": "refract_path", "split_depth": 2}, {"type": "volpath", "max_depth": 64})):
        integrator = mi.load_dict(method)
        shots = [mi.render(made, integrator=integrator, spp=4096, seed=8 * seed + i) for i in range(8)]
        renders.append(np.array([np.array(shot).ravel()[:3] for shot in shots], dtype=float))
    assert all(equal_means(renders[1][:, [i]], renders[0][:, [i]]) for i in range(3))
    assert renders[1].max() > 0.1


@pytest.mark.parametrize(
    ("medium", "bsdf", "said"),
    [
        (CLEAR | {"albedo": 0.5}, matched(), "the interior medium of 'slab' scatters or varies"),
        (
            {"type": "heterogeneous", "albedo": 0.0, "sigma_t": {"type": "constvolume", "value": 1.0}},
            matched(),
            "varies",
        ),
        (CLEAR, matched(int_absorption=0.7), "'slab' has an interior medium in a scene whose BSDFs absorb"),
    ],
)
def test_a_medium_that_is_not_followed_is_refused_by_name(medium, bsdf, said, rgb_variant):
    slab = box(bsdf, interior=medium, id="slab")
    assert said in refusal(slab=slab, integrator=CHANCE)
    assert said in refusal(**grouped(slab=slab), integrator=CHANCE)


@pytest.mark.parametrize(
    ("at", "thickness", "stepped_over"), [(12, 1e-3, True), (50, 4e-3, True), (12, 4e-3, False), (0, 1e-3, False)]
)
def test_a_sheet_that_rays_step_over_is_refused(at, thickness, stepped_over, rgb_variant):
    """Mitsuba starts a ray 9e-5 of (1 + the largest coordinate) beside the surface that it left."""
    pane = box(matched(int_absorption=100.0), thickness, at, id="pane")
    if stepped_over:
        assert "'pane' absorbs, and is so thin that rays miss one of its sides" in refusal(at + 5.0, pane=pane)
    else:
        assert radiance(at + 5.0, pane=pane) == pytest.approx(math.exp(-100 * thickness), rel=2e-2)


@pytest.mark.parametrize("order", [("inner", "outer", "far"), ("far", "inner", "outer"), ("outer", "far", "inner")])
def test_shapes_without_names_are_told_apart(order, rgb_variant):
    """Glass of water whose inner wall does not say what the outer one says; a ball far away is no witness."""
    ball = '<shape type="sphere">{}<bsdf type="refract">{}</bsdf></shape>'
    parts = {
        "inner": ball.format('<float name="radius" value="0.5"/>', ""),
        "outer": ball.format("", '<float name="int_absorption" value="1"/>'),
        "far": ball.format('<point name="center" x="9" y="0" z="0"/>', ""),
    }
    film = '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>'
    look = '<transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>'
    made = mi.load_string(
        f'<scene version="3.0.0"><integrator type="refract_path"/><sensor type="perspective">{film}{look}</sensor>'
        f'{"".join(map(parts.get, order))}<emitter type="constant"/></scene>'
    )
    assert "(Sphere): the medium that light arrives in differs from" in refused(mi.render, made, spp=16)


@pytest.mark.parametrize("around", [{"type": "moment"}, {"type": "aov", "aovs": "d:depth"}], ids=str)
def test_contradictions_are_refused_within_another_integrator(around, rgb_variant):
    made = scene(0.5, slab=box(matched(int_absorption=0.7), id="aquarium"))
    method = mi.load_dict(around | {"inner": {"type": "refract_path"}})
    assert "inconsistent absorption at 'aquarium': " in refused(mi.render, made, integrator=method, spp=4)
