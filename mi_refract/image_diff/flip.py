"""FLIP: what a person who flips between two images would see.

Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020, and "Visualizing the Error in
Rendered High Dynamic Range Images", Eurographics Short Papers 2021; computed by OpenImageIO.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels, srgb_decode

from .comparison import Comparison, Metric, Verdict, checked_pixels, verdict_of
from .pixelwise import require_nonnegative
from .tolerance import tolerance, tolerance_passes_black

PIXELS_PER_DEGREE = 67.0  # of the viewer's field: FLIP's default, a screen of 0.7 m and 3840 pixels at 0.7 m
RGB = ("R", "G", "B")
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear Rec. 709


def flip(
    reference: Image,
    test: Image,
    *,
    allow_nonfinite: bool = False,
    mean: Annotated[float, "mean FLIP error that is allowed, 0 to 1"] = 0.01,
    largest: Annotated[float, "FLIP error that no pixel may exceed, 0 to 1"] = 1.0,
    hdr: Annotated[str, "auto (by the file's format), yes or no"] = "auto",
    ppd: Annotated[float, "pixels per degree of the viewer's field"] = PIXELS_PER_DEGREE,
) -> Comparison:
    """The differences that a person flipping between the images would see: FLIP, for LDR and HDR images.

    Channels other than R, G, B are compared by `tolerance` with its defaults.
    """
    require_nonnegative(locals())
    if hdr not in ("auto", "yes", "no"):
        raise ValueError(f"hdr = {hdr!r}: accepted: auto, yes, no")
    if not 1 <= ppd <= 1000:  # below, its filters see nothing; above, they are larger than any image
        raise ValueError(f"ppd = {ppd}: accepted: 1 to 1000")
    _, _, found = checked_pixels("flip", reference, test, allow_nonfinite)
    if found:
        return found
    wide = is_hdr(reference, test, hdr)
    error = flip_map(reference, test, wide, ppd)
    metrics = (
        Metric("mean FLIP error", float(error.mean()), mean),
        Metric("largest FLIP error", float(error.max()), largest),
        Metric("99th percentile of the FLIP error", float(np.percentile(error, 99))),
    )
    reason = f"mean FLIP error {error.mean():.3g}, largest {error.max():.3g} ({'HDR' if wide else 'LDR'})"
    found = Comparison("flip", verdict_of(metrics), reason, metrics, maps={"flip": error})
    others = tuple(name for name in reference.channels if name not in _colours(reference))
    return _with_others(found, _only(reference, others), _only(test, others), allow_nonfinite) if others else found


def _only(image: Image, channels: tuple[str, ...]) -> Image:
    return replace(image, pixels=image.select(channels), channels=channels)


def _with_others(found: Comparison, reference: Image, test: Image, allow_nonfinite: bool) -> Comparison:
    """FLIP's comparison with that of the channels that it does not look at."""
    names = ", ".join(reference.channels)
    if np.array_equal(reference.pixels, test.pixels, equal_nan=True):
        return replace(found, reason=f"{found.reason}; not looked at, but the same: {names}")
    others = tolerance(reference, test, allow_nonfinite=allow_nonfinite)
    metrics = (*found.metrics, replace(others.metrics[0], name=f"{others.metrics[0].name}, in {names}"))
    verdict, reason = verdict_of(metrics), f"{found.reason}; by tolerance {names}: {others.reason}"
    if verdict is Verdict.EQUAL and tolerance_passes_black(reference, tolerance.__kwdefaults__ or {}):
        verdict, reason = Verdict.INCONCLUSIVE, f"{reason}, as would be if they were black"
    return replace(found, verdict=verdict, reason=reason, metrics=metrics)


def flip_passes_black(reference: Image, options: Mapping[str, Any]) -> bool:
    """Whether `flip` would call a black test image equal to `reference`; `options`: all of them, by name."""
    black = replace(reference, pixels=np.zeros_like(reference.pixels))
    error = flip_map(reference, black, is_hdr(reference, black, options["hdr"]), options["ppd"])
    return bool(error.mean() <= options["mean"] and error.max() <= options["largest"])


def is_hdr(reference: Image, test: Image, hdr: str = "auto") -> bool:
    """Whether FLIP looks at the images as HDR; "auto": where either is linear."""
    return hdr == "yes" or (hdr == "auto" and "linear" in (encoding(reference), encoding(test)))


def flip_map(reference: Image, test: Image, hdr: bool, ppd: float = PIXELS_PER_DEGREE) -> Pixels:
    """FLIP error of every pixel, H × W float32 from 0 to 1, of the channels R, G, B, or of images with one channel.

    HDR looks at the image at the exposures between the reference's median luminance, without black pixels, and that of
    its brightest thousandth, one FLIP for each. ValueError for images without these channels.
    """
    import OpenImageIO as oiio

    linear = [_linear(image) for image in (reference, test)]
    light = linear[0] @ LUMINANCE
    lit = light[light > 0]
    # Not the very largest: one firefly would ask for many exposures at which all else is black.
    median, brightest = map(float, np.quantile(lit, (0.5, 0.999))) if lit.size else (0.18, 2.0)
    one, two = (oiio.ImageBuf(pixels) for pixels in linear)
    found = oiio.ImageBufAlgo.FLIP_diff(one, two, int(hdr), brightest, median, ppd)
    if found.has_error:
        raise ValueError(f"{test.path}: FLIP: {found.geterror()}")
    error: Pixels = np.asarray(found.get_pixels(), np.float32)[..., 0]
    return error


def encoding(image: Image) -> str:
    """ "sRGB" for the formats of displays, by the file's own word or its type; else "linear"."""
    space = str(image.metadata.get("oiio:ColorSpace", ""))
    return "sRGB" if "srgb" in space.lower() and not space.lower().startswith("lin") else "linear"


def _linear(image: Image) -> Pixels:
    """Linear H × W × 3 float32; values that are not finite become 0."""
    names = _colours(image)
    if names != RGB and len(names) != 1:
        raise ValueError(f"{image.path}: channels {', '.join(names)}; accepted by FLIP: R, G, B, or one")
    pixels = np.nan_to_num(image.select(names), nan=0.0, posinf=0.0, neginf=0.0)
    if np.abs(pixels).max() > np.finfo(np.float32).max:
        raise ValueError(f"{image.path}: values beyond those of float32; accepted by FLIP: up to 3.4e38")
    pixels = pixels.astype(np.float32, copy=False)
    if encoding(image) == "sRGB":
        pixels = srgb_decode(pixels).astype(np.float32)
    return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)))


def _colours(image: Image) -> tuple[str, ...]:
    return RGB if set(RGB) <= set(image.channels) else image.channels
