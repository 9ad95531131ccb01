"""The studies of renders and of media: they hold what they measure to its budget, and see planted defects."""

import dataclasses
import functools
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

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
    unused_features,
)
from validation.run import render_methods
from validation.run.context import PROFILES, SCENES, Context
from validation.run.glass_balls import alone
from validation.run.kernel_timing import kernels


@pytest.fixture
def small(scalar_context):
    return scalar_context(resolution=8, spp=4, pairs=8, curve_spp=(1,))


def defective(props):
    """A plugin whose index is off by one part in a hundred."""
    plugin = refract.plugin_class(mi.scalar_rgb)(props)
    params = mi.traverse(plugin)
    params["eta"] = 1.01 * float(plugin.eta[0])
    params.update()
    return plugin


def tinted(props):
    props["specular_transmittance"] = 0.999
    return refract.plugin_class(mi.scalar_rgb)(props)


@pytest.mark.parametrize(("plugin", "verdict"), [("refract", "pass"), ("refract_defect", "fail")])
def test_renders_agree_and_see_an_index_that_is_off(small, plugin, verdict):
    mi.register_bsdf("refract_defect", defective)
    (row,) = against_dielectric._compare(small, SCENES / "sphere.xml", plugin)
    assert row.verdict == verdict, row.values
    assert sorted(path.name for path in (small.out / "images/sphere").iterdir()) == sorted(
        ["dielectric.exr", f"{plugin} difference.exr", f"{plugin} test.exr"]
    )
    assert set(row.curves) == ({"refract", "dielectric"} if plugin == "refract" else set())


def test_what_is_the_same_is_not_tested_by_chance_and_still_compared(small):
    """The furnace has no noise: no Welch test, but an image that is off fails; and NaN is no image at all."""
    mi.register_bsdf("refract_tinted", tinted)
    right, wrong = (
        against_dielectric._compare(small, SCENES / "furnace.xml", p)[0] for p in ("refract", "refract_tinted")
    )
    assert right.verdict == "pass" and right.reason.startswith("left out: Welch's test")
    assert "Welch alarms" not in right.values and not right.curves
    assert not right.images and wrong.images  # of one colour there is nothing to see
    assert {"|mean ratio − 1|", "changed share"} <= set(wrong.broken)
    quiet, noisy = np.ones((4, 8, 8, 3)), np.random.default_rng(1).random((4, 8, 8, 3))
    assert against_dielectric._budgets("nested", "").keys() == {"|mean ratio − 1|", "Welch alarms"}
    assert against_dielectric._budgets("nested", "left out").keys() == {"|mean ratio − 1|", "changed share"}
    assert against_dielectric._budgets("mirage", "left out") == {}
    assert "bit for bit" in against_dielectric.no_question(noisy, noisy)
    assert "independent seeds" in against_dielectric.no_question(quiet + 1e-7, quiet)
    assert against_dielectric.no_question(quiet * np.nan, quiet) == against_dielectric.no_question(noisy, quiet) == ""


def test_colours_are_shown_where_the_spectral_variant_runs(small, needs_variant, monkeypatch):
    path = SCENES / "rainbow_drop.xml"
    (row,) = colours.scene_rows(small, path)
    assert (row.values, row.reason) == ({}, colours.SCALAR)
    needs_variant("llvm_ad_spectral")
    monkeypatch.setattr(colours, "MOST", 1)
    (row,) = colours.scene_rows(dataclasses.replace(small, variant="llvm_ad_rgb"), path)
    assert row.setting == "llvm_ad_spectral" and row.values[colours.COLOUR] > 0.1
    assert (small.out / row.images["test"]).is_file()
    assert mi.variant() == "scalar_rgb"


def test_a_scene_is_loaded_in_the_same_order_every_time(small):
    """Loading with Mitsuba's defaults gives one of two images, about one time in four the other one."""
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


# What a scene does not use -------------------------------------------------------------------------------------------


def test_a_feature_that_is_not_asked_for_is_not_computed(context):
    rows = by_case(unused_features.operation_rows(context))
    assert {row.verdict for row in rows.values()} <= {"pass", "info"}
    assert rows["dispersion"].values["added"] > 0
    for lobe in unused_features.LOBES:
        assert rows[f"{lobe}, a bitmap"].values["added"] > rows[f"{lobe}, a number"].values["added"] > 0


