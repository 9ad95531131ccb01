"""The check of certified answers: each is put back into Snell's law, in ball arithmetic."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from flint import arb, ctx
from numpy.typing import ArrayLike, NDArray

from .ball_arithmetic import EXACT_BITS, PRECISIONS, Array, Ball, Certified, Ray, checked, rays

MAX_RESIDUAL = 1e-28


@dataclass(frozen=True)
class Residual:
    """Whether certified answers satisfy Snell's law: `holds` (N,), and `width` (N,) of the widest ball."""

    holds: NDArray[np.bool_]
    width: Array


def residual(
    a: ArrayLike, n: ArrayLike, k: ArrayLike, certified: Certified, *, contrast: ArrayLike | None = None
) -> Residual:
    """Put a certified answer back into the law; arguments as for `refract`.

    With u = n/|n|, i = a/|a| and ratio = k (transmitted) or 1, in balls around the answer:
        u×b − ratio u×i = 0     Snell's law, its plane and its side
        u·b − (±√(1 − ratio²|u×i|²)) = 0     |b| = 1; the length itself is blind along n at the critical angle
    and the flag must be what the exact signs of n·a and 1 − k² sin²θi say. Invalid rays must be NaN.
    A ball wider than 1e-28 proves nothing: the law does not hold there.
    """
    a, n, k, contrast, valid = checked(a, n, k, contrast)
    if len(certified) != len(a):
        raise ValueError(f"oracle: certified holds {len(certified)} rays; expected {len(a)}, as many as a")
    holds = np.isnan(certified.direction).all(axis=1) & ~certified.transmitted
    width = np.zeros(len(a))
    index = np.flatnonzero(valid)
    for i, ray in zip(index, rays(a, n, k, contrast, index), strict=True):
        high, low = certified.direction[i].tolist(), certified.direction_low[i].tolist()
        balls = _law(ray, high, low, float(certified.radius[i]), bool(certified.transmitted[i]))
        width[i] = max((2 * float(ball.rad()) for ball in balls), default=math.nan)
        holds[i] = width[i] <= MAX_RESIDUAL and all(ball.contains(0) for ball in balls)
    return Residual(holds, width)


def _law(ray: Ray, high: list[float], low: list[float], radius: float, transmitted: bool) -> list[Ball]:
    """The four balls of `residual`; none where the flag is wrong."""
    with ctx.workprec(EXACT_BITS):
        ax, ay, az, nx, ny, nz = (arb(x) for x in ray[:6])
        k2 = arb(ray[6]) ** 2 if ray[7] is None else arb(ray[7]) + 1
        cross = ay * nz - az * ny, az * nx - ax * nz, ax * ny - ay * nx
        sines = sum(x * x for x in cross)
        nn = nx * nx + ny * ny + nz * nz
        lengths = (ax * ax + ay * ay + az * az) * nn
        c = ax * nx + ay * ny + az * nz
        if transmitted != (c != 0 and lengths - k2 * sines >= 0):
            return []
        ratio2 = k2 if transmitted else arb(1)
        cosine = lengths - ratio2 * sines
    with ctx.workprec(2 * PRECISIONS[0]):
        bx, by, bz = (arb(h, radius) + rest for h, rest in zip(high, low, strict=True))
        u, unit, side = nn.rsqrt(), lengths.rsqrt(), 1 if (c > 0) == transmitted else -1
        scale = ratio2.sqrt() * unit
        ux, uy, uz = u * nx, u * ny, u * nz
        return [
            uy * bz - uz * by + scale * cross[0],
            uz * bx - ux * bz + scale * cross[1],
            ux * by - uy * bx + scale * cross[2],
            bx * ux + by * uy + bz * uz - side * cosine.sqrt() * unit,
        ]
