"""Comparing files, and folders of them: every pair, as its settings say, and the results.

A pair that cannot be compared does not stop the others. Nothing here writes a file.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from mi_refract.io import errors, image_file, safe_files
from mi_refract.io.image_file import Image, one_line

from . import file_pair, pairing
from .results import FAILED, Result, Results, Status
from .settings import Settings

if TYPE_CHECKING:
    from concurrent.futures import Future

AS_ASKED = Settings()
WORKERS = min(os.cpu_count() or 1, 8)
AHEAD = 2  # pairs in hand for each thread: a slow one does not leave the others idle at once
Item = TypeVar("Item")
Answer = TypeVar("Answer")
View = Callable[[Result, Results], None]
Read = Callable[[Path], Sequence[Image] | Exception]


def diff(
    reference: str | Path,
    test: str | Path,
    settings: Settings = AS_ASKED,
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

    `names`: patterns of the images to compare; none: all. `view`: called with each result that is not equal, while it
    has its images and maps, and with what is known of all; by several threads at once. What it raises ends the
    comparison. `maps`: the results keep images and maps, which takes memory for all of them. `digests`: the results
    have the SHA-256 of their files. `to_accept`: so they do, and the reference need not exist yet. `progress(done,
    total)` is called after each image.

    Whatever goes wrong with one image is the error of its result. ValueError or OSError where there is nothing to
    compare: a path that does not exist, a file against a folder, an empty folder, a path within the other, a name that
    matches no image.
    """
    reference, test = Path(reference), Path(test)
    pairing.require_apart(reference, test, settings.maps, to_accept)
    if not renders:
        every = pairing.pairs(reference, test, settings)
    elif reference.is_dir() and test.is_dir():
        name = reference.resolve().name
        how = replace(replace(settings, above=settings.above.parent).of(name), above=settings.above)
        every = [Result(name, Status.DIFFERENT, reference, test, how, target=reference)]
    else:
        raise NotADirectoryError(
            f"{test if reference.is_dir() else reference}: not a folder; --renders expects folders"
        )
    unused: list[str] = []
    if reference.is_dir() and not renders:
        unused = settings.unused([pair.name for pair in every])
        unused += [] if to_accept else pairing.unused_templates(every)  # what is accepted may be the first
    pairs = [*pairing.named(every, names), *pairing.wrong_entries(settings, every)]
    results = Results(reference, test, (), renders, inconclusive, tuple(unused), settings.flags)

    def compare(pair: Result) -> Result:
        result = _compared(pair, results, keep=maps or view is not None, digests=(digests or to_accept) and not renders)
        if view and result.status in FAILED:
            view(result, results)
        return result if maps else without_images(result)  # those of hundreds would fill the memory

    # Together, the pairs that are compared at once have no more values than one pair may have.
    most = 2 * settings.max_values
    compared = map(compare, pairs) if len(pairs) == 1 else bounded_map(compare, pairs, _values, most, WORKERS)
    done: list[Result] = []
    for result in compared:
        done.append(result)
        progress(len(done), len(pairs))
    return replace(results, results=tuple(sorted(done, key=lambda result: result.order)))


def bounded_map(
    work: Callable[[Item], Answer], items: Iterable[Item], takes: Callable[[Item], int], most: int, threads: int
) -> Iterator[Answer]:
    """Yield `work(item)` for each item, in order, from several threads. Raises what `work` raises.

    Items at work, and answers that wait for their turn, take `most` together; one that takes more is alone.
    """
    from concurrent.futures import ThreadPoolExecutor  # not needed for one item

    pending: deque[tuple[Future[Answer], int]] = deque()
    taken = 0
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                more = takes(item)
                while pending and (taken + more > most or len(pending) >= AHEAD * threads):
                    future, less = pending.popleft()
                    yield future.result()
                    taken -= less
                pending.append((pool.submit(work, item), more))
                taken += more
            while pending:
                yield pending.popleft()[0].result()
        finally:
            for future, _ in pending:
                future.cancel()


