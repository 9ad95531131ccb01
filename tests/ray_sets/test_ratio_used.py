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
from mi_refract.io import image_file
from mi_refract.ray_sets import files, media_rays, ray_set, reports
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


def index_problem(found):
    return [(each.count, each.text) for each in found.problems if each.kind == "index"]


def printed(found):
    stream = io.StringIO()
    Console(file=stream, width=1000).print(reports.table(found), highlight=False)
    return stream.getvalue()


# Index and direction


def test_a_program_that_is_right(rays):
    found = check(rays, answered(rays))
    assert (found.exit_code, found.wrong, found.problems) == (0, 0, ())
    assert found.ratio.largest == 0
    assert "n_ratio: the largest relative difference to n_from / n_to is 0 " in printed(found)
    assert reports.as_data(found)["n_ratio"]["largest"] == 0


def test_another_index_is_no_wrong_direction(rays):
    """Of the directions that it gives none is wrong; without the column, all seem so."""
    k = off(rays, 1 + 3e-4)
    found = check(rays, answered(rays, k))
    assert (found.exit_code, found.wrong) == (1, 0)
    assert [count for count, _ in index_problem(found)] == [len(rays)]
    assert found.ratio.largest == pytest.approx(3e-4, rel=1e-3)
    sentence = reports.sentence(found)
    assert sentence.startswith(f"{len(rays)} answers, all right; ")
    assert sentence.endswith(f"; {len(rays)} answers are for another ratio of indices")
    without = check(rays, answered(rays, k, said=False))
    assert without.exit_code == 1 and without.wrong > len(rays) / 3
    assert without.ratio is None and not index_problem(without)


def test_another_direction_is_no_wrong_index(rays):
    found = check(rays, answered(rays, direction=1 / rays.rays.k))
    assert (found.exit_code, found.diagnosis.mistake) == (1, "eta inverted")
    assert found.ratio.largest == 0 and not index_problem(found)
    assert "another ratio" not in reports.sentence(found)


def test_both_are_wrong(rays):
    k = off(rays, 1.01)
    found = check(rays, answered(rays, k, direction=1 / k))
    assert found.wrong > 0 and index_problem(found)[0][0] == len(rays)
    assert reports.sentence(found).endswith(
        f"are wrong: eta inverted; {len(rays)} answers are for another ratio of indices"
    )


def test_the_ray_with_the_largest_difference_is_named(rays):
    k = off(rays, 1 + 1e-3, [4, 70])
    k[70] *= k.dtype.type(1 - 5e-3)
    found = check(rays, answered(rays, k))
    assert index_problem(found) == [(2, "ids 4, 70")]
    assert found.ratio.id == 70
    assert found.ratio.ray == media_rays.described(rays.header, 70)
    assert f"(id 70, {found.ratio.ray}); up to 1e-5 is none" in printed(found)
    assert "2 answers used another ratio of indices, n_ratio: ids 4, 70" in printed(found)


@pytest.mark.parametrize(("factor", "others"), [(1 + 9e-6, 0), (1 - 9e-6, 0), (1 + 1.1e-5, 1), (1 - 1.1e-5, 1)])
def test_the_five_decimals_of_a_maker_leave_some_open(factor, others):
    rays = ray_set.make(["generic"], 12, "f64", **ALL)
    assert len(index_problem(check(rays, answered(rays, off(rays, factor))))) == others


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
@pytest.mark.parametrize(("ulps", "others"), [(3, 0), (5, 1)])
def test_a_ratio_that_the_file_gives_is_that_ratio(precision, ulps, others):
    """Without media nothing is left open but rounding."""
    rays = ray_set.make(["generic"], 12, precision)
    ratio = rays.rays.k.astype(float) * (1 + ulps * float(np.finfo(rays.rays.k.dtype).eps))
    given = dataclasses.replace(answered(rays), n_ratio=ratio)
    found = check(rays, given)
    assert len(index_problem(found)) == others
    assert found.ratio.ray == ""


def test_directions_are_certified_for_the_ratio_as_it_is_written():
    """In float64, also in a set of float32."""
    rays = ray_set.make(["generic", "critical"], 60, "f32", **ALL)
    ratio = rays.rays.k.astype(float) * (1 + 4e-6)
    exact = oracle.refract(*(getattr(rays.rays, x).astype(float) for x in "an"), ratio, fresnel=False, progress=False)
    b = np.where(exact.transmitted[:, None], exact.direction, 0)
    found = check(rays, Answers(rays.ids, b, n_ratio=ratio))
    assert (found.exit_code, found.total("exact")) == (0, len(rays))


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
@pytest.mark.parametrize("ratio", [1e-9, 1e9])
def test_the_least_and_the_largest_ratio_are_judged(precision, ratio):
    rays = ray_set.make(["generic", "near-normal"], 30, precision)
    found = check(rays, dataclasses.replace(answered(rays), n_ratio=np.full(len(rays), ratio)))
    assert found.exit_code == 1 and found.wrong > 0
    assert index_problem(found)[0][0] == len(rays)


