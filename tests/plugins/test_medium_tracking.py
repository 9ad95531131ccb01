"""Absorption along paths: exp(−σ t) on every segment, with σ of the right medium; inconsistent scenes are errors."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import GLASS, PLACE, attached, camera, equal_means, refusal, rgb

from mi_refract.plugins import medium_tracking
from validation.run.context import SCENES

THICKNESS = 2.0
CHANCE = {"deterministic": False, "split_weight": 1e-2}
CLEAR = {"type": "homogeneous", "albedo": 0.0, "sigma_t": 0.7}
WHITE = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((4, 8, 3), np.float32))}


def matched(**parameters):
    return GLASS | {"int_ior": 1.0} | parameters


def box(bsdf, thickness=THICKNESS, z=0.0, **parameters):
    to_world = PLACE().translate([0, 0, z]).scale([20, 20, thickness / 2])
    return {"type": "cube", "to_world": to_world, "bsdf": bsdf} | parameters


def sheet(bsdf, z):
    return {"type": "rectangle", "to_world": PLACE().translate([0, 0, z]).scale(20), "bsdf": bsdf}


def grouped(**parts):
    """Return an instance of a shape group of `parts`."""
    group = {"type": "shapegroup", "id": "g"} | parts
    return {"group": group, "instance": {"type": "instance", "group": {"type": "ref", "id": "g"}}}


def scene(height=5.0, sensor=None, light=None, integrator=None, **parts):
    """Return a scene with one pixel, whose rays go down along the z axis, in a constant environment by default."""
    view = camera(1, kind="orthographic", component_format="float32") | {"near_clip": 1e-3}
    view["to_world"] = PLACE().look_at([0.1, 0.2, height], [0.1, 0.2, height - 1], [0, 1, 0]).scale(1e-3)
    method = {"type": "refract_path", "deterministic": True, "split_weight": 1 / 4096} | (integrator or {})
    common = {"type": "scene", "sensor": view | (sensor or {}), "integrator": method}
    return mi.load_dict(common | {"light": light or {"type": "constant"}} | parts)


def radiance(*arguments, spp=1, **parts):
    image = np.array(mi.render(scene(*arguments, **parts), spp=spp), dtype=float).ravel()
    return image[:3] if not mi.is_monochromatic else image[:1]


def refused(*arguments, **parts):
    return refusal(radiance, *arguments, **parts)


# What is left of the light ------------------------------------------------------------------------------------

INNER = box(matched(int_absorption=0.9, ext_absorption=0.2), 0.5)
FILLED = box(matched(), interior=CLEAR)  # tinted glass as other scenes have it, by a medium that does not scatter
INSIDE = {"slab": box(matched(int_absorption=0.7))}
SHEETS = {  # air, σ = 0.2 along 1, σ = 0.9 along 1, air; a sheet's inside is below it
    "top": sheet(matched(int_absorption=0.2), 1),
    "middle": sheet(matched(int_absorption=0.9, ext_absorption=0.2), 0),
    "bottom": sheet(matched(ext_absorption=0.9), -1),
}
LEFT = {
    "none": ({"slab": box(matched(int_absorption=0.0))}, 0),
    "0.3": ({"slab": box(matched(int_absorption=0.3))}, 0.3 * THICKNESS),
    "40": ({"slab": box(matched(int_absorption=40.0))}, 40.0 * THICKNESS),
    "colours": ({"slab": box(matched(int_absorption=rgb(0.1, 0.5, 2.0)))}, np.array([0.1, 0.5, 2.0]) * THICKNESS),
    "colour": ({"slab": box(matched(int_colour=0.25, int_colour_distance=1.0))}, THICKNESS * math.log(4)),
    "nested media": ({"outer": box(matched(int_absorption=0.2)), "inner": INNER}, 0.2 * 1.5 + 0.9 * 0.5),
    "touching media": (SHEETS, 1.1),
    "camera inside, σ": (INSIDE | {"height": 0.5, "integrator": {"camera_absorption": 0.7}}, 1.05),
    "camera inside, colour": (
        INSIDE | {"height": 0.5, "integrator": {"camera_colour": math.exp(-0.7), "camera_colour_distance": 1.0}},
        1.05,
    ),
    "camera inside, medium": (INSIDE | {"height": 0.5, "sensor": {"medium": CLEAR}}, 1.05),
    "medium of a shape": ({"slab": FILLED}, 0.7 * THICKNESS),
    "medium within null": ({"slab": box({"type": "null"}, interior=CLEAR), "integrator": CHANCE}, 0.7 * THICKNESS),
    # A ball of glass in the medium that declares none: as in `volpath` the medium fills it.
    "glass in a medium": ({"slab": FILLED, "ball": box(matched(), 0.5)}, 0.7 * THICKNESS),
    "medium, camera inside": ({"height": 0.5, "sensor": {"medium": CLEAR}, "slab": FILLED}, 1.05),
}


@pytest.mark.parametrize("case", LEFT)
def test_a_slab_transmits_exp_of_minus_sigma_d(case, rgb_variant):
    parts, depth = LEFT[case]
    assert radiance(**parts) == pytest.approx(np.exp(-np.array(depth)), rel=1e-5, abs=1e-30)


def test_the_medium_of_a_sensor_outside_the_scene_counts(rgb_variant):
    wall = {"type": "rectangle", "emitter": {"type": "area", "radiance": 1.0}}
    apart = mi.load_dict({"type": "scene", "integrator": {"type": "refract_path"}, "wall": wall})
    clear, opaque = (mi.load_dict(camera(1, 1, (0, 0, 2)) | {"medium": medium}) for medium in (CLEAR, SCATTERS))
    assert np.array(mi.render(apart, sensor=clear, spp=4)) == pytest.approx(math.exp(-1.4), rel=1e-3)
    assert "the sensor's medium scatters or varies" in refusal(mi.render, apart, sensor=opaque, spp=4)


def test_multiple_reflections_in_a_slab_are_absorbed(rgb_variant):
    """R + T² a/(1 − R a), a = exp(−σ d), with R and T at normal incidence."""
    a, r = math.exp(-0.3 * THICKNESS), 0.04
    pixel = radiance(slab=box(GLASS | {"int_absorption": 0.3}))
    assert pixel == pytest.approx(r + (1 - r) ** 2 * a / (1 - r * a), abs=1e-4)  # paths below 1/4096 are dropped


def test_spectral_variants_absorb_the_same_light(spectral_variant):
    if not dr.is_jit_v(mi.Float):
        pytest.skip("a scalar variant would render for minutes")
    pixel = radiance(slab=box(matched(int_absorption=0.4)), spp=4096)
    assert pixel == pytest.approx(radiance(spp=4096) * math.exp(-0.4 * THICKNESS), rel=1e-5)


def test_light_of_a_lamp_inside_a_medium_is_absorbed(rgb_variant):
    """Camera, point light and matt floor are in the medium: light is absorbed before and after the floor."""
    sigma, height = 0.7, 0.4
    point = {"type": "point", "position": [0.1, 0.2, -0.9 + height], "intensity": 1.0}
    floor = {"type": "rectangle", "to_world": PLACE().translate([0, 0, -0.9]), "bsdf": {"type": "diffuse"}}
    method = CHANCE | {"camera_absorption": sigma, "max_depth": 2}
    pixel = radiance(0.5, light=point, **INSIDE, floor=floor, integrator=method, spp=64)
    assert pixel == pytest.approx(0.5 / math.pi / height**2 * math.exp(-sigma * (1.4 + height)), rel=1e-3)


@pytest.mark.parametrize(
    "light", [{"type": "constant"}, WHITE, {"type": "directional", "direction": [0, 0, -1]}], ids=lambda x: x["type"]
)
def test_an_infinite_medium_absorbs_all_light_from_infinity(light, rgb_variant):
    """Neither along the camera ray nor on a matt floor."""
    assert radiance(light=light, integrator={"camera_absorption": 0.1}) == pytest.approx(0, abs=1e-30)
    floor, method = sheet({"type": "diffuse"}, -1), CHANCE | {"camera_absorption": 0.1}
    assert radiance(light=light, floor=floor, integrator=method) == pytest.approx(0, abs=1e-30)


def test_the_image_has_a_derivative_in_sigma(llvm_variant):
    """d/dσ exp(−σ d) = −d exp(−σ d)."""
    tinted = scene(slab=box(matched(int_absorption=0.3)), integrator=CHANCE)
    params, (key,) = attached(tinted, "int_absorption.value")
    dr.backward(dr.mean(mi.render(tinted, params, spp=4), axis=None))
    assert float(dr.grad(params[key]).array[0]) == pytest.approx(-THICKNESS * math.exp(-0.3 * THICKNESS), rel=1e-4)


@pytest.mark.parametrize("height", [0.5, 1, 2.5, 4])
def test_the_distance_to_a_hidden_lamp_absorbs_too(height, rgb_variant):
    """From z = 5 through a medium that ends at z = 0.4, past a lamp with a null BSDF, to the sky."""
    lamp = sheet({"type": "null"}, 5 - height) | {"emitter": {"type": "area"}}
    end = sheet(matched(ext_absorption=1.0), 0.4)
    for hide in (False, True):
        method = CHANCE | {"camera_absorption": 1.0, "hide_emitters": hide}
        pixel = radiance(lamp=lamp, end=end, light=WHITE, integrator=method, spp=4)
        assert pixel == pytest.approx(math.exp(-4.6) + (not hide) * math.exp(-height), rel=1e-3)


@pytest.mark.parametrize("near", [1e-3, 0.3, 0.9])
@pytest.mark.parametrize("kind", ["orthographic", "perspective"])
def test_the_distance_to_the_near_plane_absorbs_too(kind, near, rgb_variant):
    """In a medium with σ = 0.7 that ends 5 units away."""
    view = PLACE().look_at([0.1, 0.2, 2], [0.1, 0.2, 1], [0, 1, 0])
    lens = {"to_world": view, "fov": 0.01} if kind == "perspective" else {"to_world": view.scale([0.01, 0.01, 1])}
    sensor = {"type": kind, "near_clip": near} | lens
    pixel = radiance(sensor=sensor, slab=box(matched(int_absorption=0.7), 6.0), integrator={"camera_absorption": 0.7})
    assert pixel == pytest.approx(math.exp(-0.7 * 5), rel=1e-4)


def test_a_batch_of_cameras_in_an_absorbing_medium_is_an_error(rgb_variant):
    """Which of its cameras a ray is of, and so the distance to the near plane, is not known."""
    batch = {"type": "batch", "first": camera(1), "second": camera(1), "film": camera(2)["film"]}
    method = {"type": "refract_path", "camera_absorption": 1.0}
    text = refusal(mi.render, mi.load_dict({"type": "scene", "integrator": method, "view": batch}), spp=1)
    assert text.endswith("the cameras of a batch are in an absorbing medium; expected one camera a render")


ROUGH = {"type": "roughdielectric", "alpha": 0.3}
LAMP = sheet({"type": "diffuse"}, -3) | {"to_world": PLACE().translate([0, 0, -3]), "emitter": {"type": "area"}}


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_spectral_polarized"], indirect=True)
@pytest.mark.parametrize(
    ("glass", "light", "least"), [(GLASS, None, 0.1), (ROUGH, LAMP, 0.01)], ids=["smooth", "rough"]
)
def test_tinted_glass_equals_that_of_volpath(glass, light, least, variant):
    """Compares independent renders; one false alarm in 10,000 for each colour."""
    tint = {"type": "homogeneous", "albedo": 0.0, "sigma_t": rgb(0.2, 0.5, 1.0)}
    tinted, renders = scene(light=light, slab=box(glass, interior=tint), integrator=CHANCE), []
    for seed, method in enumerate(({"type": "refract_path", "split_depth": 2}, {"type": "volpath", "max_depth": 64})):
        integrator = mi.load_dict(method)
        images = [mi.render(tinted, integrator=integrator, spp=4096, seed=8 * seed + i) for i in range(8)]
        renders.append(np.array([np.array(image).ravel()[:3] for image in images], dtype=float))
    assert all(equal_means(renders[1][:, [i]], renders[0][:, [i]]) for i in range(3))
    assert renders[1].max() > least


# Contradictions -----------------------------------------------------------------------------------------------

HERE = "refract_path: inconsistent absorption at {}: the medium that light arrives in differs from the one its BSDF "
AROUND = "ext_absorption (or ext_colour) as the medium around it absorbs"
CAMERA = "camera_absorption, or the sensor's medium, as the camera's surroundings absorb"
SCATTERS = CLEAR | {"albedo": 0.5}
VARIES = {"type": "heterogeneous", "albedo": 0.0, "sigma_t": {"type": "constvolume", "value": 1.0}}
MASKED = {"slab": box({"type": "mask", "opacity": 0.5, "bsdf": matched(int_absorption=0.2)}, id="masked")}
UNFOLLOWED = "the interior medium of 'slab' scatters or varies"
CLASH = "'slab' has an interior medium in a scene whose BSDFs absorb"


def with_medium(medium, **parameters):
    return {"slab": box(matched(**parameters), interior=medium, id="slab")}


REFUSED = {
    "a camera inside without an absorption": (
        {"height": 0.5, "slab": box(matched(int_absorption=0.7), id="aquarium")},
        (HERE.format("'aquarium'"), f"expected {CAMERA}; {AROUND}"),
    ),
    "a neighbour without an absorption": (
        {"outer": box(matched(int_absorption=0.2), id="outer"), "inner": box(matched(), 0.5, id="inner")},
        (HERE.format("'inner'"), f"expected {AROUND}; {CAMERA}"),
    ),
    "a neighbour with another green": (
        {
            "outer": box(matched(int_absorption=rgb(0.1, 0.2, 0.3)), id="outer"),
            "inner": box(matched(ext_absorption=rgb(0.1, 0.22, 0.3)), 0.5, id="inner"),
        },
        (HERE.format("'inner'"), f"expected {AROUND}; {CAMERA}"),
    ),
    "a sensor's medium that scatters": (
        INSIDE | {"height": 0.5, "sensor": {"medium": SCATTERS}},
        ("the sensor's medium scatters or varies; expected a homogeneous medium with an albedo of 0",),
    ),
    "absorption within a wrapper": (
        MASKED,
        ("'masked' has an absorbing BSDF within a MaskBSDF; expected absorption of the shape's own BSDF",),
    ),
    "a medium that scatters": (with_medium(SCATTERS), (UNFOLLOWED, "albedo of 0, or the integrator volpath")),
    "a medium that varies": (with_medium(VARIES), (UNFOLLOWED, "albedo of 0, or the integrator volpath")),
    "a medium beside absorption": (with_medium(CLEAR, int_absorption=0.7), (CLASH, "absorption of BSDFs, not both")),
}


@pytest.mark.parametrize("case", REFUSED)
def test_inconsistent_absorption_is_an_error_with_the_shape(case, rgb_variant):
    """A BSDF or a medium that cannot be followed is an error also in a shape group."""
    parts, texts = REFUSED[case]
    scenes = [parts]
    if [*parts] == ["slab"]:
        scenes = [shapes | {"integrator": CHANCE} for shapes in (parts, grouped(**parts))]
    for shapes in scenes:
        message = refused(**shapes)
        assert message.startswith("refract_path: ") and message.endswith(texts[-1])
        assert all(text in message for text in texts)


def test_a_twosided_wall_beside_an_absorbing_slab_is_no_error(rgb_variant):
    wall = sheet({"type": "twosided", "bsdf": {"type": "diffuse"}}, -4)
    assert (radiance(slab=box(matched(int_absorption=0.2)), wall=wall, integrator=CHANCE) >= 0).all()


@pytest.mark.parametrize(
    ("crossed", "wrong", "contradicts"),
    [(1, 1, True), (2, 1, True), (9, 2, False), (9, 3, True), (10_000, 99, False), (10_000, 101, True), (5, 0, False)],
)
def test_a_small_share_of_wrong_crossings_is_no_error(crossed, wrong, contradicts, scalar_variant):
    slab = scene(slab=box(matched()))
    crossings = medium_tracking.Crossings(mi.scalar_rgb, slab, "1 mm")
    for i in range(crossed):
        crossings.add(slab.shapes()[0], 1, True, i < wrong, False)
    if contradicts:
        assert HERE.format("'slab'") in refusal(crossings.refuse)
    else:
        crossings.refuse()


EXTERIOR = '<float name="ext_absorption" value="0.1"/>'
TUMBLER = {  # parameters to add to `nested.xml` after the indices of glass in air, glass in water, and water in air
    '<string name="ext_ior" value="air"/>': '<float name="int_absorption" value="0.5"/>',
    '<string name="ext_ior" value="water"/>': f'<float name="int_absorption" value="0.5"/>{EXTERIOR}',
    '<string name="int_ior" value="water"/>': '<float name="int_absorption" value="0.1"/>',
}


def test_three_media_may_meet_at_an_edge(llvm_variant):
    """A tumbler of water: near its rim one ray in 30,000 misses a boundary."""
    text = (SCENES / "nested.xml").read_text().replace('value="meshes', f'value="{SCENES}/meshes')
    for side, sigma in TUMBLER.items():
        assert side in text
        text = text.replace(side, f"{side}{sigma}", 1)
    right, wrong = (mi.load_string(x, res=64, integrator="refract_path") for x in (text, text.replace(EXTERIOR, "")))
    assert np.isfinite(np.array(mi.render(right, spp=256))).all()
    assert HERE.format("'tumbler_wet'") in refusal(mi.render, wrong, spp=16)


@pytest.mark.parametrize(
    ("at", "thickness", "stepped_over"), [(12, 1e-4, True), (50, 1.5e-4, True), (12, 1e-3, False), (50, 4e-3, False)]
)
def test_an_absorbing_sheet_that_rays_step_over_is_an_error(at, thickness, stepped_over, rgb_variant):
    """Rays start 2e-6 × (64 + the largest coordinate) from the surface; 64 is the sheet's size, 40, rounded up."""
    pane = box(matched(int_absorption=100.0), thickness, at, id="pane")
    if stepped_over:
        assert "'pane' absorbs, and is so thin that rays miss one of its sides" in refused(at + 5.0, pane=pane)
    else:
        assert radiance(at + 5.0, pane=pane) == pytest.approx(math.exp(-100 * thickness), rel=2e-2)


