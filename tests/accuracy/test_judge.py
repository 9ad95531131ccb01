"""Errors of made-up answers are those that they were made with, and the verdict follows from them."""

from dataclasses import replace

import numpy as np
import pytest

from mi_refract import oracle, regimes
from mi_refract.accuracy import (
    Judgement,
    RayBounds,
    absolute_radicand,
    errors,
    errors_of_normalised,
    judge,
    lengths,
    relative_radicand,
)
from mi_refract.formulas import FORMULAS, ROUNDING
from mi_refract.regimes import Rays

U = 2.0**-53
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


def turned(exact, angle, length=1.0):
    """The exact directions, turned by an angle out of the plane of incidence, and as long as that."""
    return length * (np.cos(angle) * exact.direction + np.sin(angle) * TURN[:, 1])


@pytest.mark.parametrize("length", [0.5, 0.9, 1.0, 1.1, 1.25, 1.8, 2.0, 2.2])
def test_errors_are_relative_to_the_length_of_a_or_of_normalised_answers_to_1_if_nearer(length):
    """Of a of length 2: an answer of length 2 x is off by x − 1, or by 2 x − 1 where it may have been made unit."""
    given = rays(a_length=2.0)
    exact = certified(given)
    b = turned(exact, 1e-3, 2 * length)
    kept, normalised = errors(b, given, exact), errors_of_normalised(b, given, exact)
    for found in (kept, normalised):
        np.testing.assert_allclose(found.angle, 1e-3, rtol=1e-9)
    np.testing.assert_allclose(kept.drift, abs(length - 1), atol=1e-15)
    np.testing.assert_allclose(kept.chord, np.hypot(length * np.cos(1e-3) - 1, length * np.sin(1e-3)), rtol=1e-9)
    np.testing.assert_allclose(normalised.drift, min(abs(length - 1), abs(2 * length - 1)), atol=1e-15)
    np.testing.assert_allclose(normalised.chord, 2 * np.sin(5e-4), rtol=1e-9)


def test_what_is_no_number_is_infinitely_wrong():
    given = rays()
    exact = certified(given)
    b = turned(exact, 0.0)
    b[1] = np.nan
    for found in (errors(b, given, exact), errors_of_normalised(b, given, exact)):
        assert np.isinf(found.chord).tolist() == np.isinf(found.angle).tolist() == [False, True, False, False]


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


def test_lengths_are_of_rows():
    np.testing.assert_array_equal(lengths(np.array([[3.0, 4.0, 12.0], [0.0, -2.0, 0.0]])), [13, 2])


def verdict(b, transmitted, exact=None, **more) -> Judgement:
    given = rays()
    bounds = RayBounds(given, exact or certified(given), FORMULAS["decomposed"].budget, U)
    return judge(b, transmitted, bounds, **more)


def test_vectors_off_unit_widen_the_bound_by_what_making_them_unit_would_cost():
    """By 3 u, where the program may have made them unit; otherwise by as much as they are off."""
    given = rays(a_length=1 + 2.0**-40, n_length=1 - 2.0**-41)
    exact = certified(given)
    for budget, normalised, u in (("decomposed", True, 3 * U), ("decomposed", False, 2.0**-40), ("promoted", False, U)):
        bounds = RayBounds(given, exact, FORMULAS[budget].budget, U, normalised)
        np.testing.assert_allclose(bounds.u, u, rtol=1e-3)
        assert np.all(bounds.unit) == normalised
    assert np.all(RayBounds(rays(), exact, FORMULAS["decomposed"].budget, U).unit)


