"""From shapes that touch to boundaries: what two of them share becomes one boundary between their media."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .scene_schema import Part
from .segments import Array, Segments

# Points are one where neither coordinate differs by more than so much of the largest one.
NEAR = 2.0**-44

Named = tuple[str, Part]  # by what errors call it
Numbers = NDArray[np.intp]


def boundaries(parts: list[Named]) -> tuple[Segments, ...]:
    """All parts as boundaries, one set per colour, with the vertices that only rounding kept apart made one.

    Where a closed part runs along one before it, there is one boundary: it fills its side of it, which was its
    outside. So shapes are cemented, and touch from inside what they lie in. ValueError where it was not.
    """
    curves = [part.curve for _, part in parts]
    owner = np.repeat(np.arange(len(parts)), [len(curve) for curve in curves])
    vertices, ids = _merged(np.concatenate([c.start for c in curves] + [c.end for c in curves]))
    (start, end), (first, last) = vertices.reshape(2, -1, 2), ids.reshape(2, -1)
    straight = np.concatenate([c.straight for c in curves])
    control = np.where(straight[:, None], (start + end) / 2, np.concatenate([c.control for c in curves]))
    control, bends = _merged(control)
    weight = np.concatenate([c.weight for c in curves])
    media = np.array([(part.left, part.right) for _, part in parts])[owner]
    kept = first != last
    _present(parts, np.bincount(owner, kept), np.abs(vertices).max())
    for i, j in _again(_numbers(np.minimum(first, last), np.maximum(first, last), bends)):
        if kept[j]:
            side = int(first[i] != first[j])
            media[i, side] = _filled(media[i, side], parts[owner[i]][0], *parts[owner[j]])
            kept[j] = False
    arcs = () if straight[kept].all() else (control[kept], weight[kept])
    left, right = media[kept].transpose(1, 2, 0)
    return tuple(Segments(start[kept], end[kept], *n, *arcs) for n in zip(left, right, strict=True))


def _present(parts: list[Named], pieces: NDArray[Any], largest: float) -> None:
    """ValueError for a part of which rounding leaves nothing."""
    for (name, _), left in zip(parts, pieces, strict=True):
        if not left:
            raise ValueError(f"{name}: a point, beside coordinates of {largest:g}; accepted: above {NEAR:.0e} of that")


def _filled(there: Array, earlier: str, later: str, part: Part) -> Any:
    """What is on that side of the edge of an earlier part along which `part` runs: its inside, for its outside."""
    if not part.curve.closed:
        raise ValueError(f"{later}: it runs along {earlier}; accepted: a boundary of its own")
    if tuple(there) != part.right:
        found, outside = _indices(there), _indices(part.right)
        raise ValueError(f"{later}: along {earlier} there is index {found}; accepted: {outside}, what it lies in")
    return part.left


def _indices(n: Any) -> str:
    return ", ".join(f"{x:g}" for x in n)


def _merged(points: Array) -> tuple[Array, Numbers]:
    """The points, near ones replaced by the first of them, and a number for each place."""
    near = NEAR * np.abs(points).max()
    ids = _numbers(*(_groups(x, near) for x in points.T))
    _, first, ids = np.unique(ids, return_index=True, return_inverse=True)
    return points[first[ids]], ids


def _groups(x: Array, near: float) -> Numbers:
    """A number for each value, the same for neighbours not farther apart than `near`."""
    order = np.argsort(x)
    groups = np.empty(len(x), np.intp)
    groups[order] = np.cumsum(np.diff(x[order], prepend=x[order[0]]) > near)
    return groups


def _numbers(*columns: Numbers) -> Numbers:
    """A number for each row, the same for equal ones."""
    ids = columns[0]
    for column in columns[1:]:
        ids = np.unique(ids * (column.max() + 1) + column, return_inverse=True)[1]
    return ids


def _again(numbers: Numbers) -> Iterator[tuple[int, int]]:
    """The first place and a later one of each number that comes more than once."""
    _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
    firsts = first[inverse]
    for j in np.flatnonzero(firsts != np.arange(len(numbers))):
        yield int(firsts[j]), int(j)
