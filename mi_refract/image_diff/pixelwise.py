"""Methods that look at every pixel alone: `exact` and `paired`; `tolerance` has a module of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels

from .comparison import Comparison, Metric, Verdict, counted, verdict_of
from .tile_statistics import median_nonblack, same_shape


def exact(reference: Image, test: Image) -> Comparison:
    """Every value is the same."""
    a, b = reference.pixels, test.pixels
    difference = _difference(a, b)
    changed = int((a != b).any(-1).sum())
    verdict = Verdict.DIFFERENT if changed else Verdict.EQUAL
    reason = f"{changed} of {a[..., 0].size} pixels differ" if changed else "every value is the same"
    metrics = (Metric("changed pixels", changed, 0.0), Metric("largest difference", float(difference.max()), 0.0))
    return Comparison("exact", verdict, reason, metrics, 0.0, {"difference": difference})


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
    threshold: Annotated[float, "a pixel is changed where a channel differs by more than this share"] = 1e-4,
    changed: Annotated[float, "share of the pixels that may be changed"] = 0.001,
    largest: Annotated[float, "largest change that is allowed, as a share"] = 100.0,
) -> Comparison:
    """Renders of the same random numbers: the share of changed pixels and the largest change.

    A change is relative to the reference's value, or to the median of its channel without black pixels where that is
    larger.
    """
    require_nonnegative(locals())
    a, b = reference.pixels, test.pixels
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


def accepts_black(a: Pixels, options: Mapping[str, Any]) -> NDArray[np.bool_]:
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
    """ValueError for a number among the options that is negative or NaN."""
    for name, value in options.items():
        if isinstance(value, float | int) and not value >= 0:
            raise ValueError(f"{name} = {value}; expected a number of at least 0")
