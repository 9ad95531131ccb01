"""How far a direction is from the certified one, and a ray from the critical angle; in extended precision."""

from __future__ import annotations

import numpy as np

from mi_refract import oracle, regimes
from mi_refract.regimes import Rays


def errors(b: np.ndarray, rays: Rays, exact: oracle.Certified) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(chord, angle, drift of the length) of every ray, relative to |a|; NaN counts as infinite."""
    unit, low = b / lengths(rays.a)[:, None], exact.direction_low.astype(np.longdouble)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a subject may return anything
        difference = (unit - exact.direction) - low
        chord, norm = lengths(difference), lengths(unit)
        across = lengths(np.cross(unit, difference)) / norm
        angle = np.arctan2(across, norm - (unit * difference).sum(1) / norm)
        chord, angle, drift = (np.nan_to_num(x.astype(float), nan=np.inf) for x in (chord, angle, np.abs(norm - 1)))
    return chord, angle, drift


def absolute_radicand(rays: Rays) -> np.ndarray:
    """|1 − k² sin²θ_i| of every ray, in extended precision: how far the decision is from the critical angle."""
    a, n, k = (x.astype(np.longdouble) for x in (rays.a, rays.n, rays.k))
    return np.abs(1 - (k * lengths(np.cross(n, a)) / (lengths(a) * lengths(n))) ** 2)


def relative_radicand(rays: Rays) -> np.ndarray:
    """|(n·a)² − κ|n×a|²| of every ray, over the mean of the two terms, right to 2⁻¹⁴⁰; NaN where both are 0.

    Near the critical angle, where the terms are alike, it is |`oracle.relative_radicand`|.
    """
    _, d, terms = regimes.radicand(*(x.T.astype(np.float64) for x in (rays.a, rays.n, rays.k)))
    with np.errstate(invalid="ignore"):
        return np.abs(d[0]) / (terms / 2)


def lengths(v: np.ndarray) -> np.ndarray:
    """(N,) of (N, 3), in extended precision."""
    return np.sqrt((v.astype(np.longdouble) ** 2).sum(1))
