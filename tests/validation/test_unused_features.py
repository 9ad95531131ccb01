"""What a scene does not use costs nothing; the study sees a plugin that breaks this."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract import backend
from mi_refract.plugins import refract
from validation.renders import unused_features
from validation.run.context import PROFILES, Context


@pytest.fixture
def context(tmp_path, llvm_variant):
    quick = dataclasses.replace(PROFILES["standard"], repeats=3)
    return Context(quick, tmp_path, "llvm_ad_rgb", backend.detect(), backend.usable_variants())


def planted(monkeypatch, **methods):
    """The study's plugin, with methods of its own: `name=function of the sound plugin's method`."""
    plugin = refract.plugin_class(getattr(mi, mi.variant()))
    own = {name: wrap(getattr(plugin, name)) for name, wrap in methods.items()}
    mi.register_bsdf("refract_planted", type("Planted", (plugin,), own))
    monkeypatch.setattr(unused_features, "PLUGIN", "refract_planted")


def literal(original):
    def face(self, eta):
        original(self, eta)
        self.k_inner, self.k_outer = (type(self.k_inner)(float(dr.detach(x)[0])) for x in (self.k_inner, self.k_outer))

    return face


def deaf(original):
    """A `sample` that computes what both lobes in radiance mode need, whatever it is asked for."""

    def sample(self, asked, si, sample1, sample2, active=True):
        bs, weight = original(self, asked, si, sample1, sample2, active)
        other, wasted = original(self, mi.BSDFContext(), si, sample1, sample2, active)
        bs.pdf = bs.pdf + 1e-9 * (other.pdf + other.eta + wasted.x)
        return bs, weight

    return sample


def by_case(rows):
    return {row.case: row for row in rows}


def test_a_feature_that_is_not_asked_for_is_not_computed(context):
    rows = by_case(unused_features.operation_rows(context))
    assert {row.verdict for row in rows.values()} <= {"pass", "info"}
    for lobe in unused_features.LOBES:
        assert rows[f"{lobe}, a bitmap"].values["added"] > rows[f"{lobe}, a number"].values["added"] > 0


def test_a_plugin_that_does_not_listen_is_seen(context, monkeypatch):
    planted(monkeypatch, sample=deaf)  # in this variant only
    nothing_else = dict.fromkeys(context.variants, "no")
    rows = by_case(unused_features.operation_rows(dataclasses.replace(context, variants=nothing_else)))
    assert (rows["polarised"].verdict, rows["polarised"].reason) == ("not run", "no")
    assert {case for case, row in rows.items() if row.verdict == "fail"} == {
        "reflection only",
        "transmission only",
        "importance mode",
    }


def test_dispersion_and_absorption_cost_nothing_where_they_are_not(context, monkeypatch):
    rows = by_case(unused_features.wavelength_rows(context))
    assert {row.verdict for row in rows.values()} == {"pass", "info"}
    assert rows["dispersion"].values["added"] > 0
    monkeypatch.setattr(refract, "is_followed", lambda asked: True)  # bends light by its wavelength for everybody
    rows = by_case(unused_features.wavelength_rows(context))
    assert {case for case, row in rows.items() if row.verdict == "fail"} == {"dispersion, by `path`"}


def test_glasses_share_a_kernel_and_an_edit_compiles_nothing(context, monkeypatch):
    monkeypatch.setattr(unused_features, "GLASSES", (1, 5))
    rows = unused_features.glass_rows(context)
    assert {row.verdict for row in rows if row.subject == unused_features.PLUGIN} == {"pass"}
    assert all(row.values["compiled"] > 0 for row in rows if row.subject == unused_features.BUILTIN)
    monkeypatch.setattr(refract, "set_ratio", literal(refract.set_ratio))
    monkeypatch.setattr(unused_features, "GLASSES", (5,))
    (row,) = unused_features.rows_of_glasses(context, unused_features.PLUGIN)
    assert set(row.broken) == {"operations, over two glasses", "compiled"}


def test_steps_of_an_optimisation_compile_nothing(context, monkeypatch):
    (row,) = unused_features.optimisation_rows(context)
    assert row.verdict == "pass"
    assert row.values["eta moved"] > 1e-4

    def restless(original):
        def face(self, eta):
            original(self, eta)
            number = float(dr.detach(self.k_inner)[0])
            self.k_inner = type(self.k_inner)(number + float(np.random.default_rng().uniform(0, 1e-9)))

        return face

    monkeypatch.setattr(refract, "set_ratio", restless(refract.set_ratio))
    monkeypatch.setattr(unused_features, "STEPS", 2)  # each of which compiles
    (row,) = unused_features.optimisation_rows(context)
    assert row.verdict == "fail"


def test_a_first_image_is_one_that_no_cache_knows(context):
    for _ in range(2):
        with unused_features.alone(unused_features.PLUGIN, 1) as balls:
            first, later = (unused_features.kernels(balls.image) for _ in range(2))
        largest = max(first, key=lambda entry: entry["operation_count"])
        assert not largest["cache_hit"]
        assert not largest["cache_disk"]
        assert all(entry["cache_hit"] for entry in later)


def test_a_frozen_image_that_does_not_follow_an_edit_is_seen(context, monkeypatch):
    monkeypatch.setattr(unused_features, "GLASSES", (3,))
    (row,) = unused_features.frozen_rows(context)
    assert row.verdict == "pass"
    # The built-in's index is a number that Dr.Jit does not see: its frozen image is stale.
    assert row.values["off after an edit, dielectric"] > 0.01
    stale = {"off after an edit": row.values["off after an edit, dielectric"]}
    assert dataclasses.replace(row, values=row.values | stale).broken.keys() == stale.keys()


def test_paths_through_the_mirage_are_longer_than_the_built_in_s(context):
    """65,536 paths; in the furnace both draw the same numbers, and 1e-3 is 50 of them."""
    furnace, mirage = (row.values["boundaries / dielectric"] for row in unused_features.boundary_rows(context))
    assert furnace == pytest.approx(1, abs=1e-3)
    assert mirage > 1.03


def test_scalar_variants_have_calls_and_say_why_they_have_no_kernels(scalar_context):
    none, calls = (row for task in unused_features.tasks(scalar_context()) for row in task.run())
    assert (none.verdict, none.reason) == ("not run", unused_features.SCALAR)
    assert calls.values["call / dielectric"] > 1
