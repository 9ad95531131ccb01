"""FLIP: what a person who flips between two images would see.

Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020, and "Visualizing the Error in
Rendered High Dynamic Range Images", Eurographics Short Papers 2021; computed by OpenImageIO.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels, block_mean, srgb_decode

from .comparison import Comparison, Metric, Verdict, passes_black, verdict_of
from .local_error import WINDOW, local_error, patch_error
from .pixelwise import require_nonnegative
from .tolerance import tolerance

PIXELS_PER_DEGREE = 67.0  # of the viewer's field: FLIP's default, a screen of 0.7 m and 3840 pixels at 0.7 m
RGB = ("R", "G", "B")
ALPHA = "A"
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear Rec. 709
# Half of the largest error, on average over a letter: above a black edge on white that moves by one pixel (0.45), below
# a white line one pixel wide on black that vanishes (0.65). `validation.diff.visible_changes` measures these and more.
LOCAL = 0.5
PATCH = 0.12  # 7 to 10 of 255 codes of gray; no antialiasing that was tried fills a patch with two thirds of it
CODED = re.compile(r"srgb|gamma|^g\d\d")  # colour spaces, in OpenImageIO's words, of what a display is sent
LINEAR = re.compile(r"^lin|linear|^aces|^raw$|^data$")
INTEGERS = ("uint8", "uint16")  # a file of these that names no colour space holds what a display is sent
DARKER = 4.0  # two stops: where the brightest light is shown nearly white, light twice as bright is, too
AROUND = 0.5  # degrees: where black is seen so near to the brightest window, the rest need not be looked at

Options = Mapping[str, Any]  # all options of `flip`, by name


def flip(
    reference: Image,
    test: Image,
    *,
    local: Annotated[
        float, "mean FLIP error allowed in any square of 0.12 degrees, 0 to 1; less in wider squares"
    ] = LOCAL,
    patch: Annotated[float, "FLIP error that may fill a square of 0.24 degrees, 0 to 1"] = PATCH,
    largest: Annotated[float, "FLIP error that no pixel may exceed, 0 to 1"] = 1.0,
    hdr: Annotated[str, "auto (by the file's format), yes or no"] = "auto",
    ppd: Annotated[float, "pixels per degree of the viewer's field"] = PIXELS_PER_DEGREE,
) -> Comparison:
    """The differences that a person flipping between the images would see: FLIP, for LDR and HDR images.

    The verdict is that of the worst window, see `local_error`. Alpha is looked at as a gray image; any other channels
    than R, G, B are compared by `tolerance` with its defaults.
    """
    options: Options = {"local": local, "patch": patch, "largest": largest, "hdr": hdr, "ppd": ppd}
    require_nonnegative(options)
    if hdr not in ("auto", "yes", "no"):
        raise ValueError(f"hdr = {hdr!r}; expected auto, yes, no")
    if not 1 <= ppd <= 1000:  # below, its filters see nothing; above, they are larger than any image
        raise ValueError(f"ppd = {ppd}; expected 1 to 1000")
    result = _of_colours(reference, test, options)
    others = [name for name in reference.channels if name not in _colours(reference)]
    for names in filter(None, ([n for n in others if n == ALPHA], [n for n in others if n != ALPHA])):
        result = _with_others(result, _only(reference, names), _only(test, names), options)
    return result


def _of_colours(reference: Image, test: Image, options: Options) -> Comparison:
    """What FLIP sees in the colours."""
    wide = is_hdr(reference, test, options["hdr"])
    error = flip_map(reference, test, wide, options["ppd"])
    (worst, around), patch = local_error(error, options["ppd"]), patch_error(error, options["ppd"])
    metrics = (
        Metric("local FLIP error", worst.value, options["local"]),
        Metric("FLIP error throughout a patch", patch.value, options["patch"]),
        Metric("largest FLIP error", float(error.max()), options["largest"]),
        Metric("mean FLIP error", float(error.mean())),
        Metric("99th percentile of the FLIP error", float(np.percentile(error, 99))),
    )
    reason = f"local FLIP error {worst.value:.3g}, largest {error.max():.3g} ({'HDR' if wide else 'LDR'})"
    if worst.value:
        kind, window = ("mean", worst) if metrics[1].holds or not metrics[0].holds else ("at least", patch)
        x, y = window.x + reference.origin[0], window.y + reference.origin[1]
        reason += f"; {kind} {window.error:.3g} in {window.width} × {window.height} pixels from x = {x}, y = {y}"
    return Comparison("flip", verdict_of(metrics), reason, metrics, maps={"flip": error, "local": around})


def _with_others(result: Comparison, reference: Image, test: Image, options: Options) -> Comparison:
    """FLIP's comparison with that of the channels, alpha or others, that it does not look at."""
    names = ", ".join(reference.channels)
    if np.array_equal(reference.pixels, test.pixels, equal_nan=True):
        return replace(result, reason=f"{result.reason}; not compared by FLIP, but identical: {names}")
    coverage = all(bool(((x.pixels >= 0) & (x.pixels <= 1)).all()) for x in (reference, test))
    if reference.channels == (ALPHA,) and coverage:
        reference, test = (replace(image, metadata={"oiio:ColorSpace": "sRGB"}) for image in (reference, test))
        options = {**options, "hdr": "no"}
        others, method, black = _of_colours(reference, test, options), "FLIP", passes_black(flip, [reference], options)
        bounded, maps = others.metrics[:3], {f"flip of {ALPHA}": others.maps["flip"]}
    else:
        others, method, black = tolerance(reference, test), "tolerance", passes_black(tolerance, [reference], {})
        bounded, maps = others.metrics[:1], {}
    metrics = (*result.metrics, *(replace(metric, name=f"{metric.name}, in {names}") for metric in bounded))
    verdict, reason = verdict_of(metrics), f"{result.reason}; by {method} {names}: {others.reason}"
    if verdict is Verdict.EQUAL and black:
        verdict, reason = Verdict.INCONCLUSIVE, f"{reason}, but black would pass as well"
    return replace(result, verdict=verdict, reason=reason, metrics=metrics, maps=result.maps | maps)


