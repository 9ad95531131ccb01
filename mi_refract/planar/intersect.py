"""Intersect a ray in the plane with directed segments and arcs of conics: first by signs, then by distances. No optics.

For a ray p + λd, f(V) = d × (V − p) gives the side of the ray on which a vertex V lies; 0 counts as its left. If the
ends A and B of a segment lie on different sides, the ray's line crosses the segment once, at μ = f(A)/(f(A) − f(B)) and

    λ = ((A − p) × (B − A)) / (d × (B − A))

which is document 004's solution (its μ has the sign of that denominator wrong). All segments that share a vertex use
the same f of it, so no ray slips through between them. For a ray that starts on a segment, the differences V − p to the
ends of that segment are computed along it, and their signs are those of the side to which the ray goes. So the rounding
of p does not carry the ray across a neighbour, however near.

An arc from A to B with control point C and weight w is ((1−t)² A + 2w t(1−t) C + t² B) / ((1−t)² + 2w t(1−t) + t²).
With s : r = 1−t : t the ray's line meets it where f(A) s² + 2 w f(C) s r + f(B) r² = 0. Here, too, the signs of f(A)
and f(B) give the number of crossings, except for a ray that may touch the arc between its ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.numerics import Mask, Number, ieee_divide

from .array_backend import ArrayBackend, Index, Vector2, Vertices, negated
from .segments import Segments

NOWHERE = 0xFFFFFFFF  # no segment
# For a ray that starts on a segment: least distance of the segment's ends from the ray, in units of its length.
SIGN = 1e-22
UNKNOWN = NOWHERE - 2  # numbers from here on are no vertex
Root = tuple[Number, Number]  # s and r, up to a common factor
Three = tuple[Any, Any, Any]  # for the start, the control point and the end
Ends = tuple[Index, Index, Vector2, Vector2, Number]  # the last five fields of `Hit`


def cross(a: Vector2, b: Vector2) -> Number:
    """a × b = a.x b.y − a.y b.x."""
    return dr.fma(a.x, b.y, -(a.y * b.x))


def norm_1(v: Vector2) -> Number:
    """|v.x| + |v.y|."""
    return dr.abs(v.x) + dr.abs(v.y)


@dataclass
class Ray:
    """A ray from `p` along the unit vector `d`.

    own: the segment that it starts on, at start + r (end − start) with r = 1 − s; NOWHERE if it starts on none.
    left: whether it leaves to the left of that segment.
    rounding: a boundary that is closer to `p` than this share of the coordinates, and of the vectors from `p` to the
    boundary's ends, is not ahead; 0 for a ray that starts on a segment.
    """

    p: Vector2
    d: Vector2
    own: Index
    s: Number
    r: Number
    left: Mask
    rounding: Number


@dataclass
class Start:
    """The segment that a ray starts on.

    vertices, vectors, sides: for both ends, the number of the vertex, the vector from p to it, and f of it.
    For an arc also:
    to_control: the vector from p to the control point.
    second_root: s and r, up to a common factor, where the ray's line meets the arc once more.
    second_ahead: whether that place is ahead and between the arc's ends.
    outward, bends: the direction of the arc away from either vertex, and its `bend` there as in `Hit`.
    """

    vertices: Vertices
    vectors: tuple[Vector2, Vector2]
    sides: tuple[Number, Number]
    to_control: Vector2 = None
    second_root: tuple[Number, Number] = None, None
    second_ahead: Mask = False
    outward: tuple[Vector2, Vector2] = None, None
    bends: tuple[Number, Number] = None, None


View = tuple[Vector2, Number]  # the vector from the ray's start to a vertex, and f of it


@dataclass
class Hit:
    """A crossing of a ray and a segment.

    segment: NOWHERE if there is no crossing. s, r: the place on the segment, as in `Ray`.
    to_left: whether the ray goes on to the left of the segment.
    left, right: numbers of the vertices on the left and on the right of the ray.
    along, into: the segment's direction, from its left vertex to its right one, at the left and at the right vertex.
    bend: of an arc, twice the curvature at a vertex times the cube of |along| or |into|, positive to the left; else 0.
    """

    distance: Number
    segment: Index
    s: Number
    r: Number
    to_left: Mask
    left: Index
    right: Index
    along: Vector2
    into: Vector2
    bend: Number


class LineSegments:
    """M straight segments.

    box: the lower and the upper corner of a box around them, with a quarter of its size added on each side.
    """

    def __init__(self, arrays: ArrayBackend, segments: Segments) -> None:
        """Copy them to the backend."""
        self.arrays, self.count = arrays, arrays.uniform(arrays.index, len(segments))
        places = np.concatenate([segments.start, segments.end, segments.control])
        low, high = places.min(axis=0), places.max(axis=0)
        margin = (high - low).max() / 4
        self.box = (low - margin).tolist(), (high + margin).tolist()
        self.ends = arrays.table(np.concatenate([segments.start, segments.end], 1))
        self.vertices = arrays.table(segments.vertices)
        e = segments.end - segments.start
        self.directions = arrays.table(e / np.maximum(np.linalg.norm(e, axis=1, keepdims=True), np.finfo(float).tiny))

    def _segment(self, i: Index, active: Mask = True) -> tuple[Vector2, Vector2, Vertices]:
        """Start, end and vertices of segment i."""
        ends, vector = self.arrays.gather(self.ends, i, active), self.arrays.vector
        return vector(ends[0], ends[1]), vector(ends[2], ends[3]), self.arrays.gather(self.vertices, i, active)

    def start(self, ray: Ray) -> Start:
        """Quantities of the ray's start, computed once per ray, not per segment."""
        a, b, vertices = self._segment(ray.own, ray.own != NOWHERE)
        (s, r), e = self._shares(ray), b - a
        own = type(vertices)(*(dr.select(ray.own != NOWHERE, v, NOWHERE) for v in vertices))
        # f of both ends: if the ray leaves to the left, the segment starts on its left and ends on its right.
        size = dr.maximum(dr.abs(cross(ray.d, e)), SIGN * norm_1(e))
        size = dr.select(ray.left, size, -size)
        return Start(own, (-e * r, e * s), (size * r, -size * s))

    def _shares(self, ray: Ray) -> tuple[Number, Number]:
        """s and r of the ray's start, at least u²: so signs are known at the ends too. Distances do not change."""
        least = self.arrays.roundoff**2
        return dr.maximum(ray.s, least), dr.maximum(ray.r, least)

    def none(self) -> Hit:
        """A `Hit` without a segment, at distance ∞."""
        number, nowhere, zero = self.arrays.number, self.arrays.index(NOWHERE), self.arrays.vector(0)
        left = self.arrays.mask(False)
        return Hit(number(dr.inf), nowhere, number(0), number(0), left, nowhere, nowhere, zero, zero, number(0))

    def _view(self, ray: Ray, start: Start, vertex: Index, place: Vector2) -> View:
        """The vector from the ray's start to a vertex, and f of it."""
        vector = place - ray.p
        side = cross(ray.d, vector)
        for own_vertex, own_vector, own_side in zip(start.vertices, start.vectors, start.sides, strict=True):
            same = vertex == own_vertex
            vector, side = dr.select(same, own_vector, vector), dr.select(same, own_side, side)
        return vector, side

    def nearer(self, best: Hit, ray: Ray, start: Start, i: Index, active: Mask = True) -> Hit:
        """The crossing of segment i, if it comes before `best`."""
        a, b, vertices = self._segment(i, active)
        views = self._view(ray, start, vertices[0], a), self._view(ray, start, vertices[1], b)
        hit, ahead = self._crossing(ray, start, i, b - a, vertices, views)
        # For two segments that share a vertex, the turn between them decides which comes first, however λ is rounded.
        turn = cross(hit.along, best.along)
        first = dr.select(hit.right == best.right, turn < 0, hit.distance < best.distance)
        first = ahead & active & dr.select(hit.left == best.left, turn > 0, first)
        return dr.select(first, hit, best)

    def _crossing(
        self, ray: Ray, start: Start, i: Index, e: Vector2, vertices: Vertices, views: tuple[View, View]
    ) -> tuple[Hit, Mask]:
        """The crossing of segment i, the vector e from start to end, and whether the crossing is ahead."""
        (to_a, f_a), (to_b, f_b) = views
        a_left, b_left = f_a >= 0, f_b >= 0
        to_end = dr.select((vertices[1] == start.vertices[0]) | (vertices[1] == start.vertices[1]), to_b, to_a)
        # |d × e| = |f_a| + |f_b| without cancellation. `reach` is λ times that; its sign is right where λ's may not be.
        scale: Number = dr.abs(f_a) + dr.abs(f_b)
        reach = dr.select(a_left, -1, 1) * cross(to_end, e)
        # The crossing lies between the ends: it is ahead if both ends are, and behind if both are. This decides for a
        # ray along the segment, where the sign of `reach` is noise.
        t_a, t_b = dr.dot(to_a, ray.d), dr.dot(to_b, ray.d)
        # The rounding of `reach` is below 4u times its two products. So a start a little above a long level segment is
        # not on it.
        noise = ray.rounding * (norm_1(ray.p) * norm_1(e) + dr.abs(to_end.x * e.y) + dr.abs(to_end.y * e.x))
        beyond = (dr.maximum(t_a, t_b) > 0) & (reach > noise)
        after = dr.minimum(t_a, t_b) > ray.rounding * (norm_1(ray.p) + norm_1(to_end))
        ahead = (a_left != b_left) & (after | beyond) & (i != ray.own)
        near = ieee_divide(dr.minimum(dr.abs(f_a), dr.abs(f_b)), scale)
        s, r = (dr.select(0.5 * scale > dr.abs(f), near, 1 - near) for f in (f_b, f_a))
        distance = dr.dot(dr.fma(e, r, to_a), ray.d)  # λ; reach/scale is noise at grazing incidence
        left, right = (dr.select(a_left, vertices[j], vertices[1 - j]) for j in (0, 1))
        along = dr.select(a_left, e, -e)
        return Hit(distance, i, s, r, a_left, left, right, along, along, self.arrays.number(0)), ahead

    def place(self, hit: Hit) -> tuple[Vector2, Vector2]:
        """The point of a hit, from the nearer end, and the segment's direction there."""
        exists = hit.segment != NOWHERE
        a, b, _ = self._segment(hit.segment, exists)
        e = b - a
        point = dr.select(hit.r < hit.s, dr.fma(e, hit.r, a), dr.fma(e, -hit.s, b))
        return point, self.arrays.gather(self.directions, hit.segment, exists)


