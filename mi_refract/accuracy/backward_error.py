"""Backward errors: the distance of the given inputs from inputs for which an answer is the exact refraction.

With a, n and b unit, w = k a − b and γ = n·w, Snell's law is n × w = 0. Inputs a + δa, n + δn, k (1 + δk) change
n × w by

    k n×δa + γ δn×n + δk k n×a     to first order, |δa|, |δn|, |δk| ≤ ε

Lengths do not count, so δa is perpendicular to a: n×δa fills an ellipse with half axes ε cos θ_i on the line of n×a and
ε across it. In the direction at the angle φ from that line the change is at most ε h,

    h = k √(cos² θ_i cos² φ + sin² φ) + |γ| + k sin θ_i |cos φ|

The backward error, the least ε that takes n × w to 0, is the largest value over φ of the component of n × w in that
direction, divided by h. Near the critical angle it may be small though the angle to the exact direction is large: there
the last digit of an input moves the direction as far.

For a mirror direction k is 1, and n × w says little near grazing incidence, where b is nearly a. So b itself is
compared with m = a − 2 (n·a) n: δa moves m by up to ε in all directions, δn by 2ε in the plane of incidence and by
2ε cos θ_i across it, so that

    h = 1 + 2 √(cos² φ + cos² θ_i sin² φ)

for b − m, with φ from the plane of incidence.

A decision on total internal reflection is exact for inputs on the other side of the critical angle: with e = k sin θ_i

    ε = |1 − e²| / (2 e (2 k cos θ_i + e))     to first order,

or |θ_i − asin(1/k)| / 2 if that is less, from turning only a and n.

The length of an answer has a backward error of its own. Its components along the surface, e, and across it, √(1 − e²),
may be those of different inputs, each within ε. Then the error of e is ε (2 k cos θ_i + e) in either, so that

    | |b|² − 1 | ≤ 4 ε e (2 k cos θ_i + e) ≤ 4 ε (2 k + 1)     with k = 1 for a mirror direction

Source: Higham, Accuracy and Stability of Numerical Algorithms, 2002, 1.5. In extended precision, the error of n × w,
with terms up to k, is 8·2⁻⁶⁴ k, and h ≥ k; that of b − m is 8·2⁻⁶⁴, and h ≥ 1. So the error of a backward error is
2⁻⁶¹, which is 2⁻⁸ u of float64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_refract.regimes import Array, Rays, normalised

from .judge import absolute_radicand, lengths

_TURNS = np.linspace(0, np.pi / 2, 33)  # values of φ: they give the largest value to 1 part in 1000


@np.errstate(all="ignore")  # b may have any values
def of_directions(b: Array, rays: Rays, reflected: NDArray[np.bool_] | None = None) -> Array:
    """(N,) the backward errors of directions `b` (N, 3) of any length; infinite if b is zero or not finite.

    `reflected`: (N,) whether b is a mirror direction: then k = 1, and b is on the side that the ray comes from.
    """
    reflected = np.zeros(len(rays), bool) if reflected is None else reflected
    a, n, b, k = unit(rays.a), unit(rays.n), unit(b), rays.k.astype(np.longdouble)
    cosine, axis, one = (n * a).sum(1), np.cross(n, a), np.ones_like(k)
    w, mirror = k[:, None] * a - b, a - 2 * cosine[:, None] * n
    gamma = (n * w).sum(1)
    refracted_errors = _least(np.cross(n, w), axis, (k * cosine, k), (gamma, gamma), k * lengths(axis))
    mirrored_errors = _least(b - mirror, np.cross(axis, mirror), (one, one), (2 * one, 2 * cosine), 0 * one)
    result = np.where(reflected, mirrored_errors, refracted_errors)
    onward = (n * b).sum(1) * np.sign(cosine) * np.where(reflected, -1, 1)
    result = np.maximum(result, -onward.astype(float))  # if b is on the wrong side, n must turn by at least this
    return np.where(np.isfinite(b).all(1), result, np.inf)


def _least(
    defect: Array, axis: Array, ellipse1: tuple[Array, Array], ellipse2: tuple[Array, Array], segment: Array
) -> Array:
    """The least ε for which changes within two ellipses and a segment, scaled by ε, add up to a defect (N, 3).

    `ellipse1`, `ellipse2`: half axes on the line of `axis` (N, 3) and across it; `segment`: half length, on the same
    line; all (N,). If `axis` is 0, the half axes are equal.
    """
    size = lengths(axis)
    along = np.where(size > 0, np.abs((defect * axis).sum(1)) / size, 0)
    across = np.sqrt(np.maximum((defect * defect).sum(1) - along * along, 0))
    x, y, a, b, c, d, e = (np.abs(v).astype(float) for v in (along, across, *ellipse1, *ellipse2, segment))
    least = np.zeros(len(x))
    for turn in _TURNS:
        cos, sin = np.cos(turn), np.sin(turn)
        h = np.sqrt((a * cos) ** 2 + (b * sin) ** 2) + np.sqrt((c * cos) ** 2 + (d * sin) ** 2) + e * cos
        np.fmax(least, (x * cos + y * sin) / h, out=least)
    return least


@np.errstate(all="ignore")
def of_lengths(b: Array, rays: Rays, reflected: NDArray[np.bool_]) -> Array:
    """(N,) the backward errors of the lengths of `b` (N, 3), which should be 1 or |a|: the smaller error counts.

    `reflected`: (N,) whether b is a mirror direction. NaN if b is not finite.
    """
    k, length = np.where(reflected, 1, rays.k.astype(np.longdouble)), lengths(b)
    error = np.fmin(np.abs(length**2 - 1), np.abs((length / lengths(rays.a)) ** 2 - 1))
    result: Array = (error / (4 * (2 * k + 1))).astype(float)
    return result


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def of_decisions(rays: Rays) -> Array:
    """(N,) the backward errors of wrong decisions: the distance to inputs on the other side of the critical angle."""
    a, n, k = unit(rays.a), unit(rays.n), rays.k.astype(np.longdouble)
    sine, cosine = lengths(np.cross(n, a)), np.abs((n * a).sum(1))
    e = k * sine
    step = absolute_radicand(rays) / (2 * e * (2 * k * cosine + e))
    turn = np.abs(np.arcsin(1 / k) - np.arctan2(sine, cosine)) / 2  # NaN for k < 1
    result: Array = np.fmin(step, turn).astype(float)
    return result


def unit(v: Array) -> Array:
    """Vectors (N, 3) of length 1, in extended precision."""
    wide = v.astype(np.longdouble)
    # Divided by the largest component first, else the squares of the smallest numbers would be 0.
    return normalised(wide / np.abs(wide).max(1, keepdims=True, initial=0))
