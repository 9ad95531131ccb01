"""FLIP: what a person who flips between two images would see, judged by the worst windows of its error map.

Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020, and "Visualizing the Error in
Rendered High Dynamic Range Images", Eurographics Short Papers 2021; computed by OpenImageIO.

What a person sees of a change does not depend on what else is in the image, nor on its place: windows slide by single
pixels. `local_error`: the largest mean in a window, for details. The smallest window is a square of 0.12 degrees of the
viewer's field, 7 arcminutes: a letter of the line 20/30 of an eye chart, so what is read without effort; 8 × 8 pixels
at 67 pixels per degree. Larger windows, each twice as wide, up to 7.7 degrees, are for wide and faint changes. Their
means count more, by the fourth root of the area in units of the smallest: as the threshold of a wide stimulus falls by
probability summation (Robson and Graham, Vision Research 21, 1981). `patch_error`: the error that fills a window of
0.24 degrees, for surfaces. Edges that are drawn otherwise make large errors along lines, and the FLIP error spreads to
0.07 degrees from them; they fill no such window.

`one_way_change`: FLIP blurs what is smaller than a letter, so images for a display are compared once more without it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from mi_refract.io.image_file import Image, Pixels, block_mean, srgb_decode, srgb_encode
from mi_refract.io.text import distinguishable

from .comparison import Comparison, Metric, Range, one_of, only, verdict_of

PIXELS_PER_DEGREE = 67.0  # of the viewer's field: FLIP's default, a screen of 0.7 m and 3840 pixels at 0.7 m
RGB = ("R", "G", "B")
ALPHA = "A"
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear Rec. 709
# Half of the largest error, on average over a letter: above a black edge on white that moves by one pixel (0.45), below
# a white line one pixel wide on black that vanishes (0.65). `validation.diff.visible_changes` measures these and more.
LOCAL = 0.5
PATCH = 0.12  # 7 to 10 of 255 codes of gray; no antialiasing that was tried fills a patch with two thirds of it
# An edge from black to white, blurred by a Gaussian of σ pixels, that moves by half a pixel changes all pixels of a
# 3 × 3 square by at most 255 (Φ(1.25) − Φ(0.75)) = 30.9 codes one way: at σ = 1.
ONE_WAY, SIDE = 31.0, 3
LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # of codes, as in JPEG (BT.601)
CODED = re.compile(r"srgb|gamma|^g\d\d")  # colour spaces, in OpenImageIO's words, of what a display is sent
LINEAR = re.compile(r"^lin|linear|^aces|^raw$|^data$")
INTEGERS = ("uint8", "uint16")  # a file of these that names no colour space holds what a display is sent
DARKER = 4.0  # two stops: where the brightest light is shown nearly white, light twice as bright is, too
DUST = 2.0**-24  # of the bright light of both images, fireflies apart: what is darker is black with rounding errors
BRIGHT = 0.999  # the share of pixels that are darker than what counts as bright
WINDOW, OCTAVES = 0.12, 7  # degrees: the side of the smallest window; how many windows, each twice as wide
SURFACE = 0.24  # degrees: the side of the window that an error fills
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
    one_way: Annotated[
        float,
        "codes of 255 by which all of a 3 × 3 square may change one way, in luma; a single channel by twice as much, "
        "larger squares by less; for LDR images",
    ] = ONE_WAY,
    largest: Annotated[float, "FLIP error that no pixel may exceed, 0 to 1"] = 1.0,
    mean: Annotated[float, "FLIP error allowed on average over the image, 0 to 1"] = 1.0,
    percentile_99: Annotated[float, "FLIP error that 1 % of the pixels may exceed, 0 to 1"] = 1.0,
    hdr: Annotated[str, "auto (by the file's format), yes or no", one_of("auto", "yes", "no")] = "auto",
    # Below 1 its filters see nothing; above 1000 they are larger than any image.
    ppd: Annotated[
        float, "pixels per degree of the viewer's field", Range(lambda x: 1 <= x <= 1000, "1 to 1000")
    ] = PIXELS_PER_DEGREE,
) -> Comparison:
    """The differences that a person flipping between the images would see: FLIP, for LDR and HDR images.

    The verdict is that of the worst window, see `local_error`. Both have the channels R, G, B, or one that is alone:
    an alpha from 0 to 1 is looked at as the gray codes of a display. ValueError for other channels.
    """
    if reference.channels == (ALPHA,) and _is_coverage(reference, test):
        hdr = "no"
        reference, test = (replace(image, metadata={"oiio:ColorSpace": "sRGB"}) for image in (reference, test))
    wide = is_hdr(reference, test, hdr)
    error = flip_map(reference, test, wide, ppd)
    (worst, around), patched = local_error(error, ppd), patch_error(error, ppd)
    changed = one_way_change(_codes(reference), _codes(test), ppd) if not wide else NOWHERE
    metrics = (
        Metric("local FLIP error", worst.value, local),
        Metric("FLIP error throughout a patch", patched.value, patch),
        *([] if wide else [Metric("change one way, in codes", changed.value, one_way)]),
        Metric("largest FLIP error", float(error.max()), largest),
        Metric("mean FLIP error", float(error.mean()), mean),
        Metric("99th percentile of the FLIP error", float(np.percentile(error, 99)), percentile_99),
    )
    reason = f"local FLIP error {worst.value:.3g}, largest {error.max():.3g} ({'HDR' if wide else 'LDR'})"
    if worst.value:
        said, window = f"mean {worst.error:.3g}", worst
        if metrics[0].holds and not metrics[1].holds:
            said, window = f"at least {patched.error:.3g}", patched
        elif metrics[0].holds and changed.value > one_way:
            said, window = f"at least {changed.error:.0f} codes brighter or darker", changed
        x, y = window.x + reference.origin[0], window.y + reference.origin[1]
        reason += f"; {said} in {window.width} × {window.height} pixels from x = {x}, y = {y}"
    for metric, name, most in zip(metrics[-2:], ("mean", "percentile_99"), (mean, percentile_99), strict=True):
        if not metric.holds:
            value, bound = distinguishable(metric.value, most)
            reason = f"{metric.name} {value} > {name} = {bound}; {reason}"
    return Comparison("flip", verdict_of(metrics), reason, metrics, maps={"flip": error, "local": around})


def views(image: Image, options: Options) -> Iterator[Image]:
    """The colours around the brightest window, where black is seen first, and all of them."""
    side, around = max(1, round(WINDOW * options["ppd"])), max(1, round(AROUND * options["ppd"]))
    light = block_mean(_linear(image), side).sum(-1)
    y, x = (side * int(i) for i in np.unravel_index(int(light.argmax()), light.shape))
    rows, columns = (slice(max(at - around, 0), at + side + around) for at in (y, x))
    yield replace(image, pixels=image.pixels[rows, columns])
    yield image


def looks_at(reference: Image, test: Image) -> list[list[str]]:
    """The colours; beside them an alpha from 0 to 1."""
    colours = list(_colours(reference))
    alpha = ALPHA in reference.channels and ALPHA not in colours
    coverage = alpha and _is_coverage(only(reference, [ALPHA]), only(test, [ALPHA]))
    return [colours, *([[ALPHA]] if coverage else [])]


def _is_coverage(*images: Image) -> bool:
    return all(bool(((image.pixels >= 0) & (image.pixels <= 1)).all()) for image in images)


def is_hdr(reference: Image, test: Image, hdr: str = "auto") -> bool:
    """Whether FLIP looks at the images as HDR; "auto": where either is linear."""
    return hdr == "yes" or (hdr == "auto" and "linear" in (encoding(reference), encoding(test)))


def flip_map(reference: Image, test: Image, hdr: bool, ppd: float = PIXELS_PER_DEGREE) -> Pixels:
    """FLIP error of every pixel, H × W float32 from 0 to 1, of the channels R, G, B, or of one that is alone.

    HDR looks at both images at the exposures between the smaller one of their median luminances, without black pixels,
    and DARKER times the larger one of their brightest, one FLIP for each. ValueError for images without these channels.
    """
    import OpenImageIO as oiio

    linear = [_linear(image) for image in (reference, test)]
    one, two = (oiio.ImageBuf(pixels) for pixels in linear)
    brightest, median = _luminances(linear) if hdr else (0.0, 0.0)
    result = oiio.ImageBufAlgo.FLIP_diff(one, two, int(hdr), DARKER * brightest, median, ppd)
    if result.has_error:
        raise ValueError(f"{test.path}: FLIP: {result.geterror()}")
    error: Pixels = np.asarray(result.get_pixels(), np.float32)[..., 0]
    return error


def _luminances(images: Sequence[Pixels]) -> tuple[float, float]:
    """The brightest and the median luminance of two images.

    The brightest is that of a thousandth of the pixels that are not black, or of the brightest line of three pixels.
    Not the very largest: one firefly would need many exposures at which all else is black.
    """
    from scipy.ndimage import rank_filter

    light = [pixels @ LUMINANCE for pixels in images]
    line = max(float(rank_filter(x, -3, 3, mode="constant").max()) for x in light)
    black = DUST * max(line, *(float(np.quantile(x, BRIGHT)) for x in light))
    median = min((float(np.median(x[x > black])) for x in light if (x > black).any()), default=0.18)
    lit = [x[x > 0] for x in light if (x > 0).any()]
    return max(line, *(float(np.quantile(x, BRIGHT)) for x in lit), 0.0) or 2.0, median


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


def _codes(image: Image) -> Pixels:
    """Codes of sRGB, H × W × C, from 0 to 255; of alpha to half of that, its part on average over black and white."""
    white = 127.5 if image.channels == (ALPHA,) else 255.0
    is_coded = encoding(image) == "sRGB"
    values = (np.nan_to_num(image.select(_colours(image))) if is_coded else _linear(image)).clip(0, 1)
    return np.asarray(white * (values if is_coded else srgb_encode(values)))


def _colours(image: Image) -> tuple[str, ...]:
    """R, G, B; else every channel but alpha."""
    return RGB if set(RGB) <= set(image.channels) else tuple(n for n in image.channels if n != ALPHA) or image.channels


# The worst window ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Window:
    """The worst window of an error map, in pixels; `value`: what counts, `error`: its mean, or its smallest error."""

    value: float
    error: float
    x: int
    y: int
    width: int
    height: int


NOWHERE = Window(0.0, 0.0, 0, 0, 0, 0)


def windows(height: int, width: int, ppd: float) -> Iterator[tuple[int, int, float]]:
    """Height and width in pixels of every window in an image of this size, and its weight, at least 1.

    A window is as high and as wide as the image at most: of a smaller image it is the whole.
    """
    for octave in range(OCTAVES):
        side = max(1, round(WINDOW * 2**octave * ppd))
        h, w = min(side, height), min(side, width)
        yield h, w, max(1.0, (h * w / (WINDOW * ppd) ** 2) ** 0.25)
        if side >= max(height, width):
            return


def local_error(error: Pixels, ppd: float) -> tuple[Window, Pixels]:
    """The window with the largest weighted mean of an error map, H × W, and the largest one around every pixel.

    `ppd`: pixels per degree. The weight of the smallest window is 1.
    """
    height, width = error.shape
    sums = np.zeros((height + 1, width + 1))
    np.cumsum(np.cumsum(error, 0, dtype=np.float64), 1, out=sums[1:, 1:])
    around, worst = np.zeros(error.shape, np.float32), []
    for h, w, weight in windows(height, width, ppd):
        means = (sums[h:, w:] - sums[:-h, w:] - sums[h:, :-w] + sums[:-h, :-w]) / (h * w)
        worst.append(_worst(np.maximum(means, 0), weight, w, h))  # a difference of sums may be −1e-16
        # At the centre of each window; next to the border those of the nearest window.
        missing = [(gap // 2, gap - gap // 2) for gap in (h - 1, w - 1)]
        np.maximum(around, np.pad(np.float32(weight) * means.astype(np.float32), missing, mode="edge"), out=around)
    return max(worst, key=lambda window: window.value), around


def patch_error(error: Pixels, ppd: float) -> Window:
    """The window with the largest error that is exceeded in all of it."""
    from scipy.ndimage import minimum_filter

    h, w = (min(max(1, round(SURFACE * ppd)), size) for size in error.shape)
    rows, columns = (slice(k // 2, k // 2 + size - k + 1) for k, size in zip((h, w), error.shape, strict=True))
    return _worst(minimum_filter(error, (h, w))[rows, columns], 1.0, w, h)


def one_way_change(reference: Pixels, test: Pixels, ppd: float) -> Window:
    """The square in which all pixels change the most one way, all brighter or all darker.

    `reference`, `test`: codes, H × W × C. A change is that of luma, or half of that of one channel, as eyes and
    subsampled JPEG files resolve colours half as well. `value`: the smallest change in a square of w = 3 … 8 pixels a
    side, times (w − 1)/2, as an edge that moves by half a pixel changes it by up to 255 φ(1)/(w − 1), at a blur of
    (w − 1)/2 pixels. With more than 67 pixels per degree, w is counted in pixels of that size.
    """
    change = (test - reference).astype(np.float32, copy=False)
    kinds = [change[..., 0]] if change.shape[2] == 1 else [change @ LUMA, *np.moveaxis(change / 2, -1, 0)]
    scale, most, worst = max(1.0, ppd / PIXELS_PER_DEGREE), max(SIDE, round(WINDOW * ppd)), NOWHERE
    for least in (np.multiply(kind, sign, order="C") for kind in kinds for sign in (1, -1)):
        for side in range(2, most + 1):
            if min(least.shape) < 2 or least.max() * (most / scale - 1) / 2 <= worst.value:
                break
            least = np.minimum(least[1:], least[:-1])
            least = np.minimum(least[:, 1:], least[:, :-1])
            if side >= SIDE * scale:
                window = _worst(least, (side / scale - 1) / 2, side, side)
                worst = max(worst, window, key=lambda window: window.value)
    return worst


def _worst(errors: Pixels, weight: float, width: int, height: int) -> Window:
    y, x = np.unravel_index(int(errors.argmax()), errors.shape)
    error = float(errors[y, x])
    return Window(weight * error, error, int(x), int(y), width, height)
