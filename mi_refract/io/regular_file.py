"""Files that others wrote, read only where they are files, and not larger than expected."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def opened(path: str | os.PathLike[str], most: int) -> Iterator[BinaryIO]:
    """The file, open for reading, of `most` bytes at most.

    ValueError for a larger one, or for what is no file: a pipe or a device may never end. OSError where it cannot be
    read.
    """
    path = Path(path)
    # A pipe without a writer would block when it is opened.
    with os.fdopen(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb") as file:
        found = os.fstat(file.fileno())
        if stat.S_ISDIR(found.st_mode):
            raise IsADirectoryError(f"{path}: is a folder; accepted: a file")
        if not stat.S_ISREG(found.st_mode):
            raise ValueError(f"{path}: is a pipe or a device; accepted: a file")
        if found.st_size > most:
            raise ValueError(f"{path}: {found.st_size} bytes; accepted: up to {most}")
        yield file


def read_bytes(path: str | os.PathLike[str], most: int) -> bytes:
    """The bytes of the file. Errors as of `opened`; ValueError also where it grew meanwhile."""
    with opened(path, most) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"{path}: more than {most} bytes; accepted: up to {most}")
    return content
