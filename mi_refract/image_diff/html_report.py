"""The HTML report of `mi-refract diff`: one file that works offline, with failures first and their images.

The verdicts are those of the results. Only maps that the method does not provide (the difference, FLIP) are computed
here. Images are embedded until the page is full; further failures are shown without images, and the page says what it
leaves out.
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
from .results import FAILED, Result, Results, Status
from .text_reports import WORDS, sentence

LIMIT = 15_000_000  # largest size of a page in bytes
PAGE = 13_000_000  # of these, bytes of images
FULL = "Not embedded: the page is full."
IMAGE_BYTES, MAP_BYTES = 4_600_000, 1_200_000  # two images and three maps fill a page
ARTICLES, LINES = 1000, 5000  # failures with details, and images in one line each; fewer if the page is too large
NAMED = 10  # images not on the page that the suggested command for a further page names
MAP_WIDTH, FLIP_WIDTH, HISTOGRAM_ROWS, BINS = 960, 640, 512, 20
BAR_BYTES = 80  # bytes of the HTML of one bar of a histogram
SIGNED = ("difference", "t")

_one_at_a_time = threading.Lock()  # encoding a pair needs several times its memory, and all processors
Pane = dict[str, Any]


# The page -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shown:
    """The images and maps of a pair, as panes for the viewer of `mi_refract.report`.

    `note`: why panes are missing. `histogram`: the shares of the p-values in equal bins from 0 to 1.
    """

    panes: list[Pane] = field(default_factory=list)
    note: str = ""
    histogram: Sequence[float] = ()

    @property
    def size(self) -> int:
        """The size on the page in bytes."""
        return sum(len(pane["data"]) for pane in self.panes) + BAR_BYTES * len(self.histogram)


class Page:
    """One HTML file. `folders.diff` calls `view` from several threads; call `write` afterwards."""

    def __init__(self, path: str | Path) -> None:
        """`path`: path of the file."""
        self.path = Path(path)
        self._shown: dict[tuple[float | str, ...], Shown] = {}
        self._lock = threading.Lock()

    def view(self, result: Result, results: Results) -> None:
        """Keep the panes of the result, unless results before it on the page fill it."""
        place = result.order
        with self._lock:
            if sum(shown.size for other, shown in self._shown.items() if other < place) > PAGE:
                return
        shown = shown_of(result, IMAGE_BYTES, MAP_BYTES)
        with self._lock:  # the results that fit on the page, and one more, independent of the order of the calls
            self._shown[place] = shown
            fitting, total = {}, 0
            for other in sorted(self._shown):
                if total <= PAGE:
                    fitting[other] = self._shown[other]
                total += self._shown[other].size
            self._shown = fitting

    def write(self, results: Results, context: Mapping[str, Any], replay: str = "", source: str = "") -> None:
        """Write the page. OSError if it cannot be written.

        `context`: names and values shown at the top. `replay`: the command that repeats the comparison. `source`: the
        path of its JSON, if one is written; the commands that accept images then accept only those compared in it.
        """
        images, failures, used, rest = EmbeddedImages(), [], 0, list[Result]()
        for number, result in enumerate(results.of(*FAILED), 1):
            shown = self._shown.get(result.order)
            # The first pair is shown, however large; after a pair that does not fit, no pair is shown.
            if rest or shown is None or (used and used + shown.size > PAGE):
                rest.append(result)
                shown = Shown(note=FULL)
            used += shown.size
            failures.append(item(result, results, shown, images) | {"key": f"pair-{number}"})
        equal = sorted((item(result, results) for result in results.of(Status.EQUAL)), key=lambda x: not x["warning"])
        has_names = results.test.is_dir() and not results.renders
        flags_of_rest = [*results.flags, "--report", "rest.html"]
        # Results without images, such as invalid settings, and names with control characters are left out.
        named = [results.word(x.name) for x in rest if (x.reference or x.test) and printable(x.name) == x.name][:NAMED]
        content: dict[str, Any] = {
            "title": "mi-refract diff",
            "sentence": sentence(results),
            "state": {0: "pass", 3: "empty"}.get(results.exit_code, "fail"),
            "causes": Counter(cause(result) for result in results.of(*FAILED)).most_common(),
            "context": {"reference": str(results.reference), "test": str(results.test)} | dict(context),
            "unused": results.unused,
            "command": replay,
            "rest": results.command("diff", *named, flags=flags_of_rest) if named and has_names else "",
            "skipped": [item(result, results) for result in results.of(Status.SKIPPED)],
            "ticks": results.command("accept", flags=["--from", source] if source else None) if has_names else "",
        }
        articles, lines = ARTICLES, LINES
        while True:
            further = failures[articles:]
            dropped, dropped_equal = max(len(further) - lines, 0), max(len(equal) - lines, 0)
            without_images = sum(entry["note"] == FULL for entry in failures[:articles])
            left_out = {
                f"images of {without_images} of {len(failures)} failures": without_images,
                f"details of {len(further) - dropped} failures": len(further) - dropped,
                f"{dropped} failures": dropped,
                f"{dropped_equal} equal images": dropped_equal,
            }
            content |= {
                "failures": failures[:articles],
                "further": further[:lines],
                "more_failures": dropped,
                "equal": equal[:lines],
                "more_equal": dropped_equal,
                "left_out": [text for text, count in left_out.items() if count],
            }
            page = rendered("diff.html.j2", content, images)
            if len(page) <= LIMIT or not lines:
                break
            articles, lines = articles // 2, lines // 2
        write_atomically(self.path, page)


def write(path: str | Path, results: Results, context: Mapping[str, Any] | None = None, replay: str = "") -> None:
    """Write the page of results that have their images and maps, see `Page.write`."""
    page = Page(path)
    for result in results.of(*FAILED):
        page.view(result, results)
    page.write(results, context or {}, replay)


def item(
    result: Result, results: Results, shown: Shown = Shown(), images: EmbeddedImages | None = None
) -> dict[str, Any]:
    """Return the data of an image for the page's template. The panes of `shown` are added to `images`."""
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
        "settings_reason": result.how.reason,
        "warning": result.warning,
        "metrics": metrics,
        "text": " ".join((result.name, result.status, result.category, why)).lower(),
        "word": shlex.quote(results.word(result.name)) if result.test is not None and result.status in FAILED else "",
        "minimum_detectable": detectable if math.isfinite(detectable) else None,
        "panes": [images.add(pane) for pane in shown.panes] if images else [],
        "paired": len({(pane["width"], pane["height"]) for pane in shown.panes[:2]}) == 1 and len(shown.panes) > 1,
        "note": shown.note,
        "histogram": shown.histogram,
        "commands": [(verb, command) for verb, command in commands.items() if command],
    }


