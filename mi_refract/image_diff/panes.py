"""What a page shows of a pair: both images, their difference, FLIP, and the maps of the method, small enough to embed.

In: a result with its images and maps. Out: panes for the viewer of `mi_refract.report`, and thumbnails.
"""

from __future__ import annotations

import functools
import math
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mi_refract.io import errors
from mi_refract.io.image_file import Image
from mi_refract.io.pixels import Pixels, block_mean
from mi_refract.report.embedded_images import difference_thumbnail, encoded, shown, strongest, thumbnail
from mi_refract.report.plots import histogram_svg

from . import flip
from .results import Result

MAP_WIDTH, FLIP_WIDTH, HISTOGRAM_ROWS = 960, 640, 512
SIGNED = ("difference", "t")

_one_at_a_time = threading.Lock()  # what is made of a pair takes several times its memory, and every processor
Pane = dict[str, Any]


@dataclass(frozen=True)
class Shown:
    """The panes of a pair; `note`: why others are missing. `thumbnails`: PNG files by role."""

    panes: list[Pane] = field(default_factory=list)
    note: str = ""
    histogram: str = ""
    thumbnails: dict[str, bytes] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes on a page."""
        return sum(len(pane["data"]) for pane in self.panes) + len(self.histogram)


def of_result(result: Result, image_bytes: float, map_bytes: float, *, thumbs: bool = False) -> Shown:
    """What can be shown of a pair, in about so many bytes for an image and for a map, and why the rest cannot.

    `thumbs`: with thumbnails of the new image, or the reference where there is none, and of the difference.
    """
    try:
        with _one_at_a_time:
            return _shown(result, image_bytes, map_bytes, thumbs)
    except Exception as error:  # of whatever kind: the page is for all images
        errors.print_traceback(error)
        return Shown(note=f"Cannot be shown: {errors.describe(error)}")


def _shown(result: Result, image_bytes: float, map_bytes: float, thumbs: bool) -> Shown:
    sides = {role: _in_shown_channels(image) for role, image in result.images.items()}
    maps = dict(result.comparison.maps) if result.comparison else {}
    makers: list[Callable[[], Pane]] = []
    for role, image in sides.items():
        channel = "" if len(image.channels) == 3 else f"channel {image.channels[0]}"
        makers.append(functools.partial(_pane, role, _paint(image), None, image.pixels, image_bytes, note=channel))
    small = {}
    if thumbs and sides:
        role, image = list(sides.items())[-1]
        coded = _paint(image) == "code"
        small[role] = thumbnail(image.pixels, coded)
    one, two = sides.get("reference"), sides.get("test")
    if one and two and one.pixels.shape == two.pixels.shape:
        with np.errstate(invalid="ignore"):
            change = two.pixels - one.pixels
        makers.append(functools.partial(map_pane, "difference", change, map_bytes))
        if thumbs:
            small["difference"] = difference_thumbnail(change)
        if "flip" not in maps and all(np.isfinite(x.pixels.astype(np.float32)).all() for x in (one, two)):
            makers.append(functools.partial(_flip, one, two, map_bytes))
    histogram = ""
    if "p" in maps:  # a histogram shows it better than a map
        p_values = maps.pop("p")
        some = p_values[:: -(-len(p_values) // HISTOGRAM_ROWS)]
        histogram = histogram_svg(some[np.isfinite(some)], "p-value", "share of the tiles", salt=result.name)
    if "q" in maps:
        maps["−log₁₀ q"] = -np.log10(np.maximum(maps.pop("q"), 1e-30))
    makers += [
        functools.partial(map_pane, name, values, map_bytes)
        for name, values in maps.items()
        if name != "difference" and (name != "flags" or values.any())
    ]
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # deflating is most of the work, and lets go of Python's lock
        return Shown(list(pool.map(lambda make: make(), makers)), result.unread, histogram, small)


def _in_shown_channels(image: Image) -> Image:
    """RGB or gray; of other channels the first stands for all."""
    seen, name = shown(image.pixels, image.channels)
    if seen is None:
        seen, name = image.pixels[..., :1], image.channels[0]
    return replace(image, pixels=seen, channels=tuple("RGB") if name == "RGB" else (name,))


def _paint(image: Image) -> str:
    return "code" if flip.encoding(image) == "sRGB" else "light"


def _pane(
    role: str, paint: str, gain: float | None, pixels: Pixels, most: float, scale: float = 1.0, note: str = ""
) -> Pane:
    embedded = encoded(pixels, most, scale)
    notes = ", ".join(filter(None, (note, embedded["note"])))
    return {"role": role, "paint": paint, "gain": gain, **embedded, "note": notes}


def map_pane(name: str, values: Pixels, most: float, note: str = "") -> Pane:
    """A pane whose colours are full at the largest value; its gain starts where the upper hundredth is full."""
    small = strongest(values.reshape(*values.shape[:2], -1), MAP_WIDTH)
    sizes = np.abs(small[np.isfinite(small)])
    largest = float(sizes.max(initial=0)) or 1.0
    upper = float(np.quantile(sizes, 0.99)) if sizes.size else 0.0
    gain = min(round(2 * math.log10(largest / upper)) / 2, 6) if upper else 0
    side = -(-values.shape[1] // MAP_WIDTH)
    reduced = f"strongest of {side} × {side} pixels" if side > 1 else ""
    paint = "signed" if name in SIGNED else "heat"
    return _pane(name, paint, gain, small, most, largest, note or reduced)


def _flip(reference: Image, test: Image, most: float) -> Pane:
    """The FLIP map of the images at the size in which it is shown; at full size it would take seconds."""
    side = -(-reference.pixels.shape[1] // FLIP_WIDTH)
    one, two = (replace(image, pixels=block_mean(image.pixels, side)) for image in (reference, test))
    error = flip.flip_map(one, two, flip.is_hdr(one, two), max(flip.PIXELS_PER_DEGREE / side, 1.0))
    return map_pane("flip", error, most, f"of means of {side} × {side} pixels" if side > 1 else "")
