"""The studies of renders and media pass, and they detect planted defects."""

import dataclasses
import functools
import itertools
import math
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.variants import switch

from mi_refract import backend, media
from mi_refract.media import dispersion, glass_catalogs
from mi_refract.planar import light
from mi_refract.plugins import index_parameter, path_loop, refract
from mi_refract.plugins.absorption import absorbed
from mi_refract.plugins.sampling import KeyedMultijitter
from validation.media import catalogs, closed_forms, ray_directions, renders
from validation.renders import (
    against_dielectric,
    colours,
    gradients,
    invisible_changes,
    neighbours,
    random_numbers,
    rendering_passes,
    samplers,
    unused_features,
)
from validation.run import render_methods
from validation.run.context import PROFILES, SCENES, Context
from validation.run.glass_balls import alone
from validation.run.kernel_timing import kernels
from validation.run.seeds import STEP


@pytest.fixture
def small(scalar_context):
    return scalar_context(resolution=8, spp=4, pairs=8, curve_spp=(1,))


def defective(props):
    """A plugin whose index is off by 1 %."""
    plugin = refract.plugin_class(mi.scalar_rgb)(props)
    params = mi.traverse(plugin)
    params["eta"] = 1.01 * float(plugin.eta[0])
    params.update()
    return plugin


def tinted(props, transmittance=0.999):
    props["specular_transmittance"] = transmittance
    return refract.plugin_class(mi.scalar_rgb)(props)


@pytest.mark.parametrize(("plugin", "verdict"), [("refract", "pass"), ("refract_defect", "fail")])
def test_renders_agree_and_a_wrong_index_is_detected(small, plugin, verdict):
    mi.register_bsdf("refract_defect", defective)
    (row,) = against_dielectric._compare(small, SCENES / "sphere.xml", plugin)
    assert row.verdict == verdict, row.values
    assert sorted(path.name for path in (small.out / "images/sphere").iterdir()) == sorted(
        ["dielectric.exr", f"{plugin} difference.exr", f"{plugin} test.exr"]
    )
    assert set(row.curves) == ({"refract", "dielectric"} if plugin == "refract" else set())


def test_a_loss_far_below_the_noise_is_detected(small):
    """The same seeds: all that noise may do to the means is that of lobes chosen otherwise."""
    mi.register_bsdf("refract_lossy", functools.partial(tinted, transmittance=1 - 3e-5))
    (row,) = against_dielectric._compare(small, SCENES / "nested.xml", "refract_lossy")
    assert row.values["largest change"] < 1e-3, "no lobe is chosen otherwise, which would raise the bound"
    assert row.broken.keys() == {"|mean ratio − 1|"}, row.values


def test_images_without_noise_are_compared_without_a_statistical_test(small):
    """The furnace has no noise: no Welch test, but a wrong image fails. Images with NaN need the test."""
    mi.register_bsdf("refract_tinted", tinted)
    furnace = SCENES / "furnace.xml"
    right, wrong = (against_dielectric._compare(small, furnace, p)[0] for p in ("refract", "refract_tinted"))
    assert right.verdict == "pass" and right.reason.startswith("left out: Welch's test")
    assert "Welch alarms" not in right.values and not right.curves
    assert not right.images and wrong.images  # an image of one colour is not shown
    assert {"|mean ratio − 1|", "changed share"} <= set(wrong.broken)
    quiet, noisy = np.ones((4, 8, 8, 3)), np.random.default_rng(1).random((4, 8, 8, 3))
    assert against_dielectric._budgets("nested", "", 0.0).keys() == {"|mean ratio − 1|", "Welch alarms"}
    assert against_dielectric._budgets("nested", "left out", 0.0).keys() == {"|mean ratio − 1|", "changed share"}
    assert against_dielectric._budgets("mirage", "left out", 0.0) == {}
    assert "bit for bit" in against_dielectric.why_no_welch(noisy, noisy)
    assert "independent seeds" in against_dielectric.why_no_welch(quiet + 1e-7, quiet)
    assert against_dielectric.why_no_welch(quiet * np.nan, quiet) == against_dielectric.why_no_welch(noisy, quiet) == ""


