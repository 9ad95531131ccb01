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
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.pixels import Pixels as Array
from mi_refract.io.pixels import block_area, block_sum

DARK = 1e-3  # a tile darker than this share of its channel's `median_nonblack` counts as that bright in ratios
GROWTH = 4  # from one level of tiles to the next
HEAVY = 4.0  # a tile whose noise comes from fewer pixels than this is heavy-tailed: its t is not a Student's
POOLED = 30  # blocks of tiles from which the correlation of pixels is estimated again, at least
MISSED = 0.01  # the minimum detectable difference is missed with this probability
WORKERS = 2

CORRECTIONS = ("sidak", "holm")

Flags = NDArray[np.bool_]


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
        """The same side in tiles GROWTH times as wide."""
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
        """The inflation of all tiles of the image; 1 where it is not known, without `renders` or without noise."""
        noisy = self.variance > 0
        if self.renders is None or not noisy.any():
            return Inflation()
        between = self.renders.var(0, ddof=1)[noisy] / len(self.renders)
        # The channels of a tile may share their noise: tiles count, not tiles and channels.
        freedom = self.freedom * int(noisy.any(-1).sum())
        return Inflation(max(1.0, float((between / self.variance[noisy]).mean())), freedom)


def from_renders(renders: Sequence[Array], tile: int) -> Side:
    """One side from independent renders, each H × W × C; needs memory for a row of tiles only."""
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
    return Side(block_area(height, width, tile), each.mean(0), noise[0], noise[1], len(renders) - 1.0, each)


def from_variances(mean: Array, variance: Array, freedom: float, tile: int) -> Side:
    """One side from an image and the variance of its pixels, both H × W × C; `freedom`: of that variance."""
    area = block_area(mean.shape[0], mean.shape[1], tile)
    squares = np.square(variance, dtype=np.float64)
    return Side(area, block_sum(mean, tile), block_sum(variance, tile), block_sum(squares, tile), freedom)


@dataclass(frozen=True)
class Level:
    """One level of tiles; every array is tiles × tiles × C.

    `t`: positive where the test is brighter. `p`: of no difference; `beyond`: of none beyond the margin; both 0 where a
    value is not finite. `silent`: no noise on either side, of which a t-test knows nothing: p is 1 there, and `off`
    where the means differ beyond the margin. `heavy`: noise from a few pixels only.
    """

    t: Array
    p: Array
    beyond: Array
    silent: Flags
    off: Flags
    heavy: Flags
    mean: Array
    allowed: Array
    error: Array
    freedom: Array

    def detectable(self, threshold: float) -> Array:
        """Relative differences that are seen with probability 1 − MISSED at that p, of the tiles with light and noise.

        One dimension. A difference δ is seen where δ ≥ margin + (t(1 − p/2) + t(1 − MISSED)) · error.
        """
        from scipy import special

        asked = ~self.silent & (self.mean > DARK * median_nonblack(self.mean))
        freedom = self.freedom[asked]
        reach = -special.stdtrit(freedom, threshold / 2) - special.stdtrit(freedom, MISSED)
        return (reach * self.error[asked] + self.allowed[asked]) / self.mean[asked]


def levels(reference: Side, test: Side, equivalence_margin: float) -> Iterator[Level]:
    """The test of single tiles, then of blocks GROWTH times as wide, and so on to the whole image."""
    inflations = reference.inflation(), test.inflation()
    while True:
        yield compare_tiles(reference, test, equivalence_margin, inflations)
        if reference.area.size == 1:
            return
        reference, test = reference.coarser(), test.coarser()
        if reference.area.size >= POOLED:
            inflations = max(inflations[0], reference.inflation()), max(inflations[1], test.inflation())


def compare_tiles(
    one: Side,
    two: Side,
    equivalence_margin: float,
    inflations: tuple[Inflation, Inflation] = (Inflation(), Inflation()),
) -> Level:
    """Welch's t-test of every tile; differences up to `equivalence_margin` × the tile's mean count as none."""
    from scipy import special

    with np.errstate(divide="ignore", invalid="ignore"):
        m1, m2 = one.mean / one.area, two.mean / two.area
        v1, d1 = one.spread(inflations[0])
        v2, d2 = two.spread(inflations[1])
        variance = v1 + v2
        allowed = equivalence_margin * np.maximum(np.abs(m1), DARK * median_nonblack(np.abs(m1)))
        silent, error, difference = variance == 0, np.sqrt(variance), m2 - m1
        freedom = np.where(silent, 1.0, variance**2 / (d1 + d2))
        t = np.where(silent, 0.0, difference / error)
        beyond = np.where(silent, 0.0, np.maximum(np.abs(difference) - allowed, 0) / error)
        few = (one.variance + two.variance) ** 2 < HEAVY * (one.squares + two.squares)
        off = silent & (np.abs(difference) > allowed)
    # NaN becomes 0: what is not finite equals nothing.
    p, p_beyond = (np.nan_to_num(2 * special.stdtr(freedom, -np.abs(x)), nan=0.0) for x in (t, beyond))
    return Level(t, p, p_beyond, silent, off, few & ~silent, np.abs(m1), allowed, error, freedom)


