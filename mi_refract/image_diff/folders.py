"""Pairs of image files, and folders of them: which image is compared with which, and the results.

A pair that cannot be compared does not stop the others. Nothing here writes a file.
"""

from __future__ import annotations

import contextlib
import enum
import functools
import hashlib
import os
import shlex
import stat
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from io import BufferedReader
from pathlib import Path

import numpy as np

from mi_refract.io import exit_code, image_file
from mi_refract.io.bounded_map import bounded_map
from mi_refract.io.image_file import MAX_VALUES, Image

from . import methods
from .comparison import Comparison, Verdict
from .settings import How, Settings


class Status(enum.StrEnum):
    """A verdict, or ERROR where there is none. The most important first."""

    ERROR = "error"
    DIFFERENT = "different"
    INCONCLUSIVE = "inconclusive"
    EQUAL = "equal"


class Category(enum.StrEnum):
    """What happened to an image between the two folders; UNKNOWN without a verdict."""

    ADDED = "added"
    REMOVED = "removed"
    CHANGED = "changed"
    UNCHANGED = "unchanged"
    UNKNOWN = "unknown"


STATUSES = {Verdict.EQUAL: Status.EQUAL, Verdict.DIFFERENT: Status.DIFFERENT, Verdict.INCONCLUSIVE: Status.INCONCLUSIVE}
CATEGORIES = {Status.EQUAL: Category.UNCHANGED, Status.DIFFERENT: Category.CHANGED}
AS_ASKED = Settings()
WORKERS = min(os.cpu_count() or 1, 8)
HELD = 250_000_000  # bytes of images that stay in memory for a page; a full page shows fewer
INCONCLUSIVE = {"": 3, "pass": 0, "fail": 1}  # exit codes by what the user wants of it


@dataclass(frozen=True)
class Result:
    """One image: its name, and what was found. `error` is the line that says why there is no verdict.

    `reference`, `test`: its files, or with renders its folders; None where that side has none. `how`: what was asked.
    `images`: both sides as they were read, of several renders the mean; empty where they were not kept. `digests`: of
    both files when they were compared, as `digest` gives them; None where that was not asked, or a file is unreadable.
    """

    name: str
    status: Status
    reference: Path | None
    test: Path | None
    how: How = field(default_factory=How)
    comparison: Comparison | None = None
    error: str = ""
    images: tuple[Image, ...] = ()
    digests: tuple[str, str] | None = None

    @property
    def category(self) -> Category:
        """What happened to the image between the two folders."""
        if self.status is Status.ERROR:
            return Category.UNKNOWN
        if self.reference is None or self.test is None:
            return Category.ADDED if self.reference is None else Category.REMOVED
        return CATEGORIES.get(self.status, Category.UNKNOWN)

    @property
    def reason(self) -> str:
        """The reason for the status in one sentence."""
        if self.comparison:
            return self.comparison.reason
        sides = {Category.ADDED: "only among the new images", Category.REMOVED: "only among the references"}
        return self.error or sides[self.category]


@dataclass(frozen=True)
class Results:
    """What `diff` found, failures first.

    `reference`, `test`: the paths as given; `renders`: each of them holds renders of one image. `inconclusive`: what
    that counts as ("pass", "fail", or "" for an exit code of its own). `unused`: patterns of the settings that matched
    no image.
    """

    reference: Path
    test: Path
    results: tuple[Result, ...]
    renders: bool = False
    inconclusive: str = ""
    unused: tuple[str, ...] = ()

    def of(self, *statuses: Status) -> list[Result]:
        """The results with one of these statuses."""
        return [result for result in self.results if result.status in statuses]

    @property
    def exit_code(self) -> int:
        """2: something could not be compared, or nothing was; 1: different; 3: inconclusive; 0: all equal."""
        if self.of(Status.ERROR) or not self.results:
            return 2
        if self.of(Status.DIFFERENT):
            return 1
        return INCONCLUSIVE[self.inconclusive] if self.of(Status.INCONCLUSIVE) else 0

    def target(self, result: Result) -> Path:
        """Where the reference is, or would be."""
        return result.reference or (self.reference / result.name if self.test.is_dir() else self.reference)

    def reproduce(self, result: Result) -> str:
        """The command that compares this image again; "" where one side has none."""
        flags = (["--renders"] if self.renders else []) + result.how.flags
        return _line("diff", result.reference, result.test, flags) if result.reference else ""

    def accept(self, result: Result) -> str:
        """The command that makes the new image the reference; "" where there is none, or no need."""
        flags = [] if self.renders else result.how.flags
        return _line("accept", self.target(result), result.test, flags) if result.status is not Status.EQUAL else ""


