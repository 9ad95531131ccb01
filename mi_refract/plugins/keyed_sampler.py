"""Random numbers for a tree of paths: each node has dimensions of its own, stratified over the samples of a pixel.

A Mitsuba sampler counts dimensions in the order in which numbers are drawn: a path that draws one number more would
shift the dimensions of all that follow. Here a number depends on its key, not on what was drawn before.
Correlated multi-jittered sampling (Kensler 2013), with Mitsuba's permutation.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr

ONE = 1 - 2.0**-24  # the largest float32 below 1


class Sampled:
    """The scene's own sampler: numbers in the order in which they are drawn; keys are ignored."""

    def one(self, sampler: Any, key: Any) -> Any:
        """A number in [0, 1)."""
        return sampler.next_1d()

    def two(self, sampler: Any, key: Any) -> Any:
        """A point in [0, 1)²."""
        return sampler.next_2d()


class KeyedMultijitter:
    """Stratified numbers for the lanes of a wavefront, in which the samples of a pixel lie side by side.

    The scene's sampler seeds them: it alone knows the seed and the pass of every render, also where another integrator
    calls this one.
    """

    def __init__(self, v: Any, sampler: Any, count: int) -> None:
        """Draw a point of the sampler as the seed of each pixel.

        `v`: the variant's module. `sampler`: seeded, one lane a sample. `count`: samples of a pixel in this wavefront.
        """
        self.v, lanes = v, sampler.wavefront_size()
        # A symbolic loop cannot read another lane, so there each lane is a pixel of its own.
        self.count = count if lanes % count == 0 and not dr.flag(dr.JitFlag.SymbolicScope) else 1
        self.rows = next(r for r in range(math.isqrt(self.count), 0, -1) if self.count % r == 0)
        self.columns = self.count // self.rows
        self.lane = dr.arange(v.UInt32, lanes)
        pixel = self.lane // self.count
        self.index = self.lane - pixel * self.count
        seed = v.sample_tea_32(*(dr.reinterpret_array(v.UInt32, x) for x in dr.detach(sampler.next_2d())))[0]
        if self.count > 1:
            seed = dr.gather(v.UInt32, seed, self.lane - self.index)  # of the first lane of the pixel
        self.pixel = v.sample_tea_32(pixel, seed)[0]

    def one(self, sampler: Any, key: Any) -> Any:
        """A number in [0, 1): n samples of a pixel with the same key lie in n equal intervals, one in each."""
        v, (permutation, noise) = self.v, self.v.sample_tea_32(self.pixel, key)
        stratum = v.permute_kensler(self.index, self.count, permutation)
        return self._placed(v.Float(stratum), self._unit(v.sample_tea_32(self.lane, noise)[0]), self.count)

    def two(self, sampler: Any, key: Any) -> Any:
        """A point in [0, 1)²: stratified in cells of rows × columns, and in x and in y alone."""
        v, (of_cells, noise) = self.v, self.v.sample_tea_32(self.pixel, key)
        # Seeds that differ by a known constant give permutations that depend on each other: each has a hash of its own.
        of_rows, of_columns = v.sample_tea_32(noise, of_cells)
        cell = v.permute_kensler(self.index, self.count, of_cells)
        row = cell // self.columns
        column = cell - row * self.columns
        # Within its cell a sample has a row and a column to itself, too.
        inner_row = v.permute_kensler(row, self.rows, of_rows)
        inner_column = v.permute_kensler(column, self.columns, of_columns)
        x, y = (self._unit(word) for word in v.sample_tea_32(self.lane, noise))
        x = self._placed(v.Float(inner_row), x, self.rows)
        y = self._placed(v.Float(inner_column), y, self.columns)
        return v.Point2f(self._placed(column, x, self.columns), self._placed(row, y, self.rows))

    def _unit(self, word: Any) -> Any:
        """24 bits as a number in [0, 1)."""
        return self.v.Float(word >> 8) * 2.0**-24

    def _placed(self, stratum: Any, x: Any, count: int) -> Any:
        return dr.minimum((self.v.Float(stratum) + x) * (1 / count), ONE)