def test_a_sheet_that_rays_step_over_is_an_error_too_where_they_start_as_those_of_mitsuba(rgb_variant):
    """With a cylinder of glass in the scene, all rays start 9e-5 × (1 + the largest coordinate) from the surface."""
    rod = {"type": "cylinder", "p0": [15, 0, 0], "p1": [16, 0, 0], "bsdf": matched()}
    pane = box(matched(int_absorption=100.0), 1e-4, 12, id="pane")
    text = refused(17.0, pane=pane, rod=rod)
    assert "'pane' absorbs, and is so thin that rays miss one of its sides" in text
    assert "thicker than 1e-4 of 1 + its largest coordinate" in text


def test_a_second_instance_of_a_sheet_that_rays_step_over_is_an_error(rgb_variant):
    """Rays that enter the first one start within or beyond the second one."""
    group = grouped(pane=box(matched(int_absorption=100.0), 4e-4, 12, id="pane"))
    shifted = group["instance"] | {"to_world": PLACE().translate([0, 0, -8e-4])}
    text = refused(17.0, integrator=CHANCE, **group, second=shifted)
    assert "'pane' absorbs, and is so thin that rays miss one of its sides" in text


NARROW = matched(int_absorption=2.0)
ROD = {"type": "cylinder", "p0": [-9, 0, 0], "p1": [9, 0, 0], "bsdf": NARROW}
UNEVEN = {
    "a rod": {"rod": ROD | {"radius": 0.3}},
    "a thin rod": {"rod": ROD | {"radius": 0.03}},
    "a ball in an instance": grouped(ball={"type": "sphere", "bsdf": NARROW}),
}
UNEVEN["a ball in an instance"]["instance"] |= {"to_world": PLACE().scale(0.5)}


