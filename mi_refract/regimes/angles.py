"""Families of rays defined by the angle of incidence and the ratio k of indices, by the names of their regimes."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from .rays import Array, Build, Triple, either, length, log_uniform, normalised

Draw = Callable[[Generator, int, float], tuple[Array, Array]]  # (rng, count, eps) → (angles of incidence, k)
AngleAt = Callable[[Array, Generator, int, float], Array]  # (k, rng, count, eps) → angles of incidence


def angles_from_ratios(ratios: Callable[[Generator, int], Array], angle: AngleAt) -> Draw:
    """A `Draw` of ratios and of angles that depend on them."""

    def draw(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
        k = ratios(rng, count)
        return angle(k, rng, count, eps), k

    return draw


# Regimes whose angles depend on k, the regime's own or given ratios; for the critical regime k must be ≥ 1.
ANGLES: dict[str, AngleAt] = {
    "critical": lambda k, rng, count, eps: np.arcsin(1 / k) + log_uniform(rng, 1e-7, 1e-2, count) * either(rng, count),
    "Brewster": lambda k, rng, count, eps: np.arctan(1 / k) + log_uniform(rng, eps, 1e-2, count) * either(rng, count),
}
DRAWS: dict[str, Draw] = {
    "generic": lambda rng, count, eps: (_uniform_cosines(rng, count), 1.5 ** either(rng, count)),
    "near-normal": lambda rng, count, eps: (log_uniform(rng, 1e-12, 1e-2, count), rng.uniform(0.4, 2.5, count)),
    "grazing": lambda rng, count, eps: (np.pi / 2 - log_uniform(rng, 1e-7, 1e-2, count), rng.uniform(0.4, 2.5, count)),
    "critical": angles_from_ratios(lambda rng, count: rng.uniform(1.05, 2.5, count), ANGLES["critical"]),
    "matched": lambda rng, count, eps: (_uniform_cosines(rng, count), _nearly_matched(rng, count, eps)),
    "matched, grazing": lambda rng, count, eps: (
        np.pi / 2 - log_uniform(rng, 1e-7, 1e-1, count),
        _nearly_matched(rng, count, eps),
    ),
    "Brewster": angles_from_ratios(lambda rng, count: rng.uniform(0.4, 2.5, count), ANGLES["Brewster"]),
    "k ≫ 1": angles_from_ratios(
        lambda rng, count: log_uniform(rng, 10, 1e6, count),
        lambda k, rng, count, eps: np.arcsin(np.minimum(1, rng.uniform(0, 1.2, count) / k)),
    ),
    "k ≪ 1": lambda rng, count, eps: (_uniform_cosines(rng, count), log_uniform(rng, 1e-6, 1e-1, count)),
}


def _uniform_cosines(rng: Generator, count: int) -> Array:
    """Angles whose cosines are uniform."""
    return np.arccos(rng.uniform(0, 1, count))


def _nearly_matched(rng: Generator, count: int, eps: float) -> Array:
    return 1 + log_uniform(rng, eps, 1e-2, count) * either(rng, count)


def mixed(rng: Generator, count: int, eps: float) -> tuple[Array, Array]:
    """Angles and ratios, for each ray from a random one of the families above."""
    angle, k = np.stack([draw(rng, count, eps) for draw in DRAWS.values()], axis=1)
    chosen = rng.integers(0, len(DRAWS), count), np.arange(count)
    return angle[chosen], k[chosen]


def rays_at(draw: Draw, rng: Generator, n: Array) -> Triple:
    """Rays at the drawn angles from ±n, in random planes of incidence."""
    angle, k = draw(rng, len(n), float(np.finfo(n.dtype).eps))
    wide = n.astype(np.float64)
    across = np.cross(wide, rng.normal(size=n.shape))
    side = np.cos(angle) * either(rng, len(n)) / length(wide)
    return normalised(side[:, None] * wide + (np.sin(angle) / length(across))[:, None] * across), n, k


def drawn(name: str) -> Build:
    """The `Build` of the family of this name."""
    return functools.partial(rays_at, DRAWS[name])
