"""Are two pictures the same? Gates first, then one of five methods; each gives a verdict with its numbers.

Fails closed: what cannot be compared is an error, a value that is not finite equals nothing, and a method that could
not have seen a difference says "inconclusive".
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from .images import Image
from .judgement import Comparison, Figure, Verdict, entered, gates
from .samples import spreads, welch_images
from .tiles import relative_mse, same_shape, welch

__all__ = ["METHODS", "Comparison", "Figure", "Image", "Method", "Option", "Paired", "Verdict", "automatic", "compare"]
__all__ += ["exact", "flip", "gates", "paired", "paired_images", "relative_mse", "tolerance", "welch", "welch_images"]
__all__ += ["encoding", "flip_map"]

RGB = ("R", "G", "B")
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear Rec. 709


def exact(reference: Image, test: Image, *, allow_nonfinite: bool = False) -> Comparison:
    """Every value is the same."""
    a, b, found = entered("exact", reference, test, allow_nonfinite)
    if found:
        return found
    difference = _difference(a, b)
    changed = int((a != b).any(-1).sum())
    verdict = Verdict.DIFFERENT if changed else Verdict.EQUAL
    reason = f"{changed} of {a[..., 0].size} pixels differ" if changed else "every value is the same"
    figures = (Figure("changed pixels", changed, 0.0), Figure("largest difference", float(difference.max()), 0.0))
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
    a, b, found = entered("tolerance", reference, test, allow_nonfinite)
    if found:
        return found
    import OpenImageIO as oiio

    result = oiio.ImageBufAlgo.compare(_buffer(a), _buffer(b), fail, warn, fail_relative, warn_relative)
    size = a[..., 0].size
    failed, warned = 100 * result.nfail / size, 100 * result.nwarn / size
    figures = (
        Figure("pixels beyond the tolerance, %", failed, fail_percent),
        Figure("largest difference", result.maxerror, hard_fail),
        Figure("mean difference", result.meanerror),
        Figure("RMS difference", result.rms_error),
        Figure("pixels worth a warning, %", warned),
    )
    reason = f"{failed:.3g} % of the pixels beyond the tolerance; largest difference {result.maxerror:.3g}"
    if result.maxerror:
        reason += f" at x = {result.maxx + reference.origin[0]}, y = {result.maxy + reference.origin[1]}"
    if warned > warn_percent or result.maxerror > hard_warn:
        reason += f"; warning: {warned:.3g} % of the pixels"
    maps = {"difference": _difference(a, b)}
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

    Changes are relative to the reference's value, or to the mean of its channel where that is larger.
    """
    _not_negative(locals())
    a, b, found = entered("paired", reference, test, allow_nonfinite)
    if found:
        return found
    usual = np.abs(a).mean((0, 1))
    scale = np.maximum(np.abs(a), np.where(usual > 0, usual, usual.mean() or 1.0))
    measured = paired(a / scale, b / scale, threshold)
    figures = (
        Figure("share of changed pixels", measured.changed, changed),
        Figure("largest change", measured.largest, largest),
        Figure("RMS change", measured.rmse),
        Figure("ratio of the means", float(b.mean() / a.mean()) if a.any() else 1.0 + float(b.mean())),
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
    """What a person who flips between the two would see: FLIP, for LDR and HDR pictures."""
    _not_negative(locals())
    if hdr not in ("auto", "yes", "no"):
        raise ValueError(f"hdr = {hdr!r}: accepted: auto, yes, no")
    _, _, found = entered("flip", reference, test, allow_nonfinite)
    if found:
        return found
    wide = hdr == "yes" or (hdr == "auto" and "linear" in (encoding(reference), encoding(test)))
    error = flip_map(reference, test, wide, ppd)
    figures = (
        Figure("mean FLIP error", float(error.mean()), mean),
        Figure("largest FLIP error", float(error.max()), largest),
        Figure("99th percentile of the FLIP error", float(np.percentile(error, 99))),
    )
    reason = f"mean FLIP error {error.mean():.3g}, largest {error.max():.3g} ({'HDR' if wide else 'LDR'})"
    if ignored := [name for name in reference.channels if name not in _colours(reference)]:
        reason += f"; not looked at: {', '.join(ignored)}"
    return Comparison("flip", _verdict(figures), reason, figures, maps={"flip": error})


def flip_map(reference: Image, test: Image, hdr: bool, ppd: float = 67.0) -> np.ndarray:
    """FLIP error of every pixel, H × W float32 from 0 to 1, of the channels R, G, B, or of pictures with one channel.

    HDR looks at the picture at the exposures between the reference's median and largest luminance, one FLIP for each.
    ValueError for pictures without these channels.
    """
    import OpenImageIO as oiio

    linear = [_linear(image) for image in (reference, test)]
    light = linear[0] @ LUMINANCE
    lit = light[light > 1e-4 * light.max()]  # the rest is black at every exposure, and would ask for many of them
    median, brightest = (float(np.median(lit)), float(lit.max())) if lit.size else (0.18, 2.0)
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
    pixels = np.nan_to_num(image.select(names).astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    if encoding(image) == "sRGB":
        pixels = np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)))


def _colours(image: Image) -> tuple[str, ...]:
    return RGB if set(RGB) <= set(image.channels) else image.channels


def _difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    difference = b - a
    return np.abs(difference, out=difference).astype(np.float32, copy=False)


def _buffer(pixels: np.ndarray) -> Any:
    import OpenImageIO as oiio

    return oiio.ImageBuf(np.ascontiguousarray(pixels))


def _verdict(figures: Sequence[Figure]) -> Verdict:
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
    """`samples`: takes a sequence of independent renders on either side instead of one picture."""

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
    method that takes one, and pictures that cannot be compared.
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
        raise ValueError(f"{method}: no picture on one side; accepted: at least one")
    if chosen.samples:
        return chosen.function(*sides, **checked)
    if [len(side) for side in sides] != [1, 1]:
        raise ValueError(f"{method}: {len(sides[0])} and {len(sides[1])} pictures; accepted: one a side")
    return chosen.function(sides[0][0], sides[1][0], **checked)


def automatic(reference: Image | Sequence[Image], test: Image | Sequence[Image]) -> str:
    """The method for these: welch where there are several renders a side, or variance channels; else tolerance."""
    sides = [[side] if isinstance(side, Image) else side for side in (reference, test)]
    if any(len(side) > 1 for side in sides) or all(spreads(side[0].channels) for side in sides if side):
        return "welch"
    return "tolerance"


@dataclass(frozen=True)
class Paired:
    """Two pictures of the same random numbers: share of changed pixels, largest change, RMSE, ratio of the means."""

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
    return Paired(changed, float(difference.max()), float(np.sqrt(np.square(test - reference).mean())),
                  float(test.mean() / reference.mean()) if reference.any() else 1.0 + float(test.mean()))  # fmt: skip
