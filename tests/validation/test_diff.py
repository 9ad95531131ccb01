"""The studies of the comparison: their images and their glass are what they say, and each sees a planted defect."""

from __future__ import annotations

import types
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract.image_diff import flip, folders, self_test, tile_statistics
from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import METHODS, compare
from mi_refract.image_diff.settings import Settings
from validation import limits, tables
from validation.diff import planted_defects, times, visible_changes, welch_nulls
from validation.run import tightness


def test_spoilt_glass_is_spoilt_as_it_says(scalar_context):
    rows = [row for task in planted_defects.tasks(scalar_context()) for row in task.run()]
    assert {row.verdict for row in rows} == {"not run"}
    planted_defects.register(mi.scalar_rgb)

    def glass(name):
        """Of index 1.5; without a name as it should be."""
        plugin = f"{planted_defects.GLASS} {name}" if name else "refract"
        return mi.load_dict({"type": plugin, "int_ior": 1.5, "ext_ior": 1.0})

    def sampled(name, cos_i, sample1):
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = mi.Vector3f(np.sqrt(1 - cos_i**2), 0, cos_i)
        bs, weight = glass(name).sample(mi.BSDFContext(), si, sample1, mi.Point2f(0.5))
        return bs.sampled_component, weight[0]

    right, inside = sampled("", 0.8, 0.9), -0.3  # beyond the critical angle
    for name, cos_i, sample1, component, weight in (
        ("missing η²", 0.8, 0.9, 1, right[1] * 1.5**2),
        ("missing η²", 0.8, 0.0, 0, 1),
        ("", inside, 0.5, 0, 1),
        ("black TIR", inside, 0.5, 0, 0),
        ("black TIR", 0.8, 0.0, 0, 1),
        ("swapped lobes", 0.8, 0.9, 0, 1),
        ("swapped lobes", 0.8, 0.0, 1, right[1]),
        ("swapped lobes", inside, 0.0, 0, 1),
    ):
        assert sampled(name, cos_i, sample1) == (component, pytest.approx(weight)), name
    for name, eta in (("IOR + 0.5 %", 1.5075), ("IOR + 1e-3", 1.501), ("flipped normal", 1 / 1.5)):
        assert mi.traverse(glass(name))["eta"][0] == pytest.approx(eta)
    images = np.split(planted_defects.opened("prism", resolution=8, count=3)(4, 0)[0], 3, axis=1)  # side by side
    mean = np.mean([planted_defects.opened("prism", resolution=8)(16, seed)[0] for seed in range(8)], 0)
    assert all(np.corrcoef(image.ravel(), mean.ravel())[0, 1] > 0.6 for image in images)
    assert abs(np.corrcoef(*((image - mean).ravel() for image in images[:2]))[0, 1]) < 0.5  # they are independent


def test_the_defects_are_seen_and_no_other_sampler(llvm_variant, monkeypatch):
    monkeypatch.setattr(planted_defects, "TRIALS", 2)
    glasses = {"flipped normal": planted_defects.GLASSES["flipped normal"]}
    monkeypatch.setattr(planted_defects, "GLASSES", glasses)
    context = types.SimpleNamespace(variant="llvm_ad_rgb")
    rows = {row.subject: row for row in planted_defects.defect_rows(context, "prism")}
    assert (rows["flipped normal"].values["welch"], rows["flipped normal"].verdict) == (1, "pass")
    assert [rows["other sampler"].values[method] for method in ("welch", "exact")] == [0, 1]


def test_what_nobody_sees_is_equal_and_what_a_person_sees_is_different():
    rows = {name: visible_changes.kind_row(name, 2) for name in visible_changes.KINDS}
    assert {row.verdict for row in rows.values()} == {"pass", "info"}
    dues = {name: due for name, (_, _, due) in visible_changes.KINDS.items()}
    assert min(list(dues.values()).count(due) for due in (False, True)) >= 3
    for name, (_, make, due) in visible_changes.KINDS.items():
        assert due is None or (rows[name].values[visible_changes.ERROR] > 1) == due  # None: nothing is demanded
        one, two = make(np.random.default_rng(5))
        assert not np.array_equal(one.pixels, two.pixels), name
    limit_rows = visible_changes.limit_rows()
    codes = np.array([row.values[visible_changes.CODES] for row in limit_rows[:-1]])
    assert np.isnan(codes[0]) and codes[-1] < 12
    assert (np.diff(codes[~np.isnan(codes)]) <= 0).all()  # the wider, the fainter
    assert 1 < limit_rows[-1].values[visible_changes.PIXELS] <= 2
    other = [replace(row, case=f"{row.case}, other seed 1") for row in (*rows.values(), *limit_rows)]
    text = tables.visible([*rows.values(), *limit_rows, *other])
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    assert [line[0] for line in lines[2 : 2 + len(rows)]] == list(rows)
    assert (lines[2][2], lines[2][-1], lines[-1][:2]) == ("not seen", "0.0%", ["codes of 255", "never"])
    assert [lines[0][i].split("(")[1] for i in (3, 4, 5)] == ["bound 0.5)", "bound 0.12)", "bound 31)"]


