"""The radicand of Snell's law, (n·a)² − κ |n×a|² with κ = k² − 1, right also where its two terms cancel."""

from __future__ import annotations

from typing import Any

import numpy as np

from mi_refract.numerics import FloatExpansion, float_expansions

from .rays import Array


def radicand(a: Any, n: Any, k: Any) -> tuple[FloatExpansion, FloatExpansion, Any]:
    """(n·a, D, T): D = (n·a)² − κ |n×a|², κ = k² − 1, which is negative under total internal reflection.

    `a`, `n`: three components each. T = (n·a)² + |κ| |n×a|², to a few u; the error of D is at most 2⁻¹⁴⁰ T.
    """
    c = float_expansions.dot(n, a)
    kappa = float_expansions.distil([*float_expansions.two_prod(k, k), 0 * k - 1])
    w2 = float_expansions.distil(
        [part for w in float_expansions.cross(n, a) for part in float_expansions.product(w, w)]
    )
    first, second = float_expansions.product(c, c), float_expansions.product(kappa, w2)
    return c, float_expansions.distil([*first, *float_expansions.negated(second)]), first[0] + abs(second[0])


def radicand_and_gradient(a: Array, n: Array, k: Array) -> tuple[Array, Array]:
    """D = k² c² − κ |a|²|n|² of these very numbers (N,), and its derivatives in a, n and k (N, 7). float64."""
    c, d, _ = radicand(a.T, n.T, k)
    aa, nn, k2c, kappa = (a * a).sum(1), (n * n).sum(1), k * k * c[0], k * k - 1
    along_a = 2 * (k2c[:, None] * n - (kappa * nn)[:, None] * a)
    along_n = 2 * (k2c[:, None] * a - (kappa * aa)[:, None] * n)
    along = np.column_stack([along_a, along_n, -2 * k * (aa * nn - c[0] ** 2)])
    return d[0], np.where(along == 0, 1e-300, along)