class ConicArcs(LineSegments):
    """M segments, some of them arcs."""

    def __init__(self, arrays: ArrayBackend, segments: Segments) -> None:
        """Copy the segments to the backend."""
        super().__init__(arrays, segments)
        straight, middle = segments.turn == 0, (segments.start + segments.end) / 2
        # With this control point and weight, r is proportional to the distance along a straight segment.
        control, weight = np.where(straight[:, None], middle, segments.control), np.where(straight, 1, segments.weight)
        self.shapes = arrays.table(np.column_stack([control, weight, segments.turn]))

    def _shape(self, i: Index, active: Mask = True) -> tuple[Vector2, Number, Number]:
        """Control point, weight and turn; the turn of a straight segment is 0."""
        shape = self.arrays.gather(self.shapes, i, active)
        return self.arrays.vector(shape[0], shape[1]), shape[2], shape[3]

    def start(self, ray: Ray) -> Start:
        """Quantities of the ray's start, computed once per ray, not per arc."""
        exists = ray.own != NOWHERE
        (a, b, _), (c, w, turn) = self._segment(ray.own, exists), self._shape(ray.own, exists)
        s, r = self._shares(ray)
        chords = _chord(a, c, b, w, s, r), _chord(b, c, a, w, r, s)
        to_c = ((c - a) * (s * s) + (c - b) * (r * r)) * dr.rcp(_total(w, s, r))
        # The ends lie on the sides of the ray that the chords point to. Their product also gives the place where the
        # line meets the arc again.
        g_a, g_b = self._chord_sides(ray, chords)
        second_ahead = exists & (turn != 0) & ((g_a >= 0) == (g_b >= 0)) & (ray.left == (turn > 0))
        line, straight = super().start(ray), turn == 0
        vectors = (dr.select(straight, x, -chord * y) for x, chord, y in zip(line.vectors, chords, (r, s), strict=True))
        sides = dr.select(straight, line.sides[0], g_a * r), dr.select(straight, line.sides[1], g_b * s)
        bend = turn * dr.rcp(w * w)
        arc_fields = to_c, (dr.abs(g_b), dr.abs(g_a)), second_ahead, (c - a, c - b), (bend, -bend)
        return Start(line.vertices, tuple(vectors), sides, *arc_fields)

    def _chord_sides(self, ray: Ray, chords: tuple[Vector2, Vector2]) -> tuple[Number, Number]:
        """−d × chord for both ends of the arc on which the ray starts.

        If the ends are on different sides of a ray that leaves to the left, the arc starts on the left. If rounding
        contradicts that, the sign of the smaller value is changed.
        """
        sizes = [dr.maximum(dr.abs(cross(ray.d, v)), SIGN * norm_1(v)) for v in chords]
        a_left, b_left = (cross(ray.d, v) <= 0 for v in chords)
        wrong = (a_left != b_left) & (a_left != ray.left)
        smaller = sizes[0] < sizes[1]
        a_left = dr.select(wrong & smaller, ray.left, a_left)
        b_left = dr.select(wrong & negated(smaller), negated(ray.left), b_left)
        return dr.select(a_left, sizes[0], -sizes[0]), dr.select(b_left, sizes[1], -sizes[1])

    def nearer(self, best: Hit, ray: Ray, start: Start, i: Index, active: Mask = True) -> Hit:
        """The first crossing of arc i, if it comes before `best`."""
        (a, b, vertices), (c, w, turn) = self._segment(i, active), self._shape(i, active)
        views = self._view(ray, start, vertices[0], a), self._view(ray, start, vertices[1], b)
        line, line_ahead = self._crossing(ray, start, i, b - a, vertices, views)
        (to_a, f_a), (to_b, f_b) = views
        own, straight = i == ray.own, turn == 0
        to_c = dr.select(own, start.to_control, c - ray.p)
        a_left = f_a >= 0
        once = a_left != (f_b >= 0)
        # For an arc that is crossed once: its left and right vertex, its directions there from left to right, its bend.
        left, right = (dr.select(once, dr.select(a_left, vertices[j], vertices[1 - j]), UNKNOWN + j) for j in (0, 1))
        along, into = dr.select(a_left, c - a, c - b), dr.select(a_left, b - c, a - c)
        ends = left, right, along, into, dr.select(a_left, turn, -turn) * dr.rcp(w * w)
        # Both roots r/s of the quadratic, −f_a/h and −h/f_b, the smaller one first: |h|² ≥ |f_a f_b|.
        f_c = w * cross(ray.d, to_c)
        rest = dr.fma(f_c, f_c, -f_a * f_b)
        h = f_c + dr.mulsign(dr.sqrt(dr.maximum(rest, 0)), f_c)
        smaller, larger = (dr.abs(h), dr.abs(f_a)), (dr.abs(f_b), dr.abs(h))
        smaller_valid, larger_valid = (rest >= 0) & ((h >= 0) != a_left), (rest >= 0) & ((h >= 0) != (f_b >= 0))
        only_larger = once & larger_valid
        roots = zip(start.second_root, smaller, larger, strict=True)
        first_root = tuple(dr.select(own, x, dr.select(only_larger, z, y)) for x, y, z in roots)
        vectors = to_a, to_c, to_b
        hit, ahead = self._hit(ray, i, vectors, w, first_root, dr.select(own, turn < 0, a_left), ends)
        hit, ahead = dr.select(straight, line, hit), dr.select(straight, line_ahead, ahead)
        ahead = self._beyond(start, hit, ahead) & dr.select(straight, once, smaller_valid | only_larger)
        ahead = dr.select(own, start.second_ahead, ahead) & active
        best = dr.select(ahead & self._before(hit, best), hit, best)
        # Of two crossings, neither is at a vertex up to rounding: their distances decide.
        hit, ahead = self._hit(ray, i, vectors, w, larger, negated(a_left), ends)
        ahead &= active & larger_valid & negated(once | own | straight)
        return dr.select(ahead & (hit.distance < best.distance), hit, best)

    def _beyond(self, start: Start, hit: Hit, ahead: Mask) -> Mask:
        """Whether a hit is ahead of the ray's start; `ahead` is the answer from its distance.

        The ray may start at a vertex that both curves share. Where rounding hides the distance there, the directions
        and curvatures decide as in `_before`.
        """
        lefts = [side >= 0 for side in start.sides]
        shared = [v == dr.select(left, hit.left, hit.right) for v, left in zip(start.vertices, lefts, strict=True)]

        def at_shared(pair: tuple[Any, Any]) -> Any:
            return dr.select(shared[0], *pair)

        left, vector = at_shared(tuple(lefts)), at_shared(start.vectors)
        outward, bend = at_shared(start.outward), at_shared(start.bends)
        own, other = dr.select(left, outward, -outward), dr.select(left, hit.along, hit.into)
        near = dr.abs(hit.distance) <= 64 * self.arrays.roundoff * norm_1(vector)
        near &= (shared[0] | shared[1]) & (dr.dot(own, other) > 0) & ((bend != 0) | (hit.bend != 0))
        behind = self._turned(other, own, (hit.bend, dr.select(left, bend, -bend)), dr.select(left, -1, 1))
        return dr.select(near, negated(behind), ahead)

    def _hit(
        self, ray: Ray, i: Index, vectors: Three, w: Number, root: Root, to_left: Mask, ends: Ends
    ) -> tuple[Hit, Mask]:
        """The `Hit` of a root, and whether it is ahead."""
        s, r = root
        size = s + r
        s, r = ieee_divide(s, size), ieee_divide(r, size)
        to_a, to_c, to_b = vectors
        vector = _mean(to_a, to_c, to_b, w, s, r)
        e = _tangent(to_a, to_c, to_b, w, s, r)
        distance = dr.dot(vector, ray.d)
        noise = ray.rounding * (norm_1(ray.p) + _mean(norm_1(to_a), norm_1(to_c), norm_1(to_b), w, s, r))
        ahead = distance * dr.abs(cross(ray.d, e)) > noise * norm_1(e)
        return Hit(distance, i, s, r, to_left, *ends), ahead & (distance > 0)

    def _before(self, hit: Hit, best: Hit) -> Mask:
        """Whether `hit` comes before `best`: by distance, but by direction at a vertex that both share.

        If the arcs touch in that vertex, their curvatures decide: the arc farther to the left, seen from the left
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
        """Whether sign · e × other < 0; if that is 0 up to rounding, whether e has the smaller curvature."""
        sine, x, y = sign * cross(e, other), dr.norm(e), dr.norm(other)
        touching = dr.abs(sine) <= 64 * self.arrays.roundoff * x * y
        touching &= (bends[0] != 0) | (bends[1] != 0)
        # Both sides over x² y²: a product of five lengths would leave the range of float32.
        less = ieee_divide(bends[0], x * x) * y < ieee_divide(bends[1], y * y) * x
        return dr.select(touching, less, sine < 0)

    def place(self, hit: Hit) -> tuple[Vector2, Vector2]:
        """The point of a hit, from the nearer end, and the arc's unit direction there."""
        exists = hit.segment != NOWHERE
        (a, b, _), (c, w, turn) = self._segment(hit.segment, exists), self._shape(hit.segment, exists)
        s, r = hit.s, hit.r
        point = dr.select(r < s, dr.fma(_chord(a, c, b, w, s, r), r, a), dr.fma(_chord(b, c, a, w, r, s), s, b))
        e = _tangent(a, c, b, w, s, r)
        line = super().place(hit)
        return dr.select(turn == 0, line[0], point), dr.select(turn == 0, line[1], e * ieee_divide(1, dr.norm(e)))


def _total(w: Number, s: Number, r: Number) -> Number:
    """s² + 2 w s r + r²."""
    return dr.fma(2 * w * s, r, dr.fma(s, s, r * r))


def _mean(a: Any, c: Any, b: Any, w: Number, s: Number, r: Number) -> Any:
    """The place on the arc, or the mean of other values with the same weights."""
    return (a * (s * s) + c * (2 * w * s * r) + b * (r * r)) * dr.rcp(_total(w, s, r))


def _chord(a: Vector2, c: Vector2, b: Vector2, w: Number, s: Number, r: Number) -> Vector2:
    """The vector from the end `a` to the place on the arc, divided by r."""
    return ((c - a) * (2 * w * s) + (b - a) * r) * dr.rcp(_total(w, s, r))


def _tangent(a: Vector2, c: Vector2, b: Vector2, w: Number, s: Number, r: Number) -> Vector2:
    """The arc's direction at a place, from `a` to `b`, of any length."""
    return (c - a) * (w * s * s) + (b - a) * (s * r) + (b - c) * (w * r * r)
