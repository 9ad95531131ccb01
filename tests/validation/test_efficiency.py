"""Efficiency, scaling and times: values of known errors, intervals, and detection of planted defects."""

import dataclasses
import math
import time

import drjit as dr
import numpy as np
import pytest
from scipy.stats import binom

from mi_refract import FORMULAS, backend
from mi_refract.rendering import pilot
from mi_refract.rendering.scene_files import load_parsed, parse_scene
from validation import limits
from validation.efficiency import chosen_settings, error_against_time, scaling
from validation.efficiency.error_against_time import Extent
from validation.run import kernel_timing, render_methods
from validation.run.array_settings import BUILTIN as BUILTIN_KERNEL
from validation.run.array_settings import Setting, settings
from validation.run.context import PROFILES, SCALAR_PROFILES, SCENES, Context
from validation.run.render_methods import BUILTIN, METHODS, Method

SMALL = Extent((4, 9), 6, 8, resolution=32)
SHORT = Method("short paths", "path", "refract", {"max_depth": 3, "rr_depth": 3})


@pytest.fixture
def context(tmp_path, llvm_variant, monkeypatch):
    monkeypatch.setitem(error_against_time.EXTENTS, "standard", SMALL)
    return Context(PROFILES["standard"], tmp_path, "llvm_ad_rgb", backend.detect(), backend.usable_variants())


# The error against time ---------------------------------------------------------------------------------------------


def test_errors_of_known_images():
    """The variance of the reference is subtracted: the method's is 1, that of the reference, a mean of 4, is 1/4."""
    mean = np.full((40, 50, 3), 2.0)
    image = mean + 0.1
    image[0, 0] += 100  # one pixel of 2000; the worst 0.1 % are two
    errors = error_against_time.errors(image, mean, np.zeros_like(mean))
    assert errors["MSE"] == pytest.approx(0.01 + (100.1**2 - 0.01) / 2000)
    assert (errors["MSE, trimmed"], errors["relMSE, trimmed"]) == pytest.approx((0.01, 0.01 / 4.01))
    rng = np.random.default_rng(5)
    references, image = rng.normal(size=(4, 100, 100, 3)), rng.normal(size=(100, 100, 3))
    variance = references.var(0, ddof=1) / 4
    mse = error_against_time.errors(image, references.mean(0), variance)["MSE"]  # 1 within 5 standard errors
    assert mse == pytest.approx(1, abs=5 * math.sqrt((2 * 1.25**2 + 2 / 16 / 3) / 30000))
    assert error_against_time.errors(image, references.mean(0), 0 * variance)["MSE"] > 1.2


def test_biased_methods_fail_and_more_samples_reduce_the_error(context):
    """Same seeds as the built-in, so agreement does not depend on the run; shorter paths are biased."""
    methods = (BUILTIN, METHODS[1], SHORT)
    rows = {row.subject: row for row in error_against_time.scene_rows(context, SCENES / "balls.xml", methods)}
    assert (rows[METHODS[1].name].verdict, rows[SHORT.name].verdict) == ("pass", "fail")
    assert set(rows[SHORT.name].broken) == {"Welch alarms"}
    ours, builtin = rows[METHODS[1].name].values, rows[BUILTIN.name].values
    for metric in error_against_time.METRICS:
        assert ours[metric] == pytest.approx(builtin[metric], rel=1e-2)
    curve, control = rows["every method"].curves[BUILTIN.name], rows[f"{BUILTIN.name}, independent"].values
    assert len(curve) == len(SMALL.spp) and curve[1][1] < curve[0][1]
    assert control["equal-time MSE / independent"] == builtin["equal-time MSE"] == 1
    assert builtin["equal-time MSE / independent"] < 1 and control["Welch alarms"] == 0


@pytest.mark.parametrize(("bias", "alarms"), [(0.0, False), (0.01, True)])
def test_a_small_bias_of_a_whole_noisy_image_is_an_alarm(bias, alarms):
    """1 % is 9.6 standard errors of the image's mean, 1.6 of a tile's. False alarms: 1 in 1000."""
    rng = np.random.default_rng(7)
    references, images = (x + 0.2 * rng.normal(size=(n, 96, 96, 3)) for x, n in ((1.0, 12), (1.0 - bias, 6)))
    values = render_methods.welch_values_with_whole(references, images, 16)
    assert (values["Welch alarms"] > 0) == alarms
    assert values["detectable difference, image"] < 0.01 < values["minimum detectable difference"]


