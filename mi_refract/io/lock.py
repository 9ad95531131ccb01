"""A lock file: one process at a time holds it, and the error of all others says who does.

The lock is the operating system's (`flock`), so it ends with the process that holds it, however that ends.
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


@contextlib.contextmanager
def held(path: Path, what: str, place: Path | None = None, expected: str = "another folder") -> Iterator[None]:
    """Hold the lock file `path` within a `with` block, and remove it at the end.

    BlockingIOError, at once and in one line, where another process holds it: `what` runs at `place` (by default the
    folder of the lock file), in which process, and since when. OSError where the file cannot be made. A file system
    without locks, as some networks', keeps nobody out.
    """
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(path.lstat(), os.fstat(file)):
                    break
            os.close(file)  # its holder removed it meanwhile
        except BlockingIOError:
            os.close(file)
            where = f"{place or path.parent}: {what} is already running {_holder(path)}"
            raise BlockingIOError(f"{where}; expected {expected}") from None
        except OSError as error:
            if error.errno in _NO_LOCKS:
                break
            os.close(file)
            raise
    try:
        since = time.strftime("%Y-%m-%d %H:%M:%S %z")
        os.ftruncate(file, 0)
        os.write(file, json.dumps({"process": os.getpid(), "host": os.uname().nodename, "since": since}).encode())
        yield
    finally:
        path.unlink(missing_ok=True)  # while it is held: nobody else's file is removed
        os.close(file)


def _holder(path: Path) -> str:
    """Which process holds the lock, as its file says; nobody waits for the file to be complete."""
    try:
        with path.open("rb") as file:
            said = json.loads(file.read(1000))
        return f"in process {said['process']} on {said['host']} since {said['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "in an unknown process"
