"""`mi-refract render --scheduler` and `--workers`: exit codes, messages, ended processes, checkpoints, TLS."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import dask
import numpy as np
import psutil
import pytest
from distributed import Security
from support.dask_workers import program, tls_settings
from support.processes import ENVIRONMENT, assert_refused, until
from support.renders import GLASS

from mi_refract.cluster import on_worker
from mi_refract.io.image_file import read_exr


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(GLASS)
    return path


@pytest.fixture
def render(scene, run):
    def call(*options, output="out.exr"):
        return run("render", scene, "-o", scene.with_name(output), "--variant", "scalar_rgb", *options)

    return call


@pytest.mark.parametrize(
    "options, message",
    [
        (("--scheduler", "tcp://h:1", "--workers", 2), "--scheduler and --workers; expected one of them"),
        (("--workers", 0), "--workers"),
        (("--mixed-workers",), "--mixed-workers requires --scheduler ADDRESS or --workers N"),
        (("--workers", 1, "--allow-plugins", "evil"), "--allow-plugins evil: native code is not sent to workers"),
        (("--scheduler", "nonsense"), "--scheduler nonsense: no Dask scheduler answers: missing port number"),
        (("--scheduler", "tcp://127.0.0.1:9"), "; expected the address of a Dask scheduler"),
        (("--workers", 1, "--bundle-limit", 1), "the limit for a cluster is 1 MiB; raise it by --bundle-limit 2"),
        (("--workers", 1), "pip install 'mi-refract[cluster]'"),
    ],
)
def test_misuse(render, scene, options, message, monkeypatch, tmp_path_factory):
    if "--bundle-limit" in options:
        sky = tmp_path_factory.mktemp("sky") / "a.ppm"
        sky.write_bytes(b"P6 600 600 255 " + bytes(3 * 600**2))
        envmap = f'<emitter type="envmap"><string name="filename" value="{sky}"/></emitter>'
        scene.write_text(GLASS.replace('<emitter type="constant"/>', envmap))
    if options == ("--workers", 1):
        monkeypatch.setitem(sys.modules, "distributed", None)
    assert_refused(render(*options), message)
    assert list(scene.parent.iterdir()) == [scene]


# Ended from outside ---------------------------------------------------------------------------------------------------


def group(leader):
    """Return the running processes of a process group."""
    members = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
            if os.getpgid(process.pid) == leader and process.status() != psutil.STATUS_ZOMBIE:
                members.append(process.pid)
    return members


@pytest.mark.parametrize(
    ("number", "victim"), [(signal.SIGINT, "render"), (signal.SIGKILL, "render"), (signal.SIGKILL, "cluster")]
)
def test_an_ended_render_ends_its_workers_and_leaves_a_checkpoint(render, scene, number, victim):
    """Ctrl-C and a lost scheduler leave a new checkpoint, SIGKILL the files as they were. Workers block no signal."""
    preview = scene.with_name("so-far.png")
    words = ("--variant", "scalar_rgb", "--pass-spp", 1, "--workers", 1, "--spp", 100_000, "--preview", preview)
    command = [sys.executable, "-m", "mi_refract.cli", "render", scene, "-o", scene.with_name("out.exr"), *words]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([*map(str, command)], env=ENVIRONMENT, **pipes) as process:
        try:
            until(lambda: preview.exists() or process.poll() is not None)  # some passes are done
            assert process.poll() is None, process.communicate()
            children = psutil.Process(process.pid).children()
            leader = next(child.pid for child in children if os.getpgid(child.pid) == child.pid)
            assert len(group(leader)) >= 2  # the scheduler's process, and a worker's
            for status in (Path(f"/proc/{pid}/status") for pid in group(leader)):
                blocked = status.read_text().partition("SigBlk:")[2].split() if status.exists() else ["0"]
                assert not int(blocked[0], 16) >> (signal.SIGTERM - 1) & 1
            process.send_signal(number) if victim == "render" else os.killpg(leader, number)
            _, err = process.communicate(timeout=60)
        finally:
            process.kill()
    until(lambda: not group(leader), 15)
    assert process.returncode == {"cluster": 2, "render": 130 if number == signal.SIGINT else -number}[victim]
    if victim == "cluster":
        assert err.count("\n") == 1 and "the Dask scheduler has ended or cancelled the tasks; run the same" in err
    if process.returncode == -signal.SIGKILL:
        return
    code, _, err = render("--time", "0.1s", "--pass-spp", 1)
    done = int(re.search(r"resuming from (\d+) spp", err)[1])
    pixels, header = read_exr(scene.with_name("out.exr"))
    assert code == 0 and header["mi_refract:spp"] > done > 0
    assert render("--spp", header["mi_refract:spp"], "--pass-spp", 1, output="local.exr")[0] == 0
    np.testing.assert_array_equal(pixels, read_exr(scene.with_name("local.exr"))[0])


# TLS, with a scheduler and a worker that are started as in the how-to ------------------------------------------------

OWN, OTHER = Security.temporary(), Security.temporary()
MIXED = Security.temporary()
MIXED.tls_ca_file = OWN.tls_ca_file  # trusts the scheduler, but the scheduler does not trust it
DOUBTING = Security(**{f"tls_client_{part}": getattr(OWN, f"tls_client_{part}") for part in ("cert", "key")})
DOUBTING.tls_ca_file = OTHER.tls_ca_file


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """The address of a scheduler that requires TLS and has a worker."""
    folder = tmp_path_factory.mktemp("tls")
    file = folder / "scheduler.json"
    common = ("--scheduler-file", str(file), "--host", "127.0.0.1", "--protocol", "tls")
    worker = ("worker", "--nthreads", "1", "--no-nanny", "--local-directory", str(folder))
    with program("scheduler", "--port", "0", *common, security=OWN), program(*worker, *common, security=OWN):
        until(file.exists)
        yield json.loads(file.read_text())["address"]


def test_a_render_over_tls_has_the_bits_of_a_local_render(render, scheduler, scene, monkeypatch):
    """Workers with another libLLVM have the same bits here, but are refused without --mixed-workers."""
    assert scheduler.startswith("tls://")
    passes = ("--spp", 20, "--pass-spp", 1)
    assert render(*passes, output="here.exr")[0] == 0
    expected = read_exr(scene.with_name("here.exr"))[0]
    facts = on_worker.facts
    with dask.config.set(tls_settings(OWN)):
        assert render("--scheduler", scheduler, *passes)[0] == 0
        np.testing.assert_array_equal(read_exr(scene.with_name("out.exr"))[0], expected)
        monkeypatch.setattr(on_worker, "facts", lambda variant: facts(variant) | {on_worker.LLVM: "99.0"})
        code, _, err = render("--scheduler", scheduler, *passes, "--restart")
        assert code == 2 and "is refused: libLLVM unknown, here 99.0" in err
        assert render("--scheduler", scheduler, *passes, "--mixed-workers", "--restart")[0] == 0
    np.testing.assert_array_equal(read_exr(scene.with_name("out.exr"))[0], expected)


@pytest.mark.parametrize("security, protocol", [(MIXED, "tls"), (DOUBTING, "tls"), (Security(), "tls"), (OWN, "tcp")])
def test_untrusted_connections_are_refused(render, scheduler, scene, security, protocol):
    address = scheduler.replace("tls", protocol)
    with dask.config.set(tls_settings(security)):
        outcome = render("--scheduler", address)
    hint = "and the files of `distributed.comm.tls` in Dask's configuration"
    assert_refused(outcome, f"--scheduler {address}: no Dask scheduler answers: ", hint)
    assert list(scene.parent.iterdir()) == [scene]
