"""Dask workers for tests: checked, killed, added, and started as programs."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from support.processes import ENVIRONMENT

from mi_refract.cluster.on_worker import facts
from mi_refract.cluster.workers import Workers


def accepted(client: Any, variant: str, **options: Any) -> Workers:
    """Return the workers of a client after all have reported their facts; usable are those like this process."""
    workers = Workers(client, variant, facts(variant), **options)
    workers.wait()
    return workers


def kill(client: Any, address: str) -> None:
    """Kill a worker's process with SIGKILL; its nanny starts another one."""
    pid = client.run(os.getpid, workers=[address])[address]
    os.kill(pid, signal.SIGKILL)


@contextlib.contextmanager
def joined(client: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Add a single-threaded worker without a nanny to the scheduler of a client of `connected(workers=…)`."""
    with program(
        "worker", client.scheduler.address, "--nthreads", "1", "--no-nanny", security=client.security
    ) as process:
        yield process


def tls_settings(security: Any) -> dict[str, str]:
    """Return settings of Dask's configuration: authority, certificates and keys, as text or files."""
    settings = {"distributed.comm.tls.ca-file": security.tls_ca_file}
    for role in ("client", "scheduler", "worker"):
        for part in ("cert", "key"):
            settings[f"distributed.comm.tls.{role}.{part}"] = getattr(security, f"tls_{role}_{part}")
    return settings


@contextlib.contextmanager
def program(*words: str, security: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Run `dask WORDS` with TLS settings in its environment; kill it on exit."""
    settings = tls_settings(security).items()
    variables = {"DASK_" + name.upper().replace(".", "__").replace("-", "_"): value for name, value in settings}
    command, silent = [sys.executable, "-m", "dask", *words, "--no-dashboard"], subprocess.DEVNULL
    process = subprocess.Popen(command, env=ENVIRONMENT | variables, stdout=silent, stderr=silent)
    try:
        yield process
    finally:
        process.kill()
        process.wait()
