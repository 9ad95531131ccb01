"""The images of a page: base64 of the deflated planes of half floats, which its script reads."""

from __future__ import annotations

import base64
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import Pixels, block_mean, read

Codes = NDArray[np.uint16]  # the bits of halves
LARGEST = 65504.0  # of the finite halves
LINES = 64  # that are converted at once
# Mantissa bits given up, by twos, before an image is made smaller: at 6 a value is within 1/32 of itself.
ROUNDED = (0, 2, 4, 6)


class EmbeddedImages:
    """The images of one page, each file once. A finite value past ±65504 becomes ±65504. Errors: see `embed`."""

    def __init__(self, folder: Path = Path()) -> None:
        """`folder` is what the paths given to `embed` are relative to."""
        self.folder = folder
        self.embedded: list[dict[str, Any]] = []
        self._files: dict[str, dict[str, Any]] = {}

    def embed(self, path: str) -> dict[str, Any]:
        """Key, width, height and data of an image, whole, by its path relative to the folder.

        Errors: FileNotFoundError where it is missing, ValueError where it is not RGB or gray; both name it.
        """
        if path not in self._files:
            image = read(self.folder / path)
            pixels = shown(image.pixels, image.channels)[0]
            if pixels is None:
                raise ValueError(f"{image.path}: neither RGB nor gray, but channels {', '.join(image.channels)}")
            self._files[path] = self.add(encoded(pixels))
        return self._files[path]

    def add(self, image: dict[str, Any]) -> dict[str, Any]:
        """Put an image that `encoded` made on the page, under a key of its own."""
        self.embedded.append(image | {"key": f"p{len(self.embedded)}"})
        return self.embedded[-1]


def encoded(pixels: Pixels, limit: float = np.inf, scale: float = 1.0) -> dict[str, Any]:
    """H × W × (1 or 3) pixels / `scale` as base64 of about `limit` bytes; `note` says what it took.

    Where they do not fit, by the size of some of their lines, values are rounded, then blocks of pixels averaged.
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
    """Text as base64 of its deflated UTF-8, which the page's script unpacks."""
    return base64.b64encode(zlib.compress(text.encode(), 9)).decode()


def shown(pixels: Pixels, channels: tuple[str, ...]) -> tuple[Pixels | None, str]:
    """The part of an image that a page can show: RGB or its one channel, and its name; (None, "") for neither."""
    if {"R", "G", "B"} <= set(channels):
        return pixels[..., [channels.index(name) for name in "RGB"]], "RGB"
    return (pixels, channels[0]) if len(channels) == 1 else (None, "")


def strongest(values: Pixels, width: int) -> Pixels:
    """H × W × C values as one channel of at most `width` columns: of every block the value of largest magnitude.

    A mean would let two errors cancel and one pixel drown. NaN is stronger than any number.
    """
    side = -(-values.shape[1] // width)
    rows = min(side, len(values))  # an image of few rows is not filled up to a block of as many as columns
    pad = [(0, -len(values) % rows), (0, -values.shape[1] % side), (0, 0)]
    height, width, channels = (values := np.pad(values, pad)).shape
    blocks = values.reshape(height // rows, rows, width // side, side, channels).swapaxes(1, 2)
    blocks = blocks.reshape(height // rows, width // side, -1)
    place = np.where(np.isnan(blocks), np.inf, np.abs(blocks)).argmax(-1, keepdims=True)
    return np.take_along_axis(blocks, place, -1)


def _halves(pixels: Pixels, scale: float) -> Codes:
    """The bits of little-endian halves, of pixels / `scale`. Finite stays finite, and every NaN is the same."""
    codes = np.empty(pixels.shape, "<u2")
    for start in range(0, len(pixels), LINES):  # the intermediates of a whole image are several times its size
        part = pixels[start : start + LINES] / np.float32(scale)
        with np.errstate(over="ignore", invalid="ignore"):
            halves = np.where(np.isinf(part), part, np.clip(part, -LARGEST, LARGEST)).astype("<f2")
        codes[start : start + LINES] = np.where(np.isnan(halves), np.float16(np.nan), halves).astype("<f2").view("<u2")
    return codes


def _rounded(codes: Codes, bits: int) -> Codes:
    """The codes with that many low bits cleared, rounded to nearest: never from finite to infinite."""
    if not bits:
        return codes
    magnitude = codes & np.uint16(0x7FFF)
    up = np.where(magnitude < 0x7C00, np.minimum(magnitude + (1 << bits - 1), 0x7BFF), magnitude).astype("<u2")
    return (up >> bits << bits | codes & np.uint16(0x8000)).astype("<u2")


def _deflated(codes: Codes) -> bytes:
    """High bytes, then low bytes: a tenth to a half smaller than the halves in a row.

    Level 4: the default's matches take five times as long on rounded noise, for a hundredth of its size.
    """
    planes = np.ascontiguousarray(codes).view("u1").reshape(-1, 2)[:, ::-1].T.tobytes()
    return zlib.compress(planes, 4)


def png(rgb: NDArray[np.uint8]) -> bytes:
    """H × W × 3 bytes as a PNG file, by the Mitsuba variant that is set."""
    import mitsuba as mi

    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(rgb)).write(stream, mi.Bitmap.FileFormat.PNG)
    return bytes(stream.raw_buffer())
