"""Curves in the plane, of straight pieces and exact arcs of conics. No optics: `Curve.between` adds the media.

A closed curve runs counter-clockwise: its inside is on the left. An arc is a rational quadratic Bézier curve, which
represents the conic exactly: its control point lies where the end tangents meet, and an affine map of start, control
and end is an affine map of the arc with the same weight. Arcs turn by at most 90° when they are created; stretching may
change that. Each vertex is computed once, so that neighbours share it to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .segments import Array, Segments


@dataclass(frozen=True)
class Curve:
    """M pieces from vertex to vertex (M + 1 vertices, or M if `closed`); `control` M × 2, `weight` M.

    A piece is straight if its weight is 1 and its control point is the middle of its ends.
    """

    vertices: Array
    control: Array
    weight: Array
    closed: bool

    def __len__(self) -> int:
        """M, the number of pieces."""
        return len(self.weight)

    @property
    def start(self) -> Array:
        """The start of each piece, M × 2."""
        return self.vertices[: len(self)]

    @property
    def end(self) -> Array:
        """The end of each piece, M × 2."""
        return np.roll(self.vertices, -1, 0)[: len(self)]

    @property
    def straight(self) -> NDArray[np.bool_]:
        """Whether each piece is straight, M."""
        return np.asarray((self.weight == 1) & (self.control == (self.start + self.end) / 2).all(1))

    def reversed(self) -> Curve:
        """The same curve in the opposite direction; a closed curve keeps its first vertex."""
        vertices = np.roll(self.vertices[::-1], 1, 0) if self.closed else self.vertices[::-1]
        return replace(self, vertices=vertices, control=self.control[::-1], weight=self.weight[::-1])

    def mapped(self, matrix: ArrayLike, at: ArrayLike = (0.0, 0.0)) -> Curve:
        """The curve under p → matrix · p + at. A reflection reverses it, so that its left side stays its left side.

        ValueError for a matrix that is singular or not finite.
        """
        matrix, at = np.asarray(matrix, float), np.asarray(at, float)
        determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
        if not (math.isfinite(determinant) and determinant and np.isfinite(at).all()):
            text = f"matrix = {matrix.tolist()}, at = {at.tolist()}"
            raise ValueError(f"{text}; expected finite numbers, and a determinant other than 0")
        # Computed by column: so products with 0 and 1 are exact, while a matrix product may sum in any order.
        x, y = matrix.T
        vertices, control = (p[:, :1] * x + p[:, 1:] * y + at for p in (self.vertices, self.control))
        mapped = replace(self, vertices=vertices, control=control)
        mapped.control[self.straight] = ((mapped.start + mapped.end) / 2)[self.straight]
        return mapped if determinant > 0 else mapped.reversed()

    def faceted(self, facets: int) -> Curve:
        """The curve with `facets` chords in place of its arcs, spread evenly over the arcs; straight pieces stay.

        ValueError if the curve has no arc, or more arcs than `facets`.
        """
        arcs = np.flatnonzero(~self.straight)
        if not 0 < len(arcs) <= facets:
            text = f"facets: {facets} for {len(arcs)} arcs"
            raise ValueError(f"{text}; expected at least one arc, and at least one facet per arc")
        steps = np.ones(len(self), int)
        steps[arcs] = np.diff(np.arange(len(arcs) + 1) * facets // len(arcs))
        return polygonal(self._chords(steps), self.closed)

    def outline(self, count: int = 64) -> Array:
        """Points along the curve, K × 2: its vertices, and `count` − 1 more on each arc."""
        return self._chords(np.where(self.straight, 1, count))

    def _chords(self, steps: NDArray[np.intp]) -> Array:
        """The vertices of `steps` (M) chords along each piece, K × 2."""
        chords = [self.start] * len(self)
        for count in np.unique(steps).tolist():
            pieces = np.flatnonzero(steps == count)
            for j, piece_points in zip(pieces.tolist(), points(self, count, pieces), strict=True):
                chords[j] = piece_points[:-1]
        return np.concatenate(chords if self.closed else [*chords, self.vertices[-1:]])

    def between(self, n_left: float, n_right: float) -> Segments:
        """The curve as boundaries between two media."""
        left, right = np.full(len(self), float(n_left)), np.full(len(self), float(n_right))
        return Segments(self.start, self.end, left, right, self.control, self.weight)


def points(curve: Curve | Segments, count: int, selected: NDArray[np.intp] | slice = slice(None)) -> Array:
    """M × (count + 1) × 2: points along each of the selected pieces, at equal angles on an arc of a circle.

    The ends of a piece are exact.
    """
    arrays = curve.start, curve.end, curve.control, curve.weight
    start, end, control, weight = (x[selected, None] for x in arrays)
    w, s = weight[..., None], np.linspace(0, 1, count + 1)[:, None]
    angle = np.emath.arccos(w) / np.pi
    # sin(φx)/sin φ for w = cos φ; it becomes x for w = 1, and for w > 1 φ is imaginary, sin becomes sinh.
    b, a = (np.real(x * np.sinc(angle * x) / np.sinc(angle)) for x in (s, 1 - s))
    middle = 2 * w * a * b
    sums = a * a * start + middle * control + b * b * end
    return sums / (a * a + middle + b * b)


def affine(rotate: float = 0.0, scale: float | Sequence[float] = 1.0) -> Array:
    """The 2 × 2 matrix that stretches by `scale` (one factor, or one each for x and y), then turns by degrees."""
    cosine, sine = unit(rotate)
    x, y = np.broadcast_to(scale, 2)
    return np.array([[cosine * x, -sine * y], [sine * x, cosine * y]])


def unit(degrees: float) -> tuple[float, float]:
    """Cosine and sine of an angle: exact for multiples of 90°, and of equal size for odd multiples of 45°."""
    degrees = math.fmod(degrees, 360)
    quarters = round(degrees / 90)
    rest = degrees - 90 * quarters
    x, y = math.cos(math.radians(rest)), math.sin(math.radians(rest))
    if abs(rest) == 45:
        x, y = math.sqrt(0.5), math.copysign(math.sqrt(0.5), rest)
    return ((x, y), (-y, x), (-x, -y), (y, -x))[quarters % 4]


def polygonal(vertices: Array, closed: bool) -> Curve:
    """The curve of straight pieces through `vertices` (K × 2)."""
    following = np.roll(vertices, -1, 0)
    pieces = len(vertices) - (not closed)
    return Curve(vertices, ((vertices + following) / 2)[:pieces], np.ones(pieces), closed)


def joined(*curves: Curve) -> Curve:
    """One closed curve from open ones, with straight pieces in the gaps between them."""
    parts = []
    for curve, following in zip(curves, [*curves[1:], curves[0]], strict=True):
        gap = polygonal(np.stack([curve.vertices[-1], following.vertices[0]]), closed=False)
        parts.append(curve)
        if (gap.start != gap.end).any():
            parts.append(gap)
    vertices, control = np.concatenate([p.start for p in parts]), np.concatenate([p.control for p in parts])
    return Curve(vertices, control, np.concatenate([p.weight for p in parts]), closed=True)


def area(curve: Curve) -> float:
    """The area inside a closed curve, positive if it runs counter-clockwise. Each arc counts as 64 chords."""
    x, y = curve.outline().T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2
