"""From shapes to boundaries: where two shapes touch, one boundary between their media."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .curves import Curve
from .segments import Array, Segments

# Points are merged where both coordinates differ by at most this share of the largest coordinate.
NEAR = 2.0**-44

Indices = tuple[float, ...]  # of a medium, one per colour
Numbers = NDArray[np.intp]


class Part(NamedTuple):
    """A curve between two media; `where`: its name in errors."""

    where: str
    curve: Curve
    left: Indices
    right: Indices


def boundaries(parts: list[Part]) -> tuple[tuple[Segments, ...], tuple[str, ...]]:
    """All parts as boundaries, one set per colour, and the `where` of each; vertices apart by rounding only are merged.

    Where a closed part runs along an earlier one, they share one boundary, with the inside of the later part on the
    side where its outside was. So shapes can be cemented, and can touch the shape they lie in from within.
    ValueError where that side has another index than the part's outside, and for a part too small to keep.
    """
    curves = [part.curve for part in parts]
    owner = np.repeat(np.arange(len(parts)), [len(curve) for curve in curves])
    vertices, ids = _merged(np.concatenate([c.start for c in curves] + [c.end for c in curves]))
    (start, end), (first, last) = vertices.reshape(2, -1, 2), ids.reshape(2, -1)
    straight = np.concatenate([c.straight for c in curves])
    control = np.where(straight[:, None], (start + end) / 2, np.concatenate([c.control for c in curves]))
    merged, bends = _merged(control)
    control = np.where(straight[:, None], control, merged)
    weight = np.concatenate([c.weight for c in curves])
    media = np.array([(part.left, part.right) for part in parts])[owner]
    kept = first != last
    for part, pieces in zip(parts, np.bincount(owner, kept), strict=True):
        if not pieces:
            size = f"beside coordinates of {np.abs(vertices).max():g}; expected above {NEAR:.0e} of that"
            raise ValueError(f"{part.where}: it shrinks to a point {size}")
    places = np.stack([np.minimum(first, last), np.maximum(first, last), bends], axis=1)
    _, original, same = np.unique(places, axis=0, return_index=True, return_inverse=True)
    original = original[same]  # of each piece, the first one that runs where it does
    for j in np.flatnonzero((original != np.arange(len(owner))) & kept):
        i, part, earlier = int(original[j]), parts[owner[j]], parts[owner[original[j]]].where
        if not part.curve.closed:
            raise ValueError(f"{part.where}: it runs along {earlier}; expected a boundary of its own")
        side = int(first[i] != first[j])
        if tuple(media[i, side]) != part.right:
            there, outside = (", ".join(f"{x:g}" for x in n) for n in (media[i, side], part.right))
            text = f"along {earlier} there is index {there}; expected {outside}, what it lies in"
            raise ValueError(f"{part.where}: {text}")
        media[i, side], kept[j] = part.left, False
    start, end, control, weight, media = (x[kept] for x in (start, end, control, weight, media))
    colours = tuple(Segments(start, end, left, right, control, weight) for left, right in media.transpose(2, 1, 0))
    return colours, tuple(parts[i].where for i in owner[kept])


def _merged(points: Array) -> tuple[Array, Numbers]:
    """The points, near ones replaced by the first of them, and for each point the number of its place."""
    near, groups = NEAR * np.abs(points).max(), np.empty(points.shape, np.intp)
    for x, numbers in zip(points.T, groups.T, strict=True):  # the same number for neighbours at most `near` apart
        order = np.argsort(x)
        numbers[order] = np.cumsum(np.diff(x[order], prepend=x[order[0]]) > near)
    _, first, ids = np.unique(groups, axis=0, return_index=True, return_inverse=True)
    return points[first[ids]], ids
