"""The arrays of an .npz file, each checked before it is read: nothing is unpacked that was not asked for."""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mi_refract.io import regular_file
from mi_refract.io.image_file import one_line

_HEADER = "header"  # the array that holds JSON text
_HEADER_BYTES = 2**20
_SPARE = 2**24  # bytes of a file beside its numbers
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_ABOVE = 2**14  # bytes: NumPy describes an array in 10,000 at most
_BROKEN = (
    *(zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError),
    *(RuntimeError, TypeError, ValueError, OverflowError, MemoryError),
    *(SyntaxError, tokenize.TokenError),  # of NumPy's parser
)


def read(path: Path, widths: Mapping[str, int], optional: Sequence[str], most: int) -> tuple[str, np.ndarray]:
    """(text of the array `header` or "", (N, columns) float64) of arrays named in `widths`, (N,) or (N, width) each.

    `most`: the largest N. ValueError, one line, for what is not in the file and not `optional`, is no number, has
    another shape, is encrypted, or does not fit its own description. OSError where the file cannot be read.
    """
    accepted = ", ".join(name for name in widths if name not in optional)
    limit = most * 16 * sum(widths.values()) + _SPARE
    with regular_file.opened(path, limit) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                found = [name for name in widths if f"{name}.npy" in archive.namelist() or name not in optional]
                count = (*_described(archive, found[0])[0], 0)[0]
                if count > most:
                    raise ValueError(f"{count} rows; accepted: up to {most}")
                numbers = [_numbers(archive, name, count, widths[name]) for name in found]
                return _text(archive), np.hstack(numbers)
        except _BROKEN as error:
            said = one_line(str(error)) or type(error).__name__
            raise ValueError(f"{path}: {said}; accepted: an .npz file with {accepted}") from None


def _numbers(archive: zipfile.ZipFile, name: str, count: int, width: int) -> np.ndarray:
    """(count, width) float64."""
    shape, dtype = _described(archive, name)
    if shape != (count, width) and not (shape == (count,) and width == 1):
        raise ValueError(f"{name} has the shape {shape} for {count} rows of {width}")
    if dtype.kind not in "biuf":
        raise ValueError(f"{name} holds {dtype}, not real numbers")
    with archive.open(f"{name}.npy") as stream, np.errstate(over="ignore"):
        return np.lib.format.read_array(stream, allow_pickle=False).reshape(count, width).astype(np.float64)


def _text(archive: zipfile.ZipFile) -> str:
    if f"{_HEADER}.npy" not in archive.namelist():
        return ""
    shape, dtype = _described(archive, _HEADER)
    if shape or dtype.kind != "U" or dtype.itemsize > _HEADER_BYTES:
        raise ValueError(f"{_HEADER} is {dtype} of the shape {shape}, not text")
    with archive.open(f"{_HEADER}.npy") as stream:
        return str(np.lib.format.read_array(stream, allow_pickle=False))


def _described(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype]:
    """(shape, dtype) of an array. ValueError where they are not those of the bytes that the archive has of it."""
    try:
        info = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise ValueError(f"there is no {name}") from None
    if info.flag_bits & 1:
        raise ValueError(f"{name} is encrypted")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed by method {info.compress_type}")
    with archive.open(info) as stream:
        head = io.BytesIO(stream.read(_ABOVE))
    version = np.lib.format.read_magic(head)
    if version not in _HEADERS:
        raise ValueError(f"{name} is in version {version} of NumPy's format")
    shape, _, dtype = _HEADERS[version](head)
    if (
        dtype.hasobject
        or head.tell() + math.prod(shape) * dtype.itemsize != info.file_size
        or min(shape, default=0) < 0
    ):
        raise ValueError(f"{name} is said to hold {shape} of {dtype}, which is not what the file has")
    return shape, dtype
