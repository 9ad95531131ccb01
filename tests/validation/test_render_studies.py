"""The studies of `refract_path` and of what a scene does not use, and defects that they must find."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract import backend
from mi_refract.plugins import path_loop, refract
from mi_refract.plugins.sampling import KeyedMultijitter
from validation.renders import gradients, invisible_changes, neighbours, random_numbers, unused_features
from validation.run.context import PROFILES, Context
from validation.run.glass_balls import alone
from validation.run.kernel_timing import kernels


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
    monkeypatch.setattr(unused_features, "GLASSES", (1, 5))
    rows = unused_features.glass_rows(context)
    assert {row.verdict for row in rows if row.subject == unused_features.PLUGIN} == {"pass"}
    assert all(row.values["compiled"] > 0 for row in rows if row.subject == unused_features.BUILTIN)
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
    monkeypatch.setattr(unused_features, "GLASSES", (5,))
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
    glass = path_loop.BOUNDARIES
    monkeypatch.setattr(path_loop, "BOUNDARIES", {*glass, "NormalMap"})
    rows = neighbours.rows("llvm_ad_rgb", "normalmap", ("refract", "diffuse", "measured"), ((1, 4),))
    assert {row.case for row in rows if row.broken} == {"normalmap: refract", "normalmap: split 1, 4 spp"}
    assert [row.reason for row in rows if not row.values] == ['Mitsuba: Property "filename" cannot be found!']
    monkeypatch.setattr(path_loop, "BOUNDARIES", {*glass, "BlendBSDF"})
    rows = invisible_changes.rows("llvm_ad_rgb", "glass", 2)
    assert [row.case.split(": ")[1] for row in rows if row.broken] == ["blend of itself"]


def test_a_direction_that_stays_attached_is_seen(context, monkeypatch):
    """Rough metal fails, glass does not: after its lobes the direction is attached in any case."""
    metal, glass = gradients.QUICK
    (sound,) = gradients.rows(context, metal)
    assert sound.verdict == "pass" and sound.values["detectable"] < 0.05
    monkeypatch.setattr(path_loop, "at_fixed_direction", lambda v, context, si, bsdf, bs, w, d, active: (w, d, bs.pdf))
    (attached,), (through,) = gradients.rows(context, metal), gradients.rows(context, glass)
    assert "z" in attached.broken and attached.values["off"] > 0.05
    assert through.verdict == "pass"


@pytest.mark.parametrize("case", ["`int_ior_B`", "`int_absorption`"])
def test_derivatives_in_what_only_refract_path_renders_are_those_of_differences(case, context):
    (row,) = gradients.rows(context, case)
    assert row.verdict == "pass" and row.values["detectable"] < 0.01


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
