"""Files that are either the old version or the new one, never half of it.

Whoever writes does so under a temporary name in the same folder, which is renamed at the end.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import secrets
import shutil
import stat
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NoReturn

from .lock import is_at

_OURS = re.compile(r"\..*\.[0-9a-f]{32}\.part(\.\w+)?", re.DOTALL)  # as `temporary_name` makes them
_KEPT = 40  # characters of the file's own name: a name of 255 bytes has no room for more
_KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
_LONGEST_CHANGE = 5.0  # seconds that one file system may take for it
_OPENING = 0.1  # seconds
_unfinished: set[Path] = set()
_changing = threading.Lock()  # held where `_unfinished` changes, and what is in it
_swept: set[Path] = set()


def writable(path: str | os.PathLike[str], suffixes: Sequence[str]) -> Path:
    """`path` as a Path, if a file can be written there.

    `suffixes`: accepted endings of the name, in lower case, with the dot. ValueError for another name, OSError for what
    exists and is no file, or for a folder that is missing or not writable.
    """
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: expected a file name that ends in {' or '.join(suffixes)}")
    _require_file(path)
    check_parent(path)
    return path


def _require_file(path: Path) -> None:
    """OSError where `path` exists and is no file: a new file cannot take its place, or others would lose it."""
    names = [path, path.parent / path.readlink()] if path.is_symlink() else [path]
    if any(name.parent.resolve().is_relative_to("/proc") for name in names):  # /dev/stdout, /dev/fd/3: may be of a file
        raise OSError(f"{path}: is a stream of a process; expected the name of a file")
    kind = stat.S_IFMT(path.stat().st_mode) if path.exists() else stat.S_IFREG
    if kind == stat.S_IFDIR:
        raise IsADirectoryError(f"{path}: is a folder; expected the name of a file")
    if kind != stat.S_IFREG:
        raise OSError(f"{path}: is {_KINDS.get(kind, 'a device')}; expected the name of a file")


def check_parent(path: Path) -> None:
    """OSError where the folder that `path` is to be made in is missing, or not writable."""
    if not path.parent.is_dir():
        raise NotADirectoryError(f"{path}: {path.parent} is not a folder; expected an existing one")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise PermissionError(f"{path}: {path.parent} is not writable; expected a writable folder")


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], suffix: str = "", *, folder: bool = False) -> Iterator[Path]:
    """Yield a temporary path in the same folder, ending in `suffix`; rename what is written there to `path` at the end.

    An empty file is there already, or with `folder` an empty folder: made exclusively, under a name that nobody can
    guess, with the permissions of the old one. A reader sees the old file, or folder, or the new one. On any exception,
    the caller's or OSError from the system, the old one stays and the temporary one is removed; what a killed process
    left behind goes with the next file that is written beside it. OSError for a file where `path` exists and is none.
    """
    path = Path(path)
    if not folder:
        _require_file(path)
    sweep(path.parent)
    with _changing:
        temporary, lock = _new(path, suffix, folder)
        _unfinished.add(temporary)
    try:
        yield temporary
        with _changing:
            _copy_mode(path, lock)
            temporary.replace(path)
            _unfinished.discard(temporary)
    except BaseException:
        with _changing:
            _remove(temporary)
            _unfinished.discard(temporary)
        raise
    finally:
        os.close(lock)


def _new(path: Path, suffix: str, folder: bool) -> tuple[Path, int]:
    """A temporary beside `path`, new and open, and its descriptor, locked for as long as this process uses it."""
    while True:
        temporary = temporary_name(path, suffix)
        if folder:
            temporary.mkdir()
        else:
            temporary.touch(exist_ok=False)  # O_EXCL: a link of that name is an error, too
        with contextlib.suppress(FileNotFoundError):  # another process took it, as yet unlocked, for a stale one
            file = os.open(temporary, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
            if _try_lock(file) is not False and is_at(file, temporary):
                _copy_mode(path, file, stat.S_IRWXU if folder else stat.S_IRUSR | stat.S_IWUSR)
                return temporary, file
            os.close(file)


def temporary_name(path: Path, suffix: str) -> Path:
    """A hidden name beside `path` that nobody can guess."""
    return path.with_name(f".{path.name[:_KEPT]}.{secrets.token_hex(16)}.part{suffix}")


def _copy_mode(path: Path, file: int, least: int = 0) -> None:
    """Give the open file the permissions of `path`, where there is one, and `least`."""
    with contextlib.suppress(FileNotFoundError):
        os.fchmod(file, stat.S_IMODE(path.stat().st_mode) | least)


def _try_lock(file: int) -> bool | None:
    """True where the file is locked now, False where another process has it, None where the system has no locks."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def sweep(folder: Path) -> None:
    """Remove the temporary files and folders of ours in `folder` whose process has ended. Once for each folder.

    A living process holds a lock on each of its own. What cannot be locked or removed stays; nothing is raised.
    """
    folder = folder.resolve()
    if folder in _swept:
        return
    _swept.add(folder)
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            if _OURS.fullmatch(entry.name):
                _remove_stale(Path(entry.path))


def _remove_stale(temporary: Path) -> None:
    with contextlib.suppress(OSError):
        file = os.open(temporary, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            ours = stat.S_IFMT(os.fstat(file).st_mode) in (stat.S_IFREG, stat.S_IFDIR)
            if ours and _try_lock(file) and is_at(file, temporary):
                _remove(temporary)
        finally:
            os.close(file)


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """A new folder for temporary files, removed at the end, also by `end_process`."""
    with _changing:
        folder = Path(tempfile.mkdtemp(prefix="mi_refract-"))
        _unfinished.add(folder)
    try:
        yield folder
    finally:
        with _changing:
            _remove(folder)
            _unfinished.discard(folder)


def end_process(code: int) -> NoReturn:
    """End this process at once, whatever its other threads do, without its temporary files and folders."""
    _changing.acquire(timeout=_LONGEST_CHANGE)  # for ever: nothing is begun, finished or found missing from here on
    for temporary in tuple(_unfinished):
        _remove(temporary)
    if _unfinished:  # a thread that was about to open one by its name has made it anew
        time.sleep(_OPENING)
    for temporary in tuple(_unfinished):
        _remove(temporary)
    os._exit(code)


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
