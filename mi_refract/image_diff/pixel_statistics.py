"""A test of the pixels of two sets of renders: what a tile's mean does not show, such as stripes that trade places.

At every pixel the means m₁, m₂ of the two sides have the estimated variances v₁, v₂. Then u = (m₂ − m₁)² − v₁ − v₂ has
the expectation δ², where δ is the true difference: it is χ² less its own expectation, for noise of any distribution.
Over the pixels of a tile S = Σu / √(Σu²) is tested.

Level: for independent pixels whose u is symmetric, P(S ≥ s) ≤ exp(−s²/2) (Efron 1969, of Hoeffding's bound for signs).
Where renders are equal u is skewed to the right at every pixel: as a form Σ aⱼₖ xⱼ xₖ in the renders, without j = k, it
has one positive eigenvalue among many negative ones, and Σ aⱼₖ³ ≥ 0. That makes large S rarer: a long right tail is
in Σu² twice. Where pixels correlate, Σu² is too small by at most the inflation F of tile means, since ρ² ≤ |ρ|; with F
estimated at f degrees of freedom the expectation of the bound over that estimate is (1 + s²/f)^(−f/2).

Rare light is skewed to the left where the sides have n₁ > n₂ samples: the small side has none in most pixels, there v₂
is 0, and u = m₁² > 0. Equal images have one variance of a sample. With the estimates exchanged, v₁ n₁/n₂ + v₂ n₂/n₁,
such a pixel has u < 0, and single events of the small side are a tail on the right. A tile must differ by both.

Where the noise of one side alone is known, from n samples, and the other has m, the difference d = ±(m₂ − m₁), positive
where the other is brighter, is tested in the same way: S = Σd / √(Σd²). Light of rare events has d > 0 where the other
side found it alone, which is no evidence of a difference, but for its number. All of k events are in the m samples with
probability (1 + n/m)⁻ᵏ; they show S² = k in d, and in u where n < m. So both have P(S ≥ s) ≤ exp(−g s²) with
g = min(½, ln(1 + n/m)) instead of ½.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mi_refract.io.pixels import Pixels as Array
from mi_refract.io.pixels import block_sum

WORKERS = 2
ROUNDING = 1e-12  # of m²: more than that of u in float64, which is some 1e-16 (m² + u)


@dataclass(frozen=True)
class PixelSums:
    """Sums of u and of its square over the pixels of each tile and channel: 1 or 2 × tiles × tiles × C.

    The second with the estimates of the variances exchanged, where the sides have different numbers of samples.
    `exponent`: g of P(S ≥ s) ≤ exp(−g s²), of all channels or of each.
    """

    total: Array
    squares: Array
    exponent: Array | float = 0.5

    def coarser(self, growth: int) -> PixelSums:
        """The same in tiles `growth` times as wide."""
        return replace(self, total=block_sum(self.total, growth), squares=block_sum(self.squares, growth))

    def p(self, area: Array, least: Array, factor: float, freedom: float) -> Array:
        """Upper bounds of the p of no pixel's u beyond `least`, which is that of a tile; NaN for what is not finite.

        `area`: pixels of a tile. `factor`, `freedom`: by how much tile means vary more than with independent pixels,
        and the degrees of freedom of that estimate.
        """
        total = self.total - area * least
        squares = self.squares - 2 * least * self.total + area * np.square(least)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            s2 = np.where(total <= 0, 0.0, 2 * self.exponent * np.square(total) / (factor * squares))
        exponent = s2 if np.isinf(freedom) else freedom * np.log1p(s2 / freedom)
        bound: Array = np.exp(-exponent / 2).max(0)
        return bound


def exponent(known: float, other: float) -> float:
    """g, where the noise of a side of `known` samples is all that is known, and the other side has `other` samples."""
    return min(0.5, math.log1p(known / other))


def sums(
    m1: Array, v1: Array, m2: Array, v2: Array, tile: int, ratio: Array | float = 1.0, exponent: Array | float = 0.5
) -> PixelSums:
    """Of the means of both sides and the variances of these means, float64, H × W × C.

    `ratio`: samples of the first side over those of the second, of all channels or of each.
    """
    # Light that one render found alone has u = 0: its rounding, the same everywhere, must not add up.
    squared = np.square(m2 - m1) - ROUNDING * (np.square(m1) + np.square(m2))
    noise = [v1 + v2] if np.all(ratio == 1) else [v1 + v2, ratio * v1 + v2 / ratio]
    found = [squared - each for each in noise]
    total, squares = (np.stack([block_sum(x, tile) for x in each]) for each in (found, map(np.square, found)))
    return PixelSums(total, squares, exponent)


def sums_of_renders(reference: Sequence[Array], test: Sequence[Array], tile: int, ratio: float = 0.0) -> PixelSums:
    """Of two sets of independent renders, each H × W × C, at least 2 a side; needs memory for rows of tiles only.

    `ratio`: as in `sums`; 0: that of their numbers.
    """
    ratio = ratio or len(reference) / len(test)

    def band(top: int) -> PixelSums:
        one, two = (_mean_and_variance([each[top : top + tile] for each in side]) for side in (reference, test))
        return sums(*one, *two, tile, ratio)

    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(WORKERS) as pool:
        bands = list(pool.map(band, range(0, reference[0].shape[0], tile)))
    return PixelSums(*(np.concatenate(each, -3) for each in ([b.total for b in bands], [b.squares for b in bands])))


def _mean_and_variance(renders: Sequence[Array]) -> tuple[Array, Array]:
    """The mean of renders, and the variance of that mean, in float64."""
    count, first = len(renders), renders[0].astype(np.float64)
    total, squares = np.zeros((2, *first.shape))
    with np.errstate(invalid="ignore", over="ignore"):
        for each in renders[1:]:
            off = each - first
            total += off
            squares += np.square(off, out=off)
        total /= count
        variance = (squares / count - np.square(total)) / (count - 1)
    return first + total, variance