def test_a_plugin_that_computes_what_nobody_asks_for_is_seen(context, monkeypatch):
    """Both lobes in radiance mode, whatever it is asked for; and the direction by the wavelength, for everybody."""
    plugin = refract.plugin_class(mi.llvm_ad_rgb)

    def sample(self, asked, si, sample1, sample2, active=True):
        bs, weight = plugin.sample(self, asked, si, sample1, sample2, active)
        other, wasted = plugin.sample(self, mi.BSDFContext(), si, sample1, sample2, active)
        bs.pdf = bs.pdf + 1e-9 * (other.pdf + other.eta + wasted.x)
        return bs, weight

    mi.register_bsdf("refract", type("Planted", (plugin,), {"sample": sample}))  # in this variant only
    try:
        rows = unused_features.operation_rows(
            dataclasses.replace(context, variants=dict.fromkeys(context.variants, "no"))
        )
    finally:
        refract.register(mi.llvm_ad_rgb)
    assert (by_case(rows)["polarised"].verdict, by_case(rows)["polarised"].reason) == ("not run", "no")
    assert failing(rows) == {"reflection only", "transmission only", "importance mode"}
    monkeypatch.setattr(refract, "is_followed", lambda asked: True)
    assert failing(unused_features.wavelength_rows(context)) == {"dispersion, by `path`"}


def test_glasses_share_a_kernel_and_neither_an_edit_nor_a_step_compiles(context, monkeypatch):
    monkeypatch.setattr(unused_features, "GLASSES", (5,))
    (row,) = unused_features.rows_of_glasses(context, unused_features.PLUGIN)
    assert row.verdict == "pass"
    (row,) = unused_features.optimisation_rows(context)
    assert row.verdict == "pass" and row.values["eta moved"] > 1e-4
    original = refract.set_ratio

    def literal(self, eta):
        """The index is a literal, another one in each kernel."""
        original(self, eta)
        off = float(np.random.default_rng().uniform(0, 1e-9))
        faces = ((type(x), float(dr.detach(x)[0])) for x in (self.k_inner, self.k_outer))
        self.k_inner, self.k_outer = (number(x + off) for number, x in faces)

    monkeypatch.setattr(refract, "set_ratio", literal)
    monkeypatch.setattr(unused_features, "STEPS", 2)  # each of which compiles
    (row,) = unused_features.rows_of_glasses(context, unused_features.PLUGIN)
    assert set(row.broken) == {"operations, over two glasses", "compiled"}
    assert failing(unused_features.optimisation_rows(context))


def test_a_first_image_is_one_that_no_cache_knows(context):
    for _ in range(2):
        with alone(unused_features.PLUGIN, 1) as balls:
            first, later = (kernels(balls.image) for _ in range(2))
        largest = max(first, key=lambda entry: entry["operation_count"])
        assert not largest["cache_hit"] and not largest["cache_disk"]
        assert all(entry["cache_hit"] for entry in later)


def test_a_frozen_image_that_does_not_follow_an_edit_is_seen(context, monkeypatch):
    monkeypatch.setattr(unused_features, "GLASSES", (3,))
    (row,) = unused_features.frozen_rows(context)
    assert row.verdict == "pass"
    # The built-in's index is a number that Dr.Jit does not see: its frozen image is stale.
    stale = {"off after an edit": row.values["off after an edit, dielectric"]}
    assert stale["off after an edit"] > 0.01
    assert dataclasses.replace(row, values=row.values | stale).broken.keys() == stale.keys()


def test_scalar_variants_have_calls_and_say_why_they_have_no_kernels(scalar_context):
    none, calls = (row for task in unused_features.tasks(scalar_context()) for row in task.run())
    assert (none.verdict, none.reason) == ("not run", unused_features.SCALAR)
    assert calls.values["call / dielectric"] > 1


# `refract_path` ------------------------------------------------------------------------------------------------------


def test_a_wrapper_that_is_split_as_if_it_were_glass_is_seen(llvm_variant, monkeypatch):
    """One that refuses a lobe, beside other BSDFs; and one of two glasses, as a change that must not be seen."""
    glass, some = path_loop.BOUNDARIES, ("blend of itself", "flat normal map")
    changes = {name: change for name, change in invisible_changes.changes().items() if name in some}
    monkeypatch.setattr(invisible_changes, "changes", lambda: changes)
    monkeypatch.setattr(invisible_changes, "WAYS", {})
    monkeypatch.setattr(path_loop, "BOUNDARIES", {*glass, "NormalMap"})
    rows = neighbours.rows("llvm_ad_rgb", "normalmap", ("refract", "diffuse", "measured"), ((1, 4),))
    assert {row.case for row in rows if row.broken} == {"normalmap: refract", "normalmap: split 1, 4 spp"}
    assert [row.reason for row in rows if not row.values] == ['Mitsuba: Property "filename" cannot be found!']
    monkeypatch.setattr(path_loop, "BOUNDARIES", {*glass, "BlendBSDF"})
    rows = invisible_changes.rows("llvm_ad_rgb", "glass", 2)
    assert len(rows) == 2 and [row.case.split(": ")[1] for row in rows if row.broken] == ["blend of itself"]


