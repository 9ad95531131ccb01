"""Efficiency and scaling: figures of known errors, and every planted defect seen. Renders need a compiled variant."""

import dataclasses
import math

import numpy as np
import pytest

from mi_refract import backend
from validation import limits
from validation.efficiency import error_against_time, scaling
from validation.efficiency.error_against_time import Extent
from validation.run import render_methods
from validation.run.context import PROFILES, SCENES, Context
from validation.run.render_methods import BUILTIN, METHODS, Method

SMALL = Extent((4, 9), 6, 8, resolution=32)
SHORT = Method("short paths", "path", "refract", {"max_depth": 3, "rr_depth": 3})
GIVEN = (BUILTIN, METHODS[1], SHORT)


@pytest.fixture
def context(tmp_path, llvm_variant, monkeypatch):
    monkeypatch.setitem(error_against_time.EXTENTS, "standard", SMALL)
    return Context(PROFILES["standard"], tmp_path, "llvm_ad_rgb", backend.detect(), backend.usable_variants())


# Figures -------------------------------------------------------------------------------------------------------


def test_errors_are_those_that_were_put_in():
    mean = np.full((40, 50, 3), 2.0)
    image = mean + 0.1
    image[0, 0] += 100  # one pixel of 2000, all of the worst 0.1 % but one
    found = error_against_time.errors(image, mean, np.zeros_like(mean))
    assert found["MSE"] == pytest.approx(0.01 + (100.1**2 - 0.01) / 2000)
    assert found["MSE, trimmed"] == pytest.approx(0.01)
    assert found["relMSE, trimmed"] == pytest.approx(0.01 / 4.01)


def test_the_variance_of_the_reference_is_not_the_methods_error():
    """Both have the variance 1, the mean of 4 references 1/4: the estimate is 1 within 5 of its standard errors."""
    rng = np.random.default_rng(5)
    references, image = rng.normal(size=(4, 100, 100, 3)), rng.normal(size=(100, 100, 3))
    own = references.var(0, ddof=1) / 4
    found = error_against_time.errors(image, references.mean(0), own)["MSE"]
    assert found == pytest.approx(1, abs=5 * math.sqrt((2 * 1.25**2 + 2 / 16 / 3) / 30000))
    assert error_against_time.errors(image, references.mean(0), 0 * own)["MSE"] > 1.2


# The study -----------------------------------------------------------------------------------------------------


def test_efficiency_is_not_bought_with_bias_and_more_samples_have_less_error(context):
    """Same seeds as the built-in, so agreement does not depend on the run; shorter paths are biased, and found."""
    rows = {row.subject: row for row in error_against_time.scene_rows(context, SCENES / "balls.xml", GIVEN)}
    assert rows[METHODS[1].name].verdict == "pass"
    assert rows[SHORT.name].verdict == "fail"
    assert set(rows[SHORT.name].broken) == {"Welch alarms"}
    the_same_image_has_the_same_error_and_more_samples_less(rows)


def the_same_image_has_the_same_error_and_more_samples_less(rows):
    ours, builtin = rows[METHODS[1].name].values, rows[BUILTIN.name].values
    for metric in error_against_time.METRICS:
        assert ours[metric] == pytest.approx(builtin[metric], rel=1e-2)
    curve = rows["every method"].curves[BUILTIN.name]
    assert len(curve) == len(SMALL.spp)
    assert curve[1][1] < curve[0][1]
    control = rows[f"{BUILTIN.name}, independent"].values
    assert control["equal-time MSE / independent"] == builtin["equal-time MSE"] == 1
    assert builtin["equal-time MSE / independent"] < 1
    assert control["Welch alarms"] == 0


@pytest.mark.parametrize(("noise", "seconds", "best"), [(2.0, 1.0, 1), (0.5, 1.0, 0), (0.5, 5.0, 1)])
def test_the_best_sampler_has_the_least_variance_and_time(monkeypatch, noise, seconds, best):
    """The first one's noise and time are given, the other's are 1; the first image of each took forever."""

    def look(path, resolution, sampler, extent):
        first = sampler == error_against_time.STRATIFIED[0]
        shots = iter([1e9] + 3 * [seconds if first else 1.0])
        rng = np.random.default_rng(1)
        return lambda spp, seed: (rng.normal(size=(8, 8, 3)) * (noise if first else 1.0), next(shots))

    monkeypatch.setattr(error_against_time, "builtin_camera", look)
    assert error_against_time.best_sampler(SCENES / "balls.xml", 8, SMALL) == error_against_time.STRATIFIED[best]


