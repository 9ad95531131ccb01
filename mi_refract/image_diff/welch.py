"""Welch's t-test between two sets of independent renders in files: equal, different, or not to be told."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np

from mi_refract.io.image_file import Image

from . import tile_statistics
from .comparison import Comparison, Maps, Metric, Verdict, aligned, nonfinite_result, preconditions

CORRECTIONS = ("sidak", "holm")
# A second image beside the mean: of the squares of the samples (Mitsuba's `moment`), or of their variance.
MOMENTS = ("m2_{}", "{}.m2")
VARIANCES = ("{}.variance", "{}.Variance", "variance.{}", "Variance.{}", "variance_{}")


@dataclass(frozen=True)
class _Asked:
    """What the levels of tiles say at one family error; `p` of all tiles with noise."""

    levels: list[tile_statistics.Level]
    p: np.ndarray
    family_error: float
    correction: str

    @cached_property
    def threshold(self) -> float:
        if self.correction == "holm":
            return tile_statistics.holm(self.p, self.family_error)
        return tile_statistics.sidak(self.family_error, self.p.size)

    def lit(self, level: tile_statistics.Level) -> np.ndarray:
        return (level.beyond <= self.threshold) & ~level.silent

    @property
    def alarms(self) -> int:
        return sum(int((self.lit(level) & ~level.heavy).sum()) for level in self.levels)

    @property
    def doubtful(self) -> int:
        return sum(int((self.lit(level) & level.heavy).sum()) for level in self.levels)

    def detectable(self, level: int) -> float:
        found = self.levels[level].detectable(self.threshold)
        return float(np.median(found)) if found.size else np.nan


def welch_images(
    reference: Sequence[Image],
    test: Sequence[Image],
    *,
    allow_nonfinite: bool = False,
    tile: Annotated[int, "side of a tile in pixels"] = 16,
    family_error: Annotated[float, "probability that equal images are called different"] = 0.001,
    correction: Annotated[str, "for the number of tiles: sidak or holm"] = "sidak",
    margin: Annotated[float, "relative difference of a tile that is as good as none"] = 0.001,
    resolution: Annotated[float, "relative difference that must be visible in a tile, or it is inconclusive"] = 0.05,
    spp: Annotated[int, "samples per pixel of images with variance channels; 0: as their headers say"] = 0,
) -> Comparison:
    """Independent renders: Welch's t-test on the means of tiles and channels.

    Two or more renders a side, or one a side with the variance or second moment of its channels: then pixels are taken
    for independent, as under a box filter. Tests single tiles, blocks of them, and the whole image together.

    Without noise a tile proves nothing, and with the noise of a few pixels its t is not a Student's: where only such
    tiles differ, the verdict is "inconclusive", and so it is where the noise hides differences of `resolution`.
    ValueError for fewer renders, the same render twice, options out of range, images that cannot be compared.
    """
    _check(tile, family_error, correction, margin, resolution)
    for image in (*reference[1:], *test):
        if reason := preconditions(reference[0], image, allow_nonfinite):
            return nonfinite_result("welch", reason, reference[0].pixels, aligned(reference[0], image)[1])
    tile = min(tile, max(reference[0].pixels.shape[:2]))
    one, two, channels = _sides(reference, test, tile, spp)
    levels = list(tile_statistics.levels(one, two, margin))
    levels[0] = _with_silent_pixels(levels[0], reference[0].select(channels), test[0].select(channels), margin, tile)
    asked = _Asked(levels, np.concatenate([level.beyond[~level.silent] for level in levels]), family_error, correction)
    verdict, reason = _verdict(asked, resolution)
    if untested := [name for name in reference[0].channels if name not in channels]:
        reason += f"; not tested: {', '.join(untested)}"
    maps = _maps(levels[0], tile, reference[0].pixels.shape)
    figures = _figures(asked, family_error, resolution)
    return Comparison("welch", verdict, reason, figures, asked.detectable(0), maps)


def _check(tile: int, family_error: float, correction: str, margin: float, resolution: float) -> None:
    if tile < 1:
        raise ValueError(f"tile = {tile}: accepted: a positive whole number")
    if not 0 < family_error < 1:
        raise ValueError(f"family_error = {family_error}: accepted: more than 0, less than 1")
    if correction not in CORRECTIONS:
        raise ValueError(f"correction = {correction!r}: accepted: {', '.join(CORRECTIONS)}")
    if not (margin >= 0 and resolution > 0):
        raise ValueError(f"margin = {margin}, resolution = {resolution}: accepted: at least 0, more than 0")


def _sides(
    reference: Sequence[Image], test: Sequence[Image], tile: int, spp: int
) -> tuple[tile_statistics.Side, tile_statistics.Side, Sequence[str]]:
    """Both sides and the channels that are tested."""
    if min(len(reference), len(test)) >= 2:
        first = reference[0]
        for side in (reference, test):
            _distinct(side)
        one, two = ([_finite(aligned(first, image)[1]) for image in side] for side in (reference, test))
        return tile_statistics.from_renders(one, tile), tile_statistics.from_renders(two, tile), first.channels
    if len(reference) == len(test) == 1 and (pairs := spreads(reference[0].channels)):
        return _moments(reference[0], pairs, tile, spp), _moments(test[0], pairs, tile, spp), list(pairs)
    raise ValueError(
        f"welch: {len(reference)} and {len(test)} renders; accepted: at least 2 a side, or one a side with channels "
        f"of its variance, as {', '.join(form.format('R') for form in (*MOMENTS[:1], *VARIANCES[:1]))}"
    )


def _with_silent_pixels(
    level: tile_statistics.Level, a: np.ndarray, b: np.ndarray, margin: float, tile: int
) -> tile_statistics.Level:
    """Without noise a tile is off where a pixel is, too: its mean knows nothing of what was moved about inside."""
    if not level.silent.any():
        return level
    a, b = _finite(a).astype(np.float64), _finite(b)
    allowed = margin * np.maximum(np.abs(a), tile_statistics.DARK * tile_statistics.median_nonblack(np.abs(a)))
    return replace(
        level, off=level.off | (level.silent & (tile_statistics.block_sum(np.abs(b - a) > allowed, tile) > 0))
    )


def _distinct(side: Sequence[Image]) -> None:
    """The same seed twice would halve the noise that is seen. Images without noise may be the same."""
    if all(_identical(side[0], image) for image in side):
        return
    for a, b in itertools.combinations(side, 2):
        if _identical(a, b):
            raise ValueError(f"{b.path}: the same image as {a.path}; accepted: independent renders, of other seeds")


def _identical(a: Image, b: Image) -> bool:
    few = np.s_[::37]  # rows: enough to tell noisy images apart, and quicker than all
    return np.array_equal(a.pixels[few], b.pixels[few]) and np.array_equal(a.pixels, b.pixels)


def _finite(pixels: np.ndarray) -> np.ndarray:
    return pixels if np.isfinite(pixels).all() else np.where(np.isfinite(pixels), pixels, 0)


def spreads(channels: Sequence[str]) -> dict[str, tuple[str, bool]]:
    """For every channel that has one: the channel of its variance, or second moment (True)."""
    return {
        name: (form.format(name), form in MOMENTS)
        for name in channels
        for form in (*MOMENTS, *VARIANCES)
        if form.format(name) in channels
    }


def _moments(image: Image, pairs: dict[str, tuple[str, bool]], tile: int, spp: int) -> tile_statistics.Side:
    spp = spp or int(image.metadata.get("mi_refract:spp", 0))
    if spp < 2:
        raise ValueError(f"{image.path}: its header names no samples per pixel; accepted: `spp` of at least 2")
    mean = _finite(image.select(list(pairs))).astype(np.float64)
    spread = _finite(image.select([name for name, _ in pairs.values()])).astype(np.float64)
    is_moment = np.array([moment for _, moment in pairs.values()])
    variance = np.where(is_moment, (spread - mean**2) * spp / (spp - 1), spread) / spp
    return tile_statistics.from_variances(mean, np.maximum(variance, 0), spp - 1.0, tile)


def _verdict(asked: _Asked, resolution: float) -> tuple[Verdict, str]:
    off, visible = int(asked.levels[0].off.sum()), asked.detectable(0)
    if asked.alarms:
        return Verdict.DIFFERENT, f"{asked.alarms} of {asked.p.size} tests of tiles and channels differ"
    if off or asked.doubtful:
        where = f"{off} tiles noise-free, {asked.doubtful} heavy-tailed"
        return Verdict.INCONCLUSIVE, f"differences only where a t-test knows little: {where}"
    if not asked.p.size:
        return Verdict.EQUAL, "no noise, and no tile differs beyond the margin"
    if not visible <= resolution:
        return Verdict.INCONCLUSIVE, f"no difference is seen, but noise hides one of {visible:.2g} in the median tile"
    return Verdict.EQUAL, f"no difference; one of {visible:.2g} would have been seen in a tile of median noise"


def _figures(asked: _Asked, family_error: float, resolution: float) -> tuple[Metric, ...]:
    finest, p = asked.levels[0], asked.p
    return (
        Metric("tests of tiles and channels that differ", asked.alarms, 0.0),
        Metric("smallest p, adjusted for the number of tests", tile_statistics.adjusted(p)),
        Metric("family error", family_error),
        Metric("tiles and channels", finest.t.size),
        Metric("tiles without noise", int(finest.silent.sum())),
        Metric("tiles without noise that differ", int(finest.off.sum()), 0.0),
        Metric("heavy-tailed tiles", int(finest.heavy.sum())),
        Metric("heavy-tailed tiles and blocks that differ", asked.doubtful, 0.0),
        Metric("detectable relative difference in a tile", asked.detectable(0), resolution),
        Metric("detectable relative difference of the whole image", asked.detectable(-1)),
    )


def _maps(level: tile_statistics.Level, tile: int, shape: tuple[int, ...]) -> Maps:
    """In every tile. `t`: signed, by channels. `p`: of no difference at all, by channels; uniform for equal images.

    `q`: p adjusted after Benjamini and Hochberg, the smallest of the channels. `flags`: 1 heavy-tailed, 2 no noise.
    """
    q = np.ones(level.p.shape)
    q[~level.silent] = tile_statistics.benjamini_hochberg(level.p[~level.silent])
    found = {"t": level.t, "p": level.p, "q": q.min(-1), "flags": (2 * level.silent + level.heavy).max(-1)}

    def spread(x: np.ndarray) -> np.ndarray:
        return x.astype(np.float32).repeat(tile, 0)[: shape[0]].repeat(tile, 1)[:, : shape[1]]

    return {name: spread(x) for name, x in found.items()}
