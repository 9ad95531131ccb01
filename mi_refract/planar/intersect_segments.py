"""Where a ray in the plane meets straight directed segments: first by signs, then by distances. No optics.

Of a ray p + λd and a segment from A to B, f(V) = d × (V − p) says on which side of the ray a vertex V lies; 0 counts
as its left. If A and B lie on different sides, the ray's line crosses the segment once, at μ = f(A)/(f(A) − f(B)) and

    λ = ((A − p) × (B − A)) / (d × (B − A))

which is document 004's solution (its μ has the sign of that denominator wrong). All segments that share a vertex use
the same f of it, so no ray slips through between them. For a ray that starts on a segment, the differences V − p to the
ends of that segment are computed along it, and their signs are those of the side to which the ray goes. So the rounding
of p does not carry the ray across a neighbour, however near.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from mi_refract.numerics import Mask, Number, ieee_divide

from .array_backend import ArrayBackend, Index, Vector2, Vertices
from .segments import Array

NOWHERE = 0xFFFFFFFF  # the number of no segment
# Of a start on its own segment: the least distance of its ends from the ray, in units of the segment's length.
SIGN = 1e-22


def cross(a: Vector2, b: Vector2) -> Number:
    """a × b = a.x b.y − a.y b.x."""
    return dr.fma(a.x, b.y, -(a.y * b.x))


@dataclass
class Ray:
    """A ray from `p` along the unit vector `d`.

    own: the segment that it starts on, at start + r (end − start) with r = 1 − s; NOWHERE for none.
    left: whether it leaves to the left of that segment.
    slack: a boundary no farther from `p` than that is not ahead; 0 for a ray that starts on a segment.
    """

    p: Vector2
    d: Vector2
    own: Index
    s: Number
    r: Number
    left: Mask
    slack: Number


@dataclass
class Start:
    """The segment that a ray starts on: numbers of its vertices, the ways from p to them, their sides of the ray.

    Of an arc also the way to its control point, s and r (up to a common factor) of where the ray's line meets it once
    more, whether that is ahead, between the arc's ends, and as of a `Hit` the directions and `bend` from its vertices.
    """

    vertices: Vertices
    ways: tuple[Vector2, Vector2]
    sides: tuple[Number, Number]
    middle: Vector2 = None
    other: tuple[Number, Number] = None, None
    again: Mask = False
    aways: tuple[Vector2, Vector2] = None, None
    bends: tuple[Number, Number] = None, None


Seen = tuple[Vector2, Number]  # the way from the ray's start to a vertex, and f of it


@dataclass
class Hit:
    """A crossing. `segment` is NOWHERE where there is none; `s`, `r`: the place on it, as in `Ray`.

    to_left: the ray goes on to the left of the segment.
    left, right: numbers of the vertices on the left and on the right of the ray.
    along: the segment's direction, from its left vertex to its right one; of an arc at its left vertex.
    into: of an arc, the same at its right vertex.
    bend: of an arc, twice the curvature at a vertex times the cube of |along| or |into|, positive to the left.
    """

    distance: Number
    segment: Index
    s: Number
    r: Number
    to_left: Mask
    left: Index
    right: Index
    along: Vector2
    into: Vector2 = None
    bend: Number = None


def bounding_box(*points: Array) -> tuple[list[float], list[float]]:
    """Lower and upper corner of a box around the points (each N × 2), with a quarter of its size added on each side."""
    places = np.concatenate(points)
    low, high = places.min(axis=0), places.max(axis=0)
    margin = (high - low).max() / 4
    return (low - margin).tolist(), (high + margin).tolist()


class LineSegments:
    """M straight segments from `start` to `end` (M × 2); `vertices` (M × 2) are equal numbers for equal ends."""

    def __init__(self, arrays: ArrayBackend, start: Array, end: Array, vertices: Vertices) -> None:
        """Copy them to the backend."""
        self.arrays, self.count = arrays, arrays.uniform(arrays.index, len(start))
        self.box = bounding_box(start, end)
        self.ends = arrays.table(np.concatenate([start, end], 1))
        self.vertices = arrays.table(vertices.astype(np.uint32))
        e = end - start
        self.directions = arrays.table(e / np.maximum(np.linalg.norm(e, axis=1, keepdims=True), np.finfo(float).tiny))

    def _of(self, i: Index, active: Mask = True) -> tuple[Vector2, Vector2, Vertices]:
        """Start, end and vertices of segment i."""
        ends, vector = self.arrays.gather(self.ends, i, active), self.arrays.vector
        return vector(ends[0], ends[1]), vector(ends[2], ends[3]), self.arrays.gather(self.vertices, i, active)

    def start(self, ray: Ray) -> Start:
        """Quantities of the ray's start, computed once per ray, not per segment."""
        a, b, vertices = self._of(ray.own, ray.own != NOWHERE)
        (s, r), e = self._shares(ray), b - a
        own = type(vertices)(*(dr.select(ray.own != NOWHERE, v, NOWHERE) for v in vertices))
        # f of both ends: of a ray that leaves to the left, the segment starts on the left and ends on the right.
        size = dr.maximum(dr.abs(cross(ray.d, e)), SIGN * (dr.abs(e.x) + dr.abs(e.y)))
        size = dr.select(ray.left, size, -size)
        return Start(own, (-e * r, e * s), (size * r, -size * s))

    def _shares(self, ray: Ray) -> tuple[Number, Number]:
        """s and r of the ray's start, kept off both ends of the segment by u² of it: signs stay, no number changes."""
        least = self.arrays.roundoff**2
        return dr.maximum(ray.s, least), dr.maximum(ray.r, least)

    def none(self) -> Hit:
        """No crossing, at distance ∞."""
        number, index, zero = self.arrays.number, self.arrays.index, self.arrays.vector(0)
        nowhere = index(NOWHERE)
        return Hit(number(dr.inf), nowhere, number(0), number(0), self.arrays.mask(False), nowhere, nowhere, zero)

    def _seen(self, ray: Ray, start: Start, vertex: Index, place: Vector2) -> Seen:
        """The way from the ray's start to a vertex, and f of it."""
        way = place - ray.p
        side = cross(ray.d, way)
        for own, its_way, its_side in zip(start.vertices, start.ways, start.sides, strict=True):
            same = vertex == own
            way, side = dr.select(same, its_way, way), dr.select(same, its_side, side)
        return way, side

    def nearer(self, best: Hit, ray: Ray, start: Start, i: Index, active: Mask = True) -> Hit:
        """The crossing of segment i, if it comes before `best`."""
        a, b, vertices = self._of(i, active)
        seen = self._seen(ray, start, vertices[0], a), self._seen(ray, start, vertices[1], b)
        hit, ahead = self._crossing(ray, start, i, b - a, vertices, seen)
        # Of two segments that share a vertex, the turn between them says which comes first, whatever λ rounds to.
        turn = cross(hit.along, best.along)
        first = dr.select(hit.right == best.right, turn < 0, hit.distance < best.distance)
        first = ahead & active & dr.select(hit.left == best.left, turn > 0, first)
        return dr.select(first, hit, best)

    def _crossing(
        self, ray: Ray, start: Start, i: Index, e: Vector2, vertices: Vertices, seen: tuple[Seen, Seen]
    ) -> tuple[Hit, Mask]:
        """The crossing of segment i, which goes along e, and whether it is ahead."""
        (to_a, f_a), (to_b, f_b) = seen
        a_left, b_left = f_a >= 0, f_b >= 0
        way = dr.select((vertices[1] == start.vertices[0]) | (vertices[1] == start.vertices[1]), to_b, to_a)
        # |d × e| = |f_a| + |f_b| without cancellation. `reach` is λ times that: its sign is right where λ's is lost.
        scale: Number = dr.abs(f_a) + dr.abs(f_b)
        reach = dr.select(a_left, -1, 1) * cross(way, e)
        # The crossing lies between the ends: ahead where both ends are, behind where both are. That decides for a ray
        # along the segment, where the sign of `reach` is noise.
        t_a, t_b = dr.dot(to_a, ray.d), dr.dot(to_b, ray.d)
        beyond = (dr.maximum(t_a, t_b) > 0) & (reach > ray.slack * (dr.abs(e.x) + dr.abs(e.y)))
        ahead = (a_left != b_left) & ((dr.minimum(t_a, t_b) > ray.slack) | beyond) & (i != ray.own)
        near = ieee_divide(dr.minimum(dr.abs(f_a), dr.abs(f_b)), scale)
        s, r = (dr.select(0.5 * scale > dr.abs(f), near, 1 - near) for f in (f_b, f_a))
        distance = dr.dot(dr.fma(e, r, to_a), ray.d)  # λ; reach/scale is noise at grazing incidence
        left, right = (dr.select(a_left, vertices[j], vertices[1 - j]) for j in (0, 1))
        return Hit(distance, i, s, r, a_left, left, right, dr.select(a_left, e, -e)), ahead

    def place(self, hit: Hit) -> tuple[Vector2, Vector2]:
        """The point of a hit, from the nearer end, and the segment's direction there."""
        there = hit.segment != NOWHERE
        a, b, _ = self._of(hit.segment, there)
        e = b - a
        point = dr.select(hit.r < hit.s, dr.fma(e, hit.r, a), dr.fma(e, -hit.s, b))
        return point, self.arrays.gather(self.directions, hit.segment, there)
