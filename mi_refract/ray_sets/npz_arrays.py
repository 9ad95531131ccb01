"""The arrays of an .npz file. What was not asked for, or is larger than it may be, is not unpacked."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io import regular_file
from mi_refract.io.image_file import one_line
from mi_refract.regimes import Array

_HEADER = "header"  # the array that holds JSON text
_HEADER_BYTES = 2**20
_SPARE = 2**24  # bytes of a file beside its numbers
_ABOVE = 2**14  # bytes: NumPy describes an array in 10,000 at most
_WIDEST = 16  # bytes of a number: a `longdouble`
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # NumPy's
_BROKEN = (
    *(zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError),
    *(RuntimeError, TypeError, ValueError, OverflowError, MemoryError),
    *(SyntaxError, tokenize.TokenError),  # of NumPy's parser
)


def read(
    path: Path, widths: Mapping[str, int], optional: Sequence[str], most: int
) -> tuple[str, Array, tuple[str, ...]]:
    """Text of the array `header` or "", (N, columns) float64, names of the arrays.

    `widths`: the arrays, (N,) or (N, width) each, which are put side by side. `most`: the largest N. ValueError, one
    line, for what is not in the file and not `optional`, is no number, has another shape, is encrypted, or does not
    fit its own description. OSError where the file cannot be read.
    """
    with regular_file.opened(path, most * _WIDEST * sum(widths.values()) + _SPARE) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                there = archive.namelist()
                names = tuple(name for name in widths if f"{name}.npy" in there or name not in optional)
                columns = [_numbers(archive, name, widths[name], most) for name in names]
                if len({len(column) for column in columns}) > 1:
                    rows = ", ".join(f"{name} has {len(x)} rows" for name, x in zip(names, columns, strict=True))
                    raise ValueError(f"{rows}, which differ")
                text = _array(archive, _HEADER, _HEADER_BYTES) if f"{_HEADER}.npy" in there else np.array("")
                if text.shape or text.dtype.kind != "U":
                    raise ValueError(f"{_HEADER} is {text.dtype} of the shape {text.shape}, not text")
                return str(text), np.hstack(columns), names
        except _BROKEN as error:
            found = one_line(str(error)) or type(error).__name__
            expected = ", ".join(name for name in widths if name not in optional)
            raise ValueError(f"{path}: {found}; expected an .npz file with {expected}") from None


def _numbers(archive: zipfile.ZipFile, name: str, width: int, most: int) -> Array:
    """An array of numbers as (N, width) float64."""
    array = _array(archive, name, most * _WIDEST * width)
    if not array.ndim or array.shape[1:] not in ((width,), ()) or array.size != len(array) * width:
        raise ValueError(f"{name} has the shape {array.shape}, not (rows, {width})")
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} holds {array.dtype}, not real numbers")
    if len(array) > most:
        raise ValueError(f"{len(array)} rows, more than {most}")
    with np.errstate(over="ignore"):
        return array.reshape(len(array), width).astype(np.float64)


def _array(archive: zipfile.ZipFile, name: str, most: int) -> NDArray[Any]:
    """A member of up to `most` bytes, to its end: only there it shows whether it is damaged."""
    try:
        info = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise ValueError(f"there is no {name}") from None
    if info.compress_type not in _METHODS:
        raise ValueError(f"{name} is compressed by method {info.compress_type}")
    if info.file_size > most + _ABOVE:
        raise ValueError(f"{name} has {info.file_size} bytes, more than {most + _ABOVE}")
    with archive.open(info) as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
        if stream.read(1):
            raise ValueError(f"{name} is longer than its shape, {array.shape}")
    return array
