"""REGIMES, the table of all regimes, and `make`, which draws rays from one."""

from __future__ import annotations

import functools
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, DTypeLike

from . import components
from .angles import ANGLES, AngleAt, angles_from_ratios, drawn, rays_at
from .rays import Array, Build, Rays, Triple, normalised, rounded


@dataclass(frozen=True)
class Regime:
    """A regime: `build(rng, n)` returns (a, n, k) for unit normals `n` (N, 3) in the precision of the set.

    `largest_k`: bound of k. `text`: the definition of the set. `unit`: whether `a` and `n` are unit up to the rounding
    of their components, as the documented formulas require. `rests_on_denormals`: whether the answer changes if
    denormal numbers are flushed to 0. `any_k`: whether given ratios can replace the regime's own without a change of
    the directions. `angle`: the function from k to the angles of incidence, if they depend on it; given ratios must
    then be at least `least_k`.
    """

    build: Build
    largest_k: float
    text: str
    unit: bool = True
    rests_on_denormals: bool = False
    any_k: bool = False
    angle: AngleAt | None = None
    least_k: float = 0.0

    @property
    def takes_k(self) -> bool:
        """Whether the regime accepts given ratios."""
        return self.any_k or self.angle is not None


# Every regime by its name.
REGIMES = {
    "generic": Regime(drawn("generic"), 1.5, "cosine uniform, k = 1.5 or 1/1.5", any_k=True),
    "near-normal": Regime(drawn("near-normal"), 2.5, "1e-12 … 1e-2 rad from the normal, k in 0.4 … 2.5", any_k=True),
    "grazing": Regime(drawn("grazing"), 2.5, "1e-7 … 1e-2 rad from the surface, k in 0.4 … 2.5", any_k=True),
    "critical": Regime(
        drawn("critical"),
        2.5,
        "1e-7 … 1e-2 rad from the critical angle, both sides, k in 1.05 … 2.5",
        angle=ANGLES["critical"],
        least_k=1.0,
    ),
    "critical, to the ulp": Regime(
        functools.partial(components.to_the_ulp, 0.05, 1.5),
        2.51,
        "k in 1.05 … 2.5, two ulps of one number or less from the critical angle, both sides",
    ),
    "critical, any k, to the ulp": Regime(
        functools.partial(components.to_the_ulp, 1e-6, 9.9e5),
        1e6,
        'as "critical, to the ulp", for k − 1 in 1e-6 … 1e6: grazing to near-normal',
    ),
    "matched": Regime(drawn("matched"), 1.01, "|k − 1| from an ulp to 1e-2, cosine uniform"),
    "matched, grazing": Regime(
        drawn("matched, grazing"), 1.01, "|k − 1| from an ulp to 1e-2, 1e-7 … 1e-1 rad from the surface"
    ),
    "Brewster": Regime(
        drawn("Brewster"),
        2.5,
        "an ulp to 1e-2 rad from Brewster's angle, both sides, k in 0.4 … 2.5",
        angle=ANGLES["Brewster"],
    ),
    "k ≫ 1": Regime(drawn("k ≫ 1"), 1e6, "k in 10 … 1e6, k sin θ uniform in 0 … 1.2"),
    "k ≪ 1": Regime(drawn("k ≪ 1"), 0.1, "k in 1e-6 … 0.1, cosine uniform"),
    "axes, signed zeros": Regime(
        components.zeros,
        1e6,
        "n, and a of about half of the rays, with zeros of either sign; not tangential",
        any_k=True,
    ),
    "denormal": Regime(
        components.denormal,
        1e6,
        'as "axes, signed zeros", with denormal numbers for the zeros of a, n or both',
        any_k=True,
    ),
    "on a denormal": Regime(
        components.on_a_denormal,
        1e6,
        "n an axis, n·a a denormal number: if it were 0, the ray would be tangential",
        rests_on_denormals=True,
        any_k=True,
    ),
    "lengths": Regime(
        components.lengths,
        1e6,
        "|a| and |n| log-uniform in 1e-18 … 1e18, angles and ratios of all sets",
        False,
        any_k=True,
    ),
    "off unit": Regime(
        components.off_unit,
        1e6,
        "a and n rotated by a matrix in their own precision, angles and ratios of all sets",
        False,
        any_k=True,
    ),
    "tangential": Regime(
        components.tangential, 1e6, "n·a = 0 exactly, lengths from 2⁻¹² up, ratios of all sets", False, any_k=True
    ),
    "exactly critical": Regime(
        components.exactly_critical, 4.0, "radicand exactly 0: whole a and n times powers of two", False
    ),
}


def make_given(name: str, ratios: ArrayLike, precision: DTypeLike, seed: int = 0) -> Rays:
    """The rays of a regime with the given ratios k (N,), rounded to `precision`, in place of its own.

    KeyError for an unknown regime. ValueError for a regime that defines its own ratios, or a ratio below its least.
    """
    regime, k = REGIMES[name], rounded(np.asarray(ratios, float), precision)
    if not regime.takes_k:
        accepting = ", ".join(repr(other) for other in REGIMES if REGIMES[other].takes_k)
        raise ValueError(f"regime {name!r}: it defines its own ratios of indices; expected one of {accepting}")
    if (k < regime.least_k).any():
        raise ValueError(f"regime {name!r}: k = {k.min():.6g}; expected {regime.least_k:g} or more")
    if regime.angle is None:
        rays = make(name, len(k), precision, seed)
        return Rays(rays.a, rays.n, k.astype(precision))
    rng, n = _normals(name, len(k), seed)
    draw = angles_from_ratios(lambda rng, count: k, regime.angle)
    return _rounded(rays_at(draw, rng, n.astype(precision)), precision)


def make(name: str, count: int, precision: DTypeLike, seed: int = 0, normal: ArrayLike | None = None) -> Rays:
    """`count` rays of a regime in `precision`, float32 or float64. KeyError for an unknown regime.

    `normal`: used in place of random normals, except by regimes that choose their own.
    """
    rng, n = _normals(name, count, seed, normal)
    return _rounded(REGIMES[name].build(rng, n.astype(precision)), precision)


def _normals(name: str, count: int, seed: int, normal: ArrayLike | None = None) -> tuple[Generator, Array]:
    """The random generator of a regime, and its normals, which are drawn first."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    if normal is not None:
        return rng, np.tile(np.asarray(normal, float), (count, 1))
    return rng, normalised(rng.normal(size=(count, 3)))


def _rounded(rays: Triple, precision: DTypeLike) -> Rays:
    a, n, k = (x.astype(precision) for x in rays)
    return Rays(a, n, k)