def views(image: Image, options: Options) -> Iterator[Image]:
    """The colours around the brightest window, where black is seen first, and all of them."""
    image = _only(image, _colours(image))
    side, around = max(1, round(WINDOW * options["ppd"])), max(1, round(AROUND * options["ppd"]))
    light = block_mean(_linear(image), side).sum(-1)
    y, x = (side * int(i) for i in np.unravel_index(int(light.argmax()), light.shape))
    rows, columns = (slice(max(at - around, 0), at + side + around) for at in (y, x))
    yield replace(image, pixels=image.pixels[rows, columns])
    yield image


def _only(image: Image, channels: Sequence[str]) -> Image:
    return replace(image, pixels=image.select(channels), channels=tuple(channels))


def is_hdr(reference: Image, test: Image, hdr: str = "auto") -> bool:
    """Whether FLIP looks at the images as HDR; "auto": where either is linear."""
    return hdr == "yes" or (hdr == "auto" and "linear" in (encoding(reference), encoding(test)))


def flip_map(reference: Image, test: Image, hdr: bool, ppd: float = PIXELS_PER_DEGREE) -> Pixels:
    """FLIP error of every pixel, H × W float32 from 0 to 1, of the channels R, G, B, or of one that is alone.

    HDR looks at the image at the exposures between the reference's median luminance, without black pixels, and DARKER
    times that of its brightest thousandth, one FLIP for each. ValueError for images without these channels.
    """
    import OpenImageIO as oiio

    linear = [_linear(image) for image in (reference, test)]
    light = linear[0] @ LUMINANCE
    lit = light[light > 0]
    # Not the very largest: one firefly would need many exposures at which all else is black.
    median, brightest = map(float, np.quantile(lit, (0.5, 0.999))) if lit.size else (0.18, 2.0)
    one, two = (oiio.ImageBuf(pixels) for pixels in linear)
    result = oiio.ImageBufAlgo.FLIP_diff(one, two, int(hdr), DARKER * brightest, median, ppd)
    if result.has_error:
        raise ValueError(f"{test.path}: FLIP: {result.geterror()}")
    error: Pixels = np.asarray(result.get_pixels(), np.float32)[..., 0]
    return error


def encoding(image: Image) -> str:
    """ "sRGB" for what a display is sent, by the file's own word, or its type where it says nothing; else "linear"."""
    space = str(image.metadata.get("oiio:ColorSpace", "")).lower()
    if LINEAR.search(space):
        return "linear"
    return "sRGB" if CODED.search(space) or image.stored in INTEGERS else "linear"


def _linear(image: Image) -> Pixels:
    """Linear H × W × 3 float32; values that are not finite become 0."""
    names = _colours(image)
    if names != RGB and len(names) != 1:
        raise ValueError(f"{image.path}: channels {', '.join(names)}; FLIP needs R, G, B, or a single channel")
    pixels = np.nan_to_num(image.select(names), nan=0.0, posinf=0.0, neginf=0.0)
    if np.abs(pixels).max() > np.finfo(np.float32).max:
        raise ValueError(f"{image.path}: values exceed the range of float32, in which FLIP computes (3.4e38)")
    pixels = pixels.astype(np.float32, copy=False)
    if encoding(image) == "sRGB":
        pixels = srgb_decode(pixels).astype(np.float32)
    return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)))


def _colours(image: Image) -> tuple[str, ...]:
    """R, G, B; else every channel but alpha."""
    return RGB if set(RGB) <= set(image.channels) else tuple(n for n in image.channels if n != ALPHA) or image.channels
