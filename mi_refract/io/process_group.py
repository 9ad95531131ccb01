"""Run another program in its own process group, so that all processes that it started end with it.

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

LONGEST = 7 * 86_400.0  # the largest timeout in seconds
_CHUNK = 2**16  # bytes


@dataclass(frozen=True)
class Ended:
    """A program that has ended: its exit status (−n: killed by signal n), its stdout, and its stderr if kept."""

    status: int
    out: bytes
    err: bytes

    @property
    def describe(self) -> str:
        """How the program ended, for an error message."""
        if self.status >= 0:
            return f"ended with status {self.status}"
        names = {member.value: member.name for member in signal.Signals}
        return f"was killed by {names.get(-self.status, f'signal {-self.status}')}"


def run(
    command: Sequence[str],
    stdin: bytes,
    timeout: float,
    *,
    keep_stderr: bool = False,
    cwd: str | Path | None = None,
    env: Mapping[str, str] | None = None,
    most: int = 2**30,
) -> Ended:
    """Run `command` to its end, with `stdin` as its input. Its stderr is that of this process, unless it is kept.

    Its process group is killed at the end, after any exception, and when SIGINT, SIGTERM or SIGHUP ends this process.
    `most`: bytes that it may print. OSError if it cannot be started; TimeoutError if it has not ended after `timeout`
    seconds; TooMuchOutputError; ValueError for a `timeout` that is negative, longer than a week, or NaN.
    """
    if not 0 <= timeout <= LONGEST:
        raise ValueError(f"timeout {timeout:g} s; expected 0 … {LONGEST:g} s")
    pipe, stderr, deadline = subprocess.PIPE, subprocess.PIPE if keep_stderr else None, time.monotonic() + timeout
    with _signals_raise() as allow_signals:
        process = subprocess.Popen(
            list(command), bufsize=0, stdin=pipe, stdout=pipe, stderr=stderr, cwd=cwd, env=env, start_new_session=True
        )

        def feed() -> None:
            assert process.stdin
            rest = memoryview(stdin)
            with contextlib.suppress(OSError):  # the program does not read it
                while rest:
                    rest = rest[process.stdin.write(rest) :]  # Linux writes up to 2 GiB at a time
            with contextlib.suppress(OSError):
                process.stdin.close()

        try:
            allow_signals()
            threading.Thread(target=feed, daemon=True).start()
            out, err = _read(process, deadline, most)
            process.wait(max(0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"did not end within {timeout:g} s") from None
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS forbids it for a group of zombies
                os.killpg(process.pid, signal.SIGKILL) if hasattr(os, "killpg") else process.kill()
            process.wait()
    return Ended(process.returncode, out, err)


def _read(process: subprocess.Popen[bytes], deadline: float, most: int) -> tuple[bytes, bytes]:
    """Return the program's stdout, and its stderr if that is a pipe."""
    chunks: queue.SimpleQueue[tuple[list[bytes], bytes]] = queue.SimpleQueue()  # of both pipes; empty at the end of one

    def pump(pipe: IO[bytes], output: list[bytes]) -> None:
        with pipe, contextlib.suppress(OSError):
            while chunk := pipe.read(_CHUNK):
                chunks.put((output, chunk))
        chunks.put((output, b""))

    out: list[bytes] = []
    err: list[bytes] = []
    pumps = [(pipe, output) for pipe, output in ((process.stdout, out), (process.stderr, err)) if pipe]
    for pipe_and_output in pumps:  # a thread for each pipe, because Windows cannot wait for two pipes
        threading.Thread(target=pump, args=pipe_and_output, daemon=True).start()
    size, open_pipes = 0, len(pumps)
    while open_pipes:
        # A signal that another thread receives does not wake this one, which handles it: so wait a second at most.
        remaining = deadline - time.monotonic()
        try:
            output, chunk = chunks.get(timeout=min(max(0, remaining), 1))
        except queue.Empty:
            if remaining > 1:
                continue
            raise subprocess.TimeoutExpired(process.args, deadline) from None
        output.append(chunk)
        if not chunk:
            open_pipes -= 1
        size += len(chunk)
        if size > most:
            raise TooMuchOutputError(f"more than {most} bytes of output")
    return b"".join(out), b"".join(err)


@contextlib.contextmanager
def _signals_raise() -> Iterator[Callable[[], None]]:
    """Within the context, SIGINT, SIGTERM and SIGHUP raise exceptions where they would end this process.

    They do so after the yielded function is called, that is, when the program has been started and can be ended. A
    signal before that is raised by the call. In other threads than the main thread this has no effect.
    """
    received: list[int] = []
    allowed = False

    def raise_exception(number: int) -> NoReturn:
        raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)

    def handle(number: int, frame: object) -> None:
        received.append(number)
        if allowed:
            raise_exception(number)

    def allow() -> None:
        nonlocal allowed
        allowed = True
        if received:
            raise_exception(received[0])

    previous: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        hangup = getattr(signal, "SIGHUP", signal.SIGINT)  # Windows has none
        for number in {signal.SIGINT, signal.SIGTERM, hangup}:
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                previous[number] = signal.signal(number, handle)
    try:
        yield allow
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