def test_images_grow_until_their_time_can_be_told(context, monkeypatch):
    monkeypatch.setattr(error_against_time, "LARGEST", 64)
    path = SCENES / "furnace.xml"
    sizes = [error_against_time.resolution_of(path, dataclasses.replace(SMALL, seconds=s)) for s in (0.0, 1e-9, 1e9)]
    assert sizes == [32, 32, 64]


@pytest.mark.parametrize(
    ("scene", "words"), [("furnace", "no noise"), ("mirage", "stairs"), ("slab", "the profile standard measures balls")]
)
def test_what_is_left_out_has_its_reason(context, monkeypatch, scene, words):
    measured = ("balls",) if scene == "slab" else ()
    monkeypatch.setitem(error_against_time.EXTENTS, "standard", dataclasses.replace(SMALL, scenes=measured))
    (row,) = error_against_time.scene_rows(context, SCENES / f"{scene}.xml", GIVEN)
    assert row.verdict == "not run"
    assert row.reason.startswith("left out: ") and words in row.reason


def test_goals_go_to_the_best_that_splits_on_glass_and_to_the_best_elsewhere():
    def measured(cost):
        return {4: error_against_time.Measured([1.0], {"MSE": [cost]}, [])}

    subjects = [error_against_time.Subject(method, "multijitter") for method in METHODS]
    costs = dict(zip((s.name for s in subjects), (1.0, 1.0, 0.1, 0.5, 0.3, 0.4), strict=True))
    found = {name: measured(cost) for name, cost in costs.items()}
    glass = error_against_time.goals_of(subjects, found, only_glass=True)
    assert glass[subjects[4].name] == limits.ONLY_GLASS
    assert glass[subjects[2].name] == {"time / built-in": 0.8}
    assert subjects[1].name not in glass and glass[subjects[3].name] == {}
    mixed = error_against_time.goals_of(subjects, found, only_glass=False)
    assert mixed[subjects[2].name] == limits.MIXED
    assert not any(mixed[s.name] for s in subjects[3:])


def test_scalar_variants_are_not_run(scalar_context):
    context = scalar_context()
    found = error_against_time.scene_rows(context, SCENES / "balls.xml") + scaling.knob_rows(context, "glasses")
    assert {row.verdict for row in found} == {"not run"}


def test_a_method_renders_to_the_depth_of_the_scene_or_to_another(scalar_variant):
    path = SCENES / "nested.xml"
    assert "max_depth = 48" in str(render_methods.camera(path, BUILTIN, 4).integrator)
    assert "max_depth = 7" in str(render_methods.camera(path, BUILTIN, 4, max_depth=7).integrator)


# Scaling -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [8, 1000, 30_000])
def test_a_ball_is_closed_convex_and_of_its_size(size):
    v, f = scaling.ball_mesh(size)
    assert len(f) == pytest.approx(size, rel=0.1)
    edges = {(int(a), int(b)) for t in f for a, b in zip(t, np.roll(t, -1), strict=True)}
    assert len(edges) == 3 * len(f) and all((b, a) in edges for a, b in edges)
    assert len(v) - len(edges) // 2 + len(f) == 2
    corners = v[f].astype(float)
    assert (np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) > 0).all()


@pytest.mark.parametrize("knob", scaling.KNOBS)
def test_every_knob_makes_an_image(knob, scalar_variant):
    size = {"pixels": 16, "glasses": 5}.get(knob, 8)
    image, _ = scaling.KNOBS[knob].make(BUILTIN, size, 4)(1, seed=0)
    assert image.shape == (4, 4, 3)
    assert np.isfinite(image).all() and image.any()


def test_kernels_that_were_there_give_no_first_image_and_the_peak_of_a_process_is_its_own(context, tmp_path):
    """Three hundred megabytes here are none of the process that is measured."""
    job = scaling.Job("llvm_ad_rgb", "glasses", 2, METHODS[1].name, 8, 1, 2)
    ballast = np.ones(300_000_000, np.uint8)
    cold, warm = (scaling.run(job, str(tmp_path)) for _ in range(2))
    assert cold["first image"] > 0
    assert math.isnan(warm["first image"])
    assert 0 < cold["arrays MB"] < 1
    assert ballast.all()
    assert math.isnan(cold["process MB"]) or cold["process MB"] < 300


def test_a_process_that_fails_says_why(tmp_path):
    job = scaling.Job("scalar_rgb", "glasses", 2, METHODS[1].name, -8, 1, 2)
    with pytest.raises(RuntimeError, match=r"glasses = 2: exit code 1: .*"):
        scaling.run(job, str(tmp_path))
