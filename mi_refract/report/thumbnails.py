"""Small images beside a page, as PNG: an image as light, and a signed difference in the page's colours."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.pixels import Pixels, block_mean, srgb_encode

from .embedded_images import strongest

SIDE, DIFFERENCE_SIDE = 160, 64  # pixels of the longer side, at most; of a difference one alone is to be seen
NOT_A_NUMBER = np.array((255, 0, 255), np.uint8)  # as in the page's script
EQUAL, LESS, MORE = np.array((247, 247, 247)), np.array((33, 102, 172)), np.array((178, 24, 43))
Bytes = NDArray[np.uint8]


def of_image(pixels: Pixels, coded: bool) -> bytes:
    """H × W × (1 or 3) pixels; `coded`: they are sRGB codes, else linear light."""
    small = block_mean(pixels, -(-max(pixels.shape[:2]) // SIDE))
    unit = np.clip(np.nan_to_num(small), 0, 1)
    codes = unit if coded else srgb_encode(unit)
    rgb = np.broadcast_to(np.rint(255 * codes), (*small.shape[:2], 3)).astype(np.uint8)
    return png(np.where(np.isnan(small).any(-1, keepdims=True), NOT_A_NUMBER, rgb))


def of_difference(values: Pixels) -> bytes:
    """H × W × C differences, of every block the strongest; colours are full at the upper hundredth of what is not 0."""
    block = -(-max(values.shape[:2]) // DIFFERENCE_SIDE)
    small = strongest(values, max(values.shape[1] // block, 1))[..., 0]
    finite = np.where(np.isfinite(small), small, np.copysign(np.inf, small))
    some = np.abs(finite[np.isfinite(small) & (small != 0)])
    full = float(np.quantile(some, 0.99)) if some.size else 1.0
    share = np.clip(np.abs(finite) / full, 0, 1)[..., None]
    rgb = EQUAL + (np.where(finite[..., None] < 0, LESS, MORE) - EQUAL) * share
    return png(np.where(np.isnan(small)[..., None], NOT_A_NUMBER, np.rint(rgb).astype(np.uint8)))


def png(rgb: Bytes) -> bytes:
    """H × W × 3 bytes as a PNG file (ISO/IEC 15948)."""
    height, width, _ = rgb.shape
    lines = np.concatenate([np.zeros((height, 1), np.uint8), rgb.reshape(height, -1)], 1)  # each with filter 0
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n"
    for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes(), 6)), (b"IEND", b"")):
        content += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return content
