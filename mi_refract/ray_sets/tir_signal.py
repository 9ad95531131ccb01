"""Signals of total internal reflection: a flag, zeros, NaN, the mirror direction, or a vector along the surface."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_refract import oracle
from mi_refract.accuracy import absolute_radicand, lengths
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import Array, Rays

from .header import FLAG

Flags = NDArray[np.bool_]

# Further results of `detect`: no ray needs a signal; the answers use no known signal, or several.
NONE, UNCLEAR = "none", "unclear"
# The documented formula with the largest error bound.
LOOSEST = max(FORMULAS, key=lambda name: (FORMULAS[name].budget.growth, FORMULAS[name].budget.radicand))
# If the radicand is beyond this and its error bound, a ray is totally reflected in any arithmetic.
CERTAIN = 1e-3
AGREEING = 0.9  # the share of those rays that must agree on a signal
ALONG = 8.0  # in u: a vector with a cosine below this counts as along the surface


@dataclass(frozen=True)
class ComparedAnswers:
    """Answers `b` (N, 3) float64 with roundoff `u`, and the certified answers to compare them with."""

    b: Array
    rays: Rays
    exact: oracle.Certified
    u: float

    @functools.cached_property
    def is_direction(self) -> Flags:
        """(N,) whether b is finite and not zero."""
        return np.asarray(np.isfinite(self.b).all(axis=1) & self.b.any(axis=1))

    @property
    def tolerance(self) -> Array:
        """(N,) ALONG u, times k for k > 1: the linear error of a formula grows with k."""
        return np.asarray(ALONG * self.u * np.maximum(1.0, self.rays.k.astype(float)))


def unit(v: Array) -> Array:
    """Vectors (N, 3) of length 1, in float64."""
    return np.asarray(v.astype(float) / lengths(v).astype(float)[:, None])


def _is_mirrored(answers: ComparedAnswers) -> Flags:
    """(N,) whether b is nearer to the mirror direction than to the transmitted one, or than to the surface if nothing
    is transmitted. If the two directions coincide, the exact answer decides for an answer along them.
    """
    a, n, transmitted = unit(answers.rays.a), unit(answers.rays.n), answers.exact.transmitted
    normal = (a * n).sum(1, keepdims=True) * n
    with np.errstate(all="ignore"):
        onward = np.where(transmitted[:, None], answers.exact.direction, unit(a - normal))
        b = answers.b / np.sqrt((answers.b * answers.b).sum(1, keepdims=True))
        to_mirror, to_onward = (np.sqrt(((b - end) ** 2).sum(1)) for end in (a - 2 * normal, onward))
        coincide, along = np.abs(to_mirror - to_onward) <= answers.tolerance, to_mirror <= 2 * answers.tolerance
        return np.asarray(np.where(coincide, ~transmitted & along, to_mirror < to_onward))


def _is_tangent(answers: ComparedAnswers) -> Flags:
    """(N,) whether b, of any length, is along the surface, and the exact direction is not transmitted along it too."""
    with np.errstate(all="ignore"):
        cosine = np.abs((unit(answers.rays.n) * answers.b).sum(1))
        along = cosine <= answers.tolerance * np.maximum(1, lengths(answers.b).astype(float))
    transmitted_along = answers.exact.transmitted & (answers.exact.cos_t <= 2 * answers.tolerance)
    return np.asarray(along & answers.is_direction & ~transmitted_along)


DETECTORS: dict[str, Callable[[ComparedAnswers], Flags]] = {
    "zero": lambda answers: np.asarray(~answers.b.any(axis=1)),
    "nan": lambda answers: np.asarray(np.isnan(answers.b).any(axis=1)),
    "reflected": _is_mirrored,
    "tangent": _is_tangent,
}


def detect(pieces: Iterable[ComparedAnswers]) -> str:
    """The signal that the answers to totally reflected rays agree on, or NONE, or UNCLEAR. `pieces`: of one set.

    If there are rays far beyond the critical angle, only they decide. Otherwise rays near it on either side decide. A
    program may transmit these nearly along the surface, so "tangent" then counts only if no other signal occurs.
    """
    # In the first column the rays, in the others those that use each signal; for all rays, and for those far beyond.
    counts = np.zeros((2, 1 + len(DETECTORS)), int)
    for answers in pieces:
        bound = FORMULAS[LOOSEST].budget.radicand_error_bound(answers.u, answers.rays.k.astype(float))
        radicand, reflects = absolute_radicand(answers.rays), ~answers.exact.transmitted
        far = reflects & (radicand > np.maximum(CERTAIN, bound))
        signals = np.array([np.ones(len(far), bool), *(detector(answers) for detector in DETECTORS.values())])
        near_and_far = reflects | (radicand <= bound), far
        counts += [(mask & (answers.exact.cos_i > 0) & signals).sum(1) for mask in near_and_far]
    (_, *near), (rays, *votes) = counts.tolist()
    if not rays:
        votes = near[:-1] if any(near[:-1]) else near
        rays = sum(votes)
    if not rays:
        return NONE
    return list(DETECTORS)[int(np.argmax(votes))] if max(votes) >= AGREEING * rays else UNCLEAR


def reflected(answers: ComparedAnswers, transmitted: Flags | None, tir: str, decided: Flags) -> Flags:
    """(N,) whether the answers classify each ray as totally reflected. `decided`: (N,) rays that the bound decides."""
    if transmitted is not None and tir == FLAG:
        return ~transmitted
    if tir == NONE:  # a program may still classify an undecided ray as reflected, and answer no direction
        return ~answers.is_direction & ~decided
    return DETECTORS[tir](answers) if tir in DETECTORS else np.zeros(len(answers.b), bool)
