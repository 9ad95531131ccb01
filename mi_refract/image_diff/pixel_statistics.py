"""What single pixels show of a difference and of the noise, where the means of tiles do not.

**Differences inside a tile**, such as stripes that trade places. At every pixel the means m₁, m₂ of the two sides have
the estimated variances v₁, v₂. Then u = (m₂ − m₁)² − v₁ − v₂ has the expectation δ², where δ is the true difference,
for noise of any distribution. Over the pixels of a tile S = Σu / √(Σu²) is tested.

For independent pixels whose u is symmetric, P(S ≥ s) ≤ exp(−s²/2) (Efron 1969, of Hoeffding's bound for signs). Where
renders are equal u is skewed to the right at every pixel: as a form Σ aⱼₖ xⱼ xₖ in the renders, without j = k, it has
one positive eigenvalue among many negative ones, and Σ aⱼₖ³ ≥ 0. That makes large S rarer: a long right tail is in Σu²
twice. Where pixels correlate, Σu² is too small by at most the inflation F of tile means, since ρ² ≤ |ρ|; with F
estimated at f degrees of freedom the expectation of the bound over that estimate is (1 + s²/f)^(−f/2).

**Rare light** skews u to the left where the sides have n₁ > n₂ samples: the small side has none in most pixels, there
v₂ is 0, and u = m₁² > 0. Equal images have one variance of a sample. With the estimates exchanged, v₁ n₁/n₂ + v₂ n₂/n₁,
such a pixel has u < 0, and single events of the small side are a tail on the right. A tile must differ by both.

**Noise known on one side alone**, from n samples, where the other has m: d = ±(m₂ − m₁), positive where the other is
brighter, is tested in the same way, S = Σd / √(Σd²). Light of rare events has d > 0 where the other side found it
alone, which is no evidence of a difference, but for its number. All of k events are in the m samples with probability
(1 + n/m)⁻ᵏ; they show S² = k in d, and in u where n < m. So both have P(S ≥ s) ≤ exp(−g s²), where g is
min(½, ln(1 + n/m)) instead of ½.

**Correlation.** Under a filter wider than a pixel neighbours share samples. A variance that was estimated from the
spread between passes is that of the filtered pixel then, and the mean of a tile varies F = Σ ρₕ times as much as the
sum of these variances says, over the correlations ρₕ of pixels at every distance h. `inflation` estimates F from the
difference d of two images that are equal but for noise: γₕ = Σ (d(x + h) − d(x))², and ρₕ = 1 − γₕ/γ∞. A true
difference that is smooth cancels in γₕ. One that repeats itself every few pixels may make F up to ten times as large,
and is then detected from √F times its size on.

**The same image with other noise.** Let a pixel of two single images come from one distribution, independently of other
pixels. Then a pixel of one may be exchanged with that of the other: the sign s of d = b − a is a fair coin, whatever
|d| and a + b are. So are s times a sign that these decide, and the product of the s of two pixels. Of N fair coins
P(|Σ| ≥ z√N) ≤ 2 exp(−z²/2) (Hoeffding 1963). `differ_like_noise` tests the sums of

- s, in tiles and in the whole image: light;
- s times the sign of a + b less its median, less its mean around, and of its slopes: contrast, sharpness, motion;
- products of s that are so far apart that no filter reaches: whatever has a shape.

Noise that only one side has, as after denoising, is in a + b less its mean around.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mi_refract.io.image_file import Pixels as Array
from mi_refract.io.image_file import block_mean, block_sum

ROUNDING = 1e-12  # of m²: more than that of u in float64, which is some 1e-16 (m² + u)
RADIUS = 2  # pixels: of a Gaussian filter of σ = 0.5, Mitsuba's default, ρ is 0.0003 at 2√2 and 1e-4 at 3
FAR = ((0, 6), (6, 0), (5, 5), (5, -5))  # where no filter reaches
REACH = 4.0  # F at which sums of signs are tested: under a Gaussian filter of σ = 0.5 it is 4πσ² = 3.1
FALSE = 0.01  # probability that noise is not called so
WIDE = 32  # pixels, of a tile of signs
FAINT = 0.1  # of the RMS relative change: a smaller one does not count, as last bits beside a true difference
SOME = 0.25  # share of the pixels that are not black which must change: noise is everywhere
SHOWN = 0.2  # a correlation of that size must show
NEAR = tuple((y, x) for y in range(RADIUS + 1) for x in range(-RADIUS, RADIUS + 1) if (y, x) > (0, 0))


@dataclass(frozen=True, order=True)
class Inflation:
    """How much more tile means vary than with independent pixels, at least 1: those of a wide filter correlate.

    `freedom`: degrees of freedom of that estimate. Few tiles make it a guess, which t-tests have to know.
    """

    factor: float = 1.0
    freedom: float = np.inf


def inflation(difference: Array, variance: Array, tile: int) -> Inflation:
    """F from the difference of two images and its variance, both H × W × C; 1 below 12 pixels a side.

    Its degrees of freedom are the number of squares of 2 RADIUS + 1 pixels with noise, whose means would show F, too.
    """
    height, width = difference.shape[:2]
    if min(height, width) < 2 * max(max(lag) for lag in FAR):
        return Inflation()
    # Every tile counts alike, however bright it is.
    typical = block_mean(variance, tile).repeat(tile, 0)[:height].repeat(tile, 1)[:, :width]
    noisy = typical > 0
    scaled = np.divide(difference, np.sqrt(typical), out=np.zeros(difference.shape, np.float32), where=noisy)

    def variogram(y: int, x: int) -> float:
        """The mean squared difference of pixels that are y rows and x columns apart."""
        one, two = _apart(scaled, y, x)
        change = two - one
        return float(np.mean(np.square(change, out=change), dtype=np.float64))

    if not (far := float(np.mean([variogram(*lag) for lag in FAR]))) > 0:
        return Inflation()
    correlations = sum(1 - variogram(*lag) / far for lag in NEAR)
    freedom = max(int(noisy.any(-1).sum()) / (2 * RADIUS + 1) ** 2, 1.0)
    return Inflation(max(1.0, 1 + 2 * correlations), freedom)  # −h is as far as h


def _apart(values: Array, y: int, x: int) -> tuple[Array, Array]:
    """The first and the second of all pairs of pixels that are y rows and x columns apart; H × W × C."""
    height, width = values.shape[:2]
    return values[: height - y, max(-x, 0) : width - max(x, 0)], values[y:, max(x, 0) : width - max(-x, 0)]


def differ_like_noise(a: Array, b: Array) -> bool:
    """Whether two images, H × W × C, look like the same image with other noise in each channel that differs.

    It is a hint: what is smaller than a tile of signs, or weaker than the noise, is not seen beside noise.
    """
    changed = np.flatnonzero((a != b).any((0, 1)))  # none: the numbers are the same, but not what they mean
    if not changed.size or min(a.shape[:2]) <= max(map(max, FAR)):
        return False
    # One at a time: a channel takes some fourteen times its memory.
    return all(_differs_like_noise(a[..., [i]], b[..., [i]], changed.size) for i in changed)


@np.errstate(over="ignore", invalid="ignore")
def _differs_like_noise(a: Array, b: Array, channels: int) -> bool:
    """`differ_like_noise` for one of so many channels that differ."""
    a, b = a.astype(np.float32), b.astype(np.float32)
    both, size = a + b, np.abs(a) + np.abs(b)
    share = np.divide(b - a, size, out=np.zeros_like(size), where=size > 0)
    signs = np.sign(share) * (np.abs(share) > FAINT * np.sqrt(np.square(share).mean(dtype=np.float64)))
    count, tiles = np.count_nonzero(signs), block_sum(signs, WIDE)
    z2 = 2 * REACH * math.log(2 * (tiles.size + 5 + len(FAR)) * channels / FALSE)
    if count < max(SOME * np.count_nonzero(size), z2 / SHOWN**2):
        return False

    def coins() -> Iterator[Array]:
        yield signs
        edged = np.pad(both, ((1, 1), (1, 1), (0, 0)), mode="edge")
        above, below, left, right = edged[:-2, 1:-1], edged[2:, 1:-1], edged[1:-1, :-2], edged[1:-1, 2:]
        around = (above + below + left + right) / 4
        for feature in (below - above, right - left, both - around, both - np.median(both)):
            yield signs * np.sign(feature)
        for lag in FAR:
            one, two = _apart(signs, *lag)
            yield one * two

    fair = (np.square(tiles) <= z2 * block_sum(np.abs(signs), WIDE)).all()
    return bool(fair) and all(float(x.sum()) ** 2 <= z2 * np.count_nonzero(x) for x in coins())


@dataclass(frozen=True)
class PixelSums:
    """Sums of u, or of d, and of its square over the pixels of each tile and channel: 1 or 2 × tiles × tiles × C.

    The second with the estimates of the variances exchanged, where the sides have different numbers of samples.
    `exponent`: g of P(S ≥ s) ≤ exp(−g s²), of all channels or of each.
    """

    total: Array
    squares: Array
    exponent: Array | float = 0.5

    def coarser(self, growth: int) -> PixelSums:
        """The same in tiles `growth` times as wide."""
        return replace(self, total=block_sum(self.total, growth), squares=block_sum(self.squares, growth))

    def p(self, area: Array, least: Array, inflation: Inflation) -> Array:
        """Upper bounds of the p of no pixel's u beyond `least`, which is that of a tile; NaN for what is not finite.

        `area`: pixels of a tile.
        """
        total = self.total - area * least
        squares = self.squares - 2 * least * self.total + area * np.square(least)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            s2 = np.where(total <= 0, 0.0, 2 * self.exponent * np.square(total) / (inflation.factor * squares))
        exponent = s2 if np.isinf(inflation.freedom) else inflation.freedom * np.log1p(s2 / inflation.freedom)
        bound: Array = np.exp(-exponent / 2).max(0)
        return bound


def sums(
    m1: Array, v1: Array, m2: Array, v2: Array, tile: int, ratio: Array | float = 1.0, exponent: Array | float = 0.5
) -> PixelSums:
    """Sums of u: of the means of both sides and the variances of these means, float64, H × W × C.

    `ratio`: samples of the first side over those of the second, of all channels or of each.
    """
    # Light that one render found alone has u = 0: its rounding, the same everywhere, must not add up.
    squared = np.square(m2 - m1) - ROUNDING * (np.square(m1) + np.square(m2))
    noise = [v1 + v2] if np.all(ratio == 1) else [v1 + v2, ratio * v1 + v2 / ratio]
    u = [squared - variance for variance in noise]
    total, squares = (np.stack([block_sum(x, tile) for x in values]) for values in (u, map(np.square, u)))
    return PixelSums(total, squares, exponent)


def rarity_exponent(known: float, other: float) -> float:
    """g, where the noise of a side of `known` samples is all that is known, and the other side has `other` samples."""
    return min(0.5, math.log1p(known / other))
