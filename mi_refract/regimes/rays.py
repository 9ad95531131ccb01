"""Sets of rays, their exact radicand, and random numbers for the families of rays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import DTypeLike, NDArray

from mi_refract.numerics import FloatExpansion, Number, Vector3, float_expansions

Array = NDArray[np.floating]
Index = NDArray[np.integer]
# (a, n, k) of shapes (N, 3), (N, 3), (N,), before they are rounded to the precision of the set.
Triple = tuple[Array, Array, Array]
# A function of unit normals (N, 3) in the precision of the set that returns the rays.
Build = Callable[[Generator, Array], Triple]


@dataclass(frozen=True)
class Rays:
    """`a`, `n`: (N, 3); `k`: (N,); all of one precision."""

    a: Array
    n: Array
    k: Array

    def __getitem__(self, index: slice | Index | NDArray[np.bool_]) -> Rays:
        """The rays selected by indices, a slice or a mask."""
        return Rays(self.a[index], self.n[index], self.k[index])

    def __len__(self) -> int:
        """The number of rays."""
        return len(self.k)

    def hexed(self, i: int) -> dict[str, Any]:
        """Ray `i` in hexadecimal floats, which reproduce it bit for bit."""
        a, n = ([float(x).hex() for x in v[i]] for v in (self.a, self.n))
        return {"a": a, "n": n, "k": float(self.k[i]).hex()}

    @staticmethod
    def joined(parts: Sequence[Rays]) -> Rays:
        """The rays of several sets in one set."""
        a, n, k = (np.concatenate([getattr(part, name) for part in parts]) for name in ("a", "n", "k"))
        return Rays(a, n, k)


def log_uniform(rng: Generator, low: float, high: float, count: int) -> Array:
    """`count` numbers whose logarithms are uniform."""
    return np.asarray(np.exp(rng.uniform(np.log(low), np.log(high), count)))


def either(rng: Generator, count: int) -> Array:
    """`count` signs, ±1."""
    return rng.choice(np.array([-1.0, 1.0]), count)


def normalised(v: Array) -> Array:
    """v/|v| for v (N, 3), in extended precision, so that only the rounding of its components changes its length."""
    wide = v.astype(np.longdouble)
    return np.asarray(wide / np.sqrt((wide * wide).sum(1, keepdims=True)))


def length(v: Array) -> Array:
    """(N,) the lengths of vectors (N, 3), in the precision of `v`."""
    lengths: Array = np.sqrt((v * v).sum(1))
    return lengths


def rounded(x: Array, precision: DTypeLike) -> Array:
    """`x` rounded to `precision`, as float64."""
    return x.astype(precision).astype(np.float64)


def power_of_two(rng: Generator, count: int) -> Array:
    """(N, 1) random powers of two from 2⁻¹² to 2¹²."""
    return np.exp2(rng.integers(-12, 13, count))[:, None]


# The radicand of Snell's law, accurate also where its terms cancel ---------------------------------------------------


def radicand(a: Vector3, n: Vector3, k: Number) -> tuple[FloatExpansion, FloatExpansion, Number]:
    """(n·a, D, T): D = (n·a)² − κ |n×a|², κ = k² − 1, which is negative under total internal reflection.

    `a`, `n`: three components each. T = (n·a)² + |κ| |n×a|², to a few u; the error of D is at most 2⁻¹⁴⁰ T.
    """
    c = float_expansions.dot(n, a)
    kappa = float_expansions.distil([*float_expansions.two_prod(k, k), 0 * k - 1])
    w2 = float_expansions.distil(
        [part for w in float_expansions.cross(n, a) for part in float_expansions.product(w, w)]
    )
    first, second = float_expansions.product(c, c), float_expansions.product(kappa, w2)
    return c, float_expansions.distil([*first, *float_expansions.negated(second)]), first[0] + abs(second[0])


def radicand_and_gradient(a: Array, n: Array, k: Array) -> tuple[Array, Array]:
    """D = k² c² − κ |a|²|n|² of exactly these numbers (N,), and its derivatives in a, n and k (N, 7). float64."""
    c, d, _ = radicand(a.T, n.T, k)
    aa, nn, k2c, kappa = (a * a).sum(1), (n * n).sum(1), k * k * c[0], k * k - 1
    along_a = 2 * (k2c[:, None] * n - (kappa * nn)[:, None] * a)
    along_n = 2 * (k2c[:, None] * a - (kappa * aa)[:, None] * n)
    along = np.column_stack([along_a, along_n, -2 * k * (aa * nn - c[0] ** 2)])
    return d[0], np.where(along == 0, 1e-300, along)
