"""Errors of made-up answers are those that they were made with, and the verdict follows from them and from bounds."""

from dataclasses import replace

import numpy as np
import pytest

from mi_refract import oracle, regimes
from mi_refract.accuracy import (
    RayBounds,
    absolute_radicand,
    errors,
    errors_of_normalised,
    judge,
    lengths,
    relative_radicand,
)
from mi_refract.formulas import FORMULAS, ROUNDING, Budget, cancelling
from mi_refract.regimes import Rays

U = 2.0**-53
DECOMPOSED = FORMULAS["decomposed"].budget
# sin θ_i and k; the last one is totally reflected.
SINES, RATIOS = np.array([0.1, 0.5, 0.6, 0.9]), np.array([1.5, 1.5, 0.75, 1.5])
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])  # no axis is special


def rays(a_length=1.0, n_length=1.0):
    zero = 0 * SINES
    a = np.stack([SINES, zero, -np.sqrt(1 - SINES**2)], 1) @ TURN.T
    n = np.stack([zero, zero, zero + 1], 1) @ TURN.T
    return Rays(a_length * a, n_length * n, RATIOS)


def certified(given):
    return oracle.refract(given.a, given.n, given.k, fresnel=False, progress=False)


EXACT = certified(rays())


def turned(exact, angle, length=1.0):
    """The exact directions, turned by an angle out of the plane of incidence, and as long as that."""
    return length * (np.cos(angle) * exact.direction + np.sin(angle) * TURN[:, 1])


def verdict(b, transmitted, exact=EXACT, budget=DECOMPOSED, **more):
    return judge(b, transmitted, RayBounds(rays(), exact, budget, U), **more)


# Errors --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [0.5, 0.9, 1.0, 1.1, 1.25, 1.8, 2.0, 2.2])
def test_errors_are_relative_to_the_length_of_a_or_of_normalised_answers_to_1_if_nearer(length):
    """Of a of length 2: an answer of length 2 x is off by x − 1, or by 2 x − 1 where it may have been made unit."""
    given = rays(a_length=2.0)
    b = turned(EXACT, 1e-3, 2 * length)
    kept, normalised = errors(b, given, EXACT), errors_of_normalised(b, given, EXACT)
    for found in (kept, normalised):
        np.testing.assert_allclose(found.angle, 1e-3, rtol=1e-9)
    np.testing.assert_allclose(kept.drift, abs(length - 1), atol=1e-15)
    np.testing.assert_allclose(kept.chord, np.hypot(length * np.cos(1e-3) - 1, length * np.sin(1e-3)), rtol=1e-9)
    np.testing.assert_allclose(normalised.drift, min(abs(length - 1), abs(2 * length - 1)), atol=1e-15)
    np.testing.assert_allclose(normalised.chord, 2 * np.sin(5e-4), rtol=1e-9)
    b[1] = np.nan
    for found in (errors(b, given, EXACT), errors_of_normalised(b, given, EXACT)):
        assert np.isinf(found.chord).tolist() == np.isinf(found.angle).tolist() == [False, True, False, False]


def test_errors_are_right_to_extended_precision():
    given = regimes.make("generic", 50, np.float64, seed=1)
    exact, length = certified(given), lengths(given.a)[:, None]
    direction = exact.direction.astype(np.longdouble) + exact.direction_low
    assert max(x.max() for x in errors(direction * length, given, exact)) < 1e-18
    across = np.cross(direction, np.roll(direction, 1, axis=1))
    found = errors((direction + 1e-9 * across / lengths(across)[:, None]) * length, given, exact)
    assert found.chord == pytest.approx(1e-9, rel=1e-6) and found.angle == pytest.approx(1e-9, rel=1e-6)


@pytest.mark.parametrize(("a_length", "n_length"), [(1.0, 1.0), (2.0, 1.0), (1.0, 4.0), (0.5, 4.0)])
def test_the_radicand_does_not_depend_on_lengths(a_length, n_length):
    found = absolute_radicand(rays(a_length, n_length)).astype(float)
    np.testing.assert_allclose(found, np.abs(1 - (RATIOS * SINES) ** 2), rtol=1e-12)


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_near_the_critical_angle_the_relative_radicand_is_that_of_the_oracle(precision):
    given = regimes.make("critical", 50, precision, seed=1)
    exact = oracle.relative_radicand(given.a, given.n, given.k)
    near = np.abs(exact) < 1e-2
    assert near.sum() > 10
    np.testing.assert_allclose(relative_radicand(given)[near].astype(float), np.abs(exact[near]), rtol=1e-2)


