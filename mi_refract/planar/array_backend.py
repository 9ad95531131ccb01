"""One source for compiled and for scalar arrays: numbers by backend and precision, tables read and written by index.

A compiled backend runs all rays at once, a lane each. Scalar numbers are Python's own: one ray after the other, in
double precision whatever is stored.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.backend import detect

PRECISIONS = ("float32", "float64")
Arrays = dict[str, Any]
Buffer = tuple[Any, tuple[int, ...]]


class Lanes:
    """The types of a compiled backend, "llvm" or "cuda", in a precision."""

    def __init__(self, backend: str, precision: str) -> None:
        self.backend, self.precision = backend, precision
        arrays = getattr(dr, backend).ad
        wide = "64" if precision == "float64" else ""
        self.number = getattr(arrays, f"Float{wide or '32'}")
        self.index, self.mask, self.byte, self.signed = arrays.UInt32, arrays.Bool, arrays.UInt8, arrays.Int32
        self._vectors = {n: getattr(arrays, f"Array{n}f{wide}") for n in (2, 3, 4)}
        self._indices = {1: arrays.UInt32, 2: arrays.Array2u}

    @property
    def vector(self) -> Any:
        return self._vectors[2]

    @property
    def vector3(self) -> Any:
        return self._vectors[3]

    def table(self, values: Any) -> Any:
        """Rows of numbers, or of indices where `values` are whole; one-dimensional or of 2 or 4 columns."""
        values = np.ascontiguousarray(values)
        whole = values.dtype.kind in "iu"
        columns = 1 if values.ndim == 1 else values.shape[1]
        row = self._indices[columns] if whole else self._vectors[columns] if columns > 1 else self.number
        kind = self.index if whole else self.number
        return row, kind(values.ravel().astype(np.uint32 if whole else self.precision, copy=False))

    def gather(self, table: Any, i: Any, active: Any = True) -> Any:
        row, values = table
        return dr.gather(row, values, i, active)

    @property
    def roundoff(self) -> float:
        return float(np.finfo(self.precision).eps) / 2

    def run(self, count: int, buffers: dict[str, Buffer], work: Callable[[Any, Callable[..., None]], None]) -> Arrays:
        """`work(i, put)` for the lanes i < count: `put(name, j, x, active)` sets buffers[name][j, i] = x. As numpy."""
        lane = dr.arange(self.index, count)

        def scatter(name: str, j: Any, x: Any, active: Any) -> None:
            values, _ = buffers[name]
            x = x if isinstance(x, self.vector) else type(values)(x)
            dr.scatter(values, x, j * count + lane, active, mode=dr.ReduceMode.NoConflicts)

        if count:  # Dr.Jit takes no part in an empty array
            work(lane, scatter)
        dr.eval(*(values for values, _ in buffers.values()))
        return {name: values.numpy().reshape(shape) for name, (values, shape) in buffers.items()}

    def buffer(self, kind: Any, value: Any, shape: tuple[int, ...]) -> Buffer:
        """Numbers, or where the shape ends in 2 vectors, all of that value."""
        return dr.full(kind, value, math.prod(shape)), shape


class Scalars(Lanes):
    """The same of Python's own numbers."""

    def __init__(self, precision: str) -> None:
        self.backend, self.precision = "scalar", precision
        self.number, self.index, self.mask, self.byte, self.signed = float, int, bool, np.uint8, np.int32
        self._vectors = {2: dr.scalar.Array2f64, 3: dr.scalar.Array3f64, 4: dr.scalar.Array4f64}
        self._indices = {1: int, 2: dr.scalar.Array2u}

    def table(self, values: Any) -> Any:
        values = np.asarray(values)
        kind = int if values.dtype.kind in "iu" else float
        if values.ndim == 1:
            return [kind(x) for x in values]
        row = (self._indices if kind is int else self._vectors)[values.shape[1]]
        return [row(*map(kind, line)) for line in values]

    def gather(self, table: Any, i: Any, active: Any = True) -> Any:
        return table[i if i < len(table) else 0]

    def run(self, count: int, buffers: dict[str, Buffer], work: Callable[[Any, Callable[..., None]], None]) -> Arrays:
        for lane in range(count):

            def scatter(name: str, j: Any, x: Any, active: Any, lane: int = lane) -> None:
                if active:
                    buffers[name][0][j, lane] = x

            work(lane, scatter)
        return {name: values for name, (values, _) in buffers.items()}

    def buffer(self, kind: Any, value: Any, shape: tuple[int, ...]) -> Buffer:
        return np.full(shape, value, kind), shape


def lanes(backend: str | None, precision: str) -> Lanes:
    """None: the best backend of this machine. ValueError for one that is unknown or cannot run here."""
    if precision not in PRECISIONS:
        raise ValueError(f"precision = {precision!r}; accepted: {', '.join(PRECISIONS)}")
    found = detect()
    backend = backend or ("llvm" if found["llvm"].usable else "scalar")
    if backend not in found:
        raise ValueError(f"backend = {backend!r}; accepted: {', '.join(found)}")
    if not found[backend].usable:
        raise ValueError(f"backend = {backend!r} cannot run here: {found[backend].reason}")
    return Scalars(precision) if backend == "scalar" else Lanes(backend, precision)


def negated(mask: Any) -> Any:
    return not mask if isinstance(mask, bool) else ~mask
