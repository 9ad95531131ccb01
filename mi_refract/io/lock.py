"""A lock on a name: one process at a time, and the others are told who holds it.

The lock is the operating system's, on a file: it ends with the process that holds it, however that ends. The file says
who that is, and is removed at the end.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)
_SAID = 1000  # bytes that are read of a lock file, which may be anything


@contextlib.contextmanager
def held(path: Path, what: str, place: Path | None = None, accepted: str = "another folder") -> Iterator[None]:
    """Hold the lock file `path` for the time of a `with` block.

    BlockingIOError, at once and in one line, where another process holds it: `what` runs at the `place`, by default the
    folder of the lock file, who runs it, and since when. OSError where the file cannot be made. A file that a killed
    process left is taken over. Where the file system has no locks, as some networks', nobody is kept out.
    """
    file = _locked(path)
    if file is None:
        where = path.parent if place is None else place
        raise BlockingIOError(f"{where}: {what} runs there already, {_holder(path)}; expected {accepted}")
    try:
        import socket  # the others who import this module do without

        since = time.strftime("%Y-%m-%d %H:%M:%S %z")
        os.ftruncate(file, 0)
        os.write(file, json.dumps({"process": os.getpid(), "host": socket.gethostname(), "since": since}).encode())
        yield
    finally:
        path.unlink(missing_ok=True)  # while it is held: nobody else's file is removed
        os.close(file)


def _locked(path: Path) -> int | None:
    """The descriptor of the locked file; None where another process has locked it."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            return None
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return file
            os.close(file)
            raise
        if is_at(file, path):
            return file
        os.close(file)  # its holder has removed it meanwhile


def is_at(file: int, path: Path) -> bool:
    """Whether `path` is still the name of the open file."""
    try:
        found = path.lstat()
    except OSError:
        return False
    return os.path.samestat(found, os.fstat(file))


def _holder(path: Path) -> str:
    """Who holds the lock, as its file says; nobody waits for the file to be complete."""
    try:
        with path.open("rb") as file:
            said = json.loads(file.read(_SAID))
        return f"process {said['process']} on {said['host']} since {said['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "by a process that has not said which it is"
