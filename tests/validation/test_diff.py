"""The studies of the comparison: their images and their glass are what they say, and each sees a planted defect."""

from __future__ import annotations

import types
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract.image_diff import flip, folders, self_test, tile_statistics
from mi_refract.image_diff.methods import METHODS
from mi_refract.image_diff.settings import Settings
from mi_refract.report.row import Row
from validation import limits, readme_tables
from validation.diff import planted_defects, times, visible_changes, welch_nulls

# Planted defects ---------------------------------------------------------------------------------------------------


@pytest.fixture
def glass(scalar_context):
    """`glass(name)`: a spoilt glass of index 1.5; `glass("")` is as it should be."""
    scalar_context()
    planted_defects.register(mi.scalar_rgb)
    kind = {"int_ior": 1.5, "ext_ior": 1.0}
    return lambda name: mi.load_dict({"type": f"{planted_defects.GLASS} {name}" if name else "refract", **kind})


def test_spoilt_glass_is_spoilt_as_it_says(glass):
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
    etas = {name: mi.traverse(glass(name))["eta"][0] for name in planted_defects.GLASSES}
    assert etas["IOR + 0.5 %"] == pytest.approx(1.5075)
    assert etas["IOR + 1e-3"] == pytest.approx(1.501)
    assert etas["flipped normal"] == pytest.approx(1 / 1.5)


def test_cameras_side_by_side_are_independent_renders(scalar_context):
    scalar_context()
    images = np.split(planted_defects.opened("prism", resolution=8, count=3)(4, 0)[0], 3, axis=1)
    mean = np.mean([planted_defects.opened("prism", resolution=8)(16, seed)[0] for seed in range(8)], 0)
    assert not np.array_equal(images[0], images[1])
    assert all(np.corrcoef(image.ravel(), mean.ravel())[0, 1] > 0.6 for image in images)
    assert abs(np.corrcoef(*((image - mean).ravel() for image in images[:2]))[0, 1]) < 0.5


def test_a_scalar_variant_is_not_run_with_the_reason(scalar_context):
    rows = [row for task in planted_defects.tasks(scalar_context()) for row in task.run()]
    assert {row.verdict for row in rows} == {"not run"}


def test_the_defects_are_seen_and_no_other_sampler(llvm_variant, monkeypatch):
    monkeypatch.setattr(planted_defects, "TRIALS", 2)
    glasses = {"flipped normal": planted_defects.GLASSES["flipped normal"]}
    monkeypatch.setattr(planted_defects, "GLASSES", glasses)
    context = types.SimpleNamespace(variant="llvm_ad_rgb")
    rows = {row.subject: row for row in planted_defects.defect_rows(context, "prism")}
    assert (rows["flipped normal"].values["welch"], rows["flipped normal"].verdict) == (1, "pass")
    assert [rows["other sampler"].values[method] for method in ("welch", "exact")] == [0, 1]


def test_the_table_says_what_was_not_read_and_which_pairs_are_identical():
    def row(subject, values, reason=""):
        replay = {"trials": 8, "renders a side": 6}
        return Row(self_test.STUDY, subject, "prism", "", values, reason=reason, replay=replay)

    seen = dict.fromkeys(METHODS, 1.0)
    alarms = {"false alarms": 0.5, "null pairs": 4.0}
    rows = [
        row("gain", seen | {"missed": 0.0, self_test.DETECTABLE: 0.02}),
        row("truncated", {self_test.UNREADABLE: 1.0, "missed": 0.0}, "not read"),
        *(row(f"null pairs, {m}", alarms, self_test.IDENTICAL if m == "exact" else "") for m in METHODS),
    ]
    lines = {line.split("|")[1].strip(): line for line in readme_tables.seen(rows).splitlines() if "|" in line}
    assert lines["truncated"].count("not read") == len(METHODS) and "%" not in lines["truncated"]
    (nothing,) = (line for name, line in lines.items() if name.startswith("nothing"))
    assert nothing.count("identical") == 1 and nothing.count("2 of 4") == len(METHODS) - 1


# Visible changes ---------------------------------------------------------------------------------------------------

KINDS = visible_changes.KINDS


@pytest.fixture(scope="module")
def visible():
    return {name: visible_changes.kind_row(name, 4) for name in KINDS}


