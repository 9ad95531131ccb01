"""Optical systems with closed answers, and what an error at each of their boundaries makes of the answer.

A system is `trace(refract) -> (N, m)`: what comes out minus the closed form, for N rays. `refract(a, n, k) -> b` is
asked at every boundary; a, n, b (N, 3), k = n_from/n_to. Intersections and closed forms are in extended precision,
whatever the precision of `refract`: they are geometry, not refraction. All systems stand askew, so that no normal is
an axis, and have the unit of length 1. Directions are compared by their chord, a small angle in radians.

Closed forms: `closed`, and Born and Wolf, Principles of Optics, 4.2.3 (aplanatic points); Descartes, La Dioptrique,
1637 (ellipsoid).
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import closed_forms

Array = NDArray[Any]
Refract = Callable[[Array, Array, Any], Array]
Trace = Callable[[Refract], Array]

RAYS = 32
BK7 = np.longdouble(1.5168)  # a crown glass
WATER = 1.331, 1.344  # for red and for violet
PRINT = Path(__file__).with_name("double_gauss_codev.json")
# What printing rounds to: see "digits" in the file.
TANGENT, POSITION = 5e-7, 2.3e-6
FIELDS = {0.0: 0.0, 0.176327: 10.0, 0.249328: 14.0}  # printed tangent: degrees


# Vectors -------------------------------------------------------------------------------------------------------


def dot(x: Array, y: Array) -> Array:
    """Of vectors (… × 3), as … × 1."""
    return (x * y).sum(-1, keepdims=True)


def unit(x: Array) -> Array:
    """Vectors (… × 3) of length 1."""
    return x / np.sqrt(dot(x, x))


def vectors(*components: Any) -> Array:
    """Three components of any shapes as (N, 3) in extended precision."""
    return np.stack(np.broadcast_arrays(*(np.asarray(x, np.longdouble) for x in components)), axis=-1)


def degrees(first: float, last: float, count: int = RAYS) -> Array:
    """`count` angles from `first` to `last`, in radians, in extended precision."""
    return np.deg2rad(np.linspace(first, last, count).astype(np.longdouble))


def snell(a: Array, n: Array, k: Any) -> Array:
    """The law in extended precision, from its well-conditioned form. No total internal reflection: NaN there."""
    k = np.asarray(k, np.longdouble).reshape(-1, 1)
    c, w = dot(n, a), np.cross(n, a)
    along = np.copysign(np.sqrt(c * c - (k - 1) * (k + 1) * dot(w, w)), c)
    return (k * np.cross(w, n) + along * n) / dot(n, n)


_X, _Y = unit(vectors([3], 1, 2)), unit(vectors([-1], 1, 1))
ASKEW = np.concatenate([_X, _Y, np.cross(_X, _Y)])


def askew(trace: Trace) -> Trace:
    """The same system, turned so that no axis is special."""

    @functools.wraps(trace)
    def turned(refract: Refract) -> Array:
        return trace(lambda a, n, k: refract(a @ ASKEW, n @ ASKEW, k) @ ASKEW.T)

    return turned


# Systems -------------------------------------------------------------------------------------------------------


@askew
def slab(refract: Refract) -> Array:
    """A plane-parallel plate: the direction is restored, the ray shifted by d sin(θ − θ')/cos θ'.

    Rays at 1 … 89 degrees through a plate of BK7, d = 1. (shift − closed form, direction restored − a).
    """
    angle = degrees(1, 89)
    a, n = vectors(np.sin(angle), 0, np.cos(angle)), vectors(np.zeros(RAYS), 0, 1)
    inside = refract(a, n, 1 / BK7)
    p = inside / dot(inside, n)
    out = refract(inside, n, BK7)
    shift = np.sqrt(dot(np.cross(p, a), np.cross(p, a)))
    return np.concatenate([shift - closed_forms.lateral_shift(angle, BK7)[:, None], unit(out) - a], axis=1)


@askew
def round_trip(refract: Refract) -> Array:
    """Into a denser medium and back through the same boundary: the direction is restored.

    Rays at 1 … 89.9 degrees, each with its own index between 1.0001 and 4. (direction restored − a).
    """
    angle, index = degrees(1, 89.9), 1 + np.geomspace(1e-4, 3, 7)[np.arange(RAYS) % 7].astype(np.longdouble)
    a, n = vectors(np.sin(angle), 0, np.cos(angle)), vectors(np.zeros(RAYS), 0, 1)
    return unit(refract(refract(a, n, 1 / index), n, index)) - a


@askew
def prism(refract: Refract) -> Array:
    """A prism at minimum deviation, D = 2 asin(n sin(A/2)) − A.

    Apex angles A of 10 … 80 degrees, BK7; the first incidence is asin(n sin(A/2)). (deviation − closed form).
    """
    half = degrees(5, 40)
    incidence = closed_forms.least_deviated(2 * half, BK7)
    left, right = vectors(np.cos(half), 0, -np.sin(half)), vectors(np.cos(half), 0, np.sin(half))
    angle = incidence - half  # inside, the ray runs along x
    a = vectors(np.cos(angle), 0, np.sin(angle))
    b = refract(refract(a, left, 1 / BK7), right, BK7)
    deviation = np.arctan2(np.sqrt(dot(np.cross(a, b), np.cross(a, b))), dot(a, b))
    return deviation - (2 * incidence - 2 * half)[:, None]


@askew
def weierstrass(refract: Refract) -> Array:
    """A sphere's aplanatic points: rays from the distance R/n within leave as if from nR, all of them.

    Rays at 91 … 179 degrees to the axis, all around it, R = 1, BK7. (direction − closed form).
    """
    angle, around = degrees(91, 179), degrees(0, 3000)
    towards = angle - np.arcsin(np.sin(angle) / BK7)  # the angle at the centre; the sines are as R to R/n
    radius = np.sin(towards)
    p = vectors(np.cos(towards), radius * np.cos(around), radius * np.sin(around))
    a = unit(p - vectors([1 / BK7], 0, 0))
    return unit(refract(a, p, BK7)) - unit(p - vectors([BK7], 0, 0))


@askew
def ellipsoid(refract: Refract) -> Array:
    """An ellipsoid of eccentricity 1/n: light parallel to its axis meets in the far focus.

    Major half-axis 1, BK7, rays at 1 … 89 degrees of eccentric anomaly. (direction − closed form).
    """
    e = 1 / BK7
    minor = np.sqrt((1 - e) * (1 + e))
    anomaly, around = degrees(1, 89), degrees(0, 3000)
    radius = np.sin(anomaly)
    p = vectors(-np.cos(anomaly), minor * radius * np.cos(around), minor * radius * np.sin(around))
    n = unit(p / vectors([1], minor**2, minor**2))
    b = refract(np.broadcast_to(vectors([1], 0, 0), p.shape), n, 1 / BK7)
    return unit(b) - unit(vectors([e], 0, 0) - p)


@askew
def rainbow(refract: Refract) -> Array:
    """The rainbows of order 1 … 4 in a drop of water: rays at the stationary angle, D = mπ + 2i − 2(m + 1) r.

    The reflections within are geometry. (direction − closed form).
    """
    order = np.arange(RAYS) % 4 + 1
    index = np.linspace(*WATER, RAYS).astype(np.longdouble)
    incidence = closed_forms.rainbow_incidence(index, order)
    d = closed_forms.deflection(incidence, index, order)
    a, p = vectors(np.ones(RAYS), 0, 0), vectors(-np.cos(incidence), 0, np.sin(incidence))
    b = unit(refract(a, p, 1 / index))
    for reflection in range(1 + order.max()):
        inside = (reflection <= order)[:, None]
        p = np.where(inside, unit(p - 2 * dot(p, b) * b), p)
        b = np.where((reflection < order)[:, None], b - 2 * dot(p, b) * p, b)
    return unit(refract(b, p, index)) - vectors(np.cos(d), 0, -np.sin(d))


# The double Gauss ----------------------------------------------------------------------------------------------


@functools.cache
def double_gauss_data() -> dict[str, Any]:
    """A double Gauss and nine rays through it, as CODE V prints them; lengths in mm."""
    return json.loads(PRINT.read_text())


def printed_rays() -> tuple[Array, Array]:
    """Where the nine rays are on the first surface, and their directions before it."""
    rays = double_gauss_data()["rays"]
    angle = np.deg2rad(np.array([FIELDS[ray["object"][4]] for ray in rays], np.longdouble))
    first = np.array([ray["surfaces"][0][:3] for ray in rays], np.longdouble)
    return first, vectors(np.zeros(len(rays)), np.sin(angle), np.cos(angle))


def printed() -> tuple[Array, Array]:
    """Positions (surfaces, 9, 3) and tangents (surfaces, 9, 2) behind the surfaces."""
    numbers = np.array([ray["surfaces"] for ray in double_gauss_data()["rays"]]).swapaxes(0, 1)
    return numbers[..., :3], numbers[..., 3:5]


def meet(p: Array, d: Array, curvature: float) -> tuple[Array, Array]:
    """Where rays meet the surface c (x² + y² + z²) = 2 z next to its vertex, and its unit normal; NaN if they miss."""
    p = p - d * (p[:, 2:] / d[:, 2:])  # on the vertex plane, where the smaller root is the near one
    e = curvature * dot(p[:, :2], p[:, :2])
    f = d[:, 2:] - curvature * dot(d[:, :2], p[:, :2])
    with np.errstate(invalid="ignore"):
        p = p + d * (e / (f + np.copysign(np.sqrt(f * f - curvature * e), f)))
    return p, vectors(0, 0, 1) - curvature * p


def retrace(refract: Refract, prescription: Any = None) -> tuple[Array, Array]:
    """Positions (surfaces, 9, 3), each from its vertex, and directions (surfaces, 9, 3) of the printed rays."""
    (p, b), index = printed_rays(), 1.0
    positions, directions = [], []
    for curvature, thickness, after in prescription or double_gauss_data()["prescription"]:
        p, n = meet(p, unit(b), curvature)
        b, index = refract(b, n, index / after), after
        positions.append(p)
        directions.append(b)
        p = p - vectors(0, 0, thickness)
    return np.array(positions), np.array(directions)


def off_print(refract: Refract, prescription: Any = None) -> float:
    """The largest deviation from the print, over what printing rounds to: 1 is within the print."""
    positions, directions = retrace(refract, prescription)
    said, tangents = printed(), directions[..., :2] / directions[..., 2:]
    deviations = (positions - said[0]) / POSITION, (tangents - said[1]) / TANGENT
    return float(max(np.abs(x).max() for x in deviations))


def double_gauss(refract: Refract) -> Array:
    """CODE V's double Gauss, eleven surfaces: nine rays against the retrace in extended precision.

    (direction − exact) after the last surface; that the exact retrace is the printed one is `off_print`.
    """
    return unit(retrace(refract)[1][-1]) - unit(retrace(snell)[1][-1])


SYSTEMS: dict[str, Trace] = {
    "slab": slab,
    "round trip": round_trip,
    "prism": prism,
    "Weierstrass sphere": weierstrass,
    "ellipsoid lens": ellipsoid,
    "rainbows": rainbow,
    "double Gauss": double_gauss,
}


# Conditions ----------------------------------------------------------------------------------------------------

NUDGE = 1e-8


@functools.cache
def condition(trace: Trace) -> Array:
    """(N,): by how many u the answer is off, if the first a and every n, k and b were off by u, to first order.

    The sum over all of them of the norm of the derivative, from differences of the exact trace; a, n and b move at
    right angles to themselves, for their length is not asked for.
    """
    exact, asked = trace(snell), 0

    def counted(a: Array, n: Array, k: Any) -> Array:
        nonlocal asked
        asked += 1
        return snell(a, n, k)

    trace(counted)
    total = np.zeros(len(exact), np.longdouble)
    for call in range(asked):
        for what in (*("a",) * (call == 0), "n", "k", "b"):
            ways = range(1 if what == "k" else 2)
            moved = [trace(_nudged(call, what, way)) - exact for way in ways]
            total += np.sqrt(sum((x**2).sum(1) for x in moved)) / NUDGE
    return total


def _nudged(call: int, what: str, way: int) -> Refract:
    """`snell`, but at one call one of its arguments or its result is moved a little."""
    calls = iter(range(1 << 30))

    def refract(a: Array, n: Array, k: Any) -> Array:
        here = next(calls) == call
        if here and what == "a":
            a = _aside(a, way)
        if here and what == "n":
            n = _aside(n, way)
        b = snell(a, n, k * (1 + NUDGE) if here and what == "k" else k)
        return _aside(b, way) if here and what == "b" else b

    return refract


def _aside(x: Array, way: int) -> Array:
    """Each vector, moved by NUDGE of its length in one of two directions at right angles to it."""
    return x + NUDGE * np.sqrt(dot(x, x)) * across(x, way)


def across(x: Array, way: int) -> Array:
    """One of two unit vectors at right angles to each vector and to each other."""
    smallest = np.eye(3, dtype=np.longdouble)[np.abs(x).argmin(axis=1)]
    aside = unit(np.cross(x, smallest))
    return np.cross(unit(x), aside) if way else aside
