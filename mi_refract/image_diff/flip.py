"""FLIP: the differences that a person sees who flips between two images, judged by the worst windows of its error map.

Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020, and "Visualizing the Error in
Rendered High Dynamic Range Images", Eurographics Short Papers 2021; computed by OpenImageIO.

The visibility of a change depends neither on its position nor on the rest of the image: windows slide by single pixels.

`local_error` detects details: it is the largest mean error of a window. The smallest window is a square of 0.12 degrees
of the viewer's field, 7 arcminutes: a letter of the 20/30 line of an eye chart, which is read without effort. At 67
pixels per degree it has 8 × 8 pixels. Larger windows, each twice as wide, up to 7.7 degrees, detect wide and faint
changes. Their means are weighted by the fourth root of their area in units of the smallest, because the threshold of a
wide stimulus falls by probability summation (Robson and Graham, Vision Research 21, 1981).

`patch_error` detects changed surfaces: it is the error that is exceeded throughout a window of 0.24 degrees. A change
of antialiasing causes large errors along edges, and the FLIP error spreads to 0.07 degrees from an edge; these errors
fill no such window.

`one_way_change` compares images for a display without FLIP, which blurs details smaller than a letter.
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
PATCH = 0.12  # 7 to 10 of 255 codes of gray; no tested change of antialiasing fills a patch with two thirds of it
# An edge from black to white, blurred by a Gaussian of σ pixels, moves by half a pixel. All pixels of a 3 × 3 square
# become brighter, or all darker, by at most 255 (Φ(1.25) − Φ(0.75)) = 30.9 codes, which is reached at σ = 1.
ONE_WAY, SIDE = 31.0, 3
LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # of codes, as in JPEG (BT.601)
CODED = re.compile(r"srgb|gamma|^g\d\d")  # OpenImageIO's names of colour spaces that are encoded for a display
LINEAR = re.compile(r"^lin|linear|^aces|^raw$|^data$")
INTEGERS = ("uint8", "uint16")  # a file of these types that names no colour space is encoded for a display
DARKER = 4.0  # two stops: light twice as bright as a nearly white pixel is nearly white, too
# Relative to the bright luminance of both images, without fireflies: below it, a pixel counts as black. Where the other
# image is not black, it is light beside a much brighter one, such as a room beside the sun, and not a rounding error.
DUST, FAINTEST = 2.0**-24, 2.0**-48
BRIGHT = 0.999  # the quantile of the luminances that counts as bright
WINDOW, OCTAVES = 0.12, 7  # degrees: the side of the smallest window; number of windows, each twice as wide
SURFACE = 0.24  # degrees: the side of the window of `patch_error`
AROUND = 0.5  # degrees around the brightest window: if FLIP detects black there, the other pixels are not needed

Options = Mapping[str, Any]  # all options of `flip`, by name


def flip(
    reference: Image,
    test: Image,
    *,
    local: Annotated[
        float, "mean FLIP error allowed in any square of 0.12 degrees, 0 to 1; less in wider squares"
    ] = LOCAL,
    patch: Annotated[float, "FLIP error allowed throughout a square of 0.24 degrees, 0 to 1"] = PATCH,
    one_way: Annotated[
        float,
        "codes of 255 by which the luma of all pixels of a 3 × 3 square may rise, or fall; twice as much for a single "
        "channel, less for larger squares; for LDR images",
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

    The worst windows decide, see `local_error`, `patch_error` and `one_way_change`. Both images have the channels
    R, G, B, or a single channel. An alpha from 0 to 1 is compared as gray codes of a display. ValueError for other
    channels.
    """
    if reference.channels == (ALPHA,) and _is_coverage(reference, test):
        hdr = "no"
        reference, test = (replace(image, metadata={"oiio:ColorSpace": "sRGB"}) for image in (reference, test))
    treat_as_hdr = is_hdr(reference, test, hdr)
    error = flip_map(reference, test, treat_as_hdr, ppd)
    (worst, around), patch_window = local_error(error, ppd), patch_error(error, ppd)
    compared = error if reference.mask is None else error[reference.mask]
    one_way_window = one_way_change(_codes(reference), _codes(test), ppd) if not treat_as_hdr else NOWHERE
    metrics = (
        Metric("local FLIP error", worst.value, local),
        Metric("FLIP error throughout a patch", patch_window.value, patch),
        *([] if treat_as_hdr else [Metric("change one way, in codes", one_way_window.value, one_way)]),
        Metric("largest FLIP error", float(error.max()), largest),
        Metric("mean FLIP error", float(compared.mean()), mean),
        Metric("99th percentile of the FLIP error", float(np.percentile(compared, 99)), percentile_99),
    )
    reason = f"local FLIP error {worst.value:.3g}, largest {error.max():.3g} ({'HDR' if treat_as_hdr else 'LDR'})"
    if worst.value:
        description, window = f"mean {worst.error:.3g}", worst
        if metrics[0].holds and not metrics[1].holds:
            description, window = f"at least {patch_window.error:.3g}", patch_window
        elif metrics[0].holds and one_way_window.value > one_way:
            description, window = f"at least {one_way_window.error:.0f} codes brighter or darker", one_way_window
        x, y = window.x + reference.origin[0], window.y + reference.origin[1]
        reason += f"; {description} in {window.width} × {window.height} pixels from x = {x}, y = {y}"
    for metric, name, most in zip(metrics[-2:], ("mean", "percentile_99"), (mean, percentile_99), strict=True):
        if not metric.holds:
            value, bound = distinguishable(metric.value, most)
            reason = f"{metric.name} {value} > {name} = {bound}; {reason}"
    return Comparison("flip", verdict_of(metrics), reason, metrics, maps={"flip": error, "local": around})