def test_what_nobody_sees_is_equal_and_what_a_person_sees_is_different(visible):
    assert {row.verdict for row in visible.values()} == {"pass", "info"}
    dues = [kind.due for kind in KINDS.values()]
    assert dues.count(False) >= 3 and dues.count(True) >= 3
    for name, row in visible.items():
        if KINDS[name].due is not None:  # else it is seen by some, in some images: nothing is demanded
            assert (row.values[visible_changes.ERROR] > 1) == KINDS[name].due
        one, two = KINDS[name].make(np.random.default_rng(5))
        assert not np.array_equal(one.pixels, two.pixels), name
    assert visible_changes.kind_row("highlight", 4) == visible["highlight"]  # the same seed gives the same


@pytest.mark.parametrize(
    "local, patch, failed",
    [
        (0.1, 0.12, {"one code", "a quarter pixel"}),
        (0.5, 0.03, {"one code"}),
        (1.0, 1.0, {"line", "moved object", "brighter surface", "light on a surface"}),
        (9.0, 0.12, {"line", "moved object", "colour of an object"}),
        (0.5, 1.0, {"brighter surface", "light on a surface"}),
    ],
)
def test_bounds_elsewhere_fail(monkeypatch, local, patch, failed):
    real = flip.flip
    monkeypatch.setattr(flip, "flip", lambda *pair: real(*pair, local=local, patch=patch))
    assert {visible_changes.kind_row(name, 4).verdict for name in failed} == {"fail"}


def test_the_record_of_what_is_not_seen(visible):
    rows = visible_changes.limit_rows()
    codes = np.array([row.values[visible_changes.CODES] for row in rows if visible_changes.CODES in row.values])
    assert np.isnan(codes[0]) and codes[-1] < 12
    assert (np.diff(codes[~np.isnan(codes)]) <= 0).all()  # the wider, the fainter
    assert 1 < rows[-1].values[visible_changes.PIXELS] <= 2
    text = readme_tables.visible([*visible.values(), *rows])
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    assert [line[0] for line in lines[2 : 2 + len(KINDS)]] == list(KINDS)
    assert lines[2][2] == "not seen" and lines[2][-1] == "0.0%"
    assert lines[0][3].endswith("(bound 0.5)") and lines[0][4].endswith("(bound 0.12)")
    assert lines[-1][:2] == ["codes of 255", "never"]


# Nulls of welch ----------------------------------------------------------------------------------------------------


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


# Times: what is measured, not how long it takes --------------------------------------------------------------------

SMALL = times.Size(48, 64, 2, 1)


def test_what_is_timed_is_told_apart(tmp_path):
    """An image that differs is what the page shows; the folder's images are equal for what `auto` tests."""
    times.write(tmp_path, SMALL)
    one, other = tmp_path / "a/0.exr", tmp_path / "b/0.exr"
    assert folders.diff(one, other, Settings.for_all(method="tolerance")).exit_code == 1
    assert folders.diff(tmp_path / "a", tmp_path / "b", renders=True).exit_code == 1
    many = tmp_path / "many_a", tmp_path / "many_b"
    assert (folders.diff(*many).exit_code, len(folders.diff(*many).results)) == (0, SMALL.pairs)
    assert folders.diff(*many, Settings.for_all(method="exact")).exit_code == 1


def test_rows_of_times():
    rows = {row.subject: row for row in times.measure(SMALL, "any")}
    assert rows.keys() >= {"welch", "tolerance", "auto", "page", "memory", "size of the page"}
    assert {name for name, row in rows.items() if "time / reading" in row.values} == {*METHODS, "auto"}
    assert "time / libraries" in rows["from the shell"].values
    assert not [row for row in rows.values() if row.goals]  # they are those of another size
    assert rows["memory"].values["MB of memory"] > 10
    assert 0.02 < rows["size of the page"].values["MB of page"] < limits.PAGE_MEGABYTES


def test_a_process_that_fails_is_no_measurement(tmp_path):
    with pytest.raises(OSError, match=r"diff, times: mi-refract: .*no such"):
        times.python("-m", "mi_refract.cli", "diff", str(tmp_path / "none.exr"), str(tmp_path / "a.exr"))
