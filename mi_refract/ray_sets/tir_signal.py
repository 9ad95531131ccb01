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

# Results of `detect` beside the signals: no answer need be one; the answers use no known signal, or several.
NONE, UNCLEAR = "none", "unclear"
# The documented formula with the largest error bound.
LOOSEST = max(FORMULAS, key=lambda name: (FORMULAS[name].budget.growth, FORMULAS[name].budget.radicand))
# Beyond this radicand, and its error bound, a ray is totally reflected in any arithmetic.
# This share of those rays must agree on a signal.
CERTAIN, AGREEING = 1e-3, 0.9
ALONG = 8.0  # in u: a cosine below this is that of a vector along the surface


@dataclass(frozen=True)
class SeenAnswers:
    """Answers `b` (N, 3) float64 with roundoff `u`, and the certified answers that they are compared with."""

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
        """(N,) ALONG u, times k where k > 1: the linear error of a formula grows with k."""
        return np.asarray(ALONG * self.u * np.maximum(1.0, self.rays.k.astype(float)))


def unit(v: Array) -> Array:
    """Vectors (N, 3) of length 1, in float64."""
    return np.asarray(v.astype(float) / lengths(v).astype(float)[:, None])


def _is_mirrored(seen: SeenAnswers) -> Flags:
    """(N,) whether b is nearer to the mirror direction than to the transmitted one, or to the surface where nothing is
    transmitted. Where these two directions are one, the exact answer decides, for an answer along them.
    """
    a, n, transmitted = unit(seen.rays.a), unit(seen.rays.n), seen.exact.transmitted
    normal = (a * n).sum(1, keepdims=True) * n
    with np.errstate(all="ignore"):
        onward = np.where(transmitted[:, None], seen.exact.direction, unit(a - normal))
        b = seen.b / np.sqrt((seen.b * seen.b).sum(1, keepdims=True))
        to_mirror, to_onward = (np.sqrt(((b - end) ** 2).sum(1)) for end in (a - 2 * normal, onward))
        alike, along = np.abs(to_mirror - to_onward) <= seen.tolerance, to_mirror <= 2 * seen.tolerance
        return np.asarray(np.where(alike, ~transmitted & along, to_mirror < to_onward))


def _is_tangent(seen: SeenAnswers) -> Flags:
    """(N,) whether b is along the surface, at any length, and the exact direction is not a transmitted one like it."""
    with np.errstate(all="ignore"):
        cosine = np.abs((unit(seen.rays.n) * seen.b).sum(1))
        along = cosine <= seen.tolerance * np.maximum(1, lengths(seen.b).astype(float))
    return np.asarray(along & seen.is_direction & ~(seen.exact.transmitted & (seen.exact.cos_t <= 2 * seen.tolerance)))


DETECTORS: dict[str, Callable[[SeenAnswers], Flags]] = {
    "zero": lambda seen: np.asarray(~seen.b.any(axis=1)),
    "nan": lambda seen: np.asarray(np.isnan(seen.b).any(axis=1)),
    "reflected": _is_mirrored,
    "tangent": _is_tangent,
}


def detect(pieces: Iterable[SeenAnswers]) -> str:
    """The signal that the answers to totally reflected rays agree on, or NONE, or UNCLEAR. `pieces`: of one set.

    Rays far beyond the critical angle decide alone. Where there is none, rays near it on either side do, and a program
    may transmit any of them, nearly along the surface: only the other signals count, unless nothing else is there.
    """
    counts = np.zeros((2, 1 + len(DETECTORS)), int)  # rays, and those that use each signal: of all, of those far beyond
    for seen in pieces:
        bound = FORMULAS[LOOSEST].budget.radicand_error_bound(seen.u, seen.rays.k.astype(float))
        radicand, reflects = absolute_radicand(seen.rays), ~seen.exact.transmitted
        far = reflects & (radicand > np.maximum(CERTAIN, bound))
        signals = np.array([np.ones(len(far), bool), *(detector(seen) for detector in DETECTORS.values())])
        counts += [(mask & (seen.exact.cos_i > 0) & signals).sum(1) for mask in (reflects | (radicand <= bound), far)]
    (_, *near), (rays, *votes) = counts.tolist()
    if not rays:
        votes = near[:-1] if any(near[:-1]) else near
        rays = sum(votes)
    if not rays:
        return NONE
    return list(DETECTORS)[int(np.argmax(votes))] if max(votes) >= AGREEING * rays else UNCLEAR


def reflected(seen: SeenAnswers, transmitted: Flags | None, tir: str, decided: Flags) -> Flags:
    """(N,) the rays that the answers call totally reflected. `decided`: (N,) where the error bound leaves no doubt."""
    if transmitted is not None and tir == FLAG:
        return ~transmitted
    if tir == NONE:  # a program may still take a ray in doubt for reflected, and answer no direction
        return ~seen.is_direction & ~decided
    return DETECTORS[tir](seen) if tir in DETECTORS else np.zeros(len(seen.b), bool)