def test_colours_are_shown_in_spectral_variants(small, needs_variant, monkeypatch):
    path = SCENES / "rainbow_drop.xml"
    (row,) = colours.scene_rows(small, path)
    assert (row.values, row.reason) == ({}, colours.SCALAR)
    needs_variant("llvm_ad_spectral")
    monkeypatch.setattr(colours, "MOST", 1)
    (row,) = colours.scene_rows(dataclasses.replace(small, variant="llvm_ad_rgb"), path)
    assert row.setting == "llvm_ad_spectral" and row.values[colours.COLOUR] > 0.1
    assert (small.out / row.images["test"]).is_file()
    assert mi.variant() == "scalar_rgb"


def test_a_scene_gives_the_same_image_every_time_it_is_loaded(small):
    """With Mitsuba's defaults, about one load in four gives a second image."""
    scenes = [render_methods.opened(SCENES / "diamond.xml", "dielectric", 8) for _ in range(12)]
    images = [render_methods.Camera(scene)(1, seed=0)[0] for scene in scenes]
    assert all((image == images[0]).all() for image in images)


@pytest.fixture
def context(tmp_path, llvm_variant):
    quick = dataclasses.replace(PROFILES["standard"], repeats=3)
    return Context(quick, tmp_path, "llvm_ad_rgb", backend.detect(), backend.usable_variants())


def by_case(rows):
    return {row.case: row for row in rows}


def failing(rows):
    return {row.case for row in rows if row.verdict == "fail"}


# Unused features -----------------------------------------------------------------------------------------------------


def test_unused_features_are_not_computed(context):
    rows = by_case(unused_features.operation_rows(context))
    assert {row.verdict for row in rows.values()} <= {"pass", "info"}
    assert rows["dispersion"].values["added"] > 0
    for lobe in unused_features.LOBES:
        assert rows[f"{lobe}, a bitmap"].values["added"] > rows[f"{lobe}, a number"].values["added"] > 0


def test_a_plugin_that_computes_unused_features_is_detected(context, monkeypatch):
    """It computes both lobes in radiance mode for every context, and directions by wavelength for every integrator."""
    plugin = refract.plugin_class(mi.llvm_ad_rgb)

    def sample(self, bsdf_context, si, sample1, sample2, active=True):
        bs, weight = plugin.sample(self, bsdf_context, si, sample1, sample2, active)
        unused, unused_weight = plugin.sample(self, mi.BSDFContext(), si, sample1, sample2, active)
        bs.pdf = bs.pdf + 1e-9 * (unused.pdf + unused.eta + unused_weight.x)
        return bs, weight

    mi.register_bsdf("refract", type("Planted", (plugin,), {"sample": sample}))  # in this variant only
    try:
        absent = dataclasses.replace(context, variants=dict.fromkeys(context.variants, "no"))
        rows = unused_features.operation_rows(absent)
    finally:
        refract.register(mi.llvm_ad_rgb)
    assert (by_case(rows)["polarised"].verdict, by_case(rows)["polarised"].reason) == ("not run", "no")
    assert failing(rows) == {"reflection only", "transmission only", "importance mode"}
    monkeypatch.setattr(refract, "is_followed", lambda context: True)
    assert failing(unused_features.wavelength_rows(context)) == {"dispersion, by `path`"}


