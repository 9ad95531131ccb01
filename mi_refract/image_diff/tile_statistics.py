"""Welch's t-test on the tiles of two sets of independent renders, from single tiles up to the whole image.

Per tile and channel the means m₁, m₂ are compared by t = (m₁ − m₂)/√(v₁ + v₂). The variance v of a tile's mean is the
sum of its pixels' variances over the renders, and its degrees of freedom follow Satterthwaite: a tile of 16² pixels
knows its noise much better than the few renders do. (Welch 1947; Satterthwaite 1946; for renderers Jung, Hanika and
Dachsbacher, "Detecting Bias in Monte Carlo Renderers using Welch's t-test", JCGT 2020.)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

DARK = 1e-3  # a tile darker than this share of its channel's `usual` counts as that bright where shares are asked for
GROWTH = 4  # from one level of tiles to the next
HEAVY = 4.0  # a tile whose noise comes from fewer pixels than this is heavy-tailed: its t is not a Student's
POOLED = 30  # blocks of tiles from which the correlation of pixels is estimated again, at least
MISSED = 0.01  # a difference of the detectable size is missed with this probability
WORKERS = 2

Array = np.ndarray


@dataclass(frozen=True, order=True)
class Inflation:
    """By how much tile means vary more than with independent pixels, at least 1: those of a wide filter correlate.

    `freedom`: degrees of freedom of that estimate. Few tiles make it a guess, which t-tests have to know.
    """

    factor: float = 1.0
    freedom: float = np.inf


@dataclass(frozen=True)
class Side:
    """Totals per tile and channel: `mean`, `variance` of the means and its square, over pixels; `renders` one by one.

    `freedom`: degrees of freedom of a pixel's variance. Without `renders` pixels are taken for independent.
    """

    area: Array
    mean: Array
    variance: Array
    squares: Array
    freedom: float
    renders: Array | None = None

    def coarser(self) -> Side:
        area, mean, variance, squares = (
            block_sum(x, GROWTH) for x in (self.area, self.mean, self.variance, self.squares)
        )
        renders = None if self.renders is None else block_sum(self.renders, GROWTH)
        return Side(area, mean, variance, squares, self.freedom, renders)

    def spread(self, inflation: Inflation) -> tuple[Array, Array]:
        """The variance of the tile means, and its square over its degrees of freedom, summed over pixels."""
        variance = self.variance * inflation.factor / self.area**2
        freedom = self.freedom / inflation.factor  # correlated pixels are fewer
        squares = self.squares * inflation.factor**2 / self.area**4 / freedom
        return variance, squares + variance**2 / inflation.freedom

    def inflation(self) -> Inflation:
        """One for all tiles of an image. Of images without `renders` it is not known, and 1."""
        noisy = self.variance > 0
        if self.renders is None or not noisy.any():
            return Inflation()
        between = self.renders.var(0, ddof=1)[noisy] / len(self.renders)
        # The channels of a tile may share their noise: tiles count, not tiles and channels.
        freedom = self.freedom * int(noisy.any(-1).sum())
        return Inflation(max(1.0, float((between / self.variance[noisy]).mean())), freedom)


def block_sum(x: Array, size: int) -> Array:
    """Sums over size × size blocks of the axes −3 and −2; at the right and lower edge of what is left."""
    rows, columns = np.arange(0, x.shape[-3], size), np.arange(0, x.shape[-2], size)
    return np.add.reduceat(np.add.reduceat(x, rows, -3), columns, -2)


def from_renders(renders: Sequence[Array], tile: int) -> Side:
    """One side from independent renders, each H × W × C. Band by band: memory for a row of tiles only."""
    height, width = renders[0].shape[:2]
    columns = np.arange(0, width, tile)

    def band(top: int) -> tuple[Array, Array]:
        rows = np.empty((len(renders), *renders[0][top : top + tile].shape))
        for row, render in zip(rows, renders, strict=True):
            row[...] = render[top : top + tile]
        each = np.add.reduceat(rows.sum(1), columns, -2)
        with np.errstate(invalid="ignore"):
            rows -= rows.mean(0)
        variance = np.einsum("n...,n...->...", rows, rows) / (len(rows) * (len(rows) - 1))
        noise = np.stack([variance.sum(0), np.einsum("y...,y...->...", variance, variance)])
        return each, np.add.reduceat(noise, columns, -2)

    with ThreadPoolExecutor(WORKERS) as pool:
        each, noise = (np.stack(x, -3) for x in zip(*pool.map(band, range(0, height, tile)), strict=True))
    return Side(_area(height, width, tile), each.mean(0), noise[0], noise[1], len(renders) - 1.0, each)


def from_variances(mean: Array, variance: Array, freedom: float, tile: int) -> Side:
    """One side from an image and the variance of its pixels, both H × W × C."""
    area = _area(mean.shape[0], mean.shape[1], tile)
    squares = np.square(variance, dtype=np.float64)
    return Side(area, block_sum(mean, tile), block_sum(variance, tile), block_sum(squares, tile), freedom)


def _area(height: int, width: int, tile: int) -> Array:
    return block_sum(np.ones((height, width, 1)), tile)


@dataclass(frozen=True)
class Level:
    """One level of tiles. `t` signed, test over reference; `p` of no difference, `beyond` of one within the margin.

    `silent`: no noise on either side, of which a t-test knows nothing: p is 1 there, `off` where the means differ
    beyond the margin. `heavy`: noise from a few pixels only.
    """

    t: Array
    p: Array
    beyond: Array
    silent: Array
    off: Array
    heavy: Array
    mean: Array
    allowed: Array
    error: Array
    freedom: Array

    def detectable(self, threshold: float) -> Array:
        """Relative differences seen with probability 1 − MISSED at that p, of the tiles with light and noise."""
        from scipy import special

        asked = ~self.silent & (self.mean > DARK * median_nonblack(self.mean))
        freedom = self.freedom[asked]
        reach = -special.stdtrit(freedom, threshold / 2) - special.stdtrit(freedom, MISSED)
        return (reach * self.error[asked] + self.allowed[asked]) / self.mean[asked]


def levels(reference: Side, test: Side, margin: float) -> Iterator[Level]:
    """The test of single tiles, then of blocks GROWTH times as wide, and so on to the whole image."""
    inflations = reference.inflation(), test.inflation()
    while True:
        yield compare_tiles(reference, test, margin, inflations)
        if reference.area.size == 1:
            return
        reference, test = reference.coarser(), test.coarser()
        if reference.area.size >= POOLED:
            inflations = max(inflations[0], reference.inflation()), max(inflations[1], test.inflation())


def compare_tiles(
    one: Side, two: Side, margin: float, inflations: tuple[Inflation, Inflation] = (Inflation(), Inflation())
) -> Level:
    """Welch's test of every tile. Differences up to `margin`, relative to the tile's mean, are as good as none."""
    from scipy import special

    with np.errstate(divide="ignore", invalid="ignore"):
        m1, m2 = one.mean / one.area, two.mean / two.area
        v1, d1 = one.spread(inflations[0])
        v2, d2 = two.spread(inflations[1])
        variance, allowed = v1 + v2, margin * np.maximum(np.abs(m1), DARK * median_nonblack(np.abs(m1)))
        silent, error, difference = variance == 0, np.sqrt(variance), m2 - m1
        freedom = np.where(silent, 1.0, variance**2 / (d1 + d2))
        t = np.where(silent, 0.0, difference / error)
        beyond = np.where(silent, 0.0, np.maximum(np.abs(difference) - allowed, 0) / error)
        few = (one.variance + two.variance) ** 2 < HEAVY * (one.squares + two.squares)
        off = silent & (np.abs(difference) > allowed)
    p, p_beyond = (2 * special.stdtr(freedom, -np.abs(x)) for x in (t, beyond))
    return Level(t, p, p_beyond, silent, off, few & ~silent, np.abs(m1), allowed, error, freedom)


def median_nonblack(sizes: Array) -> Array:
    """Of each channel the median of what is not black. Not the mean: next to a lamp everything else would be dark."""
    channels = sizes.reshape(-1, sizes.shape[-1]).T
    return np.array([np.median(x[x > 0].astype(np.float64)) if (x > 0).any() else 0.0 for x in channels])


def sidak(family_error: float, count: int) -> float:
    """The p below which one of `count` independent tests is an alarm."""
    return float(-np.expm1(np.log1p(-family_error) / max(count, 1)))


def adjusted(p: Array) -> float:
    """The smallest p after Šidák; 1 of no tests."""
    return float(-np.expm1(p.size * np.log1p(-min(float(p.min()), 1 - 1e-16)))) if p.size else 1.0


def holm(p: Array, family_error: float) -> float:
    """The p below which a test is an alarm by Holm's step-down (1979): its first step, or the last one rejected."""
    first = family_error / max(p.size, 1)
    ordered = np.sort(p, axis=None)
    kept = np.flatnonzero(ordered > family_error / np.arange(ordered.size, 0, -1))
    rejected = ordered[: kept[0]] if kept.size else ordered
    return max(first, float(rejected[-1])) if rejected.size else first


