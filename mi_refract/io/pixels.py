"""Arithmetic on arrays of pixels that several rooms need: the sRGB curve, and sums and means over blocks."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.floating[Any]]
FEW_CHANNELS = 8


def srgb_encode(linear: Pixels) -> Pixels:
    """The sRGB code, 0 to 1, of linear light of at least 0, value by value (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def srgb_decode(code: Pixels) -> Pixels:
    """The linear light of sRGB codes; the inverse of `srgb_encode` (IEC 61966-2-1)."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def any_channel(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """`flags.any(-1)`, of few channels ten times as fast: NumPy takes long for many short reductions."""
    few = 0 < flags.shape[-1] <= FEW_CHANNELS
    found: NDArray[np.bool_] = functools.reduce(np.logical_or, np.moveaxis(flags, -1, 0)) if few else np.any(flags, -1)
    return found


def block_sum(pixels: Pixels, side: int) -> Pixels:
    """Sums over side × side blocks of H × W × C pixels, or of stacks of them: … × ⌈H/side⌉ × ⌈W/side⌉ × C.

    Blocks at the right and lower edge are of what is left.
    """
    rows, columns = np.arange(0, pixels.shape[-3], side), np.arange(0, pixels.shape[-2], side)
    sums: Pixels = np.add.reduceat(np.add.reduceat(pixels, rows, -3), columns, -2)
    return sums


def block_area(height: int, width: int, side: int) -> Pixels:
    """The number of pixels in each block of `block_sum`, with a last axis of length 1."""
    rows, columns = (np.diff(np.arange(0, size, side), append=size) for size in (height, width))
    return np.outer(rows, columns)[..., None].astype(np.float64)


def block_mean(pixels: Pixels, side: int) -> Pixels:
    """Means over the blocks of `block_sum`, in the precision of `pixels`."""
    with np.errstate(invalid="ignore"):
        sums = block_sum(pixels, side)
    return sums / block_area(pixels.shape[-3], pixels.shape[-2], side).astype(pixels.dtype)