def cause(result: Result) -> str:
    """Return why an image failed, in few words, by which the page groups failures; "" if it did not fail."""
    if result.status not in FAILED:
        return ""
    if result.status in (Status.ERROR, Status.INCONCLUSIVE):
        return WORDS[result.status]
    if None in (result.reference, result.test):
        return str(result.category)
    _, metric = result.worst
    return metric.name if metric else str(result.status)


# The panes of a pair ------------------------------------------------------------------------------------------------


def shown_of(result: Result, image_bytes: float, map_bytes: float) -> Shown:
    """Return panes of both images, their difference, FLIP, and the maps of the method.

    `image_bytes`, `map_bytes`: approximate sizes of an image and of a map in bytes.
    """
    try:
        with _one_at_a_time:
            sides: dict[str, Image] = {}
            makers: list[Callable[[], Pane]] = []
            channels = [image.channels for image in result.images.values()]
            shared = [name for name in channels[0] if all(name in names for names in channels)] if channels else []
            for role, image in result.images.items():  # R, G, B, or else the first channel that both have
                names = tuple("RGB") if {*"RGB"} <= {*image.channels} else (*shared, *image.channels)[:1]
                sides[role] = side = replace(image, pixels=image.select(names), channels=names)
                paint = "code" if flip.encoding(side) == "sRGB" else "light"
                note = "" if len(names) > 1 else f"channel {names[0]}"
                makers.append(functools.partial(_pane, role, paint, None, side.pixels, image_bytes, note=note))
            maps = dict(result.comparison.maps) if result.comparison else {}
            one, two = sides.get("reference"), sides.get("test")
            if one and two and one.pixels.shape == two.pixels.shape and one.channels == two.channels:
                with np.errstate(invalid="ignore"):
                    change = two.pixels - one.pixels
                makers.append(functools.partial(map_pane, "difference", change, map_bytes))
                if "flip" not in maps and all(np.isfinite(x.pixels.astype(np.float32)).all() for x in (one, two)):
                    makers.append(functools.partial(_flip_pane, one, two, map_bytes))
            histogram: Sequence[float] = ()
            if "p" in maps:  # shown as a histogram instead of a map
                p_values = maps.pop("p")
                some_rows = p_values[:: -(-len(p_values) // HISTOGRAM_ROWS)]
                counts, _ = np.histogram(some_rows[np.isfinite(some_rows)], BINS, (0, 1))
                histogram = (counts / counts.sum()).tolist() if counts.any() else ()
            if "q" in maps:
                maps["−log₁₀ q"] = -np.log10(np.maximum(maps.pop("q"), 1e-30))
            drawn = [name for name in maps if name != "difference" and (name != "flags" or maps[name].any())]
            makers += [functools.partial(map_pane, name, maps[name], map_bytes) for name in drawn]
            with ThreadPoolExecutor(os.cpu_count()) as pool:  # most of the work is deflate, which releases the GIL
                return Shown(list(pool.map(lambda make: make(), makers)), result.unread, histogram)
    except Exception as error:  # any error: the page shows the other images
        errors.print_traceback(error)
        return Shown(note=f"Cannot be shown: {errors.describe(error)}")


def _pane(
    role: str, paint: str, gain: float | None, pixels: Pixels, max_bytes: float, scale: float = 1.0, note: str = ""
) -> Pane:
    embedded = encoded(pixels, max_bytes, scale)
    notes = ", ".join(filter(None, (note, embedded["note"])))
    return {"role": role, "paint": paint, "gain": gain, **embedded, "note": notes}


def map_pane(name: str, values: Pixels, max_bytes: float, note: str = "") -> Pane:
    """Return a pane of a map whose strongest colour is the largest value.

    The viewer starts with a gain at which the 99th percentile has the strongest colour.
    """
    small = strongest(values.reshape(*values.shape[:2], -1), MAP_WIDTH)
    sizes = np.abs(small[np.isfinite(small)])
    largest = float(sizes.max(initial=0)) or 1.0
    percentile_99 = float(np.quantile(sizes, 0.99)) if sizes.size else 0.0
    gain = min(round(2 * math.log10(largest / percentile_99)) / 2, 6) if percentile_99 else 0
    side = -(-values.shape[1] // MAP_WIDTH)
    reduced = f"strongest of {side} × {side} pixels" if side > 1 else ""
    paint = "signed" if name in SIGNED else "heat"
    return _pane(name, paint, gain, small, max_bytes, largest, note or reduced)


def _flip_pane(reference: Image, test: Image, max_bytes: float) -> Pane:
    """Return a pane of the FLIP map of the images at the displayed size; at full size FLIP would take seconds."""
    side = -(-reference.pixels.shape[1] // FLIP_WIDTH)
    one, two = (replace(image, pixels=block_mean(image.pixels, side)) for image in (reference, test))
    error = flip.flip_map(one, two, flip.is_hdr(one, two), max(flip.PIXELS_PER_DEGREE / side, 1.0))
    return map_pane("flip", error, max_bytes, f"of means of {side} × {side} pixels" if side > 1 else "")
