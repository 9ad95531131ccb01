"""Sets of rays, and what several families of rays draw them with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import DTypeLike, NDArray

Array = NDArray[np.floating]
Index = NDArray[np.integer]
# (a, n, k) of shapes (N, 3), (N, 3), (N,), not yet rounded to the precision that is wanted.
Triple = tuple[Array, Array, Array]
# From unit normals (N, 3) in the precision that is wanted to the rays.
Build = Callable[[Generator, Array], Triple]


@dataclass(frozen=True)
class Rays:
    """`a`, `n`: (N, 3); `k`: (N,); all of one precision."""

    a: Array
    n: Array
    k: Array

    def __getitem__(self, index: Any) -> Rays:
        """The rays that an index, a slice or a mask chooses."""
        return Rays(self.a[index], self.n[index], self.k[index])

    def __len__(self) -> int:
        """The number of rays."""
        return len(self.k)

    def hexed(self, i: int) -> dict[str, Any]:
        """Ray `i` in hexadecimal floats, which replay it to the last bit."""
        a, n = ([float(x).hex() for x in v[i]] for v in (self.a, self.n))
        return {"a": a, "n": n, "k": float(self.k[i]).hex()}

    @staticmethod
    def joined(parts: Sequence[Rays]) -> Rays:
        """All rays of several sets, one after the other."""
        a, n, k = (np.concatenate([getattr(part, name) for part in parts]) for name in ("a", "n", "k"))
        return Rays(a, n, k)


def log_uniform(rng: Generator, low: float, high: float, count: int) -> Array:
    """`count` numbers whose logarithms are uniform."""
    return np.exp(rng.uniform(np.log(low), np.log(high), count))


def either(rng: Generator, count: int) -> Array:
    """`count` signs, ±1."""
    return rng.choice([-1.0, 1.0], count)


def normalised(v: Array) -> Array:
    """v/|v| of (N, 3), in extended precision: rounded, it is unit up to the rounding of its components."""
    wide = v.astype(np.longdouble)
    return wide / np.sqrt((wide * wide).sum(1, keepdims=True))


def length(v: Array) -> Array:
    """(N,) of (N, 3), in the precision of `v`."""
    return np.sqrt((v * v).sum(1))


def rounded(x: Array, precision: DTypeLike) -> Array:
    """`x` rounded to `precision`, as float64."""
    return x.astype(precision).astype(np.float64)


def power_of_two(rng: Generator, count: int) -> Array:
    """(N, 1): powers of two from 2⁻¹² to 2¹²."""
    return np.exp2(rng.integers(-12, 13, count))[:, None]
