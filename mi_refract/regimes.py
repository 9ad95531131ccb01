"""Named, replayable sets of rays: where formulas of refraction are at ease, and where they are not.

Each regime draws angles and ratios k; `make` turns them into unit vectors, rounds everything to the wanted
precision and returns what was rounded. The same name, count, precision and seed give the same rays.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import DTypeLike, NDArray

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Rays:
    """`a`, `n`: (N, 3), unit up to rounding; `k`: (N,); all of one precision."""

    a: Array
    n: Array
    k: Array


@dataclass(frozen=True)
class Regime:
    """`draw(rng, count)` gives (angle of incidence in radians, k); `largest_k` bounds k; `text` defines the set."""

    draw: Callable[[Generator, int], tuple[Array, Array]]
    largest_k: float
    text: str


def _log_uniform(rng: Generator, low: float, high: float, count: int) -> Array:
    return np.exp(rng.uniform(np.log(low), np.log(high), count))


def _either(rng: Generator, count: int) -> Array:
    return rng.choice([-1.0, 1.0], count)


def _generic(rng: Generator, count: int) -> tuple[Array, Array]:
    return np.arccos(rng.uniform(0, 1, count)), 1.5 ** _either(rng, count)


def _near_normal(rng: Generator, count: int) -> tuple[Array, Array]:
    return _log_uniform(rng, 1e-12, 1e-2, count), rng.uniform(0.4, 2.5, count)


def _grazing(rng: Generator, count: int) -> tuple[Array, Array]:
    return np.pi / 2 - _log_uniform(rng, 1e-7, 1e-2, count), rng.uniform(0.4, 2.5, count)


def _critical(rng: Generator, count: int) -> tuple[Array, Array]:
    k = rng.uniform(1.05, 2.5, count)
    return np.arcsin(1 / k) + _log_uniform(rng, 1e-7, 1e-2, count) * _either(rng, count), k


def _matched(rng: Generator, count: int) -> tuple[Array, Array]:
    k = 1 + _log_uniform(rng, 1e-7, 1e-2, count) * _either(rng, count)
    return np.pi / 2 - _log_uniform(rng, 1e-7, 1e-1, count), k


def _steep(rng: Generator, count: int) -> tuple[Array, Array]:
    k = _log_uniform(rng, 10, 1e6, count)
    return np.arcsin(np.minimum(1, rng.uniform(0, 1.2, count) / k)), k


def _dense(rng: Generator, count: int) -> tuple[Array, Array]:
    return np.arccos(rng.uniform(0, 1, count)), _log_uniform(rng, 1e-6, 1e-1, count)


REGIMES = {
    "generic": Regime(_generic, 1.5, "cosine uniform, k = 1.5 or 1/1.5"),
    "near-normal": Regime(_near_normal, 2.5, "1e-12 … 1e-2 rad from the normal, k in 0.4 … 2.5"),
    "grazing": Regime(_grazing, 2.5, "1e-7 … 1e-2 rad from the surface, k in 0.4 … 2.5"),
    "critical": Regime(_critical, 2.5, "within 1e-7 … 1e-2 rad of the critical angle, both sides, k in 1.05 … 2.5"),
    "matched, grazing": Regime(_matched, 1.01, "|k − 1| in 1e-7 … 1e-2, 1e-7 … 1e-1 rad from the surface"),
    "k ≫ 1": Regime(_steep, 1e6, "k in 10 … 1e6, k sin θ uniform in 0 … 1.2"),
    "k ≪ 1": Regime(_dense, 0.1, "k in 1e-6 … 0.1, cosine uniform"),
}


def make(name: str, count: int, precision: DTypeLike, seed: int = 0) -> Rays:
    """`count` rays of a regime in `precision`, float32 or float64, normals on either side. KeyError: no such regime."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    angle, k = REGIMES[name].draw(rng, count)
    n = _unit(rng.normal(size=(count, 3))).astype(precision)
    tangent = _unit(np.cross(n, rng.normal(size=(count, 3))))
    side = _either(rng, count)[:, None]
    a = np.cos(angle)[:, None] * side * _unit(n.astype(np.float64)) + np.sin(angle)[:, None] * tangent
    return Rays(a.astype(precision), n, k.astype(precision))


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=1, keepdims=True)
