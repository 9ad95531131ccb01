"""The samples of a pass are added up: each pixel by one lane, from its first sample to its last, in float64.

Under a box filter a pixel has its own samples v, and one kernel reads them once. Under a filter w that is wider than a
pixel it takes in those of its neighbours, too, in several kernels.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refract.numerics import Number, Point2

from .pass_sums import Doubles

Filter: TypeAlias = Any  # an `mi.ReconstructionFilter`, or None


class Film:
    """Pixels, one lane each, and the filter by which samples reach those around their own; None: a box, they do not.

    No dataclass: Dr.Jit would take it for a part of a loop's state.
    """

    def __init__(self, width: int, height: int, spp: int, rfilter: Filter) -> None:
        """As above."""
        self.width, self.height, self.spp, self.rfilter = width, height, spp, rfilter

    @property
    def reach(self) -> int:
        """How many pixels a sample reaches on each side."""
        radius: float = self.rfilter.radius()
        return math.ceil(radius - 0.5)

    def pixels(self) -> tuple[Any, Any]:
        """x and y of the pixels."""
        index, width = dr.arange(mi.Int32, self.width * self.height), dr.opaque(mi.Int32, self.width)
        y = index // width
        return index - y * width, y

    def at(self, x: Number, y: Number) -> tuple[Any, Any]:
        """Whether there is a pixel x, y, and its number."""
        inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        return inside, mi.UInt32(dr.select(inside, x + y * dr.opaque(mi.Int32, self.width), 0))

    def weight(self, apart: Number) -> Any:
        """The weight of a sample so far from the middle of a pixel, along one axis."""
        near = dr.abs(apart) <= self.rfilter.radius()
        return dr.select(near, self.rfilter.eval(apart), 0)


def image_sums(
    values: list[Number], place: Point2, film: Film, *, squares: bool
) -> tuple[Doubles, Doubles | None, Doubles | None]:
    """Σ w v of all pixels, H × W × C; Σ w, None under a box; for `squares` Σ (w (v − mean))² over the samples.

    `values`: of the samples by channels, those of a pixel in a row; `place`: theirs on the film.
    """
    if film.rfilter is None:
        dr.eval(values)
        totals, within = _box_sums(values, film, squares)
        weights = []
    else:
        dr.eval(values, place)
        *totals, weight = _weighted_sums(values, place, film)
        # Rounded: the spread of equal samples is exactly 0 then.
        means = [mi.Float(dr.select(weight == 0, 0, total / weight)) for total in totals]
        weights, within = [weight], _squared_sums(values, place, means, film) if squares else []
    kind: Any = mi.ArrayXd
    sums = [dr.ravel(kind(columns)) if columns else None for columns in (totals, weights, within)]
    dr.eval(sums)  # in one kernel
    shape = film.height, film.width, -1
    total, *others = (None if each is None else np.array(each).reshape(shape) for each in sums)
    assert total is not None
    return total, others[0], others[1]


@dr.syntax
def _box_sums(values: list[Number], film: Film, squares: bool) -> tuple[list[Any], list[Any]]:
    """Σ v of every pixel by channels; and for `squares` Σ (v − mean)², else nothing.

    Σ (v − mean)² = Σ d² − (Σ d)²/n of n samples, where d is the difference from the pixel's first: 0 if all are equal.
    """
    block: Any = mi.ArrayXf
    step = math.gcd(film.spp, 8)  # where so many samples are read at once, it takes half the time
    pixels, steps, n = film.width * film.height, dr.opaque(mi.UInt32, film.spp // step), dr.opaque(mi.Float64, film.spp)
    start = dr.arange(mi.UInt32, pixels) * steps
    first = [mi.Float64(dr.gather(mi.Float, each, start * step)) for each in values]
    totals = [mi.Float64(0) for _ in values]
    squared = [mi.Float64(0) for _ in values]
    k = mi.UInt32(0)
    while k < steps:
        for c in range(len(values)):
            row = dr.gather(block, values[c], start + k, shape=(step, pixels))
            for i in range(step):
                value = mi.Float64(row[i])
                totals[c] += value
                if dr.hint(squares, mode="scalar"):
                    squared[c] += dr.square(value - first[c])
        k += 1
    within = [dr.maximum(squared[c] - dr.square(totals[c] - n * first[c]) / n, 0) for c in range(len(values))]
    return totals, within if squares else []


def _weighted_sums(values: list[Number], place: Point2, film: Film) -> list[Any]:
    """Σ w v of every pixel by channels, and Σ w, over the samples that reach it, always added in the same order.

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
def _own_samples(values: list[Number], place: Point2, x: Number, y: Number, film: Film) -> list[list[Any]]:
    """Σ w v by channels, and Σ w, over the samples of each pixel, with their weights in the pixels of a row."""
    spp = dr.opaque(mi.UInt32, film.spp)
    first = dr.arange(mi.UInt32, film.width * film.height) * spp
    row = [[mi.Float64(0) for _ in range(len(values) + 1)] for _ in range(2 * film.reach + 1)]
    k = mi.UInt32(0)
    while k < spp:
        sample = [dr.gather(mi.Float, each, first + k) for each in values]
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
def _squared_sums(values: list[Number], place: Point2, means: list[Number], film: Film) -> list[Any]:
    """Σ (z − z̄)² of every pixel by channels, z = w (v − mean) over the samples that reach it.

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
