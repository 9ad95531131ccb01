"""What `mi-refract diff` shows in a browser: one offline HTML file, failures first, with images.

Verdicts come from the results; only the maps that the method did not make (the difference, FLIP) are made here. Images
are embedded until the page is full: those further down keep their numbers, and the page says what it left out.
"""

from __future__ import annotations

import functools
import math
import os
import shlex
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io import errors
from mi_refract.io.image_file import Image, Pixels, block_mean
from mi_refract.io.safe_files import write_atomically
from mi_refract.io.text import beside_bound, compact, printable
from mi_refract.report.documents import rendered
from mi_refract.report.embedded_images import EmbeddedImages, encoded, strongest

from . import flip
from .name_patterns import literal
from .results import FAILED, Result, Results, Status
from .text_reports import WORDS, sentence

LIMIT = 15_000_000  # bytes of a page
PAGE = 13_000_000  # bytes of its images; the rest is for text
FULL = "Not embedded: the page is full."
IMAGE_BYTES, MAP_BYTES = 4_600_000, 1_200_000  # two images and three maps fill a page
ARTICLES, LINES = 1000, 5000  # failures with all their numbers, and images in a line, before the page is measured
NAMED = 10  # images without a place on the page that the command for a page of the rest names
MAP_WIDTH, FLIP_WIDTH, HISTOGRAM_ROWS, BINS = 960, 640, 512, 20
BAR_BYTES = 80  # of a bar of a histogram on the page
SIGNED = ("difference", "t")

_one_at_a_time = threading.Lock()  # what is made of a pair takes several times its memory, and every processor
Pane = dict[str, Any]


# The page -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shown:
    """The panes of a pair for the viewer of `mi_refract.report`; `note`: why others are missing.

    `histogram`: the shares of the p-values in equal bins from 0 to 1.
    """

    panes: list[Pane] = field(default_factory=list)
    note: str = ""
    histogram: Sequence[float] = ()

    @property
    def size(self) -> int:
        """Bytes on a page."""
        return sum(len(pane["data"]) for pane in self.panes) + BAR_BYTES * len(self.histogram)


class Page:
    """One HTML file. `view` is for `folders.diff`, by several threads; `write` afterwards."""

    def __init__(self, path: str | Path) -> None:
        """`path`: of the file."""
        self.path = Path(path)
        self._shown: dict[tuple[float | str, ...], Shown] = {}
        self._lock = threading.Lock()

    def view(self, result: Result, results: Results) -> None:
        """Keep what the page shows of the result, unless those before it on the page fill it."""
        place = result.order
        with self._lock:
            if sum(shown.size for other, shown in self._shown.items() if other < place) > PAGE:
                return
        shown = shown_of(result, IMAGE_BYTES, MAP_BYTES)
        with self._lock:  # what fits on the page in its order, and one more: whatever the order in which it came
            self._shown[place] = shown
            kept, total = {}, 0
            for other in sorted(self._shown):
                if total <= PAGE:
                    kept[other] = self._shown[other]
                total += self._shown[other].size
            self._shown = kept

    def write(self, results: Results, context: Mapping[str, Any], replay: str = "", source: str = "") -> None:
        """Write the page. `context` is shown on top as it is; `replay`: the command that repeats the comparison.

        `source`: the JSON of the comparison, where one is written: only what it compared is accepted then. Errors:
        OSError for the page itself.
        """
        images, failures, used, rest = EmbeddedImages(), [], 0, list[Result]()
        for number, result in enumerate(results.of(*FAILED), 1):
            shown = self._shown.get(result.order)
            # The first pair is shown, however large; after one that does not fit none is.
            if rest or shown is None or (used and used + shown.size > PAGE):
                rest.append(result)
                shown = Shown(note=FULL)
            used += shown.size
            failures.append(item(result, results, shown, images) | {"key": f"pair-{number}"})
        equal = sorted((item(result, results) for result in results.of(Status.EQUAL)), key=lambda x: not x["warning"])
        folders = results.test.is_dir() and not results.renders  # where names mean something
        more = [*results.flags, "--report", "rest.html"]
        # Without what is no image, and without names that cannot be shown as they are.
        named = [literal(x.name) for x in rest if (x.reference or x.test) and printable(x.name) == x.name][:NAMED]
        content = {
            "title": "mi-refract diff",
            "sentence": sentence(results),
            "state": {0: "pass", 3: "empty"}.get(results.exit_code, "fail"),
            "causes": Counter(cause(result) for result in results.of(*FAILED)).most_common(),
            "context": {"reference": str(results.reference), "test": str(results.test)} | dict(context),
            "unused": results.unused,
            "command": replay,
            "rest": results.command("diff", *named, flags=more) if named and folders else "",
            "skipped": [item(result, results) for result in results.of(Status.SKIPPED)],
            "ticks": results.command("accept", flags=["--from", source] if source else None) if folders else "",
        }
        articles, lines = ARTICLES, LINES
        while True:
            text = rendered("diff.html.j2", content | _cut(failures, equal, articles, lines), images)
            if len(text) <= LIMIT or not lines:
                break
            articles, lines = articles // 2, lines // 2
        write_atomically(self.path, text)


def write(path: str | Path, results: Results, context: Mapping[str, Any] | None = None, replay: str = "") -> None:
    """Write the page of results that have their images and maps; as `Page.write`."""
    page = Page(path)
    for result in results.of(*FAILED):
        page.view(result, results)
    page.write(results, context or {}, replay)


