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

A decision on total internal reflection is exact for inputs on the other side of the critical angle: with e = k sin θ_i

    ε = |1 − e²| / (2 e (2 k cos θ_i + e))     to first order,

or |θ_i − asin(1/k)| / 2, where that is less: by turning a and n alone.

Source: Higham, Accuracy and Stability of Numerical Algorithms, 2002, 1.5. In extended precision.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mi_refract.regimes import Array, Rays

from .direction_errors import absolute_radicand, lengths

_TURNS = np.linspace(0, np.pi / 2, 33)  # of φ: the largest is found to 1 part in 1000


@np.errstate(all="ignore")  # b may be anything
def of_directions(b: Array, rays: Rays, reflected: NDArray[np.bool_] | None = None) -> Array:
    """(N,) the backward errors of directions `b` (N, 3) of any length; infinite where b is zero or not finite.

    `reflected`: (N,) whose b is a mirror direction: there k = 1, and b is on the side that the ray comes from.
    """
    reflected = np.zeros(len(rays), bool) if reflected is None else reflected
    a, n, b = _unit(rays.a), _unit(rays.n), _unit(b)
    k = np.where(reflected, 1, rays.k.astype(np.longdouble))
    w = k[:, None] * a - b
    residual, axis, cosine = np.cross(n, w), np.cross(n, a), (n * a).sum(1)
    sine = lengths(axis)
    along = np.where(sine > 0, np.abs((residual * axis).sum(1)) / sine, 0)
    across = np.sqrt(np.maximum((residual * residual).sum(1) - along * along, 0))
    found = _least(along, across, (k * cosine, k, (n * w).sum(1), np.where(reflected, 0, k * sine)))
    onward = (n * b).sum(1) * np.sign(cosine) * np.where(reflected, -1, 1)
    found = np.maximum(found, -onward.astype(float))  # on the wrong side: n must turn by so much
    return np.where(np.isfinite(b).all(1), found, np.inf)


def _least(along: Array, across: Array, axes: tuple[Array, Array, Array, Array]) -> Array:
    """The least ε for a residual with these components. `axes`: k cos θ_i, k, γ and k sin θ_i; all (N,)."""
    x, y, ellipse_x, ellipse_y, disc, segment = (np.abs(v).astype(float) for v in (along, across, *axes))
    found = np.zeros(len(x))
    for turn in _TURNS:
        c, s = np.cos(turn), np.sin(turn)
        h = np.sqrt((ellipse_x * c) ** 2 + (ellipse_y * s) ** 2) + disc + segment * c
        np.fmax(found, (x * c + y * s) / h, out=found)
    return found


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def of_decisions(rays: Rays) -> Array:
    """(N,) how far inputs are for which the decision on total internal reflection is the other one."""
    a, n, k = _unit(rays.a), _unit(rays.n), rays.k.astype(np.longdouble)
    sine, cosine = lengths(np.cross(n, a)), np.abs((n * a).sum(1))
    e = k * sine
    step = absolute_radicand(rays) / (2 * e * (2 * k * cosine + e))
    turn = np.abs(np.arcsin(1 / k) - np.arctan2(sine, cosine)) / 2  # NaN where k < 1
    nearest: Array = np.fmin(step, turn).astype(float)
    return nearest


def _unit(v: Array) -> Array:
    wide = v.astype(np.longdouble)
    wide = wide / np.abs(wide).max(1, keepdims=True, initial=0)  # squares of the least numbers would be 0
    unit: Array = wide / lengths(wide)[:, None]
    return unit
