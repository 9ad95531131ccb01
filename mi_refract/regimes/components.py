"""Families of rays defined by lengths and components: far from unit, zeros, denormal, exactly or nearly critical."""

from __future__ import annotations

import functools

import numpy as np
from numpy.random import Generator

from .angles import mixed, rays_at
from .rays import (
    Array,
    Index,
    Triple,
    either,
    length,
    log_uniform,
    normalised,
    power_of_two,
    radicand_and_gradient,
    rounded,
)


def lengths(rng: Generator, n: Array) -> Triple:
    """|a| and |n| are log-uniform in 1e-18 … 1e18, angles and ratios are those of all families."""
    a, n, k = rays_at(mixed, rng, n)
    length_a, length_n = (log_uniform(rng, 1e-18, 1e18, len(n))[:, None] for _ in range(2))
    return a * length_a, n * length_n, k


def off_unit(rng: Generator, n: Array) -> Triple:
    """Vectors after a change of frame: multiplied by a rotation matrix in the arithmetic of the precision."""
    a, n, k = rays_at(mixed, rng, n)
    turn = np.linalg.qr(rng.normal(size=(len(n), 3, 3)))[0].astype(n.dtype)
    return np.einsum("nij,nj->ni", turn, a.astype(n.dtype)), np.einsum("nij,nj->ni", turn, n), k


def keep_some(rng: Generator, v: Array, most: int) -> Array:
    """Unit vectors from 1 to `most` components of every vector; the others become zeros of either sign."""
    order = np.argsort(rng.random(v.shape), axis=1)
    keep = order < rng.integers(1, most + 1, len(v))[:, None]
    single = keep.sum(1, keepdims=True) == 1
    zeros = np.copysign(0.0, rng.normal(size=v.shape))
    return np.where(keep, normalised(np.where(keep, np.where(single, np.sign(v), v), 0)), zeros)


def zeros(rng: Generator, n: Array) -> Triple:
    """Components of n, and of about half of all a, are replaced by zeros of either sign; no ray is tangential."""
    a, n, k = rays_at(mixed, rng, keep_some(rng, n, 2).astype(n.dtype))
    with_zeros = rng.random(len(n)) < 0.5
    a = np.where(with_zeros[:, None], keep_some(rng, a, 2), a)
    return np.where((a * n).sum(1, keepdims=True) == 0, n, a), n, k


def denormal(rng: Generator, n: Array) -> Triple:
    """The zeros of n, a or both become denormal numbers, below the smallest normal one, 2⁻¹²⁶ or 2⁻¹⁰²²."""
    a, n, k = zeros(rng, n)
    which = rng.integers(1, 4, len(n))[:, None]
    a = np.where((a == 0) & (which & 1 > 0), tiny(rng, n), a)
    return a, np.where((n == 0) & (which & 2 > 0), tiny(rng, n), n), k


def on_a_denormal(rng: Generator, n: Array) -> Triple:
    """n is an axis, and the component of `a` along it is a denormal number: without it `a` would be tangential."""
    count, axis = len(n), rng.integers(0, 3, len(n))
    rows, a = np.arange(count), rng.normal(size=(count, 3))
    a[rows, axis] = 0
    a = normalised(a).astype(float)
    a[rows, axis] = tiny(rng, n)[:, 0]
    normal = np.zeros((count, 3))
    normal[rows, axis] = either(rng, count)
    return a, normal, mixed(rng, count, float(np.finfo(n.dtype).eps))[1]


def tiny(rng: Generator, like: Array) -> Array:
    """Denormal numbers of either sign, in the shape and precision of `like`."""
    limits = np.finfo(like.dtype)
    whole = np.exp2(rng.uniform(0, limits.nmant, like.shape)).round()
    return np.asarray(np.ldexp(whole, limits.minexp - limits.nmant) * rng.choice([-1.0, 1.0], like.shape))


# Exact in spite of rounding: exactly tangential, exactly critical -----------------------------------------------------


def tangential(rng: Generator, n: Array) -> Triple:
    """Half of them are a = n × v in whole numbers, half (x, y, 0) and (−y, x, 0) in some order; times powers of two."""
    count, bits = len(n), np.finfo(n.dtype).nmant // 2 - 1
    whole, v = np.rint(rng.uniform(-(2**bits), 2**bits, (2, count, 3)))
    product = np.cross(whole, v)
    x, y = rounded(normalised(rng.normal(size=(count, 2))), n.dtype).T
    turn, zero = rng.integers(0, 3, count), np.zeros(count)
    # The components are moved cyclically by 0, 1 or 2 places.
    order = (np.arange(3) - turn[:, None]) % 3
    flat_a, flat_n = (np.take_along_axis(np.stack(c, 1), order, axis=1) for c in ((x, y, zero), (-y, x, zero)))
    flat = (rng.random(count) < 0.5) | ~product.any(axis=1)
    a, n = np.where(flat[:, None], flat_a, product), np.where(flat[:, None], flat_n, whole)
    _, k = mixed(rng, count, float(np.finfo(n.dtype).eps))
    return a * power_of_two(rng, count), n * power_of_two(rng, count), k


