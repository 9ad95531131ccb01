"""The images of a page, as base64 of deflated planes of half floats, which the page's script decodes."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Pixels, block_mean, read

Codes = NDArray[np.uint16]  # the bits of halves
LARGEST = 65504.0  # the largest finite half
LINES = 64  # image rows that are converted at once
# Numbers of mantissa bits to clear, tried before an image is made smaller; with 6 the relative error is up to 1/32.
ROUNDED = (0, 2, 4, 6)


class EmbeddedImages:
    """The images of one page, each file once. A finite value beyond ±65504 becomes ±65504. Errors: see `embed`."""

    def __init__(self, folder: Path = Path()) -> None:
        """`folder`: the folder that the paths given to `embed` are relative to."""
        self.folder = folder
        self.embedded: list[dict[str, Any]] = []
        self._files: dict[str, dict[str, Any]] = {}

    def embed(self, path: str) -> dict[str, Any]:
        """Return key, width, height and data of an image at full size; `path`: relative to the folder.

        Errors, with the path: FileNotFoundError if it is missing, ValueError if it is neither RGB nor gray.
        """
        if path not in self._files:
            image = read(self.folder / path)
            is_rgb = {*"RGB"} <= {*image.channels}
            if not is_rgb and len(image.channels) != 1:
                raise ValueError(f"{image.path}: neither RGB nor gray, but channels {', '.join(image.channels)}")
            self._files[path] = self.add(encoded(image.select("RGB") if is_rgb else image.pixels))
        return self._files[path]

    def add(self, image: dict[str, Any]) -> dict[str, Any]:
        """Add an image from `encoded` to the page, with a new key, and return it."""
        self.embedded.append(image | {"key": f"p{len(self.embedded)}"})
        return self.embedded[-1]


def encoded(pixels: Pixels, limit: float = np.inf, scale: float = 1.0) -> dict[str, Any]:
    """Return H × W × (1 or 3) pixels / `scale` as base64 of at most about `limit` bytes.

    If they are too large, estimated from some rows, values are rounded, and then blocks of pixels are averaged; `note`
    says so.
    """
    side, codes, bits = 1, _halves(pixels, scale), None
    while codes.nbytes * 4 / 3 > limit:  # of base64
        sample = codes[::16]
        share = len(codes) / len(sample) * 4 / 3
        sizes = ((bits, share * len(_deflated(_rounded(sample, bits)))) for bits in ROUNDED)
        bits = next((bits for bits, size in sizes if size <= limit), None)
        if bits is not None or max(pixels.shape[:2]) <= side:
            break
        side *= 2
        codes = _halves(block_mean(pixels, side), scale)
    notes = [f"means of {side} × {side} pixels"] if side > 1 else []
    notes += [f"values within {100 * 2.0 ** (bits - 11):.2g} %"] if bits else []
    size = dict(zip(("height", "width", "channels"), codes.shape, strict=True))
    data = base64.b64encode(_deflated(_rounded(codes, bits or 0))).decode()
    return {**size, "scale": float(scale), "data": data, "note": ", ".join(notes)}


def packed(text: str) -> str:
    """Return text as base64 of its deflated UTF-8, which the page's script decodes."""
    return base64.b64encode(zlib.compress(text.encode(), 9)).decode()


def strongest(values: Pixels, width: int) -> Pixels:
    """Return H × W × C values as one channel of at most `width` columns: the value of largest magnitude of each block.

    In a mean, errors could cancel and a single pixel would hardly show. NaN counts as larger than any number.
    """
    side = -(-values.shape[1] // width)
    rows = min(side, len(values))  # blocks of an image with few rows are not padded to squares
    values = np.pad(values, [(0, -len(values) % rows), (0, -values.shape[1] % side), (0, 0)])
    height, width, channels = values.shape
    blocks = values.reshape(height // rows, rows, width // side, side, channels).swapaxes(1, 2)
    blocks = blocks.reshape(height // rows, width // side, -1)
    place = np.where(np.isnan(blocks), np.inf, np.abs(blocks)).argmax(-1, keepdims=True)
    return np.take_along_axis(blocks, place, -1)


def _halves(pixels: Pixels, scale: float) -> Codes:
    """Return pixels / `scale` as the bits of little-endian halves. Finite stays finite, and every NaN is the same."""
    codes = np.empty(pixels.shape, "<u2")
    for start in range(0, len(pixels), LINES):  # temporary arrays of the whole image would be several times its size
        rows = pixels[start : start + LINES] / np.float32(scale)
        with np.errstate(over="ignore", invalid="ignore"):
            halves = np.where(np.isinf(rows), rows, np.clip(rows, -LARGEST, LARGEST)).astype("<f2")
        codes[start : start + LINES] = np.where(np.isnan(halves), np.float16(np.nan), halves).astype("<f2").view("<u2")
    return codes


def _rounded(codes: Codes, bits: int) -> Codes:
    """Return the codes with so many low bits cleared, rounded to nearest, but never from finite to infinite."""
    if not bits:
        return codes
    magnitude = codes & np.uint16(0x7FFF)
    up = np.where(magnitude < 0x7C00, np.minimum(magnitude + (1 << bits - 1), 0x7BFF), magnitude).astype("<u2")
    return (up >> bits << bits | codes & np.uint16(0x8000)).astype("<u2")


def _deflated(codes: Codes) -> bytes:
    """Return the deflated high bytes, then low bytes: 10 to 50 % smaller than with both bytes of a half together.

    Level 4, because the default level takes five times as long on rounded noise, for 1 % of its size.
    """
    planes = np.ascontiguousarray(codes).view("u1").reshape(-1, 2)[:, ::-1].T.tobytes()
    return zlib.compress(planes, 4)


def png(rgb: NDArray[np.uint8]) -> bytes:
    """Return H × W × 3 bytes as a PNG file, written by the present Mitsuba variant."""
    import mitsuba as mi

    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(rgb)).write(stream, mi.Bitmap.FileFormat.PNG)
    return bytes(stream.raw_buffer())