def _cut(failures: list[dict[str, Any]], equal: list[dict[str, Any]], articles: int, lines: int) -> dict[str, Any]:
    """The lists, no longer than that, and what was left out of them."""
    further, more_equal = failures[articles:], max(len(equal) - lines, 0)
    more = max(len(further) - lines, 0)
    without = sum(entry["note"] == FULL for entry in failures[:articles])
    left_out = {
        f"images of {without} of {len(failures)} failures": without,
        f"all but a line of {len(further) - more} failures": len(further) - more,
        f"{more} failures": more,
        f"{more_equal} equal images": more_equal,
    }
    return {
        "failures": failures[:articles],
        "further": further[:lines],
        "more_failures": more,
        "equal": equal[:lines],
        "more_equal": more_equal,
        "left_out": [text for text, count in left_out.items() if count],
    }


def item(
    result: Result, results: Results, shown: Shown = Shown(), images: EmbeddedImages | None = None
) -> dict[str, Any]:
    """What the page says of an image. The panes of `shown` go to `images`."""
    comparison, why = result.comparison, cause(result)
    detectable = comparison.minimum_detectable if comparison else math.nan
    commands = {"reproduce": results.reproduce(result), "accept": results.accept(result)}
    metrics = []
    for metric in comparison.metrics if comparison else ():
        text, limit, state = compact(metric.value), "", "info"
        if metric.bound is not None and not metric.value <= metric.bound == math.inf:
            text, limit = beside_bound(metric.value, metric.bound)
            state = "pass" if metric.value <= metric.bound else "fail"
        metrics.append({"name": metric.name, "text": text, "limit": limit, "state": state})
    return {
        "name": result.name,
        "status": str(result.status),
        "category": str(result.category),
        "method": comparison.method_in_words if comparison else "",
        "reason": result.reason,
        "asked": result.how.reason,
        "warning": result.warning,
        "metrics": metrics,
        "text": " ".join((result.name, result.status, result.category, why)).lower(),
        "word": shlex.quote(literal(result.name)) if result.test is not None and result.status in FAILED else "",
        "minimum_detectable": detectable if math.isfinite(detectable) else None,
        "panes": [images.add(pane) for pane in shown.panes] if images else [],
        "paired": len({(pane["width"], pane["height"]) for pane in shown.panes[:2]}) == 1 and len(shown.panes) > 1,
        "note": shown.note,
        "histogram": shown.histogram,
        "commands": [(verb, command) for verb, command in commands.items() if command],
    }


def cause(result: Result) -> str:
    """Why an image failed, in few words that others have in common; "" of those that did not."""
    if result.status not in FAILED:
        return ""
    if result.status in (Status.ERROR, Status.INCONCLUSIVE):
        return WORDS[result.status]
    if None in (result.reference, result.test):
        return str(result.category)
    _, metric = result.worst
    return metric.name if metric else str(result.status)


# What it shows of a pair --------------------------------------------------------------------------------------------


def shown_of(result: Result, image_bytes: float, map_bytes: float) -> Shown:
    """Both images, their difference, FLIP, and the maps of the method, in about so many bytes an image and a map."""
    try:
        with _one_at_a_time:
            sides: dict[str, Image] = {}
            makers: list[Callable[[], Pane]] = []
            for role, image in result.images.items():  # RGB or gray; of other channels the first stands for all
                names = tuple("RGB") if {*"RGB"} <= {*image.channels} else image.channels[:1]
                sides[role] = side = replace(image, pixels=image.select(names), channels=names)
                paint = "code" if flip.encoding(side) == "sRGB" else "light"
                note = "" if len(names) > 1 else f"channel {names[0]}"
                makers.append(functools.partial(_pane, role, paint, None, side.pixels, image_bytes, note=note))
            maps = dict(result.comparison.maps) if result.comparison else {}
            one, two = sides.get("reference"), sides.get("test")
            if one and two and one.pixels.shape == two.pixels.shape:
                with np.errstate(invalid="ignore"):
                    change = two.pixels - one.pixels
                makers.append(functools.partial(map_pane, "difference", change, map_bytes))
                if "flip" not in maps and all(np.isfinite(x.pixels.astype(np.float32)).all() for x in (one, two)):
                    makers.append(functools.partial(_flip, one, two, map_bytes))
            histogram: Sequence[float] = ()
            if "p" in maps:  # a histogram shows it better than a map
                p_values = maps.pop("p")
                some = p_values[:: -(-len(p_values) // HISTOGRAM_ROWS)]
                counts, _ = np.histogram(some[np.isfinite(some)], BINS, (0, 1))
                histogram = (counts / counts.sum()).tolist() if counts.any() else ()
            if "q" in maps:
                maps["−log₁₀ q"] = -np.log10(np.maximum(maps.pop("q"), 1e-30))
            makers += [
                functools.partial(map_pane, name, values, map_bytes)
                for name, values in maps.items()
                if name != "difference" and (name != "flags" or values.any())
            ]
            with ThreadPoolExecutor(os.cpu_count()) as pool:  # deflating is most of the work, without Python's lock
                return Shown(list(pool.map(lambda make: make(), makers)), result.unread, histogram)
    except Exception as error:  # of whatever kind: the page is for all images
        errors.print_traceback(error)
        return Shown(note=f"Cannot be shown: {errors.describe(error)}")


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
