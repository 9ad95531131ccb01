"""Comparison of a new image with one reference: two files, or two folders of renders, by their settings.

In files with several images, every part and MIP level is compared with that of the same number. The result is that of
the worst one, and names it. A part or level that only one file has is a difference. Pixels that a mask excludes are set
to 0 in both images before a method is applied, and shares of pixels are shares of the others.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mi_refract.io import image_file
from mi_refract.io.image_file import MAX_VALUES, Image

from . import channels, methods, pairing
from .comparison import Comparison, Verdict, require_window
from .results import Result, Status
from .settings import ComparisonSpec, Rectangle

THREADS = 8
WHITE = 0.5  # a pixel is compared if the largest colour of the mask is at least this
EXCLUDED = 0.5  # share of the pixels that a mask may exclude without a warning
ReadOne = Callable[[Path, int], Image]  # the arguments: path, maximum number of values
Mask = NDArray[np.bool_]  # H × W; True where a pixel is compared


def read_renders(folder: Path, max_values: int = MAX_VALUES, left_out: Collection[Path] = ()) -> list[Image]:
    """Return the renders in a folder, except the paths `left_out`.

    Errors: those of `image_file.read`, and ValueError for two identical renders.
    """
    from concurrent.futures import ThreadPoolExecutor  # not needed for files

    images_in_folder, failed, _ = pairing.images_in(folder)
    if failed:
        raise OSError(failed[0][1])
    if not (paths := [path for path in images_in_folder.values() if path not in left_out]):
        raise ValueError(f"{folder}: contains no image; expected several renders of one image")
    read = functools.partial(image_file.read, max_values=max_values)
    with ThreadPoolExecutor(THREADS) as pool:
        images = list(pool.map(read, paths))
    by_digest: dict[bytes, Image] = {}
    for image in images:
        other = by_digest.setdefault(hashlib.sha256(image.pixels.tobytes()).digest(), image)
        if other is not image:
            raise ValueError(f"{image.path}: the same pixels as {other.path}; expected renders with different seeds")
    return images


def mean_image(images: Sequence[Image]) -> Image:
    """Return the first image with the mean pixels of all renders; for the parts of a file, the first part."""
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
    """Return the result with the verdict on the images of both sides by `result.how`, and with images and maps.

    `path`: the reference; `roots`: the folders of both sides; `read`: reads variances. ValueError or OSError if a mask
    or a variance is missing or does not fit, and the errors of `methods.compare`, with the part of the file.
    """
    how = result.how
    without_variances = [channels.without_variances(images[0]) for images in sides]
    all_channels = dict.fromkeys(name for image in without_variances for name in image.channels)
    selected = []
    for side, (renders, root) in enumerate(zip(sides, roots, strict=True)):
        if how.reads_variance and len(renders) == 1:
            variance_path = pairing.beside(how.variance, renders[0].path, root, how.above)
            if variance_path == renders[0].path:
                raise ValueError(f"variance = {how.variance!r}: names {variance_path} itself; expected another image")
            if variance_path.exists():
                renders = [channels.with_file(renders[0], read(variance_path, how.max_values))]
        names = {pair[side]: pair[0] for pair in how.channels}  # new names, those of the reference, by old ones
        selected.append([channels.selected(image, names) if names else image for image in renders])
    reference, test = selected
    if how.reads_variance and not (len(reference) > 1 or channels.has_variance(reference[0])):
        variance_path = pairing.beside(how.variance, path, roots[0], how.above)
        raise FileNotFoundError(f"{variance_path}: no such file; expected a variance")
    mask_path = pairing.beside(how.mask, result.target, roots[0], how.above) if how.mask else None
    if (mask_path or how.ignore or how.reads_variance) and reference[-1].place:
        raise ValueError(f"{path}: several parts or MIP levels; for masks and `variance` expected a single image")
    if (mask := mask_of(reference[0], mask_path, how.ignore, how.max_values)) is not None:
        for images in selected:
            for i, image in enumerate(images):
                if image.pixels.shape[:2] == mask.shape:  # every method rejects other sizes
                    pixels = np.where(mask[..., None], image.pixels, 0)
                    variances = {name: np.where(mask, variance, 0) for name, variance in image.variances.items()}
                    images[i] = replace(image, pixels=pixels, mask=mask, variances=variances)
    if path.is_dir():
        named = [name for name, _ in how.channels]
        comparison = methods.compare(how.method, reference, test, named=named, **how.options)
        one, two = mean_image(reference), mean_image(test)
    else:
        comparison, (one, two) = _compare_parts(how, reference, test)
    chosen = {name for pair in how.channels for name in pair}
    not_compared = [name for name in all_channels if name not in chosen]
    if chosen and not_compared:
        comparison = replace(comparison, reason=f"{comparison.reason}; not compared: {', '.join(not_compared)}")
    warnings: tuple[str, ...] = ()
    if mask is not None:
        if mask.mean() < 1 - EXCLUDED:
            warnings = (f"the mask leaves out {1 - float(mask.mean()):.0%} of the pixels",)
        comparison = replace(comparison, maps=comparison.maps | {"left out": (~mask).astype(np.float32)})
    status = Status(str(comparison.verdict))
    shown = {"reference": one, "test": two}
    return replace(result, status=status, comparison=comparison, warnings=warnings, images=shown)


def _compare_parts(
    how: ComparisonSpec, reference: Sequence[Image], test: Sequence[Image]
) -> tuple[Comparison, tuple[Image, Image]]:
    """Return the worst comparison of all parts that both files have, and the two images that it is about."""
    old, new = ({image.part: image for image in side} for side in (reference, test))
    comparisons: dict[tuple[int, int], Comparison] = {}
    places = {part: old[part].place or new[part].place for part in old if part in new}
    named = [name for name, _ in how.channels]
    for part, place in places.items():
        try:
            comparisons[part] = methods.compare(how.method, [old[part]], [new[part]], named=named, **how.options)
        except ValueError as error:
            raise ValueError(f"{error} ({place})" if place else str(error)) from None
    worst_part = min(comparisons, key=lambda part: [*Verdict].index(comparisons[part].verdict))
    worst = comparisons[worst_part]
    verdict, reason, warning = worst.verdict, worst.reason, ""
    if place := places[worst_part]:
        count = sum(comparison.verdict is verdict for comparison in comparisons.values())
        reason = f"{place}: {reason}; {verdict}: {count} of {len(comparisons)} parts and MIP levels"
    with_warning = [part for part in comparisons if comparisons[part].warning]
    if with_warning and verdict is not Verdict.DIFFERENT:
        first = with_warning[0]
        prefix = f"{places[first]}: " if places[first] else ""
        more = f", and in {len(with_warning) - 1} more parts and MIP levels" if len(with_warning) > 1 else ""
        warning = f"{prefix}{comparisons[first].warning}{more}"
    if unpaired := sorted(old.keys() ^ new.keys()):
        more = f", and {len(unpaired) - 1} more" if len(unpaired) > 1 else ""
        change = "is missing" if unpaired[0] in old else "was added"
        verdict, warning = Verdict.DIFFERENT, ""
        reason = f"{(old | new)[unpaired[0]].place} {change}{more}; {reason}"
    images = old[worst_part], new[worst_part]
    return replace(worst, verdict=verdict, reason=reason, warning=warning, part=worst_part), images


# Masks --------------------------------------------------------------------------------------------------------------


def mask_of(
    reference: Image, path: Path | None, rectangles: Sequence[Rectangle], max_values: int = MAX_VALUES
) -> Mask | None:
    """Return the pixels to compare: where the mask at `path` is WHITE, outside of the rectangles; None without both.

    OSError if the mask cannot be read; ValueError if it has another size or shows another part of the frame, if a
    rectangle does not overlap the image, and if no pixel is left.
    """
    if path is None and not rectangles:
        return None
    height, width = reference.pixels.shape[:2]
    compared: Mask = np.ones((height, width), bool)
    if path is not None:
        image = image_file.read(path, max_values)
        require_window(image, reference, "mask")
        colours = image.select([name for name in image.channels if name != "A"] or image.channels)
        if not np.isfinite(colours).all():
            raise ValueError(f"{path}: values that are not finite; expected a mask from 0 to 1")
        compared = colours.max(-1) >= WHITE
    for x, y, columns, rows in rectangles:
        left, top = x - reference.origin[0], y - reference.origin[1]
        overlap = compared[max(top, 0) : max(top + rows, 0), max(left, 0) : max(left + columns, 0)]
        if not overlap.size:
            ignore = [x, y, columns, rows]
            raise ValueError(f"ignore = {ignore}; expected a rectangle that overlaps {reference.path}")
        overlap[:] = False
    if not compared.any():
        raise ValueError(f"{path or 'ignore'}: leaves no pixel of {reference.path}; expected at least one")
    return compared