def _line(verb: str, reference: Path, test: Path | None, flags: Sequence[str]) -> str:
    return shlex.join(["mi-refract", verb, as_word(reference), as_word(test), *flags]) if test else ""


def as_word(path: Path) -> str:
    """The path as a word of a command line, with ./ before a name that would be read as an option."""
    return f"./{path}" if str(path).startswith("-") else str(path)


# Comparing --------------------------------------------------------------------------------------------------------


def diff(
    reference: str | Path,
    test: str | Path,
    settings: Settings = AS_ASKED,
    *,
    renders: bool = False,
    inconclusive: str = "",
    maps: bool = False,
    to_accept: bool = False,
    tell: Callable[[int, int], None] = lambda done, of: None,
) -> Results:
    """Compare two files, two folders by the names of their images, or, with `renders`, two folders as one image.

    `maps`: keep the maps of images that are not equal, and the images themselves as far as HELD goes. `to_accept`: the
    reference need not exist yet, and the results have `digests`. `tell(done, of)` is called after each image.
    Whatever goes wrong with one image is the error of its result. ValueError or OSError where there is nothing to
    compare: a path that does not exist, a file against a folder, an empty folder, a path within the other.
    """
    reference, test = Path(reference), Path(test)
    require_apart(reference, test, to_accept)
    if renders and not (reference.is_dir() and test.is_dir()):
        raise NotADirectoryError(f"{test if reference.is_dir() else reference}: accepted with --renders: a folder")
    name = reference.resolve().name
    paired = [Result(name, Status.DIFFERENT, reference, test)] if renders else pairs(reference, test)
    asked = [replace(result, how=settings.of(result.name)) for result in paired]
    found, held = [], 0
    # Together, the pairs that are compared at once have no more values than one pair may have.
    most = 2 * settings.default.max_values
    for result in bounded_map(lambda each: _compared(each, renders, maps, to_accept), asked, _values, most, WORKERS):
        held += sum(image.pixels.nbytes for image in result.images)
        found.append(result if held <= HELD else replace(result, images=()))
        tell(len(found), len(asked))
    found.sort(key=lambda result: list(Status).index(result.status))
    unused = settings.unused([result.name for result in paired]) if reference.is_dir() and not renders else []
    return Results(reference, test, tuple(found), renders, inconclusive, tuple(unused))


def require_apart(reference: Path, test: Path, new: bool = False) -> None:
    """ValueError where one path is the other or lies within it, OSError where one does not exist."""
    for role, path in {"test": test, **({} if new else {"reference": reference})}.items():
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such {role} file or folder; accepted: one that is there")
    if reference.exists() and reference.samefile(test):
        raise ValueError(f"{test}: the same as the reference {reference}; accepted: two")
    inner, outer = reference.resolve(), test.resolve()
    if inner.is_relative_to(outer) or outer.is_relative_to(inner):
        raise ValueError(f"{test}: one within the other, {reference}; accepted: two apart")


def pairs(reference: Path, test: Path) -> list[Result]:
    """The images of both sides by name, not yet compared; those of one side only are different."""
    known = reference.exists()
    if known and reference.is_dir() != test.is_dir():
        raise ValueError(f"{reference}, {test}: a folder and a file; accepted: two of a kind")
    if not test.is_dir():
        return [Result(reference.name, Status.DIFFERENT, reference if known else None, test)]
    (old, lost), (new, missed) = images_in(reference) if known else ({}, []), images_in(test)
    for folder, nothing in ((reference, known and not old and not lost), (test, not new and not missed)):
        if nothing:
            raise ValueError(f"{folder}: holds no image; accepted: at least one")
    found = [Result(name, Status.DIFFERENT, old.get(name), new.get(name)) for name in sorted(old | new)]
    return [*found, *(Result(name, Status.ERROR, None, None, error=error) for name, error in lost + missed)]


