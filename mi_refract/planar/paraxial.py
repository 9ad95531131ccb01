"""The paraxial limit along an axis: the 2 × 2 matrix of the boundaries that it meets, and the focal points of that.

A ray near the axis is h to the left of it and turned by φ. Over a length L, and at a boundary of curvature κ,

    h' = h + L φ,    φ' = φ        and        h' = h d'_n/d_n,    φ' = g φ − (1 − g) κ h/d_n,    g = n d_n/(n' d'_n)

where d and d' are the axis' directions before and behind, d_n is normal to the boundary, and g = −1 for a reflection.
At normal incidence that is the matrix of textbooks; of an oblique axis it gives the tangential focus (Coddington).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .segments import Array, Event, Paths, Segments

Point = tuple[float, float]
LOST = 2.0**-44  # share of its terms up to which a sum is 0 but for rounding, of some hundred roundings
GRAZING = 1e-6  # smallest cosine for which there is a limit


@dataclass(frozen=True)
class Cardinal:
    """Cardinal points of a system. Lengths are in the scene's units, along the axis, negative against the ray.

    `afocal`: the focal length is infinite, and there are none of the others. `focal_length`: effective, from the back
    principal point to the back focus. `back_focal_length`: from the last boundary to the back focus, where rays
    parallel to the axis meet. `front_focal_length`: from the first boundary to the front focus, from which rays leave
    parallel to the axis. `principal`: the front and the back principal point, through which the principal planes go.
    """

    afocal: bool
    focal_length: float | None = None
    back_focal_length: float | None = None
    front_focal_length: float | None = None
    back_focus: Point | None = None
    front_focus: Point | None = None
    principal: tuple[Point, Point] | None = None


@dataclass(frozen=True)
class Axis:
    """A path along an axis: its boundaries' places (K × 2), its directions before, between and behind (K + 1 × 2).

    matrix: from the first boundary to behind the last. size: the same sums of the magnitudes of their terms.
    """

    places: Array
    directions: Array
    matrix: Array
    size: Array

    def cardinal(self) -> Cardinal:
        """The cardinal points."""
        (a, _), (c, d) = self.matrix
        if abs(c) <= LOST * self.size[1, 0]:
            return Cardinal(afocal=True)
        focal, back, front = float(-1 / c), float(-a / c), float(d / c)
        # |matrix| = n/n' for the media before and behind: what the focal length is to the front, over that to the back.
        principal = self._front(front + focal * np.linalg.det(self.matrix)), self._back(back - focal)
        return Cardinal(False, focal, back, front, self._back(back), self._front(front), principal)

    def image(self, h: float, phi: float) -> Point | None:
        """Where rays (h, φ) at the first boundary, and multiples of it, meet; None where they leave parallel."""
        pencil = np.array([h, phi])
        height, turn = self.matrix @ pencil
        return None if abs(turn) <= LOST * (self.size @ np.abs(pencil))[1] else self._back(-height / turn)

    def _front(self, way: float) -> Point:
        return _along(self.places[0], self.directions[0], way)

    def _back(self, way: float) -> Point:
        return _along(self.places[-1], self.directions[-1], way)


def _along(place: Array, direction: Array, way: float) -> Point:
    """A place on the axis; a coordinate that is 0 but for rounding is 0."""
    x, y = np.where(np.abs(point := place + way * direction) > LOST * (np.abs(place).max() + abs(way)), point, 0.0)
    return float(x), float(y)


def axis(segments: Segments, paths: Paths, i: int) -> Axis | None:
    """The i-th of some paths, with indices, as an axis; None for one that meets nothing, ends inside, or grazes."""
    hits = paths.hits[i, paths.hits[i] >= 0]
    if not len(hits) or paths.events[i, len(hits)] != Event.ESCAPED or paths.indices is None:
        return None
    points, n = paths.points[i, : len(hits) + 1], paths.indices[i]
    legs = np.concatenate([np.diff(points, axis=0), paths.directions[i : i + 1]])
    lengths = np.hypot(*legs.T)
    legs = legs / np.where(lengths > 0, lengths, 1)[:, None]
    matrix = size = np.eye(2)
    for j, hit in enumerate(hits):
        tangent, curvature = _tangent(segments, int(hit), points[j + 1])
        before, behind = (float(tangent[0] * d[1] - tangent[1] * d[0]) for d in (legs[j], legs[j + 1]))
        if min(abs(before), abs(behind)) < GRAZING:
            return None
        g = -1.0 if paths.events[i, j] == Event.REFLECTED else n[j] * before / (n[j + 1] * behind)
        boundary = np.array([[behind / before, 0], [(g - 1) * curvature / before, g]])
        way = np.array([[1, lengths[j] if j else 0], [0, 1]])
        matrix, size = boundary @ way @ matrix, np.abs(boundary) @ way @ size
    # A mirror turns left and right over: the image side is seen as though it were unfolded.
    unfolded = (-1) ** int((paths.events[i, : len(hits)] == Event.REFLECTED).sum())
    return Axis(points[1:], legs, unfolded * matrix, size)


def _tangent(segments: Segments, hit: int, place: Array) -> tuple[Array, float]:
    """The unit direction of a boundary at a place, and by how much it turns to the left in a unit of length."""
    a, b = segments.start[hit], segments.end[hit]
    middle = (a + b) / 2
    c = middle if segments.control is None else segments.control[hit]
    if segments.weight is None or (c == middle).all():
        return (b - a) / math.hypot(*(b - a)), 0.0
    w = float(segments.weight[hit])
    turn = (c - a)[0] * (b - c)[1] - (c - a)[1] * (b - c)[0]
    # Shares of a, c and b in the place: s², 2w s r and r², up to a factor; from the nearer end no digit is lost.
    of_a, of_b = np.linalg.solve(np.column_stack([a - c, b - c]), place - c)
    of_c = 1 - of_a - of_b
    s, r = (2 * w * of_a, of_c) if of_a >= of_b else (of_c, 2 * w * of_b)
    e = (c - a) * (w * s * s) + (b - a) * (s * r) + (b - c) * (w * r * r)
    length = math.hypot(*e)
    return e / length, float(w * turn * (s * s + 2 * w * s * r + r * r) ** 3 / (2 * length**3))