# Bounds and verdict --------------------------------------------------------------------------------------------------


def test_vectors_off_unit_widen_the_bound_by_what_making_them_unit_would_cost():
    """By 3 u, where the program may have made them unit; otherwise by as much as they are off."""
    given = rays(a_length=1 + 2.0**-40, n_length=1 - 2.0**-41)
    exact = certified(given)
    for budget, normalised, u in (("decomposed", True, 3 * U), ("decomposed", False, 2.0**-40), ("promoted", False, U)):
        bounds = RayBounds(given, exact, FORMULAS[budget].budget, U, normalised)
        np.testing.assert_allclose(bounds.u, u, rtol=1e-3)
        assert np.all(bounds.unit) == normalised
    assert np.all(RayBounds(rays(), exact, DECOMPOSED, U).unit)


def test_an_error_is_judged_by_the_bound_of_its_ray_and_what_it_needs_of_the_constants_is_found():
    assert EXACT.transmitted.tolist() == [True, True, True, False]
    bounds = verdict(EXACT.direction, EXACT.transmitted).bounds
    shares = np.array([0.5, 2.0, 0.5, 2.0])
    found = verdict(turned(EXACT, (shares * bounds.chord)[:, None]), EXACT.transmitted)
    np.testing.assert_allclose(found.share, shares, rtol=0.1)
    assert found.wrong.tolist() == [False, True, False, True]
    assert found.compared.all() and not found.far.any() and not found.blank.any()
    assert found.values() == {"error / bound": found.share.max(), "TIR misclassified, beyond its bound": 0}
    within = verdict(turned(EXACT, (0.9 * bounds.chord)[:, None]), EXACT.transmitted)
    assert not within.wrong.any() and within.meets(DECOMPOSED).all() and not within.meets(ROUNDING).any()
    # An error L u K, and that of the root, needs L.
    found = verdict(turned(EXACT, (3 * bounds.of_terms + bounds.of_root)[:, None]), EXACT.transmitted)
    np.testing.assert_allclose(found.linear_needed, 3 * DECOMPOSED.linear, rtol=0.1)
    # A cosine too long by what an error x of the radicand makes of it needs x.
    along = np.sqrt(EXACT.cos_t**2 + 13 * U * np.maximum(1, RATIOS)) - EXACT.cos_t
    longer = EXACT.direction - (along * EXACT.transmitted)[:, None] * rays().n
    needed = verdict(longer, EXACT.transmitted, budget=Budget(1e-9, 14, 1)).radicand_needed
    np.testing.assert_allclose(needed[:3], 13, atol=2)
    missed = verdict(EXACT.direction, np.zeros(4, bool))
    needed = np.abs(1 - (RATIOS * SINES) ** 2) / (bounds.u * np.maximum(RATIOS, 1) ** DECOMPOSED.growth)
    np.testing.assert_allclose(missed.radicand_needed[:3], needed[:3], rtol=1e-9)
    assert missed.radicand_needed[3] == 0


def test_misclassified_blank_and_undecided_rays_are_not_compared_and_wrong():
    found = verdict(EXACT.direction, EXACT.transmitted ^ np.array([True, False, False, True]))
    assert found.misjudged.tolist() == found.far.tolist() == found.wrong.tolist() == [True, False, False, True]
    assert found.compared.tolist() == [False, True, True, False]
    assert found.values()["TIR misclassified, beyond its bound"] == 2 and found.share[[0, 3]].tolist() == [0, 0]

    first = np.arange(4) == 0
    found = verdict(EXACT.direction, EXACT.transmitted, directed=EXACT.transmitted, blank=first)
    assert found.compared.tolist() == [False, True, True, False] and not found.misjudged.any()
    assert found.wrong.tolist() == found.blank.tolist() == first.tolist()

    nan = {x: np.where(first, np.nan, getattr(EXACT, x)) for x in ("cos_t", "cos_i")}
    open_ = replace(EXACT, undecided=first, transmitted=EXACT.transmitted & ~first, **nan)
    for transmitted in (True, False):  # whatever the answer is
        found = verdict(EXACT.direction, EXACT.transmitted & ~first | (first & transmitted), open_)
        assert found.compared.tolist() == [False, True, True, True] and not found.misjudged.any()
        assert found.far.tolist() == found.wrong.tolist() == first.tolist()
        assert found.values()["TIR misclassified, beyond its bound"] == 1


