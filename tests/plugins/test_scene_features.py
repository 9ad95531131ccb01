"""The features that a scene needs, in every variant; unknown plugins need all of them."""

import dataclasses
import math

import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import BLACK, PLACE, camera, sampled
from support.variants import switch

from mi_refract.plugins import check_integrator, inspect, missing_light
from mi_refract.plugins.scene_features import EITHER
from validation.run.context import SCENES

GLASS_ONLY = {"balls", "fibre", "furnace", "glasses64", "lightpipe", "mirage", "rainbow_drop", "slab"}
LAMP = {"type": "rectangle", "emitter": {"type": "area"}}
CHECKERS = {"type": "checkerboard"}
MEDIUM = {"type": "homogeneous"}


def needs(**parts):
    return inspect(mi.load_dict({"type": "scene"} | parts))


def facts(**parts):
    """Return the names of the features, except four, that are true for a scene of a glass ball and `parts`."""
    ball = {"type": "sphere", "bsdf": {"type": "refract"}}
    features = dataclasses.asdict(needs(**{"sensor": {"type": "perspective"}, "ball": ball} | parts))
    excluded = {"refracting", "shape_media", "delta", "splitting"}
    return {name for name, value in features.items() if value is True} - excluded


def sphere(bsdf, **parts):
    return {"type": "sphere", "bsdf": {"type": bsdf} | parts}


def test_a_ball_alone_needs_nothing(typical_variant):
    assert facts() == facts(ball={"type": "sphere", "bsdf": BLACK}) == {"only_glass"}


SMALL, DISTANT = {"sampleable", "lamps"}, {"sampleable", "lamps_at_infinity"}
LIT = {"sampleable", "lamps", "area"}