@pytest.mark.parametrize("solid", UNEVEN)
def test_a_solid_on_which_mitsubas_points_are_less_exact_is_no_thin_sheet(solid, rgb_variant):
    wide = {"to_world": PLACE().look_at([0, 0, 6], [0, 0, 0], [0, 1, 0]).scale(0.03)}
    image = radiance(sensor=wide, integrator=CHANCE, **UNEVEN[solid], spp=256)
    thickness = {"a rod": 0.6, "a thin rod": 0.06, "a ball in an instance": 1.0}[solid]
    assert (image > math.exp(-2 * thickness)).all() and (image < 1).all()


@pytest.mark.parametrize("order", [("inner", "outer", "far"), ("far", "inner", "outer"), ("outer", "far", "inner")])
def test_shapes_without_names_are_distinguished(order, rgb_variant):
    """The inner wall of a glass of water declares another σ than the outer one; a ball far away has no influence."""
    ball = '<shape type="sphere">{}<bsdf type="refract">{}</bsdf></shape>'
    parts = {
        "inner": ball.format('<float name="radius" value="0.5"/>', ""),
        "outer": ball.format("", '<float name="int_absorption" value="1"/>'),
        "far": ball.format('<point name="center" x="9" y="0" z="0"/>', ""),
    }
    film = '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>'
    look = '<transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>'
    glasses = mi.load_string(
        f'<scene version="3.0.0"><integrator type="refract_path"/><sensor type="perspective">{film}{look}</sensor>'
        f'{"".join(map(parts.get, order))}<emitter type="constant"/></scene>'
    )
    assert "(Sphere): the medium that light arrives in differs from" in refusal(mi.render, glasses, spp=16)


@pytest.mark.parametrize("outer", [{"type": "moment"}, {"type": "aov", "aovs": "d:depth"}], ids=str)
def test_inconsistent_absorption_in_a_nested_integrator_is_an_error(outer, rgb_variant):
    aquarium = scene(0.5, slab=box(matched(int_absorption=0.7), id="aquarium"))
    method = mi.load_dict(outer | {"inner": {"type": "refract_path"}})
    assert HERE.format("'aquarium'") in refusal(mi.render, aquarium, integrator=method, spp=4)
