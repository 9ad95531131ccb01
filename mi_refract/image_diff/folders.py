"""Comparison of two files or two folders: every pair by its settings.

A pair that cannot be compared does not stop the others. This module writes no file.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from mi_refract.io import errors, image_file, safe_files
from mi_refract.io.image_file import Image, one_line
from mi_refract.io.safe_files import digest

from . import file_pair, pairing
from .results import FAILED, Result, Results, Status
from .settings import Settings

if TYPE_CHECKING:
    from concurrent.futures import Future

NO_SETTINGS = Settings()
WORKERS = min(os.cpu_count() or 1, 8)
AHEAD = 2  # pairs queued per thread, so that a slow pair does not leave the other threads idle
Item = TypeVar("Item")
Answer = TypeVar("Answer")
View = Callable[[Result, Results], None]
Read = Callable[[Path], Sequence[Image] | Exception]


def diff(
    reference: str | Path,
    test: str | Path,
    settings: Settings = NO_SETTINGS,
    *,
    names: Sequence[str] = (),
    renders: bool = False,
    inconclusive: str = "",
    view: View | None = None,
    maps: bool = False,
    digests: bool = False,
    to_accept: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Results:
    """Compare two files, two folders by the names of their images, or, with `renders`, two folders as one image.

    `names`: patterns of the images to compare; none: all. `view(result, results)`: called for each result that is not
    equal, with its images and maps, from several threads at once; `results` has the paths and flags, but no results
    yet. An error that `view` raises ends the comparison. `maps`: the results keep images and maps, all in memory.
    `digests`: the results have the SHA-256 of their files. `to_accept`: as `digests`, and the reference may be missing.
    `progress(done, total)`: called after each image.

    An error with one image is stored in its result. ValueError or OSError if nothing can be compared: a path that does
    not exist, a file against a folder, files with a map, an empty folder, a path that contains the other, a name that
    matches no image.
    """
    reference, test = Path(reference), Path(test)
    pairing.require_apart(reference, test, settings.maps, to_accept)
    if not renders:
        all_pairs = pairing.pairs(reference, test, settings)
    elif reference.is_dir() and test.is_dir():
        name = reference.resolve().name
        how = replace(replace(settings, above=settings.above.parent).of(name), above=settings.above)
        all_pairs = [Result(name, Status.DIFFERENT, reference, test, how, target=reference)]
    else:
        file = test if reference.is_dir() else reference
        raise NotADirectoryError(f"{file}: not a folder; --renders expects folders")
    unused: list[str] = []
    pairs = pairing.named(all_pairs, names)
    if test.is_dir() and not renders:
        pairs += pairing.wrong_entries(settings, all_pairs)
    if reference.is_dir() and not renders:
        unused = settings.unused([pair.name for pair in all_pairs])
        if not to_accept:  # the first variant of a template may be about to be accepted
            unused += pairing.unused_templates(all_pairs)
    results = Results(reference, test, (), renders, inconclusive, tuple(unused), settings.flags)

    def compare(pair: Result) -> Result:
        with_digests = (digests or to_accept) and not renders
        result = _compare_pair(pair, results, keep=maps or view is not None, digests=with_digests)
        if view and result.status in FAILED:
            view(result, results)
        return result if maps else without_images(result)

    # The pairs that are compared at the same time together have at most as many values as one pair may have.
    max_values = 2 * settings.max_values
    compared = map(compare, pairs) if len(pairs) == 1 else bounded_map(compare, pairs, _size, max_values, WORKERS)
    done: list[Result] = []
    for result in compared:
        done.append(result)
        progress(len(done), len(pairs))
    return replace(results, results=tuple(sorted(done, key=lambda result: result.order)))


def bounded_map(
    work: Callable[[Item], Answer], items: Iterable[Item], size_of: Callable[[Item], int], max_size: int, threads: int
) -> Iterator[Answer]:
    """Yield `work(item)` for each item, in order, computed by several threads. Raises the errors of `work`.

    The items in progress, and those whose results are not yet yielded, have at most the size `max_size` together; a
    larger item is processed alone.
    """
    from concurrent.futures import ThreadPoolExecutor  # imported late: one item does not need it

    pending: deque[tuple[Future[Answer], int]] = deque()
    total = 0
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                size = size_of(item)
                while pending and (total + size > max_size or len(pending) >= AHEAD * threads):
                    future, finished_size = pending.popleft()
                    yield future.result()
                    total -= finished_size
                pending.append((pool.submit(work, item), size))
                total += size
            while pending:
                yield pending.popleft()[0].result()
        finally:
            for future, _ in pending:
                future.cancel()


def _size(pair: Result) -> int:
    """Return the number of values in both images; 0 if a file cannot be read, or if it is no pair of files."""
    files = [path for path in (pair.reference, pair.test) if path and path.is_file()]
    with contextlib.suppress(Exception):  # the comparison reports any error
        return sum(image_file.count_values(path, pair.how.max_values) for path in files) if len(files) == 2 else 0
    return 0


def without_images(result: Result) -> Result:
    """Return the result without its images and maps."""
    comparison = replace(result.comparison, maps={}) if result.comparison else None
    return replace(result, images={}, comparison=comparison)


def _compare_pair(result: Result, results: Results, *, keep: bool, digests: bool) -> Result:
    """Compare the two sides of a pair, if it has both, and return its result; with status ERROR after any error.

    `keep`: a result that is not equal keeps its images and maps, as far as they can be read. Each file is read once.
    """
    how = result.how
    result = replace(result, error=pairing.error_of(result, results.reference))

    decoded: dict[Path, str] | None = {} if digests else None  # the digests of the files that were read

    @functools.cache
    def read(path: Path) -> Sequence[Image] | Exception:
        """Return all renders of a folder, or all images of a file, or the error of reading them."""
        try:
            if results.renders:
                images = ((image, path) for image in pairing.images_in(path)[0].values())
                left_out = pairing.files_beside(result, results.reference, images)
                return file_pair.read_renders(path, how.max_values, left_out)
            return image_file.read_parts(path, how.max_values, decoded)
        except Exception as error:  # any error: `_judge` raises it again
            return error

    if how.skip and not how.error:
        return replace(result, error="", status=Status.SKIPPED)
    if result.error:
        result = replace(result, status=Status.ERROR)
    else:
        try:
            result = _judge(result, results.roots, read, functools.partial(image_file.read, digests=decoded))
            if decoded is not None:
                result = replace(result, digests=_digests(result, results.roots, decoded))
        except Exception as error:  # any error: the other pairs are still compared
            if safe_files.is_full_disk(error):  # the other pairs would fail, too
                raise
            errors.print_traceback(error)
            text = errors.describe(error)
            known = isinstance(error, ValueError | OSError)
            result = replace(result, status=Status.ERROR, error=text if known else f"{result.test}: {text}")
            if decoded is not None:
                with contextlib.suppress(ValueError, OSError):  # an image without digests is not accepted
                    result = replace(result, digests=_digests(result, results.roots, decoded))
    if not keep or result.status not in FAILED:
        return without_images(result)
    if result.images:
        return result
    images, unreadable = dict[str, Image](), []
    for role, path in (("reference", result.reference), ("test", result.test)):
        side = read(path) if path else ()
        try:
            if isinstance(side, Exception):
                raise side
            if side:
                images[role] = file_pair.mean_image(side)  # raises for renders of different sizes
        except Exception as error:  # the page says why an image is missing
            unreadable.append(one_line(str(error)))
    return replace(result, images=images, unread=" ".join(unreadable))


def _digests(result: Result, roots: tuple[Path, Path], decoded: Mapping[Path, str]) -> dict[Path, str]:
    """Return the digests of all files of a result; those in `decoded` are not computed again."""
    paths = [result.reference, result.test, *result.variants]
    if result.how.variance:
        sides = zip((result.target, result.test), roots, strict=True)
        paths += [pairing.beside(result.how.variance, path, root, result.how.above) for path, root in sides if path]
    return {path: decoded.get(path) or digest(path) for path in paths if path}


def _judge(result: Result, roots: tuple[Path, Path], read: Read, read_one: file_pair.ReadOne) -> Result:
    """Return the result of comparing the new image with the reference, or with the first variant that it is equal to.

    Without an equal one: an inconclusive result if there is any, else that of the reference. `read`: returns images or
    an error; `read_one`: see `file_pair.compare`.
    """
    reference, new = result.reference, result.test
    if not (reference and new):
        return result
    judged: list[Result] = []
    first_error: Exception | None = None
    for path in (reference, *result.variants):
        try:
            if path.samefile(new):
                raise ValueError(f"{new}: the same file as the reference {path}; expected two different files")
            one, two = read(path), read(new)
            if isinstance(one, Exception):
                raise one
            if isinstance(two, Exception):
                raise two
            judged.append(file_pair.compare(path, (one, two), result, roots, read_one))
        except (ValueError, OSError, MemoryError) as error:
            first_error = first_error or error  # raised below unless another reference is equal
            continue
        if judged[-1].status is Status.EQUAL:
            return replace(judged[-1], matched=path if path != reference else None)
    if first_error:
        raise first_error
    inconclusive = [result for result in judged if result.status is Status.INCONCLUSIVE]
    return (inconclusive or judged)[0]
