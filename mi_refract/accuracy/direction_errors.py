"""How far a direction is from the certified one, and a ray from the critical angle; in extended precision."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mi_refract import oracle, regimes
from mi_refract.regimes import Array, Rays


class DirectionErrors(NamedTuple):
    """Errors of directions b, (N,) float64 each; infinite where b is NaN."""

    chord: Array  # |b/|a| − exact|
    angle: Array  # between b and the exact direction, radians
    drift: Array  # of the length: | |b|/|a| − 1 |


def errors(b: Array, rays: Rays, exact: oracle.Certified) -> DirectionErrors:
    """Errors of `b` (N, 3), which should have the length of `a`, relative to |a|."""
    unit, low = b / lengths(rays.a)[:, None], exact.direction_low.astype(np.longdouble)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # b may be anything
        difference = (unit - exact.direction) - low
        chord, norm = lengths(difference), lengths(unit)
        across = lengths(np.cross(unit, difference)) / norm
        angle = np.arctan2(across, norm - (unit * difference).sum(1) / norm)
        return DirectionErrors(*(np.nan_to_num(x.astype(float), nan=np.inf) for x in (chord, angle, np.abs(norm - 1))))


def errors_of_normalised(b: Array, rays: Rays, exact: oracle.Certified) -> DirectionErrors:
    """Errors of `b` (N, 3) that may also have been made unit: `drift` is | |b| − 1 | where that is less.

    Chord and angle are those of b scaled to the length of `a`. NaN stays in `drift`.
    """
    with np.errstate(all="ignore"):  # b may be anything
        length, kept = lengths(b), lengths(rays.a)
        drift = np.fmin(np.abs(length - 1), np.abs(length / kept - 1)).astype(float)
        return errors(b * (kept / length)[:, None], rays, exact)._replace(drift=drift)


def absolute_radicand(rays: Rays) -> Array:
    """(N,) |1 − k² sin²θ_i|, in extended precision: how far each ray is from the critical angle."""
    a, n, k = (x.astype(np.longdouble) for x in (rays.a, rays.n, rays.k))
    return np.abs(1 - (k * lengths(np.cross(n, a)) / (lengths(a) * lengths(n))) ** 2)


def relative_radicand(rays: Rays) -> Array:
    """(N,) |(n·a)² − κ|n×a|²| over the mean of its two terms, right to 2⁻¹⁴⁰; NaN where both are 0.

    Near the critical angle, where the terms are alike, it is the modulus of `oracle.relative_radicand`.
    """
    _, d, terms = regimes.radicand(*(x.T.astype(np.float64) for x in (rays.a, rays.n, rays.k)))
    with np.errstate(invalid="ignore"):
        ratio: Array = np.abs(d[0]) / (terms / 2)
    return ratio


def lengths(v: Array) -> Array:
    """(N,) of (N, 3), in extended precision."""
    length: Array = np.sqrt((v.astype(np.longdouble) ** 2).sum(1))
    return length
