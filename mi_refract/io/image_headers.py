"""Parsing of headers of image files: checks that OpenImageIO lacks, and metadata that it does not return."""

from __future__ import annotations

import contextlib
import math
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from .errors import ImageError

EXR, PNG, JPEG = b"\x76\x2f\x31\x01", b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
ATTRIBUTES = 4096  # largest number of attributes of an EXR file
# Chunks of a PNG file that OpenImageIO reads, or that do not affect the meaning of the pixels.
CHUNKS = b"IHDR PLTE IDAT IEND tRNS gAMA sRGB cICP tIME pHYs oFFs eXIf bKGD hIST sBIT sPLT mDCV".split()
TEXTS, TEXT = (b"tEXt", b"zTXt", b"iTXt"), "png:text:"
SRGB = struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000)  # the default of cHRM
# Tags of a TIFF file that OpenImageIO reads, or that give the location of the pixels.
TAGS = {*range(254, 290), 292, 293, 296, 297, 305, 306, *range(315, 318), 320, *range(322, 326), 330, 332, 333, 334}
TAGS |= {338, 339, 347, *range(512, 522), 529, 530, 531, 700, *range(33300, 33307), 33432, 33723, 34377, 34665, 34675}
TAGS |= {18246, 18249, 32995, 32997, 34853, 37724, *range(40091, 40096)}
SIZES = {3: 2, 4: 4, 5: 8, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}  # bytes by type; others: 1
CUMULATIVE = {"hdr:EXPOSURE", "hdr:COLORCORR", "hdr:PIXASPECT"}  # several lines of a Radiance file multiply
FRACTION = 5  # a TIFF type: numerator and denominator
PSD = (4, 7, 8)  # Photoshop's colour modes CMYK, multichannel, duotone
REFUSED = {
    "png:acTL": "an animated PNG; expected a single image",
    "jpeg:MPF": "a JPEG of several images (MPO); expected a single image",
    "psd:ColorSpace": "a Photoshop file in CMYK or other inks; expected R, G, B",
}


def check_attributes(path: Path) -> None:
    """Raise ValueError if an attribute of an OpenEXR file is larger than the file, which OpenImageIO may not check."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(8)[:4] != EXR:
            return
        for _ in range(ATTRIBUTES):
            if not _text(file):  # the name, which is empty after the last attribute
                return
            _text(file)  # the type
            length = int.from_bytes(file.read(4), "little")
            if file.tell() + length > size:
                raise ImageError(f"{path}: corrupt EXR file: an attribute of {length} bytes")
            file.seek(length, os.SEEK_CUR)
    raise ImageError(f"{path}: more than {ATTRIBUTES} attributes")


def _text(file: BinaryIO) -> bytes:
    """Read a name up to and including a zero byte, and return it without the zero; EXR's names have up to 255 bytes."""
    block = file.read(256)
    text, zero, _ = block.partition(b"\0")
    file.seek(len(text) + len(zero) - len(block), os.SEEK_CUR)
    return text


def hidden_metadata(path: Path) -> dict[str, bytes | float]:
    """Return metadata about the pixels that OpenImageIO does not return: "png:cHRM", "tiff:301", "hdr:COLORCORR".

    Values are the bytes of the file, except numbers of HDR files and fractions of TIFF files, which are text: "1.0
    0.3127". An entry "png:text:Comment" without a value means that OpenImageIO's "Comment" is a text of a PNG file.
    Radiance's PIXASPECT is "PixelAspectRatio", as in other formats. ValueError for a file of several images of which
    OpenImageIO reads only the first, and for colours that it converts with loss.
    """
    size = path.stat().st_size
    values: dict[str, list[bytes]] = {}
    # OpenImageIO reports a file that is truncated, or that points beyond its end.
    with path.open("rb") as file, contextlib.suppress(struct.error, OverflowError, OSError):
        start = file.read(8)
        for magic, read in READERS.items():
            for name, value in read(file, size) if start.startswith(magic) else ():
                values.setdefault(name, []).append(value)
    for name in values.keys() & REFUSED.keys():
        raise ImageError(f"{path}: {REFUSED[name]}")
    metadata: dict[str, bytes | float] = {name: b" ".join(several) for name, several in values.items()}
    for name in values.keys() & CUMULATIVE:
        with contextlib.suppress(ValueError):
            factors = zip(*([float(word) for word in value.split()] for value in values[name]), strict=True)
            metadata[name] = b" ".join(str(math.prod(column)).encode() for column in factors)
    with contextlib.suppress(KeyError, ValueError, ZeroDivisionError):
        metadata["PixelAspectRatio"] = 1 / float(metadata["hdr:PIXASPECT"])  # PIXASPECT is height over width
        del metadata["hdr:PIXASPECT"]
    return metadata


