"""Are two images the same? Gates first, then one of five methods; each gives a verdict with its numbers.

Fails closed: what cannot be compared is an error, a value that is not finite equals nothing, and a method that could
not have seen a difference says "inconclusive".
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from mi_refract.io.image_file import Image

from .comparison import Comparison, Metric, Verdict, aligned, checked_pixels
from .tile_statistics import median_nonblack, relative_mse, same_shape, welch
from .welch import spreads, welch_images

__all__ = ["METHODS", "Comparison", "Image", "Method", "Metric", "Option", "Paired", "Verdict", "automatic", "compare"]
__all__ += [
    "exact",
    "flip",
    "paired",
    "paired_images",
    "relative_mse",
    "tolerance",
    "welch",
    "welch_images",
]
__all__ += ["encoding", "flip_map"]

RGB = ("R", "G", "B")
ROWS = 16  # every so many show whether a method would see that an image is black
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear Rec. 709


def exact(reference: Image, test: Image, *, allow_nonfinite: bool = False) -> Comparison:
    """Every value is the same."""
    a, b, found = checked_pixels("exact", reference, test, allow_nonfinite)
    if found:
        return found
    difference = _difference(a, b)
    changed = int((a != b).any(-1).sum())
    verdict = Verdict.DIFFERENT if changed else Verdict.EQUAL
    reason = f"{changed} of {a[..., 0].size} pixels differ" if changed else "every value is the same"
    figures = (Metric("changed pixels", changed, 0.0), Metric("largest difference", float(difference.max()), 0.0))
    return Comparison("exact", verdict, reason, figures, 0.0, {"difference": difference})


def tolerance(
    reference: Image,
    test: Image,
    *,
    allow_nonfinite: bool = False,
    fail: Annotated[float, "a value may differ by this much"] = 0.004,
    fail_relative: Annotated[float, "or by this share of the mean of both"] = 0.001,
    fail_percent: Annotated[float, "of the pixels, this many percent may differ by more"] = 0.02,
    hard_fail: Annotated[float, "no value may differ by more than this"] = np.inf,
    warn: Annotated[float, "a difference worth a warning"] = np.inf,
    warn_relative: Annotated[float, "or this share of the mean of both"] = 0.0,
    warn_percent: Annotated[float, "of the pixels, this many percent may differ so without one"] = 0.0,
    hard_warn: Annotated[float, "any value that differs by more is worth one"] = np.inf,
) -> Comparison:
    """Differences within absolute and relative thresholds, but for a share of the pixels: the meaning of `idiff`."""
    _not_negative(locals())
    a, b, found = checked_pixels("tolerance", reference, test, allow_nonfinite)
    if found:
        return found
    # Not OpenImageIO's own `compare`: it rounds to float32, and what that does not hold would be equal.
    with np.errstate(over="ignore"):
        difference = np.abs(b - a)
        maps = {"difference": difference.astype(np.float32, copy=False)}
    failed, warned = (_percent(difference, a, b, *x) for x in ((fail, fail_relative), (warn, warn_relative)))
    largest = float(difference.max())
    figures = (
        Metric("pixels beyond the tolerance, %", failed, fail_percent),
        Metric("largest difference", largest, hard_fail),
        Metric("mean difference", float(difference.mean(dtype=np.float64))),
        Metric("RMS difference", float(np.sqrt(np.einsum("ijk,ijk->", *2 * [difference], dtype=float) / a.size))),
        Metric("pixels worth a warning, %", warned),
    )
    reason = f"{failed:.3g} % of the pixels beyond the tolerance; largest difference {largest:.3g}"
    if largest:
        y, x, _ = np.unravel_index(int(difference.argmax()), difference.shape)
        reason += f" at x = {x + reference.origin[0]}, y = {y + reference.origin[1]}"
    if warned > warn_percent or largest > hard_warn:
        reason += f"; warning: {warned:.3g} % of the pixels"
    return Comparison("tolerance", _verdict(figures), reason, figures, maps=maps)


def paired_images(
    reference: Image,
    test: Image,
    *,
    allow_nonfinite: bool = False,
    threshold: Annotated[float, "a pixel is changed where a channel differs by more than this share"] = 1e-4,
    changed: Annotated[float, "share of the pixels that may be changed"] = 0.001,
    largest: Annotated[float, "largest change that is allowed, as a share"] = 100.0,
) -> Comparison:
    """Renders of the same random numbers: the share of changed pixels and the largest change.

    Changes are relative to the reference's value, or to the median of its channel where that is larger, black left out.
    """
    _not_negative(locals())
    a, b, found = checked_pixels("paired", reference, test, allow_nonfinite)
    if found:
        return found
    floor = median_nonblack(np.abs(a))
    scale = np.maximum(np.abs(a), np.where(floor > 0, floor, floor.mean() or median_nonblack(np.abs(b)).mean() or 1.0))
    measured = paired(a / scale, b / scale, threshold)
    figures = (
        Metric("share of changed pixels", measured.changed, changed),
        Metric("largest change", measured.largest, largest),
        Metric("RMS change", measured.rmse),
        Metric("ratio of the means", _mean_ratio(a, b)),
    )
    reason = f"{measured.changed:.3%} of the pixels are changed, the largest by {measured.largest:.3g} of its value"
    maps = {"difference": _difference(a, b)}
    return Comparison("paired", _verdict(figures), reason, figures, maps=maps)


def flip(
    reference: Image,
    test: Image,
    *,
    allow_nonfinite: bool = False,
    mean: Annotated[float, "mean FLIP error that is allowed, 0 to 1"] = 0.01,
    largest: Annotated[float, "FLIP error that no pixel may exceed, 0 to 1"] = 1.0,
    hdr: Annotated[str, "auto (by the file's format), yes or no"] = "auto",
    ppd: Annotated[float, "pixels per degree of the viewer's field"] = 67.0,
) -> Comparison:
    """What a person who flips between the two would see: FLIP, for LDR and HDR images."""
    _not_negative(locals())
    if hdr not in ("auto", "yes", "no"):
        raise ValueError(f"hdr = {hdr!r}: accepted: auto, yes, no")
    if not 1 <= ppd <= 1000:  # below, its filters see nothing; above, they are larger than any image
        raise ValueError(f"ppd = {ppd}: accepted: 1 to 1000")
    _, _, found = checked_pixels("flip", reference, test, allow_nonfinite)
    if found:
        return found
    wide = hdr == "yes" or (hdr == "auto" and "linear" in (encoding(reference), encoding(test)))
    error = flip_map(reference, test, wide, ppd)
    figures = (
        Metric("mean FLIP error", float(error.mean()), mean),
        Metric("largest FLIP error", float(error.max()), largest),
        Metric("99th percentile of the FLIP error", float(np.percentile(error, 99))),
    )
    reason = f"mean FLIP error {error.mean():.3g}, largest {error.max():.3g} ({'HDR' if wide else 'LDR'})"
    if ignored := [name for name in reference.channels if name not in _colours(reference)]:
        reason += f"; not looked at: {', '.join(ignored)}"
    return Comparison("flip", _verdict(figures), reason, figures, maps={"flip": error})


def flip_map(reference: Image, test: Image, hdr: bool, ppd: float = 67.0) -> np.ndarray:
    """FLIP error of every pixel, H × W float32 from 0 to 1, of the channels R, G, B, or of images with one channel.

    HDR looks at the image at the exposures between the reference's median luminance, black left out, and that of its
    brightest thousandth, one FLIP for each. ValueError for images without these channels.
    """
    import OpenImageIO as oiio

    linear = [_linear(image) for image in (reference, test)]
    light = linear[0] @ LUMINANCE
    lit = light[light > 0]
    # Not the very largest: one firefly would ask for many exposures at which all else is black.
    median, brightest = map(float, np.quantile(lit, (0.5, 0.999))) if lit.size else (0.18, 2.0)
    one, two = map(_buffer, linear)
    found = oiio.ImageBufAlgo.FLIP_diff(one, two, int(hdr), brightest, median, ppd)
    if found.has_error:
        raise ValueError(f"{test.path}: FLIP: {found.geterror()}")
    return np.asarray(found.get_pixels(), np.float32)[..., 0]


def encoding(image: Image) -> str:
    """ "sRGB" for the formats of displays, by the file's own word or its type; else "linear"."""
    space = str(image.metadata.get("oiio:ColorSpace", ""))
    return "sRGB" if "srgb" in space.lower() and not space.lower().startswith("lin") else "linear"


