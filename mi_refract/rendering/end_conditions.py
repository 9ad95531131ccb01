"""The end of a render: its number of samples, its time, a scene without noise, or its error, estimated from its passes.

The error is the RMSE over all pixels, relative to the image's mean.

    relative error = √(s²/n) / |mean|,    s²: variance of one sample, averaged over pixels and colours; n: spp

s² is the mean of m independent contrasts between passes (`PassSums.contrasts`). The squared error of this image times n
has the same distribution as a contrast. So with 95 % probability it lies within  s² ± t s_c √(1 + 1/m),  where s_c is
the standard deviation of the contrasts, if passes are normally distributed. No estimate contains light that no sample
has found yet.

A single pass has no contrast. Then s² is the variance of its samples, as if they were independent. If the sampler
stratifies them, their mean varies less: Var(x̄) ≤ s²/n for strata of equal probability (Cochran, Sampling Techniques,
1977, 5.6). So the estimate is an upper bound.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mi_refract.io.image_file import block_sum

from .pass_plan import FEW
from .pass_sums import Doubles, PassSums

NO_NOISE = "no noise: the samples of every pixel agree"
LEVEL = 0.95
TILE = 16  # pixels
ENOUGH_FOR_NO_NOISE = 64  # samples per pixel
SAME = 5e-13  # of a pixel's mean: standard deviation of samples that differ only by the rounding of their sums
LEFT_OUT = 0.01  # share of the tiles that may be worse
DARK = 0.01  # of the image's mean: a darker tile counts as this bright


@dataclass(frozen=True)
class RelativeError:
    """The estimated error, and the interval of this image's error with probability LEVEL; NaN for what is unknown.

    `at_most`: the estimate assumes independent samples, which is an upper bound for stratified ones.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    at_most: bool = False


def relative_error(sums: PassSums) -> RelativeError:
    """Return the error of an image over all finite pixels."""
    colours = sums.mean[..., : sums.colours]
    finite = np.isfinite(colours)
    mean = abs(float(colours[finite].mean())) if finite.any() else math.nan
    contrasts = np.asarray([contrast for contrast in sums.contrasts if math.isfinite(contrast)])
    if not mean > 0 or not sums.freedom:
        return RelativeError(math.nan)
    squared, spread = float(contrasts.mean()) if contrasts.size else math.nan, math.nan
    variance = None if contrasts.size else sums.variance
    if variance is not None:
        of_colours = variance[..., : sums.colours]
        squared = float(of_colours[np.isfinite(of_colours)].mean())
    if contrasts.size > 1:
        with contextlib.suppress(ImportError):  # without SciPy, which is an extra, there is no interval
            from scipy.stats import t  # this import takes a second

            quantile = float(t.ppf((1 + LEVEL) / 2, contrasts.size - 1))
            spread = quantile * float(contrasts.std(ddof=1)) * math.sqrt(1 + 1 / contrasts.size)
    value, low, high = (math.sqrt(max(x, 0) / sums.spp) / mean for x in (squared, squared - spread, squared + spread))
    return RelativeError(value, low, high, at_most=variance is not None)


def without_noise(sums: PassSums, channels: Sequence[str]) -> bool:
    """Return whether all samples of each pixel are equal, and no pixel is black: light there may be rarely found.

    `channels`: their names. Opacity and AOVs that are no colours may be 0.

    The rounding of sums of equal samples in float64 causes less than SAME. If one of n ≤ 2³² samples differs by one
    rounding in float32, it causes 6e-8/√n ≥ 9e-13.
    """
    variance = sums.variance if sums.spp >= ENOUGH_FOR_NO_NOISE else None
    if variance is None:
        return False
    mean = sums.mean
    equal = np.isfinite(mean) & (variance <= np.square(SAME * mean))
    colour = [i < sums.colours or name.rpartition(".")[2] in tuple("RGB") for i, name in enumerate(channels)]
    return bool(equal.all() and (mean[..., colour] != 0).all())


