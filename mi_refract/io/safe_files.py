"""Files: reading of regular files only, atomic writing, temporary files and folders, and locks.

A file is written under a temporary name in the same folder and renamed at the end. An exception or Ctrl-C removes the
temporary file; after SIGKILL it remains, hidden (`.NAME.….part`). A temporary folder that remains is removed by the
next process that creates one.
Locks are those of the operating system (`flock`), which releases them whenever the process ends. Windows has no such
locks: there no process is excluded, and temporary folders of killed processes remain.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import json
import os
import platform
import re
import secrets
import shutil
import stat
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Iterator, Sequence
from io import BufferedReader
from pathlib import Path
from typing import NoReturn

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_CHUNK = 2**20  # bytes
_NAME_LENGTH = 40  # characters of the file's name in a temporary name, which may have up to 255 bytes
_KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
_LONGEST_CHANGE = 5.0  # seconds that creating or renaming may take on a slow file system
_unfinished: set[Path] = set()
# Names of temporary folders contain the host, because other hosts that share the disk may not see a lock.
_PREFIX, _SUFFIX = f"mi_refract-{zlib.crc32(platform.node().encode()):08x}-", ".part"
_TEMPORARY = re.compile(r"\.[0-9a-f]{32}\.part")
_NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)  # and not inherited by other programs
_FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | _NO_LINK
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)
_changing = threading.Lock()  # held while `_unfinished` changes, or while a path in it is created or renamed


def writable(path: str | os.PathLike[str], suffixes: Sequence[str]) -> Path:
    """Return `path` as a Path, if a file can be written there.

    `suffixes`: accepted suffixes, in lower case, with the dot. ValueError for another suffix; OSError if the path
    exists and is not a regular file, or if its folder is missing or not writable.
    """
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: expected a file name that ends in {' or '.join(suffixes)}")
    _require_file(path)
    check_parent(path)
    return path


def _require_file(path: Path) -> None:
    """Raise OSError if `path` exists and is not a regular file: a device or pipe must not be replaced by a file."""
    names = [path, path.parent / path.readlink()] if path.is_symlink() else [path]
    if any(name.parent.resolve().is_relative_to("/proc") for name in names):  # /dev/stdout, /dev/fd/3, even of a file
        raise OSError(f"{path}: is a stream; expected the name of a file")
    kind = stat.S_IFMT(path.stat().st_mode) if path.exists() else stat.S_IFREG
    if kind == stat.S_IFDIR:
        raise IsADirectoryError(f"{path}: is a folder; expected the name of a file")
    if kind != stat.S_IFREG:
        raise OSError(f"{path}: is {_KINDS.get(kind, 'a device')}; expected the name of a file")


def check_parent(path: Path) -> None:
    """Raise OSError if the parent folder of `path` is missing or not writable."""
    if not path.parent.is_dir():
        raise NotADirectoryError(f"{path}: {path.parent} is not a folder; expected an existing one")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise PermissionError(f"{path}: {path.parent} is not writable; expected a writable folder")


def temporary_name(path: Path, suffix: str = "") -> Path:
    """Return a hidden, unpredictable name beside `path`."""
    return path.with_name(f".{path.name[:_NAME_LENGTH]}.{secrets.token_hex(16)}.part{suffix}")


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], suffix: str = "", *, folder: bool = False) -> Iterator[Path]:
    """Yield the path of a new empty file, or with `folder` a new empty folder, that replaces `path` at the end.

    It is beside `path`, its name ends in `suffix`, and it has the permissions of an existing `path`. After any
    exception it is removed, and `path` is unchanged. OSError from the system, and if `path` is not a regular file.
    """
    with beside(path, suffix, folder=folder) as temporary:
        yield temporary
        if not folder:
            sync(temporary)
        move_into_place(temporary, path)


@contextlib.contextmanager
def beside(path: str | os.PathLike[str], suffix: str = "", *, folder: bool = False) -> Iterator[Path]:
    """Yield a path as `replacing`, but remove it at the end unless `move_into_place` has renamed it."""
    path = Path(path)
    if not folder:
        _require_file(path)
    mode = stat.S_IMODE(path.stat().st_mode) if path.exists() else None
    temporary = temporary_name(path, suffix)
    with _changing, full_disk_names(path):
        if folder:
            temporary.mkdir()
        else:
            temporary.touch(exist_ok=False)
        _unfinished.add(temporary)
        if mode is not None:
            temporary.chmod(mode | (stat.S_IRWXU if folder else stat.S_IRUSR | stat.S_IWUSR))
    try:
        with full_disk_names(path):
            yield temporary
    finally:
        _discard(temporary)


def move_into_place(temporary: Path, path: str | os.PathLike[str]) -> None:
    """Rename a file or folder from `beside` to `path`, with the permissions of an existing `path`."""
    path = Path(path)
    with _changing:
        if path.exists():
            temporary.chmod(stat.S_IMODE(path.stat().st_mode))
        temporary.replace(path)
        _unfinished.discard(temporary)


def sync(path: Path) -> None:
    """Wait until the file is on the disk. OSError if the disk is full."""
    with path.open("r+b") as file, full_disk_names(path):  # Windows can sync only writable files
        os.fsync(file)


def is_full_disk(error: BaseException) -> bool:
    """Return whether this is the error of a full disk, of a quota or of a limit on the size of files."""
    return isinstance(error, OSError) and error.errno in _FULL


@contextlib.contextmanager
def full_disk_names(path: str | os.PathLike[str]) -> Iterator[None]:
    """Within the context, add this path to errors of a full disk, of a quota or of a limit on the size of files."""
    try:
        yield
    except OSError as error:
        if is_full_disk(error) and (not error.filename or _TEMPORARY.search(str(error.filename))):
            error.filename = str(path)
        raise


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield a new folder for temporary files, which is removed at the end, also by `end_process`.

    Folders of killed processes on this host are removed first; a running process locks its folder.
    """
    parent = Path(tempfile.gettempdir())
    _remove_abandoned(parent)
    while True:
        with _changing:
            folder = Path(tempfile.mkdtemp(_SUFFIX, _PREFIX, parent))
            _unfinished.add(folder)
        with contextlib.suppress(FileNotFoundError):  # another process has removed it before it was locked
            lock = os.open(folder if fcntl else os.devnull, _FOLDER)  # Windows cannot open folders
            with contextlib.suppress(OSError):  # the file system has no locks
                _lock(lock)
            if folder.is_dir():
                break
            os.close(lock)
    try:
        yield folder
    finally:
        _discard(folder)
        os.close(lock)


