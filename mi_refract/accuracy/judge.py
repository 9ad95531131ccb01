"""Judge directions: compare every ray with its certified answer and with the error bound of a formula for that ray."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from mi_refract import oracle, regimes
from mi_refract.formulas import NEGLIGIBLE, UNIT, Budget, radicand_for
from mi_refract.numerics import ArrayType, Mask, Number, Vector3, from_numpy
from mi_refract.regimes import Array, Rays

Flags = NDArray[np.bool_]

# In u: the error of the lengths of `a` and `n`, that of the components included, after they were made unit in their own
# precision.
NORMALISING = 3.0
# The largest `Judgement.values` within the bounds.
BUDGETS = {"error / bound": 1.0, "TIR misclassified, beyond its bound": 0.0}


# Errors ---------------------------------------------------------------------------------------------------------------


class DirectionErrors(NamedTuple):
    """Errors of directions b, (N,) float64 each; infinite if b is NaN."""

    chord: Array  # |b/|a| − exact|
    angle: Array  # between b and the exact direction, radians
    drift: Array  # of the length: | |b|/|a| − 1 |


def errors(b: Array, rays: Rays, exact: oracle.Certified) -> DirectionErrors:
    """Errors of `b` (N, 3), which should have the length of `a`, relative to |a|."""
    unit, low = b / lengths(rays.a)[:, None], exact.direction_low.astype(np.longdouble)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # b may have any values
        difference = (unit - exact.direction) - low
        chord, norm = lengths(difference), lengths(unit)
        across = lengths(np.cross(unit, difference)) / norm
        angle = np.arctan2(across, norm - (unit * difference).sum(1) / norm)
        return DirectionErrors(*(np.nan_to_num(x.astype(float), nan=np.inf) for x in (chord, angle, np.abs(norm - 1))))


def errors_of_normalised(b: Array, rays: Rays, exact: oracle.Certified) -> DirectionErrors:
    """Errors of `b` (N, 3) that may also have been made unit: `drift` is | |b| − 1 | if that is less.

    Chord and angle are those of b scaled to the length of `a`. For NaN, `drift` is NaN.
    """
    with np.errstate(all="ignore"):  # b may have any values
        length, length_a = lengths(b), lengths(rays.a)
        drift = np.fmin(np.abs(length - 1), np.abs(length / length_a - 1)).astype(float)
        return errors(b * (length_a / length)[:, None], rays, exact)._replace(drift=drift)


def absolute_radicand(rays: Rays) -> Array:
    """(N,) |1 − k² sin²θ_i| in extended precision: a measure of the distance from the critical angle."""
    a, n, k = (x.astype(np.longdouble) for x in (rays.a, rays.n, rays.k))
    return np.abs(1 - (k * lengths(np.cross(n, a)) / (lengths(a) * lengths(n))) ** 2)


def relative_radicand(rays: Rays) -> Array:
    """(N,) |(n·a)² − κ|n×a|²| over the mean of its two terms, with an error of 2⁻¹⁴⁰; NaN if both are 0.

    Near the critical angle, where the terms are nearly equal, it is the modulus of `oracle.relative_radicand`.
    """
    _, d, terms = regimes.radicand(*(x.T.astype(np.float64) for x in (rays.a, rays.n, rays.k)))
    with np.errstate(invalid="ignore"):
        ratio: Array = np.abs(d[0]) / (terms / 2)
    return ratio


def lengths(v: Array) -> Array:
    """(N,) the lengths of vectors (N, 3), in extended precision."""
    length: Array = np.sqrt((v.astype(np.longdouble) ** 2).sum(1))
    return length


# Bounds and verdict ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RayBounds:
    """The errors that `budget` allows for each ray. Arrays are (N,).

    `roundoff`: that of the answers' precision. `normalised`: whether `a`, `n` and `b` may have been made unit.
    """

    rays: Rays
    exact: oracle.Certified
    budget: Budget
    roundoff: float
    normalised: bool = False

    @functools.cached_property
    def u(self) -> Any:
        """The roundoff for which the bound is computed, a number or (N,).

        The error of a formula for unit vectors also depends on how far the lengths of `a` and `n` are from 1; this
        counts as at most NORMALISING roundoffs if they may have been made unit.
        """
        if self.budget.at_the_limit:
            return self.roundoff
        length_error = np.maximum(*(np.abs(lengths(v) - 1) for v in (self.rays.a, self.rays.n)))
        largest = NORMALISING * self.roundoff if self.normalised else np.inf
        return np.clip(length_error, self.roundoff, largest).astype(float)

    @functools.cached_property
    def k(self) -> Array:
        """n_from / n_to in float64."""
        return self.rays.k.astype(float)

    @functools.cached_property
    def unit(self) -> Any:
        """Whether |a| is 1, up to the rounding of its components."""
        return np.abs(lengths(self.rays.a) - 1) <= UNIT * self.roundoff

    @property
    def side_open(self) -> Flags:
        """Whether the ray is so near the surface that the formula may be wrong about its side."""
        return np.asarray(self.budget.side_open(self.u, self.exact.cos_i))

    @property
    def of_terms(self) -> Any:
        """The part of the bound that is linear in u."""
        return self.budget.of_terms(self.u, self.k, self.exact.transmitted, self.unit)

    @property
    def of_root(self) -> Any:
        """The part of the bound that comes from the radicand's error under the root."""
        return self.budget.of_root(self.u, self.k, self.exact.cos_t, self.exact.transmitted)

    @functools.cached_property
    def chord(self) -> Array:
        """Bound of the chord error |b/|a| − exact|."""
        exact = self.exact
        return np.asarray(self.budget.chord(self.u, self.k, exact.cos_t, exact.transmitted, self.unit, exact.cos_i))

    @functools.cached_property
    def length(self) -> Array:
        """Bound of the relative error of the length.

        The square of the component across the surface has the radicand's error, x; all other errors are linear in u.
        """
        x = np.where(self.exact.transmitted, self.budget.radicand_error_bound(self.u, self.k), 0.0)
        shorter = np.where(x < 1, x / (1 + np.sqrt(np.maximum(1 - x, 0))), 1.0)
        return np.asarray(self.of_terms + np.maximum(shorter, np.sqrt(1 + x) - 1))

    @functools.cached_property
    def decided(self) -> Flags:
        """Whether the decision about total internal reflection must be right: the radicand exceeds its error bound."""
        return self.decided_of(np.ones(len(self.rays), bool))

    def decided_of(self, mask: Flags) -> Flags:
        """`decided` for the rays in the mask, False elsewhere; this saves time, as the radicand is slow to compute."""
        rays, result = self.rays[mask], mask.copy()
        if self.budget.at_the_limit:
            # For a tangential ray at k = 1 both terms are 0 and the ratio is NaN: then the ray counts as decided.
            result[mask] = ~(relative_radicand(rays) <= NEGLIGIBLE * self.roundoff**2)
            return result
        result[mask] = absolute_radicand(rays) > self.budget.radicand_error_bound(self.u[mask], self.k[mask])
        decided: Flags = result & ~self.side_open
        return decided


