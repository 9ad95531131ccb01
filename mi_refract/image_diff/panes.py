"""What a page shows of a pair: both images, their difference, FLIP, and the maps of the method, small enough to embed.

In: a result with its images and maps, else with its files. Out: panes for the viewer of `mi_refract.report`, and
thumbnails.
"""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io import exit_code
from mi_refract.io.image_file import Image, one_line
from mi_refract.io.pixels import Pixels, block_mean
from mi_refract.report import thumbnails
from mi_refract.report.embedded_images import encoded, shown, strongest
from mi_refract.report.plots import histogram_svg

from . import flip, folders, parts
from .comparison import Maps
from .results import Result

MAP_WIDTH, FLIP_WIDTH = 960, 640
SIGNED = ("difference", "t")
UNSEEN = {"p"}  # a histogram shows it better

_one_at_a_time = threading.Lock()  # what is made of a pair takes several times its memory, and every processor
Maker = Callable[[], dict[str, Any]]


@dataclass(frozen=True)
class Most:
    """Bytes of an image and of a map, at most, and whether thumbnails are made."""

    image: float
    map: float
    thumbnails: bool = False


@dataclass(frozen=True)
class Shown:
    """The panes of a pair; `note`: why others are missing. `thumbnails`: PNG files by role."""

    panes: list[dict[str, Any]] = field(default_factory=list)
    note: str = ""
    histogram: str = ""
    thumbnails: dict[str, bytes] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes on a page."""
        return sum(len(pane["data"]) for pane in self.panes) + len(self.histogram)


def of_result(result: Result, most: Most) -> Shown:
    """What can be shown of a pair, and why the rest cannot."""
    try:
        with _one_at_a_time:
            return _all(result, most)
    except Exception as error:  # of whatever kind: the page is for all images
        exit_code.print_traceback(error)
        return Shown(note=f"Cannot be shown: {exit_code.describe(error)}")


def _histogram(p_values: Pixels, salt: str) -> str:
    some = p_values[:: -(-len(p_values) // 512)]
    return histogram_svg(some[np.isfinite(some)], "p-value", "share of the tiles", salt=salt)


def _all(result: Result, most: Most) -> Shown:
    sides, notes = _sides(result)
    maps = result.comparison.maps if result.comparison else {}
    makers: list[Maker] = [functools.partial(_image, role, image, most.image) for role, image in sides.items()]
    makers += _map_makers(maps, most.map, *sides.values())
    thumbs = _thumbnails(sides) if most.thumbnails else {}
    histogram = _histogram(maps["p"], result.name) if "p" in maps else ""
    with ThreadPoolExecutor(folders.WORKERS) as pool:  # deflating is most of the work, and lets go of Python's lock
        return Shown(list(pool.map(lambda make: make(), makers)), " ".join(notes), histogram, thumbs)


def _thumbnails(sides: dict[str, Image]) -> dict[str, bytes]:
    """The new image, or the reference where there is none, and the difference; as PNG."""
    role = "test" if "test" in sides else "reference"
    found = {}
    if role in sides:
        found[role] = thumbnails.of_image(sides[role].pixels, _paint(sides[role]) == "code")
    if (change := _difference(*sides.values())) is not None:
        found["difference"] = thumbnails.of_difference(change)
    return found


def _difference(*sides: Image) -> Pixels | None:
    if len(sides) != 2 or sides[0].pixels.shape != sides[1].pixels.shape:
        return None
    with np.errstate(invalid="ignore"):
        return sides[1].pixels - sides[0].pixels


def _sides(result: Result) -> tuple[dict[str, Image], list[str]]:
    """The images by role, in the channels that can be shown; and why one cannot be read."""
    paths = {"reference": result.reference, "test": result.test}
    if result.images:
        return {role: _in_shown_channels(image) for role, image in zip(paths, result.images, strict=True)}, []
    sides, notes = {}, []
    for role, path in paths.items():
        try:
            if path:
                most = result.how.max_values
                several = folders.read_renders(path, most) if path.is_dir() else [_part(path, result)]
                sides[role] = _in_shown_channels(folders.mean_image(several))
        except (ValueError, OSError) as error:
            notes.append(one_line(str(error)))
    return sides, notes


def _part(path: Path, result: Result) -> Image:
    """Of a file of several images the one that the verdict is about, else the first."""
    images = parts.read(path, result.how)
    part = result.comparison.part if result.comparison else (0, 0)
    return next((image for image in images if image.part == part), images[0])


def _in_shown_channels(image: Image) -> Image:
    """RGB or gray; of other channels the first stands for all."""
    seen, name = shown(image.pixels, image.channels)
    if seen is None:
        seen, name = image.pixels[..., :1], image.channels[0]
    return replace(image, pixels=seen, channels=tuple("RGB") if name == "RGB" else (name,))


def _map_makers(given: Maps, most: float, *sides: Image) -> list[Maker]:
    """For the signed difference and FLIP, then the method's own maps."""
    maps = dict(given)
    made: dict[str, Maker] = {}
    if (change := _difference(*sides)) is not None:
        made["difference"] = functools.partial(_map, "difference", change, most)
        if "flip" not in maps and all(np.isfinite(side.pixels.astype(np.float32)).all() for side in sides):
            made["flip"] = functools.partial(_flip, sides[0], sides[1], most)
    if "q" in maps:
        maps["−log₁₀ q"] = -np.log10(np.maximum(maps.pop("q"), 1e-30))
    if not maps.get("flags", np.ones(1)).any():
        del maps["flags"]
    left = [name for name in maps if name not in UNSEEN | made.keys()]
    return [*made.values(), *(functools.partial(_map, name, maps[name], most) for name in left)]


def _paint(image: Image) -> str:
    return "code" if flip.encoding(image) == "sRGB" else "light"


def _image(role: str, image: Image, most: float) -> dict[str, Any]:
    pane = {"role": role, "paint": _paint(image), "gain": None}
    embedded = encoded(image.pixels, most)
    channel = "" if len(image.channels) == 3 else f"channel {image.channels[0]}"
    return pane | embedded | {"note": ", ".join(filter(None, (channel, embedded["note"])))}


def _map(name: str, values: Pixels, most: float) -> dict[str, Any]:
    """A pane whose colours are full at the largest value; its gain starts where the upper hundredth is full."""
    small = strongest(values.reshape(*values.shape[:2], -1), MAP_WIDTH)
    sizes = np.abs(small[np.isfinite(small)])
    largest = float(sizes.max(initial=0)) or 1.0
    upper = float(np.quantile(sizes, 0.99)) if sizes.size else 0.0
    gain = min(round(2 * math.log10(largest / upper)) / 2, 6) if upper else 0
    embedded = encoded(small, most, largest)
    side = -(-values.shape[1] // MAP_WIDTH)
    reduced = f"strongest of {side} × {side} pixels" if side > 1 else ""
    pane = {"role": name, "paint": "signed" if name in SIGNED else "heat", "gain": gain}
    return pane | embedded | {"note": ", ".join(filter(None, (reduced, embedded["note"])))}


def _flip(reference: Image, test: Image, most: float) -> dict[str, Any]:
    """The FLIP map of the images at the size in which it is shown; at full size it would take seconds."""
    side = -(-reference.pixels.shape[1] // FLIP_WIDTH)
    one, two = (replace(each, pixels=block_mean(each.pixels, side)) for each in (reference, test))
    error = flip.flip_map(one, two, flip.is_hdr(one, two), max(flip.PIXELS_PER_DEGREE / side, 1.0))
    found = _map("flip", error, most)
    return found | ({"note": f"of means of {side} × {side} pixels"} if side > 1 else {})
