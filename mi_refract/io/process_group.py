"""Run another program in a process group of its own, so that all processes that it started end with it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path


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
) -> Ended:
    """Run `command` to its end, with `given` on its stdin. Its stderr goes where ours goes, unless it is kept.

    OSError if it cannot be started; TimeoutError if it has not ended after `timeout` seconds: it is killed then.
    """
    pipe, errors = subprocess.PIPE, subprocess.PIPE if keep_stderr else None
    process = subprocess.Popen(
        list(command), stdin=pipe, stdout=pipe, stderr=errors, cwd=cwd, env=env, start_new_session=True
    )
    with process:
        try:
            out, said = process.communicate(given, timeout)
        except subprocess.TimeoutExpired:
            raise TimeoutError(f"no end within {timeout:g} s") from None
        finally:
            # Also after Ctrl-C. Nothing may be left; macOS forbids it for a group of zombies.
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
    return Ended(process.returncode, out, said or b"")
