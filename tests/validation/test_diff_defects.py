"""The gate sees planted defects, fails where a method is blind or alarms at everything, and its defects are defects."""

import types

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refract.image_diff import methods
from mi_refract.image_diff import self_test as gate
from mi_refract.image_diff.comparison import Comparison, Verdict
from mi_refract.image_diff.self_test import DEFECTS
from mi_refract.io import image_file
from validation.diff import planted_defects as study

IMAGE = 0.2 + 0.8 * np.random.default_rng(5).random((32, 32, 3))


def renders(count, seed=1, spread=0.02):
    """Independent noisy renders of one image, of a skewed distribution."""
    shape = spread**-2
    return IMAGE * np.random.default_rng(seed).gamma(shape, 1 / shape, (count, *IMAGE.shape))


def by_subject(rows):
    return {row.subject: row for row in rows}


@pytest.fixture(scope="module")
def found():
    return by_subject(gate.examine(renders(12), "noise", trials=4, null_pairs=40))


@pytest.mark.parametrize("name", DEFECTS)
def test_what_is_due_is_seen(found, name):
    row = found[name]
    assert row.verdict == "pass"
    assert row.values["exact"] == 1
    if DEFECTS[name].always_due:
        assert row.replay["due"] == list(methods.METHODS)
        assert {row.values[method] for method in methods.METHODS} == {1}


def test_the_size_of_a_defect_is_measured(found):
    assert found["gain"].values["size"] == pytest.approx(0.01, rel=1e-3)
    assert found["gain"].values["size / detectable"] > 1  # 0.02/√(256 × 6) a tile: due
    assert found["gain"].values["welch"] == 1
    assert found["renders"].values["noise"] == pytest.approx(0.02, rel=0.1)


def test_equal_pairs_alarm_nowhere(found):
    rows = [found[f"null pairs, {method}"] for method in methods.METHODS]
    assert all(row.verdict == "pass" and row.values["false alarms"] == 0 for row in rows)
    assert found["null pairs, welch"].values["null pairs"] == 40


@pytest.mark.parametrize("method", methods.METHODS)
def test_a_blind_method_fails(method, monkeypatch):
    """It says of everything, NaN and other sizes included, that it is equal, and that it would have seen 1e-4."""
    real = methods.compare
    blind = Comparison(method, Verdict.EQUAL, "", detectable=1e-4)
    monkeypatch.setattr(methods, "compare", lambda m, *sides: blind if m == method else real(m, *sides))
    rows = by_subject(gate.examine(renders(8), "noise", trials=2, null_pairs=2))
    failed = {name for name, row in rows.items() if row.verdict == "fail"}
    always = {name for name, defect in DEFECTS.items() if defect.always_due and name != "truncated"}
    expected = {"exact": set(DEFECTS) - {"truncated"}, "welch": always | {"gain", "shift", "8 bits", "firefly"}}
    assert failed >= expected.get(method, always)
    assert rows["NaN"].values["missed"] == 2


def test_a_method_that_cries_wolf_fails(monkeypatch):
    monkeypatch.setattr(methods, "compare", lambda m, *sides: Comparison(m, Verdict.DIFFERENT, ""))
    rows = gate.examine(renders(8), "noise", trials=1, null_pairs=5)
    assert {row.subject for row in rows if row.verdict == "fail"} == {f"null pairs, {m}" for m in methods.METHODS}
    monkeypatch.setattr(methods, "compare", lambda m, *sides: Comparison(m, Verdict.INCONCLUSIVE, ""))
    rows = by_subject(gate.examine(renders(8), "noise", trials=1, null_pairs=5))
    assert rows["null pairs, welch"].values["inconclusive"] == 1
    assert rows["gain"].values["exact"] == 0
    assert rows["gain"].verdict == "fail"


@pytest.mark.parametrize(("alarms", "pairs"), [(0, 640), (2, 640), (3, 640), (10, 10)])
def test_the_bound_is_where_so_few_alarms_have_the_probability_left(alarms, pairs):
    from scipy import stats

    bound = gate.Tally(seen=alarms, trials=pairs).bound
    left = stats.binom.cdf(alarms, pairs, bound)
    assert left == pytest.approx(1 if alarms == pairs else 1 - gate.CONFIDENCE)
    assert (bound <= gate.FALSE_ALARMS) == (alarms <= 2)


def test_a_defect_that_changes_nothing_is_left_out():
    grey = np.repeat(renders(4)[..., :1], 3, axis=3)
    rows = by_subject(gate.examine(grey, "grey", trials=1, null_pairs=1))
    assert rows["swapped channels"].verdict == "not run"
    assert "changes nothing" in rows["swapped channels"].reason


def test_the_command_judges_a_folder_an_image_and_refuses_what_is_not_finite(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(gate.examine, "__defaults__", (2, 20))
    for i, image in enumerate(renders(4)):
        image_file.write_exr(tmp_path / f"{i}.exr", image)
    assert gate.self_test(tmp_path) == 0
    assert "every defect that was due was seen" in capsys.readouterr().out
    assert gate.self_test(tmp_path / "0.exr") == 0
    assert "–" in capsys.readouterr().out  # no noise is known of one image: nothing for welch
    monkeypatch.setattr(methods, "compare", lambda m, *sides: Comparison(m, Verdict.EQUAL, ""))
    assert gate.self_test(tmp_path / "0.exr") == 1
    assert "not held: " in capsys.readouterr().out
    image_file.write_exr(tmp_path / "bad.exr", np.full_like(IMAGE, np.nan))
    with pytest.raises(ValueError, match="finite"):
        gate.self_test(tmp_path / "bad.exr")
    image_file.write_exr(tmp_path / "bad.exr", IMAGE[1:])
    with pytest.raises(ValueError, match="differ from"):
        gate.self_test(tmp_path)


# The study -----------------------------------------------------------------------------------------------------


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


def test_the_study_sees_its_defects_and_no_other_sampler(needs_variant, monkeypatch):
    needs_variant("llvm_ad_rgb")
    monkeypatch.setattr(study, "TRIALS", 2)
    monkeypatch.setattr(study, "GLASSES", {k: v for k, v in study.GLASSES.items() if k == "flipped normal"})
    before = mi.variant()
    mi.set_variant("llvm_ad_rgb")
    try:
        rows = by_subject(study.defect_rows(types.SimpleNamespace(variant="llvm_ad_rgb"), "prism"))
    finally:
        mi.set_variant(before)
    assert rows["flipped normal"].values["welch"] == 1
    assert rows["flipped normal"].verdict == "pass"
    assert rows["other sampler"].values["welch"] == 0
    assert rows["other sampler"].values["exact"] == 1
