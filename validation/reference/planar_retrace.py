"""Paths in the plane in extended precision: the reference for `mi_refract.planar`, without shared code.

Boundaries are implicit curves. With the barycentric coordinates τ of a point in the triangle start, control, end, an
arc of weight w is τ₁² = 4w² τ₀τ₂ with τ₁ > 0 and τ₀ + τ₂ > 0; along a ray this is a quadratic in the distance. At a
boundary the tangential part of P = n d is conserved, and P_n² becomes n'² − P_t²; if that is negative, P_n is reversed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.planar import Event, Segments

Array = NDArray[Any]
PAIRS = 1 << 20  # rays × segments at once: 16 bytes each, for a dozen arrays


@dataclass(frozen=True)
class Retraced:
    """Paths: `points`, `directions`, `hits`, `events` and `indices` as in `Paths`; directions are unit.

    At each boundary, NaN after the end: `legs` N × (D+1) × 2, unit directions; `normals` N × D × 2, unit, to the left
    of the segment; `curvatures` N × D, the tangent's rotation to the left per unit of length.
    """

    points: Array
    hits: NDArray[np.int32]
    events: NDArray[np.uint8]
    indices: Array
    legs: Array
    normals: Array
    curvatures: Array

    @property
    def met(self) -> Array:
        """The number of boundaries on each path (N)."""
        return np.asarray((self.hits >= 0).sum(1))

    def last(self, x: Array) -> Array:
        """Return the values of the last legs, of N × (D+1)."""
        return x[np.arange(len(x)), self.met]

    @property
    def directions(self) -> Array:
        """The directions behind the last boundary (N × 2)."""
        return self.last(self.legs)


def retrace(
    segments: Segments, origins: Any, directions: Any, max_depth: int, *, reflect: Any = 0, n_start: Any = None
) -> Retraced:
    """Return the paths that `planar.trace` returns for the same arguments, in numpy's longdouble."""
    curves = Curves(segments)
    p, d = np.atleast_2d(origins).astype(np.longdouble), np.atleast_2d(directions).astype(np.longdouble)
    bits = np.broadcast_to(reflect, len(p))
    n = np.broadcast_to(np.longdouble(np.nan if n_start is None else n_start), len(p))
    size = max(1, PAIRS // max(1, len(segments)))
    parts = [
        _follow(curves, p[i : i + size], d[i : i + size], max_depth, bits[i : i + size], n[i : i + size])
        for i in range(0, len(p), size)
    ]
    fields = Retraced.__dataclass_fields__
    return Retraced(*(np.concatenate([getattr(part, name) for part in parts]) for name in fields))


def _follow(curves: Curves, p: Array, d: Array, max_depth: int, bits: Array, n: Array) -> Retraced:
    count, depth = len(p), max_depth
    shapes = [(depth + 1,), (depth + 1, 2), (depth, 2), (depth,)]
    indices, legs, normals, curvatures = (np.full((count, *shape), np.nan, np.longdouble) for shape in shapes)
    hits, events = np.full((count, depth), -1, np.int32), np.zeros((count, depth + 1), np.uint8)
    paths = Retraced(legs.copy(), hits, events, indices, legs, normals, curvatures)
    alive, last = np.arange(count), np.full(count, -1)
    d, n = d / np.hypot(*d.T)[:, None], n.copy()
    paths.points[:, 0], paths.legs[:, 0], paths.indices[:, 0] = p, d, n
    for j in range(max_depth + 1):
        distance, hit = curves.first(p[alive], d[alive], last[alive])
        ahead = hit >= 0
        paths.events[alive, j] = np.where(ahead, Event.MAX_DEPTH, Event.ESCAPED)
        if j == max_depth:
            break
        alive, hit, distance = alive[ahead], hit[ahead], distance[ahead]
        if not len(alive):
            break
        q = p[alive] + distance[:, None] * d[alive]
        normal, curvature = curves.normal(q, hit)
        leftward = (normal * d[alive]).sum(1) > 0
        near = np.where(leftward, curves.n_right[hit], curves.n_left[hit])
        far = np.where(leftward, curves.n_left[hit], curves.n_right[hit])
        n[alive] = np.where(np.isnan(n[alive]), near, n[alive])
        paths.indices[alive, j], right = n[alive], n[alive] == near
        forced = np.array([int(b) >> j & 1 for b in bits[alive]], bool)
        after, through = _bend(d[alive], normal, near, far, forced)
        event = np.where(through, Event.REFRACTED, Event.REFLECTED)
        paths.points[alive, j + 1], paths.hits[alive, j] = q, hit
        paths.events[alive, j] = np.where(right, event, Event.MEDIUM_MISMATCH)
        paths.normals[alive, j], paths.curvatures[alive, j] = normal, curvature
        paths.legs[alive, j + 1] = np.where(right[:, None], after, d[alive])
        p[alive], d[alive], n[alive], last[alive] = q, after, np.where(through, far, near), hit
        paths.indices[alive, j + 1] = np.where(right, n[alive], np.nan)
        alive = alive[right]
    return paths


def _bend(d: Array, normal: Array, near: Array, far: Array, forced: Array) -> tuple[Array, Array]:
    """Return unit directions and whether they are refracted. A ray along the boundary does not change."""
    momentum = near[:, None] * d
    before = (momentum * normal).sum(1)
    # n'² − P_t² = P_n² + (n' − n)(n' + n), without cancellation of large terms.
    square = before**2 + (far - near) * (far + near)
    through = (square >= 0) & (before != 0) & ~forced
    after = np.where(through, np.copysign(np.sqrt(np.maximum(square, 0)), before), -before)
    momentum += (after - before)[:, None] * normal
    return momentum / np.hypot(*momentum.T)[:, None], through


def cross(a: Array, b: Array) -> Array:
    """Return the cross products of vectors (… × 2)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


class Curves:
    """The boundaries as implicit curves in extended precision. `arcs`: the ids of segments that are not straight."""

    def __init__(self, segments: Segments) -> None:
        """Compute the implicit curves of the segments."""
        self.start, self.end = (np.asarray(x, np.longdouble) for x in (segments.start, segments.end))
        self.n_left, self.n_right = (np.asarray(x, np.longdouble) for x in (segments.n_left, segments.n_right))
        chord = self.end - self.start
        self.length = np.hypot(*chord.T)
        self.touching = 64 * np.finfo(np.longdouble).eps * np.abs([self.start, self.end]).max(initial=0)
        # By definition a segment is straight if its control point is the middle of its ends in double precision.
        middle = (np.asarray(segments.start) + np.asarray(segments.end)) / 2
        control = np.asarray(segments.control)
        self.arcs = np.flatnonzero((control != middle).any(1))
        self.place = np.full(len(chord), -1)  # index in `arcs`
        self.place[self.arcs] = np.arange(len(self.arcs))
        self.control = control[self.arcs].astype(np.longdouble)
        # Twice the area; > 0 with the control point on the left.
        area = cross(chord[self.arcs], self.control - self.start[self.arcs])
        self.w4 = 4 * np.asarray(segments.weight)[self.arcs].astype(np.longdouble) ** 2
        # ∇τ₀, ∇τ₁, ∇τ₂ (3 × arcs × 2): each is the opposite edge, rotated by 90°.
        corners = self.start[self.arcs], self.control, self.end[self.arcs]
        edges = [corners[(i + 1) % 3] - corners[(i + 2) % 3] for i in range(3)]
        self.slopes = np.stack([np.stack([-e[:, 1], e[:, 0]], 1) / area[:, None] for e in edges])
        self.to_left = np.sign(area)

    def first(self, p: Array, d: Array, last: Array) -> tuple[Array, Array]:
        """Return (distance, id) of the nearest boundary ahead, id −1 for none.

        `last`: the ids of the previous boundaries, of which only the other intersection counts.
        """
        if not len(self.start):
            return np.full(len(p), np.inf), np.full(len(p), -1)
        p, d = p[:, None], d[:, None]
        # Ties: points on the ray count as points on its left.
        sides = [cross(d, ends - p) for ends in (self.start, self.end)]
        parted = (sides[0] >= 0) != (sides[1] >= 0)
        with np.errstate(all="ignore"):
            share = sides[0] / (sides[0] - sides[1])
            met = self.start + share[..., None] * (self.end - self.start)
            distance = np.where(parted & (self.length > 0), ((met - p) * d).sum(-1), np.inf)
            own = np.arange(len(self.start)) == last[:, None]
            distance[own] = np.inf
            distance[:, self.arcs] = self._arc_distance(p, d, own[:, self.arcs], parted[:, self.arcs])
        # Boundaries that touch the last point are not ahead: they share a vertex with the previous boundary there.
        distance[~(distance > self.touching)] = np.inf
        hit = distance.argmin(1)
        nearest = distance[np.arange(len(hit)), hit]
        return nearest, np.where(np.isfinite(nearest), hit, -1)

    def _arc_distance(self, p: Array, d: Array, own: Array, parted: Array) -> Array:
        """Return the distance of the nearer intersection ahead that is on the arc; infinity for none."""
        # τ of the points in the triangle of each arc, and its derivative along the rays.
        t1, t2 = ((self.slopes[i] * (p - self.start[self.arcs])).sum(-1) for i in (1, 2))
        a, b = np.stack([1 - t1 - t2, t1, t2]), np.stack([(slope * d).sum(-1) for slope in self.slopes])
        two = b[1] ** 2 - self.w4 * b[0] * b[2]
        one = 2 * a[1] * b[1] - self.w4 * (a[0] * b[2] + a[2] * b[0])
        none = np.where(own, 0, a[1] ** 2 - self.w4 * a[0] * a[2])
        square = one**2 - 4 * two * none
        q = -(one + np.copysign(np.sqrt(np.maximum(square, 0)), one)) / 2
        roots = np.stack([q / two, none / q])
        t = a[:, None] + b[:, None] * roots
        branch = np.where(t[0] + t[2] > 0, t[1], -np.inf)  # > 0: on the arc; its ends are at 0
        branch = np.where(np.isfinite(roots), branch, -np.inf)
        # If the ends are on different sides, the arc is crossed once, at the better root; otherwise never or twice.
        on = np.where(parted, branch == branch.max(0), (branch.sum(0) > 0) & (square > 0))
        on = np.where(own, branch > 0, on)
        return np.asarray(np.where(on & (roots > 0), roots, np.inf).min(0))

    def normal(self, p: Array, hit: Array) -> tuple[Array, Array]:
        """Return unit normals at `p`, to the left of the segments `hit`, and the curvatures there."""
        chord = self.end[hit] - self.start[hit]
        normal, curvature = np.stack([-chord[:, 1], chord[:, 0]], 1), np.zeros(len(hit), np.longdouble)
        round_ = np.flatnonzero(self.place[hit] >= 0)
        if len(round_):
            k = self.place[hit[round_]]
            s0, s1, s2 = self.slopes[:, k]
            # Each point is paired with its own arc only.
            t1, t2 = ((s * (p[round_] - self.start[hit[round_]])).sum(1)[:, None] for s in (s1, s2))
            w4, left = self.w4[k, None], self.to_left[k, None]
            gradient = left * (2 * t1 * s1 - w4 * ((1 - t1 - t2) * s2 + t2 * s0))
            tangent = np.stack([gradient[:, 1], -gradient[:, 0]], 1) / np.hypot(*gradient.T)[:, None]
            rates = [(s * tangent).sum(1) for s in (s0, s1, s2)]
            hessian = 2 * left[:, 0] * (rates[1] ** 2 - w4[:, 0] * rates[0] * rates[2])
            normal[round_], curvature[round_] = gradient, -hessian / np.hypot(*gradient.T)
        return normal / np.hypot(*normal.T)[:, None], curvature
