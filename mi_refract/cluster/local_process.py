"""A local cluster in a process of its own, which ends with ours."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from .local import FAILED

MOST = 1024  # workers
MODULE = "mi_refract.cluster.local"
_ENDING = 10.0  # seconds


@dataclass(frozen=True)
class LocalScheduler:
    """Its address, and the texts of certificate and key, by their names in Dask's `Security`."""

    address: str
    pem: dict[str, str]

    def security(self) -> Any:
        """A `distributed.Security` for it."""
        from distributed.security import Security

        return Security(**self.pem, require_encryption=True)


@contextlib.contextmanager
def started(workers: int) -> Iterator[LocalScheduler]:
    """A scheduler with so many workers, processes of one thread each. They end at the end.

    They also end where this process is killed. ConnectionError, one line, where they cannot be started.
    """
    if not 1 <= workers <= MOST:
        raise ValueError(f"--workers {workers}: accepted: a whole number from 1 to {MOST}")
    # -P: no module of the working folder takes the place of one of ours.
    command = [sys.executable, "-P", "-m", MODULE, str(workers)]
    process = subprocess.Popen(
        command,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=None if os.environ.get("MI_REFRACT_TRACEBACK") == "1" else subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    assert process.stdin and process.stdout
    try:
        said = process.stdout.readline().strip()
        if not said or said.startswith(FAILED):
            reason = said.removeprefix(FAILED) or f"ended with status {process.wait()}"
            raise ConnectionError(f"--workers {workers}: no local cluster: {reason}; accepted: fewer, or none")
        found = json.loads(said)
        yield LocalScheduler(found.pop("address"), found)
    finally:
        process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_ENDING)
        process.stdout.close()
