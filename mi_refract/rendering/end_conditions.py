"""What ends a render: its number of samples, its time, a scene without noise, or its error as its own passes tell it.

The error is the RMSE over all pixels, relative to the image's mean.

    relative error = √(s²/n) / |mean|,    s²: variance of one sample, averaged over pixels and colours; n: spp

s² is the mean of m independent contrasts between passes (`PassSums.contrasts`), and the squared error of this image is
one more quantity of their distribution. So with 95 % probability it lies within  s² ± t s_c √(1 + 1/m),  s_c their
standard deviation, as far as passes are normally distributed: what no sample has met yet is in no estimate.

A single pass has no contrast: there s² is that of its samples, as if they were independent. Where the sampler
stratifies them their mean varies less, Var(x̄) ≤ s²/n for strata of equal probability (Cochran, Sampling Techniques,
1977, 5.6), so this is an upper bound.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
from dataclasses import dataclass

import numpy as np

from mi_refract.io.image_file import block_sum

from .pass_plan import FEW
from .pass_sums import Doubles, PassSums

NO_NOISE = "no noise: the samples of every pixel agree"
LEVEL = 0.95
TILE = 16  # pixels
ENOUGH_FOR_NO_NOISE = 64  # samples per pixel
SAME = 5e-13  # of a pixel's mean, the standard deviation of samples that are equal but for the rounding of sums
LEFT_OUT = 0.01  # share of the tiles that may be worse
DARK = 0.01  # of the image's mean: a darker tile is judged as if it were so bright


@dataclass(frozen=True)
class RelativeError:
    """The estimate, and where the error of this image lies with probability LEVEL; NaN where too little is known.

    `at_most`: it is that of independent samples, an upper bound for stratified ones.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    at_most: bool = False


def relative_error(sums: PassSums) -> RelativeError:
    """The error of an image over all its pixels that are finite."""
    colours = sums.mean[..., : sums.colours]
    known = np.isfinite(colours)
    mean = abs(float(colours[known].mean())) if known.any() else math.nan
    contrasts = np.asarray([each for each in sums.contrasts if math.isfinite(each)])
    if not mean > 0 or not sums.freedom:
        return RelativeError(math.nan)
    squared, spread = float(contrasts.mean()) if contrasts.size else math.nan, math.nan
    if at_most := not contrasts.size and (variance := sums.variance) is not None:
        known = np.isfinite(variance := variance[..., : sums.colours])
        squared = float(variance[known].mean())
    if contrasts.size > 1:
        with contextlib.suppress(ImportError):  # without SciPy, which is an extra, there is no interval
            from scipy.stats import t  # takes a second

            quantile = float(t.ppf((1 + LEVEL) / 2, contrasts.size - 1))
            spread = quantile * float(contrasts.std(ddof=1)) * math.sqrt(1 + 1 / contrasts.size)
    value, low, high = (math.sqrt(max(x, 0) / sums.spp) / mean for x in (squared, squared - spread, squared + spread))
    return RelativeError(value, low, high, at_most)


def without_noise(sums: PassSums) -> bool:
    """Whether all samples of each pixel are the same, and none is black: there light may be that is seldom met.

    Sums in float64 differ from equal ones by less than SAME; one sample of n ≤ 2³², by float32's 6e-8/√n ≥ 9e-13.
    """
    if sums.spp < ENOUGH_FOR_NO_NOISE or (variance := sums.variance) is None:
        return False
    mean = sums.mean
    return bool((np.isfinite(mean) & (mean != 0) & (variance <= np.square(SAME * mean))).all())


def require_interval() -> None:
    """ImportError, in one line, where the interval cannot be had."""
    if importlib.util.find_spec("scipy") is None:
        raise ImportError("--until needs SciPy; expected pip install 'mi-refract[diff]', or --until-tile")


def worst_tile(sums: PassSums) -> float:
    """The relative error of the worst tile of TILE² pixels but LEFT_OUT of them; NaN where too little is known."""
    variance = sums.variance
    if variance is None:
        return math.nan
    squared = _tile_means(variance[..., : sums.colours] / sums.spp)
    means = np.abs(_tile_means(sums.mean[..., : sums.colours]))
    if not (size := float(np.nanmean(means)) if np.isfinite(means).any() else 0.0) > 0:
        return math.nan
    return float(np.nanquantile(np.sqrt(squared) / np.maximum(means, DARK * size), 1 - LEFT_OUT, method="higher"))


def _tile_means(values: Doubles) -> Doubles:
    """Means over tiles and channels, of what is finite; NaN for a tile where nothing is."""
    known = np.isfinite(values)
    sums, counts = (
        block_sum(each.sum(-1, keepdims=True), TILE)[..., 0] for each in (np.where(known, values, 0), known)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(sums / counts, np.float64)


@dataclass(frozen=True)
class Limits:
    """The first of these that is reached ends a render.

    `until`, `until_tile`: relative errors, of the image and of its worst tiles; `seconds`: of this run. `spp`: samples
    per pixel; None: those of the scene, where nothing else ends the render. `pass_spp`: samples per pixel of a pass.
    ValueError for a number out of range.
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
        """Whether something else than a number of samples ends the render."""
        return self.by_error or self.seconds is not None

    @property
    def by_error(self) -> bool:
        """Whether an error ends the render."""
        return self.until is not None or self.until_tile is not None


def reached(limits: Limits, sums: PassSums) -> str:
    """Why an image is good enough: no noise, or an error that was asked for; "" where it is not."""
    if without_noise(sums):
        return NO_NOISE
    if sums.passes < FEW:  # their spread says too little
        return ""
    if limits.until and (error := relative_error(sums)).high <= limits.until:
        until, value, high = (f"{100 * share:.3g} %" for share in (limits.until, error.value, error.high))
        return f"--until {until}: the error is {value}, at most {high}"
    if limits.until_tile and (worst := worst_tile(sums)) <= limits.until_tile:
        until, value = (f"{100 * share:.3g} %" for share in (limits.until_tile, worst))
        return f"--until-tile {until}: the error of the worst tile is {value}"
    return ""


def needed_spp(limits: Limits, sums: PassSums) -> float:
    """The samples per pixel with which an image will reach an error that was asked for, by its present estimate."""
    ratios = [relative_error(sums).value / limits.until] if limits.until else []
    ratios += [worst_tile(sums) / limits.until_tile] if limits.until_tile else []
    return sums.spp * min((ratio for ratio in ratios if math.isfinite(ratio)), default=math.inf) ** 2
