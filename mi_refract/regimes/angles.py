"""Families of rays given by the angle of incidence and the ratio k of the indices."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from .rays import Array, Build, Triple, either, length, log_uniform, normalised

Draw = Callable[[Generator, int, float], tuple[Array, Array]]  # (rng, count, eps) to (angle of incidence, k)
AngleAt = Callable[[Array, Generator, int, float], Array]  # (k, rng, count, eps) to angle of incidence


def generic(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """Cosine uniform, k = 1.5 or 1/1.5."""
    return np.arccos(rng.uniform(0, 1, count)), 1.5 ** either(rng, count)


def near_normal(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """1e-12 … 1e-2 rad from the normal."""
    return log_uniform(rng, 1e-12, 1e-2, count), rng.uniform(0.4, 2.5, count)


def grazing(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """1e-7 … 1e-2 rad from the surface."""
    return np.pi / 2 - log_uniform(rng, 1e-7, 1e-2, count), rng.uniform(0.4, 2.5, count)


def critical(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """1e-7 … 1e-2 rad from the critical angle, on both sides."""
    k = rng.uniform(1.05, 2.5, count)
    return critical_at(k, rng, count, eps), k


def critical_at(k: Array, rng: Generator, count: int, eps: float) -> Array:
    """The same angles for k (N,) that are given, from 1 on."""
    return np.arcsin(1 / k) + log_uniform(rng, 1e-7, 1e-2, count) * either(rng, count)


def _nearly_matched(rng: Generator, count: int, eps: float) -> Array:
    return 1 + log_uniform(rng, eps, 1e-2, count) * either(rng, count)


def matched(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """k within 1e-2 of 1, cosine uniform."""
    return np.arccos(rng.uniform(0, 1, count)), _nearly_matched(rng, count, eps)


def matched_grazing(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """k within 1e-2 of 1, 1e-7 … 1e-1 rad from the surface."""
    return np.pi / 2 - log_uniform(rng, 1e-7, 1e-1, count), _nearly_matched(rng, count, eps)


def brewster(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """An ulp to 1e-2 rad from Brewster's angle, on both sides."""
    k = rng.uniform(0.4, 2.5, count)
    return brewster_at(k, rng, count, eps), k


def brewster_at(k: Array, rng: Generator, count: int, eps: float) -> Array:
    """The same angles for k (N,) that are given."""
    return np.arctan(1 / k) + log_uniform(rng, eps, 1e-2, count) * either(rng, count)


def steep(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """k from 10 to 1e6, the sine of the refracted angle uniform in 0 … 1.2."""
    k = log_uniform(rng, 10, 1e6, count)
    return np.arcsin(np.minimum(1, rng.uniform(0, 1.2, count) / k)), k


def dense(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """k from 1e-6 to 0.1, cosine uniform."""
    return np.arccos(rng.uniform(0, 1, count)), log_uniform(rng, 1e-6, 1e-1, count)


def mixed(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """Each ray from one of the families above."""
    draws = (generic, near_normal, grazing, critical, matched, matched_grazing, brewster, steep, dense)
    angle, k = np.stack([draw(rng, count, eps) for draw in draws], axis=1)
    chosen = rng.integers(0, len(draws), count), np.arange(count)
    return angle[chosen], k[chosen]


def rays_at(draw: Draw, rng: Generator, n: Array) -> Triple:
    """Rays at the drawn angles from ±n, in a random plane of incidence."""
    angle, k = draw(rng, len(n), float(np.finfo(n.dtype).eps))
    wide = n.astype(np.float64)
    across = np.cross(wide, rng.normal(size=n.shape))
    side = np.cos(angle) * either(rng, len(n)) / length(wide)
    return normalised(side[:, None] * wide + (np.sin(angle) / length(across))[:, None] * across), n, k


def aimed(angle: AngleAt, rng: Generator, n: Array, k: Array) -> Triple:
    """Rays at angles that depend on the ratios `k` (N,), which are given."""
    return rays_at(lambda *drawn: (angle(k, *drawn), k), rng, n)


def at(draw: Draw) -> Build:
    """The family of rays with the drawn angles and ratios."""
    return functools.partial(rays_at, draw)
