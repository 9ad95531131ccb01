"""Signals of total internal reflection: a flag, zeros, NaN, the mirror direction, or a vector along the surface."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mi_refract import oracle
from mi_refract.accuracy import absolute_radicand, lengths
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import Rays

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

    b: np.ndarray
    rays: Rays
    exact: oracle.Certified
    u: float

    @functools.cached_property
    def is_direction(self) -> np.ndarray:
        """(N,) whether b is finite and not zero."""
        return np.isfinite(self.b).all(axis=1) & self.b.any(axis=1)

    @functools.cached_property
    def mirror(self) -> np.ndarray:
        """(N, 3): the unit mirror direction."""
        a, normal = self._parts
        return a - 2 * normal

    @functools.cached_property
    def onward(self) -> np.ndarray:
        """(N, 3): the transmitted direction; along the surface where nothing is transmitted."""
        a, normal = self._parts
        tangent = a - normal
        with np.errstate(invalid="ignore"):
            tangent /= np.sqrt((tangent * tangent).sum(1, keepdims=True))
        return np.where(self.exact.transmitted[:, None], self.exact.direction, tangent)

    @functools.cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit a, and its part along n; each (N, 3)."""
        a, n = (v.astype(float) / lengths(v).astype(float)[:, None] for v in (self.rays.a, self.rays.n))
        return a, (a * n).sum(1, keepdims=True) * n

    @property
    def tolerance(self) -> np.ndarray:
        """(N,) ALONG u, times k where k > 1: the linear error of a formula grows with k."""
        return ALONG * self.u * np.maximum(1.0, self.rays.k.astype(float))


def _mirrored(seen: SeenAnswers) -> np.ndarray:
    """(N,) whether b is nearer to the mirror direction; where the two directions are one, the exact answer decides."""
    with np.errstate(all="ignore"):
        unit = seen.b / np.sqrt((seen.b * seen.b).sum(1, keepdims=True))
        to_mirror, to_onward = (np.sqrt(((unit - end) ** 2).sum(1)) for end in (seen.mirror, seen.onward))
        nearer = to_mirror < to_onward
        return np.where(np.abs(to_mirror - to_onward) <= seen.tolerance, ~seen.exact.transmitted, nearer)


def _along(seen: SeenAnswers) -> np.ndarray:
    """(N,) whether b is along the surface, at any length; not where the exact transmitted direction is so, too."""
    n = seen.rays.n.astype(float) / lengths(seen.rays.n).astype(float)[:, None]
    with np.errstate(all="ignore"):
        along = np.abs((n * seen.b).sum(1)) <= seen.tolerance * np.maximum(1, lengths(seen.b).astype(float))
    return along & seen.is_direction & ~(seen.exact.transmitted & (seen.exact.cos_t <= 2 * seen.tolerance))


DETECTORS = {
    "zero": lambda seen: ~seen.b.any(axis=1),
    "nan": lambda seen: np.isnan(seen.b).any(axis=1),
    "reflected": _mirrored,
    "tangent": _along,
}
TIR = (*DETECTORS, FLAG)


@dataclass(frozen=True)
class Signals:
    """How many rays are totally reflected, and how many of these give each signal; the same of those certainly so."""

    total: int
    certain: int
    of_total: dict[str, int]
    of_certain: dict[str, int]

    @property
    def signal(self) -> str:
        """The signal that certainly reflected rays agree on, or NONE, or UNCLEAR."""
        if not self.total:
            return NONE
        among, found = (self.certain, self.of_certain) if self.certain else (self.total, self.of_total)
        shares = {name: count / among for name, count in found.items()}
        best = max(shares, key=lambda name: shares[name])
        return best if shares[best] >= AGREEING else UNCLEAR


def count(seen: SeenAnswers) -> Signals:
    """The signals of some answers."""
    total = ~seen.exact.transmitted & (seen.exact.cos_i > 0)
    bound = FORMULAS[LOOSEST].budget.radicand_error_bound(seen.u, seen.rays.k.astype(float))
    certain = total & (absolute_radicand(seen.rays) > np.maximum(CERTAIN, bound))
    given = {name: detector(seen) for name, detector in DETECTORS.items()} if total.any() else {}
    of_total, of_certain = ({name: int(each[of].sum()) for name, each in given.items()} for of in (total, certain))
    return Signals(int(total.sum()), int(certain.sum()), of_total, of_certain)


def joined(parts: Sequence[Signals]) -> Signals:
    """Those of all parts."""
    sums = [
        {name: sum(getattr(part, of).get(name, 0) for part in parts) for name in DETECTORS}
        for of in ("of_total", "of_certain")
    ]
    return Signals(sum(part.total for part in parts), sum(part.certain for part in parts), *sums)


def reflected(seen: SeenAnswers, flag: np.ndarray | None, tir: str, decided: np.ndarray) -> np.ndarray:
    """(N,) the rays that the answers call totally reflected. `decided`: (N,) where the error bound leaves no doubt."""
    if flag is not None and tir == FLAG:
        return ~flag
    if tir == NONE:  # a program may still take a ray in doubt for reflected, and answer no direction
        return ~seen.is_direction & ~decided
    return DETECTORS[tir](seen) if tir in DETECTORS else np.zeros(len(seen.b), bool)


def has_direction(tir: str) -> bool:
    """Whether the signal is itself a direction."""
    return tir in ("reflected", "tangent")
