"""Where a ray in the plane meets directed arcs of conics, straight segments among them. No optics.

An arc from A to B with control point C and weight w is ((1−t)² A + 2w t(1−t) C + t² B) / ((1−t)² + 2w t(1−t) + t²).
With s : r = 1−t : t and f(V) = d × (V − p) as for straight segments, the ray's line meets it where

    f(A) s² + 2 w f(C) s r + f(B) r² = 0.

The signs of f(A) and f(B) say here, too, how many crossings there are, except for a ray that may touch the arc between
its ends.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from mi_refract.numerics import Mask, Number, ieee_divide

from .array_backend import ArrayBackend, Index, Vector2, Vertices, negated
from .intersect_segments import NOWHERE, SIGN, Hit, LineSegments, Ray, Start, bounding_box, cross
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
        (a, b, _), (c, w, turn) = self._of(ray.own, there), self._shape(ray.own, there)
        s, r = self._shares(ray)
        chords = _chord(a, c, b, w, s, r), _chord(b, c, a, w, r, s)
        to_c = ((c - a) * (s * s) + (c - b) * (r * r)) * dr.rcp(_total(w, s, r))
        # The sides of the ends are those of the chords: their product also says where the line meets the arc again.
        g_a, g_b = self._chord_sides(ray, chords)
        again = there & (turn != 0) & ((g_a >= 0) == (g_b >= 0)) & (ray.left == (turn > 0))
        line, straight = super().start(ray), turn == 0
        ways = (dr.select(straight, x, -way * y) for x, way, y in zip(line.ways, chords, (r, s), strict=True))
        sides = dr.select(straight, line.sides[0], g_a * r), dr.select(straight, line.sides[1], g_b * s)
        bend = turn * dr.rcp(w * w)
        others = to_c, (dr.abs(g_b), dr.abs(g_a)), again, (c - a, c - b), (bend, -bend)
        return Start(line.vertices, tuple(ways), sides, *others)

    def _chord_sides(self, ray: Ray, chords: tuple[Vector2, Vector2]) -> tuple[Number, Number]:
        """−d × chord for both ends of the arc on which the ray starts.

        Where the ends are on either side of a ray that leaves to the left, the arc starts on the left. Rounding that
        says otherwise is mended in the smaller of both.
        """
        sizes = [dr.maximum(dr.abs(cross(ray.d, way)), SIGN * (dr.abs(way.x) + dr.abs(way.y))) for way in chords]
        a_left, b_left = (cross(ray.d, way) <= 0 for way in chords)
        wrong = (a_left != b_left) & (a_left != ray.left)
        smaller = sizes[0] < sizes[1]
        a_left = dr.select(wrong & smaller, ray.left, a_left)
        b_left = dr.select(wrong & negated(smaller), negated(ray.left), b_left)
        return dr.select(a_left, sizes[0], -sizes[0]), dr.select(b_left, sizes[1], -sizes[1])

    def none(self) -> Hit:
        """No crossing, at distance ∞."""
        hit = super().none()
        hit.into, hit.bend = hit.along, self.arrays.number(0)
        return hit

    def nearer(self, best: Hit, ray: Ray, start: Start, i: Index, active: Mask = True) -> Hit:
        """The first crossing of arc i, if it comes before `best`."""
        (a, b, vertices), (c, w, turn) = self._of(i, active), self._shape(i, active)
        seen = self._seen(ray, start, vertices[0], a), self._seen(ray, start, vertices[1], b)
        line, line_ahead = self._crossing(ray, start, i, b - a, vertices, seen)
        line.into, line.bend = line.along, self.arrays.number(0)
        (to_a, f_a), (to_b, f_b) = seen
        own, straight = i == ray.own, turn == 0
        to_c = dr.select(own, start.middle, c - ray.p)
        a_left = f_a >= 0
        once = a_left != (f_b >= 0)
        ends = *_ends(once, a_left, vertices, (a, c, b)), dr.select(a_left, turn, -turn) * dr.rcp(w * w)
        (one, valid), (other, too) = _roots(f_a, w * cross(ray.d, to_c), f_b)
        single = once & too
        root = (dr.select(own, x, dr.select(single, z, y)) for x, y, z in zip(start.other, one, other, strict=True))
        ways = to_a, to_c, to_b
        hit, ahead = self._hit(ray, i, ways, w, tuple(root), dr.select(own, turn < 0, a_left), ends)
        hit, ahead = dr.select(straight, line, hit), dr.select(straight, line_ahead, ahead)
        ahead = self._beyond(start, hit, ahead) & dr.select(straight, once, valid | single)
        ahead = dr.select(own, start.again, ahead) & active
        best = dr.select(ahead & self._before(hit, best), hit, best)
        # Where there are two crossings, neither is at a vertex, but for rounding: their distances decide.
        hit, ahead = self._hit(ray, i, ways, w, other, negated(a_left), ends)
        ahead &= active & too & negated(once | own | straight)
        return dr.select(ahead & (hit.distance < best.distance), hit, best)

    def _beyond(self, start: Start, hit: Hit, ahead: Mask) -> Mask:
        """Whether a hit is ahead of the ray's start, which may be at a vertex that both curves share.

        Where rounding hides the distance, that is decided there as in `_before`.
        """
        lefts = [side >= 0 for side in start.sides]
        ons = [v == dr.select(left, hit.left, hit.right) for v, left in zip(start.vertices, lefts, strict=True)]

        def there(pair: tuple[Any, Any]) -> Any:
            return dr.select(ons[0], *pair)

        left, way, away, bend = there(tuple(lefts)), there(start.ways), there(start.aways), there(start.bends)
        own, other = dr.select(left, away, -away), dr.select(left, hit.along, hit.into)
        near = dr.abs(hit.distance) <= 64 * self.arrays.roundoff * (dr.abs(way.x) + dr.abs(way.y))
        near &= (ons[0] | ons[1]) & (dr.dot(own, other) > 0) & ((bend != 0) | (hit.bend != 0))
        first = self._turned(other, own, (hit.bend, dr.select(left, bend, -bend)), dr.select(left, -1, 1))
        return dr.select(near, negated(first), ahead)

    def _hit(
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
        """Whether `hit` comes before `best`: by distance, but by direction at a vertex that both share.

        Where the arcs touch in that vertex, their curvatures decide: the one farther to the left, seen from the left
        vertex to the right one, comes later.
        """
        first, second = hit.distance, best.distance
        tie = dr.abs(first - second) <= 16 * self.arrays.roundoff * dr.abs(first)
        lines = (hit.bend == 0) & (best.bend == 0)
        tie = (tie | lines) & (hit.left < UNKNOWN)
        right = self._turned(hit.into, best.into, (hit.bend, best.bend), 1)
        left = self._turned(hit.along, best.along, (hit.bend, best.bend), -1)
        before = dr.select(tie & (hit.right == best.right), right, first < second)
        return dr.select(tie & (hit.left == best.left), left, before)

    def _turned(self, e: Vector2, other: Vector2, bends: tuple[Number, Number], sign: Any) -> Mask:
        """Whether sign · e × other < 0; where that is 0 up to rounding, whether e has the smaller curvature."""
        sine, x, y = sign * cross(e, other), dr.norm(e), dr.norm(other)
        touching = dr.abs(sine) <= 64 * self.arrays.roundoff * x * y
        touching &= (bends[0] != 0) | (bends[1] != 0)
        return dr.select(touching, bends[0] * y * y * y < bends[1] * x * x * x, sine < 0)

    def place(self, hit: Hit) -> tuple[Vector2, Vector2]:
        """The point of a hit, from the nearer end, and the arc's unit direction there."""
        there = hit.segment != NOWHERE
        (a, b, _), (c, w, turn) = self._of(hit.segment, there), self._shape(hit.segment, there)
        s, r = hit.s, hit.r
        point = dr.select(r < s, dr.fma(_chord(a, c, b, w, s, r), r, a), dr.fma(_chord(b, c, a, w, r, s), s, b))
        e = _tangent(a, c, b, w, s, r)
        line = super().place(hit)
        return dr.select(turn == 0, line[0], point), dr.select(turn == 0, line[1], e * ieee_divide(1, dr.norm(e)))