@pytest.mark.parametrize(("noise", "seconds", "best"), [(2.0, 1.0, 1), (0.5, 1.0, 0), (0.5, 5.0, 1)])
def test_the_best_sampler_has_the_least_variance_and_time(monkeypatch, noise, seconds, best):
    """The first sampler has the given noise and time, the other 1 and 1; the first image of each takes 1e9 s."""

    def camera(path, resolution, sampler, extent):
        first = sampler == error_against_time.STRATIFIED[0]
        times = iter([1e9] + 3 * [seconds if first else 1.0])
        rng = np.random.default_rng(1)
        return lambda spp, seed: (rng.normal(size=(8, 8, 3)) * (noise if first else 1.0), next(times))

    monkeypatch.setattr(error_against_time, "builtin_camera", camera)
    assert error_against_time.best_sampler(SCENES / "balls.xml", 8, SMALL) == error_against_time.STRATIFIED[best]


def test_images_grow_until_they_take_long_enough(context, monkeypatch):
    monkeypatch.setattr(error_against_time, "LARGEST", 64)
    path = SCENES / "furnace.xml"
    sizes = [error_against_time.resolution_of(path, dataclasses.replace(SMALL, seconds=s)) for s in (0.0, 1e-9, 1e9)]
    assert sizes == [32, 32, 64]


def test_methods_render_to_the_depth_of_the_scene_or_a_given_one(scalar_variant):
    for depth, options in ((48, {}), (7, {"max_depth": 7})):
        camera = render_methods.camera(SCENES / "nested.xml", BUILTIN, 4, **options)
        assert f"max_depth = {depth}" in str(camera.integrator)


@pytest.mark.parametrize(
    ("scene", "words"), [("furnace", "no noise"), ("mirage", "stairs"), ("slab", "the profile standard measures balls")]
)
def test_scenes_that_are_left_out_have_a_reason(context, monkeypatch, scene, words):
    measured = ("balls",) if scene == "slab" else ()
    monkeypatch.setitem(error_against_time.EXTENTS, "standard", dataclasses.replace(SMALL, scenes=measured))
    (row,) = error_against_time.scene_rows(context, SCENES / f"{scene}.xml")
    assert row.verdict == "not run" and row.reason.startswith("left out: ") and words in row.reason


def test_the_best_method_has_a_goal_and_on_glass_only_the_best_that_splits():
    """The best at 4 samples per pixel, which is the worst at 9."""
    subjects = [error_against_time.Subject(method, "multijitter") for method in METHODS]
    costs = zip((s.name for s in subjects), (1.0, 1.0, 0.1, 0.5, 0.3, 0.4), strict=True)
    measured = {
        name: {spp: error_against_time.Measured([1.0], {"MSE": [mse]}, []) for spp, mse in ((4, cost), (9, 1 - cost))}
        for name, cost in costs
    }
    glass = error_against_time.goals_of(subjects, measured, only_glass=True)
    assert glass[subjects[4].name] == limits.ONLY_GLASS and glass[subjects[2].name] == {"time / built-in": 0.8}
    assert subjects[1].name not in glass and glass[subjects[3].name] == {}
    mixed = error_against_time.goals_of(subjects, measured, only_glass=False)
    assert mixed[subjects[2].name] == limits.MIXED and not any(mixed[s.name] for s in subjects[3:])


def test_scalar_variants_are_not_run(scalar_context):
    context = scalar_context()
    rows = error_against_time.scene_rows(context, SCENES / "balls.xml") + scaling.knob_rows(context, "glasses")
    outcomes = [(row.verdict, row.reason) for row in rows]
    assert outcomes == [("not run", error_against_time.SCALAR), ("not run", scaling.SCALAR)]


# Scaling --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("knob", scaling.KNOBS)
def test_every_knob_makes_an_image(knob, scalar_variant):
    size = {"pixels": 16, "glasses": 5}.get(knob, 8)
    image, _ = scaling.KNOBS[knob].make(BUILTIN, size, 4)(1, seed=0)
    assert image.shape == (4, 4, 3) and np.isfinite(image).all() and image.any()


def test_scaling_measures_its_own_process_or_raises(context, tmp_path):
    """Cached kernels give no first image; 600 MB in the parent process do not count."""
    job = scaling.Job("llvm_ad_rgb", "glasses", 2, METHODS[1].name, 8, 1, 2)
    parent_memory = np.ones(600_000_000, np.uint8)
    cold, warm = (scaling.run(job, str(tmp_path)) for _ in range(2))
    assert cold["first image"] > 0 and math.isnan(warm["first image"]) and 0 < cold["arrays MB"] < 1
    assert parent_memory.all() and (math.isnan(cold["process MB"]) or cold["process MB"] < 600)
    with pytest.raises(RuntimeError, match=r"glasses = 2: exit code 1: .*"):
        scaling.run(dataclasses.replace(job, variant="scalar_rgb", resolution=-8), str(tmp_path))