def test_glasses_share_a_kernel_and_edits_and_gradient_steps_compile_nothing(context, monkeypatch):
    monkeypatch.setattr(unused_features, "GLASSES", (5,))
    (row,) = unused_features.rows_of_glasses(context, unused_features.PLUGIN)
    assert row.verdict == "pass"
    (row,) = unused_features.optimisation_rows(context)
    assert row.verdict == "pass" and row.values["eta moved"] > 1e-4
    original = refract.set_ratio

    def literal(self, eta):
        """Make the index a literal, which differs in each kernel."""
        original(self, eta)
        off = float(np.random.default_rng().uniform(0, 1e-9))
        faces = ((type(x), float(dr.detach(x)[0])) for x in (self.k_inner, self.k_outer))
        self.k_inner, self.k_outer = (number(x + off) for number, x in faces)

    monkeypatch.setattr(refract, "set_ratio", literal)
    monkeypatch.setattr(unused_features, "STEPS", 2)  # each step compiles
    (row,) = unused_features.rows_of_glasses(context, unused_features.PLUGIN)
    assert set(row.broken) == {"operations, over two glasses", "compiled"}
    assert failing(unused_features.optimisation_rows(context))


def test_the_first_image_is_not_cached(context):
    for _ in range(2):
        with alone(unused_features.PLUGIN, 1) as balls:
            first, later = (kernels(balls.image) for _ in range(2))
        largest = max(first, key=lambda entry: entry["operation_count"])
        assert not largest["cache_hit"] and not largest["cache_disk"]
        assert all(entry["cache_hit"] for entry in later)


def test_a_stale_frozen_image_is_detected(context, monkeypatch):
    monkeypatch.setattr(unused_features, "GLASSES", (3,))
    (row,) = unused_features.frozen_rows(context)
    assert row.verdict == "pass"
    # The built-in's index is a constant in the frozen function: its image is stale.
    stale = {"off after an edit": row.values["off after an edit, dielectric"]}
    assert stale["off after an edit"] > 0.01
    assert dataclasses.replace(row, values=row.values | stale).broken.keys() == stale.keys()


def test_scalar_variants_time_calls_and_give_the_reason_for_no_kernels(scalar_context):
    kernels, calls = (row for task in unused_features.tasks(scalar_context()) for row in task.run())
    assert (kernels.verdict, kernels.reason) == ("not run", unused_features.SCALAR)
    assert calls.values["call / dielectric"] > 1


# `refract_path` ------------------------------------------------------------------------------------------------------


def test_wrappers_that_are_split_like_glass_are_detected(llvm_variant, monkeypatch):
    """A wrapper that rejects a lobe, by the study of neighbours; a blend of glasses, by that of invisible changes."""
    glass, names = path_loop.BOUNDARIES, ("blend of itself", "flat normal map")
    changes = {name: change for name, change in invisible_changes.changes().items() if name in names}
    monkeypatch.setattr(invisible_changes, "changes", lambda: changes)
    monkeypatch.setattr(invisible_changes, "WAYS", {})
    monkeypatch.setattr(path_loop, "BOUNDARIES", {*glass, "NormalMap"})
    rows = neighbours.rows("llvm_ad_rgb", "normalmap", ("refract", "diffuse", "measured"), ((1, 4),))
    assert {row.case for row in rows if row.broken} == {"normalmap: refract", "normalmap: split 1, 4 spp"}
    assert [row.reason for row in rows if not row.values] == ['Mitsuba: Property "filename" cannot be found!']
    monkeypatch.setattr(path_loop, "BOUNDARIES", {*glass, "BlendBSDF"})
    rows = invisible_changes.rows("llvm_ad_rgb", "glass", 2)
    assert len(rows) == 2 and [row.case.split(": ")[1] for row in rows if row.broken] == ["blend of itself"]


def test_a_detectable_difference_is_detected_with_probability_one_half():
    """Within four standard errors of 200 trials, in gray images."""
    rng, size = np.random.default_rng(1), invisible_changes.SIZE

    def values(gain):
        sides = rng.normal([1, 1 + gain], 0.5, (invisible_changes.RENDERS, size, size, 2)).repeat(3, -1)
        return invisible_changes.compared(sides[..., :3], lambda seed: sides[..., 3:], 0)

    detectable = np.mean([values(0.0)["detectable"] for _ in range(20)])
    assert np.mean([values(detectable)["alarms"] > 0 for _ in range(200)]) == pytest.approx(0.5, abs=0.14)