@pytest.mark.parametrize(
    ("part", "expected"),
    [
        ({"type": "sphere"}, {"smooth"}),
        (sphere("diffuse", reflectance=1e-6), {"smooth"}),
        (sphere("diffuse", reflectance=CHECKERS), {"smooth", "textured"}),
        (sphere("twosided", a={"type": "diffuse", "reflectance": CHECKERS}), {"smooth", "textured"}),
        (sphere("diffuse", reflectance={"type": "mesh_attribute", "name": "vertex_color"}), {"smooth", "textured"}),
        (sphere("refract", specular_reflectance=CHECKERS), {"textured"}),
        (sphere("mask", a={"type": "refract"}), {"null", "both_numbers"}),
        (sphere("thindielectric"), {"null"}),
        (sphere("roughdielectric"), {"smooth", "both_numbers"}),
        (sphere("refract") | {"interior": MEDIUM}, {"media"}),
        (sphere("plastic"), {"smooth", "both_numbers"}),
        (LAMP, LIT),
        (LAMP | {"bsdf": {"type": "null"}}, LIT | {"null"}),
        (LAMP | {"bsdf": {"type": "diffuse"}}, LIT | {"smooth"}),
        ({"type": "constant"}, {"sampleable", "environment", "plain_environment"}),
        ({"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 4, 3), np.float32))}, {"environment", *DISTANT}),
        ({"type": "point"}, SMALL),
        ({"type": "directional"}, SMALL | DISTANT),
        (LAMP | {"emitter": {"type": "directionalarea"}}, SMALL | {"area"}),
        ({"type": "shapegroup", "a": sphere("roughdielectric")}, set()),  # no instance shows it
    ],
)
def test_each_part_adds_only_the_features_that_it_needs(part, expected, scalar_variant):
    assert facts(part=part) == expected | (set() if "smooth" in expected else {"only_glass"})


def test_a_nested_bsdf_does_not_split(scalar_variant):
    assert needs(ball=sphere("dielectric")).splitting and needs(ball=sphere("refract")).splitting
    assert not needs(ball=sphere("mask", a={"type": "refract"})).splitting


def test_a_lamp_with_the_weight_0_is_never_sampled(scalar_variant):
    """With a constant sky, which is not sampled either, only BSDF samples find it."""
    expected = {"only_glass", "sampleable", "area", "environment", "plain_environment"}
    for weight, lamps in ((0.0, set()), (1.0, {"lamps"})):
        lamp = LAMP | {"emitter": {"type": "area", "sampling_weight": weight}}
        assert facts(sky={"type": "constant"}, lamp=lamp) == expected | lamps


ONE_NUMBER = {
    "Null": {"type": "null"},
    "Refract": {"type": "refract"},
    "RoughConductor": {"type": "roughconductor"},
    "SmoothConductor": {"type": "conductor"},
    "SmoothDielectric": {"type": "dielectric"},
    "SmoothDiffuse": {"type": "diffuse"},
    "ThinDielectric": {"type": "thindielectric"},
    "TwoSidedBRDF": {"type": "twosided", "nested": {"type": "diffuse"}},
}
BOTH_NUMBERS = {
    "Hair": {"type": "hair"},
    "PolarizedPlastic": {"type": "pplastic"},
    "Principled": {"type": "principled", "metallic": 0.5, "spec_trans": 0.5},
    "PrincipledThin": {"type": "principledthin", "spec_trans": 0.5, "diff_trans": 1.0},
    "RoughDielectric": {"type": "roughdielectric"},
    "RoughPlastic": {"type": "roughplastic"},
    "SmoothPlastic": {"type": "plastic"},
}


@pytest.mark.parametrize(("name", "bsdf"), (ONE_NUMBER | BOTH_NUMBERS).items())
def test_the_list_of_plugins_that_use_one_random_number(name, bsdf, scalar_variant):
    """Tests on a grid which of `sample1` and `sample2` a sample depends on, but for `measured`, which needs a file."""
    assert set(ONE_NUMBER) == EITHER
    loaded, grid, both = mi.load_dict(bsdf), (np.arange(16) + 0.5) / 16, name in BOTH_NUMBERS
    assert name in (loaded.class_name(), type(loaded).__name__)

    def differ(pairs):
        samples = [sampled(loaded, (0.36, 0.48, 0.8), x, sample2=point) for x, point in pairs]
        return len({(*s.wo, s.pdf) for s in samples}) > 1

    used = differ((x, (0.3, 0.6)) for x in grid), differ((0.3, (x, 1 - x)) for x in grid)
    assert all(used) == both
    assert ("both_numbers" in facts(part={"type": "sphere", "bsdf": bsdf})) == both


def test_shapes_that_mitsuba_merges_are_as_large_as_before(rgb_variant):
    """Mitsuba's bounding box of merged meshes omits rectangles."""
    shapes = {
        "pane": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 30).scale(1e4)},
        "cube": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.01)},
    }
    glass = {"type": "ref", "id": "glass"}
    parts = {"type": "scene", "glass": {"type": "dielectric"}} | {x: shapes[x] | {"bsdf": glass} for x in shapes}
    merged, apart = (mi.load_dict(parts, optimize=merge) for merge in (True, False))
    assert len(merged.shapes()) < len(apart.shapes())
    assert inspect(merged).delta_extent == inspect(apart).delta_extent


def test_a_mesh_without_vertices_has_no_size(scalar_variant):
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "dielectric"})
    assert needs(empty=mi.Mesh("empty", 0, 0, props=properties)).delta_extent == math.inf


@pytest.mark.parametrize("kind", ["bsplinecurve", "linearcurve", "ellipsoids", "ellipsoidsmesh"])
def test_glass_that_rays_do_not_meet_from_within_is_an_error(kind, llvm_variant, tmp_path):
    (tmp_path / "fibre.txt").write_text("\n".join(f"{x} 0 0 0.3" for x in range(4)))
    shape = {"filename": str(tmp_path / "fibre.txt")}
    if "ellipsoids" in kind:
        data = {"centers": [0, 0, 0], "scales": [1, 1, 1], "quaternions": [0, 0, 0, 1]}
        shape = {name: mi.TensorXf([float(x) for x in row], (1, len(row))) for name, row in data.items()}
    parts = {"integrator": {"type": "refract_path"}, "sensor": {"type": "perspective"}}
    made = mi.load_dict({"type": "scene", "glass": {"type": kind, "bsdf": {"type": "dielectric"}} | shape} | parts)
    with pytest.raises(ValueError, match=r"'glass' is a .* of glass.*; expected a mesh"):
        check_integrator(made)


