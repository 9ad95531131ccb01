"""Welch's t-test on the tiles of two images with known noise, from single tiles up to the whole image.

The means m₁, m₂ of each tile and channel are compared by t = (m₁ − m₂)/√(v₁ + v₂), with v = s²/n for n samples of
variance s². The variance v of a tile's mean is the sum of its pixels' variances, divided by their number squared. Its
degrees of freedom follow Satterthwaite, f = v²/Σ(vᵢ²/fᵢ) over all pixels of both sides: with 16² pixels a tile's noise
is known much better than that of one pixel from a few renders. (Welch, "The generalization of Student's problem",
Biometrika 1947; Satterthwaite 1946; for renderers Jung, Hanika and Dachsbacher, "Detecting Bias in Monte Carlo
Renderers using Welch's t-test", JCGT 2020.)

If one side has fewer samples than the other, n₂ < n₁, it may miss rare light in a tile, and its variance is near 0
there. Equal images have the same variance σ² of a sample, so the estimates s₁², s₂² may be exchanged: the variance of
m₁ − m₂ is the larger of s₁²/n₁ + s₂²/n₂ and s₁²/n₂ + s₂²/n₁. The second is the pooled estimate times (1/n₁ + 1/n₂); if
n₁ = n₂ both are the same. Let the rare light consist of equal events, λ of them expected on the side with fewer
samples. Then these bounds hold:

- Too few events: no event is −√λ standard deviations, and P(t ≤ −x) ≤ exp(−x²/2) as for every mean of values of at
  least 0 (Maurer 2003). A tile with fewer than x² expected events is no alarm at −x.
- Too many events: k events are x ≤ (k − λ)/√k standard deviations by their own variance, and
  P ≤ exp(−(k ln(k/λ) − k + λ)) ≤ exp(−x²/2) (Chernoff; with r = λ/k, −ln r − 1 + r ≥ (1 − r)²/2).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Pixels as Array
from mi_refract.io.image_file import block_area, block_sum

from .pixel_statistics import Inflation, PixelSums, sums

DARK = 1e-3  # smallest denominator of relative differences, relative to the channel's `median_nonblack`
GROWTH = 4  # ratio of the tile sides of one level and the level below
HEAVY = 4.0  # a tile whose noise comes from fewer pixels than this is heavy-tailed: its t has no Student distribution
SINGLE = 0.3  # in units of a tile's standard error: a pixel that changes its mean by more may contain rare light
POOLED = 30  # minimum number of blocks of tiles from which the correlation of pixels is estimated again
FEW_STEPS = 8  # steps of a fixed-point iteration, each of which at least halves the error
MISSED = 0.01  # probability with which the minimum detectable difference is missed
HOLLOW = 0.01  # pixels that scatter by less than this share of the stated variance do not show that noise
FAR = 10.0  # multiple of the margin by which a pixel without noise must differ, see `with_silent_pixels`
UNSEEN = 1e-3  # relative to the margin: a tile with less noise than this is left out of `Side.inflation`
UNEVEN = 2.0  # standard errors by which the spread of the tiles' inflations must exceed that of chance
WORKERS = 2

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Side:
    """One side of a comparison: sums per tile and channel, tiles × tiles × C, over the pixels of a tile.

    `area`: number of pixels. `mean`: sum of the pixels' means; `variance`, `squares`: sums of the variances of these
    means, and of the squares of these variances. `freedom`: degrees of freedom of a pixel's variance. `count`: samples
    of a pixel, in the unit of the other side; a number or one per channel. `renders`: sums of each render; without
    them, `correlated` says how much the pixels correlate.
    """

    area: Array
    mean: Array
    variance: Array
    squares: Array
    freedom: float
    count: Array | float = 1.0
    renders: Array | None = None
    correlated: Inflation = field(default_factory=Inflation)

    def coarser(self) -> Side:
        """Return the same side in tiles GROWTH times as wide."""
        area, mean, variance, squares = (
            block_sum(x, GROWTH) for x in (self.area, self.mean, self.variance, self.squares)
        )
        renders = None if self.renders is None else block_sum(self.renders, GROWTH)
        return replace(self, area=area, mean=mean, variance=variance, squares=squares, renders=renders)

    def spread(self, inflation: Inflation) -> tuple[Array, Array]:
        """Return the variance v of the tile means, and v²/f for its degrees of freedom f (Satterthwaite 1946)."""
        variance = self.variance * inflation.factor / self.area**2
        freedom = self.freedom / inflation.factor  # correlated pixels count as fewer independent ones
        squares = self.squares * inflation.factor**2 / self.area**4 / freedom
        return variance, squares + variance**2 / inflation.freedom

    def inflation(self, margin: float = 0.0) -> Inflation:
        """Return how much more the tile means vary between renders than those of independent pixels.

        Without renders it is `correlated`. `margin`: the equivalence margin. Tiles whose noise is below UNSEEN times
        the margin, such as a plain sky, are left out: their noise may be the rounding of a sum, which is the same in
        all pixels of a render and says nothing about the correlation in other tiles. Such a tile differs beyond the
        margin by 1000 σ of independent pixels or not at all.
        """
        ratios, tiles = self._ratios(margin)
        if not tiles:
            return self.correlated
        return Inflation(max(1.0, float(ratios.mean())), self.freedom * tiles)

    def _ratios(self, margin: float) -> tuple[Array, int]:
        """Return the inflation by tile and channel, of those with noise, and the number of these tiles."""
        noisy = self.variance > np.square(UNSEEN * margin * self.mean)
        if self.renders is None or not noisy.any():
            return np.zeros(0), 0
        # The channels of a tile may have the same noise, so a tile counts once, not once per channel.
        return self.between[noisy] / self.variance[noisy], int(noisy.any(-1).sum())

    @property
    def between(self) -> Array:
        """The same as `variance`, from the sums of each render, so that pixels may correlate."""
        assert self.renders is not None
        return np.asarray(self.renders.var(0, ddof=1) / len(self.renders))

    def uneven(self, margin: float) -> bool:
        """Return whether the inflation differs between tiles or channels, as where a part of an image is denoised.

        With one inflation, d times the ratios over it are χ²-distributed with d degrees of freedom. So the square of
        their coefficient of variation is 2/d, which N tiles show with a relative standard error of √((2 + 12/d)/N).
        """
        ratios, tiles = self._ratios(margin)
        if tiles < 2 or not ratios.any():
            return False
        excess = ratios.var() / ratios.mean() ** 2 * self.freedom / 2 - 1
        return bool(excess > UNEVEN * np.sqrt((2 + 12 / self.freedom) / tiles))


def from_variances(mean: Array, variance: Array, freedom: float, tile: int, count: Array | float = 1.0) -> Side:
    """Return one side, from an image and the variance of its pixels, both H × W × C.

    `freedom`: degrees of freedom of the variance; `count`: samples per pixel.
    """
    area = block_area(mean.shape[0], mean.shape[1], tile)
    squares = np.square(variance, dtype=np.float64)
    return Side(area, block_sum(mean, tile), block_sum(variance, tile), block_sum(squares, tile), freedom, count)


@dataclass(frozen=True)
class OneSided:
    """Data for tests by pixels where the noise of only one side is known.

    `brighter`: d of `pixel_statistics` at every pixel, H × W × C; 0 in channels whose noise both sides know.
    `exponent`: g of that module. `well_known`: the channels whose noise is known from so many samples that these
    include the rare light of the other side. `correlated`: how much more tile means vary than those of independent
    pixels.
    """

    brighter: Array
    exponent: Array
    well_known: Flags
    correlated: Inflation

    def p(self, level: Level, area: Array, tile: int) -> Array:
        """Return the p-value of no difference beyond the margin, per tile; 0 where the other side is not brighter.

        Where the noise is well known, the change of a tile's mean by one pixel is clipped to SINGLE times its standard
        error, because brighter pixels may contain rare light. If one event changes the mean by more than that, equal
        images have λ < 1/SINGLE² = 11 events in a tile; clipped, k of them are SINGLE k − √λ < (k − λ)/√λ σ.
        In other channels the noise is estimated from the pixels of the tile.
        """
        from scipy import special

        height, width = self.brighter.shape[:2]
        limit = (SINGLE * level.error * area).repeat(tile, 0)[:height].repeat(tile, 1)[:, :width]
        clipped = block_sum(np.minimum(self.brighter, limit), tile)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (clipped / area - level.allowed) / level.error
        total, squares = (block_sum(x, tile)[None] for x in (self.brighter, np.square(self.brighter)))
        by_pixels = PixelSums(total, squares, self.exponent).p(area, level.allowed, self.correlated)
        p = np.where(self.well_known, special.stdtr(level.freedom, -t), by_pixels)
        return np.where(total[0] > 0, np.nan_to_num(2 * p, nan=0.0), 0.0)


@dataclass(frozen=True)
class Evidence:
    """Both sides in tiles of side `tile`.

    `pixels`: the sums over the pixels of each tile; None: pixels are not tested. `one_sided`: set if for some channel
    the noise of only one side is known. `odds`: see `with_silent_pixels`.
    """

    tile: int
    one: Side
    two: Side
    pixels: PixelSums | None = None
    one_sided: OneSided | None = None
    odds: Array | float = 7.0

    def levels(self, margin: float) -> Iterator[Level]:
        """Yield the tests of single tiles, then of blocks GROWTH times as wide, and so on up to the whole image.

        `margin`: the equivalence margin. The correlation of pixels is estimated from all tiles, and again from larger
        blocks as long as there are POOLED of them: these show correlation over larger distances.
        """
        tile, one, two, pixels = self.tile, self.one, self.two, self.pixels
        inflations, uneven = (one.inflation(margin), two.inflation(margin)), one.uneven(margin) or two.uneven(margin)
        while True:
            level = compare_tiles(one, two, margin, inflations)
            if uneven:
                level = _with_own_noise(level, one, two, pixels)
            if pixels:
                p = pixels.p(one.area, np.square(level.allowed), max(inflations))
                hollow = self._p_by_scatter(level, one, two, pixels, max(inflations).factor)
                level = replace(level, of_pixels=np.where(level.silent, 1.0, np.nan_to_num(p, nan=0.0)), hollow=hollow)
            if self.one_sided:
                level = replace(level, shown=self.one_sided.p(level, one.area, tile))
            yield level
            if one.area.size == 1:
                return
            tile, one, two, pixels = GROWTH * tile, one.coarser(), two.coarser(), pixels and pixels.coarser(GROWTH)
            if one.area.size >= POOLED:
                inflations = max(inflations[0], one.inflation(margin)), max(inflations[1], two.inflation(margin))

    @staticmethod
    def _p_by_scatter(level: Level, one: Side, two: Side, pixels: PixelSums, factor: Array | float) -> Array:
        """Return the p-value of no difference of a tile beyond the margin, by the scatter of its pixels' differences d.

        It is 1 where Σd² is at least HOLLOW times the sum of the stated variances: there the pixels show that noise.
        """
        from scipy import special

        stated, area = one.variance + two.variance, one.area
        squares = pixels.total[0] + stated
        total = two.mean - one.mean
        with np.errstate(divide="ignore", invalid="ignore"):
            scatter = np.maximum(squares - total**2 / area, 0) / (area - 1)
            t = (np.abs(total) / area - level.allowed) / np.sqrt(factor * scatter / area)
            p = 2 * special.stdtr(area - 1, -np.maximum(t, 0))
        return np.where((squares < HOLLOW * stated) & (area > 1), np.nan_to_num(p, nan=1.0), 1.0)


def from_renders(
    reference: Sequence[Array], test: Sequence[Array], tile: int, counts: tuple[float, float] | None = None
) -> Evidence:
    """Return the evidence of two sets of independent renders, each H × W × C, at least 2 a side.

    `counts`: samples per pixel of all renders of each side; None: the number of renders. The renders are processed by
    rows of tiles, which limits the memory.
    """
    sides = reference, test
    counts = counts or (len(reference), len(test))

    def band(top: int) -> tuple[list[tuple[Array, Array, Array]], PixelSums]:
        """Return of one row of tiles the sums of each side (renders, variances, squares), and the sums of u."""
        rows = [np.array([render[top : top + tile] for render in side], np.float64) for side in sides]
        with np.errstate(invalid="ignore", over="ignore"):
            variances = [x.var(0, ddof=1) / len(x) for x in rows]
            pixels = sums(rows[0].mean(0), variances[0], rows[1].mean(0), variances[1], tile, counts[0] / counts[1])
            totals = [
                (block_sum(x, tile), block_sum(v, tile), block_sum(v * v, tile))
                for x, v in zip(rows, variances, strict=True)
            ]
        return totals, pixels

    with ThreadPoolExecutor(WORKERS) as pool:
        totals, pixels = zip(*pool.map(band, range(0, len(reference[0]), tile)), strict=True)
    area = block_area(reference[0].shape[0], reference[0].shape[1], tile)
    in_tiles = []
    for of_side, count in zip(zip(*totals, strict=True), counts, strict=True):
        renders, variance, squares = (np.concatenate(bands, -3) for bands in zip(*of_side, strict=True))
        in_tiles.append(Side(area, renders.mean(0), variance, squares, len(renders) - 1.0, count, renders))
    total, squares = (np.concatenate([getattr(u, name) for u in pixels], -3) for name in ("total", "squares"))
    one, two = in_tiles
    return Evidence(tile, one, two, PixelSums(total, squares))


@dataclass(frozen=True)
class Level:
    """The tests of one level of tiles; every array is tiles × tiles × C.

    - `reference`: means of the reference; `difference`: mean of the test image less that of the reference.
    - `mean`: the larger magnitude of both means; `allowed`: the margin in the unit of the image; `error`: the standard
      error of the difference; `freedom`: its degrees of freedom.
    - `t`: Welch's t of the difference. `p`: p-value of no difference; `beyond`: p-value of no difference beyond the
      margin. Both p-values are 0 where a value is not finite.
    - `silent`: tiles without noise on either side. A t-test does not apply, and their p is 1. `off`: silent tiles whose
      means differ beyond the margin. `heavy`: tiles whose noise comes from a few pixels only.
    - `shown`: p-value of no difference beyond the margin, with the noise that the pixels show; 0: not tested.
    - `hollow`: the same where the pixels do not show the stated noise; 1 where they do.
    - `own`, `own_pixels`: the same, and that of no pixel beyond the margin, where the inflation is uneven and the own
      noise of the tile between renders is larger than that by the mean inflation; 0 elsewhere.
    - `of_pixels`: p-value of no pixel beyond the margin; `of_silent`: the same for silent tiles. None: not tested.
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
    reference: Array
    difference: Array
    shown: Array | float = 0.0
    hollow: Array | float = 1.0
    own: Array | float = 0.0
    own_pixels: Array | float = 0.0
    of_pixels: Array | None = None
    of_silent: Array | None = None

    @property
    def lit(self) -> Flags:
        """The tiles and channels with light; relative differences of darker ones are meaningless."""
        return self.mean > DARK * median_nonblack(self.mean)

    def detectable(self, threshold: float) -> Array:
        """Return the relative difference that is detected with probability 1 − MISSED, if p ≤ `threshold` is an alarm.

        It is margin + (t(1 − p/2) + t(1 − MISSED)) · error, over the mean; NaN for tiles without light or noise.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            return (self.reach(threshold) + self.allowed) / self.mean

    def reach(self, threshold: float) -> Array:
        """Return by how much the smallest detected difference exceeds the margin; NaN without light or noise."""
        from scipy import special

        noisy = ~self.silent & self.lit
        freedom = self.freedom[noisy]
        quantiles = np.full(self.mean.shape, np.nan)
        quantiles[noisy] = -special.stdtrit(freedom, threshold / 2) - special.stdtrit(freedom, MISSED)
        return quantiles * self.error


def compare_tiles(
    one: Side, two: Side, margin: float, inflations: tuple[Inflation, Inflation] = (Inflation(), Inflation())
) -> Level:
    """Return Welch's t-tests of every tile; differences up to `margin` × the tile's mean count as none.

    That mean is the larger one of both sides, so that light that only one side has is detected.
    """
    from scipy import special

    def noise(ratio: Array | float) -> tuple[Array, Array, Flags]:
        """Return the variance v of m₁ − m₂, v²/f, and whether v comes from few pixels.

        `ratio`: 1 for s₁²/n₁ + s₂²/n₂, n₁/n₂ for s₁²/n₂ + s₂²/n₁.
        """
        (v1, d1), (v2, d2) = one.spread(inflations[0]), two.spread(inflations[1])
        pixels = HEAVY * max(inflations).factor  # correlated pixels
        squares = ratio**2 * one.squares + two.squares / ratio**2
        few = (ratio * one.variance + two.variance / ratio) ** 2 < pixels * squares
        return ratio * v1 + v2 / ratio, ratio**2 * d1 + d2 / ratio**2, few

    with np.errstate(divide="ignore", invalid="ignore"):
        m1, m2 = one.mean / one.area, two.mean / two.area
        ratio = one.count / two.count
        own, exchanged = noise(1.0), noise(ratio)
        larger = exchanged[0] > own[0]
        variance, squares, few = (np.where(larger, y, x) for x, y in zip(own, exchanged, strict=True))
        mean = np.maximum(np.abs(m1), np.abs(m2))
        allowed = margin * np.maximum(mean, DARK * median_nonblack(mean))
        silent, error, difference = variance == 0, np.sqrt(variance), m2 - m1
        freedom = np.where(silent, 1.0, variance**2 / squares)
        t = np.where(silent, 0.0, difference / error)
        beyond = np.where(silent, 0.0, np.maximum(np.abs(difference) - allowed, 0) / error)
        off = silent & (np.abs(difference) > allowed)
    # A p of NaN becomes 0: a value that is not finite equals nothing.
    p, p_beyond = (np.nan_to_num(2 * special.stdtr(freedom, -np.abs(x)), nan=0.0) for x in (t, beyond))
    return Level(t, p, p_beyond, silent, off, few & ~silent, mean, allowed, error, freedom, m1, difference)


def _with_own_noise(level: Level, one: Side, two: Side, pixels: PixelSums | None) -> Level:
    """Return the level with tests by each tile's own noise between renders, where that is the larger."""
    from scipy import special

    freedoms, ratio = (one.freedom, two.freedom), one.count / two.count
    v1, v2 = one.between / one.area**2, two.between / two.area**2
    exchange = ratio * v1 + v2 / ratio > v1 + v2
    v1, v2 = np.where(exchange, ratio * v1, v1), np.where(exchange, v2 / ratio, v2)
    variance = v1 + v2
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = variance**2 / (v1**2 / freedoms[0] + v2**2 / freedoms[1])
        t = np.maximum(np.abs(level.difference) - level.allowed, 0) / np.sqrt(variance)
        factor = np.fmax(one.between / one.variance, two.between / two.variance)
    larger = ~level.silent & (variance > np.square(level.error))
    level = replace(level, own=np.where(larger, 2 * special.stdtr(freedom, -t), 0.0))
    if not pixels:
        return level
    p = pixels.p(one.area, np.square(level.allowed), Inflation(factor, min(freedoms)))
    return replace(level, own_pixels=np.where(larger, p, 0.0))