def _linear(image: Image) -> np.ndarray:
    names = _colours(image)
    if names != RGB and len(names) != 1:
        raise ValueError(f"{image.path}: channels {', '.join(names)}; accepted by FLIP: R, G, B, or one")
    pixels = np.nan_to_num(image.select(names), nan=0.0, posinf=0.0, neginf=0.0)
    if np.abs(pixels).max() > np.finfo(np.float32).max:
        raise ValueError(f"{image.path}: values beyond those of float32; accepted by FLIP: up to 3.4e38")
    pixels = pixels.astype(np.float32, copy=False)
    if encoding(image) == "sRGB":
        pixels = np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)))


def _colours(image: Image) -> tuple[str, ...]:
    return RGB if set(RGB) <= set(image.channels) else image.channels


def _difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        difference = b - a
        return np.abs(difference, out=difference).astype(np.float32, copy=False)


def _percent(difference: np.ndarray, a: np.ndarray, b: np.ndarray, most: float, share: float) -> float:
    """Of the pixels, those with a channel that differs by more than `most`, and than that share of the mean of both."""
    pixels = np.flatnonzero((difference > most).any(-1))  # few: the rest is cheaper there
    x, y, z = (each.reshape(-1, a.shape[2])[pixels] for each in (difference, a, b))
    return 100 * int((x > np.maximum(most, share * (np.abs(y) / 2 + np.abs(z) / 2))).any(-1).sum()) / a[..., 0].size


