"""The page that shows a person what `mi-refract diff` found: one offline HTML file, failures first, with images.

Verdicts come from the results; only the maps that the method did not make (the difference, FLIP) are made here. Equal
images are a line each. Images are embedded until the page is full: those further down keep their numbers, and the
command that shows them alone.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io import exit_code
from mi_refract.io.image_file import Image, one_line, read
from mi_refract.io.pixels import Pixels, block_mean
from mi_refract.report.embedded_images import EmbeddedImages, encoded, shown, strongest
from mi_refract.report.html_page import write_page
from mi_refract.report.number_text import compact, distinguishable
from mi_refract.report.plots import histogram_svg

from . import flip, folders
from .comparison import Maps, Metric
from .results import FAILED, Result, Results, Status
from .text_reports import sentence

PAGE = 14_000_000  # bytes of images on a page of at most 15 MB
FULL = "Not embedded: the page is full."
IMAGE, MAP = 4_600_000, 1_200_000  # bytes of one: two images and three maps are a page
MAP_WIDTH, FLIP_WIDTH = 960, 640
SIGNED = ("difference", "t")
UNSEEN = {"p"}  # a histogram shows it better


Maker = Callable[[], dict[str, Any]]


def write(path: str | Path, results: Results, context: Mapping[str, Any] | None = None, replay: str = "") -> None:
    """Write the page; `context` is shown on top as it is, `replay` is the command that repeats the whole comparison.

    An image that cannot be read (any more) is a line on the page. Errors: OSError for the page itself.
    """
    images = EmbeddedImages()
    failures: list[dict[str, Any]] = []
    full = False
    for number, result in enumerate(results.of(*FAILED), 1):
        panes, note = ([], FULL) if full else _panes_or_why(result)
        # The first pair is shown, however large; after one that does not fit no other is tried.
        full = full or bool(images.embedded and images.size + _bytes(panes) > PAGE)
        panes, note = ([], FULL) if full else ([images.add(pane) for pane in panes], note)
        failures.append(_failure(number, result, results) | _shown_panes(panes, note))
    counts = Counter(result.status for result in results.results)
    content = {
        "title": "mi-refract diff",
        "sentence": sentence(results),
        "state": {0: "pass", 3: "empty"}.get(results.exit_code, "fail"),
        "counts": [(str(status), counts[status]) for status in Status],
        "context": {"reference": str(results.reference), "test": str(results.test)} | dict(context or {}),
        "unused": results.unused,
        "command": replay,
        "failures": failures,
        "equal": [_line(result) for result in results.of(Status.EQUAL)],
    }
    write_page(path, "diff.html.j2", content, images)


def _bytes(panes: list[dict[str, Any]]) -> int:
    return sum(len(pane["data"]) for pane in panes)


def _shown_panes(panes: list[dict[str, Any]], note: str) -> dict[str, Any]:
    one_size = len({(pane["width"], pane["height"]) for pane in panes[:2]}) == 1
    return {"panes": panes, "paired": one_size and len(panes) > 1, "note": note}


def _failure(number: int, result: Result, results: Results) -> dict[str, Any]:
    found = result.comparison
    p_values = found.maps.get("p") if found else None
    return _line(result) | {
        "key": f"pair-{number}",
        "category": str(result.category),
        "asked": result.how.reason,
        "minimum_detectable": found.minimum_detectable if found and math.isfinite(found.minimum_detectable) else None,
        "histogram": "" if p_values is None else _histogram(p_values, f"pair-{number}"),
        "commands": [
            (verb, command)
            for verb, command in (("reproduce", results.reproduce(result)), ("accept", results.accept(result)))
            if command
        ],
    }


def _line(result: Result) -> dict[str, Any]:
    found = result.comparison
    return {
        "name": result.name,
        "status": str(result.status),
        "method": found.method if found else "",
        "reason": result.reason,
        "metrics": [_metric(metric) for metric in found.metrics] if found else [],
    }


def _metric(metric: Metric) -> dict[str, str]:
    value, bound = metric.value, metric.bound
    if bound is None or value <= bound == math.inf:
        return {"name": metric.name, "text": compact(value), "limit": "", "state": "info"}
    text, limit = distinguishable(value, bound)
    state, sign = ("pass", "≤") if value <= bound else ("fail", ">" if value > bound else "≰")
    return {"name": metric.name, "text": text, "limit": f"{sign} {limit}", "state": state}


def _histogram(p_values: Pixels, salt: str) -> str:
    some = p_values[:: -(-len(p_values) // 512)]
    return histogram_svg(some[np.isfinite(some)], "p-value", "share of the tiles", salt=salt)


# Panes --------------------------------------------------------------------------------------------------------------


def _panes_or_why(result: Result) -> tuple[list[dict[str, Any]], str]:
    try:
        return _panes(result)
    except Exception as error:  # of whatever kind: the page is for all images
        exit_code.print_traceback(error)
        return [], f"Cannot be shown: {exit_code.describe(error)}"


def _panes(result: Result) -> tuple[list[dict[str, Any]], str]:
    """What can be shown of a pair, and why the rest cannot."""
    sides, notes = _sides(result)
    makers: list[Maker] = [functools.partial(_image, role, image) for role, image in sides.items()]
    makers += _map_makers(result.comparison.maps if result.comparison else {}, *sides.values())
    with ThreadPoolExecutor(2) as pool:  # deflating is most of the work, and lets go of the interpreter's lock
        return list(pool.map(lambda make: make(), makers)), " ".join(notes)


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
                several = folders.read_renders(path, most) if path.is_dir() else [read(path, most)]
                sides[role] = _in_shown_channels(folders.mean_image(several))
        except (ValueError, OSError) as error:
            notes.append(one_line(str(error)))
    return sides, notes


def _in_shown_channels(image: Image) -> Image:
    """RGB or gray; of other channels the first stands for all."""
    seen, name = shown(image.pixels, image.channels)
    if seen is None:
        seen, name = image.pixels[..., :1], image.channels[0]
    return replace(image, pixels=seen, channels=tuple("RGB") if name == "RGB" else (name,))


def _map_makers(given: Maps, *sides: Image) -> list[Maker]:
    """For the signed difference and FLIP, then the method's own maps."""
    maps = dict(given)
    made: dict[str, Maker] = {}
    if len(sides) == 2 and sides[0].pixels.shape == sides[1].pixels.shape:
        with np.errstate(invalid="ignore"):
            made["difference"] = functools.partial(_map, "difference", sides[1].pixels - sides[0].pixels)
        if "flip" not in maps and all(np.isfinite(side.pixels.astype(np.float32)).all() for side in sides):
            made["flip"] = functools.partial(_flip, *sides)
    if "q" in maps:
        maps["−log₁₀ q"] = -np.log10(np.maximum(maps.pop("q"), 1e-30))
    if not maps.get("flags", np.ones(1)).any():
        del maps["flags"]
    left = [name for name in maps if name not in UNSEEN | made.keys()]
    return [*made.values(), *(functools.partial(_map, name, maps[name]) for name in left)]