def with_silent_pixels(level: Level, a: Array, b: Array, margin: float, tile: int, odds: Array | float = 7.0) -> Level:
    """Return the level of single tiles with tests of the pixels of silent tiles.

    A silent tile is also `off` if one of its pixels differs beyond the margin, because its mean does not change when
    pixels are moved. `of_silent` is its p-value. `a`, `b`: one render of each side.

    A value that is the same in every render can still be chance: where light is rare, all renders may be black. Let a
    pixel take values with probabilities pₓ, and let each side have two or more renders. The probability that all
    renders have the same value is at most s = Σ pₓ⁴; that the two sides have one value each, and different ones, at
    most d = (Σ pₓ²)² − s. As s + 7d ≤ 1, the probability that a tile of independent pixels has no noise and k different
    pixels is at most 7⁻ᵏ. `odds`: the number in place of 7 where the noise of only one side is known, per channel.
    """
    if not level.silent.any():
        return level
    difference = np.abs(b - a.astype(np.float64))
    allowed = margin * np.maximum(np.abs(a), DARK * median_nonblack(np.abs(a)))
    moved = block_sum(difference > allowed, tile) > 0
    far = block_sum((difference > FAR * allowed).astype(np.float64), tile)
    return replace(level, off=level.off | (level.silent & moved), of_silent=np.where(level.silent, odds**-far, 1.0))


