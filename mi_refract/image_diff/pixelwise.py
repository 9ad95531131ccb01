"""Methods that compare each pixel separately: `exact`, `paired`, and `tolerance`, which follows OpenImageIO's `idiff`.

With `tolerance`, a pixel differs if one of its channels differs by more than `fail`, and by more than `fail_relative`
times the mean of both magnitudes. The bounds are applied in `idiff`'s order: up to `allow_failures` such pixels pass,
whatever the other bounds are; then `fail_percent` and `hard_fail` decide; then the corresponding bounds for warnings.
`outrageous` finds a pixel that `fail_percent` should not accept: one far brighter than its surroundings in the other
image.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Image, Pixels, any_channel
from mi_refract.io.text import compact, distinguishable

from .comparison import Comparison, Metric, Verdict, counted, groups, place, verdict_of
from .tile_statistics import median_nonblack, same_shape

CODES = {"uint8": 255, "uint16": 65535}  # the integer for the value 1, by the file's type
ROW_STEP = 16  # black is first looked for in every such row
BLOCK = 2**16  # pixels whose ratios are computed at once, in float64
# A pixel is outrageous above both of these. A detail that moves by NEAR pixels is not outrageous. Nor is any value of a
# display, up to white, if the mean is more than a hundredth of white.
TIMES_AROUND, TIMES_MEAN, NEAR = 10.0, 100.0, 2


def exact(reference: Image, test: Image) -> Comparison:
    """Every value is the same."""
    a, b = reference.pixels, test.pixels
    difference = _difference(a, b)
    changed = int((a != b).any(-1).sum())
    reason = "every value is the same"
    if changed:
        codes = CODES.get(reference.stored if reference.stored == test.stored else "", 0)
        largest = f"{difference.max() * codes:.0f} of {codes} codes" if codes else compact(float(difference.max()))
        at = place(difference, reference)
        reason = f"{changed} of {a[..., 0].size} pixels differ; largest difference {largest} at {at}"
    metrics = (Metric("changed pixels", changed, 0.0), Metric("largest difference", float(difference.max()), 0.0))
    verdict = Verdict.DIFFERENT if changed else Verdict.EQUAL
    return Comparison("exact", verdict, reason, metrics, 0.0, {"difference": difference})


def _difference(a: Pixels, b: Pixels) -> Pixels:
    with np.errstate(over="ignore"):
        difference = b - a
        return np.abs(difference, out=difference).astype(np.float32, copy=False)


# The same random numbers ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Changes:
    """The share of changed pixels, the largest change, the RMS change and the ratio of the means of two arrays."""

    share: float
    largest: float
    rms: float
    mean_ratio: float


def changes(reference: Pixels, test: Pixels, threshold: float) -> Changes:
    """Return the changes between two arrays of the same shape, … × C, in their unit.

    A pixel is changed if a channel differs by more than `threshold`, or if a value of either is not finite. With a
    value that is not finite, the largest and the RMS change are infinite, and the ratio of the means is NaN. ValueError
    for different shapes.
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

    A change is relative to the reference's value, or to the median of its channel without black pixels if that is
    larger; in a black channel, to that of the other colours of its layer, or else of the new image.
    """
    a, b = reference.pixels, test.pixels
    scale = np.empty(a.shape)
    for names in groups(reference.channels).values():
        numbers = [reference.channels.index(name) for name in names]
        scale[..., numbers] = _scale(a[..., numbers], b[..., numbers])
    measured = changes(a / scale, b / scale, threshold)
    share = measured.share * a[..., 0].size / counted(reference)
    rms = measured.rms * (a[..., 0].size / counted(reference)) ** 0.5  # pixels that are not compared do not change
    metrics = (
        Metric("share of changed pixels", share, changed),
        Metric("largest change", measured.largest, largest),
        Metric("RMS change", rms),
        Metric("ratio of the means", _mean_ratio(a, b)),
    )
    reason = f"{compact(100 * share)} % of the pixels are changed, the largest by {measured.largest:.3g} of its value"
    return Comparison("paired", verdict_of(metrics), reason, metrics, maps={"difference": _difference(a, b)})


def paired_accepts(a: Pixels, b: Pixels, options: Mapping[str, Any]) -> NDArray[np.bool_]:
    """Return the pixels, H × W, of two images, H × W × C, that `paired` calls unchanged."""
    return np.asarray((np.abs(b - a) / _scale(a, b) <= options["threshold"]).all(-1))


def _scale(a: Pixels, b: Pixels) -> Pixels:
    """Return the value that changes are relative to, at every pixel and channel of a group; above 0."""
    medians = median_nonblack(np.abs(a))
    floors = np.where(medians > 0, medians, medians.mean() or median_nonblack(np.abs(b)).mean() or 1.0)
    return np.maximum(np.abs(a), floors)


def _mean_ratio(reference: Pixels, test: Pixels) -> float:
    one, two = (float(x.mean(dtype=np.float64)) for x in (reference, test))
    return two / one if one else 1.0 + two


# Thresholds ----------------------------------------------------------------------------------------------------


def tolerance(
    reference: Image,
    test: Image,
    *,
    fail: Annotated[float, "absolute difference up to which values count as equal"] = 0.004,
    fail_relative: Annotated[
        float, "relative difference up to which values count as equal, as a share of the mean of both"
    ] = 0.001,
    fail_percent: Annotated[float, "percentage of the pixels that may differ by more than both"] = 0.02,
    hard_fail: Annotated[
        float, "largest absolute difference of any value, where more than allow_failures pixels differ"
    ] = np.inf,
    allow_failures: Annotated[int, "number of pixels that may differ by any amount"] = 0,
    warn: Annotated[float, "absolute difference above which a pixel counts for a warning"] = np.inf,
    warn_relative: Annotated[
        float, "relative difference above which a pixel counts for a warning, as a share of the mean"
    ] = 0.0,
    warn_percent: Annotated[float, "percentage of the pixels that may exceed both without a warning"] = 0.0,
    hard_warn: Annotated[float, "absolute difference of any value above which there is a warning"] = np.inf,
) -> Comparison:
    """Differences within absolute and relative thresholds, except for a few pixels, as `idiff` counts them.

    As in `idiff` there is a warning only if more than `allow_failures` pixels differ, and that is no failure.
    """
    a, b, pixels = reference.pixels, test.pixels, counted(reference)
    # OpenImageIO's own `compare` would round to float32, which hides smaller differences of float64.
    with np.errstate(over="ignore"):
        difference = np.abs(b - a)
        maps = {"difference": difference.astype(np.float32, copy=False)}
    kind, largest = difference.dtype, float(difference.max())
    failed = _beyond(difference, a, b, fail, fail_relative).size
    warned = _beyond(difference, a, b, warn, warn_relative).size
    few = failed <= allow_failures
    values = max(pixels * a.shape[2], 1)  # in pixels that are not compared, the difference is 0
    metrics = (
        Metric("pixels beyond the tolerance", failed, max(allow_failures, _max_count(fail_percent, pixels))),
        Metric("largest difference", largest, None if few else _rounded(hard_fail, kind)),
        Metric("mean difference", float(difference.sum(dtype=np.float64) / values)),
        Metric("RMS difference", float(np.sqrt(np.einsum("ijk,ijk->", *2 * [difference], dtype=float) / values))),
        Metric("pixels worth a warning", warned),
    )
    verdict = verdict_of(metrics)

    by = f"by more than fail = {fail:g}" + (f", fail_relative = {fail_relative:g}" if fail_relative else "")
    bound = f"≤ allow_failures = {allow_failures}"
    if not few:
        bound = f"{'≤' if metrics[0].holds else '>'} fail_percent = {fail_percent:g}"
        bound += f", allow_failures = {allow_failures}" if allow_failures else ""
    counts = f"{_share(failed, pixels)} differ {by} ({bound})" if failed else f"no pixel of {pixels} differs {by}"
    at = f" at {place(difference, reference)}" if largest else ""
    far = f"largest difference {compact(largest)}{at}"
    if not metrics[1].holds:
        far = "largest difference {} > hard_fail = {}".format(*distinguishable(largest, hard_fail)) + at
    only_far = metrics[0].holds and not metrics[1].holds
    reason = f"{far}; {counts}" if only_far else f"{counts}; {far}"

    warnings = []
    if warned > _max_count(warn_percent, pixels):
        bounds = f"warn = {warn:g} (> warn_percent = {warn_percent:g})"
        warnings.append(f"{_share(warned, pixels)} differ by more than {bounds}")
    if largest > _rounded(hard_warn, kind):
        warnings.append("largest difference {} > hard_warn = {}".format(*distinguishable(largest, hard_warn)))
    warning = "; ".join(warnings) if verdict is Verdict.EQUAL and not few else ""
    return Comparison("tolerance", verdict, reason, metrics, maps=maps, warning=warning)


def outrageous(reference: Image, test: Image, fail: float) -> str:
    """Return where a pixel of one image is outrageous; "" if none is.

    It is brighter than TIMES_AROUND times the other image within NEAR pixels, and than TIMES_MEAN times the mean of the
    other image's compared pixels. Differences up to `fail` are ignored. Both images are finite and have the same
    channels in the same order.
    """
    for image, other in ((test, reference), (reference, test)):
        size, bright = np.abs(other.pixels), np.abs(image.pixels)
        mean = size.sum((0, 1), dtype=np.float64) / counted(reference)  # excluded pixels are 0
        candidates = bright > np.maximum(TIMES_MEAN * mean, size + fail)
        if not candidates.any():
            continue
        from scipy.ndimage import maximum_filter

        around = maximum_filter(size, (2 * NEAR + 1, 2 * NEAR + 1, 1), mode="nearest")
        excess = np.where(candidates & (bright > TIMES_AROUND * around), bright, 0)
        if excess.any():
            y, x, _ = np.unravel_index(int(excess.argmax()), excess.shape)
            pixel = f"{compact(float(excess.max()))} at {place(excess, reference)}, of {image.path}"
            return f"{pixel}; the other image has at most {compact(float(around[y, x].max()))} within {NEAR} pixels"
    return ""


def tolerance_views(image: Image, options: Mapping[str, Any]) -> Iterator[tuple[Image, Mapping[str, Any]]]:
    """Yield every ROW_STEP-th row, in which as many pixels may differ as in the whole image, and the whole image."""
    most = max(options["allow_failures"], _max_count(options["fail_percent"], counted(image)))
    rows = replace(image, pixels=image.pixels[::ROW_STEP], mask=None)
    yield rows, {**options, "allow_failures": most, "fail_percent": 0.0}
    yield image, options


def tolerance_accepts(a: Pixels, b: Pixels, options: Mapping[str, Any]) -> NDArray[np.bool_]:
    """Return the pixels, H × W, of two images, H × W × C, that `tolerance` calls equal by `fail` and `fail_relative`.

    `hard_fail` is not used: it applies only if too many other pixels differ.
    """
    equal = np.ones(a.shape[:2], bool)
    equal.reshape(-1)[_beyond(np.abs(b - a), a, b, options["fail"], options["fail_relative"])] = False
    return equal


def _max_count(percent: float, pixels: int) -> int:
    """Return the largest number of pixels that is not more than this percentage."""
    # idiff tests count > percent / 100 · pixels in float64, with a float32 percentage.
    return int(min(_rounded(percent) / 100 * pixels, pixels))


def _rounded(bound: float, kind: np.dtype[Any] | type[np.floating[Any]] = np.float32) -> float:
    """Return a threshold in the type of the images: a difference of one code may be between it and its float32."""
    with np.errstate(over="ignore"):
        return float(np.asarray(bound, kind))


def _beyond(difference: Pixels, a: Pixels, b: Pixels, absolute: float, share: float) -> NDArray[np.intp]:
    """Return the flat indices of pixels with a channel that differs by more than both bounds.

    `absolute`: bound of the difference; `share`: bound relative to the mean of both magnitudes. The precision is that
    of idiff: a mean is rounded, the ratio to it is not.
    """
    absolute, share = _rounded(absolute, difference.dtype), _rounded(share, difference.dtype)
    pixels = np.flatnonzero(any_channel(difference > absolute))  # usually few, so the ratios are cheap
    flat = [x.reshape(-1, a.shape[2]) for x in (difference, a, b)]
    half = np.float64(0.5)  # in float32, half of a subnormal number would be rounded
    differing = []
    for block in np.array_split(pixels, pixels.size // BLOCK + 1):
        d, one, two = (x[block] for x in flat)
        mean = (np.abs(one) * half + np.abs(two) * half).astype(d.dtype)
        relative = np.divide(d, mean, out=np.zeros(mean.shape), where=mean > 0, dtype=np.float64)
        differing.append(block[any_channel((d > absolute) & (relative > share))])
    return np.concatenate(differing)


def _share(count: int, pixels: int) -> str:
    return f"{compact(100 * count / pixels)} % of the pixels ({count} of {pixels})"
