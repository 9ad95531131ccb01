"""The samples of a pass are added up: each pixel by one lane, from its first sample to its last, in float64.

Under a filter w that is wider than a pixel, a pixel takes in the samples of its neighbours, too.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi


class Film:
    """Pixels, one lane each, and the filter by which samples reach those around their own; None: they do not.

    No dataclass: Dr.Jit would take it for a part of a loop's state.
    """

    def __init__(self, width: int, height: int, spp: int, rfilter: Any) -> None:
        """`rfilter`: of the film; None for a box."""
        self.width, self.height, self.spp, self.rfilter = width, height, spp, rfilter

    @property
    def reach(self) -> int:
        """To how many pixels on each side."""
        return 0 if self.rfilter is None else math.ceil(self.rfilter.radius() - 0.5)

    def pixels(self) -> tuple[Any, Any]:
        """Their x and y."""
        index, width = dr.arange(mi.Int32, self.width * self.height), dr.opaque(mi.Int32, self.width)
        y = index // width
        return index - y * width, y

    def at(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Whether there is a pixel x, y, and its number."""
        inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        return inside, mi.UInt32(dr.select(inside, x + y * dr.opaque(mi.Int32, self.width), 0))

    def weight(self, apart: Any) -> Any:
        """Of a sample so far from the middle of a pixel, along one axis."""
        near = dr.abs(apart) <= self.rfilter.radius()
        return dr.select(near, self.rfilter.eval(apart), 0)


def weighted_sums(values: list[Any], place: Any, film: Film) -> list[Any]:
    """Of every pixel Σ w v by channels, and Σ w, over the samples that reach it, always added in the same order.

    For each row of neighbours every pixel adds up its own samples with the weights that they have in each of them.
    """
    x, y = film.pixels()
    totals = [dr.zeros(mi.Float64, film.width * film.height) for _ in (*values, "weight")]
    for j in range(-film.reach, film.reach + 1):
        row = _own_samples(values, place, mi.Float(x), mi.Float(y) + dr.opaque(mi.Float, j), film)
        dr.eval(row)
        for i, sums in zip(range(-film.reach, film.reach + 1), row, strict=True):
            inside, source = film.at(x - i, y - j)
            totals = [t + dr.gather(mi.Float64, each, source, inside) for t, each in zip(totals, sums, strict=True)]
        dr.eval(totals)
    return totals


@dr.syntax
def _own_samples(values, place, x, y, film):  # Dr.Jit rewrites it
    """Σ w v by channels, and Σ w, over the samples of each pixel, with their weights in the pixels of a row."""
    spp = dr.opaque(mi.UInt32, film.spp)
    first = dr.arange(mi.UInt32, film.width * film.height) * spp
    row = [[mi.Float64(0) for _ in range(len(values) + 1)] for _ in range(2 * film.reach + 1)]
    k = mi.UInt32(0)
    while k < spp:
        sample = [dr.gather(mi.Float, each, first + k) for each in values]
        if dr.hint(film.rfilter is None, mode="scalar"):
            for c in range(len(values)):
                row[0][c] += mi.Float64(sample[c])
            row[0][len(values)] += 1
        else:
            along = dr.gather(mi.Float, place.x, first + k) - (x + 0.5)
            across = film.weight(dr.gather(mi.Float, place.y, first + k) - (y + 0.5))
            for i in range(2 * film.reach + 1):
                w = mi.Float64(across * film.weight(along - (i - film.reach)))
                for c in range(len(values)):
                    row[i][c] += w * mi.Float64(sample[c])
                row[i][len(values)] += w
        k += 1
    return row


@dr.syntax
def squared_sums(values, place, means, film):  # Dr.Jit rewrites it
    """Of every pixel Σ (z − z̄)², by channels, of z = w (v − mean) over the samples that reach it.

    z̄ is the mean over those that lie in one pixel: their number there is fixed, so that pixels are strata.
    """
    spp = dr.opaque(mi.UInt32, film.spp)
    x, y = film.pixels()
    means = [mi.Float64(mean) for mean in means]
    totals = [mi.Float64(0) for _ in values]
    j = mi.Int32(-film.reach)
    while j <= film.reach:
        i = mi.Int32(-film.reach)
        while i <= film.reach:
            inside, source = film.at(x + i, y + j)
            sums = [mi.Float64(0) for _ in values]
            squares = [mi.Float64(0) for _ in values]
            k = mi.UInt32(0)
            while inside & (k < spp):
                w = mi.Float64(1)
                if dr.hint(film.rfilter is not None, mode="scalar"):
                    along = dr.gather(mi.Float, place.x, source * spp + k) - (mi.Float(x) + 0.5)
                    across = dr.gather(mi.Float, place.y, source * spp + k) - (mi.Float(y) + 0.5)
                    w = mi.Float64(film.weight(along) * film.weight(across))
                for c in range(len(values)):
                    z = w * (mi.Float64(dr.gather(mi.Float, values[c], source * spp + k)) - means[c])
                    sums[c] += z
                    squares[c] += z * z
                k += 1
            for c in range(len(values)):
                totals[c] += dr.maximum(squares[c] - sums[c] * sums[c] / mi.Float64(spp), 0)
            i += 1
        j += 1
    return totals
