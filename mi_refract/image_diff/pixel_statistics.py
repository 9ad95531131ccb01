"""Tests of single pixels for differences that the means of tiles do not show, and estimates of the noise from pixels.

**Differences inside a tile**, such as stripes that trade places. At every pixel the means m₁, m₂ of the two sides have
the estimated variances v₁, v₂. Then u = (m₂ − m₁)² − v₁ − v₂ has the expectation δ², where δ is the true difference,
for noise of any distribution. The tested statistic of a tile is S = Σu / √(Σu²) over its pixels.

For independent pixels whose u is symmetric, P(S ≥ s) ≤ exp(−s²/2) (Efron 1969, by Hoeffding's bound for signs). If
the renders are equal, u is skewed to the right at every pixel: as a form Σ aⱼₖ xⱼ xₖ in the renders, without j = k, it
has one positive eigenvalue among many negative ones, and Σ aⱼₖ³ ≥ 0. That makes large S rarer, because a long right
tail increases Σu² more than Σu. If pixels correlate, Σu² is too small by at most the inflation F of tile means, since
ρ² ≤ |ρ|. If F is estimated with f degrees of freedom, the expectation of the bound over that estimate is
(1 + s²/f)^(−f/2).

**Rare light** skews u to the left if the sides have n₁ > n₂ samples: the second side has none of that light in most
pixels, where v₂ is 0 and u = m₁² > 0. Equal images have the same variance of a sample. With the estimates exchanged,
v₁ n₁/n₂ + v₂ n₂/n₁, such a pixel has u < 0, and single events of the second side are a tail on the right. A tile
differs only if it does so with both.

**Noise known on one side only**, from n samples, where the other side has m: d = ±(m₂ − m₁), positive where the other
side is brighter, is tested in the same way, S = Σd / √(Σd²). Light of rare events has d > 0 where only the other side
found it, and single events are no evidence of a difference. The probability that all of k events are in the m samples
is (1 + n/m)⁻ᵏ; they give S² = k in d, and in u if n < m. So for both P(S ≥ s) ≤ exp(−g s²), where g is
min(½, ln(1 + n/m)) instead of ½.

**Correlation.** Under a filter wider than a pixel, neighbours share samples. A variance that was estimated from the
spread between passes is that of the filtered pixel. Then the mean of a tile varies F = Σ ρₕ times as much as the sum of
these variances says, where ρₕ are the correlations of pixels at all distances h. `inflation` estimates F from the
difference d of two images that are equal except for noise: γₕ = Σ (d(x + h) − d(x))², and ρₕ = 1 − γₕ/γ∞. A smooth true
difference cancels in γₕ. One that repeats every few pixels can make F up to ten times as large, and is detected only
from √F times its size on.

**The same image with other noise.** Let a pixel of two single images have the same distribution in both, independently
of other pixels. Then the pixel of one image may be exchanged with that of the other: the sign s of d = b − a is a fair
coin, whatever |d| and a + b are. Products of s with a sign that depends only on |d| and a + b are fair coins, too, and
so are products of the s of two pixels. For N fair coins P(|Σ| ≥ z√N) ≤ 2 exp(−z²/2) (Hoeffding 1963).
`differ_like_noise` tests the sums of

- s, in tiles and in the whole image, which detects a change of brightness;
- s times the sign of a + b less its median, of a + b less the mean of its neighbours, and of its slopes, which detects
  a change of contrast, of sharpness or of position;
- products of two s so far apart that no filter reaches, which detects any shape.

Noise that only one side has, as after denoising, shows in a + b less the mean of its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mi_refract.io.image_file import Pixels as Array
from mi_refract.io.image_file import block_mean, block_sum

ROUNDING = 1e-12  # relative to m²: more than the rounding of u in float64, which is some 1e-16 (m² + u)
RADIUS = 2  # pixels: under a Gaussian filter of σ = 0.5, Mitsuba's default, ρ is 0.0003 at 2√2 and 1e-4 at 3
FAR = ((0, 6), (6, 0), (5, 5), (5, -5))  # distances in rows and columns that no filter reaches
REACH = 4.0  # F that tests of sums of signs assume: under a Gaussian filter of σ = 0.5 it is 4πσ² = 3.1
FALSE = 0.01  # probability that noise is not recognised
WIDE = 32  # side of a tile of signs in pixels
FAINT = 0.1  # relative changes below this times their RMS are ignored, such as last bits beside a true difference
SOME = 0.25  # share of the pixels that are not black which must change, because noise is everywhere
SHOWN = 0.2  # with so many pixels that a correlation of this size is detected
NEAR = tuple((y, x) for y in range(RADIUS + 1) for x in range(-RADIUS, RADIUS + 1) if (y, x) > (0, 0))


@dataclass(frozen=True, order=True)
class Inflation:
    """The variance of tile means relative to that for independent pixels, at least 1; `freedom`: degrees of freedom.

    Pixels under a wide filter correlate. With few tiles the estimate is uncertain, which t-tests take into account.
    `factor`: one for all tiles, or one for each.
    """

    factor: Array | float = 1.0
    freedom: float = np.inf


def inflation(difference: Array, variance: Array, tile: int) -> Inflation:
    """Estimate the inflation from the difference of two images and its variance, both H × W × C.

    Its degrees of freedom are the number of squares of 2 RADIUS + 1 pixels with noise. It is 1 for images of less than
    12 pixels a side.
    """
    height, width = difference.shape[:2]
    if min(height, width) < 2 * max(max(lag) for lag in FAR):
        return Inflation()
    # Scaled by the noise of each tile, so that bright tiles do not dominate.
    typical = block_mean(variance, tile).repeat(tile, 0)[:height].repeat(tile, 1)[:, :width]
    noisy = typical > 0
    scaled = np.divide(difference, np.sqrt(typical), out=np.zeros(difference.shape, np.float32), where=noisy)

    def variogram(y: int, x: int) -> float:
        """Return the mean squared difference of pixels that are y rows and x columns apart."""
        one, two = _pairs_apart(scaled, y, x)
        change = two - one
        return float(np.mean(np.square(change, out=change), dtype=np.float64))

    far = float(np.mean([variogram(*lag) for lag in FAR]))
    if not far > 0:
        return Inflation()
    correlations = sum(1 - variogram(*lag) / far for lag in NEAR)
    freedom = max(int(noisy.any(-1).sum()) / (2 * RADIUS + 1) ** 2, 1.0)
    return Inflation(max(1.0, 1 + 2 * correlations), freedom)  # NEAR has one of the distances h and −h


def _pairs_apart(values: Array, y: int, x: int) -> tuple[Array, Array]:
    """Return the first and the second pixels of all pairs that are y rows and x columns apart, H × W × C each."""
    height, width = values.shape[:2]
    return values[: height - y, max(-x, 0) : width - max(x, 0)], values[y:, max(x, 0) : width - max(-x, 0)]


def differ_like_noise(a: Array, b: Array) -> bool:
    """Return whether two images, H × W × C, look like the same image with other noise in each channel that differs.

    This is a hint: beside noise, a difference smaller than a tile of signs or weaker than the noise is not detected.
    """
    changed = np.flatnonzero((a != b).any((0, 1)))  # empty if only metadata differ
    if not changed.size or min(a.shape[:2]) <= max(map(max, FAR)):
        return False
    # One channel at a time, because the test takes some fourteen times the memory of a channel.
    return all(_differs_like_noise(a[..., [i]], b[..., [i]], changed.size) for i in changed)


@np.errstate(over="ignore", invalid="ignore")
def _differs_like_noise(a: Array, b: Array, channels: int) -> bool:
    """Return `differ_like_noise` for one channel; `channels`: the number of channels that differ."""
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
            one, two = _pairs_apart(signs, *lag)
            yield one * two

    fair = (np.square(tiles) <= z2 * block_sum(np.abs(signs), WIDE)).all()
    return bool(fair) and all(float(x.sum()) ** 2 <= z2 * np.count_nonzero(x) for x in coins())


@dataclass(frozen=True)
class PixelSums:
    """Sums of u, or of d, and of its square over the pixels of each tile and channel: 1 or 2 × tiles × tiles × C.

    If the sides have different numbers of samples, the second set has the estimated variances exchanged. `exponent`: g
    of P(S ≥ s) ≤ exp(−g s²), a number or one per channel.
    """

    total: Array
    squares: Array
    exponent: Array | float = 0.5

    def coarser(self, growth: int) -> PixelSums:
        """Return the sums in tiles `growth` times as wide."""
        return replace(self, total=block_sum(self.total, growth), squares=block_sum(self.squares, growth))

    def p(self, area: Array, least: Array, inflation: Inflation) -> Array:
        """Return upper bounds of the p-value that no pixel has an expected u above `least`, per tile.

        `area`: pixels of each tile; `least`: one value per tile. NaN for values that are not finite.
        """
        total = self.total - area * least
        squares = self.squares - 2 * least * self.total + area * np.square(least)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            s2 = np.where(total <= 0, 0.0, 2 * self.exponent * np.square(total) / (inflation.factor * squares))
        exponent = s2 if np.isinf(inflation.freedom) else inflation.freedom * np.log1p(s2 / inflation.freedom)
        return np.asarray(np.exp(-exponent / 2).max(0))


def sums(
    m1: Array, v1: Array, m2: Array, v2: Array, tile: int, ratio: Array | float = 1.0, exponent: Array | float = 0.5
) -> PixelSums:
    """Return the sums of u from the means of both sides and the variances of these means, float64, H × W × C.

    `ratio`: samples of the first side over those of the second, a number or one per channel.
    """
    # Light that only one render found has u = 0. Its rounding, the same in many pixels, must not add up.
    squared = np.square(m2 - m1) - ROUNDING * (np.square(m1) + np.square(m2))
    noise = [v1 + v2] if np.all(ratio == 1) else [v1 + v2, ratio * v1 + v2 / ratio]
    u = [squared - variance for variance in noise]
    total, squares = (np.stack([block_sum(x, tile) for x in values]) for values in (u, map(np.square, u)))
    return PixelSums(total, squares, exponent)


def rarity_exponent(known: float, other: float) -> float:
    """Return g if only the noise of a side with `known` samples is known, and the other side has `other` samples."""
    return min(0.5, math.log1p(known / other))
