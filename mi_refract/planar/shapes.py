"""Shapes in the plane from their usual parameters: polygons, circles, ellipses, prisms, lenses of conic surfaces.

Each shape is a `Curve` around its own origin; `Curve.mapped` stretches, turns and moves it. All lengths are above 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .curves import Curve, area, joined, polygonal, unit
from .segments import Array

# 1 − (1 + K) c² r² counts as 0 up to this size: at the rim of a half sphere rounding of c = 1/R makes it differ from 0.
FLAT = 8 * 2.0**-53
# Surfaces that do not overlap at the rim may meet this close to it, in units of the radius. Where they touch, rounding
# moves the root of a quadratic equation by about √2⁻⁵³; between two such points they overlap by the square of that.
CLOSE = 1e-6


def polyline(points: ArrayLike, arcs: Sequence[float] | None = None) -> Curve:
    """An open curve from point to point (K × 2).

    `arcs`: for each piece, the degrees by which it turns left, as an arc of a circle; 0: straight.
    ValueError for fewer than 2 points, another number of arcs than pieces, or |degrees| ≥ 360.
    """
    return _chain(points, arcs, closed=False)


def polygon(points: ArrayLike, arcs: Sequence[float] | None = None) -> Curve:
    """A closed curve: a `polyline` with one more piece from the last point to the first, reversed if it runs clockwise.

    ValueError as for `polyline`, and for a polygon without area. Whether the polygon crosses itself is not checked.
    """
    curve = _chain(points, arcs, closed=True)
    size = area(curve)
    if abs(size) <= 1e-12 * np.ptp(curve.vertices, 0).max() ** 2:
        raise ValueError("points: they enclose no area; expected three points that are not on a line, or an arc")
    return curve if size > 0 else curve.reversed()


def _chain(points: ArrayLike, arcs: Sequence[float] | None, closed: bool) -> Curve:
    corners = np.array(points, float).reshape(-1, 2)
    pieces = len(corners) - (not closed)
    turns = [0.0] * pieces if arcs is None else [float(turn) for turn in arcs]
    if len(corners) < 2:
        raise ValueError(f"points: {len(corners)}; expected at least 2")
    if len(turns) != pieces or not all(abs(turn) < 360 for turn in turns):
        raise ValueError(f"arcs: {len(turns)} for {pieces} pieces; expected one per piece, above -360 and below 360")
    if not any(turns):
        return polygonal(corners, closed)
    vertices, control, weight = [corners[0]], [], []
    for p, q, turn in zip(corners, np.roll(corners, -1, 0), turns, strict=False):
        for end, middle, w in _arc(p, q, turn):
            vertices.append(end)
            control.append(middle)
            weight.append(w)
    return Curve(np.array(vertices[: len(vertices) - closed]), np.array(control), np.array(weight), closed)


def _arc(p: Array, q: Array, turn: float) -> Iterable[tuple[Array, Array, float]]:
    """End, control point and weight of the pieces of a circle's arc from p to q that turns left by `turn` degrees.

    The middle of the arc lies to the right of the chord at tan(turn/4)/2 of the chord's length, and the tangents at its
    ends meet at tan(turn/2)/2.
    """
    middle, aside = (p + q) / 2, np.array([q[1] - p[1], p[0] - q[0]]) / 2
    if abs(turn) <= 90:
        cosine, sine = unit(turn / 2)
        return [(q, middle + sine / cosine * aside, cosine)]
    cosine, sine = unit(turn / 4)
    between = middle + sine / cosine * aside
    return [*_arc(p, between, turn / 2), *_arc(between, q, turn / 2)]


def ellipse(rx: float, ry: float) -> Curve:
    """An ellipse around the origin with half axes `rx`, `ry`: four arcs with exact vertices and control points."""
    vertices = np.array([(rx, 0.0), (0.0, ry), (-rx, 0.0), (0.0, -ry)])
    control = np.array([(rx, ry), (-rx, ry), (-rx, -ry), (rx, -ry)], float)
    return Curve(vertices, control, np.full(4, math.sqrt(0.5)), closed=True)


def circle(radius: float) -> Curve:
    """A circle around the origin."""
    return ellipse(radius, radius)


def rectangle(width: float, height: float) -> Curve:
    """A rectangle around the origin, `width` along x and `height` along y."""
    x, y = width / 2, height / 2
    return polygon([(-x, -y), (x, -y), (x, y), (-x, y)])


def prism(apex: float, side: float) -> Curve:
    """A triangle with the angle `apex`, in degrees, at its top between two sides of length `side`; centroid at 0."""
    cosine, sine = unit(apex / 2)
    x, y = side * sine, side * cosine / 3
    return polygon([(-x, -y), (x, -y), (0.0, 2 * y)])


# Conic surfaces ---------------------------------------------------------------------------------------------------


def sag(r: Any, curvature: float, conic: float = 0.0) -> Any:
    """z = c r² / (1 + √(1 − (1 + K) c² r²)) for `curvature` c and conic constant K; NaN for r beyond the surface."""
    r = np.asarray(r, float)
    square = 1 - (1 + conic) * (curvature * r) ** 2
    square = np.where(np.abs(square) <= FLAT, 0.0, square)
    return curvature * r * r / (1 + np.sqrt(np.where(square < 0, np.nan, square)))


def _surface(vertex: float, rim: float, radius: float, curvature: float, conic: float) -> Curve:
    """The conic surface from (rim, radius) through (vertex, 0) to (rim, −radius), in two arcs.

    q = 1 − (1 + K) c z at the rim is the root in the sag. The end tangents of either arc meet at
    (vertex, ±radius/(1 + q)), and w² = (1 + q)/2, for every K, and for c = 0, where the arcs are straight.
    """
    q = 1 - (1 + conic) * curvature * (rim - vertex)
    meeting = radius / (1 + q)
    vertices = np.array([(rim, radius), (vertex, 0.0), (rim, -radius)])
    return Curve(vertices, np.array([(vertex, meeting), (vertex, -meeting)]), np.full(2, math.sqrt((1 + q) / 2)), False)


def lens(
    curvature: Sequence[float],
    thickness: float,
    *,
    radius: float | None = None,
    conic: Sequence[float] = (0.0, 0.0),
    vertex: float = 0.0,
) -> Curve:
    """A lens of two conic surfaces around the x axis, with `curvature` and `conic` constant of each; rim at ±`radius`.

    A curvature is positive if the centre lies toward +x. The front surface passes through (`vertex`, 0), the back
    surface through (`vertex` + `thickness`, 0). Without a radius the lens ends where the surfaces meet.
    ValueError if a surface does not reach the rim, or the surfaces meet before it, or they never meet.
    """
    tip, tip_radius = _tip(curvature, thickness, conic)
    if radius is None:
        if math.isinf(tip_radius):
            raise ValueError(f"curvature = {list(curvature)}: the surfaces never meet; expected a radius")
        radius, rims = tip_radius, [vertex + tip] * 2
    else:
        depths = [float(sag(radius, c, k)) for c, k in zip(curvature, conic, strict=True)]
        rims = [vertex + depths[0], vertex + thickness + depths[1]]
    if math.isnan(rims[0] + rims[1]):
        radii = (1 / (abs(c) * math.sqrt(1 + k)) for c, k in zip(curvature, conic, strict=True) if c and k > -1)
        raise ValueError(f"radius = {radius:g}: larger than a surface; expected at most {min(radii, default=0):g}")
    if rims[1] < rims[0] or tip_radius < (1 - CLOSE) * radius:
        most = f"at most {tip_radius:g}" if tip_radius < radius else "a smaller one"
        text = f"the surfaces meet inside it; expected {most}, or no radius"
        raise ValueError(f"radius = {radius:g}: {text}")
    front = _surface(vertex, rims[0], radius, curvature[0], conic[0])
    back = _surface(vertex + thickness, rims[1], radius, curvature[1], conic[1])
    return joined(front, back.reversed())


def _tip(curvature: Sequence[float], thickness: float, conic: Sequence[float]) -> tuple[float, float]:
    """(z, r) of the point nearest to the axis where the surfaces meet; r is infinite if they never meet.

    The front obeys c r² = 2 z − c (1 + K) z², the back the same with z − thickness for z. Eliminating r² leaves a
    quadratic equation in z.
    """
    (c1, c2), (k1, k2), t = curvature, (1 + k for k in conic), thickness
    if c1 == -c2 and k1 == k2 and c1:
        places = [t / 2]
    else:
        terms = [c1 * c2 * (k2 - k1), 2 * (c2 - c1 - c1 * c2 * k2 * t), 2 * c1 * t + c1 * c2 * k2 * t * t]
        places = [float(z.real) for z in np.roots(terms) if z.imag == 0] if np.isfinite(terms).all() else []
    tips = [(math.inf, math.nan)]
    for z in places:
        c, k, depth = (c1, k1, z) if abs(c1) >= abs(c2) else (c2, k2, z - t)
        square = 2 * depth / c - k * depth * depth if c else 0.0
        # Keep only points on the near half of both conics, which the sag describes.
        if square > 0 and 1 - c1 * k1 * z >= -FLAT and 1 - c2 * k2 * (z - t) >= -FLAT:
            tips.append((math.sqrt(square), z))
    radius, z = min(tips)
    return z, radius


def ellipse_lens(n: float, focal_length: float, thickness: float, radius: float) -> Curve:
    """A lens that focuses rays along +x exactly into the origin; n = n_inside / n_outside > 1.

    Its front is an ellipse of eccentricity 1/n whose far focus is the origin. Its back is a circle around the origin,
    which the rays meet at right angles. ValueError for n ≤ 1, a thickness ≥ the focal length, and as for `lens`.
    """
    if not n > 1 or not 0 < thickness < focal_length:
        raise ValueError(f"n = {n:g}, thickness = {thickness:g}; expected n > 1, 0 < thickness < {focal_length:g}")
    eccentricity = 1 / n
    curvature = 1 / (focal_length * (1 - eccentricity)), 1 / (focal_length - thickness)
    return lens(curvature, thickness, radius=radius, conic=(-(eccentricity**2), 0.0), vertex=-focal_length)


def luneburg(radius: float, layers: int) -> list[tuple[Curve, float]]:
    """Concentric circles, the largest first, each with the ratio of its index inside to the index around the lens.

    n(r) = √(2 − (r/R)²) in layers of equal steps in n²; each layer has the n² in the middle of its step.
    """
    circles = [circle(radius * math.sqrt(1 - j / layers)) for j in range(layers)]
    return [(curve, math.sqrt(1 + (j + 0.5) / layers)) for j, curve in enumerate(circles)]
