"""Certified derivatives: Snell's law and Fresnel's equations in ball arithmetic, along a line of inputs.

The inputs are a + ε a′ and k + ε k′ with exact a, a′, k, k′. Every quantity is a power series in ε to first order
whose coefficients are balls. √D, with the radicand D > 0 of `oracle`, is the only step that is not a polynomial.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from flint import arb, arb_series, ctx
from numpy.typing import ArrayLike

Series: TypeAlias = Any  # a `flint.arb_series`, or a ball

# With so many bits the radicand of any float32 inputs is exact; for float64 they suffice unless it cancels to less than
# 2⁻⁶⁰⁰ of its terms. If a ball cannot decide, the result is NaN.
BITS = 1200
MAX_RADIUS = 1e-25


def derivative(a: ArrayLike, n: ArrayLike, k: ArrayLike, along_a: ArrayLike, along_k: ArrayLike) -> np.ndarray:
    """(N, 3): d/dε of b for a + ε along_a and k + ε along_k, where b has the length of `a`.

    a, n, along_a: (N, 3) of any lengths; k, along_k: (N,) or numbers. NaN for n·a = 0 and D = 0, where it does not
    exist. Under total internal reflection it is the derivative of the mirror direction.
    """
    return _by_series(_direction, 3, a, n, k, along_a, along_k)


def derivative_of_powers(cos_i: ArrayLike, k: ArrayLike, along_cos: ArrayLike, along_k: ArrayLike) -> np.ndarray:
    """(N,): d/dε of the unpolarised reflectance R, and so of −T, for cos_i + ε along_cos and k + ε along_k."""
    zeros = np.zeros((len(np.asarray(cos_i)), 3))
    a, along_a = (zeros + np.reshape(x, (-1, 1)) for x in (cos_i, along_cos))
    return _by_series(_reflectance, 1, a, zeros, k, along_a, along_k)[:, 0]


def _by_series(
    solve: Callable[[list[Series], list[float], Series], list[Series]],
    width: int,
    a: ArrayLike,
    n: ArrayLike,
    k: ArrayLike,
    along_a: ArrayLike,
    along_k: ArrayLike,
) -> np.ndarray:
    """(N, width): the coefficients of ε from `solve` for each ray; NaN if a ball is too wide."""
    a, n, along_a = (np.asarray(x, np.float64) for x in (a, n, along_a))
    k, along_k = (np.broadcast_to(np.asarray(x, np.float64), len(a)) for x in (k, along_k))
    result = np.full((len(a), width), math.nan)
    before = ctx.cap
    ctx.cap = 2
    try:
        with ctx.workprec(BITS):
            for i, row in enumerate(np.column_stack([a, along_a, n, k, along_k]).tolist()):
                vector = [arb_series([row[j], row[3 + j]]) for j in range(3)]
                balls = solve(vector, row[6:9], arb_series([row[9], row[10]]))
                if all(float(x.rad()) <= MAX_RADIUS * max(1.0, abs(float(x))) for x in balls):
                    result[i] = [float(x) for x in balls]
    finally:
        ctx.cap = before
    return result


def _dot(x: list[Series], y: list[Series]) -> Series:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def _direction(a: list[Series], n: list[Series], k: Series) -> list[Series]:
    """b = (k t + s √D n)/N, t = N a − c n; b = (t − c n)/N where nothing is transmitted."""
    n = [arb(x) for x in n]
    c, square = _dot(n, a), _dot(n, n)
    t = [square * a_i - c * n_i for a_i, n_i in zip(a, n, strict=True)]
    d = k * k * c * c - (k * k - 1) * square * _dot(a, a)
    if d[0] < 0 and c[0] != 0:
        b = [(t_i - c * n_i) / square for t_i, n_i in zip(t, n, strict=True)]
    elif d[0] > 0 and c[0] != 0:
        root = d.sqrt() if c[0] > 0 else -d.sqrt()
        b = [(k * t_i + root * n_i) / square for t_i, n_i in zip(t, n, strict=True)]
    else:
        return [arb(math.nan)] * 3
    return [x[1] for x in b]


def _reflectance(cosine: list[Series], _: list[Series], k: Series) -> list[Series]:
    """(r_s² + r_p²)/2 from the amplitudes as in textbooks: with BITS bits cancellation does no harm."""
    c = cosine[0]
    d = k * k * c * c - (k * k - 1)
    if d[0] < 0 and c[0] > 0:
        return [arb(0)]
    if not (d[0] > 0 and c[0] > 0):
        return [arb(math.nan)]
    y = d.sqrt()
    r_s, r_p = (k * c - y) / (k * c + y), (c - k * y) / (c + k * y)
    return [((r_s * r_s + r_p * r_p) / 2)[1]]