@pytest.mark.parametrize(
    ("pixel", "second_stop", "broken"),
    [(1.001, 16, set()), (math.nan, 16, {"beyond", "outside"}), (1.001, 12, {rendering_passes.ALIKE})],
)
def test_renders_in_passes_without_a_number_or_a_choice_of_stop_fail(context, monkeypatch, pixel, second_stop, broken):
    def resume(job, *_, **__):
        render = mock.Mock(image=lambda: np.full((2, 2, 3), 1.0 if job.seed >= 2**31 else pixel))
        render.error.return_value = mock.Mock(value=1e-3, low=0.5e-3, high=2e-3)
        render.progress.passes = second_stop if job.seed % 2 else 12
        return render

    monkeypatch.setattr(rendering_passes, "resume", resume)
    (row,) = rendering_passes.error_rows(context, "sphere")
    assert row.broken.keys() == broken


def test_the_requested_error_leaves_the_stop_to_chance(context):
    (row,) = rendering_passes.error_rows(replace(context, profile=PROFILES["quick"]), "sphere")
    assert row.verdict == "pass" and 12 < row.values["passes"] < 16


def test_no_two_images_of_neighbours_have_a_seed_in_common(llvm_variant, monkeypatch):
    """The errors of BSDFs that do not share an image are independent, as their variances are added."""
    seeds = []

    def render(view, sensor, seed, **_):
        seeds.append(seed)
        return np.ones((*sensor.film().size()[::-1], 4))

    monkeypatch.setattr(neighbours.mi, "render", render)
    assert neighbours.rows("llvm_ad_rgb", "alone", ("diffuse", "plastic", "refract"), ((0, 4), (1, 4)))
    assert len(seeds) == len({*seeds}) > 12 and max(seeds) - min(seeds) < STEP


@pytest.mark.parametrize(("wrapper", "name"), [("alone", "refract_wedge"), ("alone", "hair"), ("twosided", "plastic")])
def test_only_bsdfs_that_mitsuba_is_known_to_reject_are_left_out(llvm_variant, monkeypatch, wrapper, name):
    monkeypatch.setattr(neighbours, "measured", lambda *_, **__: np.ones((2, 1, len(neighbours.CELLS))))
    names, settings = ("diffuse", "refract_wedge"), ((0, 4),)
    judged = neighbours.rows("llvm_ad_rgb", "twosided", names, settings)
    assert {row.verdict for row in judged if row.case.endswith("refract_wedge")} == {"not run"}
    broken = mock.Mock(side_effect=RuntimeError("a defect"))
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="a defect"):
        patch.setattr(neighbours, "inspect", broken)
        neighbours.rows("llvm_ad_rgb", wrapper, (name,), settings)
    monkeypatch.setitem(neighbours.BSDFS, name, {"formula": "none"})
    with pytest.raises(RuntimeError, match="formula"):
        neighbours.rows("llvm_ad_rgb", wrapper, (name,), settings)


def test_an_attached_direction_is_detected(context, monkeypatch):
    """Rough metal fails; glass does not, since the directions of its lobes are attached anyway."""
    metal, glass = gradients.QUICK  # both pass without the defect, see test_contract.py
    monkeypatch.setattr(path_loop, "at_fixed_direction", lambda v, context, si, bsdf, bs, w, d, *_: (w, d, bs.pdf))
    (attached,), (through,) = (gradients.rows(replace(context, profile=PROFILES["quick"]), x) for x in (metal, glass))
    assert "off / interval" in attached.broken and attached.values["off"] > 0.05
    assert through.verdict == "pass"


