"""How far rounding may move a derivative: the conditions of a ray, and the constants in `limits` that go with them.

Notation: c = cosθi, s = sinθi, y = cosθt, D = y² = c² − κ s², e the input's direction, a prime d/dε. Forward
differentiation evaluates a sum of products with rounded factors. Sums of two words stay free of errors, as their
derivatives pass the same steps; a product costs u of its size. In units of u, for a form at the rounding limit,
whose values D, y and b are right to u:

    c′ = n·e                  δc′ ≤ 1 + 4|c′|                       Σ|nᵢeᵢ| ≤ 1
    w′ = n × e                δw′ ≤ √2 + 2|w′|                      Σ(|nⱼeₖ| + |nₖeⱼ|)² ≤ 2
    D′ = 2cc′ − 2κ w·w′       δD′ ≤ 2c δc′ + 4c|c′| + |κ|(2s δw′ + 8s|w′|) + 2|D′|
    r′ = D′/2y                δr′ ≤ (δD′ + 6|D′|)/2y                rsqrt, its derivative, one correction
    b′ along the surface      k δw′ + 2k|w′|
    b′, corrected and rounded 4|b′|                                  three products a component, and the last sum

**∂b/∂a in the plane**: c′ = −s, |w′| = c, D′ = −2k²sc, |b′| = kc/y.

    δb′ ≤ [c(1 + 6s) + |κ|s(1.42 + 6c) + 8k²sc]/y + k(√2 + 4c) + 4|b′|

With C = 1 + k²s(s + 2c)/y² ≥ 1/y² + 2k²sc/y² ≥ 1 and M = max(1, |b′|):
k ≥ 1: kc/y ≤ M; |κ|s ≤ k as ks ≤ 1, so |κ|s/y ≤ 2M for c ≥ 1/2, and k ≤ 1.155, |κ| ≤ 1/3 else; k²sc/y ≤ C/2; so
7 + 2.83 + 3 + 4 + (2.83 + 4) + 4 = 27.7. k < 1: c ≤ y, s/y ≤ C: 7 + 1.42 + 6 + 4 + 5.42 + 4 = 27.9.
**Across it**: c′ = w·w′ = D′ = 0, |w′| = 1: (c + 7.4|κ|s)/y + 5.42k + 4k ≤ 17.9 CM. **∂b/∂k**: no δc′, no δw′, less.
The certified derivative is a double, 1 more: DERIVATIVE = 29 ≥ error/(C M u).

**Étendue**, (v × w)·b = k²c/y of v = ∂b/∂a in the plane and w = k across it. Errors along the surface, τ relative, and
ν along n, in units of u, move its logarithm by y²(τ_v + τ_w) + k²s²τ_w + (s y/c) ν_v; ν_w moves it by none. With
τ_v ≤ √2/c + 4 + 4/y, τ_w ≤ √2 + 8, ν_v ≤ δr′ + 4kc/y:

    (√2 y² + 1.42|κ|s²)/c + 4y² + 4y + 9.42 + s(1 + 6s) + 6|κ|s² + 8k²s² + 4ks

y² + k²s² = 1 and |κ|s² ≤ 1, so at most 2.84/c + 8 + 4√2 + 9.42 + 7 + 6 = 2.84/c + 36.1. Both e are off unit by √3/2
each; cosines and b are doubles, 3 more: 40.8 + 2.84/c ≤ 41 (C + 1/12c). Here a small k does not hide in M.

**The promoted form in float32** computes all of this with 2⁻⁵³ and rounds v and w once: |δb′| ≤ u|b′|, 1.01 with what
is left of float64; the étendue 2 + √3 of it.

**∂R/∂η** of R = A/(A + B), A = κ²(p² + q²), B = 2kp(d_s² + d_p²), p = cy, q = ks², where log y changes with log k by
Y = −k²s²/y². k ∂R/∂k = RT(α − β), and the sum of its terms' magnitudes is

    S = RT [4k²/|κ| + (2p²|Y| + 2q²)/(p² + q²) + 1 + |Y| + 2(d_s(kc + y|Y|) + d_p ky(1 + |Y|))/(d_s² + d_p²)].

In float64: Y by D′ (6 roundings) and √ (13); five steps of double words to A′ or B′, 13; T A′ − R B′ over A + B, 8; and
the rounded y, which enters p, d_s, d_p, R, T with powers of 8.2 at most: 48.2 u S. In float32 all but y, y′ and the
result is exact to 2⁻²⁹: 8.2 + 1 + 1, and less than 0.3 for what 1/T ≤ 1e6 makes of 2⁻⁵³.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mi_refract import oracle


def condition_of(certified: oracle.Certified, k: np.ndarray) -> np.ndarray:
    """C = 1 + k² sinθi (sinθi + 2 cosθi)/cos²θt: what k and both directions, off by u, change log cosθt by."""
    cos_i = certified.cos_i
    sin_i = np.sqrt((1 - cos_i) * (1 + cos_i))
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = k.astype(float) ** 2 * sin_i * (sin_i + 2 * cos_i) / certified.cos_t**2
    return 1 + np.where(certified.transmitted, moved, 0)


def condition_of_etendue(condition: np.ndarray, cos_i: np.ndarray) -> np.ndarray:
    """C + 1/12 cosθi: what crosses the surface at grazing incidence is known to u/cosθi."""
    return condition + 1 / (12 * cos_i)


def size_of_powers(certified: oracle.Certified, cos_i: np.ndarray, k: np.ndarray) -> np.ndarray:
    """S above, (N,); 0 under total internal reflection and at k = 1, where the derivative is exactly 0."""
    wide: Any = np.longdouble
    c, k, y = cos_i.astype(wide), k.astype(wide), certified.cos_t.astype(wide)
    r, t = (getattr(certified, name).astype(wide) for name in ("reflectance", "transmittance"))
    s2, kappa = (1 - c) * (1 + c), (k - 1) * (k + 1)
    p, q, d_s, d_p = c * y, k * s2, k * c + y, c + k * y
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = k * k * s2 / (y * y)
        reflected = 4 * k * k / np.abs(kappa) + 2 * (p * p * turn + q * q) / (p * p + q * q)
        through = 1 + turn + 2 * (d_s * (k * c + y * turn) + d_p * k * y * (1 + turn)) / (d_s * d_s + d_p * d_p)
        found = r * t * (reflected + through)
    return np.where(certified.transmitted & (kappa != 0), found, 0)
