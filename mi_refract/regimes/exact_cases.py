"""Families of rays with a property that rounding does not spoil: exactly tangential, exactly critical."""

from __future__ import annotations

import functools

import numpy as np
from numpy.random import Generator

from .angles import mixed
from .rays import Array, Index, Triple, either, normalised, power_of_two, rounded


def tangential(rng: Generator, n: Array) -> Triple:
    """Half of them a = n × v in whole numbers, half (x, y, 0) and (−y, x, 0) in some order; times powers of two."""
    count, bits = len(n), np.finfo(n.dtype).nmant // 2 - 1
    whole, v = np.rint(rng.uniform(-(2**bits), 2**bits, (2, count, 3)))
    product = np.cross(whole, v)
    x, y = rounded(normalised(rng.normal(size=(count, 2))), n.dtype).T
    turn, zero = rng.integers(0, 3, count), np.zeros(count)
    flat_a, flat_n = (_turned(np.stack(c, axis=1), turn) for c in ((x, y, zero), (-y, x, zero)))
    flat = (rng.random(count) < 0.5) | ~product.any(axis=1)
    a, n = np.where(flat[:, None], flat_a, product), np.where(flat[:, None], flat_n, whole)
    _, k = mixed(rng, count, float(np.finfo(n.dtype).eps))
    return a * power_of_two(rng, count), n * power_of_two(rng, count), k


def _turned(v: Array, turn: Index) -> Array:
    """The components of every vector moved on cyclically by 0, 1 or 2."""
    return np.take_along_axis(v, (np.arange(3) - turn[:, None]) % 3, axis=1)


@functools.cache
def _solutions() -> Array:
    """Whole (x, y, z) and dyadic k with k² (x² + y²) = x² + y² + z²: a = (x, y, z) on n = (0, 0, 1) is critical."""
    k = np.unique(np.concatenate([np.arange(2**m + 1, 2 ** (m + 2)) / 2**m for m in range(1, 7)]))
    x, y = (v.ravel()[1:] for v in np.meshgrid(np.arange(129), np.arange(129)))
    s = (x * x + y * y)[:, None]
    # k² has 12 bits after the point: s (k² − 1) is exact, and so is the root where it is whole.
    z = np.rint(np.sqrt(s * (k * k - 1)))
    i, j = np.nonzero((z * z == s * (k * k - 1)) & (z > 0))
    return np.stack([x[i], y[i], z[i, j], k[j]], axis=1)


def exactly_critical(rng: Generator, n: Array) -> Triple:
    """Whole solutions, turned by the whole matrix of a quaternion, which multiplies all lengths by its own square."""
    count = len(n)
    x, y, z, k = _solutions()[rng.integers(0, len(_solutions()), count)].T
    small = rng.integers(-7, 8, (4, count)).astype(float)
    small[0][~small.any(axis=0)] = 1
    rotation = _rotation(*small)
    local = np.stack([x * either(rng, count), y * either(rng, count), z * either(rng, count)], axis=1)
    a = np.einsum("ijn,nj->ni", rotation, local)
    return a * power_of_two(rng, count), rotation[:, 2].T * power_of_two(rng, count), k


def _rotation(w: Array, x: Array, y: Array, z: Array) -> Array:
    """(3, 3, N): the rotation of the quaternion times w² + x² + y² + z²."""
    ww, xx, yy, zz = w * w, x * x, y * y, z * z
    return np.array(
        [
            [ww + xx - yy - zz, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), ww - xx + yy - zz, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), ww - xx - yy + zz],
        ]
    )