EVERYTHING = {"both_numbers", "smooth", "null", "textured", "dispersive", "absorbing"}


def test_unknown_plugins_need_everything(scalar_variant):

    class Refract(mi.BSDF):  # it has the name of our class, but another module
        def __init__(self, props):
            super().__init__(props)
            self.m_flags = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide

        def traverse(self, callback):
            pass

    mi.register_bsdf("stranger", Refract)
    part = sphere("twosided", nested={"type": "stranger"})
    assert facts(part=part) == EVERYTHING
    (name,) = needs(part=part).unknown
    assert name.endswith("Refract")
    assert {*needs(part=part, lamp=POINT).missing()} == {CAST}
    group = {"type": "shapegroup", "id": "group", "a": {"type": "sphere", "bsdf": BLACK}}
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    assert facts(group=group, instance=instance) == EVERYTHING | {"area"}
    assert {*needs(group=group, instance=instance, lamp=POINT).missing(volumes=True)} == {CAST}
    cloudy = group | {"a": group["a"] | {"interior": MEDIUM}}
    assert facts(group=cloudy, instance=instance) == EVERYTHING | {"area", "media"}
    assert facts(group=group, other=cloudy | {"id": "other"}, instance=instance) == EVERYTHING | {"area"}


@pytest.mark.parametrize(("reflectance", "black"), [(0.0, True), ({"type": "rgb", "value": 1e-9}, False)])
def test_a_spectrum_from_rgb_is_never_exactly_black(reflectance, black):
    """Its `max` in Mitsuba is 0."""
    switch("scalar_spectral")
    assert ("smooth" in facts(part=sphere("diffuse", reflectance=reflectance))) != black


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"], indirect=True)
def test_features_of_our_scenes(variant):
    scenes = {path.stem: inspect(mi.load_file(str(path), res=4)) for path in SCENES.glob("*.xml")}
    assert {name for name, scene in scenes.items() if scene.only_glass} == GLASS_ONLY
    assert {name for name, scene in scenes.items() if not scene.environment} == {"fibre", "mirage"}
    assert not any(scene.unknown for scene in scenes.values())
    reasons = scenes["slab"].left_out
    assert reasons["emitter sampling"] == "every BSDF has delta lobes only"
    assert set(reasons) == {"emitter sampling", "a random number", "media", "null lobes", "dispersion", "absorption"}


def test_omitted_features_have_reasons_and_an_edit_can_require_them(scalar_variant):
    """The edit makes the black surface of a lamp grey."""
    matt = {"type": "sphere"}
    assert "BSDF sampling finds it" in needs(a=matt, sky={"type": "constant"}).left_out["sampling the environment"]
    dark = needs(a=matt).left_out
    assert dark["emitter sampling"] == "no emitter can be sampled"
    assert {"area lights", "environment"} <= set(dark)
    scene = mi.load_dict({"type": "scene", "lamp": LAMP})
    assert not inspect(scene).smooth
    params = mi.traverse(scene)
    params["lamp.bsdf.reflectance.value"] = 0.1
    params.update()
    assert inspect(scene).smooth


# Missing light ------------------------------------------------------------------------------------------------------

DOWN = PLACE().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
POINT, SPOT = {"type": "point", "position": [0, 0, 4]}, {"type": "spot", "to_world": DOWN}
SUNLIGHT = {"type": "directional", "direction": [0, 0, -1]}
PROJECTOR = {"type": "projector", "to_world": DOWN, "irradiance": {"type": "rgb", "value": 1.0}}
SQUARE = {"type": "rectangle", "to_world": DOWN}
BEAM = SQUARE | {"emitter": {"type": "directionalarea"}}
CAST, ALL_OF_BEAM = "L S+ D (S|D)* E", "L (S|D)* D (S|D)* E"


