"""What `planar.trace` returns: the paths of rays, and what happened to a ray at each boundary. Numpy only."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from .segments import Array

REFLECT_BITS = 32  # boundaries on a path at which `reflect` can ask for reflection


class Event(IntEnum):
    """What happened to a ray at a boundary, or how its path ended."""

    NONE = 0  # after the end of the path
    REFRACTED = 1
    REFLECTED = 2  # totally, or where `reflect` asked for it
    ESCAPED = 3  # end: no boundary ahead
    MAX_DEPTH = 4  # end: `max_depth` boundaries met, and another one is ahead
    MEDIUM_MISMATCH = 5  # end: the near side of the boundary has another index than the ray's medium


@dataclass(frozen=True)
class Paths:
    """N paths of at most D boundaries each. Leg j leads from point j to point j + 1, the last one along `directions`.

    points: N × (D+1) × 2, the origin and the places where boundaries are met, then NaN.
    directions: N × 2, unit vectors after the last boundary.
    hits: N × D, the number of each segment met, then −1.
    events: N × (D+1), `Event` at each boundary, then how the path ended, then NONE.
    indices: N × (D+1), refractive index of the medium of each leg; NaN after the end and where it is not known.
    polarised: N × (D+1) × 2, shares of the ray's s and p waves that each leg carries (Fresnel). s is perpendicular to
    the plane. Neither wave becomes the other at a boundary.
    `indices` and `polarised` are None where weights were not asked for.
    """

    points: Array
    directions: Array
    hits: NDArray[np.int32]
    events: NDArray[np.uint8]
    indices: Array | None = None
    polarised: Array | None = None

    @property
    def weights(self) -> Array | None:
        """N × (D+1), share of the power of unpolarised light that each leg carries: the mean of both waves."""
        return None if self.polarised is None else self.polarised.mean(axis=-1)
