"""One set of answers, ray by ray: how total internal reflection is told, what is too far off, what is no direction."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mi_refract import oracle
from mi_refract.accuracy.direction_errors import absolute_radicand, errors, lengths, relative_radicand
from mi_refract.formulas import NEGLIGIBLE, ROUNDING, Budget
from mi_refract.regimes import Rays

from .ray_set import PRECISIONS

AUTO, FLAG = "auto", "flag"
# Words of `Judged.tir` beside those of TIR: no ray has it, and it is told in no known way.
NONE, UNCLEAR = "none", "unclear"
# In u: what making `a` and `n` unit in the set's precision leaves of errors, with those of the components.
NORMALISING = 3.0
# Rays whose radicand is beyond this are totally reflected in anyone's arithmetic; so many of them must say so alike.
CERTAIN, ALIKE = 1e-3, 0.9
# In u: below this a cosine is that of a ray along the surface.
ALONG = 8.0


@dataclass(frozen=True)
class Judged:
    """Ray by ray. `compared`: decided rightly, and the answer is a direction."""

    rays: Rays
    exact: oracle.Certified
    raw: np.ndarray  # (N, 3) as they came
    b: np.ndarray  # (N, 3) in the set's precision
    roundoff: float
    budget: Budget
    tir: str
    blank: np.ndarray  # NaN, infinite or zero where that means nothing
    compared: np.ndarray
    misjudged: np.ndarray
    decided: np.ndarray  # where the budget leaves no doubt about total internal reflection
    angle: np.ndarray
    norm: np.ndarray
    bound: np.ndarray

    @functools.cached_property
    def share(self) -> np.ndarray:
        """Error over bound of the rays compared, 0 elsewhere."""
        return np.where(self.compared, np.maximum(self.angle, self.norm) / self.bound, 0.0)

    @functools.cached_property
    def exact_to_rounding(self) -> np.ndarray:
        """Where rounding the exact answer could have given this one."""
        bound = _bound(self.rays, self.exact, self.roundoff, ROUNDING)
        decided = _decided(self.rays, self.exact, self.roundoff, ROUNDING)
        near = ~self.compared | (np.maximum(self.angle, self.norm) <= bound)
        return near & ~self.blank & ~(self.misjudged & decided)

    @property
    def far(self) -> np.ndarray:
        return self.misjudged & self.decided

    @functools.cached_property
    def wrong(self) -> np.ndarray:
        return ~(self.share <= 1) | self.far | self.blank


def judge(
    b: np.ndarray, flag: np.ndarray | None, rays: Rays, precision: str, budget: Budget, tir: str = AUTO
) -> Judged:
    """Answers b (N, 3) to these rays, and whether they were said to be transmitted."""
    u, exact = float(np.finfo(PRECISIONS[precision]).eps) / 2, oracle.refract(rays.a, rays.n, rays.k, fresnel=False)
    with np.errstate(over="ignore"):
        rounded = b.astype(PRECISIONS[precision])
    seen = _Seen(rounded.astype(np.float64), rays, exact, u)
    if tir == AUTO:
        tir = _detected(seen) if flag is None else FLAG
    decided = _decided(rays, exact, u, budget)
    if flag is not None and tir == FLAG:
        reflected = ~flag
    elif tir == NONE:  # but those who think of the rays in doubt that they have it must say so somehow
        reflected = ~seen.directed & ~decided
    else:
        reflected = TELLERS[tir](seen) if tir in TELLERS else np.zeros(len(b), bool)
    blank = ~seen.directed & ~(reflected & (tir != "reflected") & (tir != "tangent"))
    misjudged = (exact.transmitted == reflected) & ~blank
    bound = _bound(rays, exact, u, budget)
    with np.errstate(all="ignore"):
        length, kept = lengths(seen.b), lengths(rays.a)
        _, angle, _ = errors(seen.b * (kept / length)[:, None], rays, exact)
        norm = np.fmin(np.abs(length - 1), np.abs(length / kept - 1)).astype(float)
    return Judged(
        rays,
        exact,
        b,
        seen.b,
        u,
        budget,
        tir,
        blank,
        compared=~misjudged & ~blank & (exact.transmitted | (tir == "reflected")),
        misjudged=misjudged,
        decided=decided,
        angle=angle,
        norm=norm,
        bound=bound,
    )


def _off_unit(rays: Rays, u: float) -> np.ndarray:
    """The roundoff that a formula for unit vectors is held to: what `a` and `n` are off by, or what unit ones would."""
    off = np.maximum(*(np.abs(lengths(v) - 1) for v in (rays.a, rays.n)))
    return np.clip(off, u, NORMALISING * u).astype(float)


def _bound(rays: Rays, exact: oracle.Certified, u: float, budget: Budget) -> np.ndarray:
    wide = u if budget.at_the_limit else _off_unit(rays, u)
    return np.asarray(budget.chord(wide, rays.k.astype(float), exact.cos_t, exact.transmitted, cos_i=exact.cos_i))


def _decided(rays: Rays, exact: oracle.Certified, u: float, budget: Budget) -> np.ndarray:
    """Where a wrong decision is held against the answers: where the radicand is beyond the budget's own error."""
    if budget.at_the_limit:
        return ~(relative_radicand(rays) <= NEGLIGIBLE * u * u)
    wide = _off_unit(rays, u)
    return (absolute_radicand(rays) > budget.radicand_error_bound(wide, rays.k.astype(float))) & ~budget.side_open(
        wide, exact.cos_i
    )


# How total internal reflection is told -----------------------------------------------------------------------------


class _Seen:
    """Answers in float64 with what tells a reflected ray from a transmitted one."""

    def __init__(self, b: np.ndarray, rays: Rays, exact: oracle.Certified, u: float) -> None:
        self.b, self.rays, self.exact, self.u = b, rays, exact, u
        with np.errstate(invalid="ignore"):
            self.directed = np.isfinite(b).all(axis=1) & b.any(axis=1)

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


def _mirrored(seen: _Seen) -> np.ndarray:
    """Nearer to the mirror direction; the benefit of the doubt where the two ends are one."""
    with np.errstate(all="ignore"):
        unit = seen.b / np.sqrt((seen.b * seen.b).sum(1, keepdims=True))
        to_mirror, to_onward = (np.sqrt(((unit - end) ** 2).sum(1)) for end in seen.ends)
        nearer = to_mirror < to_onward
        return np.where(np.abs(to_mirror - to_onward) <= seen.open, ~seen.exact.transmitted, nearer)


def _along(seen: _Seen) -> np.ndarray:
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


def _detected(seen: _Seen) -> str:
    """How most of the rays that are beyond doubt say it."""
    total = ~seen.exact.transmitted & (seen.exact.cos_i > 0)
    if not total.any():
        return NONE
    certain = total & (absolute_radicand(seen.rays) > CERTAIN)
    among = certain if certain.any() else total
    shares = {name: float(teller(seen)[among].mean()) for name, teller in TELLERS.items()}
    best = max(shares, key=lambda name: shares[name])
    return best if shares[best] >= ALIKE else UNCLEAR
