"""What a scene needs is seen in every variant, feature by feature; what is not known counts as needed."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.glass_scenes import BLACK
from support.variants import switch

from mi_refract.plugins.scene_features import EITHER, inspect
from validation.run.context import SCENES

GLASS_ONLY = {"balls", "fibre", "furnace", "glasses64", "lightpipe", "mirage", "rainbow_drop", "slab"}
LAMP = {"type": "rectangle", "emitter": {"type": "area"}}


def facts(**parts):
    """The names of what is true of a scene of a glass ball and `parts`."""
    ball = {"type": "sphere", "bsdf": {"type": "refract"}}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "ball": ball} | parts)
    found = {name for name, value in dataclasses.asdict(inspect(scene)).items() if value is True}
    return found - {"refracting", "deterministic", "shape_media"}


def test_a_ball_alone_needs_nothing_but_polarisation(typical_variant):
    assert facts() == {"only_glass", "polarising"}
    assert facts(ball={"type": "sphere", "bsdf": BLACK}) == {"only_glass"}


CHECKERS = {"type": "checkerboard"}
MEDIUM = {"type": "homogeneous"}


@pytest.mark.parametrize(
    ("part", "seen"),
    [
        ({"type": "sphere"}, {"smooth"}),
        ({"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": 1e-6}}, {"smooth"}),
        ({"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": CHECKERS}}, {"smooth", "textured"}),
        (
            {"type": "sphere", "bsdf": {"type": "twosided", "a": {"type": "diffuse", "reflectance": CHECKERS}}},
            {"smooth", "textured"},
        ),
        ({"type": "sphere", "bsdf": {"type": "refract", "specular_reflectance": CHECKERS}}, {"textured"}),
        ({"type": "sphere", "bsdf": {"type": "mask", "a": {"type": "refract"}}}, {"null", "both_numbers"}),
        ({"type": "sphere", "bsdf": {"type": "thindielectric"}}, {"null"}),
        ({"type": "sphere", "bsdf": {"type": "roughdielectric"}}, {"smooth", "both_numbers"}),
        ({"type": "sphere", "interior": MEDIUM, "bsdf": {"type": "refract"}}, {"media"}),
        ({"type": "sphere", "bsdf": {"type": "plastic"}}, {"smooth", "both_numbers"}),
        (LAMP, {"sampleable", "lamps", "area"}),
        (LAMP | {"bsdf": {"type": "null"}}, {"sampleable", "lamps", "area", "null"}),
        (LAMP | {"bsdf": {"type": "diffuse"}}, {"sampleable", "lamps", "area", "smooth"}),
        ({"type": "constant"}, {"sampleable", "environment", "plain_environment"}),
        ({"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 4, 3), np.float32))}, {"sampleable", "environment"}),
        ({"type": "point"}, {"sampleable", "lamps", "delta_emitters"}),
        ({"type": "directional"}, {"sampleable", "lamps", "delta_emitters"}),
        (LAMP | {"emitter": {"type": "directionalarea"}}, {"sampleable", "lamps", "area", "delta_emitters"}),
    ],
)
def test_each_part_adds_what_it_needs_and_no_more(part, seen, scalar_variant):
    expected = {"polarising"} | seen | (set() if "smooth" in seen else {"only_glass"})
    assert facts(part=part) == expected


def test_a_lamp_with_the_weight_0_is_never_sampled(scalar_variant):
    """Beside a constant sky, which is not sampled either, it is met by the BSDFs' own samples only."""
    lamp = LAMP | {"emitter": {"type": "area", "sampling_weight": 0.0}}
    expected = {"only_glass", "polarising", "sampleable", "area", "environment", "plain_environment"}
    assert facts(sky={"type": "constant"}, lamp=lamp) == expected
    assert facts(sky={"type": "constant"}, lamp=LAMP) == expected | {"lamps"}


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


def numbers_asked(bsdf):
    """Which of `sample1` and `sample2` a BSDF's sample depends on, tried on a grid."""
    si, grid = dr.zeros(mi.SurfaceInteraction3f), (np.arange(16) + 0.5) / 16
    si.wi = mi.Vector3f(0.36, 0.48, 0.8)

    def several(numbers):
        found = [bsdf.sample(mi.BSDFContext(), si, *pair)[0] for pair in numbers]
        return len({(bs.wo.x, bs.wo.y, bs.wo.z, bs.pdf) for bs in found}) > 1

    asked = {1} if several((x, [0.3, 0.6]) for x in grid) else set()
    return asked | ({2} if several((0.3, [x, 1 - x]) for x in grid) else set())


