"""Numbers outside of the memory: in files without a name, which are gone with the process, however that ends."""

from __future__ import annotations

import math
import os
import tempfile
import weakref
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import DTypeLike, NDArray

IN_MEMORY = 2**24  # bytes: fewer stay in memory
_SCATTERED = 2**11  # rows that are mapped at once: each may bring 64 KiB around it into the memory, 128 MiB in all
_ZEROS = 2**20  # bytes at once
Numbers = NDArray[Any]


class Table:
    """Rows of one type, zeros at first. Each call maps the rows that it needs, and lets go of them.

    What was asked for is reserved on the disk at once: OSError, one line, where there is no room.
    """

    def __init__(self, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        """`shape`: (rows,) or (rows, width)."""
        self.shape, self.dtype = shape, np.dtype(dtype)
        size = math.prod(shape) * self.dtype.itemsize
        self._array: Numbers | None = np.zeros(shape, dtype) if size <= IN_MEMORY else None
        if self._array is None:
            self._file = _temporary(size)
            weakref.finalize(self, self._file.close)

    def __len__(self) -> int:
        """The number of rows."""
        return self.shape[0]

    def _rows(self) -> Numbers:
        if self._array is not None:
            return self._array
        return np.memmap(self._file, self.dtype, "r+", shape=self.shape)

    def read(self, start: int, stop: int) -> Numbers:
        """Those from `start` on, before `stop`."""
        return np.array(self._rows()[start:stop])

    def take(self, rows: NDArray[np.integer[Any]]) -> Numbers:
        """Those of these numbers."""
        found = np.empty((len(rows), *self.shape[1:]), self.dtype)
        for start in range(0, len(rows), _SCATTERED):
            found[start : start + _SCATTERED] = self._rows()[rows[start : start + _SCATTERED]]
        return found

    def write(self, start: int, values: Numbers) -> None:
        """Put rows in place of those from `start` on."""
        self._rows()[start : start + len(values)] = values

    def put(self, rows: NDArray[np.integer[Any]], values: Numbers) -> None:
        """Put rows in place of those of these numbers."""
        for start in range(0, len(rows), _SCATTERED):
            self._rows()[rows[start : start + _SCATTERED]] = values[start : start + _SCATTERED]


class Log:
    """Numbers in float64 or int64 that are only added to, and read in their order; how many is not known before."""

    def __init__(self, dtype: DTypeLike, width: int = 1) -> None:
        """`width` numbers make a row."""
        self.dtype, self.width, self.rows = np.dtype(dtype), width, 0
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY)  # noqa: SIM115 (closed with the log)
        weakref.finalize(self, self._file.close)

    def append(self, values: Numbers) -> None:
        """Add (N, width) or, of width 1, (N,)."""
        self._file.write(np.ascontiguousarray(values, self.dtype).tobytes())
        self.rows += len(values)

    def pieces(self, step: int) -> Iterator[Numbers]:
        """(n, width) each, n up to `step`. Nothing is added meanwhile."""
        self._file.seek(0)
        while data := self._file.read(step * self.width * self.dtype.itemsize):
            yield np.frombuffer(data, self.dtype).reshape(-1, self.width)


def _temporary(size: int) -> BinaryIO:
    """A file without a name, of so many zeros, whose room is its own: a full disk is an error here, and not later."""
    file: BinaryIO = tempfile.TemporaryFile()  # noqa: SIM115 (closed with its table)
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:
            for start in range(0, size, _ZEROS):
                file.write(bytes(min(_ZEROS, size - start)))
            file.flush()
    except OSError as error:
        file.close()
        why = f"{tempfile.gettempdir()}: no room for {size} bytes: {error.strerror}"
        raise OSError(f"{why}; expected a folder for temporary files that has it, in TMPDIR") from None
    return file
