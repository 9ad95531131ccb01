"""What `mi-refract diff` shows in a browser: one offline HTML file, failures first, with images.

Verdicts come from the results; only the maps that the method did not make (the difference, FLIP) are made here. Images
are embedded until the page is full: those further down keep their numbers, and the page says what it left out.
"""

from __future__ import annotations

import hashlib
import math
import re
import shlex
import threading
from collections import Counter
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from mi_refract.io.atomic import write_atomically
from mi_refract.io.sanitise import printable
from mi_refract.report.embedded_images import EmbeddedImages
from mi_refract.report.html_page import rendered
from mi_refract.report.number_text import compact, distinguishable

from . import panes
from .comparison import Metric
from .panes import Shown
from .results import FAILED, Result, Results, Status
from .text_reports import WORDS, sentence

LIMIT = 15_000_000  # bytes of a page
PAGE = 13_000_000  # bytes of its images; the rest is for text
FULL = "Not embedded: the page is full."
IMAGE_BYTES, MAP_BYTES = 4_600_000, 1_200_000  # two images and three maps fill a page
ARTICLES, LINES = 1000, 5000  # failures with all their numbers, and images in a line, before the page is measured
SHORT = 60  # characters of an image's name in the name of its page


class Page:
    """One HTML file. `view` is for `folders.diff`, by several threads; `write` afterwards."""

    def __init__(self, path: str | Path) -> None:
        """`path`: of the file."""
        self.path = Path(path)
        self._shown: dict[tuple[int, str], Shown] = {}
        self._lock = threading.Lock()

    def view(self, result: Result, results: Results) -> None:
        """Keep what the page shows of the result, unless those before it on the page fill it."""
        place = _place(result)
        with self._lock:
            wanted = sum(shown.size for other, shown in self._shown.items() if other < place) <= PAGE
        if not wanted:
            return
        shown = panes.of_result(result, IMAGE_BYTES, MAP_BYTES)
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

        `source`: the JSON of the comparison, where one is written. Errors: OSError for the page itself.
        """
        images, failures, used, full = EmbeddedImages(), [], 0, False
        for number, result in enumerate(results.of(*FAILED), 1):
            shown = self._shown.get(_place(result))
            # The first pair is shown, however large; after one that does not fit none is.
            full = full or shown is None or bool(used and used + shown.size > PAGE)
            if shown is None or full:
                shown = Shown(note=FULL)
            used += shown.size
            failures.append(item(result, results, shown, images) | {"key": f"pair-{number}"})
        content = overview(results, context, replay, source)
        content["folder_command"] = f"{replay} --report report/" if replay else ""
        articles, lines = ARTICLES, LINES
        while True:
            cut = _cut(failures, content["equal"], articles, lines)
            text = rendered("diff.html.j2", content | cut, images)
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


def _place(result: Result) -> tuple[int, str]:
    """Where the result stands on the page."""
    return FAILED.index(result.status), result.name


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


# What pages say of the whole, and of an image ---------------------------------------------------------------------


def overview(results: Results, context: Mapping[str, Any], replay: str, source: str = "") -> dict[str, Any]:
    """The top of a page: sentence, causes, settings; the images without an article; and `ticks`.

    That is the command that accepts the images whose names follow it; "" where names mean nothing. By the JSON of the
    comparison, `source`, only what was compared is accepted.
    """
    folders = results.test.is_dir() and not results.renders
    equal = [item(result, results) for result in results.of(Status.EQUAL)]
    return {
        "title": "mi-refract diff",
        "sentence": sentence(results),
        "state": {0: "pass", 3: "empty"}.get(results.exit_code, "fail"),
        "causes": Counter(cause(result) for result in results.of(*FAILED)).most_common(),
        "context": {"reference": str(results.reference), "test": str(results.test)} | dict(context),
        "unused": results.unused,
        "command": replay,
        "equal": sorted(equal, key=lambda entry: not entry["warning"]),
        "skipped": [item(result, results) for result in results.of(Status.SKIPPED)],
        "ticks": results.command("accept", flags=["--from", source] if source else None) if folders else "",
    }


def item(
    result: Result, results: Results, shown: Shown | None = None, images: EmbeddedImages | None = None
) -> dict[str, Any]:
    """What a page says of an image; with `shown`, whose panes go to `images`, all of it."""
    comparison, why, href = result.comparison, cause(result), page_of(result)
    times, worst = excess(result)
    folder = PurePosixPath(result.name).parent.as_posix()
    words = (result.name, result.status, result.category, why)
    text = {
        "name": result.name,
        "status": str(result.status),
        "category": str(result.category),
        "method": comparison.method_in_words if comparison else "",
        "reason": result.reason,
        "asked": result.how.reason,
        "warning": result.warning,
        "metrics": [_metric(metric) for metric in comparison.metrics] if comparison else [],
        "text": " ".join(words).lower(),
        "word": word(result),
        "href": href,
        "folder": "" if folder == "." else folder,
        "excess": "" if worst is None else f"{times:.9g}" if math.isfinite(times) else "Infinity",
        "excess_text": "" if worst is None else f"{compact(times)} ×" if math.isfinite(times) else "∞",
        "excess_of": worst.name if worst else "",
    }
    if shown is None or images is None:
        return text
    detectable = comparison.minimum_detectable if comparison else math.nan
    sizes = {(pane["width"], pane["height"]) for pane in shown.panes[:2]}
    commands = {"reproduce": results.reproduce(result), "accept": results.accept(result)}
    return text | {
        "minimum_detectable": detectable if math.isfinite(detectable) else None,
        "panes": [images.add(pane) for pane in shown.panes],
        "paired": len(sizes) == 1 and len(shown.panes) > 1,
        "note": shown.note,
        "histogram": shown.histogram,
        "commands": [(verb, command) for verb, command in commands.items() if command],
    }


def page_of(result: Result) -> str:
    """The page of an image in a folder's report, relative to it: named after the image, whatever the other images."""
    short = re.sub(r"[^A-Za-z0-9._]+", "-", result.name)[-SHORT:].lstrip(".-")
    return f"pairs/{short}-{hashlib.sha256(result.name.encode('utf-8', 'surrogateescape')).hexdigest()[:10]}.html"


