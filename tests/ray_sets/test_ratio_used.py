"""Answers that say which ratio of indices they are for: an error of the index is told from one of the direction."""

from __future__ import annotations

import dataclasses
import io
import json
from xml.etree import ElementTree

import numpy as np
import pytest
from rich.console import Console
from support.media_rays import ALL, FLINT, answered

from mi_refract import oracle
from mi_refract.ray_sets import media_rays, ray_set, reports
from mi_refract.ray_sets.check_answers import check
from mi_refract.ray_sets.ray_set import Answers

NAMES, COUNT = ("generic", "critical", "grazing"), 60


@pytest.fixture(scope="module", params=ray_set.PRECISIONS)
def rays(request):
    return ray_set.make(NAMES, COUNT, request.param, 2, **ALL)


def off(rays, factor, rows=slice(None)):
    """The ratios of a program whose glass is another, in the set's precision."""
    k = rays.rays.k.copy()
    k[rows] *= k.dtype.type(factor)
    return k


def printed(found):
    stream = io.StringIO()
    Console(file=stream, width=1000).print(reports.table(found), highlight=False)
    return stream.getvalue()


def test_a_program_that_is_right(rays):
    found = check(rays, answered(rays))
    assert (found.exit_code, found.wrong, found.problems, found.ratio.largest) == (0, 0, (), 0)
    assert "n_ratio: the largest relative difference to n_from / n_to is 0 " in printed(found)
    without = check(rays, answered(rays, said=False))
    assert without.ratio is None
    assert "n_ratio" not in reports.as_data(without) and "n_ratio" not in printed(without)


def test_another_index_is_no_wrong_direction(rays):
    """Of the directions that it gives none is wrong; without the column, all seem so."""
    k = off(rays, 1 + 3e-4)
    found = check(rays, answered(rays, k))
    assert (found.exit_code, found.wrong, found.problem_count("index")) == (1, 0, len(rays))
    assert found.ratio.largest == pytest.approx(3e-4, rel=1e-3)
    sentence = reports.sentence(found)
    assert sentence.startswith(f"{len(rays)} answers, all right; ")
    assert sentence.endswith(f"; {len(rays)} answers are for a different ratio of indices")
    without = check(rays, answered(rays, k, said=False))
    assert without.exit_code == 1 and without.wrong > len(rays) / 3 and not without.problem_count("index")


def test_another_direction_is_no_wrong_index(rays):
    found = check(rays, answered(rays, direction=1 / rays.rays.k))
    assert (found.exit_code, found.diagnosis.mistake) == (1, "eta inverted")
    assert found.ratio.largest == 0 and not found.problem_count("index")
    both = check(rays, answered(rays, off(rays, 1.01), direction=1 / off(rays, 1.01)))
    assert both.wrong > 0 and both.problem_count("index") == len(rays)
    assert "are wrong: eta inverted; 180 answers are for a different" in reports.sentence(both)


def test_the_ray_with_the_largest_difference_is_named(rays):
    k = off(rays, 1 + 1e-3, [4, 70])
    k[70] *= k.dtype.type(1 - 5e-3)
    found = check(rays, answered(rays, k))
    assert (found.ratio.id, found.ratio.ray) == (70, media_rays.described(rays.header, 70))
    assert f"(id 70, {found.ratio.ray}); up to 1e-5 counts as equal" in printed(found)
    assert "2 answers used a different ratio of indices (n_ratio): ids 4, 70" in printed(found)


ULP = {precision: float(np.finfo(dtype).eps) for precision, dtype in ray_set.PRECISIONS.items()}
CASES = [("f64", ALL, 1 + x, abs(x) > 1e-5) for x in (9e-6, -9e-6, 1.1e-5, -1.1e-5)]
CASES += [(name, {}, 1 + ulps * ULP[name], ulps > 4) for name in ULP for ulps in (3, 5)]


@pytest.mark.parametrize(("precision", "of_media", "factor", "counts"), CASES)
def test_a_maker_s_five_decimals_leave_some_open_and_a_ratio_in_the_file_nothing_but_rounding(
    precision, of_media, factor, counts
):
    rays = ray_set.make(["generic"], 12, precision, **of_media)
    given = dataclasses.replace(answered(rays), n_ratio=rays.rays.k.astype(float) * factor)
    found = check(rays, given)
    assert bool(found.problem_count("index")) == counts
    assert bool(found.ratio.ray) == bool(of_media)


def test_directions_are_certified_for_the_ratio_as_it_is_written():
    """In float64, also in a set of float32."""
    rays = ray_set.make(["generic", "critical"], 60, "f32", **ALL)
    ratio = rays.rays.k.astype(float) * (1 + 4e-6)
    exact = oracle.refract(*(getattr(rays.rays, x).astype(float) for x in "an"), ratio, fresnel=False, progress=False)
    found = check(rays, Answers(rays.ids, np.where(exact.transmitted[:, None], exact.direction, 0), n_ratio=ratio))
    assert (found.exit_code, found.total("exact")) == (0, len(rays))


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
@pytest.mark.parametrize("ratio", [1e-9, 1e9])
def test_the_least_and_the_largest_ratio_are_judged(precision, ratio):
    rays = ray_set.make(["generic", "near-normal"], 30, precision)
    found = check(rays, dataclasses.replace(answered(rays), n_ratio=np.full(len(rays), ratio)))
    assert found.exit_code == 1 and found.wrong > 0 and found.problem_count("index") == len(rays)


def test_total_internal_reflection_is_that_of_the_ratio_used():
    """Rays just inside of the critical angle of the set, which the program's own glass reflects."""
    rays = ray_set.make(["critical"], 400, **ALL)
    found, without = (check(rays, answered(rays, off(rays, 1 + 1e-3), said=said), tir="zero") for said in (True, False))
    assert (found.wrong, found.total("tir_beyond_bound")) == (0, 0)
    assert without.total("tir_beyond_bound") > 20


def test_every_report_has_it(tmp_path):
    rays = ray_set.make(["generic"], 12, **ALL)
    found = check(rays, answered(rays, off(rays, 1.001, [4])))
    reports.write_json(tmp_path / "a.json", found)
    data = json.loads((tmp_path / "a.json").read_text())
    ray = f"{FLINT} to air at 587.561829 nm"
    assert data["n_ratio"] == {"largest": pytest.approx(1e-3, rel=1e-3), "id": 4, "ray": ray, "tolerance": 1e-5}
    assert data["problems"] == [{"kind": "index", "count": 1, "text": "id 4"}]
    reports.write_junit(tmp_path / "a.xml", found, "answers")
    (failure,) = ElementTree.parse(tmp_path / "a.xml").getroot().iter("failure")
    assert "1 answers used a different ratio of indices" in failure.get("message")
    reports.write_html(tmp_path / "a.html", found, {})
    page = (tmp_path / "a.html").read_text()
    assert "<dt>ratio of indices</dt><dd>n_ratio: the largest relative difference" in page
