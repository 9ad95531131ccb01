"""Welch's t-test on the tiles of two images with known noise, from single tiles up to the whole image.

Per tile and channel the means m₁, m₂ are compared by t = (m₁ − m₂)/√(v₁ + v₂), with v = s²/n for n samples of variance
s². The variance v of a tile's mean is the sum of its pixels' variances, divided by their number squared. Its degrees of
freedom follow Satterthwaite, f = v²/Σ(vᵢ²/fᵢ) over all pixels of both sides: a tile of 16² pixels knows its noise much
better than the few renders do. (Welch, "The generalization of Student's problem", Biometrika 1947; Satterthwaite 1946;
for renderers Jung, Hanika and Dachsbacher, "Detecting Bias in Monte Carlo Renderers using Welch's t-test", JCGT 2020.)

Where one side has fewer samples than the other, n₂ < n₁, and light is rare, it may have none of that light in a tile,
and a variance near 0. Equal images have the same variance σ² of a sample, so the estimates s₁², s₂² may be exchanged:
the variance of m₁ − m₂ is the larger of s₁²/n₁ + s₂²/n₂ and s₁²/n₂ + s₂²/n₁. The second is the pooled estimate times
(1/n₁ + 1/n₂), and with n₁ = n₂ the first. With that, for light of equal events at a rate λ on the small side:

- too few of them: no events are −√λ standard deviations, and P(t ≤ −x) ≤ exp(−x²/2) as for every mean of values of at
  least 0 (Maurer 2003): no tile with fewer than x² expected events is an alarm at −x;
- too many: k of them are x ≤ (k − λ)/√k by their own variance, and P ≤ exp(−(k ln(k/λ) − k + λ)) ≤ exp(−x²/2)
  (Chernoff; with r = λ/k, −ln r − 1 + r ≥ (1 − r)²/2).
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

DARK = 1e-3  # a tile darker than this share of its channel's `median_nonblack` counts as that bright in ratios
GROWTH = 4  # from one level of tiles to the next
HEAVY = 4.0  # a tile whose noise comes from fewer pixels than this is heavy-tailed: its t is not a Student's
SINGLE = 0.3  # of a tile's standard error: a pixel that moves its mean by more may be of light that is rare
POOLED = 30  # blocks of tiles from which the correlation of pixels is estimated again, at least
FEW_STEPS = 8  # of a fixed point, each of which halves its error at least
MISSED = 0.01  # the minimum detectable difference is missed with this probability
HOLLOW = 0.01  # of the variance that is claimed: pixels that scatter by less show none of that noise
FAR = 10.0  # times the margin: a pixel without noise that is so far off is evidence, see `with_silent_pixels`
UNSEEN = 1e-3  # of the margin: a tile with less noise than this decides nothing, see `Side.inflation`
WORKERS = 2

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Side:
    """One side of a comparison: totals per tile and channel, tiles × tiles × C, over the pixels of a tile.

    `mean`: of the pixels; `variance`, `squares`: of the variances of these means, and of their squares. `freedom`:
    degrees of freedom of a pixel's variance. `count`: samples of a pixel, in the unit of the other side; of all
    channels or of each. `renders`: totals of each render; without them pixels are taken for independent, or to vary
    together by `correlated`.
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
        """The same side in tiles GROWTH times as wide."""
        area, mean, variance, squares = (
            block_sum(x, GROWTH) for x in (self.area, self.mean, self.variance, self.squares)
        )
        renders = None if self.renders is None else block_sum(self.renders, GROWTH)
        return replace(self, area=area, mean=mean, variance=variance, squares=squares, renders=renders)

    def spread(self, inflation: Inflation) -> tuple[Array, Array]:
        """The variance v of the tile means, and v²/f for its degrees of freedom f (Satterthwaite 1946)."""
        variance = self.variance * inflation.factor / self.area**2
        freedom = self.freedom / inflation.factor  # correlated pixels are fewer
        squares = self.squares * inflation.factor**2 / self.area**4 / freedom
        return variance, squares + variance**2 / inflation.freedom

    def inflation(self, margin: float = 0.0) -> Inflation:
        """How much more the tile means vary between renders than independent pixels would; `correlated` without them.

        `margin`: the equivalence margin. Where noise is below UNSEEN of it, as that of a plain sky, it may be the
        rounding of a sum, the same in all pixels of a render. Such a tile differs beyond the margin by 1000 σ of
        independent pixels or not at all, and says nothing of how the pixels of other tiles correlate.
        """
        noisy = self.variance > np.square(UNSEEN * margin * self.mean)
        if self.renders is None or not noisy.any():
            return self.correlated
        between = self.renders.var(0, ddof=1)[noisy] / len(self.renders)
        # The channels of a tile may share their noise: tiles count, not tiles and channels.
        freedom = self.freedom * int(noisy.any(-1).sum())
        return Inflation(max(1.0, float((between / self.variance[noisy]).mean())), freedom)


