"""Where a ray in the plane meets directed arcs of conics, straight segments among them. No optics.

An arc from A to B with control point C and weight w is ((1−t)² A + 2w t(1−t) C + t² B) / ((1−t)² + 2w t(1−t) + t²).
With s : r = 1−t : t and f(V) = d × (V − p) as for straight segments, the ray's line meets it where

    f(A) s² + 2 w f(C) s r + f(B) r² = 0.

The signs of f(A) and f(B) say here, too, how many crossings there are, except for a ray that may touch the arc between
its ends.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.numerics import Mask, Number, ieee_divide

from .array_backend import ArrayBackend, Index, Vector2, Vertices
from .intersect_segments import NOWHERE, Hit, LineSegments, Ray, Start, bounding_box, cross, start_shares
from .segments import Array

UNKNOWN = NOWHERE - 2  # from here on a number is no vertex
Root = tuple[Number, Number]  # s and r, up to a common factor
Three = tuple[Any, Any, Any]  # of the start, the control point and the end
Ends = tuple[Index, Index, Vector2, Vector2, Number]  # the last five fields of `Hit`


class ConicArcs(LineSegments):
    """M arcs as in `planar.Segments`: as `LineSegments`, with `control` (M × 2) and `weight` (M)."""

    def __init__(
        self, arrays: ArrayBackend, start: Array, end: Array, vertices: Vertices, control: Array, weight: Array
    ) -> None:
        """Copy them to the backend."""
        super().__init__(arrays, start, end, vertices)
        self.box = bounding_box(start, end, control)
        (ax, ay), (bx, by) = (control - start).T, (end - control).T
        middle = (start + end) / 2
        turn = np.where((control == middle).all(1), 0.0, ax * by - ay * bx)
        # A straight one has r in equal steps along it, whatever control and weight it was given.
        control, weight = np.where(turn[:, None] == 0, middle, control), np.where(turn == 0, 1.0, weight)
        self.shapes = arrays.table(np.column_stack([control, weight, turn]))

    def _shape(self, i: Index, active: Mask = True) -> tuple[Vector2, Number, Number]:
        """Control point, weight and turn; the turn of a straight segment is 0."""
        shape = self.arrays.gather(self.shapes, i, active)
        return self.arrays.vector(shape[0], shape[1]), shape[2], shape[3]

    def start(self, ray: Ray) -> Start:
        """Quantities of the ray's start, computed once per ray, not per arc."""
        there = ray.own != NOWHERE
        (a, b, vertices), (c, w, turn) = self._of(ray.own, there), self._shape(ray.own, there)
        s, r = start_shares(ray)
        to_a, to_b = -_bend(a, c, b, w, s, r), -_bend(b, c, a, w, r, s)
        to_c = ((c - a) * (s * s) + (c - b) * (r * r)) * dr.rcp(_total(w, s, r))
        straight = self._sides(ray, b - a, s, r)
        sides = (dr.select(turn == 0, x, cross(ray.d, way)) for x, way in zip(straight, (to_a, to_b), strict=True))
        return Start(self._own(ray, vertices), (to_a, to_b), tuple(sides), to_c, turn)

    def none(self) -> Hit:
        """No crossing, at distance ∞."""
        hit = super().none()
        hit.into, hit.bend = hit.along, self.arrays.number(0)
        return hit

    def nearer(self, best: Hit, ray: Ray, start: Start, i: Index, active: Mask = True) -> Hit:
        """The first crossing of arc i, if it comes before `best`."""
        (a, b, vertices), (c, w, turn) = self._of(i, active), self._shape(i, active)
        (to_a, f_a), (to_b, f_b) = (self._seen(ray, start, v, x) for v, x in zip(vertices, (a, b), strict=True))
        to_c = dr.select(i == ray.own, start.middle, c - ray.p)
        f_c = dr.select(turn == 0, 0.5 * (f_a + f_b), w * cross(ray.d, to_c))
        a_left = f_a >= 0
        once = a_left != (f_b >= 0)
        ends = *_ends(once, a_left, vertices, (a, c, b)), dr.select(a_left, turn, -turn) * dr.rcp(w * w)
        for root, valid, to_left in self._roots(ray, i, turn, (f_a, f_c, f_b)):
            to_left = dr.select(once, a_left, to_left)
            found, ahead = self._found(ray, i, (to_a, to_c, to_b), w, root, to_left, ends)
            best = dr.select(valid & active & ahead & self._before(found, best), found, best)
        return best

    def _roots(self, ray: Ray, i: Index, turn: Number, f: Three) -> Iterator[tuple[Root, Mask, Mask]]:
        """Both roots of the quadratic, whether each is on the arc, and whether the ray goes on to the left there."""
        f_a, f_c, f_b = f
        own, a_left, b_left = i == ray.own, f_a >= 0, f_b >= 0
        # The roots r/s are −f_a/h and −h/f_b, the smaller one first: |h|² ≥ |f_a f_b|.
        rest = dr.fma(f_c, f_c, -f_a * f_b)
        h = f_c + dr.mulsign(dr.sqrt(dr.maximum(rest, 0)), f_c)
        crossed = (rest >= 0) & (i != ray.own)
        h_left = h >= 0
        # The other root of the arc on which the ray starts: the product of both is f_a/f_b.
        again = own & (a_left == b_left) & (turn != 0) & (ray.left == (turn > 0))
        small = dr.select(own, dr.abs(f_b) * ray.r, dr.abs(h)), dr.select(own, dr.abs(f_a) * ray.s, dr.abs(f_a))
        yield small, again | (crossed & (h_left != a_left)), dr.select(own, turn < 0, a_left)
        yield (dr.abs(f_b), dr.abs(h)), crossed & (h_left != b_left), f_a < 0

    def _found(
        self, ray: Ray, i: Index, ways: Three, w: Number, root: Root, to_left: Mask, ends: Ends
    ) -> tuple[Hit, Mask]:
        """A root as a hit, and whether it is ahead."""
        s, r = root
        size = s + r
        s, r = ieee_divide(s, size), ieee_divide(r, size)
        to_a, to_c, to_b = ways
        way = (to_a * (s * s) + to_c * (2 * w * s * r) + to_b * (r * r)) * dr.rcp(_total(w, s, r))
        e = _tangent(to_a, to_c, to_b, w, s, r)
        distance = dr.dot(way, ray.d)
        ahead = distance * dr.abs(cross(ray.d, e)) > ray.slack * (dr.abs(e.x) + dr.abs(e.y))
        return Hit(distance, i, s, r, to_left, *ends), ahead & (distance > 0)

    def _before(self, hit: Hit, best: Hit) -> Mask:
        """Whether `hit` comes before `best`: by distance, but by direction at a vertex that both arcs share.

        Where the arcs touch in that vertex, their curvatures decide: the one farther to the left, seen from the left
        vertex to the right one, comes later.
        """
        first, second = hit.distance, best.distance
        tie = dr.abs(first - second) <= 16 * self.arrays.roundoff * dr.abs(first)
        tie &= hit.left < UNKNOWN
        right = self._turned(hit.into, best.into, hit, best, 1)
        left = self._turned(hit.along, best.along, hit, best, -1)
        before = dr.select(tie & (hit.right == best.right), right, first < second)
        return dr.select(tie & (hit.left == best.left), left, before)

    def _turned(self, e: Vector2, other: Vector2, hit: Hit, best: Hit, sign: int) -> Mask:
        """Whether sign · e × other < 0; where that is 0 up to rounding, whether the hit has the smaller curvature."""
        sine, x, y = sign * cross(e, other), dr.norm(e), dr.norm(other)
        touching = dr.abs(sine) <= 64 * self.arrays.roundoff * x * y
        return dr.select(touching, hit.bend * y * y * y < best.bend * x * x * x, sine < 0)

    def place(self, hit: Hit) -> tuple[Vector2, Vector2]:
        """The point of a hit, from the nearer end, and the arc's unit direction there."""
        there = hit.segment != NOWHERE
        (a, b, _), (c, w, _) = self._of(hit.segment, there), self._shape(hit.segment, there)
        s, r = hit.s, hit.r
        point = dr.select(r < s, a + _bend(a, c, b, w, s, r), b + _bend(b, c, a, w, r, s))
        e = _tangent(a, c, b, w, s, r)
        return point, e * ieee_divide(1, dr.norm(e))