# Each reader yields names and values. `size`: the size of the file, which limits the length of a value.


def _png(file: BinaryIO, size: int) -> Iterator[tuple[str, bytes]]:
    file.seek(len(PNG))
    while True:
        length, chunk = struct.unpack(">I4s", file.read(8))
        after = file.tell() + length + 4
        if chunk in TEXTS:
            yield TEXT + file.read(min(length, 80)).partition(b"\0")[0].decode("latin-1"), b""
        elif chunk not in CHUNKS and (data := file.read(min(length, size))) != SRGB:
            yield f"png:{chunk.decode('latin-1')}", data
        file.seek(after)


def _jpeg(file: BinaryIO, size: int) -> Iterator[tuple[str, bytes]]:
    file.seek(len(JPEG))
    while True:
        marker, length = struct.unpack(">HH", file.read(4))
        after = file.tell() + length - 2
        if marker == 0xFFDA or marker < 0xFF00:  # the pixels begin
            return
        if marker == 0xFFFF:  # the first byte is padding
            after = file.tell() - 3
        elif marker == 0xFFE2 and file.read(4) == b"MPF\0":
            yield "jpeg:MPF", b""
        file.seek(after)


def _hdr(file: BinaryIO, size: int) -> Iterator[tuple[str, bytes]]:
    file.seek(0)
    while (line := file.readline(size)).strip():
        name, equals, value = line.partition(b"=")
        # Other lines are comments, or commands that produced this image or one of its inputs.
        if equals and name.isalnum() and name != b"FORMAT":
            with contextlib.suppress(ValueError):
                value = b" ".join(str(float(word)).encode() for word in value.split())
            yield f"hdr:{name.decode('latin-1')}", value.strip()


def _tiff(file: BinaryIO, size: int) -> Iterator[tuple[str, bytes]]:
    file.seek(0)
    order = "<" if file.read(2) == b"II" else ">"
    big = struct.unpack(f"{order}H", file.read(2))[0] == 43
    offset, count, inline = (f"{order}Q", f"{order}Q", 8) if big else (f"{order}I", f"{order}H", 4)

    def unpack(kind: str) -> tuple[int, ...]:
        return struct.unpack(kind, file.read(struct.calcsize(kind)))

    file.seek(inline)
    directories = {0}
    while (directory := unpack(offset)[0]) not in directories:
        suffix = f" of part {len(directories) - 1}" if len(directories) > 1 else ""
        directories.add(directory)
        file.seek(directory)
        first = directory + struct.calcsize(count)
        entries = min(unpack(count)[0], size // 12)
        entry = struct.calcsize(f"{order}HH{offset[1]}") + inline
        for i in range(entries):
            file.seek(first + i * entry)
            tag, kind, number = unpack(f"{order}HH{offset[1]}")
            length = min(number * SIZES.get(kind, 1), size)
            if tag not in TAGS:
                if length > inline:
                    file.seek(unpack(offset)[0])
                value = file.read(length)
                if kind == FRACTION:
                    pairs = struct.iter_unpack(f"{order}II", value)
                    value = " ".join(f"{x / (y or math.nan):.6g}" for x, y in pairs).encode()
                yield f"tiff:{tag}{suffix}", value
        file.seek(first + entries * entry)


def _psd(file: BinaryIO, size: int) -> Iterator[tuple[str, bytes]]:
    file.seek(24)
    (mode,) = struct.unpack(">H", file.read(2))
    if mode in PSD:
        yield "psd:ColorSpace", b""


READERS = {PNG: _png, JPEG: _jpeg, b"#?": _hdr, b"II*\0": _tiff, b"MM\0*": _tiff, b"II+\0": _tiff, b"MM\0+": _tiff}
READERS[b"8BPS"] = _psd
