"""Comparing files, and folders of them: every pair, as its settings say, and the results.

A pair that cannot be compared does not stop the others. Nothing here writes a file.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import stat
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from io import BufferedReader
from pathlib import Path

import numpy as np

from mi_refract.io import exit_code, image_file
from mi_refract.io.bounded_map import bounded_map
from mi_refract.io.image_file import MAX_VALUES, Image

from . import channels, masks, methods, pairing, parts, variances
from .comparison import Comparison, Verdict
from .pairing import Pair
from .results import FAILED, STATUSES, Result, Results, Status
from .settings import ComparisonSpec, Settings

AS_ASKED = Settings()
WORKERS = min(os.cpu_count() or 1, 8)
View = Callable[[Result, Results], None]


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
    tell: Callable[[int, int], None] = lambda done, of: None,
) -> Results:
    """Compare two files, two folders by the names of their images, or, with `renders`, two folders as one image.

    `names`: patterns of the images to compare; none: all. `view`: called with each result that is not equal, while it
    has its images and maps, and with what is known of all; by several threads at once. What it raises ends the
    comparison. `maps`: the results keep images and maps, which takes memory for all of them. `digests`: the results
    have those of their files. `to_accept`: so they do, and the reference need not exist yet. `tell(done, of)` is called
    after each image.

    Whatever goes wrong with one image is the error of its result. ValueError or OSError where there is nothing to
    compare: a path that does not exist, a file against a folder, an empty folder, a path within the other, a name that
    matches no image.
    """
    reference, test = Path(reference), Path(test)
    pairing.require_apart(reference, test, settings.maps, to_accept)
    every = _pairs(reference, test, settings, renders)
    unused = settings.unused([pair.name for pair in every]) if reference.is_dir() and not renders else []
    pairs = [*pairing.named(every, names), *pairing.wrong_entries(settings, every)]
    roots = tuple(path if path.is_dir() else path.parent for path in (reference, test))
    all_of_them = Results(
        reference, test, (), renders, inconclusive, tuple(unused), tuple(settings.flags), settings.of_file
    )
    asked = _Asked(roots, all_of_them, view, maps, (digests or to_accept) and not renders)
    # Together, the pairs that are compared at once have no more values than one pair may have.
    most = 2 * settings.default.max_values
    one = len(pairs) == 1
    results = map(asked.result, pairs) if one else bounded_map(asked.result, pairs, _values, most, WORKERS)
    found = []
    for result in results:
        found.append(result)
        tell(len(found), len(pairs))
    found.sort(key=lambda result: list(Status).index(result.status))
    return replace(all_of_them, results=tuple(found))


def _pairs(reference: Path, test: Path, settings: Settings, renders: bool) -> list[Pair]:
    if not renders:
        return pairing.pairs(reference, test, settings)
    if not (reference.is_dir() and test.is_dir()):
        raise NotADirectoryError(f"{test if reference.is_dir() else reference}; expected with --renders: a folder")
    name = reference.resolve().name
    return [Pair(name, reference, test, reference, settings.of(name))]


@dataclass(frozen=True)
class _Asked:
    """What is asked of every pair; see `diff`. `roots`: the folders of both sides."""

    roots: tuple[Path, ...]
    results: Results  # without the results of pairs
    view: View | None
    maps: bool
    digests: bool

    def result(self, pair: Pair) -> Result:
        """The result of comparing the two sides of a pair, after it was viewed."""
        found = _compared(pair, self)
        if self.view and found.status in FAILED:
            self.view(found, self.results)
        return found if self.maps or not found.images else _without_images(found)


def _values(pair: Pair) -> int:
    """The values of its two images; 0 for what cannot be read, or is no pair of files."""
    files = [path for path in (pair.reference, pair.test) if path and path.is_file()]
    if len(files) < 2:
        return 0
    with contextlib.suppress(Exception):  # of whatever kind: the comparison says it
        return sum(image_file.count_values(path, pair.how.max_values) for path in files)
    return 0


def _compared(pair: Pair, asked: _Asked) -> Result:
    """The result of comparing the two sides of a pair, where it has both; ERROR for whatever goes wrong."""
    result = Result(pair.name, Status.DIFFERENT, pair.reference, pair.test, pair.how)
    result = replace(result, target=pair.target, variants=pair.variants, error=pair.error or pair.how.error)
    if result.error:
        return replace(result, status=Status.ERROR)
    if result.how.skip:
        return replace(result, status=Status.SKIPPED)
    try:
        if asked.digests:  # before the images are read: what is read later and has the same digest is what was compared
            result = replace(result, digests=_digests(result, asked.roots))
        return _judged(result, asked)
    except Exception as error:  # of whatever kind: the other images are still to be compared
        exit_code.print_traceback(error)
        text = exit_code.describe(error)
        known = isinstance(error, ValueError | OSError)
        return replace(result, status=Status.ERROR, error=text if known else f"{result.test}: {text}")


def _digests(result: Result, roots: tuple[Path, ...]) -> Mapping[Path, str]:
    """Of its images, and of their variances."""
    how, paths = result.how, [result.reference, result.test, *result.variants]
    if how.reads_variance:
        sides = zip((result.target, result.test), roots, strict=True)
        paths += [pairing.beside(how.variance, path, root) for path, root in sides if path]
    return {path: digest(path) for path in paths if path}


def _without_images(result: Result) -> Result:
    """The result as it is kept: the images of hundreds would fill the memory."""
    comparison = replace(result.comparison, maps={}) if result.comparison else None
    return replace(result, images=(), comparison=comparison)


def _judged(result: Result, asked: _Asked) -> Result:
    """The verdict against the reference, or that of a variant to which the new image is equal."""
    if not (result.reference and result.test):
        return result
    read = functools.partial(_read, result, renders=asked.results.renders)
    new = result.test
    test = functools.cache(lambda: read(new))  # once, and after the reference: what it lacks is said first
    kept = asked.maps or asked.view is not None
    judged, failed = [], None
    for path in (result.reference, *result.variants):
        try:
            if path.samefile(new):
                raise ValueError(f"{new}: the same file as the reference {path}; expected two")
            one = _against(path, read(path), test(), result, asked.roots)
        except (ValueError, OSError, MemoryError) as error:
            failed = failed or error  # unless another reference is equal
            continue
        if one.comparison.verdict is Verdict.EQUAL:
            matched = path if path != result.reference else None
            return _with(replace(result, matched=matched), one, kept)
        judged.append(one)
    if failed:
        raise failed
    doubt = [one for one in judged if one.comparison.verdict is Verdict.INCONCLUSIVE]
    return _with(result, (doubt or judged)[0], kept)


@dataclass(frozen=True)
class _Judged:
    """Both images that the comparison is about, and what was found."""

    images: tuple[Image, Image]
    comparison: Comparison
    warning: str


def _read(result: Result, path: Path, renders: bool) -> list[Image]:
    """All renders of a folder, or all images of a file."""
    return read_renders(path, result.how.max_values) if renders else parts.read(path, result.how)


def _against(path: Path, reference: list[Image], test: list[Image], result: Result, roots: tuple[Path, ...]) -> _Judged:
    how, firsts = result.how, (channels.without_variances(images[0]) for images in (reference, test))
    whole = dict.fromkeys(name for image in firsts for name in image.channels)
    reference, test = (
        channels.chosen(_with_variance(images, root, how), how.channels, side)
        for side, (images, root) in enumerate(zip((reference, test), roots, strict=True))
    )
    if how.reads_variance and not (len(reference) > 1 or variances.has_variance(reference[0])):
        raise FileNotFoundError(f"{pairing.beside(how.variance, path, roots[0])}: no such file; expected a variance")
    file = pairing.beside(how.mask, result.target or path, roots[0]) if how.mask else None
    if (file or how.ignore) and reference[-1].place:
        raise ValueError(f"{path}: several parts or MIP levels; expected with a mask one image")
    mask = masks.made(reference[0], file, how.ignore, how.max_values)
    reference, test = ([masks.applied(image, mask) for image in side] for side in (reference, test))
    if path.is_dir():
        found = methods.compare(how.method, reference, test, named=[name for name, _ in how.channels], **how.options)
        images = mean_image(reference), mean_image(test)
    else:
        found, images = parts.compare(how, reference, test)
    if how.channels:  # what nobody looked at is said
        left = [name for name in whole if name not in {each for pair in how.channels for each in pair}]
        found = replace(found, reason=f"{found.reason}; not compared: {', '.join(left)}" if left else found.reason)
    return _Judged(images, found, masks.warning(mask))


def _with_variance(images: list[Image], root: Path, how: ComparisonSpec) -> list[Image]:
    """A single image with the variance that lies beside it, where the settings name one and it is there."""
    if not how.reads_variance or len(images) > 1:
        return images
    file = pairing.beside(how.variance, images[0].path, root)
    if file == images[0].path:
        raise ValueError(f"variance = {how.variance!r}: is {file} itself; expected the name of another image")
    return [variances.with_file(images[0], file, how.max_values)] if file.exists() else images


def _with(result: Result, one: _Judged, kept: bool) -> Result:
    found = one.comparison
    kept = kept and found.verdict is not Verdict.EQUAL
    images = one.images if kept else ()
    mask = one.images[0].mask
    left_out = {} if mask is None else {"left out": (~mask).astype(np.float32)}
    comparison = replace(found, maps=found.maps | left_out if kept else {})
    warnings = tuple(filter(None, (one.warning,)))
    return replace(result, status=STATUSES[found.verdict], comparison=comparison, images=images, warnings=warnings)


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
    raise ValueError(f"{path}: expected a regular file")


def read_renders(folder: Path, max_values: int = MAX_VALUES) -> list[Image]:
    """The renders of one image in a folder. ValueError where two are the same, seed and all; otherwise as `read`."""
    found, failed = pairing.images_in(folder)
    if failed:
        raise OSError(failed[0][1])
    if not found:
        raise ValueError(f"{folder}: holds no image; expected several renders of one")
    read = functools.partial(image_file.read, max_values=max_values)
    images = list(bounded_map(read, found.values(), lambda path: 0, max_values, WORKERS))  # all are needed at once
    sums: dict[float, Image] = {}
    for image in images:
        other = sums.setdefault(float(image.pixels.sum(dtype=np.float64)), image)
        if other is not image and np.array_equal(image.pixels, other.pixels):
            raise ValueError(f"{image.path}: the same pixels as {other.path}; expected renders of different seeds")
    return images


def mean_image(images: Sequence[Image]) -> Image:
    """The first image with the mean of the pixels of all; one image as it is."""
    first = images[0]
    if len(images) == 1:
        return first
    pixels = sum((each.pixels for each in images[1:]), start=first.pixels) / np.float32(len(images))
    return replace(first, pixels=pixels)
