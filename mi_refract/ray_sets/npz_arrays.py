"""The arrays of an .npz file, each checked before it is read: nothing is unpacked that was not asked for."""

from __future__ import annotations

import contextlib
import io
import math
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from mi_refract.io import regular_file
from mi_refract.io.image_file import one_line

_HEADER = "header"  # the array that holds JSON text
_HEADER_BYTES = 2**20
_SPARE = 2**24  # bytes of a file beside its numbers
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_STEP = 2**16  # rows that are read at once
_ABOVE = 2**14  # bytes: NumPy describes an array in 10,000 at most
_BROKEN = (
    *(zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError),
    *(RuntimeError, TypeError, ValueError, OverflowError, MemoryError),
    *(SyntaxError, tokenize.TokenError),  # of NumPy's parser
)


def read(
    path: Path, widths: Mapping[str, int], optional: Sequence[str], most: int
) -> tuple[str, np.ndarray, tuple[str, ...]]:
    """Text of the array `header` or "", (N, columns) float64, names of the arrays. Arguments, errors as of `opened`."""
    with opened(path, widths, optional, most) as found:
        numbers = np.empty((found.rows, found.width))
        for i, piece in enumerate(found.pieces(_STEP)):
            numbers[i * _STEP : i * _STEP + len(piece)] = piece
        return found.text, numbers, found.names


@contextlib.contextmanager
def opened(path: Path, widths: Mapping[str, int], optional: Sequence[str], most: int) -> Iterator[Arrays]:
    """The arrays named in `widths`, (N,) or (N, width) each, side by side, and the text of the array `header` or "".

    All of it is read once here, and none of it kept. `most`: the largest N. ValueError, one line, for what is not in
    the file and not `optional`, is no number, has another shape, is encrypted, or does not fit its own description.
    OSError where the file cannot be read.
    """
    accepted = ", ".join(name for name in widths if name not in optional)
    limit = most * 16 * sum(widths.values()) + _SPARE
    with regular_file.opened(path, limit) as stream, contextlib.ExitStack() as stack:
        with _one_line(path, accepted):
            archive = stack.enter_context(zipfile.ZipFile(stream))
            found = [name for name in widths if f"{name}.npy" in archive.namelist() or name not in optional]
            count = (*_described(archive, found[0]).shape, 0)[0]
            if count > most:
                raise ValueError(f"{count} rows; accepted: up to {most}")
            members = [_checked(archive, name, count, widths[name]) for name in found]
            text = _text(archive)
        yield Arrays(path, accepted, archive, text, count, tuple(members))


@contextlib.contextmanager
def _one_line(path: Path, accepted: str) -> Iterator[None]:
    try:
        yield
    except _BROKEN as error:
        said = one_line(str(error)) or type(error).__name__
        raise ValueError(f"{path}: {said}; accepted: an .npz file with {accepted}") from None


@dataclass(frozen=True)
class Member:
    """How an array of the archive is described, and where in the member its numbers begin."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    by_column: bool
    begin: int

    @property
    def width(self) -> int:
        """Numbers of a row."""
        return self.shape[1] if len(self.shape) > 1 else 1

    def open_parts(self, archive: zipfile.ZipFile) -> Iterator[tuple[IO[bytes], int]]:
        """Streams of the whole array, or of each of its columns where they are stored so; with the width of each."""
        count = self.width if self.by_column else 1
        for i in range(count):
            stream = archive.open(f"{self.name}.npy")
            stream.seek(self.begin + i * self.shape[0] * self.dtype.itemsize)
            yield stream, self.width // count


@dataclass(frozen=True)
class Arrays:
    """What `opened` found: `text` of the header, and (rows, width) numbers, which are read in pieces."""

    path: Path
    accepted: str
    archive: zipfile.ZipFile
    text: str
    rows: int
    members: tuple[Member, ...]

    @property
    def width(self) -> int:
        """Columns of all arrays together."""
        return sum(each.width for each in self.members)

    @property
    def names(self) -> tuple[str, ...]:
        """Those of the arrays."""
        return tuple(each.name for each in self.members)

    def pieces(self, step: int) -> Iterator[np.ndarray]:
        """(n, width) float64, n up to `step`. ValueError, one line, for a file that has changed."""
        with _one_line(self.path, self.accepted), contextlib.ExitStack() as stack:
            parts = [(each.dtype, *part) for each in self.members for part in each.open_parts(self.archive)]
            for _, stream, _ in parts:
                stack.enter_context(stream)
            for start in range(0, self.rows, step):
                count = min(step, self.rows - start)
                yield np.hstack([_numbers(stream, dtype, count, width) for dtype, stream, width in parts])


def _numbers(stream: IO[bytes], dtype: np.dtype, count: int, width: int) -> np.ndarray:
    """The next (count, width), in float64."""
    data = _exactly(stream, count * width * dtype.itemsize)
    with np.errstate(over="ignore"):
        return np.frombuffer(data, dtype).reshape(count, width).astype(np.float64)


def _exactly(stream: IO[bytes], size: int) -> bytes:
    """The next bytes. ValueError, in NumPy's words, where there are fewer."""
    if len(data := stream.read(size)) < size:
        raise ValueError(f"EOF: reading array data, expected {size} bytes got {len(data)}")
    return data


def _checked(archive: zipfile.ZipFile, name: str, count: int, width: int) -> Member:
    """An array of numbers, (count, width). It is read to its end: only there it shows whether it is damaged."""
    member = _described(archive, name)
    if member.shape != (count, width) and not (member.shape == (count,) and width == 1):
        raise ValueError(f"{name} has the shape {member.shape} for {count} rows of {width}")
    if member.dtype.kind not in "biuf":
        raise ValueError(f"{name} holds {member.dtype}, not real numbers")
    with archive.open(f"{name}.npy") as stream:
        stream.read(member.begin)
        left = count * width * member.dtype.itemsize
        while left:
            left -= len(_exactly(stream, min(left, np.lib.format.BUFFER_SIZE)))
    return member


def _text(archive: zipfile.ZipFile) -> str:
    if f"{_HEADER}.npy" not in archive.namelist():
        return ""
    found = _described(archive, _HEADER)
    if found.shape or found.dtype.kind != "U" or found.dtype.itemsize > _HEADER_BYTES:
        raise ValueError(f"{_HEADER} is {found.dtype} of the shape {found.shape}, not text")
    with archive.open(f"{_HEADER}.npy") as stream:
        return str(np.lib.format.read_array(stream, allow_pickle=False))


def _described(archive: zipfile.ZipFile, name: str) -> Member:
    """What is said of an array. ValueError where that is not what the archive has of it."""
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
    shape, by_column, dtype = _HEADERS[version](head)
    if (
        dtype.hasobject
        or head.tell() + math.prod(shape) * dtype.itemsize != info.file_size
        or min(shape, default=0) < 0
    ):
        raise ValueError(f"{name} is said to hold {shape} of {dtype}, which is not what the file has")
    return Member(name, shape, dtype, by_column and len(shape) > 1, head.tell())