def benjamini_hochberg(p: Array) -> Array:
    """Adjusted p: tiles below q are, but for a share q of them, different (Benjamini and Hochberg 1995)."""
    order = np.argsort(p, axis=None)
    scaled = p.ravel()[order] * p.size / np.arange(1, p.size + 1)
    adjusted = np.empty(p.size)
    adjusted[order] = np.minimum.accumulate(scaled[::-1])[::-1]
    return np.minimum(adjusted, 1).reshape(p.shape)


@dataclass(frozen=True)
class Welch:
    """`alarms`: tiles and channels that differ, at the given probability of any alarm between equal images.

    `smallest_p` is Šidák-adjusted; `detectable` the median over tiles of the smallest relative difference of means
    that would have been seen; `certain` counts tiles without any variance, which a t-test knows nothing of:
    they are alarms where the means differ beyond the margin.
    """

    alarms: int
    smallest_p: float
    detectable: float
    certain: int


def welch(reference: Array, test: Array, tile: int, family_error: float, margin: float = 0.0) -> Welch:
    """The test of single tiles of two stacks of independent renders, (renders, height, width, channels).

    Means that differ by no more than `margin`, relative to the tile's or to a thousandth of the channel's, are equal
    for all practical purposes: the test asks whether they differ by more. It keeps noise-free tiles from turning last
    bits into certainties. Pixels are taken for independent, as under a box filter.

    ValueError for fewer than 2 renders a side, or of another shape. A tile that is not finite is an alarm.
    """
    same_shape(reference[0], test[0])
    if min(len(reference), len(test)) < 2:
        raise ValueError(f"welch: {len(reference)} and {len(test)} renders: at least 2 a side are needed")
    found = compare_tiles(from_renders(list(reference), tile), from_renders(list(test), tile), margin)
    p = np.where(found.off | ~np.isfinite(found.beyond), 0.0, found.beyond)
    threshold = sidak(family_error, p.size)
    detectable = found.detectable(threshold)
    return Welch(
        int((p <= threshold).sum()),
        adjusted(p),
        float(np.median(detectable)) if detectable.size else 0.0,
        int(found.silent.sum()),
    )


def relative_mse(image: Array, references: Array, epsilon: float = 0.01) -> float:
    """mean((x − r)²/(r² + ε)) against the mean r of a stack of independent renders, less what r's own noise adds."""
    r = references.mean(0)
    same_shape(r, image)
    own = references.var(0, ddof=1) / len(references)
    return float(((np.square(image - r) - own) / (np.square(r) + epsilon)).mean())


def same_shape(reference: Array, test: Array) -> None:
    if reference.shape != test.shape:
        raise ValueError(f"images of different shapes: reference {reference.shape}, test {test.shape}")
