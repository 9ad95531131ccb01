"""The input and output of `planar.trace` as numpy arrays: boundaries between media (`Segments`), and `Paths`."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

REFLECT_BITS = 32  # number of boundaries on a path, from its start, at which `reflect` can request reflection


def finite_array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """`values` as a float64 array. ValueError, with `name`, for another shape, NaN or Inf."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: expected numbers of shape {shape}") from None
    if array.shape != shape:
        raise ValueError(f"{name}: shape {array.shape}; expected {shape}")
    if array.size and not (np.isfinite(array.min()) and np.isfinite(array.max())):
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}{list(place)} = {array[place]}; expected finite numbers")
    return array


def check_range(name: str, values: Array, largest: float) -> None:
    """ValueError for NaN and for numbers above `largest` in magnitude."""
    if values.size and not (values.max() <= largest and values.min() >= -largest):
        raise ValueError(f"{name}: {values[~(np.abs(values) <= largest)][0]:g}; expected up to ±{largest:g}")


@dataclass(frozen=True)
class Segments:
    """M directed boundaries from `start` to `end` (M × 2), between media of index `n_left` and `n_right` (M).

    Left and right are as seen along the segment. A segment is an arc of a conic, as a rational quadratic Bézier curve

        ((1−t)² start + 2w t(1−t) control + t² end) / ((1−t)² + 2w t(1−t) + t²),   0 ≤ t ≤ 1

    with `control` (M × 2), where the tangents at both ends meet, and `weight` (M): w < 1 is an ellipse, w = 1 a
    parabola, w > 1 a hyperbola. Each arc turns by less than 180°. A segment is straight if its control point is on its
    chord. Without `control` and `weight`, all segments are straight: the control point is in the middle, the weight 1.

    ValueError for shapes that do not match, NaN or Inf, an index ≤ 0, a weight ≤ 0, and two segments that coincide.
    """

    start: Array
    end: Array
    n_left: Array
    n_right: Array
    control: Array = None  # type: ignore[assignment]  # always an array after __post_init__
    weight: Array = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Copy all fields to float64 arrays and check them."""
        if not len(self.start):
            raise ValueError("segments: none; expected at least one")
        if (self.control is None) != (self.weight is None):
            raise ValueError("segments: control and weight; expected both or neither")
        for name in ("start", "end", "n_left", "n_right", "control", "weight"):
            shape = (len(self.start), 2) if name in ("start", "end", "control") else (len(self.start),)
            values = getattr(self, name)
            if values is None:
                values = (self.start + self.end) / 2 if name == "control" else np.ones(shape)
            values = finite_array(f"segments.{name}", values, shape).copy()
            object.__setattr__(self, name, values)
            if len(shape) == 1 and not (values > 0).all():
                i = int(np.argmin(values > 0))
                raise ValueError(f"segments.{name}[{i}] = {values[i]}; expected more than 0")
        # Of two segments that coincide, neither would come first on a ray.
        key = np.column_stack([np.sort(self.vertices, axis=1), self.control, self.weight])
        key[self.turn == 0, 2:] = 0  # of a straight segment, neither matters
        order = np.lexsort(key.T)
        same = (key[order[1:]] == key[order[:-1]]).all(1) & (key[order[1:], 0] != key[order[1:], 1])
        if same.any():
            i, j = sorted(order[int(np.argmax(same)) :][:2].tolist())
            raise ValueError(f"segments {i} and {j} coincide; expected one, with the media on either side of both")

    def __len__(self) -> int:
        """M."""
        return len(self.start)

    @functools.cached_property
    def turn(self) -> Array:
        """M: (control − start) × (end − control), positive for an arc that turns left, 0 for a straight segment."""
        (ax, ay), (bx, by) = (self.control - self.start).T, (self.end - self.control).T
        straight = (self.control == (self.start + self.end) / 2).all(1)
        return np.where(straight, 0.0, ax * by - ay * bx)

    @functools.cached_property
    def vertices(self) -> NDArray[np.uint32]:
        """M × 2: a number for each start and each end, the same for ends at the same place."""
        places = np.concatenate([self.start, self.end]) + 0.0  # turns −0 into 0
        _, numbers = np.unique(places.view(complex).ravel(), return_inverse=True)
        return numbers.reshape(2, -1).T.astype(np.uint32)


class Event(IntEnum):
    """What happened to a ray at a boundary, or how its path ended."""

    NONE = 0  # after the end of the path
    REFRACTED = 1
    REFLECTED = 2  # totally, or as `reflect` requested
    ESCAPED = 3  # end: no boundary ahead
    MAX_DEPTH = 4  # end: `max_depth` boundaries met, and another one is ahead
    MEDIUM_MISMATCH = 5  # end: the near side of the boundary has another index than the ray's medium


@dataclass(frozen=True)
class Paths:
    """N paths of at most D boundaries each. Leg j leads from point j to point j + 1, the last leg along `directions`.

    points: N × (D+1) × 2, the origin and the points on the boundaries, then NaN.
    directions: N × 2, unit vectors after the last boundary.
    hits: N × D, the number of the segment at each boundary, then −1.
    events: N × (D+1), the `Event` at each boundary, then the one that ended the path, then NONE.
    indices: N × (D+1), refractive index of the medium of each leg; NaN after the end and where it is unknown.
    polarised: N × (D+1) × 2, shares of the ray's s and p waves that each leg carries (Fresnel). s is perpendicular to
    the plane. No boundary turns one wave into the other.
    `indices` and `polarised` are None unless weights were requested.
    """

    points: Array
    directions: Array
    hits: NDArray[np.int32]
    events: NDArray[np.uint8]
    indices: Array | None = None
    polarised: Array | None = None

    @property
    def weights(self) -> Array | None:
        """N × (D+1): the share of the power of unpolarised light that each leg carries, the mean of both waves."""
        return None if self.polarised is None else self.polarised.mean(axis=-1)
