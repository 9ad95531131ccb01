"""A ray set through someone else's program: rays on its stdin, answers on its stdout, both as CSV."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from .rays import Answers, RaySet, as_csv, parse_answers

TIMEOUT = 300.0  # seconds


def answers_of(
    command: Sequence[str],
    rays: RaySet,
    *,
    timeout: float = TIMEOUT,
    cwd: str | Path | None = None,
    env: Mapping[str, str] | None = None,
) -> Answers:
    """What `command` answers. Its stderr goes where ours goes; with it ends every process of its group.

    ValueError, one line that begins with the command: a status other than 0, answers that cannot be read, or none
    within `timeout` seconds. OSError where it cannot be started.
    """
    if not command:
        raise ValueError("no command; accepted: mi-refract rays run [OPTIONS] -- COMMAND")
    name = shlex.join(command)
    try:
        process = subprocess.Popen(
            list(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=cwd, env=env, start_new_session=True
        )
    except OSError as error:
        raise type(error)(f"{name}: cannot be started: {error.strerror or error}") from None
    with process:
        try:
            output, _ = process.communicate(as_csv(rays).encode(), timeout)
        except subprocess.TimeoutExpired:
            raise ValueError(f"{name}: no answer within {timeout:g} s; accepted: a longer --timeout") from None
        finally:
            _end(process)
    if process.returncode:
        raise ValueError(f"{name}: {_status(process.returncode)}; accepted: status 0")
    return parse_answers(output, name)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill what is left of the group: the program itself after a timeout or Ctrl-C, and what it started."""
    # Nothing may be left; macOS forbids it for a group of zombies.
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def _status(code: int) -> str:
    if code > 0:
        return f"ended with status {code}"
    names = {member.value: member.name for member in signal.Signals}
    return f"was killed by {names.get(-code, f'signal {-code}')}"
