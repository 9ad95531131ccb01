"""Python subprocesses that import the package from this checkout, and checks of a command's output."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, sys.path)])}


def python(code: str, *arguments: object, **environment: str) -> subprocess.Popen[str]:
    """Start `python -c code arguments` with additional environment variables; its output is text in pipes."""
    command, pipe = [sys.executable, "-c", code, *map(str, arguments)], subprocess.PIPE
    return subprocess.Popen(command, env=ENVIRONMENT | environment, text=True, stdout=pipe, stderr=pipe)


def executable(path: Path, text: str) -> None:
    """Write a program."""
    path.write_text(text)
    path.chmod(0o755)


def assert_refused(outcome: tuple[int, str, str], *messages: object) -> None:
    """Check an outcome of the fixture `run`: exit code 2, and only one line on stderr, which contains the messages."""
    code, out, err = outcome
    assert (code, out, err.count("\n")) == (2, "", 1) and err.startswith("mi-refract: ")
    assert all(str(message) in err for message in messages), err


def until(reached: Callable[[], Any], seconds: float = 60.0) -> None:
    """Wait until `reached()` is true; fail after `seconds`."""
    deadline = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.05)
