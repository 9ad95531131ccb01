"""Methods that look at every pixel alone: `exact`, `tolerance` and `paired`.

`tolerance_passes_black` and `paired_passes_black` say whether an all-black test image would pass with the same
options, `tolerance_accepts_black` and `paired_accepts_black` in which pixels: there the method sees no difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels, any_channel

from .comparison import Comparison, Metric, Verdict, checked_pixels, counted, verdict_of
from .tile_statistics import median_nonblack, same_shape


def exact(reference: Image, test: Image, *, allow_nonfinite: bool = False) -> Comparison:
    """Every value is the same."""
    a, b, found = checked_pixels("exact", reference, test, allow_nonfinite)
    if found:
        return found
    difference = _difference(a, b)
    changed = int((a != b).any(-1).sum())
    verdict = Verdict.DIFFERENT if changed else Verdict.EQUAL
    reason = f"{changed} of {a[..., 0].size} pixels differ" if changed else "every value is the same"
    metrics = (Metric("changed pixels", changed, 0.0), Metric("largest difference", float(difference.max()), 0.0))
    return Comparison("exact", verdict, reason, metrics, 0.0, {"difference": difference})


# Absolute and relative thresholds ------------------------------------------------------------------------------


def tolerance(
    reference: Image,
    test: Image,
    *,
    allow_nonfinite: bool = False,
    fail: Annotated[float, "difference up to which values count as equal"] = 0.004,
    fail_relative: Annotated[float, "the same, as a share of the mean of both"] = 0.001,
    fail_percent: Annotated[float, "percentage of the pixels that may differ by more"] = 0.02,
    hard_fail: Annotated[float, "no value may differ by more than this"] = np.inf,
    warn: Annotated[float, "difference above which a pixel gives a warning"] = np.inf,
    warn_relative: Annotated[float, "the same, as a share of the mean of both"] = 0.0,
    warn_percent: Annotated[float, "percentage of the pixels that may do so without a warning"] = 0.0,
    hard_warn: Annotated[float, "any larger difference gives a warning"] = np.inf,
) -> Comparison:
    """Differences within absolute and relative thresholds, except for a share of the pixels, as `idiff` counts them."""
    require_nonnegative(locals())
    a, b, found = checked_pixels("tolerance", reference, test, allow_nonfinite)
    if found:
        return found
    # Not OpenImageIO's own `compare`: it rounds to float32, and what that does not hold would be equal.
    with np.errstate(over="ignore"):
        difference = np.abs(b - a)
        maps = {"difference": difference.astype(np.float32, copy=False)}
    limits = (fail, fail_relative), (warn, warn_relative)
    failed, warned = (_percent(difference, a, b, *each, counted(reference)) for each in limits)
    largest = float(difference.max())
    metrics = (
        Metric("pixels beyond the tolerance, %", failed, fail_percent),
        Metric("largest difference", largest, hard_fail),
        Metric("mean difference", float(difference.mean(dtype=np.float64))),
        Metric("RMS difference", float(np.sqrt(np.einsum("ijk,ijk->", *2 * [difference], dtype=float) / a.size))),
        Metric("pixels worth a warning, %", warned),
    )
    reason = f"{failed:.3g} % of the pixels beyond the tolerance; largest difference {largest:.3g}"
    reason += _place(difference, reference) if largest else ""
    if warned > warn_percent or largest > hard_warn:
        reason += f"; warning: {warned:.3g} % of the pixels"
    return Comparison("tolerance", verdict_of(metrics), reason, metrics, maps=maps)


def tolerance_passes_black(reference: Image, options: Mapping[str, Any]) -> bool:
    """Whether `tolerance` would call a black test image equal to `reference`; `options`: all of them, by name."""
    a = reference.pixels
    difference = np.abs(a)
    black = np.zeros_like(a)
    beyond = _percent(difference, a, black, options["fail"], options["fail_relative"], counted(reference))
    return bool(beyond <= options["fail_percent"] and difference.max() <= options["hard_fail"])


def tolerance_accepts_black(a: Pixels, options: Mapping[str, Any]) -> NDArray[np.bool_]:
    """The pixels of the reference, H × W × C, in which `tolerance` would take black for equal; H × W."""
    difference = np.abs(a)
    accepted = ~any_channel(~(difference <= options["hard_fail"]))
    beyond = _beyond(difference, a, np.zeros_like(a), options["fail"], options["fail_relative"])
    accepted.reshape(-1)[beyond] = False
    return accepted


def _place(difference: Pixels, image: Image) -> str:
    y, x, _ = np.unravel_index(int(difference.argmax()), difference.shape)
    return f" at x = {x + image.origin[0]}, y = {y + image.origin[1]}"


def _percent(difference: Pixels, a: Pixels, b: Pixels, most: float, share: float, of: int) -> float:
    """The pixels that `_beyond` finds, as a percentage of `of`."""
    return 100 * _beyond(difference, a, b, most, share).size / of


def _beyond(difference: Pixels, a: Pixels, b: Pixels, most: float, share: float) -> NDArray[np.intp]:
    """The pixels with a channel that differs by more than `most`, and than that share of the mean of both; flat."""
    pixels = np.flatnonzero(any_channel(difference > most))  # few: the rest is cheaper there
    x, y, z = (each.reshape(-1, a.shape[2])[pixels] for each in (difference, a, b))
    found: NDArray[np.intp] = pixels[any_channel(x > np.maximum(most, share * (np.abs(y) / 2 + np.abs(z) / 2)))]
    return found


def _difference(a: Pixels, b: Pixels) -> Pixels:
    with np.errstate(over="ignore"):
        difference = b - a
        return np.abs(difference, out=difference).astype(np.float32, copy=False)


# The same random numbers ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Changes:
    """Of two arrays: the share of changed pixels, the largest change, the RMS change, the ratio of the means."""

    share: float
    largest: float
    rms: float
    mean_ratio: float


def changes(reference: Pixels, test: Pixels, threshold: float) -> Changes:
    """The changes between two arrays of one shape, … × C, in their own unit.

    A pixel is changed where a channel differs by more than `threshold`, or where a value of either is not finite; then
    the largest and the RMS change are infinite, and the ratio of the means is NaN. ValueError for different shapes.
    """
    same_shape(reference, test)
    with np.errstate(invalid="ignore"):
        difference = np.abs(test - reference).max(-1)
    finite = np.isfinite(test).all(-1) & np.isfinite(reference).all(-1)
    changed = float((~(difference <= threshold) | ~finite).mean())
    if not finite.all():
        return Changes(changed, np.inf, np.inf, np.nan)
    rms = float(np.sqrt(np.square(test - reference).mean()))
    return Changes(changed, float(difference.max()), rms, _mean_ratio(reference, test))


def paired(
    reference: Image,
    test: Image,
    *,
    allow_nonfinite: bool = False,
    threshold: Annotated[float, "a pixel is changed where a channel differs by more than this share"] = 1e-4,
    changed: Annotated[float, "share of the pixels that may be changed"] = 0.001,
    largest: Annotated[float, "largest change that is allowed, as a share"] = 100.0,
) -> Comparison:
    """Renders of the same random numbers: the share of changed pixels and the largest change.

    A change is relative to the reference's value, or to the median of its channel without black pixels where that is
    larger.
    """
    require_nonnegative(locals())
    a, b, found = checked_pixels("paired", reference, test, allow_nonfinite)
    if found:
        return found
    scale = _scale(a, b)
    measured = changes(a / scale, b / scale, threshold)
    share = measured.share * a[..., 0].size / counted(reference)
    metrics = (
        Metric("share of changed pixels", share, changed),
        Metric("largest change", measured.largest, largest),
        Metric("RMS change", measured.rms),
        Metric("ratio of the means", _mean_ratio(a, b)),
    )
    reason = f"{share:.3%} of the pixels are changed, the largest by {measured.largest:.3g} of its value"
    return Comparison("paired", verdict_of(metrics), reason, metrics, maps={"difference": _difference(a, b)})


def paired_passes_black(reference: Image, options: Mapping[str, Any]) -> bool:
    """Whether `paired` would call a black test image equal to `reference`; `options`: all of them, by name."""
    a = reference.pixels
    black = np.zeros_like(a)
    measured = changes(a / _scale(a, black), black, options["threshold"])
    return bool(measured.share <= options["changed"] and measured.largest <= options["largest"])


def paired_accepts_black(a: Pixels, options: Mapping[str, Any]) -> NDArray[np.bool_]:
    """The pixels of the reference, H × W × C, that `paired` would take for unchanged if they were black; H × W."""
    accepted: NDArray[np.bool_] = (np.abs(a) / _scale(a, np.zeros_like(a)) <= options["threshold"]).all(-1)
    return accepted


def _scale(a: Pixels, b: Pixels) -> Pixels:
    """What changes are relative to, at every pixel and channel; above 0."""
    floor = median_nonblack(np.abs(a))
    of_channels = np.where(floor > 0, floor, floor.mean() or median_nonblack(np.abs(b)).mean() or 1.0)
    return np.maximum(np.abs(a), of_channels)


def _mean_ratio(reference: Pixels, test: Pixels) -> float:
    one, two = (float(x.mean(dtype=np.float64)) for x in (reference, test))
    return two / one if one else 1.0 + two


def require_nonnegative(options: Mapping[str, Any]) -> None:
    """ValueError for a float among the options that is negative or NaN."""
    for name, value in options.items():
        if isinstance(value, float) and not value >= 0:
            raise ValueError(f"{name} = {value}: accepted: a number of at least 0")