def test_an_error_is_judged_by_the_bound_of_its_ray():
    exact = certified(rays())
    assert exact.transmitted.tolist() == [True, True, True, False]
    chord = verdict(exact.direction, exact.transmitted).bounds.chord
    shares = np.array([0.5, 2.0, 0.5, 2.0])
    found = verdict(turned(exact, (shares * chord)[:, None]), exact.transmitted)
    np.testing.assert_allclose(found.share, shares, rtol=0.1)
    assert found.wrong.tolist() == [False, True, False, True]
    assert found.compared.all() and not found.far.any() and not found.blank.any()
    assert found.values() == {"error / bound": found.share.max(), "TIR misclassified, beyond its bound": 0}
    within = verdict(turned(exact, (0.9 * chord)[:, None]), exact.transmitted)
    assert not within.wrong.any() and within.meets(FORMULAS["decomposed"].budget).all()
    assert not within.meets(ROUNDING).any()


def test_a_misclassified_ray_is_not_compared_and_wrong_where_it_is_far_from_the_critical_angle():
    exact = certified(rays())
    found = verdict(exact.direction, exact.transmitted ^ np.array([True, False, False, True]))
    assert found.misjudged.tolist() == found.far.tolist() == found.wrong.tolist() == [True, False, False, True]
    assert found.compared.tolist() == [False, True, True, False]
    assert found.values()["TIR misclassified, beyond its bound"] == 2
    assert found.share[[0, 3]].tolist() == [0, 0]


def test_what_is_no_direction_is_not_compared():
    exact = certified(rays())
    blank = np.array([True, False, False, False])
    found = verdict(exact.direction, exact.transmitted, directed=exact.transmitted, blank=blank)
    assert found.compared.tolist() == [False, True, True, False]
    assert found.wrong.tolist() == found.blank.tolist() == blank.tolist()
    assert not found.misjudged.any()


@pytest.mark.parametrize("transmitted", [True, False])
def test_a_ray_that_the_oracle_could_not_decide_never_passes(transmitted):
    """Whatever the answer is: it is neither compared nor misclassified, and counts against the bound."""
    exact, first = certified(rays()), np.arange(4) == 0
    nan = {x: np.where(first, np.nan, getattr(exact, x)) for x in ("cos_t", "cos_i")}
    open_ = replace(exact, undecided=first, transmitted=exact.transmitted & ~first, **nan)
    found = verdict(exact.direction, exact.transmitted & ~first | (first & transmitted), open_)
    assert found.compared.tolist() == [False, True, True, True]
    assert found.misjudged.tolist() == [False] * 4
    assert found.far.tolist() == found.wrong.tolist() == [True, False, False, False]
    assert found.values()["TIR misclassified, beyond its bound"] == 1


def test_an_infinite_error_never_passes_also_within_an_infinite_bound():
    """At normal incidence with k = 1e300 the bound is infinite, and ∞/∞ is no share at most 1."""
    n = np.array([[0.0, 0, 1]])
    given = Rays(-n, n, np.array([1e300]))
    exact = certified(given)
    with np.errstate(over="ignore", invalid="ignore"):
        bounds = RayBounds(given, exact, FORMULAS["decomposed"].budget, U)
        found = judge(np.full((1, 3), np.nan), exact.transmitted, bounds)
        assert np.isinf(bounds.chord) and np.isnan(found.share)
        assert found.compared and found.wrong


def test_the_bound_covers_the_error_that_it_was_derived_from():
    """`linear_needed` of an error L u K, and that of the root, is L; `radicand_needed` of a missed ray its own."""
    exact, budget = certified(rays()), FORMULAS["decomposed"].budget
    bounds = verdict(exact.direction, exact.transmitted).bounds
    found = verdict(turned(exact, (3 * bounds.of_terms + bounds.of_root)[:, None]), exact.transmitted)
    np.testing.assert_allclose(found.linear_needed, 3 * budget.linear, rtol=0.1)
    missed = verdict(exact.direction, np.zeros(4, bool))
    needed = np.abs(1 - (RATIOS * SINES) ** 2) / (bounds.u * np.maximum(RATIOS, 1) ** budget.growth)
    np.testing.assert_allclose(missed.radicand_needed[:3], needed[:3], rtol=1e-9)
    assert missed.radicand_needed[3] == 0
