"""Run another program in a process group of its own, so that all processes that it started end with it.

Windows has no such groups: there only the program itself is ended.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NoReturn

from .errors import TooMuchOutputError

LONGEST = 7 * 86_400.0  # seconds that a program may have
_PIECE = 2**16  # bytes


@dataclass(frozen=True)
class Ended:
    """A program that has ended: its exit status (−n: killed by signal n), its stdout, and its stderr where kept."""

    status: int
    out: bytes
    said: bytes

    @property
    def describe(self) -> str:
        """How it ended, for an error message."""
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
) -> Ended:
    """Run `command` to its end, with `given` on its stdin. Its stderr is ours, unless it is kept.

    Its process group is killed at the end, after any exception, and when SIGINT, SIGTERM or SIGHUP ends this process.
    `most`: bytes that it may print. OSError if it cannot be started; TimeoutError if it has not ended after `timeout`
    seconds; TooMuchOutputError; ValueError for a `timeout` that is negative, longer than a week, or NaN.
    """
    if not 0 <= timeout <= LONGEST:
        raise ValueError(f"timeout {timeout:g} s; expected 0 … {LONGEST:g} s")
    pipe, errors, deadline = subprocess.PIPE, subprocess.PIPE if keep_stderr else None, time.monotonic() + timeout
    with _signals_raise() as begin:
        process = subprocess.Popen(
            list(command), bufsize=0, stdin=pipe, stdout=pipe, stderr=errors, cwd=cwd, env=env, start_new_session=True
        )

        def feed() -> None:
            assert process.stdin
            rest = memoryview(given)
            with contextlib.suppress(OSError):  # nobody reads it
                while rest:
                    rest = rest[process.stdin.write(rest) :]  # Linux writes up to 2 GiB at a time
            with contextlib.suppress(OSError):
                process.stdin.close()

        try:
            begin()
            threading.Thread(target=feed, daemon=True).start()
            out, said = _read(process, deadline, most)
            process.wait(max(0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"did not end within {timeout:g} s") from None
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS forbids it for a group of zombies
                os.killpg(process.pid, signal.SIGKILL) if hasattr(os, "killpg") else process.kill()
            process.wait()
    return Ended(process.returncode, out, said)


def _read(process: subprocess.Popen[bytes], deadline: float, most: int) -> tuple[bytes, bytes]:
    """All that the program prints: its stdout, and its stderr where it is a pipe."""
    arriving: queue.SimpleQueue[tuple[list[bytes], bytes]] = queue.SimpleQueue()

    def pump(pipe: IO[bytes], kept: list[bytes]) -> None:
        with pipe, contextlib.suppress(OSError):
            while piece := pipe.read(_PIECE):
                arriving.put((kept, piece))
        arriving.put((kept, b""))

    out: list[bytes] = []
    said: list[bytes] = []
    pumps = [(pipe, kept) for pipe, kept in ((process.stdout, out), (process.stderr, said)) if pipe]
    for both in pumps:  # a thread for each: Windows cannot wait for two pipes at once
        threading.Thread(target=pump, args=both, daemon=True).start()
    room, going = most, len(pumps)
    while going:
        try:
            kept, piece = arriving.get(timeout=max(0, deadline - time.monotonic()))
        except queue.Empty:
            raise subprocess.TimeoutExpired(process.args, deadline) from None
        kept.append(piece)
        going -= not piece
        room -= len(piece)
        if room < 0:
            raise TooMuchOutputError(f"more than {most} bytes of output")
    return b"".join(out), b"".join(said)


@contextlib.contextmanager
def _signals_raise() -> Iterator[Callable[[], None]]:
    """Within, SIGINT, SIGTERM and SIGHUP raise where they would end us: as soon as the yielded function was called.

    A signal before that call is kept, and raised by the call: until the program is started there is nothing to end.
    Only in the main thread.
    """
    caught: list[int] = []
    ready: list[bool] = []

    def end(number: int) -> NoReturn:
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)

    def note(number: int, frame: object) -> None:
        caught.append(number)
        if ready:
            end(number)

    def begin() -> None:
        ready.append(True)
        if caught:
            end(caught[0])

    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGINT)}:  # Windows has none
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                before[number] = signal.signal(number, note)
    try:
        yield begin
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
