"""The studies of media, and defects that they must find."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.variants import switch

from mi_refract import backend, media
from mi_refract.media import dispersion, glass_catalogs
from mi_refract.planar import light
from mi_refract.plugins import index_parameter, path_loop, refract
from mi_refract.plugins.absorption import absorbed
from validation.media import catalogs, closed_forms, ray_directions, renders
from validation.run.context import PROFILES, Context

READS = pytest.mark.skipif(
    find_spec("opticalglass") is None, reason="opticalglass is not installed: pip install 'mi-refract[glass]'"
)


@READS
@pytest.mark.parametrize("catalog", glass_catalogs.CATALOGS)
def test_indices_are_those_of_the_catalogue(catalog):
    """At all printed lines the index that `opticalglass` computes; of some makers also the printed one."""
    row = catalogs._row(catalog)
    assert row.verdict == "pass"
    assert row.values["glasses"] > 100
    assert catalog not in catalogs.CONSISTENT or row.values["missing"] == 0


@READS
@pytest.mark.parametrize("catalog", ["SCHOTT", "HOYA"])
def test_a_formula_with_another_unit_is_found(catalog, monkeypatch):
    """Off by 1e-6, which moves n by 3e-8: far below a printed digit."""
    monkeypatch.setattr(glass_catalogs, "NANOMETRES", 1000.001)
    assert set(catalogs._row(catalog).broken) == {"formula error"}


@READS
def test_a_glass_with_the_numbers_of_another_is_found(monkeypatch):
    glasses = dict(glass_catalogs.read("SCHOTT"))
    glasses["N-BK7"] = replace(glasses["N-BK7"], printed=glasses["F2"].printed, v_d=glasses["F2"].v_d)
    monkeypatch.setattr(glass_catalogs, "read", lambda catalog: glasses)
    assert set(catalogs._row("SCHOTT").broken) == {"largest miss"}


def test_without_the_package_the_row_is_not_run(monkeypatch):
    monkeypatch.setattr(catalogs, "find_spec", lambda name: None)
    (row,) = catalogs._rows(None)
    assert row.verdict == "not run" and "pip install" in row.reason


# Directions, closed forms, renders --------------------------------------------------------------------------------

HERE = Context(PROFILES["quick"], Path(), "llvm_ad_rgb", backend.detect(), backend.usable_variants())
GLASS = "cauchy(1.5046, 4200)"


def spectral(needs_variant):
    needs_variant("llvm_ad_spectral")
    switch("llvm_ad_rgb")


def test_directions_are_at_the_rounding_limit(needs_variant):
    spectral(needs_variant)
    for row in ray_directions._rows(HERE, GLASS):
        assert row.verdict in ("pass", "not run"), (row.name, row.broken)


def test_an_index_that_is_rounded_to_float32_is_found(needs_variant, monkeypatch):
    spectral(needs_variant)
    at = index_parameter.DispersiveRatio.at
    monkeypatch.setattr(index_parameter.DispersiveRatio, "at", lambda *x: mi.Float64(mi.Float(at(*x))))
    row = ray_directions._sampled_row(media.parse(GLASS), GLASS, 4000)
    assert "error / bound" in row.broken


def test_a_formula_of_dispersion_that_is_off_by_1e_14_is_found(monkeypatch):
    index = dispersion.Terms.index
    monkeypatch.setattr(dispersion.Terms, "index", lambda *x: index(*x) * (1 + 1e-14))
    assert ray_directions._index_row(media.parse(GLASS), GLASS).verdict == "fail"


def test_closed_forms_are_met():
    for row in closed_forms._rows(HERE)[:-1]:
        assert row.verdict == "pass", (row.name, row.values)


def test_through_mitsubas_intersections_the_achromat_shifts_alike(needs_variant, monkeypatch):
    """Within 1 % of the shift between the wavelengths; with the index of the d line for all there is none."""
    spectral(needs_variant)
    assert closed_forms.mitsuba_row(HERE).values["off / chromatic shift"] < 0.01
    monkeypatch.setattr(refract, "is_followed", lambda asked: False)
    assert closed_forms.mitsuba_row(HERE).values["off / chromatic shift"] > 0.5


def test_an_index_off_by_1e_12_moves_prism_and_bows(monkeypatch):
    index = light.Light.indices
    monkeypatch.setattr(light.Light, "indices", lambda *x: tuple(n * (1 + 1e-12 * (n > 1)) for n in index(*x)))
    rows = [closed_forms.prism_row(), closed_forms.bow_row(1), closed_forms.bow_row(2)]
    # The prism's closed form takes the index of the scene, and its incidence with it.
    assert [row.verdict for row in rows] == ["pass", "fail", "fail"]


def test_an_index_off_by_1e_7_moves_the_focus(monkeypatch):
    trace = closed_forms._traced
    monkeypatch.setattr(closed_forms, "_traced", lambda scene, *rays: trace(off(scene, 1e-7), *rays))
    assert closed_forms.achromat_row().verdict == closed_forms.prism_row().verdict == "fail"


def off(scene, by):
    inside = [replace(s, n_left=np.where(s.n_left > 1, s.n_left * (1 + by), s.n_left)) for s in scene.segments]
    return replace(scene, segments=tuple(inside))


def test_a_weight_that_is_taken_twice_colours_the_furnace(needs_variant, monkeypatch):
    """At both boundaries that a path goes through."""
    spectral(needs_variant)
    step = path_loop.PathLoop._next

    def twice(self, s, si, bsdf, bs, weight, active):
        ray, throughput, changed = step(self, s, si, bsdf, bs, weight, active)
        return ray, throughput, changed | ({"wavelength_count": self.v.Float(1.1)} if self.features.dispersion else {})

    monkeypatch.setattr(path_loop.PathLoop, "_next", twice)
    (row,) = renders.furnace_rows(HERE, "llvm_ad_spectral", "by chance", {})
    assert row.broken


def test_a_slab_that_absorbs_1e_5_more_is_found(needs_variant, monkeypatch):
    spectral(needs_variant)
    assert renders.slab_row(HERE).verdict == "pass"
    monkeypatch.setattr(path_loop, "absorbed", lambda sigma, length: absorbed(1.00001 * sigma, length))
    assert renders.slab_row(HERE).verdict == "fail"


def test_media_that_absorb_half_as_much_again_differ_from_volpath(needs_variant, monkeypatch):
    spectral(needs_variant)
    (row,) = renders.volpath_rows(HERE, "nested")
    assert row.verdict == "pass"
    monkeypatch.setattr(path_loop, "absorbed", lambda sigma, length: absorbed(1.3 * sigma, length))
    (row,) = renders.volpath_rows(HERE, "nested")
    assert row.verdict == "fail"
