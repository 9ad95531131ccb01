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
        return Rays(self.a[index], self.n[index], self.k[index])

    def __len__(self) -> int:
        return len(self.k)

    def hexed(self, i: int) -> dict[str, Any]:
        """Ray `i`, to the last bit."""
        a, n = ([float(x).hex() for x in v[i]] for v in (self.a, self.n))
        return {"a": a, "n": n, "k": float(self.k[i]).hex()}

    @staticmethod
    def joined(parts: Sequence[Rays]) -> Rays:
        a, n, k = (np.concatenate([getattr(part, name) for part in parts]) for name in ("a", "n", "k"))
        return Rays(a, n, k)


def log_uniform(rng: Generator, low: float, high: float, count: int) -> Array:
    return np.exp(rng.uniform(np.log(low), np.log(high), count))


def either(rng: Generator, count: int) -> Array:
    return rng.choice([-1.0, 1.0], count)


def normalised(v: Array) -> Array:
    """In extended precision: what is rounded from it is unit up to that rounding."""
    wide = v.astype(np.longdouble)
    return wide / np.sqrt((wide * wide).sum(1, keepdims=True))


def length(v: Array) -> Array:
    return np.sqrt((v * v).sum(1))


def rounded(x: Array, precision: DTypeLike) -> Array:
    return x.astype(precision).astype(np.float64)


def power_of_two(rng: Generator, count: int) -> Array:
    return np.exp2(rng.integers(-12, 13, count))[:, None]
