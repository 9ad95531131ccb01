"""By how much the means of tiles vary more than those of independent pixels, from the difference of two images alone.

Under a reconstruction filter wider than a pixel neighbours share samples. The variance of a pixel that was estimated
from the spread between passes is that of the filtered pixel then, and a tile's mean varies F = Σ ρₕ times as much as
the sum of these variances says, over the correlations ρₕ of pixels at every distance h.

The differences d of two images that are equal but for noise have the same correlations: with
γₕ = Σ (d(x + h) − d(x))², ρₕ = 1 − γₕ/γ∞. A true difference that is smooth cancels in γₕ. One that repeats itself
every few pixels may make F up to ten times as large, and is detected then from √F times its size on. Under a box
filter pixels are independent, and F is not asked for.
"""

from __future__ import annotations

import numpy as np

from mi_refract.io.pixels import Pixels, block_mean

from .tile_statistics import Inflation

RADIUS = 2  # pixels: of a Gaussian filter of σ = 0.5, Mitsuba's default, ρ is 0.0003 at 2√2 and 1e-4 at 3
FAR = ((0, 6), (6, 0), (5, 5), (5, -5))  # where no filter reaches
NEAR = tuple((y, x) for y in range(RADIUS + 1) for x in range(-RADIUS, RADIUS + 1) if (y, x) > (0, 0))


def inflation(difference: Pixels, variance: Pixels, tile: int) -> Inflation:
    """Of the difference of two images and its variance, both H × W × C; 1 for images of less than 12 pixels a side.

    Its degrees of freedom are the number of squares of 2 RADIUS + 1 pixels with noise, whose means would show F, too.
    """
    height, width = difference.shape[:2]
    if min(height, width) < 2 * max(max(lag) for lag in FAR):
        return Inflation()
    # Every tile counts alike, however bright it is.
    typical = block_mean(variance, tile).repeat(tile, 0)[:height].repeat(tile, 1)[:, :width]
    noisy = typical > 0
    scaled = np.divide(difference, np.sqrt(typical), out=np.zeros(difference.shape, np.float32), where=noisy)
    if not (far := float(np.mean([_variogram(scaled, *lag) for lag in FAR]))) > 0:
        return Inflation()
    correlations = [1 - _variogram(scaled, *lag) / far for lag in NEAR]
    freedom = max(int(noisy.any(-1).sum()) / (2 * RADIUS + 1) ** 2, 1.0)
    return Inflation(max(1.0, 1 + 2 * sum(correlations)), freedom)  # −h is as far as h


def _variogram(values: Pixels, y: int, x: int) -> float:
    """The mean squared difference of pixels that are y rows and x columns apart."""
    height, width = values.shape[:2]
    one = values[: height - y, max(-x, 0) : width - max(x, 0)]
    change = values[y:, max(x, 0) : width - max(-x, 0)] - one
    return float(np.mean(np.square(change, out=change), dtype=np.float64))
