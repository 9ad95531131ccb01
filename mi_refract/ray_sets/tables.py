"""Tables of numbers in CSV, .npz and EXR files that others wrote, beside a header of `key: value` lines.

A layout is the tuple of the names of the columns, in order. In an .npz file, columns that differ in a last x, y, z are
one array: `ax`, `ay`, `az` are `a`, of the shape (N, 3).
"""

from __future__ import annotations

import io
import json
import re
import tokenize
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mi_refract.io import image_file, regular_file
from mi_refract.io.image_file import one_line
from mi_refract.regimes import Array

from .header import Header, as_json

SUFFIXES = (".csv", ".npz", ".exr")
EXR_HEADER = "mi_refract:rays"  # the attribute with the header, as JSON
EXR_UNUSED = -1  # the id of a pixel without a row
Layout = tuple[str, ...]

# Visual C++ and others print a NaN as nan(ind) or the like; C has letters, digits and _ between the brackets.
_NAN = re.compile(r"nan\([A-Za-z0-9_]{0,32}\)", re.IGNORECASE)
_LONGEST_LINE = 2**20  # characters
_ROW_BYTES, _TOP_BYTES = 1024, 2**20  # of CSV: five times what the digits of a row need; the header
_TEXT_BYTES = 2**32  # of CSV in memory
_NUMBER_BYTES = 16  # a `longdouble`
_ARRAY_TOP_BYTES = 2**14  # NumPy describes an array in 10,000 at most
_NPZ_HEADER_BYTES = 2**20
_NPZ_MORE_BYTES = 2**24  # of a file beside its numbers
_BROKEN_NPZ = (
    *(zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError),
    *(RuntimeError, TypeError, ValueError, OverflowError, MemoryError),
    *(SyntaxError, tokenize.TokenError),  # of NumPy's parser
)


class Table(NamedTuple):
    """A header, empty where there is none; the names of the columns; their numbers (N, columns), float64."""

    header: Header
    columns: Layout
    numbers: Array


def read(path: Path, layouts: Sequence[Layout], most: int) -> Table:
    """The table in a file, with `most` rows at most, in one of the layouts: of .npz and EXR in the largest one that is
    there.

    ValueError, one line that begins with the path, for another format, or what is no such table. OSError where the file
    cannot be read.
    """
    if path.suffix.lower() == ".csv":
        with regular_file.opened(path, most * _ROW_BYTES + _TOP_BYTES) as stream:
            return read_csv(str(path), stream, layouts, most)
    if path.suffix.lower() == ".npz":
        return _read_npz(path, layouts, most)
    if path.suffix.lower() != ".exr":
        raise ValueError(f"{path}: expected a file name that ends in {' or '.join(SUFFIXES)}")
    image = image_file.read(path)
    layout = _largest(layouts, lambda column: column in image.channels)
    pixels: NDArray[np.float64] = image.select(layout).reshape(-1, len(layout)).astype(np.float64)
    numbers = pixels[pixels[:, 0] != EXR_UNUSED]
    if len(numbers) > most:
        raise ValueError(f"{path}: {len(numbers)} rows; expected up to {most}")
    return Table(_header(image.metadata.get(EXR_HEADER, "")), layout, numbers)


def _largest(layouts: Sequence[Layout], exists: Callable[[str], bool]) -> Layout:
    """The layout with the most columns of which all exist; the first one where none is complete."""
    return max((layout for layout in layouts if all(map(exists, layout))), key=len, default=layouts[0])


def _header(text: object) -> Header:
    """The header in JSON text, empty where there is none."""
    try:
        header = as_json(text) if isinstance(text, str) else {}
    except ValueError:
        return {}
    return header if isinstance(header, dict) else {}


# CSV ---------------------------------------------------------------------------------------------------------------


def csv_text(header: Mapping[str, Any], columns: Layout, numbers: Array, whole: Collection[str] = ()) -> str:
    """CSV text of `numbers` (N, columns); the first column, and those in `whole`, hold whole numbers.

    Each number is the shortest decimal that reads back, in float64, as exactly that number.
    """
    top = [f"# {key}: {value if value == _value(value) else json.dumps(value)}" for key, value in header.items()]
    row = ",".join(["%d", *("%d" if name in whole else "%r" for name in columns[1:])])
    return "\n".join([*top, ",".join(columns), *(row % tuple(x) for x in numbers.tolist()), ""])


def csv_bytes(rows: int) -> int:
    """The largest size of CSV text with so many rows, in memory."""
    return min(rows * _ROW_BYTES + _TOP_BYTES, _TEXT_BYTES)


class _TooLongError(ValueError):
    """A line, or a table."""


