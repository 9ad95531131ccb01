"""The planar system: rays against boundaries in two dimensions, refracted or totally reflected at each.

A boundary is a directed segment with the index of the medium on its left and on its right (seen along it), straight
or an arc of a conic. `trace` follows rays through them; conventions:

- A boundary is met at λ > 0. A ray that starts on one has not met it: it starts on the side to which it goes.
- A ray passes a vertex, and runs along a segment, as though it were displaced to its own right by less than
  anything. So one through a vertex that two segments share crosses exactly one of them, or none or both at a tip.
- A segment of length zero is no boundary. Where several segments share a vertex (a T-junction) a ray crosses those
  on its path, one after the other. A vertex inside another segment is no junction: one side of that segment has
  two media then, and a ray that finds another medium than its own is CONTRADICTED there and ends.
- The medium in which a ray starts is that on the near side of the first boundary it meets, unless it is told.

Source: document 004, with its slips corrected (README, Errata).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Event(IntEnum):
    """What became of a ray at a boundary, and how its path ended."""

    NONE = 0  # after the end
    REFRACTED = 1
    REFLECTED = 2
    ESCAPED = 3  # no boundary left to meet
    EXHAUSTED = 4  # `max_depth` boundaries met, and another one ahead
    CONTRADICTED = 5  # the next boundary's near side is not the ray's medium


@dataclass(frozen=True)
class Segments:
    """M directed boundaries from `start` to `end` (M × 2), between media of index `n_left` and `n_right` (M).

    `control` (M × 2) and `weight` (M): arcs of conics, as the rational quadratic Bézier curves
    ((1−t)² start + 2w t(1−t) control + t² end) / ((1−t)² + 2w t(1−t) + t²), each turning by less than 180°; the
    controls lie where the end tangents meet; w < 1, 1, > 1: ellipse, parabola, hyperbola. Straight where None.
    ValueError for shapes that do not fit, what is not finite, an index ≤ 0, a weight ≤ 0, or two segments with the
    same two ends.
    """

    start: Array
    end: Array
    n_left: Array
    n_right: Array
    control: Array | None = None
    weight: Array | None = None

    def __len__(self) -> int:
        return len(self.start)


@dataclass(frozen=True)
class Paths:
    """N paths of at most D boundaries. Leg j goes from point j to point j + 1, the last one on along `directions`.

    `points` N × (D+1) × 2: the origin and the places where boundaries are met, then NaN. `directions` N × 2: after
    the last of them. `hits` N × D: the segment met, then −1. `events` N × (D+1): of each boundary, then the end's,
    then NONE. `indices` N × (D+1): of the medium of each leg, NaN after the end and where it is not known.
    `weights` N × (D+1): share of the power that a leg carries, by Fresnel's equations for unpolarised light; None
    where it was not asked for.
    """

    points: Array
    directions: Array
    hits: NDArray[np.int32]
    events: NDArray[np.uint8]
    indices: Array
    weights: Array | None = None


def trace(
    segments: Segments,
    origins: Any,
    directions: Any,
    max_depth: int,
    *,
    formula: str = "rotated",
    precision: str = "float64",
    backend: str | None = None,
    method: str = "auto",
    reflect: Any = 0,
    n_start: Any = None,
    weights: bool = False,
) -> Paths:
    """Follow rays from `origins` along `directions` (N × 2) until they escape or have met `max_depth` boundaries.

    `formula`: a key of FORMULAS for the direction. `precision`: "float64" or "float32". `backend`: "llvm", "cuda" or
    "scalar"; None for the best on this machine. `reflect`: bits, one number or N; where bit j is set the ray is
    reflected at the j-th boundary it meets (from 0), though it might be refracted. `n_start`: index of the medium in
    which rays start (N or one). `weights`: fill `Paths.weights`.
    ValueError for what is none of these, and for origins or directions that are not finite, or no direction.
    """
    raise NotImplementedError
