"""Errors of answers with known errors, and the verdicts that follow from them and from the bounds."""

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
# sin θ_i and k; the last ray is totally reflected.
SINES, RATIOS = np.array([0.1, 0.5, 0.6, 0.9]), np.array([1.5, 1.5, 0.75, 1.5])
TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])  # a rotation, so that no axis is special


def rays(a_length=1.0, n_length=1.0):
    zero = 0 * SINES
    a = np.stack([SINES, zero, -np.sqrt(1 - SINES**2)], 1) @ TURN.T
    n = np.stack([zero, zero, zero + 1], 1) @ TURN.T
    return Rays(a_length * a, n_length * n, RATIOS)


def certified(incident):
    return oracle.refract(incident.a, incident.n, incident.k, fresnel=False, progress=False)


EXACT = certified(rays())


def turned_answers(exact, angle, length=1.0):
    """The exact directions, turned by an angle out of the plane of incidence, with the given length."""
    return length * (np.cos(angle) * exact.direction + np.sin(angle) * TURN[:, 1])


def verdict(b, transmitted, exact=EXACT, budget=DECOMPOSED, **more):
    return judge(b, transmitted, RayBounds(rays(), exact, budget, U), **more)


# Errors --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [0.5, 0.9, 1.0, 1.1, 1.25, 1.8, 2.0, 2.2])
def test_errors_are_relative_to_the_length_of_a_or_to_1_for_normalised_answers(length):
    """For |a| = 2, the error of a length 2 x is x − 1, or 2 x − 1 if the answer may have been made unit."""
    long_rays = rays(a_length=2.0)
    b = turned_answers(EXACT, 1e-3, 2 * length)
    plain, normalised = errors(b, long_rays, EXACT), errors_of_normalised(b, long_rays, EXACT)
    for result in (plain, normalised):
        np.testing.assert_allclose(result.angle, 1e-3, rtol=1e-9)
    np.testing.assert_allclose(plain.drift, abs(length - 1), atol=1e-15)
    np.testing.assert_allclose(plain.chord, np.hypot(length * np.cos(1e-3) - 1, length * np.sin(1e-3)), rtol=1e-9)
    np.testing.assert_allclose(normalised.drift, min(abs(length - 1), abs(2 * length - 1)), atol=1e-15)
    np.testing.assert_allclose(normalised.chord, 2 * np.sin(5e-4), rtol=1e-9)
    b[1] = np.nan
    for result in (errors(b, long_rays, EXACT), errors_of_normalised(b, long_rays, EXACT)):
        assert np.isinf(result.chord).tolist() == np.isinf(result.angle).tolist() == [False, True, False, False]


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="numpy.longdouble has less than 64 bits")
def test_errors_are_computed_in_extended_precision():
    generic = regimes.make("generic", 50, np.float64, seed=1)
    exact, length = certified(generic), lengths(generic.a)[:, None]
    direction = exact.direction.astype(np.longdouble) + exact.direction_low
    assert max(x.max() for x in errors(direction * length, generic, exact)) < 1e-18
    across = np.cross(direction, np.roll(direction, 1, axis=1))
    result = errors((direction + 1e-9 * across / lengths(across)[:, None]) * length, generic, exact)
    assert result.chord == pytest.approx(1e-9, rel=1e-6) and result.angle == pytest.approx(1e-9, rel=1e-6)


@pytest.mark.parametrize(("a_length", "n_length"), [(1.0, 1.0), (2.0, 1.0), (1.0, 4.0), (0.5, 4.0)])
def test_the_radicand_does_not_depend_on_lengths(a_length, n_length):
    radicands = absolute_radicand(rays(a_length, n_length)).astype(float)
    np.testing.assert_allclose(radicands, np.abs(1 - (RATIOS * SINES) ** 2), rtol=1e-12)


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_the_relative_radicand_agrees_with_the_oracle_near_the_critical_angle(precision):
    critical = regimes.make("critical", 50, precision, seed=1)
    exact = oracle.relative_radicand(critical.a, critical.n, critical.k)
    near = np.abs(exact) < 1e-2
    assert near.sum() > 10
    np.testing.assert_allclose(relative_radicand(critical)[near].astype(float), np.abs(exact[near]), rtol=1e-2)


# Bounds and verdict --------------------------------------------------------------------------------------------------