def from_variances(mean: Array, variance: Array, freedom: float, tile: int, count: Array | float = 1.0) -> Side:
    """One side from an image and the variance of its pixels, both H × W × C; `freedom`: of that variance.

    `count`: samples per pixel.
    """
    area = block_area(mean.shape[0], mean.shape[1], tile)
    squares = np.square(variance, dtype=np.float64)
    return Side(area, block_sum(mean, tile), block_sum(variance, tile), block_sum(squares, tile), freedom, count)


@dataclass(frozen=True)
class OneSided:
    """What the pixels show where the noise of one side alone is known.

    `brighter`: d of `pixel_statistics` at every pixel, H × W × C; 0 in channels whose noise both sides know.
    `exponent`: g of that module. `well_known`: the channels whose noise is known from so many samples that it holds the
    rare light of the other side. `correlated`: how much more tile means vary than those of independent pixels.
    """

    brighter: Array
    exponent: Array
    well_known: Flags
    correlated: Inflation

    def p(self, level: Level, area: Array, tile: int) -> Array:
        """The p of no difference beyond the margin; 0 where the other side is not brighter.

        Where the noise is well known, a pixel may move the mean of a tile by SINGLE of its standard error at most: what
        bright pixels add beyond that may be rare light. If an event moves the mean by more than that, equal images have
        λ < 1/SINGLE² = 11 of them in a tile. So clipped, k of them are SINGLE k − √λ < (k − λ)/√λ σ.
        Elsewhere the pixels alone say how large the noise is.
        """
        from scipy import special

        height, width = self.brighter.shape[:2]
        most = (SINGLE * level.error * area).repeat(tile, 0)[:height].repeat(tile, 1)[:, :width]
        clipped = block_sum(np.minimum(self.brighter, most), tile)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (clipped / area - level.allowed) / level.error
        total, squares = (block_sum(x, tile)[None] for x in (self.brighter, np.square(self.brighter)))
        by_pixels = PixelSums(total, squares, self.exponent).p(area, level.allowed, self.correlated)
        p = np.where(self.well_known, special.stdtr(level.freedom, -t), by_pixels)
        return np.where(total[0] > 0, np.nan_to_num(2 * p, nan=0.0), 0.0)


@dataclass(frozen=True)
class Evidence:
    """Both sides in tiles of side `tile`; `pixels`: the sums over their pixels, None where these are not tested.

    `one_sided`: where the noise of one side alone is known. `odds`: of `with_silent_pixels`.
    """

    tile: int
    one: Side
    two: Side
    pixels: PixelSums | None = None
    one_sided: OneSided | None = None
    odds: Array | float = 7.0

    def levels(self, margin: float) -> Iterator[Level]:
        """The tests of single tiles, then of blocks GROWTH times as wide, and so on to the whole image.

        `margin`: the equivalence margin. The correlation of pixels is estimated from all tiles, and again from blocks
        where there are many: those show it over larger distances.
        """
        tile, one, two, pixels = self.tile, self.one, self.two, self.pixels
        inflations = one.inflation(margin), two.inflation(margin)
        while True:
            level = compare_tiles(one, two, margin, inflations)
            if pixels:
                p = pixels.p(one.area, np.square(level.allowed), max(inflations))
                hollow = self._by_scatter(level, one, two, pixels, max(inflations).factor)
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
    def _by_scatter(level: Level, one: Side, two: Side, pixels: PixelSums, factor: float) -> Array:
        """p of no difference of a tile beyond the margin, by the scatter of the differences d of its pixels.

        1 where Σd² is at least HOLLOW times the sum of the variances: the pixels show the noise that is claimed.
        """
        from scipy import special

        claimed, area = one.variance + two.variance, one.area
        squares = pixels.total[0] + claimed
        total = two.mean - one.mean
        with np.errstate(divide="ignore", invalid="ignore"):
            scatter = np.maximum(squares - total**2 / area, 0) / (area - 1)
            t = (np.abs(total) / area - level.allowed) / np.sqrt(factor * scatter / area)
            p = 2 * special.stdtr(area - 1, -np.maximum(t, 0))
        return np.where((squares < HOLLOW * claimed) & (area > 1), np.nan_to_num(p, nan=1.0), 1.0)


