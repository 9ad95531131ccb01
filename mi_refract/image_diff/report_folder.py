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

from . import html_report, panes
from .results import FAILED, Result, Results

IMAGE_BYTES, MAP_BYTES = 2_000_000, 400_000
BESIDE = ("report.css", "report.js", "diff.css", "diff.js")
INDEX, PAGES = "index.html", "pages.js"
FOLDERS = {"pairs": ".html", "thumbs": ".png"}  # and the ending of each file in them
GENERATOR = b'<meta name="generator" content="mi-refract diff">'
HEAD = 2000  # bytes of a page that hold the generator


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
        shown = panes.of_result(result, IMAGE_BYTES, MAP_BYTES, thumbs=True)
        page, images = html_report.page_of(result), EmbeddedImages()
        item = html_report.item(result, results, shown, images)
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
        failures = [html_report.item(result, results) for result in results.of(*FAILED)]
        failures = [item | {"thumbs": self._thumbs[item["href"]]} for item in failures]
        content = html_report.overview(results, context, replay, source) | {"failures": failures}
        (self.path / INDEX).write_bytes(rendered("diff_index.html.j2", content, beside=""))
        listed = json.dumps([[item["href"], printable(item["name"])] for item in failures])
        (self.path / PAGES).write_text(f"const PAGES = {listed};\n", "utf-8")


def require_free(path: Path, *sides: Path) -> None:
    """ValueError unless a report may be written to `path`: a new or empty folder, or one that holds a report.

    Nor may it lie in one of the `sides`, where its thumbnails would be images. OSError where its parent is missing.
    """
    for side in sides:
        if side.is_dir() and path.resolve().is_relative_to(side.resolve()):
            raise ValueError(f"{path}: is inside {side}, so it would be compared; use another folder")
    if not path.is_dir():
        if path.exists():
            raise NotADirectoryError(f"{path}: expected a file name that ends in .html, or a folder")
        atomic.check_parent(path.resolve())
    elif foreign := _foreign(path):
        raise ValueError(
            f"{path}: contains {foreign}, not part of a report; expected a new or empty folder, or an old report"
        )


def _foreign(path: Path) -> str:
    """The name of what is no part of a report in a folder; "" where all is."""
    entries = sorted(path.iterdir())
    for entry in entries:
        if entry.name not in {INDEX, PAGES, *BESIDE, *FOLDERS}:
            return entry.name
        for inside in entry.iterdir() if entry.name in FOLDERS and entry.is_dir() else ():
            if inside.suffix != FOLDERS[entry.name]:
                return f"{entry.name}/{inside.name}"
    with contextlib.suppress(OSError), (path / INDEX).open("rb") as file:
        if GENERATOR in file.read(HEAD):
            return ""
    return entries[0].name if entries else ""


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
            if path.exists():  # a folder that is not empty cannot be replaced in one step
                old = path.rename(atomic.temporary_name(path, ""))
    except BaseException:
        if old and not path.exists():
            old.rename(path)
        raise
    if old:
        shutil.rmtree(old, ignore_errors=True)
