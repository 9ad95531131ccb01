"""REGIMES, the table of all regimes, and `make`, which draws rays from one."""

from __future__ import annotations

import functools
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, DTypeLike

from . import components
from .angles import ANGLES, AngleAt, drawn, rays_at
from .rays import Array, Build, Rays, Triple, normalised, rounded


@dataclass(frozen=True)
class Regime:
    """`build(rng, n)` gives (a, n, k) for unit normals `n` (N, 3), whose precision is the one wanted.

    `largest_k` bounds k; `text` defines the set; `unit`: `a` and `n` are unit up to the rounding of their components,
    as the documented formulas demand. `rests_on_denormals`: the answer is another one where those are taken for 0.
    `any_k`: the directions stay those of the regime where other ratios take the place of its own. `angle`: those of
    incidence follow from k; so they do from ratios that are given, which are `least_k` or more.
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
        """Whether ratios may be given."""
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
        "k in 1.05 … 2.5, the radicand of the rounded numbers as near to 0 as two ulps of one of them, both sides",
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
        components.zeros, 1e6, "n, and a of every other ray, with zeros of either sign; not tangential", any_k=True
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
        "n an axis, n·a a denormal number: all that keeps a from being tangential",
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
        "a and n turned by a matrix in their own precision, all angles and k",
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
    """The rays of a regime with the k `ratios` (N,), rounded to `precision`, in place of its own.

    KeyError: no such regime. ValueError: its ratios are part of it, or one is below its least.
    """
    regime, k = REGIMES[name], rounded(np.asarray(ratios, float), precision)
    if not regime.takes_k:
        taking = ", ".join(repr(other) for other in REGIMES if REGIMES[other].takes_k)
        raise ValueError(f"regime {name!r}: it defines its own ratios of indices; expected one of {taking}")
    if (k < regime.least_k).any():
        raise ValueError(f"regime {name!r}: k = {k.min():.6g}; expected {regime.least_k:g} or more")
    angle = regime.angle
    if angle is None:
        rays = make(name, len(k), precision, seed)
        return Rays(rays.a, rays.n, k.astype(precision))
    rng, n = _normals(name, len(k), seed)
    return _rounded(rays_at(lambda *given: (angle(k, *given), k), rng, n.astype(precision)), precision)


def make(name: str, count: int, precision: DTypeLike, seed: int = 0, normal: ArrayLike | None = None) -> Rays:
    """`count` rays of a regime in `precision`, float32 or float64. KeyError: no such regime.

    `normal` takes the place of random normals, in the regimes that do not choose their own.
    """
    rng, n = _normals(name, count, seed, normal)
    return _rounded(REGIMES[name].build(rng, n.astype(precision)), precision)


def _normals(name: str, count: int, seed: int, normal: ArrayLike | None = None) -> tuple[Generator, Array]:
    """The generator of a regime, and what it draws first."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    if normal is not None:
        return rng, np.tile(np.asarray(normal, float), (count, 1))
    return rng, normalised(rng.normal(size=(count, 3)))


def _rounded(rays: Triple, precision: DTypeLike) -> Rays:
    a, n, k = (x.astype(precision) for x in rays)
    return Rays(a, n, k)
