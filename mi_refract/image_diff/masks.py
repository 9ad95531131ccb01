"""Which pixels of an image count: a mask, an image in which white counts, and rectangles that are left out.

What does not count is 0 in both images before a method sees them, and shares of pixels are of those that count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mi_refract.io import image_file
from mi_refract.io.image_file import MAX_VALUES, Image

Mask = NDArray[np.bool_]  # H × W; True where a pixel counts
Rectangle = tuple[int, int, int, int]  # x, y, width and height, as the messages of the methods count pixels
WHITE = 0.5  # of a mask's largest colour: from there on a pixel counts
MOST = 0.5  # share of the pixels that may be left out without a warning


def made(reference: Image, path: Path | None, rectangles: Sequence[Rectangle], most: int = MAX_VALUES) -> Mask | None:
    """The pixels of the image that count; None where there is neither a mask nor a rectangle.

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


def applied(image: Image, mask: Mask | None) -> Image:
    """The image with 0 where the mask does not count, and with the mask; one of another size as it is.

    An image of another size is refused by every method. Here a single pixel would be spread over the mask's size.
    """
    if mask is None or image.pixels.shape[:2] != mask.shape:
        return image
    variances = {name: np.where(mask, variance, 0) for name, variance in image.variances.items()}
    return replace(image, pixels=np.where(mask[..., None], image.pixels, 0), mask=mask, variances=variances)


def warning(mask: Mask | None) -> str:
    """The warning for a mask that leaves out more than MOST; "" for others."""
    left_out = 0.0 if mask is None else 1 - float(mask.mean())
    return f"the mask leaves out {left_out:.0%} of the pixels" if left_out > MOST else ""