def test_the_table_of_defects_is_made_of_the_rows_of_the_self_test():
    rng = np.random.default_rng(1)
    rows = self_test.examine(rng.gamma(16, 1 / 16, (4, 16, 16, 3)), "noise", trials=1, null_pairs=2)
    lines = tables.seen(rows).splitlines()
    assert lines[0].startswith("noise; 1 trials each of 2 renders a side. Minimum detectable difference in a tile: ")
    assert [line.split("|")[1].strip() for line in lines[4:-1]] == list(self_test.DEFECTS)
    assert lines[-2].count("not read") == len(METHODS)
    assert [cell.strip() for cell in lines[-1].split("|")[2:4]] == ["identical", "0 of 4"]


@pytest.mark.parametrize(
    "local, patch, one_way, failed",
    [
        (0.1, 0.12, 31, {"one code", "a quarter pixel"}),
        (0.5, 0.03, 31, {"one code"}),
        (0.5, 0.12, 10, {"half a pixel"}),
        (1.0, 1.0, 31, {"line", "light on a surface"}),
        (9.0, 0.12, 999, {"line", "moved object", "colour of an object", "dot", "facet"}),
        (0.5, 1.0, 999, {"light on a surface", "dot", "facet"}),
    ],
)
def test_bounds_elsewhere_fail(monkeypatch, local, patch, one_way, failed):
    real = flip.flip
    monkeypatch.setattr(flip, "flip", lambda *pair: real(*pair, local=local, patch=patch, one_way=one_way))
    assert {visible_changes.kind_row(name, 2).verdict for name in failed} == {"fail"}


@pytest.mark.parametrize("name", ["one code", "line"])
def test_errors_without_a_number_fail(name, monkeypatch):
    assert visible_changes.kind_row(name, 2).verdict == "pass"
    monkeypatch.setattr(visible_changes, "errors", lambda pair: (0.0, 0.0, 0.0, np.nan))
    assert visible_changes.kind_row(name, 2).verdict == "fail"


@pytest.mark.parametrize("defect", [False, True])
def test_a_side_that_does_not_know_its_noise_is_seen(defect, monkeypatch):
    """Each side's noise taken at its word, as `welch` once did."""
    compare = tile_statistics.compare_tiles

    def by_its_own_word(one, two, *more):
        return compare(replace(one, count=1.0), replace(two, count=1.0), *more)

    if defect:
        monkeypatch.setattr(tile_statistics, "compare_tiles", by_its_own_word)
    rows = welch_nulls.null_rows("fireflies 0.001", quick=True, pairs=8)
    assert any(row.broken for row in rows) is defect


@pytest.mark.parametrize(
    ("factor", "broken"),
    [(1, set()), (np.nan, {"missed"}), (np.inf, {"missed"}), (10, {"seen at half"}), (0.1, {"missed"})],
)
def test_a_wrong_minimum_detectable_difference_fails_in_every_profile(factor, broken, monkeypatch):
    right = tile_statistics.TileTests.minimum_detectable
    monkeypatch.setattr(welch_nulls, "POWER", {"variances": ((64, 64),)})
    monkeypatch.setattr(tile_statistics.TileTests, "minimum_detectable", lambda x, level=0: factor * right(x, level))
    (row,) = welch_nulls.power_rows(min(welch_nulls.PLANTED.values()))
    assert row.broken.keys() == broken | ({"missed at half"} if "missed" in broken else set())


def test_a_difference_that_is_detected_but_called_inconclusive_is_missed(monkeypatch):
    def undecided(*pair, **options):
        result = compare(*pair, **options)
        return result.but(Verdict.INCONCLUSIVE, "undecided") if result.verdict is Verdict.DIFFERENT else result

    monkeypatch.setattr(welch_nulls, "POWER", {"renders": ((256, 256),)})
    monkeypatch.setattr(welch_nulls, "compare", undecided)
    (row,) = welch_nulls.power_rows(min(welch_nulls.PLANTED.values()))
    assert row.broken.keys() == {"missed"}


def test_the_bounds_of_all_null_pairs_are_explained():
    assert [x for x in welch_nulls.FORMS if not tightness.excluded(welch_nulls.NAME, x, "alarms")] == []


def test_what_is_timed(tmp_path):
    """An image that differs is what the page shows; the folder's images are equal for what `auto` tests."""
    small = times.Size(48, 64, 2, 6)
    times.write(tmp_path, small)
    one, other, many = tmp_path / "a/0.exr", tmp_path / "b/0.exr", (tmp_path / "many_a", tmp_path / "many_b")
    assert folders.diff(one, other, Settings.for_all(method="tolerance")).exit_code == 1
    assert folders.diff(tmp_path / "a", tmp_path / "b", renders=True).exit_code == 1
    assert (folders.diff(*many).exit_code, len(folders.diff(*many).results)) == (0, small.pairs)
    assert folders.diff(*many, Settings.for_all(method="exact")).exit_code == 1
    with pytest.raises(OSError, match=r"diff, times: mi-refract: .*no such"):  # is no measurement
        times.python("-m", "mi_refract.cli", "diff", str(tmp_path / "none.exr"), str(one))
    rows = {row.subject: row for row in times.measure(small, "any")}
    assert rows.keys() >= {"welch", "tolerance", "auto", "page", "memory", "size of the page"}
    assert {name for name, row in rows.items() if "time / reading" in row.values} == {*METHODS, "auto"}
    assert not [row for row in rows.values() if row.goals]  # they are those of another size
    assert rows["memory"].values["MB of memory"] > 10
    assert 0.02 < rows["size of the page"].values["MB of page"] < limits.PAGE_MEGABYTES
