"""Files that others wrote, read only where they are files, and not larger than expected."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader

_PIECE = 2**20  # bytes


@contextmanager
def opened(path: str | os.PathLike[str], most: int) -> Iterator[BufferedReader]:
    """The file, open for reading, of `most` bytes at most.

    ValueError for a larger one, or for what is no file: a pipe or a device may never end. OSError where it cannot be
    read.
    """
    # A pipe without a writer would block when it is opened.
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0))) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode):
            raise ValueError(f"{path}: not a regular file")
        if found.st_size > most:
            raise ValueError(f"{path}: {found.st_size} bytes; expected up to {most}")
        yield file


def read_bytes(path: str | os.PathLike[str], most: int) -> bytes:
    """The bytes of the file. Errors as of `opened`; ValueError also where it grew meanwhile."""
    with opened(path, most) as file:
        # `read(n)` asks for n bytes of memory before it reads: not for `most`, which may be all there are.
        size = os.fstat(file.fileno()).st_size
        content = file.read(size + 1)
        while size < len(content) <= most and (more := file.read(_PIECE)):  # it grew meanwhile
            content += more
    if len(content) > most:
        raise ValueError(f"{path}: more than {most} bytes")
    return content
