"""The judgement of a formula: every ray against the certified answer, and against the formula's budget for that ray.

Subjects are called as formulas are, `subject(a, n, k) -> (b, transmitted)`; studies, mutants and tests judge alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract import oracle
from mi_refract.accuracy.direction_errors import absolute_radicand, errors, lengths, relative_radicand
from mi_refract.formulas import NEGLIGIBLE, UNIT, Budget, radicand_for
from mi_refract.regimes import Rays

Subject = Callable[[Any, Any, Any], tuple[Any, Any]]


@dataclass(frozen=True)
class Judgement:
    """What came out, ray by ray; `right` are the rays whose decision was right, and errors count only there.

    `linear`, `radicand` say what the budget's constants would have to be for this ray, the other one as it is.
    """

    chord: np.ndarray  # |b/|a| − exact|; infinite where b is NaN
    angle: np.ndarray
    drift: np.ndarray  # of the length of b from that of a, relative
    right: np.ndarray
    misjudged: np.ndarray
    far: np.ndarray  # misjudged although the radicand exceeds what the budget leaves open; or undecided by the oracle
    crossed: np.ndarray  # on the other side of the surface, where the budget leaves the side open
    bound: np.ndarray  # of the chord
    linear: np.ndarray
    radicand: np.ndarray

    @property
    @np.errstate(over="ignore")
    def share(self) -> np.ndarray:
        """Error over bound of the rays judged rightly, 0 elsewhere."""
        return np.where(self.right, self.chord / self.bound, 0.0)

    @property
    def seen(self) -> np.ndarray:
        """The rays that break the budget."""
        return ~(self.share <= 1) | self.far

    def values(self) -> dict[str, float]:
        """What a budget is set on: every one of them at most `BUDGETS`."""
        return {"error / bound": float(self.share.max()), "misjudged far": float(self.far.sum())}


BUDGETS = {"error / bound": 1.0, "misjudged far": 0.0}


def judge(subject: Subject, rays: Rays, exact: oracle.Certified, vector: Any, budget: Budget) -> Judgement:
    """`subject` on all rays, in arrays of the 3-vector type `vector`."""
    return judged(*evaluate(subject, rays, vector), rays, exact, budget)


@np.errstate(over="ignore", invalid="ignore")  # a subject may return anything
def judged(b: np.ndarray, transmitted: np.ndarray, rays: Rays, exact: oracle.Certified, budget: Budget) -> Judgement:
    """What a subject returned, in extended precision."""
    chord, angle, drift = errors(b, rays, exact)
    misjudged = (transmitted != exact.transmitted) & ~exact.undecided
    right, distance = ~misjudged & ~exact.undecided, absolute_radicand(rays)
    u: Any = float(np.finfo(rays.a.dtype).eps) / 2
    k, cos_t, through = rays.k.astype(float), exact.cos_t, exact.transmitted
    off = [np.abs(lengths(v) - 1) for v in (rays.a, rays.n)]
    unit = off[0] <= UNIT * u
    if not budget.at_the_limit:  # what unit vectors are off by, the result is off by
        u = np.maximum(u, np.maximum(*off)).astype(float)
    open_side = budget.side_open(u, exact.cos_i)
    far = misjudged & ~open_side
    if budget.at_the_limit:
        far[far] = ~(relative_radicand(rays[far]) <= NEGLIGIBLE * u * u)
    else:
        far &= distance > budget.radicand_error_bound(u, k)
    far |= exact.undecided  # which no float is
    of_terms, of_root = budget.of_terms(u, k, through, unit), budget.of_root(u, k, cos_t, through)
    needed = np.where(through, radicand_for(np.maximum(chord - of_terms, 0), cos_t), 0.0)
    needed = np.where(misjudged, distance.astype(float), needed) / (u * np.maximum(1.0, k) ** budget.growth)
    linear = np.where(right & ~open_side, budget.linear * (chord - of_root) / of_terms, 0.0)
    bound = budget.chord(u, k, cos_t, through, unit, exact.cos_i)
    crossed = open_side & right & through & (chord > cos_t)
    return Judgement(
        chord, angle, drift, right, misjudged, far, crossed, bound, linear, np.where(open_side, 0.0, needed)
    )


def evaluate(subject: Subject, rays: Rays, vector: Any) -> tuple[np.ndarray, np.ndarray]:
    """`subject` on all rays, as numpy arrays (N, 3) and (N,), in extended precision."""
    if dr.is_jit_v(vector):
        b, transmitted = subject(vector(rays.a.T), vector(rays.n.T), dr.value_t(vector)(rays.k))
        return np.array(b).T.astype(np.longdouble), np.array(transmitted)
    pairs = [subject(vector(a), vector(n), float(k)) for a, n, k in zip(rays.a, rays.n, rays.k, strict=True)]
    return np.array([list(b) for b, _ in pairs], np.longdouble), np.array([t for _, t in pairs], bool)