def from_renders(
    reference: Sequence[Array], test: Sequence[Array], tile: int, counts: tuple[float, float] | None = None
) -> Evidence:
    """Two sets of independent renders, each H × W × C, at least 2 a side; needs memory for rows of tiles only.

    `counts`: samples per pixel of all renders of each side; None: as many as there are renders.
    """
    sides = reference, test
    counts = counts or (len(reference), len(test))

    def band(top: int) -> tuple[list[tuple[Array, Array, Array]], PixelSums]:
        """Totals of a row of tiles: of the renders, their mean's variances and the squares; and the sums of u."""
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

    `reference`: its means; `difference`: how much larger those of the test are; `t`: of that. `p`: of no difference;
    `beyond`: of none beyond the margin; both 0 where a value is not finite. `silent`: no noise on either side, of which
    a t-test knows nothing: p is 1 there, and `off` where the means differ beyond the margin. `heavy`: noise from a few
    pixels only. `shown`: p of none beyond the margin by the noise that the pixels show; 0 where that is not tested.
    `hollow`: the same of noise that the pixels do not show; 1 where they do. `of_pixels`: p of no pixel beyond the
    margin; `of_silent`: the same of tiles without noise; None where that is not tested.
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
    of_pixels: Array | None = None
    of_silent: Array | None = None

    @property
    def lit(self) -> Flags:
        """The tiles and channels with light; for darker ones relative differences mean nothing."""
        return self.mean > DARK * median_nonblack(self.mean)

    def detectable(self, threshold: float) -> Array:
        """Relative differences that are seen with probability 1 − MISSED at that p; NaN without light or noise.

        A difference δ is seen where δ ≥ margin + (t(1 − p/2) + t(1 − MISSED)) · error.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            return (self.reach(threshold) + self.allowed) / self.mean

    def reach(self, threshold: float) -> Array:
        """How much the differences that are seen exceed the margin; NaN without light or noise."""
        from scipy import special

        noisy = ~self.silent & self.lit
        freedom = self.freedom[noisy]
        quantiles = np.full(self.mean.shape, np.nan)
        quantiles[noisy] = -special.stdtrit(freedom, threshold / 2) - special.stdtrit(freedom, MISSED)
        return quantiles * self.error


def compare_tiles(
    one: Side, two: Side, margin: float, inflations: tuple[Inflation, Inflation] = (Inflation(), Inflation())
) -> Level:
    """Welch's t-test of every tile; differences up to `margin` × the tile's mean count as none.

    That mean is the larger one of both sides: light that one of them has must be seen.
    """
    from scipy import special

    def noise(ratio: Array | float) -> tuple[Array, Array, Flags]:
        """The variance v of m₁ − m₂, v²/f, and whether v comes from few pixels.

        `ratio`: 1 for s₁²/n₁ + s₂²/n₂, n₁/n₂ for s₁²/n₂ + s₂²/n₁.
        """
        (v1, d1), (v2, d2) = one.spread(inflations[0]), two.spread(inflations[1])
        pixels = HEAVY * max(inflations).factor  # that share samples
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
    # NaN becomes 0: what is not finite equals nothing.
    p, p_beyond = (np.nan_to_num(2 * special.stdtr(freedom, -np.abs(x)), nan=0.0) for x in (t, beyond))
    return Level(t, p, p_beyond, silent, off, few & ~silent, mean, allowed, error, freedom, m1, difference)


def with_silent_pixels(level: Level, a: Array, b: Array, margin: float, tile: int, odds: Array | float = 7.0) -> Level:
    """The level of single tiles with those without noise `off` where a pixel is, too, and with their p.

    The mean of such a tile does not show what was moved about inside. `a`, `b`: one render of each side.

    A value that comes up in every render can still be chance, as black is where light is rarely found. Let a pixel take
    values with probabilities pₓ. All renders of each side, two or more, agree with probability s = Σ pₓ⁴ at most in
    the same value, and with d = (Σ pₓ²)² − s in two different ones. As s + 7d ≤ 1, no tile of independent pixels is
    without noise and has k different pixels with a probability above 7⁻ᵏ. `odds`, per channel: what stands for 7 where
    the noise of one side is all that is known.
    """
    if not level.silent.any():
        return level
    difference = np.abs(b - a.astype(np.float64))
    allowed = margin * np.maximum(np.abs(a), DARK * median_nonblack(np.abs(a)))
    moved = block_sum(difference > allowed, tile) > 0
    far = block_sum((difference > FAR * allowed).astype(np.float64), tile)
    return replace(level, off=level.off | (level.silent & moved), of_silent=np.where(level.silent, odds**-far, 1.0))


def median_nonblack(sizes: Array) -> Array:
    """The median of each channel of … × C values without those that are 0 or less; 0 where none is left."""
    # Not the mean: next to a lamp everything else would be dark.
    channels = sizes.reshape(-1, sizes.shape[-1]).T
    return np.array([np.median(x[x > 0].astype(np.float64)) if (x > 0).any() else 0.0 for x in channels])


# All tests of an image -----------------------------------------------------------------------------------------


def sidak(family_error: float, count: int) -> float:
    """The p at which one of `count` independent tests is an alarm (Šidák 1967): 1 − (1 − family_error)^(1/count)."""
    return float(-np.expm1(np.log1p(-family_error) / max(count, 1)))


class Alarms(NamedTuple):
    """Numbers of tests that differ.

    `tiles`: of the means of tiles; `doubtful`: of those that are heavy-tailed, or whose noise the pixels do not show;
    also where they show less of it, and so a difference.
    `pixels`: of the pixels of a tile. `silent`: single tiles and channels without noise whose means or pixels differ
    beyond the margin; `silent_far`: so far beyond it, in so many pixels, that they are alarms.
    """

    tiles: int
    doubtful: int
    pixels: int
    silent_far: int
    silent: int


@dataclass(frozen=True)
class TileTests:
    """The tests of all tiles and channels with noise, on every level, at one probability of any false alarm."""

    levels: list[Level]
    family_error: float

    @cached_property
    def p(self) -> Array:
        """The p of every test, in one dimension: of tiles with noise, of their pixels, and of tiles without noise."""
        of_tiles = [level.beyond[~level.silent] for level in self.levels]
        of_pixels = [level.of_pixels[~level.silent] for level in self.levels if level.of_pixels is not None]
        of_silent = [level.of_silent[level.silent] for level in self.levels if level.of_silent is not None]
        return np.concatenate([*of_tiles, *of_pixels, *of_silent])

    @cached_property
    def threshold(self) -> float:
        """The p at or below which a test is an alarm."""
        return sidak(self.family_error, self.p.size)

    @cached_property
    def _flags(self) -> list[dict[str, Flags]]:
        """The tests of each level that differ, by the fields of `Alarms`."""
        none = 1.0  # the p of what is not tested
        flags = []
        for level in self.levels:
            in_doubt = level.heavy | (level.shown > self.threshold)
            p = {
                "tiles": np.where(in_doubt | level.silent, none, level.beyond),
                "doubtful": np.where(level.silent, none, np.where(in_doubt, level.beyond, level.hollow)),
                "pixels": np.full(level.p.shape, none) if level.of_pixels is None else level.of_pixels,
                "silent_far": np.full(level.p.shape, none) if level.of_silent is None else level.of_silent,
            }
            off = level.off & (level is self.levels[0])
            flags.append({name: x <= self.threshold for name, x in p.items()} | {"silent": off})
        return flags

    @cached_property
    def differing(self) -> Alarms:
        """The tests that differ."""
        return Alarms(**{name: sum(int(flags[name].sum()) for flags in self._flags) for name in Alarms._fields})

    def worst(self) -> tuple[str, int, int, int, int]:
        """The largest of the tests that differ: its field of `Alarms`, its level, row, column and channel.

        Of tiles by standard errors, of their pixels by p on the finest level, of tiles without noise by the difference;
        a field counts where none before it differs. ValueError where no test does.
        """
        for name in ("tiles", "silent_far", "pixels", "doubtful", "silent"):
            best = []
            for number, (level, flags) in enumerate(zip(self.levels, self._flags, strict=True)):
                size = level.difference if "silent" in name else level.t if name != "pixels" else level.of_pixels
                if flags[name].any() and size is not None:
                    size = np.nan_to_num(-size if name == "pixels" else np.abs(size), nan=np.inf)
                    at = np.unravel_index(int(np.where(flags[name], size, -np.inf).argmax()), size.shape)
                    best.append((0.0 if name == "pixels" else float(size[at]), -number, at))
            if best:
                _, finer, (row, column, channel) = max(best)
                return name, -finer, int(row), int(column), int(channel)
        raise ValueError("no test differs")

    @property
    def alarms(self) -> int:
        """The number of tests that differ, whatever is known of their noise."""
        return sum(self.differing) - self.differing.silent_far

    @property
    def smallest_p(self) -> float:
        """The smallest p after Šidák's correction, 1 − (1 − p)^N; 1 where there are no tests."""
        return float(-np.expm1(self.p.size * np.log1p(-min(self.p.min(), 1 - 1e-16)))) if self.p.size else 1.0

    def minimum_detectable(self, level: int = 0) -> float:
        """The smallest relative difference that is seen in the median tile of a level; NaN where none has noise."""
        detectable = self.levels[level].detectable(self.threshold)
        return float(np.nanmedian(detectable)) if np.isfinite(detectable).any() else np.nan

    def hidden_share(self, resolution: float) -> float:
        """The share of the tiles with light whose noise hides a difference of `resolution`, in the worst channel."""
        finest = self.levels[0]
        hidden = (finest.detectable(self.threshold) > resolution).sum((0, 1)).max()
        return float(hidden / max(finest.lit.any(-1).sum(), 1))

    def quieter(self, resolution: float, hidden: float) -> float:
        """The factor by which the noise's variance must fall for `resolution` to be seen in all but `hidden` tiles.

        And in the median tile; at most 1, NaN without light or noise, 0 where no noise is low enough.
        """
        finest = self.levels[0]
        room = np.maximum(resolution * finest.mean - finest.allowed, 0)
        factor = np.ones_like(room)
        with np.errstate(invalid="ignore", divide="ignore"):
            for _ in range(FEW_STEPS):  # more samples are more degrees of freedom, too
                reach = replace(finest, freedom=finest.freedom / factor).reach(self.threshold)
                factor = np.sqrt(factor * np.minimum(np.square(room / reach), 1))
        enough = np.sort(factor.reshape(-1, finest.mean.shape[-1]), 0)
        allowed = int(hidden * max(finest.lit.any(-1).sum(), 1))  # NaN, of other tiles, is sorted last
        if not np.isfinite(enough).any():
            return np.nan
        return float(np.nanmin([1.0, np.nanmedian(enough), *enough[min(allowed, len(enough) - 1)]]))