def _buffer(pixels: np.ndarray) -> Any:
    import OpenImageIO as oiio

    return oiio.ImageBuf(np.ascontiguousarray(pixels))


def _verdict(figures: Sequence[Metric]) -> Verdict:
    return Verdict.EQUAL if all(figure.holds for figure in figures) else Verdict.DIFFERENT


def _not_negative(options: dict[str, Any]) -> None:
    for name, value in options.items():
        if isinstance(value, float) and not value >= 0:
            raise ValueError(f"{name} = {value}: accepted: a number of at least 0")


@dataclass(frozen=True)
class Option:
    """A keyword argument of a method."""

    name: str
    type: type
    default: Any
    help: str


@dataclass(frozen=True)
class Method:
    """`samples`: takes a sequence of independent renders on either side instead of one image."""

    function: Callable[..., Comparison]
    samples: bool = False

    @property
    def summary(self) -> str:
        return (self.function.__doc__ or "").partition("\n")[0]

    @property
    def options(self) -> dict[str, Option]:
        """The keyword arguments but `allow_nonfinite`, which every method has."""
        hints = typing.get_type_hints(self.function, include_extras=True)
        given = inspect.signature(self.function).parameters
        return {
            name: Option(name, typing.get_args(hint)[0], given[name].default, hint.__metadata__[0])
            for name, hint in hints.items()
            if typing.get_origin(hint) is Annotated
        }

    def checked(self, method: str, name: str, value: Any) -> Any:
        """The value of an option; ValueError for an unknown name or a value of another type."""
        if name not in self.options:
            raise ValueError(f"{method} has no option {name!r}; accepted: {', '.join(self.options) or 'none'}")
        kind = self.options[name].type
        if isinstance(value, bool) or not isinstance(value, (int, float) if kind is float else kind):
            raise ValueError(f"{method}: {name} = {value!r}: accepted: a value of type {kind.__name__}")
        return kind(value)


