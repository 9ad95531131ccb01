"""Random numbers for a tree of paths: a dimension each for every node, stratified over the samples of a pixel.

A Mitsuba sampler counts its dimensions as they are drawn, so what one path draws would move those of the next. Here a
number belongs to a key, whatever was drawn before. Correlated multi-jitter (Kensler 2013), by Mitsuba's permutation.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr

ONE = 1 - 2.0**-24  # the largest float32 below 1


class Sampled:
    """The scene's own sampler, in the order in which numbers are drawn; keys count for nothing."""

    def one(self, sampler: Any, key: Any) -> Any:
        return sampler.next_1d()

    def two(self, sampler: Any, key: Any) -> Any:
        return sampler.next_2d()


class KeyedMultijitter:
    """Of the lanes of a wavefront, pixel by pixel `sampler.sample_count()` of them; `v` is the variant's module."""

    def __init__(self, v: Any, sampler: Any, seed: Any) -> None:
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
        v, (permutation, noise) = self.v, self.v.sample_tea_32(self.pixel, key)
        stratum = v.permute_kensler(self.index, self.count, permutation)
        return self._placed(v.Float(stratum), self._unit(v.sample_tea_32(self.lane, noise)[0]), self.count)

    def two(self, sampler: Any, key: Any) -> Any:
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