def test_lengths_off_unit_widen_the_bound():
    """To 3 u if the program may have made the vectors unit; otherwise to the error of their lengths."""
    off_unit = rays(a_length=1 + 2.0**-40, n_length=1 - 2.0**-41)
    exact = certified(off_unit)
    for budget, normalised, u in (("decomposed", True, 3 * U), ("decomposed", False, 2.0**-40), ("promoted", False, U)):
        bounds = RayBounds(off_unit, exact, FORMULAS[budget].budget, U, normalised)
        np.testing.assert_allclose(bounds.u, u, rtol=1e-3)
        assert not np.any(bounds.unit)
    assert np.all(RayBounds(rays(), exact, DECOMPOSED, U).unit)


def test_errors_are_compared_with_the_bound_of_their_ray_and_needed_constants_are_computed():
    assert EXACT.transmitted.tolist() == [True, True, True, False]
    bounds = verdict(EXACT.direction, EXACT.transmitted).bounds
    shares = np.array([0.5, 2.0, 0.5, 2.0])
    judgement = verdict(turned_answers(EXACT, (shares * bounds.chord)[:, None]), EXACT.transmitted)
    np.testing.assert_allclose(judgement.share, shares, rtol=0.1)
    assert judgement.wrong.tolist() == [False, True, False, True]
    assert judgement.compared.all() and not judgement.far.any() and not judgement.blank.any()
    assert judgement.values() == {"error / bound": judgement.share.max(), "TIR misclassified, beyond its bound": 0}
    within = verdict(turned_answers(EXACT, (0.9 * bounds.chord)[:, None]), EXACT.transmitted)
    assert not within.wrong.any() and within.meets(DECOMPOSED).all() and not within.meets(ROUNDING).any()
    # An error L u K plus that of the root needs `linear` = L.
    judgement = verdict(turned_answers(EXACT, (3 * bounds.of_terms + bounds.of_root)[:, None]), EXACT.transmitted)
    np.testing.assert_allclose(judgement.linear_needed, 3 * DECOMPOSED.linear, rtol=0.1)
    # A cosine with the error that an error x of the radicand causes needs `radicand` = x.
    along = np.sqrt(EXACT.cos_t**2 + 13 * U * np.maximum(1, RATIOS)) - EXACT.cos_t
    longer = EXACT.direction - (along * EXACT.transmitted)[:, None] * rays().n
    needed = verdict(longer, EXACT.transmitted, budget=Budget(1e-9, 14, 1)).radicand_needed
    np.testing.assert_allclose(needed[:3], 13, atol=2)
    missed = verdict(EXACT.direction, np.zeros(4, bool))
    needed = np.abs(1 - (RATIOS * SINES) ** 2) / (bounds.u * np.maximum(RATIOS, 1) ** DECOMPOSED.growth)
    np.testing.assert_allclose(missed.radicand_needed[:3], needed[:3], rtol=1e-9)
    assert missed.radicand_needed[3] == 0


def test_misclassified_blank_and_undecided_rays_are_wrong_and_not_compared():
    judgement = verdict(EXACT.direction, EXACT.transmitted ^ np.array([True, False, False, True]))
    for mask in (judgement.misjudged, judgement.far, judgement.wrong):
        assert mask.tolist() == [True, False, False, True]
    assert judgement.compared.tolist() == [False, True, True, False]
    assert judgement.values()["TIR misclassified, beyond its bound"] == 2 and judgement.share[[0, 3]].tolist() == [0, 0]

    first = np.arange(4) == 0
    judgement = verdict(EXACT.direction, EXACT.transmitted, directed=EXACT.transmitted, blank=first)
    assert judgement.compared.tolist() == [False, True, True, False] and not judgement.misjudged.any()
    assert judgement.wrong.tolist() == judgement.blank.tolist() == first.tolist()

    nan = {x: np.where(first, np.nan, getattr(EXACT, x)) for x in ("cos_t", "cos_i")}
    open_ = replace(EXACT, undecided=first, transmitted=EXACT.transmitted & ~first, **nan)
    for transmitted in (True, False):  # for either answer
        judgement = verdict(EXACT.direction, EXACT.transmitted & ~first | (first & transmitted), open_)
        assert judgement.compared.tolist() == [False, True, True, True] and not judgement.misjudged.any()
        assert judgement.far.tolist() == judgement.wrong.tolist() == first.tolist()
        assert judgement.values()["TIR misclassified, beyond its bound"] == 1


