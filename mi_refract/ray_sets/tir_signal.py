"""Signals of total internal reflection: a flag, zeros, NaN, the mirror direction, or a vector along the surface."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_refract import oracle
from mi_refract.accuracy import absolute_radicand, lengths
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import Array, Rays

Flags = NDArray[np.bool_]

AUTO, FLAG = "auto", "flag"
# Results of `detect` beside those of TIR: no ray is totally reflected; the rays signal it in no known way.
NONE, UNCLEAR = "none", "unclear"
# The documented formula with the largest error bound.
LOOSEST = max(FORMULAS, key=lambda name: (FORMULAS[name].budget.growth, FORMULAS[name].budget.radicand))
# Beyond this radicand, and its error bound, a ray is totally reflected in any arithmetic.
# This share of those rays must agree on a signal.
CERTAIN, AGREEING = 1e-3, 0.9
# In u: a cosine below this is that of a ray along the surface.
ALONG = 8.0


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

    @functools.cached_property
    def mirror(self) -> Array:
        """(N, 3): the unit mirror direction."""
        a, normal = self._parts
        return a - 2 * normal

    @functools.cached_property
    def onward(self) -> Array:
        """(N, 3): the transmitted direction; along the surface where nothing is transmitted."""
        a, normal = self._parts
        tangent = a - normal
        with np.errstate(invalid="ignore"):
            tangent /= np.sqrt((tangent * tangent).sum(1, keepdims=True))
        return np.where(self.exact.transmitted[:, None], self.exact.direction, tangent)

    @functools.cached_property
    def _parts(self) -> tuple[Array, Array]:
        """Unit a, and its part along n; each (N, 3)."""
        a, n = (v.astype(float) / lengths(v).astype(float)[:, None] for v in (self.rays.a, self.rays.n))
        return a, (a * n).sum(1, keepdims=True) * n

    @property
    def tolerance(self) -> Array:
        """(N,) ALONG u, times k where k > 1: the linear error of a formula grows with k."""
        return np.asarray(ALONG * self.u * np.maximum(1.0, self.rays.k.astype(float)))


def _mirrored(seen: SeenAnswers) -> Flags:
    """(N,) whether b is nearer to the mirror direction; where the two directions are one, the exact answer decides."""
    with np.errstate(all="ignore"):
        unit = seen.b / np.sqrt((seen.b * seen.b).sum(1, keepdims=True))
        to_mirror, to_onward = (np.sqrt(((unit - end) ** 2).sum(1)) for end in (seen.mirror, seen.onward))
        nearer = to_mirror < to_onward
        return np.where(np.abs(to_mirror - to_onward) <= seen.tolerance, ~seen.exact.transmitted, nearer)


def _along(seen: SeenAnswers) -> Flags:
    """(N,) whether b is along the surface, at any length; not where the exact transmitted direction is so, too."""
    n = seen.rays.n.astype(float) / lengths(seen.rays.n).astype(float)[:, None]
    with np.errstate(all="ignore"):
        along = np.abs((n * seen.b).sum(1)) <= seen.tolerance * np.maximum(1, lengths(seen.b).astype(float))
    return np.asarray(along & seen.is_direction & ~(seen.exact.transmitted & (seen.exact.cos_t <= 2 * seen.tolerance)))


DETECTORS: dict[str, Callable[[SeenAnswers], Flags]] = {
    "zero": lambda seen: np.asarray(~seen.b.any(axis=1)),
    "nan": lambda seen: np.asarray(np.isnan(seen.b).any(axis=1)),
    "reflected": _mirrored,
    "tangent": _along,
}
TIR = (*DETECTORS, FLAG)
_ALL = "all"  # beside the names of DETECTORS


def detect(pieces: Iterable[SeenAnswers]) -> str:
    """The signal that totally reflected rays agree on, or NONE, or UNCLEAR; of all rays, which come in pieces.

    Where some rays are far beyond the critical angle, they decide alone.
    """
    total, certain = Counter[str](), Counter[str]()
    for seen in pieces:
        reflects = ~seen.exact.transmitted & (seen.exact.cos_i > 0)
        if reflects.any():
            bound = FORMULAS[LOOSEST].budget.radicand_error_bound(seen.u, seen.rays.k.astype(float))
            far = reflects & (absolute_radicand(seen.rays) > np.maximum(CERTAIN, bound))
            given = {name: detector(seen) for name, detector in DETECTORS.items()} | {_ALL: reflects}
            total.update({name: int(mask[reflects].sum()) for name, mask in given.items()})
            certain.update({name: int(mask[far].sum()) for name, mask in given.items()})
    votes = certain if certain[_ALL] else total
    if not votes[_ALL]:
        return NONE
    best = max(DETECTORS, key=lambda name: votes[name])
    return best if votes[best] >= AGREEING * votes[_ALL] else UNCLEAR


def reflected(seen: SeenAnswers, flag: Flags | None, tir: str, decided: Flags) -> Flags:
    """(N,) the rays that the answers call totally reflected. `decided`: (N,) where the error bound leaves no doubt."""
    if flag is not None and tir == FLAG:
        return ~flag
    if tir == NONE:  # a program may still take a ray in doubt for reflected, and answer no direction
        return ~seen.is_direction & ~decided
    return DETECTORS[tir](seen) if tir in DETECTORS else np.zeros(len(seen.b), bool)


def has_direction(tir: str) -> bool:
    """Whether the signal is itself a direction."""
    return tir in ("reflected", "tangent")
