"""Where a ray in the plane crosses directed segments, straight or arcs of conics: signs first, places after. No optics.

With the ray p + λd and a segment from A to B, f(V) = d × (V − p) says on which side of the ray a vertex lies; 0 counts
as its left. A and B on different sides: the ray's line crosses the segment once, at μ = f(A)/(f(A) − f(B)), and at

    λ = ((A − p) × (B − A)) / (d × (B − A))

which is document 004's solution (its μ has the sign of that denominator wrong). A vertex has one f, whichever segment
asks, so a line through it crosses what a line beside it would: nothing leaks. For a ray that starts on a segment the
differences V − p to its ends are formed along that segment, and their signs are those of the side to which the ray
goes. So rounding the point does not move it across a neighbour, however near.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.numerics import ieee_divide

from .array_backend import Lanes

NOWHERE = 0xFFFFFFFF
UNKNOWN = NOWHERE - 2  # from here on a number is no vertex
# A start is kept so far from the ends of its own segment, in shares of it, and its sides from 0, in units
# of its length: both are signs only.
LEAST = 1e-14
SIGN = 1e-22


def cross(a: Any, b: Any) -> Any:
    return dr.fma(a.x, b.y, -(a.y * b.x))


@dataclass
class Ray:
    """From `p` along `d`. `own`: the segment that it starts on, or NOWHERE, at start + r (end − start), r = 1 − s.

    It leaves to the `left` of it, or not. `slack`: a boundary no farther than rounding from `p` is not ahead; 0 for a
    ray that starts on a segment.
    """

    p: Any
    d: Any
    own: Any
    s: Any
    r: Any
    left: Any
    slack: Any


@dataclass
class Start:
    """What is known of a ray's start once a query: vertices of its own segment, the way to them, and their sides."""

    vertices: Any
    ways: tuple[Any, Any]
    sides: tuple[Any, Any]
    middle: Any = None  # the way to the control point of an arc
    turn: Any = None


@dataclass
class Hit:
    """The first crossing found. `segment` is NOWHERE where there is none; `s`, `r` place it as in `Ray`."""

    distance: Any
    segment: Any
    s: Any
    r: Any
    to_left: Any  # the ray goes on to the left of the segment
    left: Any  # the vertex on the left of the ray, the one on its right
    right: Any
    along: Any  # the segment's direction, from its left vertex to its right one
    into: Any = None  # of an arc, at its right vertex; `along` is that at its left one
    bend: Any = None  # of an arc: its curvature at a vertex, positive to the left, times the cube of `along` or `into`


def _box(*points: Any) -> tuple[list[float], list[float]]:
    """Corners of a box half as wide again as what holds the points."""
    places = np.concatenate(points)
    low, high = places.min(axis=0), places.max(axis=0)
    margin = (high - low).max() / 4
    return (low - margin).tolist(), (high + margin).tolist()


def _inside(ray: Ray) -> tuple[Any, Any]:
    return dr.maximum(ray.s, LEAST), dr.maximum(ray.r, LEAST)


