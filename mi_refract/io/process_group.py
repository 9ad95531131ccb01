"""Run another program in a process group of its own, so that all processes that it started end with it.

A program may leave its group (a "double fork"). Where the system lets us adopt orphans, which is Linux, `run` can find
those, too, and end them. A SIGKILL to us ends nothing else.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .errors import TooMuchOutputError

LONGEST = 7 * 86_400.0  # seconds that a program may have
_PIECE = 2**16  # bytes
_POLL = 0.02  # seconds
_ADOPTING = 36  # PR_SET_CHILD_SUBREAPER of <linux/prctl.h>
_ENDING = 5.0  # seconds until a killed process must have ended


@dataclass(frozen=True)
class Ended:
    """A program that has ended: its exit status (−n: killed by signal n), its stdout, its stderr where it was kept."""

    status: int
    out: bytes
    said: bytes

    @property
    def how(self) -> str:
        """How it ended, in words for an error message."""
        if self.status >= 0:
            return f"ended with status {self.status}"
        names = {member.value: member.name for member in signal.Signals}
        return f"was killed by {names.get(-self.status, f'signal {-self.status}')}"


def run(
    command: Sequence[str],
    given: bytes,
    timeout: float,
    *,
    keep_stderr: bool = False,
    cwd: str | Path | None = None,
    env: Mapping[str, str] | None = None,
    most: int = 2**30,
    adopt: bool = False,
) -> Ended:
    """Run `command` to its end, with `given` on its stdin. Its stderr goes where ours goes, unless it is kept.

    A SIGINT, SIGTERM or SIGHUP to us ends it, too, and has its usual effect on us then. `most`: bytes that it may
    print. `adopt`: end what has left its group as well; for a caller that starts no other process meanwhile.
    OSError if it cannot be started; TimeoutError if it has not ended after `timeout` seconds, TooMuchOutputError if it
    prints more than `most` bytes: it is killed then. ValueError for a `timeout` that is no time.
    """
    if not 0 <= timeout <= LONGEST:
        raise ValueError(f"timeout {timeout:g} s; expected 0 … {LONGEST:g} s")
    pipe, errors = subprocess.PIPE, subprocess.PIPE if keep_stderr else None
    with _signals_noted() as noted, _adopting(adopt):
        process = subprocess.Popen(
            list(command), bufsize=0, stdin=pipe, stdout=pipe, stderr=errors, cwd=cwd, env=env, start_new_session=True
        )
        with process:
            try:
                found = _Conversation(process, given, time.monotonic() + timeout, most, noted).follow()
            except TimeoutError:
                raise TimeoutError(f"no end within {timeout:g} s") from None
            finally:
                # Nothing may be left; macOS forbids it for a group of zombies.
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(process.pid, signal.SIGKILL)
    return Ended(process.returncode, *found)


@dataclass
class _Conversation:
    """What a program is given and what it says, until it has ended or must end."""

    process: subprocess.Popen[bytes]
    given: bytes
    deadline: float
    most: int
    noted: list[int]  # signals to us
    kept: dict[int, list[bytes]] = field(default_factory=dict)  # by the number of a pipe

    def follow(self) -> tuple[bytes, bytes]:
        """Its stdout and stderr, when it has ended or a signal came."""
        process = self.process
        assert process.stdin and process.stdout
        with selectors.DefaultSelector() as selector:
            os.set_blocking(process.stdin.fileno(), False)
            selector.register(process.stdin, selectors.EVENT_WRITE)
            outputs = [pipe.fileno() for pipe in (process.stdout, process.stderr) if pipe]
            for number in outputs:
                self.kept[number] = []
                selector.register(number, selectors.EVENT_READ)
            self._exchange(selector)
        while process.poll() is None and not self._over():
            time.sleep(_POLL)
        return b"".join(self.kept[outputs[0]]), b"".join(self.kept[outputs[1]]) if len(outputs) > 1 else b""

    def _exchange(self, selector: selectors.BaseSelector) -> None:
        rest, room = memoryview(self.given), self.most
        while selector.get_map() and not self._over():
            for key, _ in selector.select(_POLL):
                if key.fd in self.kept:
                    piece = os.read(key.fd, _PIECE)
                    self.kept[key.fd].append(piece)
                    room -= len(piece)
                    done = not piece
                else:
                    rest = rest[_written(key.fd, rest) :]
                    done = not rest
                if room < 0:
                    raise TooMuchOutputError(f"more than {self.most} bytes of output")
                if done:
                    selector.unregister(key.fileobj)
                    if key.fileobj is self.process.stdin:
                        self.process.stdin.close()

    def _over(self) -> bool:
        """Whether a signal came. TimeoutError where the time is over."""
        if time.monotonic() > self.deadline:
            raise TimeoutError
        return bool(self.noted)


def _written(number: int, rest: memoryview) -> int:
    """How much of `rest` was written; all of it where nobody reads it."""
    try:
        return os.write(number, rest[:_PIECE]) if rest else 0
    except BlockingIOError:
        return 0
    except BrokenPipeError:
        return len(rest)


@contextlib.contextmanager
def _signals_noted() -> Iterator[list[int]]:
    """Signals that would end us are noted meanwhile, and have their effect afterwards. In the main thread only."""
    noted: list[int] = []
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        usual = {
            signal.SIGINT: signal.default_int_handler,
            signal.SIGTERM: signal.SIG_DFL,
            signal.SIGHUP: signal.SIG_DFL,
        }
        for number, handler in usual.items():
            if signal.getsignal(number) is handler:
                before[number] = signal.signal(number, lambda number, frame: noted.append(number))
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for caught in noted:
            signal.raise_signal(caught)


# Orphans -----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _adopting(wanted: bool) -> Iterator[None]:
    """Orphans of our children become our children meanwhile, and are ended. Nothing where the system does not do it."""
    prctl = _prctl() if wanted else None
    if prctl is None or prctl(_ADOPTING, 1, 0, 0, 0):
        yield
        return
    before = _children()
    try:
        yield
    finally:
        _end_children(before)
        prctl(_ADOPTING, 0, 0, 0, 0)


def _prctl() -> Any:
    """The system's function; None where it has none."""
    if not sys.platform.startswith("linux"):
        return None
    return getattr(ctypes.CDLL(None), "prctl", None)


def _end_children(before: set[int]) -> None:
    """End all children that are not in `before`, and theirs, which become ours when their parent ends."""
    deadline = time.monotonic() + _ENDING
    while (found := _children() - before) and time.monotonic() < deadline:
        for child in found:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(child, signal.SIGKILL)
        for child in found:
            with contextlib.suppress(ChildProcessError):
                while os.waitpid(child, os.WNOHANG)[0] == 0 and time.monotonic() < deadline:
                    time.sleep(_POLL / 10)


def _children() -> set[int]:
    """The processes whose parent we are."""
    found = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError, ValueError, IndexError):
                # "pid (name) state parent …", and the name may hold brackets and spaces.
                if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == os.getpid():
                    found.add(int(entry.name))
    return found
