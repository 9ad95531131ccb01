"""Files that are either the old version or the new one, never half of it.

Whoever writes does so under a temporary name in the same folder, which is renamed at the end.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path

_unfinished: set[Path] = set()


def writable(path: str | os.PathLike[str], suffixes: Sequence[str]) -> Path:
    """`path` as a Path, if a file can be written there.

    `suffixes`: accepted endings of the name, in lower case, with the dot. ValueError for another name, OSError for a
    folder that is missing or not writable.
    """
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: accepted: a file name that ends in {' or '.join(suffixes)}")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; accepted: the name of a file")
    check_parent(path)
    return path


def check_parent(path: Path) -> None:
    """OSError where the folder that `path` is to be made in is missing, or not writable."""
    if not path.parent.is_dir():
        raise NotADirectoryError(f"{path}: {path.parent} is not a folder; accepted: an existing one")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise PermissionError(f"{path}: {path.parent} is not writable; accepted: a writable folder")


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], suffix: str = "") -> Iterator[Path]:
    """Yield a temporary path in the same folder, ending in `suffix`; rename what is written there to `path` at the end.

    A reader sees the old file, or folder, or the new one. The old file's permissions are kept. On any exception,
    the caller's or OSError from the system, the old file stays and the temporary one is removed.
    """
    path = Path(path)
    temporary = temporary_name(path, suffix)
    _unfinished.add(temporary)
    try:
        yield temporary
        if path.is_file():
            shutil.copymode(path, temporary)
        temporary.replace(path)
    except BaseException:
        _remove(temporary)
        raise
    finally:
        _unfinished.discard(temporary)


def temporary_name(path: Path, suffix: str) -> Path:
    """A hidden name beside `path` that nothing else has."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.part{suffix}")


def remove_unfinished() -> None:
    """Remove the temporary files of this process, for code that ends it by `os._exit`."""
    for temporary in tuple(_unfinished):
        _remove(temporary)


def _remove(temporary: Path) -> None:
    if temporary.is_dir() and not temporary.is_symlink():
        shutil.rmtree(temporary, ignore_errors=True)
    else:
        temporary.unlink(missing_ok=True)


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Replace the file `path` by `content` (text as UTF-8), complete or not at all, as `replacing` does.

    OSError as the system raises it; the old file stays then.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def update_between(path: str | Path, marker: str, text: str) -> None:
    """Put `text` between `<!-- begin: marker -->` and `<!-- end: marker -->`, each on its own line.

    ValueError unless the file holds exactly one such pair in that order, or where `text` contains a marker itself;
    OSError from reading or writing. The file is unchanged then.
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