def median_nonblack(sizes: Array) -> Array:
    """The median of each channel of … × C values without those that are 0 or less; 0 where none is left."""
    # Not the mean: next to a lamp everything else would be dark.
    channels = sizes.reshape(-1, sizes.shape[-1]).T
    return np.array([np.median(x[x > 0].astype(np.float64)) if (x > 0).any() else 0.0 for x in channels])


def sidak(family_error: float, count: int) -> float:
    """The p below which one of `count` independent tests is an alarm (Šidák 1967): 1 − (1 − family_error)^(1/count)."""
    return float(-np.expm1(np.log1p(-family_error) / max(count, 1)))


def adjusted(p: Array) -> float:
    """The smallest p after Šidák's correction; 1 where there are no tests."""
    return float(-np.expm1(p.size * np.log1p(-min(float(p.min()), 1 - 1e-16)))) if p.size else 1.0


def holm(p: Array, family_error: float) -> float:
    """The p below which a test is an alarm by Holm's step-down (1979): its first step, or the last one rejected."""
    first = family_error / max(p.size, 1)
    ordered = np.sort(p, axis=None)
    kept = np.flatnonzero(ordered > family_error / np.arange(ordered.size, 0, -1))
    rejected = ordered[: kept[0]] if kept.size else ordered
    return max(first, float(rejected[-1])) if rejected.size else first


# All tests of an image -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TileTests:
    """The tests of all tiles and channels with noise, on every level, at one probability of any false alarm."""

    levels: list[Level]
    family_error: float
    correction: str = "sidak"

    @cached_property
    def p(self) -> Array:
        """Of all levels the p of tiles with noise, in one dimension."""
        return np.concatenate([level.beyond[~level.silent] for level in self.levels])

    @cached_property
    def threshold(self) -> float:
        """The p at or below which a test is an alarm."""
        if self.correction == "holm":
            return holm(self.p, self.family_error)
        return sidak(self.family_error, self.p.size)

    @property
    def differing(self) -> int:
        """The number of tests that are alarms; heavy-tailed tiles are not among them."""
        return sum(int((self._seen(level) & ~level.heavy).sum()) for level in self.levels)

    @property
    def heavy_differing(self) -> int:
        """The number of tests of heavy-tailed tiles that would be alarms."""
        return sum(int((self._seen(level) & level.heavy).sum()) for level in self.levels)

    @property
    def silent_differing(self) -> int:
        """The number of single tiles and channels without noise whose means differ beyond the margin."""
        return int(self.levels[0].off.sum())

    @property
    def alarms(self) -> int:
        """The number of tests that differ, whatever is known of their noise."""
        return self.differing + self.heavy_differing + self.silent_differing

    @property
    def smallest_p(self) -> float:
        """The smallest p after Šidák's correction."""
        return adjusted(self.p)

    def minimum_detectable(self, level: int = 0) -> float:
        """The smallest relative difference that is seen in the median tile of a level; NaN where none has noise."""
        found = self.levels[level].detectable(self.threshold)
        return float(np.median(found)) if found.size else np.nan

    def _seen(self, level: Level) -> Flags:
        return (level.beyond <= self.threshold) & ~level.silent


def compare_stacks(
    reference: Array, test: Array, tile: int, family_error: float, equivalence_margin: float = 0.0
) -> TileTests:
    """Welch's test of single tiles of two stacks of independent renders, each renders × H × W × C.

    Pixels are taken for independent, as under a box filter. A tile with a value that is not finite is an alarm.
    `equivalence_margin` is relative to the tile's mean, or to a thousandth of the channel's; above 0 it keeps tiles
    without noise from differing by their last bits. ValueError for fewer than 2 renders a side, or another shape.
    """
    same_shape(reference[0], test[0])
    if min(len(reference), len(test)) < 2:
        raise ValueError(f"welch: {len(reference)} and {len(test)} renders: at least 2 a side are needed")
    one, two = (from_renders(list(side), tile) for side in (reference, test))
    return TileTests([compare_tiles(one, two, equivalence_margin)], family_error)


def relative_mse(image: Array, references: Array, epsilon: float = 0.01) -> float:
    """mean((x − r)²/(r² + ε)) against the mean r of a stack of independent renders, less what r's own noise adds.

    `image` H × W × C, `references` renders × H × W × C. ValueError for other shapes.
    """
    r = references.mean(0)
    same_shape(r, image)
    own = references.var(0, ddof=1) / len(references)
    return float(((np.square(image - r) - own) / (np.square(r) + epsilon)).mean())


def same_shape(reference: Array, test: Array) -> None:
    """ValueError unless both arrays have one shape."""
    if reference.shape != test.shape:
        raise ValueError(f"images of different shapes: reference {reference.shape}, test {test.shape}")
