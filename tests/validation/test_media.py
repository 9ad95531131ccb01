"""The studies of media, and defects that they must find."""

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
    monkeypatch.setattr(glass_catalogs, "NANOMETRES", 1000.001)
    assert set(catalogs.catalog_row(catalog).broken) == {"formula error"}


@READS
def test_a_glass_with_the_numbers_of_another_is_found(monkeypatch):
    glasses = dict(glass_catalogs.read("SCHOTT"))
    glasses["N-BK7"] = replace(glasses["N-BK7"], printed=glasses["F2"].printed, v_d=glasses["F2"].v_d)
    monkeypatch.setattr(glass_catalogs, "read", lambda catalog: glasses)
    assert set(catalogs.catalog_row("SCHOTT").broken) == {"largest miss"}
    monkeypatch.setattr(catalogs, "find_spec", lambda name: None)
    (row,) = catalogs.rows(None)
    assert row.verdict == "not run" and "pip install" in row.reason


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
    assert closed_forms.mitsuba_row(HERE).values["off / chromatic shift"] < 0.01
    monkeypatch.setattr(refract, "is_followed", lambda asked: False)
    assert closed_forms.mitsuba_row(HERE).values["off / chromatic shift"] > 0.5


def test_an_index_that_is_off_moves_prism_bows_and_focus(monkeypatch):
    """By 1e-12 the bows; the prism's closed form takes the index of the scene, and its incidence with it."""
    rows = closed_forms.prism_row, lambda: closed_forms.bow_row(1), lambda: closed_forms.bow_row(2)
    rows = *rows, closed_forms.achromat_row
    index, trace = light.Light.indices, closed_forms.traced
    with monkeypatch.context() as patch:
        patch.setattr(light.Light, "indices", lambda *x: tuple(n * (1 + 1e-12 * (n > 1)) for n in index(*x)))
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
    """A slab by 1e-5; half as much again differs from `volpath`."""
    for factor, rows in ((1.00001, renders.slab_rows), (1.3, lambda context: renders.volpath_rows(context, "nested"))):
        assert [row.verdict for row in rows(HERE)] == ["pass"]
        with monkeypatch.context() as patch:
            patch.setattr(path_loop, "absorbed", lambda sigma, length, f=factor: absorbed(f * sigma, length))
            assert [row.verdict for row in rows(HERE)] == ["fail"]