def read_csv(name: str, stream: BinaryIO, layouts: Sequence[Layout], most: int) -> Table:
    """The table in CSV text, whose names of columns are one of the layouts, in order.

    ValueError, one line that begins with `name`: bytes that are not text, other columns, a row that is too short, too
    long, or not of numbers, or more than `most` rows.
    """
    number, line, rows_left = 0, "", most + 1  # with the names of the columns

    def lines(text: io.TextIOWrapper) -> Iterator[str]:
        nonlocal number, line, rows_left
        for line in iter(lambda: text.readline(_LONGEST_LINE + 1), ""):
            number += 1
            if len(line) > _LONGEST_LINE:
                raise _TooLongError(f"line {number} is longer than {_LONGEST_LINE} characters")
            if line.strip():
                rows_left -= not line.startswith("#")
                if rows_left < 0:
                    raise _TooLongError(f"more than {most} rows; expected up to {most}")
                yield _NAN.sub("nan", line) if "(" in line else line

    try:
        with io.TextIOWrapper(stream, "utf-8-sig") as text:
            rows, header, columns = lines(text), Header(), tuple[str, ...]()
            for top in rows:
                key, colon, value = top.partition(":")
                if not key.startswith("#"):
                    columns = tuple(column.strip() for column in top.split(","))
                    break
                header[key[1:].strip()] = _value(value.strip()) if colon else ""
            if columns not in layouts:
                found = f"the first row is {','.join(columns)[:60]!r}" if columns else "the table is empty"
                raise ValueError(f"{found}; expected, in this order: {' or '.join(map(','.join, layouts))}")
            with warnings.catch_warnings(action="ignore", category=UserWarning):  # of a table without rows
                try:
                    numbers = np.loadtxt(rows, delimiter=",", ndmin=2)  # `max_rows` would be allocated
                except (_TooLongError, UnicodeDecodeError):
                    raise
                except ValueError:
                    numbers = np.empty((1, 0))
    except UnicodeDecodeError:
        raise ValueError(f"{name}: not text; expected CSV in UTF-8") from None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    if len(numbers) and numbers.shape[1] != len(columns):
        raise ValueError(f"{name}: line {number} is {line.rstrip()[:60]!r}; expected {len(columns)} numbers")
    return Table(header, columns, numbers.reshape(-1, len(columns)))


def _value(text: Any) -> Any:
    """The value of JSON text, any other text unchanged, None for anything but text."""
    try:
        return as_json(text)
    except ValueError:
        return text
    except TypeError:
        return None


# NumPy's archives --------------------------------------------------------------------------------------------------


def _array_name(column: str) -> str:
    return column[0] if len(column) == 2 and column[1] in "xyz" else column


def _read_npz(path: Path, layouts: Sequence[Layout], most: int) -> Table:
    """Other arrays, and those that are too large, are not unpacked."""
    largest = most * _NUMBER_BYTES * max(map(len, layouts)) + _NPZ_MORE_BYTES
    with regular_file.opened(path, largest) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                members = {name.removesuffix(".npy") for name in archive.namelist()}
                columns = _largest(layouts, lambda column: _array_name(column) in members)
                widths = Counter(map(_array_name, columns))
                arrays = {name: _numbers(archive, name, width, most) for name, width in widths.items()}
                if len({len(array) for array in arrays.values()}) > 1:
                    raise ValueError(", ".join(f"{name} has {len(array)} rows" for name, array in arrays.items()))
                text = _array(archive, "header", _NPZ_HEADER_BYTES) if "header" in members else np.array("")
                if text.shape or text.dtype.kind != "U":
                    raise ValueError(f"header is {text.dtype} of the shape {text.shape}, not text")
        except _BROKEN_NPZ as error:
            found, expected = one_line(str(error)) or type(error).__name__, dict.fromkeys(map(_array_name, layouts[0]))
            raise ValueError(f"{path}: {found}; expected an .npz file with {', '.join(expected)}") from None
    return Table(_header(str(text)), columns, np.hstack(list(arrays.values())))


def _numbers(archive: zipfile.ZipFile, name: str, width: int, most: int) -> Array:
    """An array of numbers as (N, width) float64."""
    array = _array(archive, name, most * _NUMBER_BYTES * width)
    if not array.ndim or array.shape[1:] not in ((width,), ()) or array.size != len(array) * width:
        raise ValueError(f"{name} has the shape {array.shape}, not (rows, {width})")
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} holds {array.dtype}, not real numbers")
    if len(array) > most:
        raise ValueError(f"{len(array)} rows, more than {most}")
    with np.errstate(over="ignore"):
        return array.reshape(len(array), width).astype(np.float64)


def _array(archive: zipfile.ZipFile, name: str, most: int) -> NDArray[Any]:
    """A member of up to `most` bytes, read to its end: only there zipfile compares its checksum."""
    try:
        info = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise ValueError(f"there is no {name}") from None
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed by method {info.compress_type}")
    if info.file_size > most + _ARRAY_TOP_BYTES:
        raise ValueError(f"{name} has {info.file_size} bytes, more than {most + _ARRAY_TOP_BYTES}")
    with archive.open(info) as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
        if stream.read(1):
            raise ValueError(f"{name} is longer than its shape, {array.shape}")
    return array
