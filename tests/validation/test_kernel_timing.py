"""Times: intervals, ratios within a round, kernels that were really compiled."""

import dataclasses
import time

import drjit as dr
import mitsuba as mi
import pytest
from scipy.stats import binom

from mi_refract import FORMULAS, backend
from validation.run import kernel_timing
from validation.run.array_settings import BUILTIN, Setting, settings
from validation.run.context import SCALAR_PROFILES, Context

PROFILE = dataclasses.replace(SCALAR_PROFILES["standard"], scalar_rays=20, streamed_rays=2000, repeats=9)


@pytest.fixture
def context(tmp_path):
    return Context(PROFILE, tmp_path, mi.variant(), backend.detect(), backend.usable_variants())


@pytest.mark.parametrize("count", [9, 11, 21])
def test_the_interval_of_a_median_covers_it_19_times_in_20(count):
    """The exact coverage of the ranks that it takes; one rank further in it would be less than 95 %."""
    found = kernel_timing.interval("t", list(map(float, range(1, count + 1))))
    rank = int(found["t, low"])
    assert (found["t"], found["t, high"]) == ((count + 1) / 2, count + 1 - rank)
    coverage = 1 - 2 * binom.cdf(rank - 1, count, 0.5)
    assert coverage >= 0.95 > 1 - 2 * binom.cdf(rank, count, 0.5)


def test_a_ratio_is_that_of_one_round():
    """A machine that is twice as slow in some rounds does not move it."""
    load = [1.0, 2.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0, 1.0]
    ratio = kernel_timing.ratio("t", [3.0 * x for x in load], load)
    assert ratio == {"t": 3.0, "t, low": 3.0, "t, high": 3.0}


def test_every_second_round_runs_backwards_and_the_first_is_thrown_away():
    calls = []

    def clock(subject):
        calls.append(subject)
        return float(len(calls))

    seconds = kernel_timing.rounds({"a": "a", "b": "b"}, clock, 3)
    assert "".join(calls) == "abbaabba"
    assert seconds == {"a": [4, 5, 8], "b": [3, 6, 7]}


def test_a_slow_subject_is_seen_on_every_backend_that_runs(context, monkeypatch):
    def slow(a, n, k):
        if not dr.is_jit_v(a):
            time.sleep(2e-3)
        b, transmitted = FORMULAS["decomposed"](a, n, k)
        for _ in range(20):
            b = dr.sin(b)
        return b, transmitted

    for setting in settings(context):
        if setting.vector is None:
            continue
        several = {"decomposed": FORMULAS["decomposed"], "slow": slow}
        monkeypatch.setattr(Setting, "subjects", several)
        found = kernel_timing.measure(context, setting)
        assert set(found) == {"copy", "decomposed", "slow"}
        assert found["slow"]["time / plain, low"] > 1.5
        assert found["decomposed"]["time / plain"] == found["copy"]["time / copy"] == 1
        assert ("ns per ray" in found["slow"]) == (setting.backend == "cuda")
        if not setting.is_scalar:
            assert found["slow"]["operations"] > found["decomposed"]["operations"]
            assert found["slow"]["compile ms"] > 1  # NaN where a cache had the kernel


def test_goals_are_those_of_the_table(context):
    by_label = {setting.label: setting for setting in settings(context)}
    single, double, scalar = (by_label[label] for label in ("llvm float32", "llvm float64", "scalar float64"))
    assert kernel_timing.goals("promoted", single) == {"time / plain": FORMULAS["promoted"].time_goal}
    assert kernel_timing.goals("promoted", double) == {}
    assert kernel_timing.goals("wedge", double) == {"time / copy": 1 / 0.9}
    assert kernel_timing.goals("wedge", scalar) == kernel_timing.goals(BUILTIN, single) == {}
