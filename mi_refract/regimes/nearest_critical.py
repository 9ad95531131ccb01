"""Families of rays as near to the critical angle as their precision allows."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from .radicand import radicand_and_gradient
from .rays import Array, Index, Triple, either, length, log_uniform, normalised, rounded

_STEPS = 2


def to_the_ulp(least: float, most: float, rng: Generator, n: Array) -> Triple:
    """Rays whose exact radicand is as near to 0 as one number among them can bring it, then up to two ulps aside.

    k − 1 is log-uniform in `least` … `most`. For a third of them that number is k, for the rest the component of `a`
    along the axis j that n is farthest from: it starts at 2u … 2⁻², and the smaller it is the finer are its ulps, down
    to a radicand of u² of its terms.
    """
    count, precision, eps = len(n), n.dtype, float(np.finfo(n.dtype).eps)
    wide, rows = n.astype(np.float64), np.arange(count)
    j = np.argmin(np.abs(wide), axis=1)
    k = rounded(1 + log_uniform(rng, least, most, count), precision)
    start = log_uniform(rng, eps, 0.25, count) * either(rng, count)
    a = rounded(_on_the_cone(rng, wide, j, k, start), precision)
    by_k = (rng.random(count) < 1 / 3) | (np.abs(a[rows, j]) > 0.25)
    for _ in range(_STEPS):
        d, along = radicand_and_gradient(a, wide, k)
        # A step that would leave |a| = 1 by more than u/4 is left to k.
        step = d / along[rows, j]
        by_k |= np.abs(step) * (np.abs(a[rows, j]) + np.abs(step)) > eps / 8
        a[rows, j] -= np.where(by_k, 0, step)
        a, k = rounded(a, precision), rounded(k - np.where(by_k, d / along[:, 6], 0), precision)
    aside = rng.integers(-2, 3, count)
    a[rows, j] += np.where(by_k, 0, aside) * np.spacing(np.abs(a[rows, j]).astype(precision))
    return a, n, k + np.where(by_k, aside, 0) * np.spacing(k.astype(precision))


def _on_the_cone(rng: Generator, n: Array, j: Index, k: Array, start: Array) -> Array:
    """Unit a at the critical angle from ±n, whose component j is `start` as far as the cone reaches there."""
    rows, sine, cosine = np.arange(len(n)), 1 / k, np.sqrt((k - 1) * (k + 1)) / k * either(rng, len(n))
    n = n / length(n)[:, None]
    p = -n[rows, j][:, None] * n
    p[rows, j] += 1
    p /= length(p)[:, None]
    cos_turn = np.clip((start - cosine * n[rows, j]) / (sine * p[rows, j]), -1, 1)
    sin_turn = np.sqrt(1 - cos_turn**2) * either(rng, len(n))
    tangent = cos_turn[:, None] * p + sin_turn[:, None] * np.cross(n, p)
    return normalised(cosine[:, None] * n + sine[:, None] * tangent)