def test_a_direction_that_stays_attached_is_seen(context, monkeypatch):
    """Rough metal fails, glass does not: after its lobes the direction is attached in any case."""
    metal, glass = gradients.QUICK  # both pass without the defect, see test_contract.py
    monkeypatch.setattr(
        path_loop, "at_fixed_direction", lambda v, context, si, bsdf, bs, w, d, active, own: (w, d, bs.pdf)
    )
    (attached,), (through,) = (gradients.rows(replace(context, profile=PROFILES["quick"]), x) for x in (metal, glass))
    assert "off / interval" in attached.broken and attached.values["off"] > 0.05
    assert through.verdict == "pass"


@pytest.mark.parametrize("detached", ["direction", "index"])
def test_a_derivative_that_is_detached_is_seen(detached, context, monkeypatch):
    """The refracted direction alone is what `path` leaves out; without the index nothing is left."""
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
def test_a_verdict_is_the_same_for_every_seed(off, verdict):
    """Of derivatives that scatter by 3 % from render to render, and differences by 1 %."""
    case, rng = gradients.CASES["`eta`"], np.random.default_rng(7)
    for _ in range(100):
        draws = (1 + off) * (1 + 0.03 * rng.normal(size=64)), 1 + 0.01 * rng.normal(size=64)
        assert gradients.judged(draws[0].__getitem__, draws[1].__getitem__, case)[1] == verdict
    edge = replace(case, excluded="an edge moves")
    assert gradients.judged(draws[0].__getitem__, draws[1].__getitem__, edge)[1] == (
        verdict if verdict != "biased" else "missing: an edge moves"
    )


def test_a_parameter_that_nothing_differentiates_is_refused(llvm_variant):
    for key, text in (
        ("film.size", "no integrator differentiates 'sensor.film.size'; expected"),
        ("near_clip", "no integrator differentiates 'sensor.near_clip'; expected"),
        ("none", "0 parameters end with 'none'"),
    ):
        with pytest.raises(ValueError, match=text):
            gradients.Images(replace(gradients.CASES["`eta`"], key=key))


def test_the_derivative_in_a_coefficient_of_dispersion_is_that_of_differences(context):
    (row,) = gradients.rows(context, "`int_ior_B`")
    assert row.verdict == "pass" and row.values["at most"] < 0.05


class OneSeed(KeyedMultijitter):
    """Rows and columns are permuted by the seed of the cells, changed by constants: as this package once did."""

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
    """The samples of a pixel in the same order in every dimension."""

    def next_1d(self, sampler, key):
        noise = self._unit(self.v.sample_tea_32(self.lane, key)[0])
        return self._placed(self.v.Float(self.index), noise, self.count)


@pytest.mark.parametrize(
    ("source", "count", "failing"),
    [
        (KeyedMultijitter, 16, set()),
        (OneSeed, 4, {"two"}),
        (OneSeed, 64, {"two"}),
        (Unpermuted, 16, {"one", "one and one"}),
    ],
)
def test_numbers_that_do_not_fill_the_square_are_seen(llvm_variant, source, count, failing):
    rows = random_numbers.rows(llvm_variant, (count,), 1, source)
    assert {row.case.split(",")[0] for row in rows if row.broken} == failing


# Media ----------------------------------------------------------------------------------------------------------------


READS = pytest.mark.skipif(
    any(find_spec(name) is None for name in catalogs.READERS), reason="no opticalglass: bash .ci/setup dev"
)
HERE = Context(PROFILES["quick"], Path(), "llvm_ad_rgb", backend.detect(), backend.usable_variants())
GLASS = "cauchy(1.5046, 4200)"


@pytest.fixture
def spectral(needs_variant):
    needs_variant("llvm_ad_spectral")
    switch("llvm_ad_rgb")