# Times ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [6, 9, 11, 21])
def test_the_interval_of_a_median_has_95_percent_coverage(count):
    """The exact coverage of its ranks; a narrower interval would have less than 95 %."""
    values = kernel_timing.interval("t", list(map(float, range(1, count + 1))))
    rank = int(values["t, low"])
    assert (values["t"], values["t, high"]) == ((count + 1) / 2, count + 1 - rank)
    assert 1 - 2 * binom.cdf(rank - 1, count, 0.5) >= 0.95 > 1 - 2 * binom.cdf(rank, count, 0.5)
    with pytest.raises(ValueError, match="t: 5 values; expected at least 6 for an interval of 95 %"):
        kernel_timing.interval("t", [1.0] * 5)


def test_ratios_are_formed_within_a_round_and_every_second_round_runs_backwards():
    """A machine that is twice as slow in some rounds does not change a ratio; the first round is not counted."""
    load, calls = [1.0, 2.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0, 1.0], []
    assert set(kernel_timing.ratio("t", [3.0 * x for x in load], load).values()) == {3.0}

    def clock(subject):
        calls.append(subject)
        return float(len(calls))

    seconds = kernel_timing.rounds({"a": "a", "b": "b"}, clock, 3)
    assert "".join(calls) == "abbaabba" and seconds == {"a": [4, 5, 8], "b": [3, 6, 7]}


def test_slow_subjects_are_detected_on_all_backends(tmp_path, variant, monkeypatch):
    def slow(a, n, k):
        if not dr.is_jit_v(a):
            time.sleep(2e-3)
        b, transmitted = FORMULAS["decomposed"](a, n, k)
        for _ in range(200 if dr.backend_v(a) == dr.JitBackend.CUDA else 20):
            b = dr.sin(b)
        return b, transmitted

    profile = dataclasses.replace(SCALAR_PROFILES["standard"], scalar_rays=20, streamed_rays=2000, repeats=9)
    context = Context(profile, tmp_path, variant, backend.detect(), backend.usable_variants())
    on_gpu = dataclasses.replace(context, profile=dataclasses.replace(profile, streamed_rays=1 << 22))
    monkeypatch.setattr(Setting, "subjects", {"decomposed": FORMULAS["decomposed"], "slow": slow})
    labels = "llvm float32", "llvm float64", "scalar float64"
    single, double, scalar = (next(x for x in settings(context) if x.label == label) for label in labels)
    assert kernel_timing.goals("promoted", single) == {"time / plain": FORMULAS["promoted"].time_goal}
    assert kernel_timing.goals("wedge", double) == {"time / copy": 1 / 0.9}
    for subject, setting in (("promoted", double), ("wedge", scalar), (BUILTIN_KERNEL, single)):
        assert kernel_timing.goals(subject, setting) == {}
    for setting in settings(context):
        if setting.vector is None:
            continue
        values = kernel_timing.measure(on_gpu if setting.backend == "cuda" else context, setting)
        assert set(values) == {"copy", "decomposed", "slow"} and values["slow"]["time / plain, low"] > 1.5
        assert values["decomposed"]["time / plain"] == values["copy"]["time / copy"] == 1
        assert ("ns per ray" in values["slow"]) == (setting.backend == "cuda")
        if not setting.is_scalar:
            assert values["slow"]["operations"] > values["decomposed"]["operations"]
            assert values["slow"]["compile ms"] > 1  # NaN if the kernel was cached


# Settings that a pilot chooses ---------------------------------------------------------------------------------------


def test_a_pilot_that_chooses_badly_misses_its_goals(context, monkeypatch):
    """In a scene of glass only, the scene's own settings cost ten times as much as splitting."""
    small = chosen_settings.Extent(("balls",), 24, 16, 6, samplers=("multijitter",), depths=(3,))
    monkeypatch.setitem(chosen_settings.EXTENTS, "standard", small)
    (row,) = chosen_settings.scene_rows(context, "balls")
    assert "split_depth=3" in row.reason and row.values["equal-time MSE / independent"] < 0.5
    assert row.values["equal-time MSE / best by hand"] == pytest.approx(1 + row.values[chosen_settings.SHARE])
    monkeypatch.setattr(pilot, "LOST", math.inf)
    monkeypatch.setattr(pilot, "MARGIN", math.inf)  # all settings count as equal
    monkeypatch.setattr(pilot, "SURELY", math.inf)
    (worse,) = chosen_settings.scene_rows(context, "balls")
    assert "split_depth" not in worse.reason and "equal-time MSE / best by hand" in worse.missed
    summary = chosen_settings.summarise([worse, worse])[-1]
    assert summary.case == chosen_settings.EVERY and "equal-time MSE / independent" in summary.missed


@pytest.mark.parametrize("name", chosen_settings.OTHERS)
def test_other_scenes_can_be_written_and_loaded(name, tmp_path, llvm_variant):
    path, defines = chosen_settings.scene_file(name, "refract", 8, tmp_path)
    assert len(load_parsed(parse_scene(path, defines)).shapes()) > 1