def _values(pair: Result) -> int:
    """The values of its two images; 0 for what cannot be read, or is no pair of files."""
    files = [path for path in (pair.reference, pair.test) if path and path.is_file()]
    with contextlib.suppress(Exception):  # of whatever kind: the comparison reports it
        return sum(image_file.count_values(path, pair.how.max_values) for path in files) if len(files) == 2 else 0
    return 0


def without_images(result: Result) -> Result:
    """The result without its images and maps."""
    comparison = replace(result.comparison, maps={}) if result.comparison else None
    return replace(result, images={}, comparison=comparison)


def _compared(result: Result, results: Results, *, keep: bool, digests: bool) -> Result:
    """The result of comparing the two sides of a pair, where it has both; ERROR for whatever goes wrong.

    `keep`: one that is not equal has its images and maps, or what can be read of them. Each file is read once.
    """
    how = result.how
    result = replace(result, error=result.error or how.error)

    decoded: dict[Path, str] | None = {} if digests else None  # the digests of what was read

    @functools.cache
    def read(path: Path) -> Sequence[Image] | Exception:
        """All renders of a folder, or all images of a file; or why they cannot be read."""
        try:
            if results.renders:
                return file_pair.read_renders(path, how.max_values)
            return image_file.read_parts(path, how.max_values, decoded)
        except Exception as error:  # of whatever kind: it is raised where the images are compared
            return error

    if how.skip and not how.error:
        return replace(result, error="", status=Status.SKIPPED)
    if result.error:
        result = replace(result, status=Status.ERROR)
    else:
        try:
            result = _judged(result, results.roots, read, functools.partial(image_file.read, digests=decoded))
            if decoded is not None:
                result = replace(result, digests=_digests(result, results.roots, decoded))
        except Exception as error:  # of whatever kind: the other images are still to be compared
            if safe_files.is_full_disk(error):  # which no image could be copied to
                raise
            errors.print_traceback(error)
            text = errors.describe(error)
            known = isinstance(error, ValueError | OSError)
            result = replace(result, status=Status.ERROR, error=text if known else f"{result.test}: {text}")
            if decoded is not None:
                with contextlib.suppress(ValueError, OSError):  # without digests it is not accepted
                    result = replace(result, digests=_digests(result, results.roots, decoded))
    if not keep or result.status not in FAILED:
        return without_images(result)
    if result.images:
        return result
    images, unread = dict[str, Image](), []
    for role, path in (("reference", result.reference), ("test", result.test)):
        side = read(path) if path else ()
        try:
            if isinstance(side, Exception):
                raise side
            if side:
                images[role] = file_pair.mean_image(side)  # renders of several sizes have none
        except Exception as error:  # the page says why it lacks the image
            unread.append(one_line(str(error)))
    return replace(result, images=images, unread=" ".join(unread))


def _digests(result: Result, roots: tuple[Path, Path], decoded: Mapping[Path, str]) -> dict[Path, str]:
    """The digests of all files of a result: of what was decoded, and of what there was no need to decode."""
    paths = [result.reference, result.test, *result.variants]
    if result.how.reads_variance:
        sides = zip((result.target, result.test), roots, strict=True)
        paths += [pairing.beside(result.how.variance, path, root, result.how.above) for path, root in sides if path]
    return {path: decoded.get(path) or digest(path) for path in paths if path}


def _judged(result: Result, roots: tuple[Path, Path], read: Read, read_one: file_pair.ReadOne) -> Result:
    """The verdict against the reference, or that of a variant to which the new image is equal."""
    reference, new = result.reference, result.test
    if not (reference and new):
        return result
    judged: list[Result] = []
    failed: Exception | None = None
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
            failed = failed or error  # unless another reference is equal
            continue
        if judged[-1].status is Status.EQUAL:
            return replace(judged[-1], matched=path if path != reference else None)
    if failed:
        raise failed
    doubt = [each for each in judged if each.status is Status.INCONCLUSIVE]
    return (doubt or judged)[0]


def digest(path: Path | None) -> str:
    """The SHA-256 of a file's bytes; "" where there is none. OSError, and ValueError, as `safe_files.opened`."""
    if path is None or not path.exists():
        return ""
    with safe_files.opened(path, sys.maxsize) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
