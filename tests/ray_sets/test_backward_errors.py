"""Answers that pass as "as good as a textbook's formula", and are exact only for inputs farther off than rounding."""

import numpy as np
import pytest

from mi_refract.ray_sets import ray_set, reports
from mi_refract.ray_sets.check_answers import check
from mi_refract.ray_sets.judged_answers import RIGHT
from mi_refract.ray_sets.ray_set import Answers
from validation.suite import small_mistakes
from validation.suite.small_mistakes import textbook, tilted

LARGE = {"k ≫ 1", "critical, any k, to the ulp", "axes, signed zeros", "denormal"}  # regimes with ratios far above 1


def answered(rays, answer):
    given = rays.rays
    with np.errstate(all="ignore"):
        return Answers(rays.ids, answer(given.a, given.n, given.k[:, None]).astype(float))


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
def test_the_textbook_is_right_but_where_k_is_large(precision):
    rays = ray_set.make(None, 200, precision, 3)
    found = check(rays, answered(rays, textbook))
    assert found.exit_code == 0
    for each in found.regimes:
        assert (each.backward_worst > RIGHT) == (each.regime in LARGE), each.regime
        assert (each.right < each.rays) == (each.regime in LARGE)
        assert each.backward_median <= each.backward_p99 <= each.backward_worst
    strict = check(rays, answered(rays, textbook), most_backward=RIGHT)
    assert strict.exit_code == 1 and strict.wrong == found.answered - found.right
    assert {each.regime for each in strict.regimes if each.wrong} == LARGE


def test_where_k_is_large_the_sine_is_lost_in_1_minus_c_squared():
    """sin²θ_i from 1 − c² is off by u, and the radicand by k² u; from |n × a|² by u sin²θ_i. That is all of it."""
    rays = ray_set.make(["k ≫ 1"], 500, "f32", 3)

    def by(sine_squared):
        def answer(a, n, k):
            c = (n * a).sum(1, keepdims=True)
            radicand = 1 - k * k * sine_squared(a, n, c)
            return np.where(radicand < 0, 0, k * (a - c * n) - np.sqrt(np.maximum(radicand, 0)) * n)

        return check(rays, answered(rays, answer))

    lost, kept = by(lambda a, n, c: 1 - c * c), by(lambda a, n, c: (np.cross(n, a) ** 2).sum(1, keepdims=True))
    assert lost.right < 0.6 * lost.answered and lost.regimes[0].backward_worst > 100
    assert kept.right == kept.answered and kept.regimes[0].backward_worst < 1


def test_a_normal_off_by_a_millionth_hid_and_is_seen():
    rays = ray_set.make(["generic"], 500, "f32", 3)
    found = check(rays, answered(rays, tilted))
    assert (found.exit_code, reports.grade(found.regimes[0])) == (0, "within bound")
    assert found.right < found.answered / 2
    assert check(rays, answered(rays, tilted), most_backward=RIGHT).exit_code == 1
    assert check(rays, answered(rays, textbook), most_backward=RIGHT).exit_code == 0


def test_a_transmitted_ray_that_is_called_reflected_far_from_the_critical_angle():
    rays = ray_set.make(["generic"], 100, "f32", 3)
    answers = answered(rays, textbook)
    lost = int(np.flatnonzero(answers.b.any(axis=1))[0])
    b = answers.b.copy()
    b[lost] = 0
    (regime,) = check(rays, Answers(rays.ids, b), tir="zero").regimes
    assert regime.backward_worst > 1e3 and regime.right == regime.rays - 1


def test_an_answer_that_is_no_direction_is_exact_for_no_input():
    rays = ray_set.make(["generic"], 100, "f32", 3)
    answers = answered(rays, textbook)
    b = answers.b.copy()
    b[:50] = np.nan
    (regime,) = check(rays, Answers(rays.ids, b), tir="zero").regimes
    assert (regime.backward_worst, regime.backward_p99) == (np.inf, np.inf)


@pytest.mark.parametrize("most", [0.0, -1.0, np.nan])
def test_a_limit_that_is_none(most):
    rays = ray_set.make(["generic"], 5, "f32", 3)
    with pytest.raises(ValueError, match="most_backward"):
        check(rays, answered(rays, textbook), most_backward=most)


@pytest.mark.parametrize("precision", ray_set.PRECISIONS)
@pytest.mark.parametrize("name", small_mistakes.MISTAKES)
def test_every_small_mistake_is_seen_where_it_matters(name, precision):
    (row,) = small_mistakes.rows(name, precision)
    harmless = precision == small_mistakes.MISTAKES[name].harmless[0]
    assert row.verdict == "pass" and row.values["not seen"] == harmless
    assert row.values["m, worst, without"] <= RIGHT < row.values["m, worst"] or harmless


def test_a_mistake_that_is_not_seen_fails(monkeypatch):
    monkeypatch.setitem(small_mistakes.MISTAKES, "none", small_mistakes.Mistake(textbook, "generic"))
    (row,) = small_mistakes.rows("none", "f32")
    assert row.verdict == "fail" and row.broken == {"not seen": 0.0}