def word(result: Result) -> str:
    """The name as a word of a shell; "" where there is nothing to accept, or where it cannot be shown as it is."""
    acceptable = result.test is not None and result.status in FAILED and printable(result.name) == result.name
    return shlex.quote(result.name) if acceptable else ""


def excess(result: Result) -> tuple[float, Metric | None]:
    """How many times its bound the number is that is furthest beyond it; None where none is."""
    beyond = []
    for metric in result.comparison.metrics if result.comparison else ():
        if not metric.holds:
            times = metric.value / metric.bound if metric.bound else math.inf
            beyond.append((math.inf if math.isnan(times) else times, metric))
    return max(beyond, key=lambda pair: pair[0]) if beyond else (0.0, None)


def cause(result: Result) -> str:
    """Why an image failed, in few words that others have in common; "" of those that did not."""
    if result.status not in FAILED:
        return ""
    if result.status in (Status.ERROR, Status.INCONCLUSIVE):
        return WORDS[result.status]
    if None in (result.reference, result.test):
        return str(result.category)
    metric = excess(result)[1]
    return metric.name if metric else str(result.status)


def _metric(metric: Metric) -> dict[str, str]:
    value, bound = metric.value, metric.bound
    if bound is None or value <= bound == math.inf:
        return {"name": metric.name, "text": compact(value), "limit": "", "state": "info"}
    text, limit = distinguishable(value, bound)
    state, sign = ("pass", "≤") if value <= bound else ("fail", ">" if value > bound else "≰")
    return {"name": metric.name, "text": text, "limit": f"{sign} {limit}", "state": state}