def test_total_internal_reflection_is_that_of_the_ratio_used():
    """Rays just inside of the critical angle of the set, which the program's own glass reflects."""
    rays = ray_set.make(["critical"], 400, **ALL)
    k = off(rays, 1 + 1e-3)
    found, without = (check(rays, answered(rays, k, said=said), tir="zero") for said in (True, False))
    assert (found.wrong, found.total("tir_beyond_bound")) == (0, 0)
    assert without.total("tir_beyond_bound") > 20


# Files


def written(folder, ending, answers, names):
    columns = {"transmitted": answers.transmitted, "n_ratio": answers.n_ratio}
    more = {name: columns[name] for name in names}
    numbers = np.column_stack([answers.ids, answers.b, *more.values()]).astype(float)
    path = folder / f"answers.{ending}"
    if ending == "npz":
        np.savez(path, id=answers.ids, b=answers.b, **more)
    elif ending == "exr":
        image_file.write_exr(path, numbers[None].astype(np.float32), (*files.ANSWER_COLUMNS, *names))
    else:
        path.write_text(files.with_header({}, (*files.ANSWER_COLUMNS, *names), numbers))
    return path


@pytest.mark.parametrize("names", [(), ("transmitted",), ("n_ratio",), ("transmitted", "n_ratio")])
@pytest.mark.parametrize("ending", ["csv", "npz", "exr"])
def test_either_column_both_or_none(tmp_path, ending, names):
    rays = ray_set.make(NAMES, COUNT, "f32", 2, **ALL)
    some = answered(rays, off(rays, 1 + 2e-4, slice(0, 90)))
    given = dataclasses.replace(some, transmitted=some.b.any(1))
    path = written(tmp_path, ending, given, names)
    found = files.read_answers(path)
    for name in ("transmitted", "n_ratio"):
        column = getattr(found, name)
        assert (column is not None) == (name in names)
        if column is not None:
            np.testing.assert_array_equal(column, getattr(given, name))
    np.testing.assert_array_equal(found.b, given.b)
    findings = check(rays, found)
    assert (findings.ratio is not None) == ("n_ratio" in names)


@pytest.mark.parametrize("ratio", ["nan", "inf", "0", "-1.5", "1e-10", "1e10"])
def test_ratios_that_are_none(tmp_path, ratio):
    path = tmp_path / "answers.csv"
    path.write_text(f"id,bx,by,bz,n_ratio\n0,0,0,1,1.5\n1,0,0,1,{ratio}\n2,0,0,1,{ratio}\n")
    with pytest.raises(ValueError, match=r"n_ratio is \S+ for 2 rays; expected n_from / n_to, 1e-09 … 1e\+09$"):
        files.read_answers(path)


def test_names_of_columns_that_are_accepted():
    with pytest.raises(ValueError) as caught:
        files.parse_answers("id,bx,by,bz,n_ratio,transmitted\n")
    assert str(caught.value).endswith(
        "expected, in this order: id,bx,by,bz or id,bx,by,bz,transmitted or id,bx,by,bz,n_ratio"
        " or id,bx,by,bz,transmitted,n_ratio"
    )
    with pytest.raises(ValueError, match="answers: b is"):
        Answers(np.arange(2), np.zeros((2, 3)), n_ratio=np.ones(3))


# Reports


def test_every_report_has_it(tmp_path):
    rays = ray_set.make(["generic"], 12, **ALL)
    found = check(rays, answered(rays, off(rays, 1.001, [4])))
    reports.write_json(tmp_path / "a.json", found)
    data = json.loads((tmp_path / "a.json").read_text())
    assert data["n_ratio"] == {
        "largest": pytest.approx(1e-3, rel=1e-3), "id": 4, "ray": f"{FLINT} to air at 587.561829 nm", "accepted": 1e-5
    }  # fmt: skip
    assert data["problems"] == [{"kind": "index", "count": 1, "text": "id 4"}]
    reports.write_junit(tmp_path / "a.xml", found, "answers")
    (failure,) = ElementTree.parse(tmp_path / "a.xml").getroot().iter("failure")
    assert "1 answers used another ratio of indices" in failure.get("message")
    reports.write_html(tmp_path / "a.html", found, {})
    page = (tmp_path / "a.html").read_text()
    assert "<dt>ratio of indices</dt><dd>n_ratio: the largest relative difference" in page


def test_reports_of_answers_without_it_are_what_they_were(tmp_path):
    rays = ray_set.make(["generic"], 12)
    found = check(rays, answered(rays, said=False))
    assert "n_ratio" not in reports.as_data(found) and "n_ratio" not in printed(found)
    reports.write_html(tmp_path / "a.html", found, {})
    assert "ratio of indices" not in (tmp_path / "a.html").read_text()