METHODS = {
    "exact": Method(exact),
    "tolerance": Method(tolerance),
    "paired": Method(paired_images),
    "welch": Method(welch_images, samples=True),
    "flip": Method(flip),
}


def compare(
    method: str,
    reference: Image | Sequence[Image],
    test: Image | Sequence[Image],
    *,
    allow_nonfinite: bool = False,
    **options: Any,
) -> Comparison:
    """One comparison by the table; "auto" is welch where it can be, else tolerance.

    ValueError for an unknown method or option, an option of another type or out of its range, several renders for a
    method that takes one, and images that cannot be compared.
    """
    method = automatic(reference, test) if method == "auto" else method
    if method not in METHODS:
        raise ValueError(f"method {method!r}: accepted: auto, {', '.join(METHODS)}")
    chosen = METHODS[method]
    checked = {name: chosen.checked(method, name, value) for name, value in options.items()}
    if allow_nonfinite:
        checked["allow_nonfinite"] = True
    sides = [[side] if isinstance(side, Image) else list(side) for side in (reference, test)]
    if not all(sides):
        raise ValueError(f"{method}: no image on one side; accepted: at least one")
    if chosen.samples:
        return chosen.function(*sides, **checked)
    if [len(side) for side in sides] != [1, 1]:
        raise ValueError(f"{method}: {len(sides[0])} and {len(sides[1])} images; accepted: one a side")
    found = chosen.function(sides[0][0], sides[1][0], **checked)
    if found.verdict is Verdict.EQUAL and _blind(chosen.function, sides[0][0], sides[1][0], checked):
        reason = f"an all-black image would pass, too, with these options; {found.reason}"
        return replace(found, verdict=Verdict.INCONCLUSIVE, reason=reason)
    return found


def _blind(method: Callable[..., Comparison], reference: Image, test: Image, options: dict[str, Any]) -> bool:
    """Whether the method would see no difference if the test were black. Never where both are the same, or black."""
    a, b = aligned(reference, test)
    if options.get("allow_nonfinite"):
        a, b = np.nan_to_num(a, posinf=0, neginf=0), np.nan_to_num(b, posinf=0, neginf=0)
    if not a.any() or np.array_equal(a, b):
        return False

    def black_is_equal(a: np.ndarray) -> bool:
        one, other = replace(reference, pixels=a), replace(reference, pixels=np.zeros_like(a))
        return method(one, other, **options).verdict is Verdict.EQUAL

    # Where it would be seen in some of the rows, the others need not be asked: this is to cost little.
    return black_is_equal(a[::ROWS]) and black_is_equal(a)


def automatic(reference: Image | Sequence[Image], test: Image | Sequence[Image]) -> str:
    """The method for these: welch where there are several renders a side, or variance channels; else tolerance."""
    sides = [[side] if isinstance(side, Image) else side for side in (reference, test)]
    if any(len(side) > 1 for side in sides) or all(spreads(side[0].channels) for side in sides if side):
        return "welch"
    return "tolerance"


@dataclass(frozen=True)
class Paired:
    """Two images of the same random numbers: share of changed pixels, largest change, RMSE, ratio of the means."""

    changed: float
    largest: float
    rmse: float
    mean_ratio: float


def paired(reference: np.ndarray, test: np.ndarray, threshold: float) -> Paired:
    """A pixel is changed where any channel differs by more than `threshold`, or is not finite."""
    same_shape(reference, test)
    with np.errstate(invalid="ignore"):
        difference = np.abs(test - reference).max(-1)
    finite = np.isfinite(test).all(-1) & np.isfinite(reference).all(-1)
    changed = float((~(difference <= threshold) | ~finite).mean())
    if not finite.all():
        return Paired(changed, np.inf, np.inf, np.nan)
    return Paired(
        changed,
        float(difference.max()),
        float(np.sqrt(np.square(test - reference).mean())),
        _mean_ratio(reference, test),
    )


def _mean_ratio(reference: np.ndarray, test: np.ndarray) -> float:
    one, two = (float(x.mean(dtype=np.float64)) for x in (reference, test))
    return two / one if one else 1.0 + two
