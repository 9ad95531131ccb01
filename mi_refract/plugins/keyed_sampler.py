"""Random numbers for a tree of paths: each node has a dimension of its own, stratified over the samples of a pixel.

A Mitsuba sampler counts dimensions in the order in which numbers are drawn: a path that draws one number more would
shift the dimensions of all that follow. Here the number depends on a key only, not on what was drawn before.
Correlated multi-jitter (Kensler 2013), with Mitsuba's permutation.
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
    """Stratified numbers for the lanes of a wavefront, in which the samples of a pixel lie side by side."""

    def __init__(self, v: Any, sampler: Any, seed: Any) -> None:
        """`v`: the variant's module. `sampler`: says how many lanes there are, and samples in a pixel."""
        self.v, lanes = v, sampler.wavefront_size()
        self.count = sampler.sample_count() if lanes % sampler.sample_count() == 0 else 1
        self.rows = next(r for r in range(math.isqrt(self.count), 0, -1) if self.count % r == 0)
        self.columns = self.count // self.rows
        self.lane, seed = dr.arange(v.UInt32, lanes), v.UInt32(seed)
        dr.make_opaque(seed)  # a new seed is new data, not a new kernel
        pixel = self.lane // self.count
        self.index = self.lane - pixel * self.count
        self.pixel = v.sample_tea_32(pixel, seed)[0]

    def one(self, sampler: Any, key: Any) -> Any:
        """A number in [0, 1): n samples of a pixel with the same key lie in n equal intervals, one in each."""
        v, (permutation, noise) = self.v, self.v.sample_tea_32(self.pixel, key)
        stratum = v.permute_kensler(self.index, self.count, permutation)
        return self._placed(v.Float(stratum), self._unit(v.sample_tea_32(self.lane, noise)[0]), self.count)

    def two(self, sampler: Any, key: Any) -> Any:
        """A point in [0, 1)²: stratified in cells of rows × columns, and in x and in y alone."""
        v, (permutation, noise) = self.v, self.v.sample_tea_32(self.pixel, key)
        cell = v.permute_kensler(self.index, self.count, permutation)
        row = cell // self.columns
        column = cell - row * self.columns
        # Within its cell a sample has a row and a column to itself, too.
        inner_row = v.permute_kensler(row, self.rows, permutation ^ 0x68BC21EB)
        inner_column = v.permute_kensler(column, self.columns, permutation ^ 0x02E5BE93)
        x, y = (self._unit(word) for word in v.sample_tea_32(self.lane, noise))
        x = self._placed(v.Float(inner_row), x, self.rows)
        y = self._placed(v.Float(inner_column), y, self.columns)
        return v.Point2f(self._placed(column, x, self.columns), self._placed(row, y, self.rows))

    def _unit(self, word: Any) -> Any:
        """24 bits as a number in [0, 1)."""
        return self.v.Float(word >> 8) * 2.0**-24

    def _placed(self, stratum: Any, x: Any, count: int) -> Any:
        return dr.minimum((self.v.Float(stratum) + x) * (1 / count), ONE)
