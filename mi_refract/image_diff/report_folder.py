"""A report of any number of failures: a folder with an index and one page a pair, which needs no network.

Pages are written one by one, while the images of their pair are in memory. The folder gets its name when it is
complete.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mi_refract.io import atomic
from mi_refract.io.sanitise import printable
from mi_refract.report.embedded_images import EmbeddedImages
from mi_refract.report.html_page import rendered, write_beside

from . import panes, report_rows
from .panes import Most
from .results import FAILED, Result, Results, Status

MOST = Most(2_000_000, 400_000, thumbnails=True)
BESIDE = ("report.css", "report.js", "diff.css", "diff.js")
INDEX, PAGES = "index.html", "pages.js"
FOLDERS = {"pairs": ".html", "thumbs": ".png"}  # and the ending of each file in them
GENERATOR = b'<meta name="generator" content="mi-refract diff">'
HEAD = 2000  # bytes of a page in which it says what generated it


class Folder:
    """The report while it is written. `view` is for `folders.diff`, by several threads; `write` afterwards."""

    def __init__(self, path: Path) -> None:
        """`path`: an empty folder. OSError where it cannot be written."""
        self.path = path
        for name in FOLDERS:
            (path / name).mkdir()
        write_beside(path, *BESIDE)
        self._thumbs: dict[str, list[str]] = {}
        self._lock = threading.Lock()

    def view(self, result: Result, results: Results) -> None:
        """Write the page of the result, and its thumbnails. OSError."""
        shown = panes.of_result(result, MOST)
        page, images = report_rows.page_of(result), EmbeddedImages()
        item = report_rows.failure(result, results, shown) | {"panes": [images.add(pane) for pane in shown.panes]}
        content = {"title": "mi-refract diff", "sentence": result.name, "item": item, "ticks": ""}
        (self.path / page).write_bytes(rendered("diff_pair.html.j2", content, images, "../"))
        names = []
        for role, data in shown.thumbnails.items():
            names.append(f"thumbs/{Path(page).stem}.{role}.png")
            (self.path / names[-1]).write_bytes(data)
        with self._lock:
            self._thumbs[page] = names

    def write(self, results: Results, context: Mapping[str, Any], replay: str = "", source: str = "") -> None:
        """Write the index, as `html_report.Page.write`. Errors: OSError."""
        failed = results.of(*FAILED)
        pages = [report_rows.page_of(result) for result in failed]
        equal = [report_rows.line(result) for result in results.of(Status.EQUAL)]
        content = report_rows.head(results, context, replay) | {
            "failures": [
                report_rows.row(result, self._thumbs[page]) for result, page in zip(failed, pages, strict=True)
            ],
            "equal": sorted(equal, key=lambda each: not each["warnings"]),
            "skipped": [report_rows.line(result) for result in results.of(Status.SKIPPED)],
            "ticks": report_rows.ticked(results, source),
        }
        (self.path / INDEX).write_bytes(rendered("diff_index.html.j2", content, beside=""))
        listed = json.dumps([[page, printable(result.name)] for page, result in zip(pages, failed, strict=True)])
        (self.path / PAGES).write_text(f"const PAGES = {listed};\n", "utf-8")


def require_free(path: Path, *sides: Path) -> None:
    """ValueError unless a report may be written to `path`: a new or empty folder, or one that holds a report.

    Nor may it lie in one of the `sides`, where its thumbnails would be images. OSError where its parent is missing.
    """
    for side in sides:
        if side.is_dir() and path.resolve().is_relative_to(side.resolve()):
            raise ValueError(f"{path}: in {side}, where it would be compared; expected a folder outside")
    if not path.is_dir():
        if path.exists():
            raise NotADirectoryError(f"{path}: expected a file name that ends in .html, or a folder")
        return atomic.check_parent(path.resolve())
    if foreign := _foreign(path):
        raise ValueError(f"{path}: holds {foreign}, no report of ours; expected a new or empty folder, or a report")
    return None


def _foreign(path: Path) -> str:
    """The name of what is no part of a report in a folder; "" where all is."""
    entries = {entry.name: entry for entry in path.iterdir()}
    if not entries:
        return ""
    known = {INDEX, PAGES, *BESIDE, *FOLDERS}
    others = [name for name in sorted(entries) if name not in known]
    for name, ending in FOLDERS.items():
        inside = entries[name].iterdir() if name in entries and entries[name].is_dir() else ()
        others += [f"{name}/{entry.name}" for entry in inside if entry.suffix != ending]
    if others:
        return others[0]
    with contextlib.suppress(OSError), (path / INDEX).open("rb") as file:
        if GENERATOR in file.read(HEAD):
            return ""
    return sorted(entries)[0]


@contextlib.contextmanager
def writing(path: Path) -> Iterator[Folder]:
    """A report that takes the place of `path` at the end, complete; on any exception what was there stays.

    ValueError and OSError as `require_free`.
    """
    require_free(path)
    path, old = path.resolve(), None
    try:
        with atomic.replacing(path, folder=True) as temporary:
            yield Folder(temporary)
            require_free(path)
            old = _set_aside(path)
    except BaseException:
        if old and not path.exists():
            old.rename(path)
        raise
    if old:
        shutil.rmtree(old, ignore_errors=True)


def _set_aside(path: Path) -> Path | None:
    """The new name of the old report: a folder that is not empty cannot be replaced in one step."""
    if not path.exists():
        return None
    old = atomic.temporary_name(path, "")
    path.rename(old)
    return old