@dataclass(frozen=True)
class Judgement:
    """The verdict on each ray. Arrays are (N,).

    Errors count if directions are `compared`: total internal reflection was decided right, and b is a direction.
    """

    bounds: RayBounds
    chord: Array  # |b/|a| − exact|; infinite if b is NaN
    angle: Array  # radians
    drift: Array  # relative error of the length of b
    error: Array  # the error that `bounds.chord` bounds: the chord, or the angle of normalised answers
    compared: Flags
    misjudged: Flags  # a totally reflected ray was classified as transmitted, or the reverse
    blank: Flags  # neither a direction nor a signal of total internal reflection

    @functools.cached_property
    @np.errstate(over="ignore", invalid="ignore")
    def share(self) -> Array:
        """Error over bound of the compared rays, 0 elsewhere; for normalised answers that of the length if larger."""
        share = self.error / self.bounds.chord
        if self.bounds.normalised:
            share = np.maximum(share, self.drift / self.bounds.length)
        return np.where(self.compared, share, 0.0)

    @functools.cached_property
    def far(self) -> Flags:
        """Whether a ray is misclassified though the radicand exceeds its error bound, or undecided by the oracle."""
        far: Flags = self.bounds.decided_of(self.misjudged) | self.bounds.exact.undecided
        return far

    @functools.cached_property
    def wrong(self) -> Flags:
        """Whether a ray breaks its bound."""
        wrong: Flags = ~(self.share <= 1) | self.far | self.blank
        return wrong

    def meets(self, budget: Budget) -> Flags:
        """Whether an answer keeps the bound of another budget."""
        return ~replace(self, bounds=replace(self.bounds, budget=budget)).wrong

    @property
    def crossed(self) -> Flags:
        """Whether a direction is on the wrong side of the surface where the bound allows it."""
        exact = self.bounds.exact
        return np.asarray(self.bounds.side_open & self.compared & exact.transmitted & (self.error > exact.cos_t))

    @property
    @np.errstate(over="ignore", invalid="ignore")
    def linear_needed(self) -> Array:
        """The value of `budget.linear` that each ray needs, with the rest of the budget unchanged."""
        needed = self.bounds.budget.linear * (self.error - self.bounds.of_root) / self.bounds.of_terms
        return np.where(self.compared & ~self.bounds.side_open, needed, 0.0)

    @property
    @np.errstate(over="ignore", invalid="ignore")
    def radicand_needed(self) -> Array:
        """The value of `budget.radicand` that each ray needs, with the rest of the budget unchanged."""
        bounds, exact = self.bounds, self.bounds.exact
        needed = radicand_for(np.maximum(self.error - bounds.of_terms, 0), exact.cos_t)
        needed = np.where(exact.transmitted, needed, 0.0)
        needed = np.where(self.misjudged, absolute_radicand(bounds.rays).astype(float), needed)
        needed = needed / (bounds.u * np.maximum(1.0, bounds.k) ** bounds.budget.growth)
        return np.where(bounds.side_open, 0.0, needed)

    def values(self) -> dict[str, float]:
        """The worst values over all rays; they are within the bounds if none exceeds that of BUDGETS."""
        return {"error / bound": float(self.share.max()), "TIR misclassified, beyond its bound": float(self.far.sum())}