def test_plugins_that_take_either_number_have_been_tried(scalar_variant):
    """`measured`, which needs a file, has not been."""
    assert set(ONE_NUMBER) == EITHER
    for name, bsdf in (ONE_NUMBER | BOTH_NUMBERS).items():
        loaded, both = mi.load_dict(bsdf), name in BOTH_NUMBERS
        assert name in (loaded.class_name(), type(loaded).__name__)
        assert (numbers_asked(loaded) == {1, 2}) == both, name
        assert ("both_numbers" in facts(part={"type": "sphere", "bsdf": bsdf})) == both, name


EVERYTHING = {"both_numbers", "smooth", "null", "textured", "polarising", "dispersive", "absorbing"}


def test_what_is_not_known_needs_everything(scalar_variant):

    class Refract(mi.BSDF):  # ours by its name, but not by its module
        def __init__(self, props):
            super().__init__(props)
            self.m_flags = mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.FrontSide

        def traverse(self, callback):
            pass

    mi.register_bsdf("stranger", Refract)
    part = {"type": "sphere", "bsdf": {"type": "twosided", "nested": {"type": "stranger"}}}
    assert facts(part=part) == EVERYTHING
    scene = mi.load_dict({"type": "scene", "part": part})
    (name,) = inspect(scene).unknown
    assert name.endswith("Refract")
    group = {"type": "shapegroup", "id": "group", "a": {"type": "sphere", "bsdf": BLACK}}
    instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    assert facts(group=group, instance=instance) == EVERYTHING | {"area"}
    group["a"]["interior"] = MEDIUM
    assert facts(group=group, instance=instance) == EVERYTHING | {"area", "media"}


def test_an_emitter_that_declares_nothing_may_be_a_delta(scalar_variant):

    class Silent(mi.Emitter):
        def traverse(self, callback):
            pass

    mi.register_emitter("silent", Silent)
    assert facts(part={"type": "silent"}) == {"only_glass", "polarising", "sampleable", "lamps", "delta_emitters"}


@pytest.mark.parametrize(("reflectance", "black"), [(0.0, True), ({"type": "rgb", "value": 1e-9}, False)])
def test_a_spectrum_from_rgb_is_never_exactly_black(reflectance, black):
    """Mitsuba calls its largest value 0."""
    switch("scalar_spectral")
    part = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": reflectance}}
    assert ("smooth" in facts(part=part)) != black


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_the_scenes(variant, needs_variant):
    needs_variant(variant)
    switch(variant)
    found = {path.stem: inspect(mi.load_file(str(path), res=4)) for path in SCENES.glob("*.xml")}
    assert {name for name, needs in found.items() if needs.only_glass} == GLASS_ONLY
    assert {name for name, needs in found.items() if not needs.environment} == {"fibre", "mirage"}
    assert all(needs.polarising and not needs.unknown for needs in found.values())


def test_what_is_left_out_has_its_reason(scalar_variant):
    found = inspect(mi.load_file(str(SCENES / "slab.xml"), res=4)).left_out
    assert found["emitter sampling"] == "every BSDF has delta lobes only"
    assert set(found) == {"emitter sampling", "a random number", "media", "null lobes", "dispersion", "absorption"}
    sky = {"type": "scene", "a": {"type": "sphere"}, "sky": {"type": "constant"}}
    assert "met" in inspect(mi.load_dict(sky)).left_out["sampling the environment"]
    dark = inspect(mi.load_dict({"type": "scene", "a": {"type": "sphere"}})).left_out
    assert dark["emitter sampling"] == "no emitter can be sampled"
    assert {"area lights", "environment", "polarisation"} <= set(dark)


def test_an_edit_changes_what_is_needed(scalar_variant):
    """A lamp's own black surface, made grey."""
    scene = mi.load_dict({"type": "scene", "lamp": LAMP})
    assert not inspect(scene).smooth
    params = mi.traverse(scene)
    params["lamp.bsdf.reflectance.value"] = 0.1
    params.update()
    assert inspect(scene).smooth
