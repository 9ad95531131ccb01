"""The errors of judged answers outside of the memory, and what is said of them: mean, quantiles, medians.

The numbers are those that NumPy gives for one array of all errors, bit for bit.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mi_refract.io.scratch import Table

_LEAF = 2**17  # numbers that are added by NumPy itself; it adds 128 without cutting them in two
_DIGIT = 16  # bits


class KeptErrors:
    """Those of pieces, by the numbers of the pieces, in any order; `most` of them together."""

    def __init__(self, most: int) -> None:
        """Nothing is kept yet."""
        self._table = Table((most,), np.float64)
        self._runs: dict[int, tuple[int, int]] = {}
        self._end = 0

    def put(self, number: int, errors: np.ndarray) -> None:
        """Keep those of a piece."""
        self._table.write(self._end, errors)
        self._runs[number] = self._end, len(errors)
        self._end += len(errors)

    def of(self, numbers: Iterable[int]) -> SomeErrors:
        """Those of some pieces, one after the other."""
        return SomeErrors(self._table, tuple(self._runs[number] for number in numbers))


@dataclass(frozen=True)
class SomeErrors:
    """KeptErrors from 0 on. `runs`: the first row and the number of rows of each piece."""

    table: Table
    runs: Sequence[tuple[int, int]]

    def __len__(self) -> int:
        """The number of errors."""
        return sum(count for _, count in self.runs)

    def pieces(self) -> Iterator[np.ndarray]:
        """The errors of each piece."""
        for start, count in self.runs:
            yield self.table.read(start, start + count)

    @functools.cached_property
    def _ends(self) -> np.ndarray:
        return np.cumsum([count for _, count in self.runs], dtype=np.int64)

    def _read(self, start: int, stop: int) -> np.ndarray:
        """By their places among all errors."""
        found = []
        for i in range(int(np.searchsorted(self._ends, start, side="right")), len(self.runs)):
            first, count = self.runs[i]
            before = int(self._ends[i]) - count
            if before >= stop:
                break
            found.append(self.table.read(first + max(0, start - before), first + min(count, stop - before)))
        return np.concatenate(found)

    @property
    def largest(self) -> float:
        """NaN where one is, or where there is none."""
        return (
            float(np.max([each.max() for each in self.pieces() if len(each)], initial=-np.inf)) if len(self) else np.nan
        )

    @property
    def mean(self) -> float:
        """NaN where there is none."""
        return self._sum(0, len(self)) / len(self) if len(self) else np.nan

    def _sum(self, start: int, count: int) -> float:
        """As NumPy adds: halves of halves, the first of a multiple of eight."""
        if count <= _LEAF:
            return float(np.add.reduce(self._read(start, start + count)))
        half = count // 2
        half -= half % 8
        return self._sum(start, half) + self._sum(start + half, count - half)

    def quantile(self, share: float) -> float:
        """Linear between two errors; NaN where one is NaN, or where there is none."""
        if math.isnan(self.largest):
            return np.nan
        place = (len(self) - 1) * share
        low, high = (_at(self.pieces, min(math.floor(place) + i, len(self) - 1)) for i in (0, 1))
        if low == high:  # infinite, it may be
            return low
        t = place - math.floor(place)
        return low + (high - low) * t if t < 0.5 else high - (high - low) * (1 - t)


def median(pieces: Callable[[], Iterable[np.ndarray]]) -> float:
    """Of numbers from 0 on, which are asked for several times; NaN where one is NaN, or where there is none."""
    count, nan = 0, False
    for each in pieces():
        count, nan = count + len(each), nan or bool(np.isnan(each).any())
    if nan or not count:
        return np.nan
    return (_at(pieces, (count - 1) // 2) + _at(pieces, count // 2)) / 2


def _at(pieces: Callable[[], Iterable[np.ndarray]], rank: int) -> float:
    """The number of that rank, from 0, among numbers from 0 on: their bits are in the order of the numbers."""
    found = 0
    for shift in range(64 - _DIGIT, -1, -_DIGIT):
        counts = np.zeros(2**_DIGIT, np.int64)
        for each in pieces():
            digits = (each + 0.0).view(np.uint64) >> np.uint64(shift)  # −0 becomes 0
            mine = digits[digits >> np.uint64(_DIGIT) == np.uint64(found)] & np.uint64(2**_DIGIT - 1)
            counts += np.bincount(mine.astype(np.int64), minlength=2**_DIGIT)
        before = np.cumsum(counts) - counts
        digit = int(np.flatnonzero((before <= rank) & (rank < before + counts))[0])
        rank -= int(before[digit])
        found = found << _DIGIT | digit
    return float(np.uint64(found).view(np.float64))