def require_interval() -> None:
    """Raise ImportError, in one line, if the interval of an error cannot be computed."""
    if importlib.util.find_spec("scipy") is None:
        raise ImportError("--until needs SciPy; expected pip install 'mi-refract[diff]', or --until-tile")


def worst_tile(sums: PassSums) -> float:
    """Return the relative error of tiles of TILE² pixels that a share LEFT_OUT of them exceeds; NaN if unknown.

    Black tiles, without any variance, are left out: they say nothing about the others.
    """
    if (variance := sums.variance) is None:
        return math.nan
    squared = _tile_means(variance[..., : sums.colours] / sums.spp)
    means = np.abs(_tile_means(sums.mean[..., : sums.colours]))
    image_mean = float(np.nanmean(means)) if np.isfinite(means).any() else 0.0
    if not image_mean > 0:
        return math.nan
    errors = np.sqrt(squared) / np.maximum(means, DARK * image_mean)
    return float(np.nanquantile(errors[(means > 0) | (squared > 0)], 1 - LEFT_OUT, method="higher"))


def _tile_means(values: Doubles) -> Doubles:
    """Return the means of all finite values over tiles and channels; NaN for a tile without finite values."""
    finite = np.isfinite(values)
    sums = block_sum(np.where(finite, values, 0).sum(-1, keepdims=True), TILE)[..., 0]
    counts = block_sum(finite.sum(-1, keepdims=True), TILE)[..., 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(sums / counts, np.float64)


@dataclass(frozen=True)
class Limits:
    """Limits of a render, which ends at the first that it reaches. ValueError for a number out of range.

    `until`, `until_tile`: relative errors, of the image and of its worst tiles; `seconds`: of this run. `spp`: samples
    per pixel; None: the scene's, if there is no other limit. `pass_spp`: samples per pixel of a pass, not a limit.
    """

    spp: int | None = None
    until: float | None = None
    until_tile: float | None = None
    seconds: float | None = None
    pass_spp: int | None = None

    def __post_init__(self) -> None:  # noqa: D105
        for name in ("spp", "pass_spp"):
            if (value := getattr(self, name)) is not None and not 1 <= value < 2**32:
                raise ValueError(f"{name} = {value}; expected a whole number from 1 to 2³² − 1")
        for name in ("until", "until_tile"):
            if (value := getattr(self, name)) is not None and not 0 < value <= 1:
                raise ValueError(f"{name} = {value:g}; expected more than 0 %, up to 100 %")
        if self.seconds is not None and not 0 < self.seconds < float("inf"):
            raise ValueError(f"time = {self.seconds:g} s; expected more than 0")

    @property
    def open_ended(self) -> bool:
        """Whether an error or a time may end the render."""
        return self.by_error or self.seconds is not None

    @property
    def by_error(self) -> bool:
        """Whether an error may end the render."""
        return self.until is not None or self.until_tile is not None


def reached(limits: Limits, sums: PassSums, channels: Sequence[str]) -> str:
    """Return why an image is good enough: no noise, or an error below its limit; "" if it is not."""
    if without_noise(sums, channels):
        return NO_NOISE
    if sums.passes < FEW:  # their spread is a poor estimate
        return ""
    if limits.until and (error := relative_error(sums)).high <= limits.until:
        until, value, high = (f"{100 * share:.3g} %" for share in (limits.until, error.value, error.high))
        return f"--until {until}: the error is {value}, at most {high}"
    if limits.until_tile and (worst := worst_tile(sums)) <= limits.until_tile:
        until, value = (f"{100 * share:.3g} %" for share in (limits.until_tile, worst))
        return f"--until-tile {until}: the error of the worst tile is {value}"
    return ""


def needed_spp(limits: Limits, sums: PassSums) -> float:
    """Return the estimated samples per pixel with which an image reaches an error limit."""
    ratios = [relative_error(sums).value / limits.until] if limits.until else []
    ratios += [worst_tile(sums) / limits.until_tile] if limits.until_tile else []
    return sums.spp * min((ratio for ratio in ratios if math.isfinite(ratio)), default=math.inf) ** 2
