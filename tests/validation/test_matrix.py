"""The matrix of systems and checks: what it takes from the rows of other studies."""

from __future__ import annotations

import pytest

from mi_refract.report.row import Row
from validation import limits, readme_tables
from validation.suite import matrix, per_ray, rendered_images
from validation.suite.renderers import SYSTEMS
from validation.suite.renderers.system import LARGE, TOTAL

GOAL = {per_ray.OFF_RECORDED: limits.RECORDED}


def ray(subject="A", case="random", budget=None, **values):
    values = {"worst rad": 1e-6, "wrong": 0.0, "TIR misclassified": 0.0} | values
    return Row(per_ray.NAME, subject, case, "f32", values, {"wrong": 0.0}, reason="A 1.2; zero")


def image(subject="B", verdict="equal", differing=0.0, **more):
    values = {"mean difference": -0.02, "tests that differ": differing}
    budgets = {"tests that differ": 0.0} | more
    replay = {"verdict": verdict, "renderer": "B 3"}
    return Row(rendered_images.NAME, subject, "prism", "64²", values, budgets, reason="why", replay=replay)


def test_numbers_and_verdicts_are_those_of_the_rows():
    right, wrong, equal, different = matrix.summary(
        [ray(), ray(case="near-critical", wrong=3.0), image(), image(verdict="different", differing=2.0)]
    )
    assert (right.subject, right.case, right.values[matrix.OFF], right.verdict) == ("A, f32", "random", 1e-6, "pass")
    assert (wrong.verdict, wrong.reason) == ("fail", "A 1.2; zero")
    assert (equal.subject, equal.values[matrix.OFF], equal.verdict) == ("B", 0.02, "pass")
    assert (equal.values["differs"], equal.reason) == (0.0, "B 3; why")
    assert (different.verdict, different.values["differs"], different.reason) == ("fail", 1.0, "B 3; why")


def test_a_missed_goal_is_shown_beside_the_number_and_fails_nothing():
    missed = Row(per_ray.NAME, "A", "random", "f32", {"worst rad": 5e-6, "off the recorded": 3.67}, goals=GOAL)
    reached = Row(per_ray.NAME, "B", "random", "f32", {"worst rad": 5e-6, "off the recorded": 2.9}, goals=GOAL)
    better = {"worst rad": 2e-15, "recorded": 9e-15, "off the recorded": 4.5}
    rows = matrix.summary([missed, reached, Row(per_ray.NAME, "C", "random", "f64", better, goals=GOAL)])
    assert [row.verdict for row in rows] == ["pass"] * 3
    assert [bool(row.missed) for row in rows] == [True, False, True]
    table = readme_tables.suite(rows)
    assert "| A, f32 | 5e-6 (3.67 × recorded) |" in table
    assert "| B, f32 | 5e-6 |" in table
    assert "| C, f64 | 2e-15 (recorded / 4.5) |" in table
    assert "a goal" in table and "fails nothing" in table


def test_every_recorded_error_of_mitsuba_is_a_goal():
    """`dielectric` on random rays missed it, and the goal was taken away."""
    for call in SYSTEMS["mitsuba"].calls:
        assert set(call.recorded) == set(per_ray.SETS) - {TOTAL, LARGE}, call.title


def test_a_system_that_is_known_to_differ_passes_and_is_said_to_differ():
    row = image(verdict="different", differing=2.0)
    known = Row(row.study, row.subject, row.case, row.setting, row.values, reason=row.reason, replay=row.replay)
    (found,) = matrix.summary([known])
    assert (found.verdict, found.missed, found.reason) == ("pass", {"differs": 0.0}, "B 3; why")


@pytest.mark.parametrize(
    ("study", "cases"), [(per_ray.NAME, per_ray.SETS), (rendered_images.NAME, rendered_images.SCENES)]
)
def test_what_was_not_run_is_not_run_for_every_check(study, cases):
    found = matrix.summary([Row(study, "A", "every set", "f32", reason="pip install it")])
    assert [row.case for row in found] == list(cases)
    assert {row.verdict for row in found} == {"not run"}


def test_the_summary_stands_before_what_it_is_taken_from():
    other = Row("directions", "x", "y", "z", {"v": 1.0})
    rows = matrix.with_summary([other, ray(), other])
    assert [row.study for row in rows] == ["directions", matrix.NAME, per_ray.NAME, "directions"]
    assert matrix.with_summary([other]) == [other]