def under_a_pane(lamp, bsdf, integrator="path", floor=None, more=None, calls=None, **parameters):
    """Return a scene of a floor seen from below a pane, with the lamp above the pane, and a part `more`.

    `calls`: an integrator nested in `integrator`, which gets the parameters instead.
    """
    parts = {"floor": {"type": "rectangle", "bsdf": floor or {"type": "diffuse"}}, "lamp": lamp}
    if bsdf:
        parts["pane"] = {"type": "rectangle", "to_world": PLACE().translate([0, 0, 1]).scale(3), "bsdf": bsdf}
    if more:
        parts["more"] = more
    view = camera(8, 60) | {"to_world": PLACE().look_at([1.5, 0, 0.6], [0, 0, 0], [0, 0, 1])}
    if calls:
        parameters = {"called": {"type": calls} | parameters}
    return mi.load_dict({"type": "scene", "eye": view, "integrator": {"type": integrator} | parameters} | parts)


CLEAR, HOLES = {"type": "null"}, {"type": "mask", "nested": {"type": "diffuse"}}
MIRROR = {"type": "twosided", "nested": {"type": "conductor"}}
GLASS = {"type": "dielectric"}
CLOUDY = {"type": "sphere", "bsdf": GLASS, "interior": MEDIUM}


@pytest.mark.parametrize(
    ("lamp", "bsdf", "others", "missing"),
    [
        *((lamp, GLASS, {}, {CAST}) for lamp in (POINT, SPOT, SUNLIGHT, PROJECTOR)),
        *((POINT, {"type": bsdf}, {}, {CAST}) for bsdf in ("refract", "thindielectric", "plastic", "retarder", "hair")),
        *((POINT, bsdf, {}, {CAST}) for bsdf in (CLEAR, HOLES, MIRROR)),
        *((BEAM, bsdf, {}, {ALL_OF_BEAM}) for bsdf in (None, GLASS)),
        # Nothing is missing without such a lamp, a delta lobe or another lobe, nor if `max_depth` excludes the paths.
        *((lamp, GLASS, {}, set()) for lamp in ({"type": "constant"}, SQUARE | {"emitter": {"type": "area"}})),
        (POINT | {"sampling_weight": 0.0}, GLASS, {"more": {"type": "constant"}}, set()),
        *((POINT, bsdf, {}, set()) for bsdf in (None, {"type": "roughdielectric"}, {"type": "principled"})),
        *((lamp, GLASS, {"floor": BLACK}, set()) for lamp in (POINT, BEAM)),
        *((POINT, GLASS, {"max_depth": depth}, missing) for depth, missing in ((2, set()), (3, {CAST}))),
        *((BEAM, GLASS, {"max_depth": depth}, missing) for depth, missing in ((1, set()), (2, {ALL_OF_BEAM}))),
        # In `volpath` shadow rays pass null lobes, and media scatter.
        *((POINT, bsdf, {"integrator": "volpath"}, set()) for bsdf in (CLEAR, HOLES)),
        *((POINT, {"type": bsdf}, {"integrator": "volpathmis"}, {CAST}) for bsdf in ("thindielectric", "dielectric")),
        (POINT, GLASS, {"floor": BLACK, "more": CLOUDY, "integrator": "path"}, set()),
        (POINT, GLASS, {"floor": BLACK, "more": CLOUDY, "integrator": "volpath"}, {CAST}),
        # Other integrators are not examined.
        *((POINT, GLASS, {"integrator": name}, set()) for name in ("ptracer", "direct", "depth")),
        (POINT, GLASS, {"integrator": "refract_path", "caustics": "path"}, {CAST}),
        (POINT, GLASS, {"integrator": "refract_path"}, {"L S+ D (S|D)* S E"}),
        *((POINT, GLASS, {"integrator": "moment", "calls": name}, {CAST}) for name in ("path", "refract_path")),
        (POINT, GLASS, {"integrator": "moment", "calls": "path", "max_depth": 2}, set()),
    ],
)
def test_missing_light_lists_the_classes_of_paths(lamp, bsdf, others, missing, scalar_variant):
    assert {*missing_light(under_a_pane(lamp, bsdf, **others))} == missing


def test_missing_light_needs_no_sensor(scalar_variant):
    parts = {"ball": {"type": "sphere", "bsdf": GLASS}, "floor": {"type": "rectangle"}, "lamp": POINT}
    for integrator in ("path", "refract_path"):
        assert {*missing_light(mi.load_dict({"type": "scene", "integrator": {"type": integrator}} | parts))} == {CAST}


