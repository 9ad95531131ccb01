"""Budgets bound every ray, and the judgement finds what their constants would have to be."""

import dataclasses
import math

import numpy as np
import pytest

from mi_refract import oracle, regimes
from mi_refract.accuracy import RayBounds, evaluate, judge, judge_formula
from mi_refract.formulas import FORMULAS, LARGEST_RATIO, ROUNDING, SMALLEST_RATIO, Budget, cancelling, radicand_for
from mi_refract.formulas.bounds import root

U = 2.0**-53


@pytest.mark.parametrize("cos_t", [0.0, 1e-12, 1e-3, 0.5, 1.0])
@pytest.mark.parametrize("x", [1e-15, 1e-6, 1e-3, 0.3])
def test_the_root_moves_by_no_more_than_its_bound_and_nearly_as_much(x, cos_t):
    """Against the definition, in both directions."""
    e = np.linspace(-min(x, cos_t**2), x, 1001)
    with np.errstate(invalid="ignore"):
        moved = np.abs(e / (np.sqrt(cos_t**2 + e) + cos_t))  # |√(D + e) − √D|
    assert np.nanmax(moved) <= root(x, cos_t) * (1 + 1e-12)
    assert np.nanmax(moved) >= 0.6 * root(x, cos_t)


@pytest.mark.parametrize("cos_t", [0.0, 1e-9, 1e-3, 0.9])
@pytest.mark.parametrize("error", [0.0, 1e-12, 1e-3, 2.0])
def test_the_root_has_an_inverse(error, cos_t):
    x = radicand_for(np.array(error), cos_t)
    assert root(x, cos_t) == pytest.approx(error, rel=1e-6)


def test_a_bound_grows_with_the_ratio_where_the_ray_is_transmitted_only():
    budget = Budget(10, 14, 2)
    assert budget.chord(U, 0.5, 1.0) == pytest.approx((10 + 7) * U, rel=1e-6)
    assert budget.chord(U, 100.0, 1.0) == pytest.approx((1000 + 7e4) * U, rel=1e-6)
    assert budget.chord(U, 100.0, transmitted=False) == 10 * U
    assert budget.chord(U, 1.0) == pytest.approx(10 * U + math.sqrt(14 * U))
    assert ROUNDING.chord(U, 1e6) == 0.8724 * U
    assert ROUNDING.chord(U, 1e6, unit=False) == 1.005 * U
    assert budget.chord(U, 1.0, 1.0, unit=False) == budget.chord(U, 1.0, 1.0)


def test_a_side_that_is_not_known_may_be_either():
    open_side, known = Budget(10, side=4), Budget(10)
    assert open_side.chord(U, 0.5, 0.8, cos_i=4 * U) == 10 * U + 1.6
    assert open_side.chord(U, 0.5, 0.8, cos_i=5 * U) == known.chord(U, 0.5, 0.8, cos_i=0.0) == 10 * U


@pytest.mark.parametrize("end", [SMALLEST_RATIO, LARGEST_RATIO])
@pytest.mark.parametrize("name", FORMULAS)
def test_bounds_hold_up_to_the_least_and_the_largest_ratio_and_there_is_no_answer_beyond(name, end, setting):
    """A factor of two up to either end, the refracted angle uniform in its sine."""
    rng, count = np.random.default_rng(6), 40 if setting.backend == "scalar" else 4000
    n, k = rng.normal(size=(count, 3)), end * rng.uniform(*((0.5, 1) if end > 1 else (1, 2)), count)
    k[0], n = end, n / np.linalg.norm(n, axis=1, keepdims=True)
    t = np.cross(n, rng.normal(size=(count, 3)))
    sine = rng.uniform(0, 1, (count, 1)) / np.maximum(k, 1)[:, None]
    a = sine * t / np.linalg.norm(t, axis=1, keepdims=True) - np.sqrt(1 - sine * sine) * n
    rays = regimes.Rays(*(x.astype(setting.precision) for x in (a, n, k)))
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    formula = FORMULAS[name]
    found = judge_formula(formula, rays, exact, setting.vector, formula.budget)
    assert not found.wrong.any() and exact.transmitted.sum() > count / 2
    beyond = regimes.Rays(rays.a, rays.n, rays.k * setting.precision(2 if end > 1 else 0.5))
    b, transmitted = evaluate(formula, beyond, setting.vector)
    assert np.isnan(b[0]).all() and not transmitted[0]


@pytest.fixture(scope="module")
def sample():
    rays = regimes.make("critical", 300, np.float64, seed=4)
    return rays, oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)


def off(exact, linear, radicand):
    """A subject of numpy arrays that is off by so much of u, sideways and in its radicand."""

    def subject(a, n, k):
        i = subject.calls = subject.calls + 1
        unit, length = exact.direction[i], math.hypot(*a)
        c = math.copysign(exact.cos_t[i], np.dot(unit, n))
        longer = math.sqrt(exact.cos_t[i] ** 2 + radicand * U * k) - exact.cos_t[i] if exact.transmitted[i] else 0.0
        across = np.cross(a, n) / np.linalg.norm(np.cross(a, n))
        b = unit + across * linear * U + np.array(n) * math.copysign(longer, c)
        return [float(x) * length for x in b], bool(exact.transmitted[i])

    subject.calls = -1
    return subject


@pytest.mark.parametrize(("linear", "radicand"), [(9.0, 0.0), (0.0, 13.0)])
def test_what_a_subject_needs_of_either_constant_is_found(sample, linear, radicand):
    rays, exact = sample
    scale = np.where(exact.transmitted, rays.k, 1.0)
    found = judge_formula(off(exact, linear, radicand), rays, exact, list, cancelling(1))
    assert found.share.max() <= 1
    # Rounding of the planted answer is up to two u.
    needed = Budget(1e-9, 14, 1) if radicand else Budget(10, 0, 1)
    again = judge_formula(off(exact, linear, radicand), rays, exact, list, needed)
    found = again.radicand_needed if radicand else again.linear_needed * scale
    assert found.max() == pytest.approx(linear + radicand, abs=2)