class Straight:
    """Straight segments; `vertices` (M × 2) name equal ends by equal numbers."""

    def __init__(self, lanes: Lanes, start: Any, end: Any, vertices: Any) -> None:
        self.lanes, self.count, self.box = lanes, len(start), _box(start, end)
        self.ends = lanes.table(np.concatenate([start, end], 1))
        self.vertices = lanes.table(vertices.astype(np.uint32))
        e = end - start
        self.directions = lanes.table(e / np.maximum(np.linalg.norm(e, axis=1, keepdims=True), np.finfo(float).tiny))

    def _of(self, i: Any, active: Any = True) -> tuple[Any, Any, Any]:
        """Start, end and vertices of segment i."""
        ends, vector = self.lanes.gather(self.ends, i, active), self.lanes.vector
        return vector(ends[0], ends[1]), vector(ends[2], ends[3]), self.lanes.gather(self.vertices, i, active)

    def start(self, ray: Ray) -> Start:
        a, b, vertices = self._of(ray.own, ray.own != NOWHERE)
        s, r, e = *_inside(ray), b - a
        return Start(self._own(ray, vertices), (-e * r, e * s), self._sides(ray, e, s, r))

    def _own(self, ray: Ray, vertices: Any) -> Any:
        return type(vertices)(*(dr.select(ray.own != NOWHERE, v, NOWHERE) for v in vertices))

    def _sides(self, ray: Ray, e: Any, s: Any, r: Any) -> tuple[Any, Any]:
        """Seen by a ray that leaves to the left of a segment, its start is on the left and its end on the right."""
        size = dr.maximum(dr.abs(cross(ray.d, e)), SIGN * (dr.abs(e.x) + dr.abs(e.y)))
        size = dr.select(ray.left, size, -size)
        return size * r, -size * s

    def none(self) -> Hit:
        number, index, zero = self.lanes.number, self.lanes.index, self.lanes.vector(0)
        nowhere = index(NOWHERE)
        return Hit(number(dr.inf), nowhere, number(0), number(0), self.lanes.mask(False), nowhere, nowhere, zero)

    def _seen(self, ray: Ray, start: Start, vertex: Any, place: Any) -> tuple[Any, Any]:
        """The way from the ray's start to a vertex, and on which side of the ray that is."""
        way = place - ray.p
        side = cross(ray.d, way)
        for own, its_way, its_side in zip(start.vertices, start.ways, start.sides, strict=True):
            same = vertex == own
            way, side = dr.select(same, its_way, way), dr.select(same, its_side, side)
        return way, side

    def nearer(self, best: Hit, ray: Ray, start: Start, i: Any, active: Any = True) -> Hit:
        """The crossing of segment i, if it comes before `best`."""
        a, b, vertices = self._of(i, active)
        e = b - a
        (to_a, f_a), (to_b, f_b) = (self._seen(ray, start, v, x) for v, x in ((vertices[0], a), (vertices[1], b)))
        a_left, b_left = f_a >= 0, f_b >= 0
        way = dr.select((vertices[1] == start.vertices[0]) | (vertices[1] == start.vertices[1]), to_b, to_a)
        # |d × e| = |f_a| + |f_b| without cancellation, and λ times it, whose sign is right where λ itself is lost.
        scale = dr.abs(f_a) + dr.abs(f_b)
        reach = dr.select(a_left, -1, 1) * cross(way, e)
        # The crossing is between the ends: where both are ahead, or both behind, so is it. That decides along a
        # segment, whose line is no farther than rounding, so that the sign of `reach` is noise.
        t_a, t_b = dr.dot(to_a, ray.d), dr.dot(to_b, ray.d)
        beyond = (dr.maximum(t_a, t_b) > 0) & (reach > ray.slack * (dr.abs(e.x) + dr.abs(e.y)))
        ahead = (a_left != b_left) & ((dr.minimum(t_a, t_b) > ray.slack) | beyond) & (i != ray.own) & active
        near = ieee_divide(dr.minimum(dr.abs(f_a), dr.abs(f_b)), scale)
        s, r = (dr.select(dr.abs(f) < 0.5 * scale, near, 1 - near) for f in (f_b, f_a))
        distance = dr.dot(dr.fma(e, r, to_a), ray.d)  # λ again: that quotient would be noise at grazing incidence
        left, right = (dr.select(a_left, vertices[j], vertices[1 - j]) for j in (0, 1))
        along = dr.select(a_left, e, -e)
        # Of two segments that share a vertex the turn between them says which comes first, whatever λ rounds to.
        turn = cross(along, best.along)
        first = dr.select(right == best.right, turn < 0, distance < best.distance)
        first = ahead & dr.select(left == best.left, turn > 0, first)
        found = Hit(distance, i, s, r, a_left, left, right, along)
        return dr.select(first, found, best)

    def place(self, hit: Hit) -> tuple[Any, Any]:
        """The point of a hit, from the nearer end, and the segment's direction there."""
        there = hit.segment != NOWHERE
        a, b, _ = self._of(hit.segment, there)
        e = b - a
        point = dr.select(hit.r < hit.s, dr.fma(e, hit.r, a), dr.fma(e, -hit.s, b))
        return point, self.lanes.gather(self.directions, hit.segment, there)