def _roots(f_a: Number, f_c: Number, f_b: Number) -> tuple[tuple[Root, Mask], tuple[Root, Mask]]:
    """Both roots of the quadratic, f_c with the weight in it, and whether each is on the arc."""
    # The roots r/s are −f_a/h and −h/f_b, the smaller one first: |h|² ≥ |f_a f_b|.
    rest = dr.fma(f_c, f_c, -f_a * f_b)
    h = f_c + dr.mulsign(dr.sqrt(dr.maximum(rest, 0)), f_c)
    one, other = (dr.abs(h), dr.abs(f_a)), (dr.abs(f_b), dr.abs(h))
    return (one, (rest >= 0) & ((h >= 0) != (f_a >= 0))), (other, (rest >= 0) & ((h >= 0) != (f_b >= 0)))


def _ends(once: Mask, a_left: Mask, vertices: Vertices, points: Three) -> tuple[Index, Index, Vector2, Vector2]:
    """Left and right vertex of an arc that is crossed once (else UNKNOWN), its directions there, from left to right."""
    a, c, b = points
    left, right = (dr.select(once, dr.select(a_left, vertices[j], vertices[1 - j]), UNKNOWN + j) for j in (0, 1))
    return left, right, dr.select(a_left, c - a, c - b), dr.select(a_left, b - c, a - c)


def _total(w: Number, s: Number, r: Number) -> Number:
    """s² + 2 w s r + r²."""
    return dr.fma(2 * w * s, r, dr.fma(s, s, r * r))


def _chord(a: Vector2, c: Vector2, b: Vector2, w: Number, s: Number, r: Number) -> Vector2:
    """The vector from the end `a` to the place on the arc, over r."""
    return ((c - a) * (2 * w * s) + (b - a) * r) * dr.rcp(_total(w, s, r))


def _tangent(a: Vector2, c: Vector2, b: Vector2, w: Number, s: Number, r: Number) -> Vector2:
    """The arc's direction at a place, from `a` to `b`, of any length."""
    return (c - a) * (w * s * s) + (b - a) * (s * r) + (b - c) * (w * r * r)