def test_an_infinite_error_fails_also_within_an_infinite_bound():
    """At normal incidence with k = 1e300 the bound is infinite, and ∞/∞ = NaN is not at most 1."""
    n = np.array([[0.0, 0, 1]])
    incident = Rays(-n, n, np.array([1e300]))
    exact = certified(incident)
    with np.errstate(over="ignore", invalid="ignore"):
        bounds = RayBounds(incident, exact, DECOMPOSED, U)
        judgement = judge(np.full((1, 3), np.nan), exact.transmitted, bounds)
        assert np.isinf(bounds.chord) and np.isnan(judgement.share)
        assert judgement.compared and judgement.wrong


# One ray on the z axis -----------------------------------------------------------------------------------------------


def judged(a, k, answer, budget, precision=np.float64):
    """The judgement of `answer(exact)`, which returns b, or None for a, and whether the ray is transmitted."""
    incident = Rays(np.array([a], precision), np.array([[0.0, 0.0, 1.0]], precision), np.array([k], precision))
    exact = certified(incident)
    b, transmitted = answer(exact)
    b = incident.a if b is None else np.asarray(b, float).reshape(1, 3)
    u = float(np.finfo(precision).eps) / 2
    return judge(b.astype(np.longdouble), np.array([transmitted]), RayBounds(incident, exact, budget, u))


def on_the_wrong_side(exact):
    """The exact direction mirrored to the wrong side of the surface."""
    return exact.direction * [1, 1, -1], True


def other_decision(exact):
    return None, not exact.transmitted[0]


@pytest.mark.parametrize("transmitted", [True, False])
@pytest.mark.parametrize(("side", "cos_i", "held"), [(4.0, 2 * U, False), (4.0, 32 * U, True), (0.0, 2 * U, True)])
def test_either_side_is_right_near_the_surface_if_the_bound_leaves_the_side_open(side, cos_i, held, transmitted):
    """A ray into the denser medium that leaves on the wrong side, or is classified as tangential."""
    answer = on_the_wrong_side if transmitted else other_decision
    judgement = judged((1, 0, -cos_i), 0.5, answer, Budget(10, 14, 1, side=side))
    assert judgement.wrong.tolist() == [held]
    assert judgement.crossed.tolist() == [transmitted and not held]


@pytest.mark.parametrize("name", [name for name, formula in FORMULAS.items() if formula.budget.side])
def test_the_distance_from_the_surface_within_which_the_side_is_open(name):
    """The error of n·a is 3 u from three products and two sums, 4 u with the rounding of a and n."""
    for cos_i, held in ((3 * U, False), (12 * U, True)):
        assert judged((1, 0, -cos_i), 0.5, on_the_wrong_side, FORMULAS[name].budget).wrong.tolist() == [held]


def test_a_mirrored_ray_near_the_surface_has_not_crossed_it():
    judgement = judged((1, 0, -2 * U), 1.5, lambda exact: ([1.0, 0.0, 3 * U], False), cancelling(1))
    assert judgement.chord[0] > 0 and not judgement.wrong[0] and not judgement.crossed[0]


@pytest.mark.parametrize(("steps", "far"), [(0, False), (1, True), (-1, True)])
def test_at_the_limit_one_ulp_of_k_decides(steps, far):
    """For sin θ = 4/5, k = 5/4 is exactly critical; an ulp of k is 1e16 times the width of the undecided range."""
    judgement = judged((4, 0, -3), 1.25 + steps * 2.0**-52, other_decision, ROUNDING)
    assert (judgement.misjudged.tolist(), judgement.far.tolist()) == ([True], [far])


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize(("apart", "far"), [(0.5, False), (10.0, True)])
def test_at_the_limit_a_radicand_of_a_hundred_u_squared_decides(precision, apart, far):
    """(n·a)² and κ w² differ by a component y of the ray across: w² = 16 (1 + y²), y = `apart` u, and κ = 9/16."""
    u = float(np.finfo(precision).eps) / 2
    judgement = judged((4.0, 4 * apart * u, -3.0), 1.25, other_decision, ROUNDING, precision)
    assert not judgement.bounds.exact.transmitted[0]
    assert (judgement.misjudged.tolist(), judgement.far.tolist()) == ([True], [far])


@pytest.mark.parametrize(("length", "bound"), [(1.0, 0.8724), (1 + 2.0**-52, 1.005), (3.0, 1.005)])
def test_the_rounding_bound_depends_on_the_length_of_the_ray(length, bound):
    judgement = judged((0, 0, -length), 1.5, lambda exact: (None, True), ROUNDING)
    assert judgement.bounds.chord == pytest.approx(bound * U)
