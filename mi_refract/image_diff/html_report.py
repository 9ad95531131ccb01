"""The page that shows a person what `mi-refract diff` found: one offline HTML file, failures first, with images.

Verdicts come from the results; only the maps that the method did not make (the difference, FLIP) are made here. Images
are embedded until the page is full: those further down keep their numbers, and the page says what it left out.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mi_refract.io.atomic import write_atomically
from mi_refract.report.embedded_images import EmbeddedImages
from mi_refract.report.html_page import rendered

from . import panes, report_rows
from .panes import Most, Shown
from .results import FAILED, Result, Results, Status

LIMIT = 15_000_000  # bytes of a page
PAGE = 13_000_000  # bytes of its images; the rest is for text
FULL = "Not embedded: the page is full."
MOST = Most(4_600_000, 1_200_000)  # two images and three maps are a page
ARTICLES, LINES = 1000, 5000  # failures with all their numbers, and images in a line, before the page is measured


def write(path: str | Path, results: Results, context: Mapping[str, Any] | None = None, replay: str = "") -> None:
    """Write the page of results that have their images and maps, or else from their files; as `Page.write`."""
    page = Page(path)
    for result in results.of(*FAILED):
        page.view(result, results)
    page.write(results, context or {}, replay)


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
        if wanted:
            shown = panes.of_result(result, MOST)
            with self._lock:
                self._shown[place] = shown
                self._shown = _fitting(self._shown)

    def write(self, results: Results, context: Mapping[str, Any], replay: str = "", source: str = "") -> None:
        """Write the page. `context` is shown on top as it is; `replay`: the command that repeats the comparison.

        `source`: the JSON of the comparison, where one is written. An image that could not be read (any more) is a line
        on the page. Errors: OSError for the page itself.
        """
        images = EmbeddedImages()
        failures = list(self._failures(images, results))
        equal, skipped = (
            [report_rows.line(result) for result in results.of(status)] for status in (Status.EQUAL, Status.SKIPPED)
        )
        equal.sort(key=lambda each: not each["warnings"])
        content = report_rows.head(results, context, replay) | {
            "skipped": skipped,
            "ticks": report_rows.ticked(results, source),
            "folder_command": f"{replay} --report report/" if replay else "",
        }
        articles, lines = ARTICLES, LINES
        while len(text := rendered("diff.html.j2", content | _cut(failures, equal, articles, lines), images)) > LIMIT:
            articles, lines = articles // 2, lines // 2
            if not lines:
                break
        write_atomically(self.path, text)

    def _failures(self, images: EmbeddedImages, results: Results) -> Iterator[dict[str, Any]]:
        """The failures in order. The first pair is shown, however large; after one that does not fit none is."""
        used, full = 0, False
        for number, result in enumerate(results.of(*FAILED), 1):
            shown = self._shown.get(_place(result))
            full = full or shown is None or bool(used and used + shown.size > PAGE)
            if shown is None or full:
                shown = Shown(note=FULL)
            used += shown.size
            found = report_rows.failure(result, results, shown) | {"key": f"pair-{number}"}
            yield found | {"panes": [images.add(pane) for pane in shown.panes]}


def _place(result: Result) -> tuple[int, str]:
    """Where the result stands on the page."""
    return FAILED.index(result.status), result.name


def _fitting(shown: dict[tuple[int, str], Shown]) -> dict[tuple[int, str], Shown]:
    """What fits on the page in its order, and one more: whatever the order in which it came."""
    kept, total = {}, 0
    for place in sorted(shown):
        if total <= PAGE:
            kept[place] = shown[place]
        total += shown[place].size
    return kept


def _cut(failures: list[dict[str, Any]], equal: list[dict[str, Any]], articles: int, lines: int) -> dict[str, Any]:
    """The lists, no longer than that, and what was left out of them."""
    further, more_equal = failures[articles:], max(len(equal) - lines, 0)
    more = max(len(further) - lines, 0)
    without = sum(each["note"] == FULL for each in failures[:articles])
    said = {
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
        "left_out": [text for text, count in said.items() if count],
    }
