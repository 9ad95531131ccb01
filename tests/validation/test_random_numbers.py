"""The study of random numbers sees numbers that leave cells of the square empty."""

import pytest

from mi_refract.plugins.sampling import KeyedMultijitter
from validation.renders import random_numbers


class OneSeed(KeyedMultijitter):
    """Rows and columns are permuted by the seed of the cells, changed by constants: as this package once did."""

    def next_2d(self, sampler, key):
        v, (permutation, noise) = self.v, self.v.sample_tea_32(self.pixel, key)
        cell = v.permute_kensler(self.index, self.count, permutation)
        row = cell // self.columns
        column = cell - row * self.columns
        inner_row = v.permute_kensler(row, self.rows, permutation ^ 0x68BC21EB)
        inner_column = v.permute_kensler(column, self.columns, permutation ^ 0x02E5BE93)
        x, y = (v.Float(word >> 8) * 2.0**-24 for word in v.sample_tea_32(self.lane, noise))
        x, y = (inner_row + x) / self.rows, (inner_column + y) / self.columns
        return v.Point2f((column + x) / self.columns, (row + y) / self.rows)


class Unpermuted(KeyedMultijitter):
    """The samples of a pixel in the same order in every dimension."""

    def next_1d(self, sampler, key):
        noise = self._unit(self.v.sample_tea_32(self.lane, key)[0])
        return self._placed(self.v.Float(self.index), noise, self.count)


@pytest.mark.parametrize(
    ("source", "count", "failing"),
    [
        (KeyedMultijitter, 16, set()),
        (OneSeed, 4, {"two"}),
        (OneSeed, 64, {"two"}),
        (Unpermuted, 16, {"one", "one and one"}),
    ],
)
def test_numbers_that_do_not_fill_the_square_are_seen(llvm_variant, source, count, failing):
    found = random_numbers.rows(llvm_variant, (count,), 1, source)
    assert {row.case.split(",")[0] for row in found if row.broken} == failing
