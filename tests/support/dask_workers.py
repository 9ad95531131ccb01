"""Dask workers of the tests: started once a module, killed, and made to lie."""

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
    with program(
        "worker", client.scheduler.address, "--nthreads", "1", "--no-nanny", security=client.security
    ) as process:
        yield process


def tls_settings(security: Any) -> dict[str, str]:
    """Of Dask's configuration: authority, certificates and keys, as text or files."""
    found = {"distributed.comm.tls.ca-file": security.tls_ca_file}
    for role in ("client", "scheduler", "worker"):
        for part in ("cert", "key"):
            found[f"distributed.comm.tls.{role}.{part}"] = getattr(security, f"tls_{role}_{part}")
    return found


@contextlib.contextmanager
def program(*words: str, security: Any) -> Iterator[subprocess.Popen[bytes]]:
    """`dask WORDS`, which takes its TLS settings from the environment; killed at the end."""
    variables = {
        "DASK_" + name.upper().replace(".", "__").replace("-", "_"): value
        for name, value in tls_settings(security).items()
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *words, "--no-dashboard"],
        env=ENVIRONMENT | variables,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
