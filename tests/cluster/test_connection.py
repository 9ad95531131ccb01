"""Connections to a Dask scheduler: none there, no Dask, and a local one that ends with whoever started it."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import dask
import psutil
import pytest
from distributed import CancelledError
from distributed.comm import CommClosedError, connect
from support.dask_workers import tls_settings, until
from support.processes import python

from mi_refract.cluster.connection import cluster_errors, connected
from mi_refract.io.errors import LostSchedulerError


def refusal(**options):
    with pytest.raises((ConnectionError, ValueError, ImportError, FileNotFoundError)) as caught, connected(**options):
        pass
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"scheduler": "tcp://127.0.0.1:9"}, "--scheduler tcp://127.0.0.1:9: no Dask scheduler answers: "),
        ({"scheduler": "tcp://127.0.0.1:9"}, "; expected the address of a Dask scheduler"),
        ({"scheduler": "nonsense"}, "--scheduler nonsense: no Dask scheduler answers: missing port"),
        ({"scheduler": "tcp://h:1", "workers": 1}, "expected either --scheduler ADDRESS or --workers N"),
        ({"workers": 0}, "--workers 0; expected a whole number from 1 to 1024"),
        ({"scheduler": "tls://h:1"}, "and the files of `distributed.comm.tls` in Dask's configuration"),
    ],
)
def test_misuse(options, message):
    assert message in refusal(**options)


def test_a_connection_that_is_not_encrypted_is_refused():
    """Of local workers, and where the scheduler speaks TLS: Dask would take a worker's results over any connection."""

    def refuses(client):
        with pytest.raises(RuntimeError, match="encryption required"):
            client.sync(connect, "tcp://127.0.0.1:9", **client.connection_args)

    with connected(workers=1) as local:
        refuses(local)
        assert local.run_on_scheduler(lambda dask_scheduler: dask_scheduler.security.require_encryption)
        with dask.config.set(tls_settings(local.security)), connected(local.scheduler.address) as client:
            refuses(client)


def test_a_module_of_the_working_folder_is_not_taken_for_one_of_ours(tmp_path, monkeypatch):
    for name in ("dask", "distributed", "mi_refract", "pickle"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit")
    monkeypatch.chdir(tmp_path)
    with connected(workers=1) as client:
        assert client.submit(os.getpid).result() != os.getpid()


def test_without_dask(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert refusal(workers=1).endswith("pip install 'mi-refract[cluster]'")


LOST = "tcp://h:1: the Dask scheduler has ended or cancelled the tasks; run the same command again to resume"


@pytest.mark.parametrize(
    "status, then, raised, message",
    [
        ("running", "running", CommClosedError("x"), LOST),
        ("running", "running", CancelledError("x"), LOST),
        ("closed", "closed", None, LOST),
        ("running", "connecting", RuntimeError("cannot schedule"), LOST),
        ("running", "running", OSError("of the scene"), "of the scene"),
        ("running", "running", ValueError("of the scene"), "of the scene"),
    ],
)
def test_a_lost_scheduler_is_one_line(status, then, raised, message):
    client = SimpleNamespace(status=status, scheduler=SimpleNamespace(address="tcp://h:1"))
    expected = LostSchedulerError if message == LOST else type(raised)
    with pytest.raises(expected) as caught, cluster_errors(client):
        client.status = then
        raise raised
    assert str(caught.value) == message


def test_dask_is_not_imported_before_it_is_needed():
    code = """import sys, mi_refract.cli.app, mi_refract.cli.render
import mi_refract.cluster.workers, mi_refract.cluster.connection
mi_refract.cli.app.main(["--help"])
sys.exit(str([name for name in sys.modules if name.partition(".")[0] in ("dask", "distributed")]))"""
    with python(code) as process:
        assert process.communicate()[1].splitlines()[-1] == "[]"


def group(leader):
    """The processes of a process group that have not ended."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
            if os.getpgid(process.pid) == leader and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
    return found


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks /proc")
def test_local_workers_end_with_a_killed_process():
    code = """import signal, subprocess, sys, time
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
from mi_refract.cluster import local_cluster
popen = subprocess.Popen
def told(*arguments, **options):
    process = popen(*arguments, **options)
    print(process.pid, flush=True)
    return process
subprocess.Popen = told
with local_cluster.started(1) as (address, _):
    print(address, flush=True)
    time.sleep(600)"""
    with python(code) as process:
        leader, address = int(process.stdout.readline()), process.stdout.readline()
        try:
            assert address.startswith("tls://127.0.0.1:")
            assert len(group(leader)) >= 2  # the scheduler's process, and a worker's
            for pid in group(leader):
                status = Path(f"/proc/{pid}/status").read_text()
                assert not int(status.partition("SigBlk:")[2].split()[0], 16) >> (signal.SIGTERM - 1) & 1
            process.kill()
            until(lambda: not group(leader), 10)
        finally:
            process.kill()
            if group(leader):
                os.killpg(leader, signal.SIGKILL)


def test_a_cluster_that_cannot_start(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    assert refusal(workers=1) == "--workers 1: the local cluster did not start: ended with status 1; try fewer workers"