def median_nonblack(sizes: Array) -> Array:
    """Return the median of each channel of … × C values, of those above 0; 0 if there are none."""
    # The mean would not do: with a lamp in the image everything else would be dark.
    channels = sizes.reshape(-1, sizes.shape[-1]).T
    return np.array([np.median(x[x > 0].astype(np.float64)) if (x > 0).any() else 0.0 for x in channels])


# All tests of an image -----------------------------------------------------------------------------------------


class Alarms(NamedTuple):
    """Numbers of tests that differ.

    - `tiles`: tests of the means of tiles.
    - `doubtful`: the same of tiles that are heavy-tailed, or that do not differ by the noise which their pixels show;
      also of tiles that differ only by that noise, where it is far below the stated one; also tests of tiles and of
      their pixels that do not differ by the own noise of the tile between renders.
    - `pixels`: tests of the pixels of a tile.
    - `silent_far`: silent tiles and channels of the finest level with so many pixels so far beyond the margin that they
      are alarms.
    - `silent`: those whose mean or pixels differ beyond the margin at all.
    """

    tiles: int
    doubtful: int
    pixels: int
    silent_far: int
    silent: int


@dataclass(frozen=True)
class TileTests:
    """The tests of all tiles and channels on every level; `family_error`: probability of any false alarm."""

    levels: list[Level]
    family_error: float

    @cached_property
    def p(self) -> Array:
        """The p-values of all tests, flat: of tiles with noise, of their pixels, and of silent tiles."""
        of_tiles = [level.beyond[~level.silent] for level in self.levels]
        of_pixels = [level.of_pixels[~level.silent] for level in self.levels if level.of_pixels is not None]
        of_silent = [level.of_silent[level.silent] for level in self.levels if level.of_silent is not None]
        return np.concatenate([*of_tiles, *of_pixels, *of_silent])

    @cached_property
    def threshold(self) -> float:
        """The p at or below which a test is an alarm: 1 − (1 − family_error)^(1/N) for N tests (Šidák 1967)."""
        return float(-np.expm1(np.log1p(-self.family_error) / max(self.p.size, 1)))

    @cached_property
    def _flags(self) -> list[dict[str, Flags]]:
        """For each level the tests that differ, by the fields of `Alarms`."""
        untested = 1.0
        flags = []
        for level in self.levels:
            doubtful = level.heavy | (level.shown > self.threshold) | (level.own > self.threshold)
            pixels = np.full(level.p.shape, untested) if level.of_pixels is None else level.of_pixels
            own = level.own_pixels > self.threshold
            means = np.where(level.silent, untested, np.where(doubtful, level.beyond, level.hollow))
            p = {
                "tiles": np.where(doubtful | level.silent, untested, level.beyond),
                "doubtful": np.where(own, np.minimum(means, pixels), means),
                "pixels": np.where(own, untested, pixels),
                "silent_far": np.full(level.p.shape, untested) if level.of_silent is None else level.of_silent,
            }
            off = level.off & (level is self.levels[0])
            flags.append({name: x <= self.threshold for name, x in p.items()} | {"silent": off})
        return flags

    @cached_property
    def differing(self) -> Alarms:
        """The numbers of tests that differ."""
        return Alarms(**{name: sum(int(flags[name].sum()) for flags in self._flags) for name in Alarms._fields})

    def worst(self) -> tuple[str, int, int, int, int]:
        """Return the worst of the tests that differ: its field of `Alarms`, its level, row, column and channel.

        It belongs to the first field, in the order of the loop below, with a test that differs. Tiles are ranked by t,
        silent tiles by the difference, and pixels by p on the finest level. ValueError if no test differs.
        """
        for name in ("tiles", "silent_far", "pixels", "doubtful", "silent"):
            candidates = []
            for number, (level, flags) in enumerate(zip(self.levels, self._flags, strict=True)):
                size = level.difference if "silent" in name else level.t if name != "pixels" else level.of_pixels
                if flags[name].any() and size is not None:
                    size = np.nan_to_num(-size if name == "pixels" else np.abs(size), nan=np.inf)
                    at = np.unravel_index(int(np.where(flags[name], size, -np.inf).argmax()), size.shape)
                    candidates.append((0.0 if name == "pixels" else float(size[at]), -number, at))
            if candidates:
                _, minus_number, (row, column, channel) = max(candidates)  # the finest level of equal ones
                return name, -minus_number, int(row), int(column), int(channel)
        raise ValueError("no test differs")

    @property
    def alarms(self) -> int:
        """The number of tests that differ, doubtful and silent ones included."""
        return sum(self.differing) - self.differing.silent_far

    @property
    def smallest_p(self) -> float:
        """The smallest p after Šidák's correction, 1 − (1 − p)^N; 1 where there are no tests."""
        return float(-np.expm1(self.p.size * np.log1p(-min(self.p.min(), 1 - 1e-16)))) if self.p.size else 1.0

    def minimum_detectable(self, level: int = 0) -> float:
        """Return the smallest relative difference detected in the median tile of a level, in the worst channel.

        NaN if no tile has light and noise.
        """
        return max(_known_medians(self.levels[level].detectable(self.threshold)), default=np.nan)

    def hidden_share(self, resolution: float) -> float:
        """Return the share of the lit tiles whose noise hides a difference of `resolution`, of the worst channel."""
        finest = self.levels[0]
        hidden = (finest.detectable(self.threshold) > resolution).sum((0, 1))
        return float((hidden / np.maximum(finest.lit.sum((0, 1)), 1)).max())

    def quieter(self, resolution: float, hidden: float) -> float:
        """Return the factor on the noise's variance at which every channel's median and most tiles show `resolution`.

        `hidden`: the share of a channel's lit tiles in which it may be missed. The factor is at most 1; NaN without
        light or noise; 0 if the difference is not detected even without noise.
        """
        finest = self.levels[0]
        excess = np.maximum(resolution * finest.mean - finest.allowed, 0)
        factor = np.ones_like(excess)
        with np.errstate(invalid="ignore", divide="ignore"):
            for _ in range(FEW_STEPS):  # more samples also increase the degrees of freedom
                reach = replace(finest, freedom=finest.freedom / factor).reach(self.threshold)
                factor = np.sqrt(factor * np.minimum(np.square(excess / reach), 1))
        factors = np.sort(factor.reshape(-1, finest.mean.shape[-1]), 0)  # NaN, of tiles without light, is last
        allowed = np.minimum(hidden * finest.lit.sum((0, 1)), len(factors) - 1).astype(int)
        of_most = np.take_along_axis(factors, allowed[None], 0).ravel()
        medians = _known_medians(factors)
        return float(np.nanmin([1.0, *medians, *of_most])) if medians else np.nan


