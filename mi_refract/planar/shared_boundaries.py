"""Turn shapes into boundaries: where two shapes touch, one boundary separates their media."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .curves import Curve
from .segments import Array, Segments

# Points are merged if both coordinates differ by at most this share of the largest coordinate, and weights likewise.
NEAR = 2.0**-44

Indices = tuple[float, ...]  # refractive index of a medium for each colour
Numbers = NDArray[np.intp]


class Part(NamedTuple):
    """A curve between two media. `where`: the name of its shape in errors."""

    where: str
    curve: Curve
    left: Indices
    right: Indices


def boundaries(parts: list[Part]) -> tuple[tuple[Segments, ...], tuple[str, ...]]:
    """All parts as segments, one `Segments` per colour, and for each segment the `where` of its part.

    Vertices that differ only by rounding are merged. Where a closed part runs along an earlier one, they share one
    boundary, with the inside of the later part on the side where its outside was. So shapes can be cemented, and can
    touch the shape they lie in from within.
    ValueError if the index on that side differs from that outside the later part, and if a part shrinks to a point.
    """
    curves = [part.curve for part in parts]
    owner = np.repeat(np.arange(len(parts)), [len(curve) for curve in curves])
    vertices, ids = _merged(np.concatenate([c.start for c in curves] + [c.end for c in curves]))
    (start, end), (first, last) = vertices.reshape(2, -1, 2), ids.reshape(2, -1)
    straight = np.concatenate([c.straight for c in curves])
    control = np.where(straight[:, None], (start + end) / 2, np.concatenate([c.control for c in curves]))
    merged, control_ids = _merged(control)
    control = np.where(straight[:, None], control, merged)
    weight = np.concatenate([c.weight for c in curves])
    media = np.array([(part.left, part.right) for part in parts])[owner]
    keep = first != last
    for part, count in zip(parts, np.bincount(owner, keep), strict=True):
        if not count:
            limit = f"{NEAR:.0e} of the largest coordinate, {np.abs(vertices).max():g}"
            raise ValueError(f"{part.where}: too small, rounding makes it a point; expected a size above {limit}")
    _, weight_ids = _merged(weight[:, None])
    places = np.stack([np.minimum(first, last), np.maximum(first, last), control_ids, weight_ids], axis=1)
    _, originals, place_ids = np.unique(places, axis=0, return_index=True, return_inverse=True)
    original = originals[place_ids.ravel()]  # for each piece, the number of the first piece at the same place
    for j in np.flatnonzero((original != np.arange(len(owner))) & keep):
        i, part, earlier = int(original[j]), parts[owner[j]], parts[owner[original[j]]].where
        if not part.curve.closed:
            raise ValueError(f"{part.where}: runs along {earlier}; expected a boundary elsewhere")
        side = int(first[i] != first[j])
        if tuple(media[i, side]) != part.right:
            index, outside = (", ".join(f"{x:g}" for x in n) for n in (media[i, side], part.right))
            text = f"the index along {earlier} is {index}; expected {outside}, the index around this shape"
            raise ValueError(f"{part.where}: {text}")
        media[i, side], keep[j] = part.left, False
    start, end, control, weight, media = (x[keep] for x in (start, end, control, weight, media))
    colours = tuple(Segments(start, end, left, right, control, weight) for left, right in media.transpose(2, 1, 0))
    return colours, tuple(parts[i].where for i in owner[keep])


def _merged(points: Array) -> tuple[Array, Numbers]:
    """The points, near ones replaced by the first of them, and a number for each, the same for merged points."""
    tolerance, groups = NEAR * np.abs(points).max(), np.empty(points.shape, np.intp)
    for x, numbers in zip(points.T, groups.T, strict=True):  # neighbours at most `tolerance` apart get the same number
        order = np.argsort(x)
        numbers[order] = np.cumsum(np.diff(x[order], prepend=x[order[0]]) > tolerance)
    _, first, ids = np.unique(groups, axis=0, return_index=True, return_inverse=True)
    ids = ids.ravel()  # NumPy 2.0.0 returns a column
    return points[first[ids]], ids
