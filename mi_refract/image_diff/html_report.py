"""The page that shows a person what `mi-refract diff` found: one offline HTML file, failures first, with images.

Judgements come from the results; only maps that the method did not ask for (the difference, FLIP) are made here.
Equal images are a line each. Images are embedded until the page is full: those further down keep their numbers,
and the command that shows them alone.
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

from mi_refract.io.image_file import Image, one_line, read
from mi_refract.report.embedded_images import EmbeddedImages, encoded, means, shown, strongest
from mi_refract.report.html_page import write_page
from mi_refract.report.number_text import compact, distinguishable
from mi_refract.report.plots import histogram_svg

from . import folders, methods
from .folders import Result, Results, Status
from .text_reports import sentence

PAGE = 14_000_000  # bytes of images on a page of at most 15 MB
IMAGE, MAP = 4_600_000, 1_200_000  # bytes of one: two images and three maps are a page
MAP_WIDTH, FLIP_WIDTH = 960, 640
PPD = 67.0  # pixels per degree, as everywhere FLIP is used
SIGNED = ("difference", "t")
UNSEEN = {"p"}  # a histogram shows it better
FAILED = (Status.ERROR, Status.DIFFERENT, Status.INCONCLUSIVE)


Maker = Callable[[], dict[str, Any]]


def write(path: str | Path, results: Results, context: Mapping[str, Any] | None = None, replay: str = "") -> None:
    """Write the page; `context` is shown on top as it is, `replay` is the command that repeats the whole comparison.

    An image that cannot be read (any more) is a line on the page. Errors: OSError for the page itself.
    """
    images = EmbeddedImages()
    failures = [_failure(number, result, results, images) for number, result in enumerate(results.of(*FAILED), 1)]
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


def _failure(number: int, result: Result, results: Results, images: EmbeddedImages) -> dict[str, Any]:
    found = result.comparison
    p_values = found.maps.get("p") if found else None
    panes, note = _panes(result, images) if images.size < PAGE else ([], "Not embedded: the page is full.")
    return _line(result) | {
        "key": f"pair-{number}",
        "category": str(result.category),
        "asked": result.how.reason,
        "detectable": found.detectable if found and math.isfinite(found.detectable) else None,
        "panes": panes,
        "paired": len({(pane["width"], pane["height"]) for pane in panes[:2]}) == 1 and len(panes) > 1,
        "note": note,
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
        "figures": [_figure(figure) for figure in found.figures] if found else [],
    }


def _figure(figure: methods.Metric) -> dict[str, str]:
    value, bound = figure.value, figure.bound
    if bound is None or value <= bound == math.inf:
        return {"name": figure.name, "text": compact(value), "limit": "", "state": "info"}
    text, limit = distinguishable(value, bound)
    state, sign = ("pass", "≤") if value <= bound else ("fail", ">" if value > bound else "≰")
    return {"name": figure.name, "text": text, "limit": f"{sign} {limit}", "state": state}


def _histogram(p_values: np.ndarray, salt: str) -> str:
    some = p_values[:: -(-len(p_values) // 512)]
    return histogram_svg(some[np.isfinite(some)], "p-value", "share of the tiles", salt=salt)


# Panes --------------------------------------------------------------------------------------------------------------


def _panes(result: Result, images: EmbeddedImages) -> tuple[list[dict[str, Any]], str]:
    """What can be shown of a pair, and why the rest cannot."""
    sides: dict[str, Image] = {}
    notes = []
    for role, path in (("reference", result.reference), ("test", result.test)):
        try:
            if path:
                sides[role] = _seen(path)
        except (ValueError, OSError) as error:
            notes.append(one_line(str(error)))
    makers: list[Maker] = [functools.partial(_image, role, image) for role, image in sides.items()]
    makers += _map_makers(dict(result.comparison.maps) if result.comparison else {}, *sides.values())
    with ThreadPoolExecutor(2) as pool:  # deflating is most of the work, and lets go of the interpreter's lock
        return [images.add(pane) for pane in pool.map(lambda make: make(), makers)], " ".join(notes)


def _seen(path: Path) -> Image:
    """The image, or the mean of the renders in a folder, in the channels that can be shown."""
    several = folders.sample_images(path) if path.is_dir() else [read(path)]
    first = several[0]
    pixels = sum((each.pixels for each in several[1:]), start=first.pixels) / np.float32(len(several))
    seen, name = shown(pixels, first.channels)
    if seen is None:  # neither RGB nor gray: the first channel stands for all
        seen, name = pixels[..., :1], first.channels[0]
    return replace(first, pixels=seen, channels=tuple("RGB") if name == "RGB" else (name,))


def _map_makers(maps: dict[str, np.ndarray], *sides: Image) -> list[Maker]:
    """For the signed difference and FLIP, then the method's own maps."""
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
    pane = {"role": role, "paint": "code" if methods.encoding(image) == "sRGB" else "light", "gain": None}
    embedded = encoded(image.pixels, IMAGE)
    channel = "" if len(image.channels) == 3 else f"channel {image.channels[0]}"
    return pane | embedded | {"note": ", ".join(filter(None, (channel, embedded["note"])))}


def _map(name: str, values: np.ndarray) -> dict[str, Any]:
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
    """The FLIP map of the images made as small as it is shown: whole, they would take it seconds."""
    side = -(-reference.pixels.shape[1] // FLIP_WIDTH)
    small = [replace(each, pixels=means(each.pixels, side)) for each in (reference, test)]
    found = _map("flip", methods.flip(*small, ppd=max(PPD / side, 1.0)).maps["flip"])
    return found | ({"note": f"of means of {side} × {side} pixels"} if side > 1 else {})