@pytest.mark.parametrize("detached", ["direction", "index"])
def test_detached_derivatives_are_detected(detached, context, monkeypatch):
    """Detaching the refracted direction gives the derivative of `path`; detaching the index gives none."""
    if detached == "index":
        monkeypatch.setattr(refract, "differentiated", lambda value: False)
    else:
        whole = refract.refract
        monkeypatch.setattr(refract, "refract", lambda *args: (ray := whole(*args))._replace(wo=dr.detach(ray.wo)))
    (row,) = gradients.rows(replace(context, profile=PROFILES["quick"]), "`eta`")
    assert "off / interval" in row.broken
    assert row.reason.startswith(gradients.BIASED if detached == "direction" else gradients.MISSING)


@pytest.mark.parametrize(
    ("off", "verdict"), [(0, "right"), (0.05, "biased"), (-0.5, "biased"), (-1, "missing: it is 0")]
)
def test_verdicts_on_derivatives_do_not_depend_on_the_seed(off, verdict):
    """For derivatives with 3 % of noise per render, and differences with 1 %."""
    case, rng = gradients.CASES["`eta`"], np.random.default_rng(7)
    for _ in range(100):
        draws = (1 + off) * (1 + 0.03 * rng.normal(size=64)), 1 + 0.01 * rng.normal(size=64)
        assert gradients.judged(draws[0].__getitem__, draws[1].__getitem__, case)[1] == verdict
    edge = replace(case, excluded="an edge moves")
    expected = verdict if verdict != "biased" else "missing: an edge moves"
    assert gradients.judged(draws[0].__getitem__, draws[1].__getitem__, edge)[1] == expected


def test_parameters_without_derivatives_are_rejected(llvm_variant):
    for key, text in (
        ("film.size", "no integrator differentiates 'sensor.film.size'; expected"),
        ("near_clip", "no integrator differentiates 'sensor.near_clip'; expected"),
        ("none", "0 parameters end with 'none'"),
    ):
        with pytest.raises(ValueError, match=text):
            gradients.Images(replace(gradients.CASES["`eta`"], key=key))


def test_the_derivative_in_a_coefficient_of_dispersion_is_right(context):
    (row,) = gradients.rows(context, "`int_ior_B`")
    assert row.verdict == "pass" and row.values["at most"] < 0.05


class OneSeed(KeyedMultijitter):
    """Permutes rows and columns by the seed of the cells, changed by constants: a defect that this package once had."""

    def next_2d(self, sampler, key):
        v, (permutation, noise) = self.v, self.v.sample_tea_32(self.pixel, key)
        cell = v.permute_kensler(self.index, self.count, permutation)
        row = cell // self.columns
        column = cell - row * self.columns
        inner_row = v.permute_kensler(row, self.rows, permutation ^ 0x68BC21EB)
        inner_column = v.permute_kensler(column, self.columns, permutation ^ 0x02E5BE93)
        x, y = (v.Float(word >> 8) * 2.0**-24 for word in v.sample_tea_32(self.lane, noise))
        x, y = (inner_row + x) / self.rows, (inner_column + y) / self.columns
        return v.Point2f((column + x) / self.columns, (row + y) / self.rows)


class Unpermuted(KeyedMultijitter):
    """Has the samples of a pixel in the same order in every dimension."""

    def next_1d(self, sampler, key):
        noise = self._unit(self.v.sample_tea_32(self.lane, key)[0])
        return self._placed(self.v.Float(self.index), noise, self.count)


class Dependent(KeyedMultijitter):
    """Too few rounds of the hash."""

    def independent(self, key, count):
        calls = [self.v.sample_tea_32(self.lane ^ self.pixel, key + i, rounds=4) for i in range(0, count, 2)]
        return [self._unit(word) for words in calls for word in words]