def _known_medians(values: Array) -> list[float]:
    """Return the median of each channel of … × C values, without NaN; no median of a channel of NaN only."""
    channels = values.reshape(-1, values.shape[-1]).T
    return [float(np.nanmedian(x)) for x in channels if not np.isnan(x).all()]


# Stacks of renders ---------------------------------------------------------------------------------------------


def compare_stacks(reference: Array, test: Array, tile: int, family_error: float, margin: float = 0.0) -> TileTests:
    """Return Welch's tests of single tiles of two stacks of independent renders, each renders × H × W × C.

    Pixels are assumed to be independent, as under a box filter. A tile with a value that is not finite is an alarm.
    `margin`: the equivalence margin, relative to the tile's mean, or to a thousandth of the channel's median if that is
    larger; a margin above 0 ignores differences of tiles without noise in their last bits. ValueError for fewer than 2
    renders a side, and for different shapes.
    """
    same_shape(reference[0], test[0])
    if min(len(reference), len(test)) < 2:
        raise ValueError(f"welch: {len(reference)} and {len(test)} renders; expected at least 2 per side")
    evidence = from_renders(list(reference), list(test), tile)
    return TileTests([compare_tiles(evidence.one, evidence.two, margin)], family_error)


def relative_mse(image: Array, references: Array) -> float:
    """Return mean(((x − r)² − v)/(r² + 0.01)), with r the mean of a stack of independent renders and v its variance.

    `image` H × W × C, `references` renders × H × W × C. ValueError for other shapes.
    """
    r = references.mean(0)
    same_shape(r, image)
    variance = references.var(0, ddof=1) / len(references)
    return float(((np.square(image - r) - variance) / (np.square(r) + 0.01)).mean())


def same_shape(reference: Array, test: Array) -> None:
    """Raise ValueError unless both arrays have the same shape."""
    if reference.shape != test.shape:
        raise ValueError(f"images of different shapes: reference {reference.shape}, test {test.shape}")
