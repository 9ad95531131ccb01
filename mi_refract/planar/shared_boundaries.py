"""From shapes to boundaries: where two shapes touch, one boundary between their media."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

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


def boundaries(parts: list[Part]) -> tuple[Segments, ...]:
    """All parts as boundaries, one set per colour; vertices that differ by rounding only are merged.

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
    control, bends = _merged(control)
    weight = np.concatenate([c.weight for c in curves])
    media = np.array([(part.left, part.right) for part in parts])[owner]
    kept = first != last
    _present(parts, np.bincount(owner, kept), np.abs(vertices).max())
    for i, j in _again(_numbers(np.minimum(first, last), np.maximum(first, last), bends)):
        if kept[j]:
            side = int(first[i] != first[j])
            media[i, side] = _filled(media[i, side], parts[owner[i]].where, parts[owner[j]])
            kept[j] = False
    arcs = () if straight[kept].all() else (control[kept], weight[kept])
    left, right = media[kept].transpose(1, 2, 0)
    return tuple(Segments(start[kept], end[kept], *n, *arcs) for n in zip(left, right, strict=True))


def _present(parts: list[Part], pieces: NDArray[Any], largest: float) -> None:
    """ValueError for a part of which merging leaves no piece."""
    for part, left in zip(parts, pieces, strict=True):
        if not left:
            raise ValueError(
                f"{part.where}: a point, beside coordinates of {largest:g}; expected above {NEAR:.0e} of that"
            )


def _filled(there: Array, earlier: str, part: Part) -> Indices:
    """The index on the side of an earlier part's edge along which `part` runs: that of its inside."""
    if not part.curve.closed:
        raise ValueError(f"{part.where}: it runs along {earlier}; expected a boundary of its own")
    if tuple(there) != part.right:
        found, outside = _indices(there), _indices(part.right)
        raise ValueError(f"{part.where}: along {earlier} there is index {found}; expected {outside}, what it lies in")
    return part.left


def _indices(n: Any) -> str:
    return ", ".join(f"{x:g}" for x in n)


def _merged(points: Array) -> tuple[Array, Numbers]:
    """The points, near ones replaced by the first of them, and for each point the number of its place."""
    near = NEAR * np.abs(points).max()
    ids = _numbers(*(_groups(x, near) for x in points.T))
    _, first, ids = np.unique(ids, return_index=True, return_inverse=True)
    return points[first[ids]], ids


def _groups(x: Array, near: float) -> Numbers:
    """A number for each value, the same for neighbours at most `near` apart."""
    order = np.argsort(x)
    groups = np.empty(len(x), np.intp)
    groups[order] = np.cumsum(np.diff(x[order], prepend=x[order[0]]) > near)
    return groups


def _numbers(*columns: Numbers) -> Numbers:
    """A number for each row, the same for equal rows."""
    ids = columns[0]
    for column in columns[1:]:
        ids = np.unique(ids * (column.max() + 1) + column, return_inverse=True)[1]
    return ids


def _again(numbers: Numbers) -> Iterator[tuple[int, int]]:
    """Of each number that occurs more than once: its first place and each later one."""
    _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
    firsts = first[inverse]
    for j in np.flatnonzero(firsts != np.arange(len(numbers))):
        yield int(firsts[j]), int(j)
