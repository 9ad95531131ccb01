"""Comparing a new image with one reference: two files, or two folders of renders, with what the settings say of them.

In files with several images each part and MIP level is compared with the one of the same number. The verdict is the
worst of them, with the place of the image that it is about. A part or level that only one of the files has is a
difference. What a mask leaves out is 0 in both images before a method sees them, and shares of pixels are of those that
count.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mi_refract.io import image_file
from mi_refract.io.image_file import MAX_VALUES, Image

from . import channels, methods, pairing
from .comparison import Comparison, Verdict
from .results import Result, Status
from .settings import ComparisonSpec, Rectangle

THREADS = 8
WHITE = 0.5  # of a mask's largest colour: from there on a pixel counts
MOST = 0.5  # share of the pixels that a mask may leave out without a warning
ReadOne = Callable[[Path, int], Image]
Mask = NDArray[np.bool_]  # H × W; True where a pixel counts


def read_renders(folder: Path, max_values: int = MAX_VALUES) -> list[Image]:
    """The renders of one image in a folder. Errors: of `image_file.read`, and ValueError for equal ones."""
    from concurrent.futures import ThreadPoolExecutor  # not needed for files

    paths, failed, _ = pairing.images_in(folder)
    if failed:
        raise OSError(failed[0][1])
    if not paths:
        raise ValueError(f"{folder}: contains no image; expected several renders of one image")
    read = functools.partial(image_file.read, max_values=max_values)
    with ThreadPoolExecutor(THREADS) as pool:
        images = list(pool.map(read, paths.values()))
    sums: dict[float, Image] = {}
    for image in images:
        other = sums.setdefault(float(image.pixels.sum(dtype=np.float64)), image)
        if other is not image and np.array_equal(image.pixels, other.pixels):
            raise ValueError(f"{image.path}: the same pixels as {other.path}; expected renders with different seeds")
    return images


def mean_image(images: Sequence[Image]) -> Image:
    """The first image with the mean of the pixels of all; one image, or the first of several parts, as it is."""
    first = images[0]
    if len(images) == 1 or first.place:
        return first
    pixels = sum((image.pixels for image in images[1:]), start=first.pixels) / np.float32(len(images))
    return replace(first, pixels=pixels)


def compare(
    path: Path,
    sides: tuple[Sequence[Image], Sequence[Image]],
    result: Result,
    roots: tuple[Path, Path],
    read: ReadOne = image_file.read,
) -> Result:
    """The result with the verdict on the images of both sides, as `result.how` says, and with images and maps.

    `path`: of the reference, `roots`: the folders, `read`: for variances. ValueError or OSError where a mask or a
    variance is missing or does not fit, and as `methods.compare`, with the place of the image.
    """
    how = result.how
    bare = [channels.without_variances(images[0]) for images in sides]
    whole = dict.fromkeys(name for image in bare for name in image.channels)
    selected = []
    for side, (renders, root) in enumerate(zip(sides, roots, strict=True)):
        if how.reads_variance and len(renders) == 1:
            beside = pairing.beside(how.variance, renders[0].path, root, how.above)
            if beside == renders[0].path:
                raise ValueError(f"variance = {how.variance!r}: names {beside} itself; expected another image")
            renders = [channels.with_file(renders[0], read(beside, how.max_values))] if beside.exists() else renders
        selected.append(channels.chosen(renders, how.channels, side))
    reference, test = selected
    if how.reads_variance and not (len(reference) > 1 or channels.has_variance(reference[0])):
        beside = pairing.beside(how.variance, path, roots[0], how.above)
        raise FileNotFoundError(f"{beside}: no such file; expected a variance")
    file = pairing.beside(how.mask, result.target, roots[0], how.above) if how.mask else None
    if (file or how.ignore) and reference[-1].place:
        raise ValueError(f"{path}: has several parts or MIP levels; masks are supported for single images only")
    mask = mask_of(reference[0], file, how.ignore, how.max_values)
    if mask is not None:
        for several in selected:
            for place, image in enumerate(several):
                if image.pixels.shape[:2] == mask.shape:  # else every method refuses it; one pixel would be spread here
                    kept = np.where(mask[..., None], image.pixels, 0)
                    spread = {name: np.where(mask, variance, 0) for name, variance in image.variances.items()}
                    several[place] = replace(image, pixels=kept, mask=mask, variances=spread)
    if path.is_dir():
        comparison = methods.compare(how.method, reference, test, named=[one for one, _ in how.channels], **how.options)
        one, two = mean_image(reference), mean_image(test)
    else:
        comparison, (one, two) = _compare_parts(how, reference, test)
    chosen = {name for pair in how.channels for name in pair}
    if chosen and (left := [name for name in whole if name not in chosen]):  # what was not compared is reported
        comparison = replace(comparison, reason=f"{comparison.reason}; not compared: {', '.join(left)}")
    warnings: tuple[str, ...] = ()
    if mask is not None:
        if mask.mean() < 1 - MOST:
            warnings = (f"the mask leaves out {1 - float(mask.mean()):.0%} of the pixels",)
        comparison = replace(comparison, maps=comparison.maps | {"left out": (~mask).astype(np.float32)})
    images = {"reference": one, "test": two}
    status = Status(str(comparison.verdict))
    return replace(result, status=status, comparison=comparison, warnings=warnings, images=images)


def _compare_parts(
    how: ComparisonSpec, reference: Sequence[Image], test: Sequence[Image]
) -> tuple[Comparison, tuple[Image, Image]]:
    """The worst comparison of all parts that both files have, and the two images that it is about."""
    one, two = ({image.part: image for image in side} for side in (reference, test))
    compared: dict[tuple[int, int], Comparison] = {}
    places = {part: one[part].place or two[part].place for part in one if part in two}
    named = [name for name, _ in how.channels]
    for part, place in places.items():
        try:
            compared[part] = methods.compare(how.method, [one[part]], [two[part]], named=named, **how.options)
        except ValueError as error:
            raise ValueError(f"{error} ({place})" if place else str(error)) from None
    shown = min(compared, key=lambda part: [*Verdict].index(compared[part].verdict))
    worst, reason = compared[shown], compared[shown].reason
    if places[shown]:
        alike = sum(comparison.verdict is worst.verdict for comparison in compared.values())
        reason = f"{places[shown]}: {reason}; {worst.verdict}: {alike} of {len(compared)} parts and MIP levels"
    verdict, warning = worst.verdict, ""
    warned = [part for part in compared if compared[part].warning]
    if warned and verdict is not Verdict.DIFFERENT:
        place = f"{places[warned[0]]}: " if places[warned[0]] else ""
        more = f", and in {len(warned) - 1} more parts and MIP levels" if len(warned) > 1 else ""
        warning = f"{place}{compared[warned[0]].warning}{more}"
    if lone := sorted(one.keys() ^ two.keys()):
        more = f", and {len(lone) - 1} more" if len(lone) > 1 else ""
        changed = "is missing" if lone[0] in one else "was added"
        verdict, warning = Verdict.DIFFERENT, ""
        reason = f"{(one | two)[lone[0]].place} {changed}{more}; {reason}"
    return replace(worst, verdict=verdict, reason=reason, warning=warning, part=shown), (one[shown], two[shown])


# Masks --------------------------------------------------------------------------------------------------------------


def mask_of(
    reference: Image, path: Path | None, rectangles: Sequence[Rectangle], most: int = MAX_VALUES
) -> Mask | None:
    """The pixels of the image that count, by a mask, in which white counts, and rectangles; None where there is none.

    OSError for a mask that cannot be read; ValueError for one of another size, for a rectangle without a pixel of the
    image, and where no pixel is left.
    """
    if path is None and not rectangles:
        return None
    height, width = reference.pixels.shape[:2]
    counts: Mask = np.ones((height, width), bool)
    if path is not None:
        image = image_file.read(path, most)
        if image.pixels.shape[:2] != (height, width):
            size = f"{image.pixels.shape[1]} × {image.pixels.shape[0]}"
            raise ValueError(f"{path}: {size}; expected a mask of {width} × {height}")
        colours = image.select([name for name in image.channels if name != "A"] or image.channels)
        if not np.isfinite(colours).all():
            raise ValueError(f"{path}: values that are not finite; expected a mask from 0 to 1")
        counts = colours.max(-1) >= WHITE
    for x, y, columns, rows in rectangles:
        left, top = x - reference.origin[0], y - reference.origin[1]
        part = counts[max(top, 0) : max(top + rows, 0), max(left, 0) : max(left + columns, 0)]
        if not part.size:
            ignore = [x, y, columns, rows]
            raise ValueError(f"ignore = {ignore}; expected a rectangle that overlaps {reference.path}")
        part[:] = False
    if not counts.any():
        raise ValueError(f"{path or 'ignore'}: leaves no pixel of {reference.path}; expected at least one")
    return counts
