"""How answers tell total internal reflection: by a flag, zeros, NaN, the mirror direction or one along the surface."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mi_refract import oracle
from mi_refract.accuracy import absolute_radicand, lengths
from mi_refract.regimes import Rays

AUTO, FLAG = "auto", "flag"
# What `recognise` answers beside the words of TIR: no ray has it, and it is told in no known way.
NONE, UNCLEAR = "none", "unclear"
# Rays whose radicand is beyond this are totally reflected in anyone's arithmetic; so many of them must say so alike.
CERTAIN, ALIKE = 1e-3, 0.9
# In u: below this a cosine is that of a ray along the surface.
ALONG = 8.0


@dataclass(frozen=True)
class Seen:
    """Answers `b` (N, 3) float64, with what tells a reflected ray from a transmitted one; `u`: their roundoff."""

    b: np.ndarray
    rays: Rays
    exact: oracle.Certified
    u: float

    @functools.cached_property
    def directed(self) -> np.ndarray:
        """(N,) whether b is a direction: finite and not zero."""
        return np.isfinite(self.b).all(axis=1) & self.b.any(axis=1)

    @functools.cached_property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """The unit mirror direction, and the transmitted one: along the surface where there is none."""
        a, n = (v.astype(float) / lengths(v).astype(float)[:, None] for v in (self.rays.a, self.rays.n))
        normal = (a * n).sum(1, keepdims=True) * n
        tangent = a - normal
        with np.errstate(invalid="ignore"):
            tangent /= np.sqrt((tangent * tangent).sum(1, keepdims=True))
        return a - 2 * normal, np.where(self.exact.transmitted[:, None], self.exact.direction, tangent)

    @property
    def open(self) -> np.ndarray:
        """ALONG u, as much more as a formula's linear terms grow with k."""
        return ALONG * self.u * np.maximum(1.0, self.rays.k.astype(float))


def _mirrored(seen: Seen) -> np.ndarray:
    """Nearer to the mirror direction; the benefit of the doubt where the two ends are one."""
    with np.errstate(all="ignore"):
        unit = seen.b / np.sqrt((seen.b * seen.b).sum(1, keepdims=True))
        to_mirror, to_onward = (np.sqrt(((unit - end) ** 2).sum(1)) for end in seen.ends)
        nearer = to_mirror < to_onward
        return np.where(np.abs(to_mirror - to_onward) <= seen.open, ~seen.exact.transmitted, nearer)


def _along(seen: Seen) -> np.ndarray:
    """Along the surface, of whatever length; where the exact answer is so too, the benefit of the doubt."""
    n = seen.rays.n.astype(float) / lengths(seen.rays.n).astype(float)[:, None]
    with np.errstate(all="ignore"):
        along = np.abs((n * seen.b).sum(1)) <= seen.open * np.maximum(1, lengths(seen.b).astype(float))
    return along & seen.directed & ~(seen.exact.transmitted & (seen.exact.cos_t <= 2 * seen.open))


TELLERS = {
    "zero": lambda seen: ~seen.b.any(axis=1),
    "nan": lambda seen: np.isnan(seen.b).any(axis=1),
    "reflected": _mirrored,
    "tangent": _along,
}
TIR = (*TELLERS, FLAG)


def recognise(seen: Seen, flag: np.ndarray | None) -> str:
    """One of TIR: how most of the rays beyond doubt say it, FLAG where there is one; or NONE, or UNCLEAR."""
    if flag is not None:
        return FLAG
    total = ~seen.exact.transmitted & (seen.exact.cos_i > 0)
    if not total.any():
        return NONE
    certain = total & (absolute_radicand(seen.rays) > CERTAIN)
    among = certain if certain.any() else total
    shares = {name: float(teller(seen)[among].mean()) for name, teller in TELLERS.items()}
    best = max(shares, key=lambda name: shares[name])
    return best if shares[best] >= ALIKE else UNCLEAR


def reflected(seen: Seen, flag: np.ndarray | None, tir: str, decided: np.ndarray) -> np.ndarray:
    """(N,) the rays that are said to be totally reflected. `decided`: where there is no doubt whether they are."""
    if flag is not None and tir == FLAG:
        return ~flag
    if tir == NONE:  # but those who think of the rays in doubt that they have it must say so somehow
        return ~seen.directed & ~decided
    return TELLERS[tir](seen) if tir in TELLERS else np.zeros(len(seen.b), bool)


def has_direction(tir: str) -> bool:
    """Whether a totally reflected ray must come with a direction, told so."""
    return tir in ("reflected", "tangent")