@READS
@pytest.mark.parametrize("catalog", glass_catalogs.CATALOGS)
def test_indices_are_those_of_the_catalogue_and_another_unit_is_found(catalog, monkeypatch):
    """Off by 1e-6, which moves n by 3e-8: far below a printed digit."""
    row = catalogs.catalog_row(catalog)
    assert row.verdict == "pass" and row.values["glasses"] > 100
    assert catalog not in catalogs.CONSISTENT or row.values["missing"] == 0
    for module in (dispersion, glass_catalogs):
        monkeypatch.setattr(module, "NANOMETRES", 1000.001)
    assert set(catalogs.catalog_row(catalog).broken) == {"formula error"}


@READS
def test_a_glass_with_the_numbers_of_another_is_found(monkeypatch):
    table, glasses = catalogs.tables("SCHOTT")
    glasses["N-BK7"] = replace(glasses["N-BK7"], lines=glasses["F2"].lines, v_d=glasses["F2"].v_d)
    monkeypatch.setattr(catalogs, "tables", lambda catalog: (table, glasses))
    assert set(catalogs.catalog_row("SCHOTT").broken) == {"largest miss"}
    monkeypatch.setattr(catalogs, "find_spec", lambda name: None)
    (row,) = catalogs.rows(None)
    assert row.verdict == "not run" and row.reason.endswith("bash .ci/setup validation")


@READS
def test_the_packages_file_is_what_is_written_of_the_makers_tables(tmp_path):
    catalogs.write(tmp_path / "glasses.json")
    assert (tmp_path / "glasses.json").read_bytes() == glass_catalogs.FILE.read_bytes()


def test_a_wrong_index_is_found_in_directions(spectral, monkeypatch):
    """One that is rounded to float32, and one that is off by 1e-14."""
    for row in ray_directions.rows(HERE, GLASS):
        assert row.verdict in ("pass", "not run"), (row.name, row.broken)
    at, index = index_parameter.DispersiveRatio.at, dispersion.Terms.index
    monkeypatch.setattr(index_parameter.DispersiveRatio, "at", lambda *x: mi.Float64(mi.Float(at(*x))))
    assert "error / bound" in ray_directions.sampled_row(media.parse(GLASS), GLASS, 4000).broken
    monkeypatch.setattr(dispersion.Terms, "index", lambda *x: index(*x) * (1 + 1e-14))
    assert ray_directions.index_row(media.parse(GLASS), GLASS).verdict == "fail"


def test_through_mitsubas_intersections_the_achromat_shifts_alike(spectral, monkeypatch):
    """Within 1 % of the shift between the wavelengths; with the index of the d line for all there is none."""
    for followed, verdict in ((True, "pass"), (False, "fail")):
        monkeypatch.setattr(refract, "is_followed", lambda asked, followed=followed: followed)
        row = closed_forms.mitsuba_row(HERE)
        assert row.verdict == verdict and (row.values["off / chromatic shift"] < 0.01) == followed


def test_an_index_that_is_off_moves_prism_bows_and_focus(monkeypatch):
    """By 1e-12 the bows; the prism's closed form takes the index of the scene, and its incidence with it."""
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


def test_a_weight_that_is_taken_twice_colours_the_furnace(spectral, monkeypatch):
    """At both boundaries that a path goes through."""
    step = path_loop.PathLoop._next

    def twice(self, s, si, bsdf, bs, weight, active):
        ray, throughput, changed = step(self, s, si, bsdf, bs, weight, active)
        return ray, throughput, changed | ({"wavelength_count": self.v.Float(1.1)} if self.features.dispersion else {})

    monkeypatch.setattr(path_loop.PathLoop, "_next", twice)
    (row,) = renders.furnace_rows(HERE, "llvm_ad_spectral", "by chance")
    assert row.broken


def test_media_that_absorb_more_are_found(spectral, monkeypatch):
    """A slab by 1e-5, and a scene against `volpath` by a tenth, which moves its mean by 2 to 4 %: p < 1e-28."""
    monkeypatch.setattr(renders, "SIZE", 24)
    scenes = [functools.partial(renders.volpath_rows, name=name) for name in ("nested", "matt inside")]
    for factor, rows in ((1.00001, renders.slab_rows), *((1.1, rows) for rows in scenes)):
        assert [row.verdict for row in rows(HERE)] == ["pass"]
        with monkeypatch.context() as patch:
            patch.setattr(path_loop, "absorbed", lambda sigma, length, f=factor: absorbed(f * sigma, length))
            assert [row.verdict for row in rows(HERE)] == ["fail"]