@functools.cache
def _solutions() -> Array:
    """Whole (x, y, z) and dyadic k with k² (x² + y²) = x² + y² + z²: a = (x, y, z) is critical for n = (0, 0, 1)."""
    k = np.unique(np.concatenate([np.arange(2**m + 1, 2 ** (m + 2)) / 2**m for m in range(1, 7)]))
    x, y = (v.ravel()[1:] for v in np.meshgrid(np.arange(129), np.arange(129)))
    s = (x * x + y * y)[:, None]
    # k² has 12 bits after the point, so s (k² − 1) is exact, and its root is exact if it is whole.
    z = np.rint(np.sqrt(s * (k * k - 1)))
    i, j = np.nonzero((z * z == s * (k * k - 1)) & (z > 0))
    return np.stack([x[i], y[i], z[i, j], k[j]], axis=1)


def exactly_critical(rng: Generator, n: Array) -> Triple:
    """Whole solutions, rotated by the matrix of a whole quaternion, which multiplies all lengths by its square."""
    count = len(n)
    x, y, z, k = _solutions()[rng.integers(0, len(_solutions()), count)].T
    small = rng.integers(-7, 8, (4, count)).astype(float)
    small[0][~small.any(axis=0)] = 1
    w, x_, y_, z_ = small
    ww, xx, yy, zz = small * small
    rotation = np.array(
        [
            [ww + xx - yy - zz, 2 * (x_ * y_ - w * z_), 2 * (x_ * z_ + w * y_)],
            [2 * (x_ * y_ + w * z_), ww - xx + yy - zz, 2 * (y_ * z_ - w * x_)],
            [2 * (x_ * z_ - w * y_), 2 * (y_ * z_ + w * x_), ww - xx - yy + zz],
        ]
    )
    local = np.stack([x * either(rng, count), y * either(rng, count), z * either(rng, count)], axis=1)
    a = np.einsum("ijn,nj->ni", rotation, local)
    return a * power_of_two(rng, count), rotation[:, 2].T * power_of_two(rng, count), k


# As near the critical angle as the precision allows -------------------------------------------------------------------


def to_the_ulp(least: float, most: float, rng: Generator, n: Array) -> Triple:
    """Rays whose exact radicand is as near 0 as one of their numbers can bring it, which is then moved by 0 to 2 ulps.

    k − 1 is log-uniform in `least` … `most`. For a third of the rays that number is k, for the others the component of
    `a` along the axis j that n is farthest from: it starts at 2u … 2⁻². The smaller it is, the finer are its ulps, down
    to a radicand of u² of its terms.
    """
    count, precision, eps = len(n), n.dtype, float(np.finfo(n.dtype).eps)
    wide, rows = n.astype(np.float64), np.arange(count)
    j = np.argmin(np.abs(wide), axis=1)
    k = rounded(1 + log_uniform(rng, least, most, count), precision)
    start = log_uniform(rng, eps, 0.25, count) * either(rng, count)
    a = rounded(_on_the_cone(rng, wide, j, k, start), precision)
    by_k = (rng.random(count) < 1 / 3) | (np.abs(a[rows, j]) > 0.25)
    for _ in range(2):
        d, along = radicand_and_gradient(a, wide, k)
        # If a step would change |a| = 1 by more than u/4, k is changed instead.
        step = d / along[rows, j]
        by_k |= np.abs(step) * (np.abs(a[rows, j]) + np.abs(step)) > eps / 8
        a[rows, j] -= np.where(by_k, 0, step)
        a, k = rounded(a, precision), rounded(k - np.where(by_k, d / along[:, 6], 0), precision)
    ulps = rng.integers(-2, 3, count)
    a[rows, j] += np.where(by_k, 0, ulps) * np.spacing(np.abs(a[rows, j]).astype(precision))
    return a, n, k + np.where(by_k, ulps, 0) * np.spacing(k.astype(precision))


def _on_the_cone(rng: Generator, n: Array, j: Index, k: Array, start: Array) -> Array:
    """Unit a at the critical angle from ±n; its component j is `start`, or the nearest value on that cone."""
    rows, sine, cosine = np.arange(len(n)), 1 / k, np.sqrt((k - 1) * (k + 1)) / k * either(rng, len(n))
    n = n / length(n)[:, None]
    p = -n[rows, j][:, None] * n
    p[rows, j] += 1
    p /= length(p)[:, None]
    cos_turn = np.clip((start - cosine * n[rows, j]) / (sine * p[rows, j]), -1, 1)
    sin_turn = np.sqrt(1 - cos_turn**2) * either(rng, len(n))
    tangent = cos_turn[:, None] * p + sin_turn[:, None] * np.cross(n, p)
    return normalised(cosine[:, None] * n + sine[:, None] * tangent)