class Arcs(Straight):
    """Arcs of conics, straight segments among them; see `planar.Segments` for their form.

    In the ray's frame the arc is f(A) s² + 2 w f(C) s r + f(B) r² = 0, C the control point: signs tell here, too, how
    many crossings there are, but for those of a ray that may touch the arc between its ends.
    """

    def __init__(self, lanes: Lanes, start: Any, end: Any, vertices: Any, control: Any, weight: Any) -> None:
        super().__init__(lanes, start, end, vertices)
        self.box = _box(start, end, control)
        (ax, ay), (bx, by) = (control - start).T, (end - control).T
        middle = (start + end) / 2
        turn = np.where((control == middle).all(1), 0.0, ax * by - ay * bx)
        # A straight one counts along it in equal steps, whatever it says.
        control, weight = np.where(turn[:, None] == 0, middle, control), np.where(turn == 0, 1.0, weight)
        self.shapes = lanes.table(np.column_stack([control, weight, turn]))

    def _shape(self, i: Any, active: Any = True) -> tuple[Any, Any, Any]:
        """Control point, weight and turn; the turn of a straight segment is 0."""
        shape = self.lanes.gather(self.shapes, i, active)
        return self.lanes.vector(shape[0], shape[1]), shape[2], shape[3]

    def start(self, ray: Ray) -> Start:
        there = ray.own != NOWHERE
        (a, b, vertices), (c, w, turn) = self._of(ray.own, there), self._shape(ray.own, there)
        s, r = _inside(ray)
        to_a, to_b = -_bend(a, c, b, w, s, r), -_bend(b, c, a, w, r, s)
        to_c = ((c - a) * (s * s) + (c - b) * (r * r)) * dr.rcp(_total(w, s, r))
        straight = self._sides(ray, b - a, s, r)
        sides = (dr.select(turn == 0, x, cross(ray.d, way)) for x, way in zip(straight, (to_a, to_b), strict=True))
        return Start(self._own(ray, vertices), (to_a, to_b), tuple(sides), to_c, turn)

    def none(self) -> Hit:
        hit = super().none()
        hit.into, hit.bend = hit.along, self.lanes.number(0)
        return hit

    def nearer(self, best: Hit, ray: Ray, start: Start, i: Any, active: Any = True) -> Hit:
        (a, b, vertices), (c, w, turn) = self._of(i, active), self._shape(i, active)
        (to_a, f_a), (to_b, f_b) = (self._seen(ray, start, v, x) for v, x in zip(vertices, (a, b), strict=True))
        own = i == ray.own
        to_c = dr.select(own, start.middle, c - ray.p)
        f_c = dr.select(turn == 0, 0.5 * (f_a + f_b), w * cross(ray.d, to_c))
        a_left, b_left = f_a >= 0, f_b >= 0
        # The roots r/s are −f_a/h and −h/f_b, the smaller one first: |h|² ≥ |f_a f_b|.
        rest = dr.fma(f_c, f_c, -f_a * f_b)
        h = f_c + dr.mulsign(dr.sqrt(dr.maximum(rest, 0)), f_c)
        crossed = (rest >= 0) & (i != ray.own)
        h_left = h >= 0
        # The other root of the arc on which the ray starts: their product is f_a/f_b.
        again = own & (a_left == b_left) & (turn != 0) & (ray.left == (turn > 0))
        small = dr.select(own, dr.abs(f_b) * ray.r, dr.abs(h)), dr.select(own, dr.abs(f_a) * ray.s, dr.abs(f_a))
        large = dr.abs(f_b), dr.abs(h)
        once = a_left != b_left
        ends = *_ends(once, a_left, vertices, (a, c, b)), dr.select(a_left, turn, -turn) * dr.rcp(w * w)
        for root, valid, to_left in (
            (small, again | (crossed & (h_left != a_left)), dr.select(own, turn < 0, a_left)),
            (large, crossed & (h_left != b_left), f_a < 0),
        ):
            to_left = dr.select(once, a_left, to_left)
            found, ahead = self._found(ray, i, (to_a, to_c, to_b), w, root, to_left, ends)
            best = dr.select(valid & active & ahead & self._before(found, best), found, best)
        return best

    def _found(self, ray: Ray, i: Any, ways: Any, w: Any, root: Any, to_left: Any, ends: Any) -> tuple[Hit, Any]:
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

    def _before(self, hit: Hit, best: Hit) -> Any:
        """Where both are one place to rounding, a vertex that the arcs share, their directions there decide.

        Where they touch in it their curvatures do: the one farther to the left, seen from left to right, comes later.
        """
        first, second = hit.distance, best.distance
        tie = dr.abs(first - second) <= 16 * self.lanes.roundoff * dr.abs(first)
        tie &= hit.left < UNKNOWN
        right = self._turned(hit.into, best.into, hit, best, 1)
        left = self._turned(hit.along, best.along, hit, best, -1)
        before = dr.select(tie & (hit.right == best.right), right, first < second)
        return dr.select(tie & (hit.left == best.left), left, before)

    def _turned(self, e: Any, other: Any, hit: Hit, best: Hit, sign: int) -> Any:
        """Whether sign · e × other < 0, by more than rounding, or else whether the hit's curvature is the lesser."""
        sine, x, y = sign * cross(e, other), dr.norm(e), dr.norm(other)
        touching = dr.abs(sine) <= 64 * self.lanes.roundoff * x * y
        return dr.select(touching, hit.bend * y * y * y < best.bend * x * x * x, sine < 0)

    def place(self, hit: Hit) -> tuple[Any, Any]:
        there = hit.segment != NOWHERE
        (a, b, _), (c, w, _) = self._of(hit.segment, there), self._shape(hit.segment, there)
        s, r = hit.s, hit.r
        point = dr.select(r < s, a + _bend(a, c, b, w, s, r), b + _bend(b, c, a, w, r, s))
        e = _tangent(a, c, b, w, s, r)
        return point, e * ieee_divide(1, dr.norm(e))


def _ends(once: Any, a_left: Any, vertices: Any, points: Any) -> tuple[Any, Any, Any, Any]:
    """Of an arc that is crossed once: its left and right vertex, and its directions there, from left to right."""
    a, c, b = points
    left, right = (dr.select(once, dr.select(a_left, vertices[j], vertices[1 - j]), UNKNOWN + j) for j in (0, 1))
    return left, right, dr.select(a_left, c - a, c - b), dr.select(a_left, b - c, a - c)


def _total(w: Any, s: Any, r: Any) -> Any:
    return dr.fma(2 * w * s, r, dr.fma(s, s, r * r))


def _bend(a: Any, c: Any, b: Any, w: Any, s: Any, r: Any) -> Any:
    """From the end `a` to the place on the arc."""
    return ((c - a) * (2 * w * s * r) + (b - a) * (r * r)) * dr.rcp(_total(w, s, r))


def _tangent(a: Any, c: Any, b: Any, w: Any, s: Any, r: Any) -> Any:
    """The arc's direction at a place, from `a` to `b`, not normalised."""
    return (c - a) * (w * s * s) + (b - a) * (s * r) + (b - c) * (w * r * r)
