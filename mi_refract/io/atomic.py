"""Files that are either the old version or the new one, never half of it."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Sequence
from pathlib import Path


def writable(path: str | os.PathLike[str], suffixes: Sequence[str]) -> Path:
    """The path, where a file of that kind can be put; otherwise ValueError for its name, OSError for its folder."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: accepted: a file name that ends in {' or '.join(suffixes)}")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; accepted: the name of a file")
    if not path.parent.is_dir():
        raise NotADirectoryError(f"{path}: {path.parent} is not a folder; accepted: an existing one")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise PermissionError(f"{path}: {path.parent} is not writable; accepted: a writable folder")
    return path


def write_atomically(path: str | Path, content: str | bytes) -> None:
    """Replace `path` by `content` (text as UTF-8), keeping the old file's permissions.

    Written under a temporary name in the same folder, then renamed: a reader sees the old file or the new.
    Errors: OSError as the system raises it; the old file stays and the temporary one is gone.
    """
    path = Path(path)
    data = content.encode() if isinstance(content, str) else content
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        temporary.write_bytes(data)
        if path.exists():
            shutil.copymode(path, temporary)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def update_between(path: str | Path, marker: str, text: str) -> None:
    """Put `text` between `<!-- begin: marker -->` and `<!-- end: marker -->`, each on its own line.

    Errors: ValueError unless the file holds exactly one such pair in that order, or when `text` contains a
    marker itself; OSError from reading or writing. The file is then unchanged.
    """
    path = Path(path)
    begin, end = f"<!-- begin: {marker} -->", f"<!-- end: {marker} -->"
    document = path.read_bytes().decode()
    if document.count(begin) != 1 or document.count(end) != 1 or document.index(begin) > document.index(end):
        raise ValueError(f"{path}: expected one '{begin}' followed by one '{end}'")
    if begin in text or end in text:
        raise ValueError(f"{path}: the text for '{marker}' contains its own marker")
    head, _, rest = document.partition(begin)
    tail = rest.partition(end)[2]
    newline = "\r\n" if "\r\n" in document else "\n"
    body = "\n".join((begin, text.strip("\n"), end)).replace("\n", newline)
    write_atomically(path, head + body + tail)