def test_missing_light_gives_reason_and_remedy(scalar_variant):
    scene = under_a_pane(POINT, {"type": "mask", "nested": GLASS})
    (text,) = missing_light(scene).values()
    assert text == (
        "light of PointLight that delta lobes (glass, mirrors, null) cast on other surfaces is black; "
        "expected refract_path with caustics = lamp, or area lights in place of such lamps"
    )


@pytest.mark.parametrize("integrator", ["path", "refract_path", "volpath"])
@pytest.mark.parametrize(
    ("lamp", "bsdf"), [(POINT, None), (POINT, GLASS), (SUNLIGHT, CLEAR), (SPOT, HOLES), (BEAM, None)]
)
def test_missing_light_is_black_and_ptracer_finds_it(lamp, bsdf, integrator, scalar_variant):
    by_path = {"caustics": "path"} if integrator == "refract_path" else {}
    scene, tracer = under_a_pane(lamp, bsdf, integrator, **by_path), mi.load_dict({"type": "ptracer"})
    ours, theirs = np.array(mi.render(scene, spp=4)), np.array(mi.render(scene, spp=4000, integrator=tracer))
    assert theirs.mean() > 0
    assert ours.mean() == (0 if missing_light(scene) else pytest.approx(theirs.mean(), rel=0.1))


def test_a_lamp_without_samples_is_black_beside_one_at_infinity(scalar_variant):
    lamps = (x | {"to_world": PLACE().translate([9, 0, 2])} for x in (BEAM, SQUARE))
    one, other = (
        np.array(mi.render(under_a_pane(x, None, "refract_path", more=SUNLIGHT), spp=256)).mean() for x in lamps
    )
    assert one == pytest.approx(other, rel=0.1) and one > 0


@pytest.mark.parametrize(
    ("integrator", "bsdf", "black"),
    [("prb", CLEAR, True), ("prb_projective", CLEAR, True), ("prbvolpath", CLEAR, False), ("prbvolpath", GLASS, True)],
)
def test_missing_light_is_black_in_differentiable_integrators(integrator, bsdf, black, llvm_variant):
    scene = under_a_pane(POINT, bsdf, integrator)
    assert bool(missing_light(scene)) == (np.array(mi.render(scene, spp=4)).max() == 0) == black


@pytest.mark.parametrize(
    ("lamp", "bsdf", "max_depth", "missing"),
    [
        (POINT, GLASS, -1, {"L S+ D (S|D)* S E"}),
        (POINT, CLEAR, 4, {"L S+ D (S|D)* S E"}),
        (POINT, GLASS, 3, set()),
        (POINT, None, -1, set()),
        (BEAM, GLASS, -1, {"L S+ D (S|D)* S E", "L D (S|D)* E"}),
        (BEAM, GLASS, 3, {"L D (S|D)* E"}),
    ],
)
def test_missing_light_if_caustics_are_traced_from_the_lamp(lamp, bsdf, max_depth, missing, scalar_variant):
    assert {*inspect(under_a_pane(lamp, bsdf)).missing("lamp", max_depth)} == missing


def test_missing_light_of_another_caustics_is_an_error(scalar_variant):
    with pytest.raises(ValueError, match=r"^missing: caustics = 'auto'; expected path or lamp$"):
        needs().missing("auto")


def test_refract_path_warns_again_if_lamps_are_no_longer_traced(logged, scalar_variant):
    scene = under_a_pane(POINT, GLASS)
    method = mi.load_dict({"type": "refract_path"})
    cameras = [mi.load_dict(x) for x in (camera(4), camera(4, sample_border=True), camera(4))]
    for sensor in cameras:
        method.render(scene, sensor, spp=1)
    classes = [text.partition(": light")[0] for text in logged if "missing" in text]
    assert classes == [f"refract_path: missing L S+ D (S|D)* {end}" for end in ("S E", "E", "S E")]


def test_refract_path_warns_once_a_scene_about_missing_light(logged, scalar_variant):
    for bsdf in (GLASS, GLASS, None):
        scene = under_a_pane(POINT, bsdf, "refract_path", caustics="path")
        for seed in range(2):
            mi.render(scene, spp=1, seed=seed)
    warnings = [text for text in logged if "missing" in text]
    assert len(warnings) == 2
    assert all(text.startswith("refract_path: missing L S+ D (S|D)* E: light of PointLight") for text in warnings)