@pytest.mark.parametrize(
    ("source", "count", "failing"),
    [
        (KeyedMultijitter, 16, set()),
        (Dependent, 16, {"light at one vertex", "light at two vertices"}),
        (OneSeed, 4, {"two"}),
        (OneSeed, 64, {"two"}),
        (Unpermuted, 16, {"one", "one and one"}),
    ],
)
def test_numbers_that_are_not_uniform_are_detected(llvm_variant, source, count, failing):
    rows = random_numbers.rows(llvm_variant, (count,), 1, source)
    assert {row.case.split(",")[0] for row in rows if row.broken} == failing


def test_the_bias_of_a_sampler_is_detected_and_refract_path_has_none(llvm_variant):
    """False alarms: 1 in 1000 for each sampler of `refract_path`. The bias of `path` is 4 standard errors inside."""
    by_path, ours = (samplers.rows(llvm_variant, method, 48) for method in samplers.COMPARED)
    assert not any(row.broken for row in ours) and not any(row.budgets for row in by_path)
    (worst,) = (row for row in by_path if row.case == "ldsampler")
    assert worst.values["Welch alarms"] > 10 and 0.002 < abs(worst.values["bias of the image"]) < 0.01


# Media ----------------------------------------------------------------------------------------------------------------


NO_READER = any(find_spec(name) is None for name in catalogs.READERS)
READS = pytest.mark.skipif(NO_READER, reason="no opticalglass: bash .ci/setup dev")
HERE = Context(PROFILES["quick"], Path(), "llvm_ad_rgb", backend.detect(), backend.usable_variants())
GLASS = "cauchy(1.5046, 4200)"


@pytest.fixture
def spectral(needs_variant):
    needs_variant("llvm_ad_spectral")
    switch("llvm_ad_rgb")


@READS
@pytest.mark.parametrize("catalog", glass_catalogs.CATALOGS)
def test_indices_are_those_of_the_catalogue_and_a_wrong_unit_is_detected(catalog, monkeypatch):
    """A unit off by 1e-6 changes n by 3e-8, far below a printed digit."""
    row = catalogs.catalog_row(catalog)
    assert row.verdict == "pass" and row.values["glasses"] > 100
    assert catalog not in catalogs.CONSISTENT or row.values["missing"] == 0
    for module in (dispersion, glass_catalogs):
        monkeypatch.setattr(module, "NANOMETRES", 1000.001)
    assert set(catalogs.catalog_row(catalog).broken) == {"formula error"}


@READS
def test_a_glass_with_the_numbers_of_another_is_detected(monkeypatch):
    table, glasses = catalogs.tables("SCHOTT")
    glasses["N-BK7"] = replace(glasses["N-BK7"], lines=glasses["F2"].lines, v_d=glasses["F2"].v_d)
    monkeypatch.setattr(catalogs, "tables", lambda catalog: (table, glasses))
    assert set(catalogs.catalog_row("SCHOTT").broken) == {"largest miss"}
    monkeypatch.setattr(catalogs, "find_spec", lambda name: None)
    (row,) = catalogs.rows(None)
    assert row.verdict == "not run" and row.reason.endswith("bash .ci/setup validation")


@READS
def test_the_packages_file_is_written_from_the_makers_tables(tmp_path):
    catalogs.write(tmp_path / "glasses.json")
    assert (tmp_path / "glasses.json").read_bytes() == glass_catalogs.FILE.read_bytes()


def test_wrong_indices_are_detected_in_directions(spectral, monkeypatch):
    """An index rounded to float32, one off by 1e-14, and one that is NaN at one wavelength of many."""
    for row in ray_directions.rows(HERE, GLASS):
        assert row.verdict in ("pass", "not run"), (row.name, row.broken)
    at, index = index_parameter.DispersiveRatio.at, dispersion.Terms.index
    monkeypatch.setattr(index_parameter.DispersiveRatio, "at", lambda *x: mi.Float64(mi.Float(at(*x))))
    assert "error / bound" in ray_directions.sampled_row(media.parse(GLASS), GLASS, 4000).broken
    monkeypatch.setattr(dispersion.Terms, "index", lambda *x: index(*x) * (1 + 1e-14))
    assert ray_directions.index_row(media.parse(GLASS), GLASS).verdict == "fail"
    monkeypatch.undo()
    index, off = media.Medium.index, itertools.chain([1.0] * 9, [math.nan], itertools.repeat(1.0))
    monkeypatch.setattr(media.Medium, "index", lambda *x: index(*x) * next(off))
    assert ray_directions.index_row(media.parse(GLASS), GLASS).verdict == "fail"


