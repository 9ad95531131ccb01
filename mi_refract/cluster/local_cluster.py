"""A Dask scheduler and single-threaded workers in a process of their own, which ends with this process in every case.

The workers do not inherit blocked signals. Each cluster gets a new certificate and key: without them every user of this
machine could run code on the workers. The process, `python -m mi_refract.cluster.local_cluster`, reads the number of
workers and Dask's `Security` from stdin, prints the scheduler's address, and ends when stdin closes.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from mi_refract.io.errors import NoWorkersError, UsageError
from mi_refract.io.safe_files import temporary_folder

MOST = 1024  # workers
# Dask's profiler and monitors would take 5 % of the workers' time.
SETTINGS = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.admin.tick.interval": "1s",
    # Dask's HTTP servers do not use TLS: every user of this machine could read their pages.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # How long a worker tries to reach a lost worker; 30 s by default.
    "distributed.comm.timeouts.connect": "4s",
}


@contextlib.contextmanager
def started(workers: int) -> Iterator[tuple[str, Any]]:
    """Yield the address of a scheduler with `workers` workers, and the `Security` for clients; end them on exit.

    UsageError for a number out of range; NoWorkersError if the cluster cannot start.
    """
    if not 1 <= workers <= MOST:
        raise UsageError(f"--workers {workers}; expected a whole number from 1 to {MOST}")
    if not hasattr(os, "killpg"):
        raise UsageError(f"--workers {workers}: Windows cannot end them with the render; expected no --workers there")
    from distributed.security import Security

    security = Security.temporary()
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", __name__],  # -P: do not import modules from the working folder
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=None if os.environ.get("MI_REFRACT_TRACEBACK") == "1" else subprocess.DEVNULL,
        start_new_session=True,
    )
    assert process.stdin and process.stdout
    try:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(pickle.dumps((workers, security)))
            process.stdin.flush()
        answer = process.stdout.readline().decode().strip()
        if not answer.startswith("tls://"):
            reason = answer or f"ended with status {process.wait()}"
            raise NoWorkersError(f"--workers {workers}: the local cluster did not start: {reason}; try fewer workers")
        yield answer, security
    finally:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(10.0)
        process.stdout.close()


def main() -> None:
    """Start the cluster, print its address, wait until stdin closes, and end with all workers."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, signal.valid_signals())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles Ctrl-C
    # The parent reads one line of stdout. Other output goes to stderr: otherwise the pipe fills and the workers block.
    answer = os.dup(1)
    os.dup2(2, 1)
    try:
        import dask
        from distributed import LocalCluster

        workers, security = pickle.load(sys.stdin.buffer)
        dask.config.set(SETTINGS)
        with temporary_folder() as folder:
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                host="127.0.0.1",
                protocol="tls://",
                security=security,
                dashboard_address=None,
                local_directory=str(folder),
                silence_logs=logging.CRITICAL,
            )
            os.write(answer, f"{cluster.scheduler_address}\n".encode())
            sys.stdin.buffer.read()
    except Exception as error:
        os.write(answer, f"{type(error).__name__}: {' '.join(str(error).split())}\n".encode())
    finally:
        if os.getpgrp() == os.getpid():  # the workers are in this process group: kill them, even during a kernel
            with contextlib.suppress(ProcessLookupError):
                os.killpg(os.getpid(), signal.SIGKILL)
        os._exit(1)


if __name__ == "__main__":
    main()
