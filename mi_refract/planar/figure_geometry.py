"""The geometry of a figure, without matplotlib: legs of paths in the view, their density, boundaries as polylines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .curves import points
from .path_tree import Branches
from .scene_file import PlanarScene
from .segments import Array, Event, Segments

View = tuple[float, float, float, float]  # x0, x1, y0, y1
MARGIN = 0.08  # around the scene, as a share of its larger side
SHARED = -1  # the number of the colour that stands for all of them
SAMPLES = 2**22  # pixels of lines at a time: 0.3 GB


@dataclass(frozen=True)
class Legs:
    """L lines from `start` to `end` (L × 2), each with its share of the power and the number of its colour."""

    start: Array
    end: Array
    weight: Array
    colour: NDArray[np.intp]

    def __len__(self) -> int:
        """L."""
        return len(self.start)

    def where(self, mask: NDArray[np.bool_]) -> Legs:
        """Those for which `mask` (L) is True."""
        return Legs(self.start[mask], self.end[mask], self.weight[mask], self.colour[mask])


def around(scene: PlanarScene, traced: Sequence[Branches]) -> View:
    """The view that holds all boundaries and all places where rays meet them, with a margin."""
    segments = scene.segments[0]
    places = [segments.start, segments.end, *(region.outline for region in scene.regions)]
    places += [branches.paths.points[:, 1:].reshape(-1, 2) for branches in traced]
    points = np.concatenate(places)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    pad = MARGIN * (float((high - low).max()) or 1.0)
    return float(low[0] - pad), float(high[0] + pad), float(low[1] - pad), float(high[1] + pad)


def legs(traced: Sequence[Branches], view: View) -> Legs:
    """The legs inside the view, each once; rays that escape end at its edge."""
    x0, x1, y0, y1 = view
    parts = []
    for number, branches in enumerate(traced):
        start, own = branches.paths.points, branches.own
        # NaN where there is no leg, as after the last boundary of a path that stopped.
        end = np.full_like(start, np.nan)
        end[:, :-1] = start[:, 1:]
        away = np.flatnonzero(branches.end == Event.ESCAPED)
        tips = branches.tips[away]
        reach = np.hypot(*(tips - [(x0 + x1) / 2, (y0 + y1) / 2]).T) + math.hypot(x1 - x0, y1 - y0)
        end[away, branches.last[away]] = tips + branches.paths.directions[away] * reach[:, None]
        colour = np.full(own.shape, number)
        if len(traced) > 1:  # they separate at the first boundary
            colour[:, 0] = SHARED
            own[:, 0] &= number == 0
        first, last, inside = clip(start[own], end[own], view)
        parts.append([x[inside] for x in (first, last, branches.weights[own], colour[own])])
    return Legs(*map(np.concatenate, zip(*parts, strict=True)))


def clip(start: Array, end: Array, view: View) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Lines (L × 2) clipped to the view, and which of them are inside at all; False for NaN."""
    first, final = np.zeros(len(start)), np.ones(len(start))
    along = end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in range(2):
            sides = (np.array([[view[2 * axis]], [view[2 * axis + 1]]]) - start[:, axis]) / along[:, axis]
            first, final = np.maximum(first, sides.min(axis=0)), np.minimum(final, sides.max(axis=0))
        inside = first < final
        return start + along * first[:, None], start + along * final[:, None], inside


def density(lines: Legs, value: Array, view: View, width: int, height: int) -> Array:
    """Σ value × length in each pixel, over the pixel's side (height × width, row 0 at the bottom).

    A line is sampled one pixel apart along its longer axis; each sample is shared by the two nearest pixels across.
    """
    x0, x1, y0, y1 = view
    scale = np.array([width / (x1 - x0), height / (y1 - y0)])
    start, end = ((p - [x0, y0]) * scale - 0.5 for p in (lines.start, lines.end))
    steep = np.abs(end - start)[:, 1] > np.abs(end - start)[:, 0]
    flat = _chains(start[~steep], end[~steep], value[~steep], height, width)
    return flat + _chains(start[steep, ::-1], end[steep, ::-1], value[steep], width, height).T


def _chains(start: Array, end: Array, value: Array, rows: int, columns: int) -> Array:
    """The density of lines at 45° or less; ends as (column, row) from the centre of the first pixel."""
    backward = (start[:, 0] > end[:, 0])[:, None]
    left, right = np.where(backward, end, start), np.where(backward, start, end)
    run, rise = (right - left).T
    slope = np.divide(rise, run, out=np.zeros(len(run)), where=run > 0)
    value = value * np.hypot(1, slope)
    first = np.ceil(left[:, 0]).astype(int)
    lengths = np.maximum(np.floor(right[:, 0]).astype(int) - first + 1, 0)
    total = np.zeros((rows + 2) * (columns + 2))  # with a frame of one pixel
    step = max(SAMPLES // columns, 1)
    for i in range(0, len(value), step):
        part = slice(i, i + step)
        line = np.repeat(np.arange(len(value))[part], lengths[part])
        before = np.cumsum(lengths[part]) - lengths[part]
        column = first[line] + np.arange(len(line)) - np.repeat(before, lengths[part])
        y = left[line, 1] + slope[line] * (column - left[line, 0])
        row = np.floor(y).astype(int)
        pixel = (row + 1) * (columns + 2) + column + 1
        upper = (y - row) * value[line]
        total += np.bincount(pixel, value[line] - upper, len(total))
        total += np.bincount(pixel + columns + 2, upper, len(total))
    return total.reshape(rows + 2, columns + 2)[1:-1, 1:-1]


def curves(segments: Segments, samples: int = 33) -> list[Array]:
    """The boundaries as polylines, joined where one starts at the end of the one before; `samples` points per arc."""
    places = points(segments, samples - 1 if segments.curved else 1)
    breaks = np.flatnonzero((segments.start[1:] != segments.end[:-1]).any(axis=1)) + 1
    return [np.concatenate([run[:, :-1].reshape(-1, 2), run[-1:, -1]]) for run in np.split(places, breaks)]
