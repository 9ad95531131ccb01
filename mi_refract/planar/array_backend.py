"""Compiled and scalar arrays behind one interface: number types by backend and precision, tables, output buffers.

A compiled backend (LLVM, CUDA) follows all rays at once. The scalar backend follows one ray after the other with
Python's own numbers, in double precision.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.backend import detect
from mi_refract.numerics import Mask, aligned

Index = Any  # a Python int, or a Dr.Jit array of uint32
Vector2 = Any  # x and y, two Numbers
Vertices = Any  # two Indices: the numbers of a start and an end
Table = Any  # rows to gather from; see `ArrayBackend.table`
Buffer = tuple[Any, Any, tuple[int, ...]]  # type, fill value, and shape; a last dimension of 2 holds vectors
Scatter = Callable[[str, Index, Any, Mask], None]  # (name of a buffer, row, value, active)


class ArrayBackend:
    """Types and memory access of a compiled backend, "llvm" or "cuda", in one precision."""

    def __init__(self, backend: str, precision: str) -> None:
        """The backend must be able to run here: `choose_backend` checks that."""
        self.name, self.precision, arrays = backend, precision, getattr(dr, backend).ad
        wide = "64" if precision == "float64" else ""
        self._set_types(getattr(arrays, f"Float{wide or '32'}"), arrays, wide)
        self.index, self.mask, self.byte, self.signed = arrays.UInt32, arrays.Bool, arrays.UInt8, arrays.Int32

    def _set_types(self, number: Any, arrays: Any, wide: str) -> None:
        """Set `number`, `vector` (in the plane), `vector3` (in space), and `roundoff`: u, half the machine epsilon."""
        self.number, self.roundoff = number, float(np.finfo(self.precision).eps) / 2
        self._vectors = {n: getattr(arrays, f"Array{n}f{wide}") for n in (2, 3, 4)}
        self.vector, self.vector3, self._pair = self._vectors[2], self._vectors[3], arrays.Array2u

    def table(self, values: Any) -> Table:
        """A numpy array (N, N × 2 or N × 4; whole numbers become indices) as a table of N rows to `gather`."""
        values = np.ascontiguousarray(values)
        whole = values.dtype.kind in "iu"
        columns = 1 if values.ndim == 1 else values.shape[1]
        kind = self.index if whole else self.number
        row = kind if columns == 1 else self._pair if whole else self._vectors[columns]
        return row, kind(aligned(values.ravel(), np.dtype(np.uint32 if whole else self.precision)))

    def gather(self, table: Table, i: Index, active: Mask = True) -> Any:
        """Row i of a table; meaningless where not `active`."""
        row, values = table
        return dr.gather(row, values, i, active)

    def uniform(self, kind: Any, *values: Any) -> Any:
        """A number or vector of type `kind` that is the same for all rays, and not a constant in a kernel's code."""
        return dr.opaque(kind, values[0]) if len(values) == 1 else kind(*(dr.opaque(self.number, x) for x in values))

    def run(
        self, count: int, buffers: dict[str, Buffer], work: Callable[[Index, Scatter], None]
    ) -> dict[str, np.ndarray]:
        """Run `work(i, scatter)` for all i < count, and return the buffers as numpy arrays.

        `scatter(name, j, x, active)` sets buffers[name][j, i] = x where `active`.
        """
        filled = {name: dr.full(kind, value, math.prod(shape)) for name, (kind, value, shape) in buffers.items()}
        lane, stride = dr.arange(self.index, count), self.uniform(self.index, count)

        def scatter(name: str, j: Index, x: Any, active: Mask) -> None:
            x = x if isinstance(x, self.vector) else type(filled[name])(x)
            dr.scatter(filled[name], x, j * stride + lane, active, mode=dr.ReduceMode.NoConflicts)

        if count:  # Dr.Jit rejects an empty array
            # With fast math CUDA's quotients are approximations, and its compiler fuses their last product with a sum
            # in one kernel and not in another.
            fast = self.name != "cuda" and dr.flag(dr.JitFlag.FastMath)
            with dr.scoped_set_flag(dr.JitFlag.FastMath, fast):
                work(lane, scatter)
        dr.eval(*filled.values())
        return {name: values.numpy().reshape(buffers[name][2]) for name, values in filled.items()}


class ScalarBackend(ArrayBackend):
    """The same interface with Python's own numbers, in double precision."""

    def __init__(self) -> None:
        """Takes no arguments: the precision is float64."""
        self.name, self.precision = "scalar", "float64"
        self._set_types(float, dr.scalar, "64")
        self.index, self.mask, self.byte, self.signed = int, bool, np.uint8, np.int32

    def table(self, values: Any) -> Table:
        """The rows as a list."""
        values = np.asarray(values)
        kind = int if values.dtype.kind in "iu" else float
        if values.ndim == 1:
            return [kind(x) for x in values]
        row = self._pair if kind is int else self._vectors[values.shape[1]]
        return [row(*map(kind, line)) for line in values]

    def gather(self, table: Table, i: Index, active: Mask = True) -> Any:
        """Row i, or row 0 if row i does not exist: then it is not `active`."""
        return table[i if i < len(table) else 0]

    def uniform(self, kind: Any, *values: Any) -> Any:
        """The number or vector itself."""
        return kind(*values)

    def run(
        self, count: int, buffers: dict[str, Buffer], work: Callable[[Index, Scatter], None]
    ) -> dict[str, np.ndarray]:
        """As for compiled backends, one i after the other."""
        filled = {name: np.full(shape, value, kind) for name, (kind, value, shape) in buffers.items()}
        for lane in range(count):

            def scatter(name: str, j: Index, x: Any, active: Mask, lane: int = lane) -> None:
                if active:
                    filled[name][j, lane] = x

            work(lane, scatter)
        return filled


def choose_backend(name: str | None, precision: str) -> ArrayBackend:
    """The backend of that name ("llvm", "cuda" or "scalar"); None: LLVM where it runs, else scalar.

    ValueError for an unknown name or precision, a backend that cannot run here, and float32 on the scalar backend,
    which computes in double.
    """
    if precision not in ("float32", "float64"):
        raise ValueError(f"precision = {precision!r}; expected float32, float64")
    backends = detect()
    llvm = backends["llvm"]
    name = name or ("llvm" if llvm.usable else "scalar")
    if name not in backends:
        raise ValueError(f"backend = {name!r}; expected {', '.join(backends)}")
    if not backends[name].usable:
        raise ValueError(f"backend = {name!r} cannot run here: {backends[name].reason}")
    if name != "scalar":
        return ArrayBackend(name, precision)
    if precision == "float32":
        expected = "float64, or a compiled backend (llvm, cuda)"
        missing = "" if llvm.usable else f"; llvm cannot run here: {llvm.reason}"
        raise ValueError(f"precision = 'float32': scalar arrays compute in double; expected {expected}{missing}")
    return ScalarBackend()


def negated(mask: Mask) -> Mask:
    """Not `mask`, for Dr.Jit masks and Python bools (`~True` is −2)."""
    return not mask if isinstance(mask, bool) else ~mask