def test_the_achromat_has_its_focal_shifts_through_mitsubas_intersections(spectral, monkeypatch):
    """Within 1 % of the shift between the wavelengths; if all have the index of the d line, there is no shift."""
    for followed, verdict in ((True, "pass"), (False, "fail")):
        monkeypatch.setattr(refract, "is_followed", lambda context, followed=followed: followed)
        row = closed_forms.mitsuba_row(HERE)
        assert row.verdict == verdict and (row.values["off / chromatic shift"] < 0.01) == followed


def test_wrong_indices_are_detected_by_prism_rainbows_and_focus(monkeypatch):
    """An index of the scene off by 1e-12 fails the rainbows; the prism's closed form uses the index of the scene."""
    rows = closed_forms.prism_row, lambda: closed_forms.bow_row(1), lambda: closed_forms.bow_row(2)
    rows = *rows, closed_forms.achromat_row
    index, trace = light.Light.indices, closed_forms.traced
    with monkeypatch.context() as patch:
        patch.setattr(light.Light, "indices", lambda *x, **y: tuple(n * (1 + 1e-12 * (n > 1)) for n in index(*x, **y)))
        assert [row().verdict for row in rows[:3]] == ["pass", "fail", "fail"]

    def off(scene, by):
        inside = [replace(s, n_left=np.where(s.n_left > 1, s.n_left * (1 + by), s.n_left)) for s in scene.segments]
        return replace(scene, segments=tuple(inside))

    monkeypatch.setattr(closed_forms, "traced", lambda scene, *rays: trace(off(scene, 1e-7), *rays))
    assert [row().verdict for row in rows] == ["fail"] * 4


def test_a_weight_applied_twice_colours_the_furnace(spectral, monkeypatch):
    """At both boundaries of a path."""
    step = path_loop.PathLoop._next

    def twice(self, s, si, bsdf, bs, weight, active):
        ray, throughput, changed = step(self, s, si, bsdf, bs, weight, active)
        return ray, throughput, changed | ({"wavelength_count": self.v.Float(1.1)} if self.features.dispersion else {})

    monkeypatch.setattr(path_loop.PathLoop, "_next", twice)
    (row,) = renders.furnace_rows(HERE, "llvm_ad_spectral", "by chance")
    assert row.broken


def test_a_slab_without_a_number_fails(llvm_variant, monkeypatch):
    monkeypatch.setattr(renders.mi, "render", lambda *_, **__: np.full((1, 1, 3), np.nan))
    (row,) = renders.slab_rows(HERE)
    assert row.broken


def test_media_that_absorb_too_much_are_detected(spectral, monkeypatch):
    """By 1e-5 in a slab; by a tenth in a scene against `volpath`, which changes its mean by 2 to 4 %: p < 1e-28."""
    monkeypatch.setattr(renders, "SIZE", 24)
    scenes = [functools.partial(renders.volpath_rows, name=name) for name in ("nested", "matt inside")]
    for factor, rows in ((1.00001, renders.slab_rows), *((1.1, rows) for rows in scenes)):
        assert [row.verdict for row in rows(HERE)] == ["pass"]
        with monkeypatch.context() as patch:
            patch.setattr(path_loop, "absorbed", lambda sigma, length, f=factor: absorbed(f * sigma, length))
            assert [row.verdict for row in rows(HERE)] == ["fail"]
