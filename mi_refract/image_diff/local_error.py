"""Where an error map is worst: what a person sees of a change does not depend on what else is in the image.

`local_error`: the largest mean in a window, for details. The smallest window is a square of 0.12 degrees of the
viewer's field, 7 arcminutes: a letter of the line 20/30 of an eye chart, so what is read without effort; 8 × 8 pixels
at 67 pixels per degree. Larger windows, each twice as wide, up to 7.7 degrees, are for wide and faint changes. Their
means count more, by the fourth root of the area in units of the smallest: as the threshold of a wide stimulus falls by
probability summation (Robson and Graham, Vision Research 21, 1981).

`patch_error`: the error that fills a window of 0.24 degrees, for surfaces. Edges that are drawn otherwise make large
errors along lines, and the FLIP error spreads to 0.07 degrees from them; they fill no such window.

Windows slide by single pixels, so a change counts as much wherever it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mi_refract.io.pixels import Pixels

WINDOW = 0.12  # degrees: the side of the smallest window
OCTAVES = 7
PATCH = 0.24  # degrees


@dataclass(frozen=True)
class Window:
    """The worst window of an error map, in pixels; `value`: what counts, `error`: its mean, or its smallest error."""

    value: float
    error: float
    x: int
    y: int
    width: int
    height: int


def windows(height: int, width: int, ppd: float) -> Iterator[tuple[int, int, float]]:
    """Height and width in pixels of every window in an image of this size, and its weight, at least 1.

    A window is as high and as wide as the image at most: of a smaller image it is the whole.
    """
    for octave in range(OCTAVES):
        side = _pixels(WINDOW * 2**octave, ppd)
        h, w = min(side, height), min(side, width)
        yield h, w, max(1.0, (h * w / (WINDOW * ppd) ** 2) ** 0.25)
        if side >= max(height, width):
            return


def local_error(error: Pixels, ppd: float) -> tuple[Window, Pixels]:
    """The window with the largest weighted mean of an error map, H × W, and the largest one around every pixel.

    `ppd`: pixels per degree. The weight of the smallest window is 1.
    """
    height, width = error.shape
    sums = np.zeros((height + 1, width + 1))
    np.cumsum(np.cumsum(error, 0, dtype=np.float64), 1, out=sums[1:, 1:])
    around, worst = np.zeros(error.shape, np.float32), []
    for h, w, weight in windows(height, width, ppd):
        means = (sums[h:, w:] - sums[:-h, w:] - sums[h:, :-w] + sums[:-h, :-w]) / (h * w)
        worst.append(_worst(np.maximum(means, 0), weight, w, h))  # a difference of sums may be −1e-16
        # At the centre of each window; next to the border those of the nearest window.
        missing = [(gap // 2, gap - gap // 2) for gap in (h - 1, w - 1)]
        np.maximum(around, np.pad(np.float32(weight) * means.astype(np.float32), missing, mode="edge"), out=around)
    return max(worst, key=lambda window: window.value), around


def patch_error(error: Pixels, ppd: float) -> Window:
    """The window with the largest error that is exceeded in all of it."""
    from scipy.ndimage import minimum_filter

    h, w = (min(_pixels(PATCH, ppd), size) for size in error.shape)
    inside = tuple(
        slice(side // 2, side // 2 + size - side + 1) for side, size in zip((h, w), error.shape, strict=True)
    )
    return _worst(minimum_filter(error, (h, w))[inside], 1.0, w, h)


def _pixels(degrees: float, ppd: float) -> int:
    return max(1, round(degrees * ppd))


def _worst(errors: Pixels, weight: float, width: int, height: int) -> Window:
    y, x = np.unravel_index(int(errors.argmax()), errors.shape)
    error = float(errors[y, x])
    return Window(weight * error, error, int(x), int(y), width, height)