# Stacks of renders ---------------------------------------------------------------------------------------------


def compare_stacks(reference: Array, test: Array, tile: int, family_error: float, margin: float = 0.0) -> TileTests:
    """Welch's test of single tiles of two stacks of independent renders, each renders × H × W × C.

    Pixels are taken for independent, as under a box filter. A tile with a value that is not finite is an alarm.
    `margin`: the equivalence margin, relative to the tile's mean, or to a thousandth of the channel's; above 0 it keeps
    tiles without noise from differing by their last bits. ValueError for fewer than 2 renders a side, another shape.
    """
    same_shape(reference[0], test[0])
    if min(len(reference), len(test)) < 2:
        raise ValueError(f"welch: {len(reference)} and {len(test)} renders; expected at least 2 per side")
    evidence = from_renders(list(reference), list(test), tile)
    return TileTests([compare_tiles(evidence.one, evidence.two, margin)], family_error)


def relative_mse(image: Array, references: Array) -> float:
    """mean((x − r)²/(r² + 0.01)) against the mean r of a stack of independent renders, less what r's own noise adds.

    `image` H × W × C, `references` renders × H × W × C. ValueError for other shapes.
    """
    r = references.mean(0)
    same_shape(r, image)
    own = references.var(0, ddof=1) / len(references)
    return float(((np.square(image - r) - own) / (np.square(r) + 0.01)).mean())


def same_shape(reference: Array, test: Array) -> None:
    """ValueError unless both arrays have one shape."""
    if reference.shape != test.shape:
        raise ValueError(f"images of different shapes: reference {reference.shape}, test {test.shape}")