def test_an_infinite_error_never_passes_also_within_an_infinite_bound():
    """At normal incidence with k = 1e300 the bound is infinite, and ∞/∞ is no share at most 1."""
    n = np.array([[0.0, 0, 1]])
    given = Rays(-n, n, np.array([1e300]))
    exact = certified(given)
    with np.errstate(over="ignore", invalid="ignore"):
        bounds = RayBounds(given, exact, DECOMPOSED, U)
        found = judge(np.full((1, 3), np.nan), exact.transmitted, bounds)
        assert np.isinf(bounds.chord) and np.isnan(found.share)
        assert found.compared and found.wrong


# One ray on the z axis -----------------------------------------------------------------------------------------------


def judged(a, k, answer, budget, precision=np.float64):
    """The judgement of `answer(exact)`: b, or None for a, and whether it is transmitted."""
    given = Rays(np.array([a], precision), np.array([[0.0, 0.0, 1.0]], precision), np.array([k], precision))
    exact = certified(given)
    b, transmitted = answer(exact)
    b = given.a if b is None else np.asarray(b, float).reshape(1, 3)
    u = float(np.finfo(precision).eps) / 2
    return judge(b.astype(np.longdouble), np.array([transmitted]), RayBounds(given, exact, budget, u))


def crossed(exact):
    """The exact direction on the wrong side of the surface."""
    return exact.direction * [1, 1, -1], True


def other_decision(exact):
    return None, not exact.transmitted[0]


@pytest.mark.parametrize("transmitted", [True, False])
@pytest.mark.parametrize(("side", "cos_i", "held"), [(4.0, 2 * U, False), (4.0, 32 * U, True), (0.0, 2 * U, True)])
def test_next_to_the_surface_either_side_is_right_where_the_side_is_open(side, cos_i, held, transmitted):
    """A ray into the denser medium that comes out on the wrong side, or is taken for a tangential one."""
    found = judged((1, 0, -cos_i), 0.5, crossed if transmitted else other_decision, Budget(10, 14, 1, side=side))
    assert found.wrong.tolist() == [held]
    assert found.crossed.tolist() == [transmitted and not held]


@pytest.mark.parametrize("name", [name for name, formula in FORMULAS.items() if formula.budget.side])
def test_the_side_is_known_three_times_as_far_from_the_surface_as_it_need_not_be(name):
    """n·a by three products and two sums is off by 3 u of its terms, and by what rounding a and n costs: 4 u."""
    for cos_i, held in ((3 * U, False), (12 * U, True)):
        assert judged((1, 0, -cos_i), 0.5, crossed, FORMULAS[name].budget).wrong.tolist() == [held]


def test_a_mirrored_ray_next_to_the_surface_has_not_crossed_it():
    found = judged((1, 0, -2 * U), 1.5, lambda exact: ([1.0, 0.0, 3 * U], False), cancelling(1))
    assert found.chord[0] > 0 and not found.wrong[0] and not found.crossed[0]


@pytest.mark.parametrize(("steps", "far"), [(0, False), (1, True), (-1, True)])
def test_at_the_limit_a_decision_is_held_to_the_terms_of_the_radicand(steps, far):
    """sin θ = 4/5: critical at k = 5/4 exactly, and an ulp of k is 1e16 times more than what is left undecided."""
    found = judged((4, 0, -3), 1.25 + steps * 2.0**-52, other_decision, ROUNDING)
    assert (found.misjudged.tolist(), found.far.tolist()) == ([True], [far])


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize(("apart", "far"), [(0.5, False), (10.0, True)])
def test_at_the_limit_a_radicand_of_a_hundred_u_squared_decides(precision, apart, far):
    """(n·a)² = κ w² but for a part y of the ray across: w² = 16 (1 + y²), y = `apart` u, and κ = 9/16."""
    u = float(np.finfo(precision).eps) / 2
    found = judged((4.0, 4 * apart * u, -3.0), 1.25, other_decision, ROUNDING, precision)
    assert not found.bounds.exact.transmitted[0]
    assert (found.misjudged.tolist(), found.far.tolist()) == ([True], [far])


@pytest.mark.parametrize(("length", "bound"), [(1.0, 0.8724), (1 + 2.0**-52, 1.005), (3.0, 1.005)])
def test_the_length_of_the_ray_itself_says_which_rounding_it_is_held_to(length, bound):
    found = judged((0, 0, -length), 1.5, lambda exact: (None, True), ROUNDING)
    assert found.bounds.chord == pytest.approx(bound * U)
