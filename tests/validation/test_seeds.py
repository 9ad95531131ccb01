"""Randomised studies are repeated with other seeds, and bounds far above the errors are listed."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import validation.__main__ as command
from mi_refract import backend
from mi_refract.report.row import Row
from validation import repeated
from validation.run import seeds, tightness
from validation.run.context import SCALAR_PROFILES, Context
from validation.study import Study

HERE = Context(SCALAR_PROFILES["standard"], Path(), "scalar_rgb", backend.detect(), backend.usable_variants())
MODULES = [f"{room}.{name}" for room, names in command.ROOMS.values() for name in names]
# Their random draws decide no verdict on errors: times, noise of several seeds of its own, or a sampled defect.
OTHERWISE = {
    "renders.against_dielectric": "eight seeds a side, compared by a test with a stated probability of alarm",
    "renders.colours": "images are shown; no figure has a bound",
    "renders.unused_features": "times and equality to the last bit",
    "efficiency.error_against_time": "several seeds a method, with intervals",
    "efficiency.changing_indices": "times",
    "efficiency.scaling": "times",
    "planar.times": "times",
    "diff.planted_defects": "trials with seeds of their own",
    "diff.times": "times",
    "suite.rendered_images": "several seeds a side",
    "media.hero_wavelength": "times and variances; no figure has a bound",
    "media.renders": "sixteen seeds a side in the furnace, eight by Welch's test; the rest is times and closed forms",
    "robustness.code_mutants": "each mutant is a case of its own, and the study is longer in full",
    "ground_truth.traced_bodies": "bodies are fixed; the rainbow's seeds are its sample",
}
DRAWS = "default_rng", "regimes.make(", "seed="


def test_every_study_that_draws_is_repeated_or_says_why_not():
    for name in MODULES:
        module = import_module(f"validation.{name}")
        draws = any(word in Path(module.__file__).read_text() for word in (*DRAWS, "SEED"))
        if draws and name not in OTHERWISE:
            assert module.STUDY.again is not None, name
        assert module.STUDY.again is None or name not in OTHERWISE


def drawn(context):
    """A bound that holds for the study's own seed and for no other."""
    value = np.random.default_rng(seeds.current(5)).random()
    own = np.random.default_rng(5).random()
    return [Row("s", "x", "case", "", {"error": abs(value - own)}, {"error": 1e-9})]


def study(again):
    return Study("s", "S", "", {}, lambda context: [], again=again)


@pytest.mark.parametrize(("profile", "count"), [("quick", 0), ("standard", 3), ("full", 10)])
def test_a_bound_that_only_its_own_seed_holds_fails(profile, count, tmp_path):
    context = replace(HERE, profile=SCALAR_PROFILES[profile], out=tmp_path)
    assert drawn(context)[0].verdict == "pass"
    tasks = repeated.tasks(study(drawn), context)
    assert len({task.name for task in tasks}) == len(tasks) == count
    for task in tasks:
        summary, broken = task.run()
        assert (summary.values["checks"], summary.values["broken"], summary.verdict) == (1, 1, "fail")
        assert summary.values["largest share"] > 1e6
        assert broken.verdict == "fail"
    assert seeds.current(5) == 5


def test_a_repetition_that_checks_nothing_fails():
    nothing = study(lambda context: [Row("s", "x", "y", "", {"error": 1.0})])
    assert repeated.rows_of(nothing, HERE, 1)[0].broken == {"nothing checked": 0.0}


def test_what_is_drawn_is_kept_by_seed():
    calls = []
    draw = seeds.cached(lambda x: calls.append(x) or seeds.current(x))
    with seeds.shifted(1):
        other = draw(1)
    assert (draw(1), draw(1), other) == (1, 1, 1 + seeds.STEP)
    assert calls == [1, 1]


@pytest.mark.parametrize(("value", "bound", "share"), [(0, 0, 0), (1, 0, np.inf), (np.nan, 0, np.nan), (1, 4, 0.25)])
def test_shares_of_bounds(value, bound, share):
    assert repeated.share(float(value), float(bound)) == pytest.approx(share, nan_ok=True)


def bounded(subject, case, value, bound=1.0, study="energy", metric="error"):
    return Row(study, subject, case, "", {metric: value}, {metric: bound})


def test_bounds_far_above_the_errors_are_listed_and_must_be_explained():
    """Far in one case of two: the bound is the other's. Far in every case: an explanation, or the row fails."""
    near = [bounded("x", "easy", 0.001), bounded("x", "hard", 0.5), bounded("x", "never", 0.0, bound=0.0)]
    (row,) = tightness.rows(near)
    assert (row.values["checks"], row.values["far from the bound"], row.verdict) == (2, 1, "pass")
    assert row.reason == "x, error: 1 of 2 rows, others use up to 0.5 of it"
    (row,) = tightness.rows([*near, bounded("y", "easy", 0.002)])
    assert row.values["loose in every case"] == 1
    assert row.broken == {"unexplained": 0.0}
    (row,) = tightness.rows([bounded("powers", "n = 2", 1e-4, metric="inside: R / u")])
    assert row.verdict == "pass"
    assert "excludes: as for 1 − R" in row.reason
