"""Dask workers of the tests: started once a module, killed, and made to lie."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from support.certificates import tls_files
from support.processes import ENVIRONMENT

from mi_refract.cluster.local import PEM
from mi_refract.cluster.worker_facts import facts
from mi_refract.cluster.workers import Workers

_PID = "import os; from distributed import get_worker"


def accepted(client: Any, variant: str, **options: Any) -> Workers:
    """The workers of a client that are like this process, after all have answered."""
    workers = Workers(client, variant, facts(variant), **options)
    workers.wait()
    return workers


def kill(client: Any, address: str) -> None:
    """End a worker's process with SIGKILL; its nanny starts another one."""
    pid = client.run(os.getpid, workers=[address])[address]
    os.kill(pid, signal.SIGKILL)


@contextlib.contextmanager
def joined(client: Any) -> Iterator[subprocess.Popen[bytes]]:
    """One more worker of one thread, without a nanny, for the scheduler of a client of `connected(workers=…)`."""
    command = [sys.executable, "-m", "distributed.cli.dask_worker", client.scheduler.address]
    with tempfile.TemporaryDirectory() as folder:
        files = tls_files({name: getattr(client.security, name) for name in PEM}, Path(folder))
        command += ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--tls-ca-file", str(files.ca_file)]
        command += ["--tls-cert", str(files.cert), "--tls-key", str(files.key)]
        process = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


def until(reached: Callable[[], Any], seconds: float = 60.0) -> None:
    """Wait until something is so; a failure after `seconds`."""
    deadline = time.monotonic() + seconds
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.05)