def views(image: Image, options: Options) -> Iterator[tuple[Image, Options]]:
    """Yield the part of the image around the brightest window, where black is detected first, and the whole image.

    With a bound of the mean or of the 99th percentile only the whole image: both are larger in the brightest part.
    """
    if min(options["mean"], options["percentile_99"]) < 1:
        yield image, options
        return
    side, around = max(1, round(WINDOW * options["ppd"])), max(1, round(AROUND * options["ppd"]))
    light = block_mean(_linear(image), side).sum(-1)
    y, x = (side * int(i) for i in np.unravel_index(int(light.argmax()), light.shape))
    rows, columns = (slice(max(start - around, 0), start + side + around) for start in (y, x))
    yield replace(image, pixels=image.pixels[rows, columns], mask=None), options
    yield image, options


def looks_at(reference: Image, test: Image) -> list[list[str]]:
    """Return the groups of channels that `flip` compares: the colours, and alpha if its values are from 0 to 1."""
    colours = list(_colours(reference))
    alpha = ALPHA in reference.channels and ALPHA not in colours
    coverage = alpha and _is_coverage(only(reference, [ALPHA]), only(test, [ALPHA]))
    return [colours, *([[ALPHA]] if coverage else [])]


def _is_coverage(*images: Image) -> bool:
    return all(bool(((image.pixels >= 0) & (image.pixels <= 1)).all()) for image in images)


def is_hdr(reference: Image, test: Image, hdr: str = "auto") -> bool:
    """Return whether FLIP treats the images as HDR; with "auto", if either image is linear."""
    return hdr == "yes" or (hdr == "auto" and "linear" in (encoding(reference), encoding(test)))