def _image(role: str, image: Image) -> dict[str, Any]:
    pane = {"role": role, "paint": "code" if flip.encoding(image) == "sRGB" else "light", "gain": None}
    embedded = encoded(image.pixels, IMAGE)
    channel = "" if len(image.channels) == 3 else f"channel {image.channels[0]}"
    return pane | embedded | {"note": ", ".join(filter(None, (channel, embedded["note"])))}


def _map(name: str, values: Pixels) -> dict[str, Any]:
    """A pane whose colours are full at the largest value; its gain starts where the upper hundredth is full."""
    small = strongest(values.reshape(*values.shape[:2], -1), MAP_WIDTH)
    sizes = np.abs(small[np.isfinite(small)])
    largest = float(sizes.max(initial=0)) or 1.0
    upper = float(np.quantile(sizes, 0.99)) if sizes.size else 0.0
    gain = min(round(2 * math.log10(largest / upper)) / 2, 6) if upper else 0
    embedded = encoded(small, MAP, largest)
    side = -(-values.shape[1] // MAP_WIDTH)
    reduced = f"strongest of {side} × {side} pixels" if side > 1 else ""
    pane = {"role": name, "paint": "signed" if name in SIGNED else "heat", "gain": gain}
    return pane | embedded | {"note": ", ".join(filter(None, (reduced, embedded["note"])))}


def _flip(reference: Image, test: Image) -> dict[str, Any]:
    """The FLIP map of the images at the size in which it is shown; at full size it would take seconds."""
    side = -(-reference.pixels.shape[1] // FLIP_WIDTH)
    one, two = (replace(each, pixels=block_mean(each.pixels, side)) for each in (reference, test))
    error = flip.flip_map(one, two, flip.is_hdr(one, two), max(flip.PIXELS_PER_DEGREE / side, 1.0))
    found = _map("flip", error)
    return found | ({"note": f"of means of {side} × {side} pixels"} if side > 1 else {})
