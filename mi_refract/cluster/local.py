"""`python -m mi_refract.cluster.local N`: a Dask scheduler and N workers of one thread each, until stdin closes.

It prints the scheduler's address, with a certificate and a key made for this once: without them every user of this
machine could have the workers run code. In a process of its own, so that it ends with whoever holds the other end of
its stdin, however that ends, and so that no signal which is blocked there is blocked in the workers.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import signal
import sys
import tempfile

# Dask watches itself: its profiler and monitors would take 5 % of the workers' time from kernels.
SETTINGS = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.admin.tick.interval": "1s",
}
FAILED = "failed: "
PEM = ("tls_ca_file", "tls_client_cert", "tls_client_key")  # of Dask's `Security`: their text


def main() -> None:
    """Start, print the address, wait, and end with all workers."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, signal.valid_signals())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for who started us
    folder = tempfile.mkdtemp(prefix="mi_refract-workers-")
    try:
        import dask
        from distributed import LocalCluster
        from distributed.security import Security

        dask.config.set(SETTINGS)
        security = Security.temporary()
        cluster = LocalCluster(
            n_workers=int(sys.argv[1]),
            threads_per_worker=1,
            host="127.0.0.1",
            protocol="tls://",
            security=security,
            dashboard_address=None,
            local_directory=folder,
            silence_logs=logging.CRITICAL,
        )
        print(
            json.dumps({"address": cluster.scheduler_address} | {name: getattr(security, name) for name in PEM}),
            flush=True,
        )
        sys.stdin.buffer.read()
    except Exception as error:
        print(f"{FAILED}{type(error).__name__}: {' '.join(str(error).split())}", flush=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if os.getpgrp() == os.getpid():  # workers are of our group: at once, whatever they render
            with contextlib.suppress(ProcessLookupError):
                os.killpg(os.getpid(), signal.SIGKILL)
        os._exit(1)


if __name__ == "__main__":
    main()
