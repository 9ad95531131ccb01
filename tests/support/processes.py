"""Python code in a process of its own that imports the package from this checkout; what a command that fails prints."""

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
    """Start `python -c code arguments`, with variables of the environment added; its output is text in pipes."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        env=ENVIRONMENT | environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def assert_refused(outcome: tuple[int, str, str], *messages: object) -> None:
    """Of the fixture `run`: exit code 2, and nothing printed but one line on stderr that holds the messages."""
    code, out, err = outcome
    assert (code, out, err.count("\n")) == (2, "", 1) and err.startswith("mi-refract: ")
    assert all(str(message) in err for message in messages), err


def until(reached: Callable[[], Any], seconds: float = 60.0) -> None:
    """Wait until something is so; a failure after `seconds`."""
    deadline = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.05)