def _ends(once: Mask, a_left: Mask, vertices: Vertices, points: Three) -> tuple[Index, Index, Vector2, Vector2]:
    """Left and right vertex of an arc that is crossed once (else UNKNOWN), its directions there, from left to right."""
    a, c, b = points
    left, right = (dr.select(once, dr.select(a_left, vertices[j], vertices[1 - j]), UNKNOWN + j) for j in (0, 1))
    return left, right, dr.select(a_left, c - a, c - b), dr.select(a_left, b - c, a - c)


def _total(w: Number, s: Number, r: Number) -> Number:
    """s² + 2 w s r + r²."""
    return dr.fma(2 * w * s, r, dr.fma(s, s, r * r))


def _bend(a: Vector2, c: Vector2, b: Vector2, w: Number, s: Number, r: Number) -> Vector2:
    """The vector from the end `a` to the place on the arc."""
    return ((c - a) * (2 * w * s * r) + (b - a) * (r * r)) * dr.rcp(_total(w, s, r))


def _tangent(a: Vector2, c: Vector2, b: Vector2, w: Number, s: Number, r: Number) -> Vector2:
    """The arc's direction at a place, from `a` to `b`, of any length."""
    return (c - a) * (w * s * s) + (b - a) * (s * r) + (b - c) * (w * r * r)
