"""The method `tolerance`: differences within thresholds, except for a few pixels, as OpenImageIO's `idiff` counts.

A pixel differs where one of its channels does: by more than `fail`, and by more than `fail_relative` of the mean of
both magnitudes. The bounds are asked in `idiff`'s order: up to `allow_failures` such pixels pass, whatever the others
say; then `fail_percent` and `hard_fail` decide, and after them the same bounds for warnings.

`outrageous` finds what `fail_percent` should not let pass: a pixel that is far brighter than all around it in the other
image. `tolerance_passes_black` says whether an all-black test image would pass with the same options,
`tolerance_accepts_black` in which pixels: there the method sees no difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels, any_channel
from mi_refract.report.number_text import compact, distinguishable

from .comparison import Comparison, Metric, Verdict, checked_pixels, counted, verdict_of
from .pixelwise import require_nonnegative

BLOCK = 2**16  # pixels whose ratios are formed at once, in float64
# A pixel is outrageous above both of these: a detail that moves by NEAR pixels is not, nor is any code value of a
# display where the mean is more than a hundredth of white.
TIMES_AROUND, TIMES_MEAN, NEAR = 10.0, 100.0, 2


def tolerance(
    reference: Image,
    test: Image,
    *,
    allow_nonfinite: bool = False,
    fail: Annotated[float, "difference up to which values count as equal"] = 0.004,
    fail_relative: Annotated[float, "the same, as a share of the mean of both"] = 0.001,
    fail_percent: Annotated[float, "percentage of the pixels that may differ by more"] = 0.02,
    hard_fail: Annotated[
        float, "no value may differ by more than this, where more than allow_failures differ"
    ] = np.inf,
    allow_failures: Annotated[int, "so many pixels may differ by any amount"] = 0,
    warn: Annotated[float, "difference above which a pixel gives a warning"] = np.inf,
    warn_relative: Annotated[float, "the same, as a share of the mean of both"] = 0.0,
    warn_percent: Annotated[float, "percentage of the pixels that may do so without a warning"] = 0.0,
    hard_warn: Annotated[float, "any larger difference gives a warning"] = np.inf,
) -> Comparison:
    """Differences within absolute and relative thresholds, except for a few pixels, as `idiff` counts them.

    Warnings are looked at as `idiff` does: where more than `allow_failures` pixels differ, and that is no failure.
    """
    options = {name: value for name, value in locals().items() if name not in ("reference", "test", "allow_nonfinite")}
    require_nonnegative(options)
    a, b, found = checked_pixels("tolerance", reference, test, allow_nonfinite)
    if found:
        return found
    # Not OpenImageIO's own `compare`: it rounds to float32, and what that does not hold would be equal.
    with np.errstate(over="ignore"):
        difference = np.abs(b - a)
        maps = {"difference": difference.astype(np.float32, copy=False)}
    failed, warned = (_beyond(difference, a, b, *x).size for x in ((fail, fail_relative), (warn, warn_relative)))
    largest, pixels = float(difference.max()), counted(reference)
    bounds = _bounds(failed, pixels, options, difference.dtype)
    metrics = (
        Metric("pixels beyond the tolerance", failed, bounds[0]),
        Metric("largest difference", largest, bounds[1]),
        Metric("mean difference", float(difference.mean(dtype=np.float64))),
        Metric("RMS difference", float(np.sqrt(np.einsum("ijk,ijk->", *2 * [difference], dtype=float) / a.size))),
        Metric("pixels worth a warning", warned),
    )
    place = _place(difference, reference) if largest else ""
    reason = "; ".join(_reasons(metrics, pixels, options, place))
    verdict = verdict_of(metrics)
    quiet = verdict is not Verdict.EQUAL or failed <= allow_failures
    warning = "" if quiet else _warning(warned, largest, pixels, options, difference.dtype)
    return Comparison("tolerance", verdict, reason, metrics, maps=maps, warning=warning)


def outrageous(reference: Image, test: Image, fail: float) -> str:
    """Where one image is TIMES_AROUND as bright as the other is within NEAR pixels, and TIMES_MEAN its mean; or "".

    Differences up to `fail` are none. Both images are finite and have the same channels in the same order.
    """
    names = (test, reference.pixels, test.pixels), (reference, test.pixels, reference.pixels)
    for image, dim, bright in names:
        size = np.abs(dim)
        found = np.abs(bright) > np.maximum(TIMES_MEAN * size.mean((0, 1), dtype=np.float64), size + fail)
        if found.any():
            from scipy.ndimage import maximum_filter

            around = maximum_filter(size, (2 * NEAR + 1, 2 * NEAR + 1, 1), mode="nearest")
            excess = np.where(found & (np.abs(bright) > TIMES_AROUND * around), np.abs(bright), 0)
            if excess.any():
                y, x, _ = np.unravel_index(int(excess.argmax()), excess.shape)
                most = f"{compact(float(excess.max()))}{_place(excess, reference)}, of {image.path}"
                beside = f"{compact(float(around[y, x].max()))} in the other image within {NEAR} pixels"
                return f"{most} for at most {beside}"
    return ""


def tolerance_passes_black(reference: Image, options: Mapping[str, Any]) -> bool:
    """Whether `tolerance` would call a black test image equal to `reference`; `options`: all of them, by name."""
    a = reference.pixels
    difference = np.abs(a)
    failed = _beyond(difference, a, np.zeros_like(a), options["fail"], options["fail_relative"]).size
    most, hard = _bounds(failed, counted(reference), options, a.dtype)
    return bool(failed <= most and (hard is None or difference.max() <= hard))


def tolerance_accepts_black(a: Pixels, options: Mapping[str, Any]) -> NDArray[np.bool_]:
    """The pixels of the reference, H × W × C, in which `tolerance` would take black for equal; H × W.

    `hard_fail` is not among the reasons: it is asked of other pixels than those within `fail` only where they fail.
    """
    accepted = np.ones(a.shape[:2], bool)
    accepted.reshape(-1)[_beyond(np.abs(a), a, np.zeros_like(a), options["fail"], options["fail_relative"])] = False
    return accepted


def _bounds(failed: int, pixels: int, options: Mapping[str, Any], kind: np.dtype[Any]) -> tuple[int, float | None]:
    """How many pixels may fail, and by how much a value may differ; None where that is not asked."""
    allowed = options["allow_failures"]
    most = max(allowed, _most(options["fail_percent"], pixels))
    return most, None if failed <= allowed else _rounded(options["hard_fail"], kind)


def _most(percent: float, pixels: int) -> int:
    """The largest number of pixels that is not more than this percentage."""
    # count > percent / 100 · pixels, in float64 of a float32 percentage, is what idiff asks.
    return int(min(_rounded(percent) / 100 * pixels, pixels))


def _rounded(bound: float, kind: np.dtype[Any] | type[np.floating[Any]] = np.float32) -> float:
    """A threshold in the numbers of the images: a difference of one code value may lie between it and its float32."""
    with np.errstate(over="ignore"):
        return float(np.asarray(bound, kind))


def _beyond(difference: Pixels, a: Pixels, b: Pixels, most: float, share: float) -> NDArray[np.intp]:
    """The pixels with a channel that differs by more than `most`, and than that share of the mean of both; flat."""
    most, share = (_rounded(each, difference.dtype) for each in (most, share))
    pixels = np.flatnonzero(any_channel(difference > most))  # few: the rest is cheaper there
    x, y, z = (each.reshape(-1, a.shape[2]) for each in (difference, a, b))
    blocks = np.array_split(pixels, pixels.size // BLOCK + 1)
    return np.concatenate([block[_differ(x[block], y[block], z[block], most, share)] for block in blocks])


def _differ(difference: Pixels, a: Pixels, b: Pixels, most: float, share: float) -> NDArray[np.bool_]:
    """Which of these pixels, N × C, differ; in idiff's precision: a mean is rounded, the ratio to it is not."""
    half = np.float64(0.5)  # of this type: half of a float32 would be rounded where it is subnormal
    mean = (np.abs(a) * half + np.abs(b) * half).astype(difference.dtype)
    relative = np.divide(difference, mean, out=np.zeros(mean.shape), where=mean > 0, dtype=np.float64)
    differs: NDArray[np.bool_] = any_channel((difference > most) & (relative > share))
    return differs


