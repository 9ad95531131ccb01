"""The studies of renders hold what they measure to its budget, see planted defects, and say what they leave out."""

import dataclasses

import mitsuba as mi
import numpy as np
import pytest

from mi_refract.plugins import refract as bsdf
from validation.renders import against_dielectric, colours
from validation.run import render_methods
from validation.run.context import SCENES


@pytest.fixture
def context(scalar_context):
    return scalar_context(resolution=8, spp=4, pairs=8, curve_spp=(1,))


def defective(props):
    """A plugin whose index is off by one part in a hundred."""
    plugin = bsdf.plugin_class(mi.scalar_rgb)(props)
    params = mi.traverse(plugin)
    params["eta"] = 1.01 * float(plugin.eta[0])
    params.update()
    return plugin


def tinted(props):
    props["specular_transmittance"] = 0.999
    return bsdf.plugin_class(mi.scalar_rgb)(props)


@pytest.mark.parametrize(("plugin", "verdict"), [("refract", "pass"), ("refract_defect", "fail")])
def test_renders_agree_and_see_an_index_that_is_off(context, plugin, verdict):
    mi.register_bsdf("refract_defect", defective)
    (row,) = against_dielectric._compare(context, SCENES / "sphere.xml", plugin)
    assert row.verdict == verdict, row.values
    assert sorted(path.name for path in (context.out / "images/sphere").iterdir()) == sorted(
        ["dielectric.exr", f"{plugin} difference.exr", f"{plugin} test.exr"]
    )
    assert set(row.curves) == ({"refract", "dielectric"} if plugin == "refract" else set())


def test_what_is_the_same_is_not_tested_by_chance_and_still_compared(context):
    """The furnace has no noise: no Welch test, but an image that is off fails; and NaN is no image at all."""
    mi.register_bsdf("refract_tinted", tinted)
    right, wrong = (
        against_dielectric._compare(context, SCENES / "furnace.xml", p)[0] for p in ("refract", "refract_tinted")
    )
    assert right.verdict == "pass" and right.reason.startswith("left out: Welch's test")
    assert "Welch alarms" not in right.values and not right.curves
    assert {"|mean ratio − 1|", "changed share"} <= set(wrong.broken)
    quiet, noisy = np.ones((4, 8, 8, 3)), np.random.default_rng(1).random((4, 8, 8, 3))
    assert against_dielectric._budgets("nested", "").keys() == {"|mean ratio − 1|", "Welch alarms"}
    assert against_dielectric._budgets("nested", "left out").keys() == {"|mean ratio − 1|", "changed share"}
    assert against_dielectric._budgets("mirage", "left out") == {}
    assert "bit for bit" in against_dielectric.no_question(noisy, noisy)
    assert "independent seeds" in against_dielectric.no_question(quiet + 1e-7, quiet)
    assert against_dielectric.no_question(quiet * np.nan, quiet) == against_dielectric.no_question(noisy, quiet) == ""


def test_an_image_of_colours_is_of_as_many_renders_as_its_noise_asks_for():
    """Of 48 × 48 numbers with a relative noise of 0.4: 64 renders leave 0.05; its estimate is off by 1 %."""
    rng = np.random.default_rng(5)

    def camera(spp, seed):
        return (rng.normal(2, 0.8, (48, 48, 3)),)

    for count, most, expected in ((16, 1, 16), (16, 2, 32), (16, 16, 64 + 16), (80, 4, 80)):
        image, noise, seeds = colours._mean(camera, 1, count, most)
        assert seeds == pytest.approx(expected, abs=16 if most == 16 else 0)
        assert noise == pytest.approx(0.4 / np.sqrt(seeds), rel=0.06)
        assert image.mean() == pytest.approx(2, rel=0.01)


def test_colours_are_shown_where_the_spectral_variant_runs(context, needs_variant):
    path = SCENES / "rainbow_drop.xml"
    (row,) = colours.scene_rows(context, path)
    assert (row.values, row.reason) == ({}, colours.SCALAR)
    needs_variant("llvm_ad_spectral")
    (row,) = colours.scene_rows(dataclasses.replace(context, variant="llvm_ad_rgb"), path)
    assert row.setting == "llvm_ad_spectral" and row.values[colours.COLOUR] > 0.1
    assert (context.out / row.images["test"]).is_file()
    assert mi.variant() == "scalar_rgb"


def test_a_scene_is_loaded_in_the_same_order_every_time(context):
    """Loading with Mitsuba's defaults gives one of two images, about one time in four the other one."""
    scenes = [render_methods.opened(SCENES / "diamond.xml", "dielectric", 8) for _ in range(12)]
    images = [render_methods.Camera(scene)(1, seed=0)[0] for scene in scenes]
    assert all((image == images[0]).all() for image in images)