def flip_map(reference: Image, test: Image, hdr: bool, ppd: float = PIXELS_PER_DEGREE) -> Pixels:
    """Return the FLIP error of every pixel, H × W float32 from 0 to 1, of the channels R, G, B, or of a single channel.

    For HDR it is the largest error over several exposures. Their range extends from the smaller of the median
    luminances of both images, without black pixels, to DARKER times the larger of their brightest luminances.
    ValueError for images with other channels.
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
    """Return the brightest and the median luminance of two images.

    The brightest luminance is the BRIGHT quantile of the pixels that are not black, or that of the brightest line of
    three pixels if it is larger. It is not the maximum: one firefly would require many exposures at which all other
    pixels are black.
    """
    from scipy.ndimage import rank_filter

    light = [pixels @ LUMINANCE for pixels in images]
    line = max(float(rank_filter(x, -3, 3, mode="constant").max()) for x in light)
    bright = max(line, *(float(np.quantile(x, BRIGHT)) for x in light))
    in_both = np.minimum(light[0], light[1]) > FAINTEST * bright
    visible = [x[in_both | (x > DUST * bright)] for x in light]
    median = min((float(np.median(x)) for x in visible if x.size), default=0.18)
    lit = [x[x > 0] for x in light if (x > 0).any()]
    return max(line, *(float(np.quantile(x, BRIGHT)) for x in lit), 0.0) or 2.0, median


def encoding(image: Image) -> str:
    """Return "sRGB" for values that are encoded for a display, else "linear".

    The colour space named in the file decides; without one, integers are sRGB.
    """
    space = str(image.metadata.get("oiio:ColorSpace", "")).lower()
    if LINEAR.search(space):
        return "linear"
    return "sRGB" if CODED.search(space) or image.stored in INTEGERS else "linear"


def _linear(image: Image) -> Pixels:
    """Return the linear values, H × W × 3 float32; values that are not finite become 0."""
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
    """Return sRGB codes, H × W × C, from 0 to 255; of alpha from 0 to 127.5, its mean effect over black and white."""
    white = 127.5 if image.channels == (ALPHA,) else 255.0
    is_coded = encoding(image) == "sRGB"
    values = (np.nan_to_num(image.select(_colours(image))) if is_coded else _linear(image)).clip(0, 1)
    return np.asarray(white * (values if is_coded else srgb_encode(values)))


def _colours(image: Image) -> tuple[str, ...]:
    """Return R, G, B if the image has them, else every channel but alpha, or alpha if there is no other channel."""
    return RGB if set(RGB) <= set(image.channels) else tuple(n for n in image.channels if n != ALPHA) or image.channels


# The worst window ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Window:
    """The worst window of an error map, in pixels; `error`: its mean or smallest error; `value`: the weighted error."""

    value: float
    error: float
    x: int
    y: int
    width: int
    height: int


NOWHERE = Window(0.0, 0.0, 0, 0, 0, 0)


def windows(height: int, width: int, ppd: float) -> Iterator[tuple[int, int, float]]:
    """Yield the height and width in pixels of every window, and its weight, at least 1.

    A window is at most as high and as wide as the image.
    """
    for octave in range(OCTAVES):
        side = max(1, round(WINDOW * 2**octave * ppd))
        h, w = min(side, height), min(side, width)
        yield h, w, max(1.0, (h * w / (WINDOW * ppd) ** 2) ** 0.25)
        if side >= max(height, width):
            return


def local_error(error: Pixels, ppd: float) -> tuple[Window, Pixels]:
    """Return the window of an error map, H × W, with the largest weighted mean, and a map, H × W, of these means.

    `ppd`: pixels per degree. The weight of the smallest window is 1. The map holds for every pixel the largest weighted
    mean of the windows that are centred there.
    """
    height, width = error.shape
    sums = np.zeros((height + 1, width + 1))
    np.cumsum(np.cumsum(error, 0, dtype=np.float64), 1, out=sums[1:, 1:])
    around, worst_windows = np.zeros(error.shape, np.float32), []
    for h, w, weight in windows(height, width, ppd):
        means = (sums[h:, w:] - sums[:-h, w:] - sums[h:, :-w] + sums[:-h, :-w]) / (h * w)
        worst_windows.append(_worst_window(np.maximum(means, 0), weight, w, h))  # a difference of sums may be −1e-16
        # Each mean is stored at the centre of its window; pixels next to the border get that of the nearest window.
        padding = [(gap // 2, gap - gap // 2) for gap in (h - 1, w - 1)]
        np.maximum(around, np.pad(np.float32(weight) * means.astype(np.float32), padding, mode="edge"), out=around)
    return max(worst_windows, key=lambda window: window.value), around


def patch_error(error: Pixels, ppd: float) -> Window:
    """Return the window of SURFACE degrees whose smallest error is the largest."""
    from scipy.ndimage import minimum_filter

    h, w = (min(max(1, round(SURFACE * ppd)), size) for size in error.shape)
    rows, columns = (slice(k // 2, k // 2 + size - k + 1) for k, size in zip((h, w), error.shape, strict=True))
    return _worst_window(minimum_filter(error, (h, w))[rows, columns], 1.0, w, h)


def one_way_change(reference: Pixels, test: Pixels, ppd: float) -> Window:
    """Return the square whose pixels all become brighter, or all darker, by the most.

    `reference`, `test`: codes, H × W × C. A change is that of luma, or half the change of one channel, because eyes
    and subsampled JPEG files resolve colours half as well. `value` of a square is its smallest change times (w − 1)/2,
    for squares of w = 3 … 8 pixels a side: an edge that moves by half a pixel changes such a square by up to
    255 φ(1)/(w − 1), at a blur of (w − 1)/2 pixels. Above 67 pixels per degree, w is in units of 1/67 degree.
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
                window = _worst_window(least, (side / scale - 1) / 2, side, side)
                worst = max(worst, window, key=lambda window: window.value)
    return worst


def _worst_window(errors: Pixels, weight: float, width: int, height: int) -> Window:
    y, x = np.unravel_index(int(errors.argmax()), errors.shape)
    error = float(errors[y, x])
    return Window(weight * error, error, int(x), int(y), width, height)
