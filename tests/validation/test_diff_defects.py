"""The glass of the study is spoilt as it says, and the study sees it."""

import types

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract.image_diff import self_test
from mi_refract.image_diff.methods import METHODS
from mi_refract.report.row import Row
from validation import readme_tables
from validation.diff import planted_defects as study


def by_subject(rows):
    return {row.subject: row for row in rows}


@pytest.fixture
def glass(scalar_context):
    """`glass(name)`: a spoilt glass of index 1.5; `glass("")` is as it should be."""
    scalar_context()
    study.register(mi.scalar_rgb)
    kind = {"int_ior": 1.5, "ext_ior": 1.0}
    return lambda name: mi.load_dict({"type": f"{study.GLASS} {name}" if name else "refract", **kind})


def sampled(bsdf, cos_i, sample1):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi = mi.Vector3f(np.sqrt(1 - cos_i**2), 0, cos_i)
    return bsdf.sample(mi.BSDFContext(), si, sample1, mi.Point2f(0.5))


def test_spoilt_glass_is_spoilt_as_it_says(glass):
    right = glass("")
    bs, weight = sampled(right, 0.8, 0.9)
    assert sampled(glass("missing η²"), 0.8, 0.9)[1][0] == pytest.approx(weight[0] * 1.5**2)
    assert sampled(glass("missing η²"), 0.8, 0.0)[1][0] == pytest.approx(1)
    inside = -0.3  # beyond the critical angle
    assert sampled(right, inside, 0.5)[1][0] == pytest.approx(1)
    assert sampled(glass("black TIR"), inside, 0.5)[1][0] == 0
    assert sampled(glass("black TIR"), 0.8, 0.0)[1][0] == pytest.approx(1)
    swapped = glass("swapped lobes")
    assert sampled(swapped, 0.8, 0.9)[0].sampled_component == 0 != bs.sampled_component
    assert sampled(swapped, 0.8, 0.0)[0].sampled_component == 1
    assert sampled(swapped, inside, 0.0)[0].sampled_component == 0
    etas = {name: mi.traverse(glass(name))["eta"][0] for name in study.GLASSES}
    assert etas["IOR + 0.5 %"] == pytest.approx(1.5075)
    assert etas["IOR + 1e-3"] == pytest.approx(1.501)
    assert etas["flipped normal"] == pytest.approx(1 / 1.5)


def test_cameras_side_by_side_are_independent_renders(scalar_context):
    scalar_context()
    sheet = study.opened("prism", resolution=8, count=3)(4, 0)[0]
    one, two, three = np.split(sheet, 3, axis=1)
    mean = np.mean([study.opened("prism", resolution=8)(16, seed)[0] for seed in range(8)], 0)
    assert not np.array_equal(one, two)
    for image in (one, two, three):
        assert np.corrcoef(image.ravel(), mean.ravel())[0, 1] > 0.6
    noise = [x - mean for x in (one, two, three)]
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.5


def test_a_scalar_variant_is_not_run_with_the_reason(scalar_context):
    rows = [row for task in study.tasks(scalar_context()) for row in task.run()]
    assert {row.verdict for row in rows} == {"not run"}


def test_the_study_sees_its_defects_and_no_other_sampler(llvm_variant, monkeypatch):
    monkeypatch.setattr(study, "TRIALS", 2)
    monkeypatch.setattr(study, "GLASSES", {k: v for k, v in study.GLASSES.items() if k == "flipped normal"})
    rows = by_subject(study.defect_rows(types.SimpleNamespace(variant="llvm_ad_rgb"), "prism"))
    assert rows["flipped normal"].values["welch"] == 1
    assert rows["flipped normal"].verdict == "pass"
    assert rows["other sampler"].values["welch"] == 0
    assert rows["other sampler"].values["exact"] == 1


def test_the_table_says_where_no_method_was_asked_and_which_pairs_are_identical():
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