# The words ------------------------------------------------------------------------------------------------------


def _reasons(metrics: tuple[Metric, ...], pixels: int, options: Mapping[str, Any], place: str) -> list[str]:
    """What was found of both bounds, the violated one first."""
    failed, largest = metrics[:2]
    relative = options["fail_relative"]
    by = f"by more than fail = {options['fail']:g}" + (f", fail_relative = {relative:g}" if relative else "")
    count, allowed = int(failed.value), options["allow_failures"]
    if not count:
        words = f"no pixel of {pixels} differs {by}"
    elif count <= allowed:
        words = f"{_share(count, pixels)} differ {by} (≤ allow_failures = {allowed})"
    else:
        also = f", allow_failures = {allowed}" if allowed else ""
        sign = "≤" if failed.holds else ">"
        words = f"{_share(count, pixels)} differ {by} ({sign} fail_percent = {options['fail_percent']:g}{also})"
    far = f"largest difference {compact(largest.value)}{place}"
    if not largest.holds:
        value, bound = distinguishable(largest.value, options["hard_fail"])
        far = f"largest difference {value} > hard_fail = {bound}{place}"
    return [far, words] if failed.holds and not largest.holds else [words, far]


def _share(count: int, pixels: int) -> str:
    return f"{compact(100 * count / pixels)} % of the pixels ({count} of {pixels})"


def _warning(warned: int, largest: float, pixels: int, options: Mapping[str, Any], kind: np.dtype[Any]) -> str:
    """Which bounds of warnings are exceeded; "" for none."""
    found = []
    if warned > _most(options["warn_percent"], pixels):
        by = f"differ by more than warn = {options['warn']:g} (> warn_percent = {options['warn_percent']:g})"
        found.append(f"{_share(warned, pixels)} {by}")
    if largest > _rounded(options["hard_warn"], kind):
        value, bound = distinguishable(largest, options["hard_warn"])
        found.append(f"largest difference {value} > hard_warn = {bound}")
    return "; ".join(found)


def _place(difference: Pixels, image: Image) -> str:
    y, x, c = np.unravel_index(int(difference.argmax()), difference.shape)
    return f" at x = {x + image.origin[0]}, y = {y + image.origin[1]}, channel {image.channels[c]}"
