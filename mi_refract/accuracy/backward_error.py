"""Backward errors: how far the inputs are of which an answer is the exact refraction.

With a, n and b unit, w = k a − b and γ = n·w, Snell's law is n × w = 0. Inputs a + δa, n + δn, k (1 + δk) change
n × w by

    k n×δa + γ δn×n + δk k n×a     to first order, |δa|, |δn|, |δk| ≤ ε

Lengths do not count, so δa is across a: n×δa fills an ellipse, ε cos θ_i long on the line of n×a and ε across it. In
the direction at the angle φ from that line the change is at most ε h,

    h = k √(cos² θ_i cos² φ + sin² φ) + |γ| + k sin θ_i |cos φ|

The backward error, the least ε that takes n × w to 0, is the largest component of n × w in such a direction, over h.
Near the critical angle it is small where the angle to the exact direction is not: there the last digit of an input
moves the direction as far.

For a mirror direction k is 1, and n × w says little near grazing incidence, where b is nearly a. There b itself is
compared with m = a − 2 (n·a) n: δa moves m by up to ε in all directions, δn by 2ε in the plane of incidence and by
2ε cos θ_i across it, so that

    h = 1 + 2 √(cos² φ + cos² θ_i sin² φ)

of b − m, φ from the plane of incidence.

A decision on total internal reflection is exact for inputs on the other side of the critical angle: with e = k sin θ_i

    ε = |1 − e²| / (2 e (2 k cos θ_i + e))     to first order,

or |θ_i − asin(1/k)| / 2, where that is less: by turning a and n alone.

The length of an answer has a backward error of its own. Its parts along the surface, e, and across it, √(1 − e²), may
be those of different inputs, each within ε. Then e is off by ε (2 k cos θ_i + e) in either, so that

    | |b|² − 1 | ≤ 4 ε e (2 k cos θ_i + e) ≤ 4 ε (2 k + 1)     with k = 1 for a mirror direction

Source: Higham, Accuracy and Stability of Numerical Algorithms, 2002, 1.5. In extended precision: n × w, of terms up to
k, is off by 8·2⁻⁶⁴ k, and h ≥ k; b − m by as much, and h ≥ 1. So a backward error is right to 2⁻⁶¹, 2⁻⁸ u of float64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_refract.regimes import Array, Rays

from .judge import absolute_radicand, lengths

_TURNS = np.linspace(0, np.pi / 2, 33)  # of φ: the largest is found to 1 part in 1000


@np.errstate(all="ignore")  # b may be anything
def of_directions(b: Array, rays: Rays, reflected: NDArray[np.bool_] | None = None) -> Array:
    """(N,) the backward errors of directions `b` (N, 3) of any length; infinite where b is zero or not finite.

    `reflected`: (N,) whose b is a mirror direction: there k = 1, and b is on the side that the ray comes from.
    """
    reflected = np.zeros(len(rays), bool) if reflected is None else reflected
    a, n, b, k = _unit(rays.a), _unit(rays.n), _unit(b), rays.k.astype(np.longdouble)
    cosine, axis, one = (n * a).sum(1), np.cross(n, a), np.ones_like(k)
    w, mirror = k[:, None] * a - b, a - 2 * cosine[:, None] * n
    gamma = (n * w).sum(1)
    of_refracted = _least(np.cross(n, w), axis, (k * cosine, k), (gamma, gamma), k * lengths(axis))
    of_mirrored = _least(b - mirror, np.cross(axis, mirror), (one, one), (2 * one, 2 * cosine), 0 * one)
    error = np.where(reflected, of_mirrored, of_refracted)
    onward = (n * b).sum(1) * np.sign(cosine) * np.where(reflected, -1, 1)
    error = np.maximum(error, -onward.astype(float))  # on the wrong side: n must turn by so much
    return np.where(np.isfinite(b).all(1), error, np.inf)


def _least(defect: Array, axis: Array, ellipse: tuple[Array, Array], other: tuple[Array, Array], along: Array) -> Array:
    """The least ε of which the changes reach a defect (N, 3): within two ellipses and a segment, ε times as large.

    `ellipse`, `other`: half axes on the line of `axis` (N, 3) and across it; `along`: the segment's; all (N,). Where
    `axis` is 0 the half axes are equal.
    """
    size = lengths(axis)
    part = np.where(size > 0, np.abs((defect * axis).sum(1)) / size, 0)
    across = np.sqrt(np.maximum((defect * defect).sum(1) - part * part, 0))
    x, y, a, b, c, d, segment = (np.abs(v).astype(float) for v in (part, across, *ellipse, *other, along))
    least = np.zeros(len(x))
    for turn in _TURNS:
        cos, sin = np.cos(turn), np.sin(turn)
        h = np.sqrt((a * cos) ** 2 + (b * sin) ** 2) + np.sqrt((c * cos) ** 2 + (d * sin) ** 2) + segment * cos
        np.fmax(least, (x * cos + y * sin) / h, out=least)
    return least


@np.errstate(all="ignore")
def of_lengths(b: Array, rays: Rays, reflected: NDArray[np.bool_]) -> Array:
    """(N,) the backward errors of the lengths of `b` (N, 3), which are to be 1 or |a|: the smaller one counts.

    `reflected`: (N,) whose b is a mirror direction. NaN where b is not finite.
    """
    k, length = np.where(reflected, 1, rays.k.astype(np.longdouble)), lengths(b)
    off = np.fmin(np.abs(length**2 - 1), np.abs((length / lengths(rays.a)) ** 2 - 1))
    return np.asarray((off / (4 * (2 * k + 1))).astype(float))


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def of_decisions(rays: Rays) -> Array:
    """(N,) how far inputs are for which the decision on total internal reflection is the other one."""
    a, n, k = _unit(rays.a), _unit(rays.n), rays.k.astype(np.longdouble)
    sine, cosine = lengths(np.cross(n, a)), np.abs((n * a).sum(1))
    e = k * sine
    step = absolute_radicand(rays) / (2 * e * (2 * k * cosine + e))
    turn = np.abs(np.arcsin(1 / k) - np.arctan2(sine, cosine)) / 2  # NaN where k < 1
    return np.asarray(np.fmin(step, turn).astype(float))


def _unit(v: Array) -> Array:
    wide = v.astype(np.longdouble)
    wide = wide / np.abs(wide).max(1, keepdims=True, initial=0)  # squares of the least numbers would be 0
    return np.asarray(wide / lengths(wide)[:, None])