def _lock(file: int, *, wait: bool = True) -> None:
    """Lock an open file for this process. BlockingIOError if another process has locked it; OSError without locks."""
    if not fcntl:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


@functools.cache  # once per process
def _remove_abandoned(parent: Path) -> None:
    for folder in parent.glob(f"{_PREFIX}*{_SUFFIX}"):
        with contextlib.suppress(OSError):  # the folder is locked, belongs to another user, or has been removed
            lock = os.open(folder, _FOLDER)
            try:
                _lock(lock, wait=False)
                if os.fstat(lock).st_uid == os.getuid():
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)


def _discard(temporary: Path) -> None:
    with _changing:
        if temporary in _unfinished:
            _remove(temporary)
            _unfinished.discard(temporary)


def _remove(temporary: Path) -> None:
    if temporary.is_dir() and not temporary.is_symlink():
        shutil.rmtree(temporary, ignore_errors=True)
    else:
        temporary.unlink(missing_ok=True)


def end_process(code: int) -> NoReturn:
    """Remove all temporary files and folders, and end this process at once, even if other threads are running."""
    _changing.acquire(timeout=_LONGEST_CHANGE)  # never released: from here on nothing is created or renamed
    for pause in (0.1, 0.0):  # twice, because a thread that is just opening a file by its name creates it again
        for temporary in tuple(_unfinished):
            _remove(temporary)
        time.sleep(pause if _unfinished else 0.0)
    os._exit(code)


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Replace the file `path` by `content` (text as UTF-8), completely or not at all. Errors: those of `replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def update_between(path: str | Path, marker: str, text: str) -> None:
    """Put `text` between `<!-- begin: marker -->` and `<!-- end: marker -->`, each on its own line.

    ValueError unless the file contains exactly one such pair in that order, and if `text` contains a marker; OSError
    from reading or writing. After an error the file is unchanged.
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


@contextlib.contextmanager
def held(path: Path, what: str, place: Path | None = None, expected: str = "another folder") -> Iterator[None]:
    """Hold the lock file `path` within the context, and remove it at the end.

    BlockingIOError, at once and in one line, if another process holds it: that `what` runs at `place` (by default the
    folder of the lock file), in which process, and since when. OSError if the file cannot be created. On a file system
    without locks, as in some networks, no process is excluded.
    """
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | _NO_LINK, 0o644)
        try:
            _lock(file, wait=False)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(path.lstat(), os.fstat(file)):
                    break
            os.close(file)  # its holder has removed it
        except BlockingIOError:
            os.close(file)
            holder = "in an unknown process"
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError), path.open("rb") as text:
                content = json.loads(text.read(1000))  # may be incomplete
                holder = f"in process {content['process']} on {content['host']} since {content['since']}"
            where = f"{place or path.parent}: {what} is already running {holder}"
            raise BlockingIOError(f"{where}; expected {expected}") from None
        except OSError as error:
            if error.errno in _NO_LOCKS:
                break
            os.close(file)
            raise
    try:
        since = time.strftime("%Y-%m-%d %H:%M:%S %z")
        os.ftruncate(file, 0)
        os.write(file, json.dumps({"process": os.getpid(), "host": platform.node(), "since": since}).encode())
        yield
    finally:
        if fcntl:  # before closing, so that no other process's file is removed
            path.unlink(missing_ok=True)
        os.close(file)
        if not fcntl:  # Windows cannot remove open files
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


# Reading -------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def opened(path: str | os.PathLike[str], most: int) -> Iterator[BufferedReader]:
    """Yield the file, open for reading, if it has at most `most` bytes.

    ValueError for a larger file, and for a pipe or a device, which may never end. OSError if it cannot be read.
    """
    # Without O_NONBLOCK, opening a pipe that has no writer would block.
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | getattr(os, "O_NONBLOCK", 0))) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise ValueError(f"{path}: not a regular file")
        if status.st_size > most:
            raise ValueError(f"{path}: {status.st_size} bytes; expected up to {most}")
        yield file


def read_bytes(path: str | os.PathLike[str], most: int) -> bytes:
    """Return the bytes of the file. Errors: those of `opened`, and ValueError if it grows beyond `most` bytes."""
    with opened(path, most) as file:
        # `read(n)` allocates n bytes before it reads, and `most` may be the whole memory.
        size = os.fstat(file.fileno()).st_size
        content = file.read(size + 1)
        while size < len(content) <= most and (chunk := file.read(_CHUNK)):  # the file is growing
            content += chunk
    if len(content) > most:
        raise ValueError(f"{path}: more than {most} bytes")
    return content


def copy(source: str | os.PathLike[str], target: Path, most: int = sys.maxsize) -> str:
    """Copy a regular file of up to `most` bytes to `target`, and return its SHA-256. Errors: those of `opened`."""
    digest = hashlib.sha256()
    with opened(source, most) as file, full_disk_names(target), target.open("wb") as target_file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
            target_file.write(chunk)
    return digest.hexdigest()


def digest(path: Path) -> str:
    """Return the SHA-256 of a regular file, or "" if there is no file. Errors: those of `opened`."""
    if not path.exists():
        return ""
    with opened(path, sys.maxsize) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