def judge(
    b: Array, transmitted: Flags, bounds: RayBounds, directed: Flags | bool = True, blank: Flags | bool = False
) -> Judgement:
    """The verdict on answers: `b` (N, 3) in any precision, and whether each classifies its ray as transmitted (N,).

    `directed`: whether b is a direction to compare. `blank`: whether b is neither a direction nor a signal of total
    internal reflection. For `bounds.normalised` the errors are those of `errors_of_normalised`.
    """
    exact = bounds.exact
    known = ~exact.undecided & ~np.broadcast_to(blank, len(exact))
    misjudged = (transmitted != exact.transmitted) & known
    measure = errors_of_normalised if bounds.normalised else errors
    measured = measure(b, bounds.rays, exact)
    return Judgement(
        bounds,
        *measured,
        error=measured.angle if bounds.normalised else measured.chord,
        compared=~misjudged & known & directed,
        misjudged=misjudged,
        blank=np.broadcast_to(blank, len(exact)),
    )


# Formulas -------------------------------------------------------------------------------------------------------------

# A function with the signature of the entries of FORMULAS: `subject(a, n, k) -> (b, transmitted)`.
Subject: TypeAlias = Callable[[Vector3, Vector3, Number], tuple[Vector3, Mask]]


def evaluate(subject: Subject, rays: Rays, vector: ArrayType) -> tuple[Array, Flags]:
    """(b, transmitted) for all rays, (N, 3) in extended precision and (N,).

    `vector`: the 3-vector type of Dr.Jit to compute with. With scalar types the subject is called for each ray.
    """
    if dr.is_jit_v(vector):
        b, transmitted = subject(*arrays(rays, vector))
        dr.eval(b, transmitted)  # in one kernel
        parts = np.broadcast_arrays(*(np.array(x) for x in b))
        return np.stack(parts, 1).astype(np.longdouble), np.array(transmitted)
    pairs = [subject(vector(a), vector(n), float(k)) for a, n, k in zip(rays.a, rays.n, rays.k, strict=True)]
    return np.array([list(b) for b, _ in pairs], np.longdouble), np.array([t for _, t in pairs], bool)


def arrays(rays: Rays, vector: ArrayType) -> tuple[Vector3, Vector3, Number]:
    """(a, n, k) of all rays, as vectors of a vectorised type and their numbers."""
    return from_numpy(vector, rays.a), from_numpy(vector, rays.n), from_numpy(dr.value_t(vector), rays.k)


def judge_formula(
    subject: Subject, rays: Rays, exact: oracle.Certified, vector: ArrayType, budget: Budget
) -> Judgement:
    """`judge` the results of `subject` for all rays, computed with arrays of the 3-vector type `vector`."""
    u = float(np.finfo(rays.a.dtype).eps) / 2
    return judge(*evaluate(subject, rays, vector), RayBounds(rays, exact, budget, u))
