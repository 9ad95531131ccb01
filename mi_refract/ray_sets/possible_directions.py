"""Which directions are possible where the error bound is too wide to judge them: what rounding of a formula can give.

A documented formula is off by L = linear u K in any direction, and by its root along the normal (see
`mi_refract.formulas.bounds`). With t the direction of `a` along the surface, m the normal on the side that the
transmitted ray goes to, D = cos²θ_t, it answers, at any length s > 0,

    b = s (k sinθ t + r m + δ),   |δ| ≤ L,   r ≥ 0,   |r² − D| ≤ x

So b is in the plane of incidence, forward, and not on the side that the ray came from, whatever x is. A vector along
the surface that signals total internal reflection is in that plane and forward; a mirror direction is known entirely.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_refract.accuracy import RayBounds, lengths
from mi_refract.regimes import Array

Index = NDArray[np.intp]
Flags = NDArray[np.bool_]

UNDECIDABLE = 0.1  # radians: a direction is not judged where its bound is larger


@dataclass(frozen=True)
class Components:
    """Directions (M, 3) as parts along t, along m, and across both: (M,) each, of a unit vector."""

    along: Array
    onward: Array
    across: Array


def possible(b: Array, bounds: RayBounds, some: Index) -> Flags:
    """(M,) the answers of `b` (N, 3) to the rays `some` (M indices) that a transmitted direction may be."""
    u, k, exact = bounds.u[some], bounds.k[some], bounds.exact
    answer, incident = _components(b, bounds, some)
    e = k * incident.along
    root2 = np.where(exact.transmitted[some], exact.cos_t[some] ** 2, 1 - e * e)
    x = bounds.budget.radicand_error_bound(u, k)
    low, high = (np.sqrt(np.maximum(root2 + sign * x, 0)) for sign in (-1, 1))
    either = bounds.budget.side_open(u, exact.cos_i[some])
    onward = np.where(either, np.abs(answer.onward), answer.onward)
    plane = answer.along**2 + answer.across**2
    with np.errstate(invalid="ignore", divide="ignore"):
        nearest = np.where(plane > 0, e * onward * answer.along / plane, low).clip(low, high)
    off = np.sqrt((nearest**2 + e * e) * answer.across**2 + (e * onward - nearest * answer.along) ** 2)
    return _within(off, e * answer.along + nearest * onward, np.hypot(e, nearest), _slack(bounds, some))


def possible_tangent(b: Array, bounds: RayBounds, some: Index) -> Flags:
    """(M,) as `possible`, of vectors along the surface."""
    answer, incident = _components(b, bounds, some)
    e, length = bounds.k[some] * incident.along, np.hypot(answer.along, answer.across)
    with np.errstate(invalid="ignore", divide="ignore"):
        return _within(e * answer.across / length, answer.along, e, _slack(bounds, some))


def possible_mirror(b: Array, bounds: RayBounds, some: Index) -> Flags:
    """(M,) as `possible`, of mirror directions."""
    answer, incident = _components(b, bounds, some)
    e, back = incident.along, -incident.onward
    off = np.sqrt(answer.across**2 + (e * answer.onward - back * answer.along) ** 2)
    return _within(off, e * answer.along + back * answer.onward, np.ones(len(some)), _slack(bounds, some, 1.0))


def _within(off: Array, forward: Array, size: Array, slack: Array) -> Flags:
    """Whether a vector of this size is within `slack` of the line of b, and b does not point away from it."""
    return (size <= slack) | (off <= slack) & (forward > 0)


def _slack(bounds: RayBounds, some: Index, largest: float = np.inf) -> Array:
    """(M,): L, with K = k where k > 1, up to `largest`."""
    k = np.minimum(bounds.k[some], largest)
    return np.asarray(bounds.budget.of_terms(bounds.u[some], k))


def _components(b: Array, bounds: RayBounds, some: Index) -> tuple[Components, Components]:
    """The parts of b and of `a`, in extended precision."""
    a, n = (_unit(v[some]) for v in (bounds.rays.a, bounds.rays.n))
    c = (a * n).sum(1, keepdims=True)
    m = np.where(c < 0, -n, n)
    tangent = a - c * n
    length = lengths(tangent)
    t = tangent / np.where(length > 0, length, 1)[:, None]
    b = _unit(b[some])
    onward = (b * m).sum(1)
    rest = b - onward[:, None] * m  # first: next to the normal, t is not orthogonal to m to the last digit
    along = (rest * t).sum(1)
    across = lengths(rest - along[:, None] * t)
    return Components(along, onward, across), Components(length, np.abs(c[:, 0]), np.zeros(len(some)))


def _unit(v: Array) -> Array:
    """Any vectors (M, 3), made unit in extended precision. Precondition: finite, not zero."""
    wide: Array = v.astype(np.longdouble)
    wide = wide / np.abs(wide).max(1, keepdims=True, initial=0)  # squares of the least numbers would be 0
    return np.asarray(wide / lengths(wide)[:, None])