def test_a_constant_too_small_is_broken(sample):
    rays, exact = sample
    assert judge_formula(off(exact, 9.0, 0.0), rays, exact, list, Budget(4, 0, 1)).share.max() > 1
    assert judge_formula(off(exact, 0.0, 13.0), rays, exact, list, Budget(10, 3, 1)).share.max() > 1


def test_a_decision_far_from_the_critical_angle_is_held_against_the_subject(sample):
    rays, exact = sample
    mirrored = judge_formula(lambda a, n, k: (list(a), False), rays, exact, list, cancelling(1))
    assert mirrored.misjudged.sum() == exact.transmitted.sum()
    assert mirrored.far.sum() == exact.transmitted.sum()  # within 1e-7 rad, the margin is 14 · 2⁻⁵³
    assert mirrored.radicand_needed.max() > 14


def judged(a, k, answer, budget):
    """The judgement of one ray on the z axis; `answer(a, exact)`: b, and whether it is transmitted."""
    rays = regimes.Rays(np.array([a], float), np.array([[0.0, 0.0, 1.0]]), np.array([k], float))
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    return judge_formula(lambda a, n, k: answer(list(a), exact), rays, exact, list, budget)


def crossed(a, exact):
    """The exact direction on the wrong side of the surface."""
    x, y, z = exact.direction[0].tolist()
    return [x, y, -z], True


@pytest.mark.parametrize("transmitted", [True, False])
@pytest.mark.parametrize(("side", "cos_i", "held"), [(4.0, 2 * U, False), (4.0, 32 * U, True), (0.0, 2 * U, True)])
def test_next_to_the_surface_either_side_is_right_where_the_side_is_open(side, cos_i, held, transmitted):
    """A ray into the denser medium that comes out on the wrong side, or is taken for a tangential one."""
    answer = crossed if transmitted else lambda a, exact: (a, False)
    found = judged((1, 0, -cos_i), 0.5, answer, Budget(10, 14, 1, side=side))
    assert found.wrong.tolist() == [held]
    assert found.crossed.tolist() == [transmitted and not held]


@pytest.mark.parametrize("name", [name for name, formula in FORMULAS.items() if formula.budget.side])
@pytest.mark.parametrize(("cos_i", "held"), [(3 * U, False), (12 * U, True)])
def test_the_side_is_known_three_times_as_far_from_the_surface_as_it_need_not_be(name, cos_i, held):
    """n·a by three products and two sums is off by 3 u of its terms, and by what rounding a and n costs: 4 u."""
    assert judged((1, 0, -cos_i), 0.5, crossed, FORMULAS[name].budget).wrong.tolist() == [held]


@pytest.mark.parametrize(("steps", "far"), [(0, False), (1, True), (-1, True)])
def test_at_the_limit_a_decision_is_held_to_the_terms_of_the_radicand(steps, far):
    """sin θ = 4/5: critical at k = 5/4 exactly, and an ulp of k is 1e16 times more than what is left undecided."""
    found = judged((4, 0, -3), 1.25 + steps * 2.0**-52, lambda a, exact: (a, not exact.transmitted[0]), ROUNDING)
    assert (found.misjudged.tolist(), found.far.tolist()) == ([True], [far])


@pytest.mark.parametrize(("length", "bound"), [(1.0, 0.8724), (1 + 2.0**-52, 1.005), (3.0, 1.005)])
def test_the_length_of_the_ray_itself_says_which_rounding_it_is_held_to(length, bound):
    found = judged((0, 0, -length), 1.5, lambda a, exact: (a, True), ROUNDING)
    assert found.bounds.chord == pytest.approx(bound * U)


def test_a_mirrored_ray_next_to_the_surface_has_not_crossed_it():
    found = judged((1, 0, -2 * U), 1.5, lambda a, exact: ([1.0, 0.0, 3 * U], False), cancelling(1))
    assert found.chord[0] > 0
    assert not found.wrong[0] and not found.crossed[0]


def test_a_ray_that_the_oracle_could_not_decide_breaks_the_budget():
    rays = regimes.make("generic", 20, np.float64, seed=3)
    exact = oracle.refract(rays.a, rays.n, rays.k, progress=False)
    unknown = dataclasses.replace(exact, undecided=np.arange(20) == 7)
    b, transmitted = exact.direction.astype(np.longdouble), exact.transmitted
    assert not judge(b, transmitted, RayBounds(rays, exact, ROUNDING, U)).wrong.any()
    assert np.flatnonzero(judge(b, transmitted, RayBounds(rays, unknown, ROUNDING, U)).wrong).tolist() == [7]


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize(("apart", "far"), [(0.5, False), (10.0, True)])
def test_at_the_limit_a_radicand_of_a_hundred_u_squared_decides(precision, apart, far):
    """(n·a)² = κ w² but for a part y of the ray across: w² = 16 (1 + y²), y = `apart` u, and κ = 9/16."""
    u = float(np.finfo(precision).eps) / 2
    a = np.array([[4.0, 4 * apart * u, -3.0]], precision)
    rays = regimes.Rays(a, np.array([[0.0, 0.0, 1.0]], precision), np.array([1.25], precision))
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    assert not exact.transmitted[0]
    called = judge(rays.a.astype(float), np.array([True]), RayBounds(rays, exact, ROUNDING, u))
    assert called.misjudged.tolist() == [True]
    assert called.far.tolist() == [far]
