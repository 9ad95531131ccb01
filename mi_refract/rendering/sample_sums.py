"""Sums of the samples of a pass: one lane sums each pixel, from its first sample to its last, in float64.

With a box filter, the samples v of a pixel are its own, and one kernel reads them once. With a filter w that is wider
than a pixel, those of neighbours count, too, and there are several kernels.
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
    """The pixels of a film, one lane each, and its filter.

    This is no dataclass, because Dr.Jit would make a dataclass a part of a loop's state.
    """

    def __init__(self, width: int, height: int, spp: int, rfilter: Filter) -> None:
        """`rfilter`: weighs samples in the pixels around their own; None: a box filter, for which there are none."""
        self.width, self.height, self.spp, self.rfilter = width, height, spp, rfilter

    @property
    def reach(self) -> int:
        """Number of pixels on each side that a sample reaches."""
        return math.ceil(float(self.rfilter.radius()) - 0.5)

    def pixels(self) -> tuple[Any, Any]:
        """Return x and y of all pixels."""
        index, width = dr.arange(mi.Int32, self.width * self.height), dr.opaque(mi.Int32, self.width)
        y = index // width
        return index - y * width, y

    def at(self, x: Number, y: Number) -> tuple[Any, Any]:
        """Return whether there is a pixel x, y, and its number."""
        inside = (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        return inside, mi.UInt32(dr.select(inside, x + y * dr.opaque(mi.Int32, self.width), 0))

    def weight(self, distance: Number) -> Any:
        """Return the weight of a sample at this distance from the middle of a pixel, along one axis."""
        near = dr.abs(distance) <= self.rfilter.radius()
        return dr.select(near, self.rfilter.eval(distance), 0)


def image_sums(
    values: list[Number], position: Point2, film: Film, *, squares: bool
) -> tuple[Doubles, Doubles | None, Doubles | None]:
    """Return Σ w v of all pixels, H × W × C, Σ w and Σ (w (v − mean))² over the samples.

    Σ w is None for a box filter, the last one unless `squares`. `values`: of the samples by channel, pixel after pixel.
    `position`: of the samples on the film.
    """
    if film.rfilter is None:
        dr.eval(values)
        totals, within = _box_sums(values, film, squares)
        weights = []
    else:
        dr.eval(values, position)
        *totals, weight = _weighted_sums(values, position, film)
        # Rounded to float32, so that the spread of equal samples is exactly 0.
        means = [mi.Float(dr.select(weight == 0, 0, total / weight)) for total in totals]
        weights, within = [weight], _squared_sums(values, position, means, film) if squares else []
    array: Any = mi.ArrayXd
    sums = [dr.ravel(array(columns)) if columns else None for columns in (totals, weights, within)]
    dr.eval(sums)  # in one kernel
    shape = film.height, film.width, -1
    total, weight_sums, squared = (None if column is None else np.array(column).reshape(shape) for column in sums)
    assert total is not None
    return total, weight_sums, squared


@dr.syntax
def _box_sums(values: list[Number], film: Film, squares: bool) -> tuple[list[Any], list[Any]]:
    """Return Σ v of every pixel by channel, and for `squares` Σ (v − mean)², else [].

    Σ (v − mean)² = Σ d² − (Σ d)²/n, where n is the number of samples and d the difference of a sample from the pixel's
    first. So it is exactly 0 for equal samples.
    """
    block: Any = mi.ArrayXf
    step = math.gcd(film.spp, 8)  # samples read at once: reading 8 takes half the time of reading one by one
    pixels, steps, n = film.width * film.height, dr.opaque(mi.UInt32, film.spp // step), dr.opaque(mi.Float64, film.spp)
    start = dr.arange(mi.UInt32, pixels) * steps
    first = [mi.Float64(dr.gather(mi.Float, channel, start * step)) for channel in values]
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


def _weighted_sums(values: list[Number], position: Point2, film: Film) -> list[Any]:
    """Return Σ w v of every pixel by channel, and Σ w, over the samples that reach it, always added in the same order.

    For each row of neighbours every pixel sums its own samples, with their weights in each of these neighbours.
    """
    x, y = film.pixels()
    totals = [dr.zeros(mi.Float64, film.width * film.height) for _ in (*values, "weight")]
    for j in range(-film.reach, film.reach + 1):
        row = _own_samples(values, position, mi.Float(x), mi.Float(y) + dr.opaque(mi.Float, j), film)
        dr.eval(row)
        for i, sums in zip(range(-film.reach, film.reach + 1), row, strict=True):
            inside, source = film.at(x - i, y - j)
            parts = [dr.gather(mi.Float64, own, source, inside) for own in sums]
            totals = [total + part for total, part in zip(totals, parts, strict=True)]
        dr.eval(totals)
    return totals


@dr.syntax
def _own_samples(values: list[Number], position: Point2, x: Number, y: Number, film: Film) -> list[list[Any]]:
    """Return Σ w v by channel, and Σ w, over the samples of each pixel, with their weights in a row around x, y."""
    spp = dr.opaque(mi.UInt32, film.spp)
    first = dr.arange(mi.UInt32, film.width * film.height) * spp
    row = [[mi.Float64(0) for _ in range(len(values) + 1)] for _ in range(2 * film.reach + 1)]
    k = mi.UInt32(0)
    while k < spp:
        sample = [dr.gather(mi.Float, channel, first + k) for channel in values]
        dx = dr.gather(mi.Float, position.x, first + k) - (x + 0.5)
        weight_y = film.weight(dr.gather(mi.Float, position.y, first + k) - (y + 0.5))
        for i in range(2 * film.reach + 1):
            w = mi.Float64(weight_y * film.weight(dx - (i - film.reach)))
            for c in range(len(values)):
                row[i][c] += w * mi.Float64(sample[c])
            row[i][len(values)] += w
        k += 1
    return row


@dr.syntax
def _squared_sums(values: list[Number], position: Point2, means: list[Number], film: Film) -> list[Any]:
    """Return Σ (z − z̄)² of every pixel by channel, over the samples that reach it, where z = w (v − mean).

    z̄ is the mean of z over the samples in one pixel: their number is fixed, so pixels are strata.
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
                dx = dr.gather(mi.Float, position.x, source * spp + k) - (mi.Float(x) + 0.5)
                dy = dr.gather(mi.Float, position.y, source * spp + k) - (mi.Float(y) + 0.5)
                w = mi.Float64(film.weight(dx) * film.weight(dy))
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
