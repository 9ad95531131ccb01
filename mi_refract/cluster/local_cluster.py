"""A Dask scheduler and workers of one thread each, in a process of its own that ends with ours, however that ends.

No signal that is blocked here is blocked in the workers. Certificate and key are made for this once: without them every
user of this machine could have the workers run code. The process, `python -m mi_refract.cluster.local_cluster`, reads
the number of workers and Dask's `Security` from its stdin, prints the scheduler's address, and ends when stdin closes.
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
# Dask watches itself: its profiler and monitors would take 5 % of the workers' time from kernels.
SETTINGS = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.admin.tick.interval": "1s",
    # Dask's HTTP servers do not use TLS: pages of the scheduler and of workers would be for all users of this machine.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # As long as a worker tries to reach one that has gone, when that is told before it tries; 30 s by default.
    "distributed.comm.timeouts.connect": "4s",
}


@contextlib.contextmanager
def started(workers: int) -> Iterator[tuple[str, Any]]:
    """The address of a scheduler with so many workers, and the `Security` of its clients. They end at the end.

    UsageError for a number out of range; NoWorkersError, one line, where they cannot be started.
    """
    if not 1 <= workers <= MOST:
        raise UsageError(f"--workers {workers}; expected a whole number from 1 to {MOST}")
    if not hasattr(os, "killpg"):
        raise UsageError(f"--workers {workers}: Windows cannot end them with the render; expected no --workers there")
    from distributed.security import Security

    security = Security.temporary()
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", __name__],  # -P: no module of the working folder takes the place of one of ours
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
    """Start, print the address, wait, and end with all workers."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, signal.valid_signals())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for who started us
    # One line of our stdout is read: what workers log there goes to stderr, or the pipe fills up and they wait.
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
        if os.getpgrp() == os.getpid():  # workers are of our group: at once, whatever they render
            with contextlib.suppress(ProcessLookupError):
                os.killpg(os.getpid(), signal.SIGKILL)
        os._exit(1)


if __name__ == "__main__":
    main()