# Glass that is too thin ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("thickness", "place", "others", "thin"),
    [
        (1e-3, 12, {}, ""),
        (1e-5, 12, {}, "'pane' is 1e-05 thick, but rays start 2.86e-05 or more from its surface"),
        (1e-5, 0, {}, ""),
        # In a scene with a cylinder rays start as in Mitsuba.
        (1e-3, 12, {"pipe": {"type": "cylinder", "bsdf": GLASS}}, "'pane' is 0.001 thick, but rays start 0.00125"),
        (1e-5, 12, {"bsdf": {"type": "conductor"}}, ""),
    ],
)
def test_glass_that_rays_step_over_is_reported(thickness, place, others, thin, scalar_variant):
    at = PLACE().translate([place, 0, 0]).scale([1, 1, thickness / 2])
    pane = {"type": "cube", "id": "pane", "to_world": at, "bsdf": others.get("bsdf", GLASS)}
    text = needs(pane=pane, **{name: part for name, part in others.items() if name != "bsdf"}).thin
    assert thin in text and bool(thin) == bool(text)


def shown(scale, **parameters):
    """Return an instance, scaled by `scale`, of a shape."""
    group = {"type": "shapegroup", "id": "group", "solid": {"bsdf": GLASS, "id": "solid"} | parameters}
    to_world = PLACE().scale(scale)
    return {"group": group, "i": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": to_world}}


def pipe(radius, **parameters):
    return {"solid": {"type": "cylinder", "radius": radius, "bsdf": GLASS, "id": "solid"} | parameters}


@pytest.mark.parametrize(
    ("parts", "distance", "text"),
    [
        (shown(0.5, type="sphere"), 6, ""),
        (shown(0.2, type="sphere"), 6, "'solid' is a Sphere in an instance that scales it by 0.2, 6 from a camera: "),
        (shown((1, 1, 0.2), type="sphere"), 6, "0.2, 6 from a camera: Mitsuba's points on it err by up to 0.00069"),
        (shown(0.5, type="sphere"), 30, "err by up to 0.00043, but rays start 8.9e-05 from its surface; expected a"),
        (shown(2, type="sphere"), 30, ""),
        (shown(0.2, type="cube"), 30, ""),
        (shown(0.2, type="sphere", bsdf={"type": "diffuse"}), 6, ""),
        ({"solid": {"type": "sphere", "radius": 0.01, "bsdf": GLASS}}, 30, ""),
        (pipe(0.1), 5, ""),
        (pipe(0.1), 30, "'solid' is a Cylinder, 29.5 from a camera: Mitsuba's points on it err by up to 0.0021"),
        (pipe(0.1, p0=[0, 0, 25], p1=[0, 0, 29]), 30, ""),  # nearer
        (pipe(0.1, bsdf={"type": "conductor"}), 30, ""),
        (pipe(0.1, bsdf={"type": "null"}), 30, ""),
        (shown(0.1, type="cylinder"), 30, "'solid' is a Cylinder in an instance that scales it by 0.1, 29.9 from"),
    ],
)
def test_shapes_on_which_mitsubas_points_are_not_exact_enough_are_reported(parts, distance, text, typical_variant):
    at = PLACE().look_at([0, 0, distance], [0, 0, 0], [0, 1, 0])
    reported = needs(sensor={"type": "perspective", "to_world": at}, **parts).inexact
    assert text in reported and bool(text) == bool(reported)


def test_refract_path_warns_once_of_inexact_points_wherever_the_camera_is(logged, scalar_variant):
    scene = under_a_pane(POINT, GLASS, more=pipe(0.01)["solid"])
    method = mi.load_dict({"type": "refract_path", "caustics": "path"})
    for distance in (1, 30, 40):
        at = PLACE().look_at([0, 0, distance], [0, 0, 0], [0, 1, 0])
        method.render(scene, mi.load_dict(camera(4) | {"to_world": at}), spp=1)
    warnings = "missing L S+ D", "Mitsuba's points on it err by"
    assert [x for text in logged for x in warnings if x in text] == [*warnings]