def images_in(folder: Path) -> tuple[dict[str, Path], list[tuple[str, str]]]:
    """The files whose names end as an image's, by their path inside; (name, error) of folders that cannot be read.

    Names that begin with a dot are left out. Links to folders are not followed, and an error: nobody would look there.
    """
    found: dict[str, Path] = {}
    failed: list[tuple[str, str]] = []

    def note(error: OSError) -> None:
        failed.append((Path(error.filename).relative_to(folder).as_posix(), str(error)))

    for parent, folders, names in os.walk(folder, onerror=note):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for path in (Path(parent, name) for name in folders):
            if path.is_symlink():
                failed.append((path.relative_to(folder).as_posix(), f"{path}: a link to a folder; accepted: a folder"))
        for name in names:
            path = Path(parent, name)
            if path.suffix[1:].lower() in endings() and not name.startswith("."):
                found[path.relative_to(folder).as_posix()] = path
    return found, failed


@functools.cache
def endings() -> frozenset[str]:
    """The file name endings, lower case without the dot, of the images that OpenImageIO reads."""
    import OpenImageIO as oiio

    formats = (each.split(":") for each in oiio.get_string_attribute("extension_list").split(";") if each)
    return frozenset(e for name, listed in formats if name not in ("null", "term", "zfile") for e in listed.split(","))


def _values(result: Result) -> int:
    """The values of its two images; 0 for what cannot be read, or is no pair of files."""
    files = [path for path in (result.reference, result.test) if path and path.is_file()]
    if len(files) < 2:
        return 0
    with contextlib.suppress(Exception):  # of whatever kind: the comparison says it
        return sum(image_file.count_values(path, result.how.max_values) for path in files)
    return 0


def _compared(result: Result, renders: bool, maps: bool, to_accept: bool) -> Result:
    """The result of comparing its two sides, where it has both; ERROR for whatever goes wrong."""
    if result.error:
        return result
    try:
        if to_accept:  # before the images are read: what is read later and has the same digest is what was compared
            result = replace(result, digests=(digest(result.reference), digest(result.test)))
        return _judged(result, result.reference, result.test, renders, maps)
    except Exception as error:  # of whatever kind: the other images are still to be compared
        exit_code.print_traceback(error)
        text = exit_code.describe(error)
        known = isinstance(error, ValueError | OSError)
        return replace(result, status=Status.ERROR, error=text if known else f"{result.test}: {text}")


def digest(path: Path | None) -> str:
    """The SHA-256 of a file's bytes; "" where there is none. OSError, and ValueError, as `opened`."""
    if path is None or not path.exists():
        return ""
    with opened(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def opened(path: Path) -> BufferedReader:
    """A file to read from. OSError, or ValueError for a pipe or a device, which might never end."""
    nonblocking = getattr(os, "O_NONBLOCK", 0)  # or the pipe is waited for
    file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | nonblocking))  # noqa: SIM115
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        return file
    file.close()
    raise ValueError(f"{path}: accepted: a regular file")


def _judged(result: Result, reference: Path | None, test: Path | None, renders: bool, maps: bool) -> Result:
    if not (reference and test):
        return result
    if reference.samefile(test):
        raise ValueError(f"{test}: the same file as the reference {reference}; accepted: two")
    most = result.how.max_values
    sides = [read_renders(path, most) if renders else [image_file.read(path, most)] for path in (reference, test)]
    found = methods.compare(result.how.method, *sides, **result.how.options)
    kept = maps and found.verdict is not Verdict.EQUAL  # a thousand images' maps would fill the memory
    images = tuple(map(mean_image, sides)) if kept else ()
    comparison = found if kept else replace(found, maps={})
    return replace(result, status=STATUSES[found.verdict], comparison=comparison, images=images)


def read_renders(folder: Path, max_values: int = MAX_VALUES) -> list[Image]:
    """The renders of one image in a folder. ValueError where two are the same, seed and all; otherwise as `read`."""
    found, failed = images_in(folder)
    if failed:
        raise OSError(failed[0][1])
    if not found:
        raise ValueError(f"{folder}: holds no image; accepted: several renders of one")
    with ThreadPoolExecutor(WORKERS) as pool:
        images = list(pool.map(lambda path: image_file.read(path, max_values), found.values()))
    sums: dict[float, Image] = {}
    for image in images:
        other = sums.setdefault(float(image.pixels.sum(dtype=np.float64)), image)
        if other is not image and np.array_equal(image.pixels, other.pixels):
            raise ValueError(f"{image.path}: the same pixels as {other.path}; accepted: renders of different seeds")
    return images


def mean_image(images: Sequence[Image]) -> Image:
    """The first image with the mean of the pixels of all; one image as it is."""
    first = images[0]
    if len(images) == 1:
        return first
    pixels = sum((each.pixels for each in images[1:]), start=first.pixels) / np.float32(len(images))
    return replace(first, pixels=pixels)
