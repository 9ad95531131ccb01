"""Families of rays given by lengths and components: far from unit, zeros of either sign, denormal numbers."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from .angles import mixed, rays_at
from .rays import Array, Triple, either, log_uniform, normalised


def lengths(rng: Generator, n: Array) -> Triple:
    """|a| and |n| log-uniform in 1e-18 … 1e18, angles and ratios of all families."""
    a, n, k = rays_at(mixed, rng, n)
    of_a, of_n = (log_uniform(rng, 1e-18, 1e18, len(n))[:, None] for _ in range(2))
    return a * of_a, n * of_n, k


def off_unit(rng: Generator, n: Array) -> Triple:
    """Vectors after a change of frame: each times a matrix, both rounded, in the precision's own arithmetic."""
    a, n, k = rays_at(mixed, rng, n)
    turn = np.linalg.qr(rng.normal(size=(len(n), 3, 3)))[0].astype(n.dtype)
    return np.einsum("nij,nj->ni", turn, a.astype(n.dtype)), np.einsum("nij,nj->ni", turn, n), k


def keep_some(rng: Generator, v: Array, most: int) -> Array:
    """Between 1 and `most` components of every vector, unit again; the others are zeros of either sign."""
    order = np.argsort(rng.random(v.shape), axis=1)
    kept = order < rng.integers(1, most + 1, len(v))[:, None]
    lone = kept.sum(1, keepdims=True) == 1
    zeros = np.copysign(0.0, rng.normal(size=v.shape))
    return np.where(kept, normalised(np.where(kept, np.where(lone, np.sign(v), v), 0)), zeros)


def zeros(rng: Generator, n: Array) -> Triple:
    """Components of n, and of every other a, replaced by zeros of either sign; no ray is tangential."""
    a, n, k = rays_at(mixed, rng, keep_some(rng, n, 2).astype(n.dtype))
    some = rng.random(len(n)) < 0.5
    a = np.where(some[:, None], keep_some(rng, a, 2), a)
    return np.where((a * n).sum(1, keepdims=True) == 0, n, a), n, k


def denormal(rng: Generator, n: Array) -> Triple:
    """The zeros of n, of a or of both become numbers below the smallest normal one, 2⁻¹²⁶ or 2⁻¹⁰²²."""
    a, n, k = zeros(rng, n)
    which = rng.integers(1, 4, len(n))[:, None]
    a = np.where((a == 0) & (which & 1 > 0), tiny(rng, n), a)
    return a, np.where((n == 0) & (which & 2 > 0), tiny(rng, n), n), k


def on_a_denormal(rng: Generator, n: Array) -> Triple:
    """n an axis, and a denormal number along it is all that keeps `a` from being tangential."""
    count, axis = len(n), rng.integers(0, 3, len(n))
    rows, a = np.arange(count), rng.normal(size=(count, 3))
    a[rows, axis] = 0
    a = normalised(a).astype(float)
    a[rows, axis] = tiny(rng, n)[:, 0]
    normal = np.zeros((count, 3))
    normal[rows, axis] = either(rng, count)
    return a, normal, mixed(rng, count, float(np.finfo(n.dtype).eps))[1]


def tiny(rng: Generator, like: Array) -> Array:
    """Denormal numbers of either sign."""
    limits = np.finfo(like.dtype)
    whole = np.exp2(rng.uniform(0, limits.nmant, like.shape)).round()
    return np.ldexp(whole, limits.minexp - limits.nmant) * rng.choice([-1.0, 1.0], like.shape)
