"""`mi-refract render --scheduler` and `--workers`: exit codes, what is said, what is kept, and what is ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from support.dask_workers import until
from support.processes import ENVIRONMENT

from mi_refract.cluster import worker_facts
from mi_refract.io.image_file import read_exr

SCENE = """<scene version="3.0.0">
  <integrator type="path"/>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,1,-4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
  </sensor>
  <emitter type="constant"/>
  <shape type="sphere"><bsdf type="refract"/></shape>
</scene>"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def render(scene, run):
    def call(*options, output="out.exr"):
        return run("render", scene, "-o", scene.with_name(output), "--variant", "scalar_rgb", *options)

    return call


@pytest.fixture
def started(scene):
    """`started("--workers", 1)`: the command in a process of its own, ended with the test."""
    processes = []

    def call(*options):
        command = [sys.executable, "-m", "mi_refract.cli", "render", scene, "-o", scene.with_name("out.exr")]
        command += ["--variant", "scalar_rgb", "--pass-spp", "1", *options]
        process = subprocess.Popen(
            list(map(str, command)), env=ENVIRONMENT, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        processes.append(process)
        return process

    yield call
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.parametrize(
    "options, message",
    [
        (("--scheduler", "tcp://h:1", "--workers", 2), "--scheduler and --workers; expected one of them"),
        (("--workers", 0), "--workers"),
        (("--mixed-workers",), "expected --scheduler ADDRESS or --workers N with it"),
        (
            ("--workers", 1, "--allow-plugins", "evil"),
            "--allow-plugins evil: native code, which is not sent to workers",
        ),
        (("--scheduler", "nonsense"), "--scheduler nonsense: no Dask scheduler answers: missing port number"),
    ],
)
def test_misuse(render, scene, options, message):
    code, out, err = render(*options)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("mi-refract: ") and message in err
    assert list(scene.parent.iterdir()) == [scene]


def test_no_scheduler(started, scene):
    """Within 10 s, Python's own start included."""
    began = time.monotonic()
    process = started("--scheduler", "tcp://127.0.0.1:9")
    out, err = process.communicate()
    assert time.monotonic() - began < 10
    assert (process.returncode, out, err.count("\n")) == (2, "", 1)
    assert "--scheduler tcp://127.0.0.1:9: no Dask scheduler answers: " in err and "; expected the address of" in err
    assert list(scene.parent.iterdir()) == [scene]


def test_too_large_for_a_cluster(render, scene):
    scene.write_text(SCENE + f"<!-- {'x' * 2**20} -->")
    code, _, err = render("--workers", 1, "--bundle-limit", 1)
    assert (code, err.count("\n")) == (2, 1)
    assert f"{scene}: 1.0 MiB of files" in err and "expected with a cluster: 1 MiB, or --bundle-limit 2" in err


def test_another_libllvm_is_refused_unless_mixed_workers_are_accepted(render, monkeypatch):
    own = worker_facts.facts
    monkeypatch.setattr(worker_facts, "facts", lambda variant: own(variant) | {worker_facts.LLVM: "99.0"})
    code, _, err = render("--workers", 1)
    assert code == 2 and "is refused: libLLVM unknown, here 99.0" in err
    assert render("--workers", 1, "--mixed-workers")[0] == 0


def test_without_dask(render, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, err = render("--workers", 1)
    assert (code, err.count("\n")) == (2, 1) and "pip install 'mi-refract[cluster]'" in err


def leader_of_workers(process):
    """The process of the local cluster that `process` started, once it has a worker."""
    found = subprocess.run(["ps", "-eo", "pid=,ppid=,pgid="], capture_output=True, text=True, check=True).stdout
    rows = [tuple(map(int, line.split())) for line in found.splitlines()]
    leaders = [pid for pid, parent, group in rows if parent == process.pid and pid == group]
    return leaders[0] if leaders and sum(group == leaders[0] for _, _, group in rows) >= 2 else None


def group_ended(leader):
    found = subprocess.run(["ps", "-eo", "pgid=,stat="], capture_output=True, text=True, check=True).stdout
    return not any(line.split()[0] == str(leader) and "Z" not in line for line in found.splitlines())


def begun(process, scene):
    """Wait until some passes are done: the preview is of them."""
    until(lambda: scene.with_name("so-far.png").exists() or process.poll() is not None)
    assert process.poll() is None, process.communicate()


@pytest.mark.parametrize("ended_by", [signal.SIGINT, signal.SIGKILL])
def test_the_scheduler_ends_and_the_render_goes_on_here(started, render, scene, ended_by):
    """Ctrl-C ends the render and its local cluster, a lost scheduler is an error: both leave a checkpoint."""
    preview = ("--preview", scene.with_name("so-far.png"), "--spp", 100_000)
    process = started("--workers", 1, *preview)
    begun(process, scene)
    leader = leader_of_workers(process)
    if ended_by == signal.SIGINT:
        process.send_signal(signal.SIGINT)
    else:
        os.killpg(leader, signal.SIGKILL)
    _, err = process.communicate(timeout=30)
    until(lambda: group_ended(leader), 10)
    assert process.returncode == (130 if ended_by == signal.SIGINT else 2)
    if ended_by == signal.SIGKILL:
        assert (
            err.count("\n") == 1 and "the Dask scheduler is gone, or has given up its tasks; expected one that" in err
        )
    assert scene.with_name("out.exr.checkpoint").exists()
    goes_on(render, scene)


def goes_on(render, scene):
    """From the checkpoint, here, to the bits of a render that was never elsewhere."""
    from mi_refract.rendering import checkpoint

    with np.load(scene.with_name("out.exr.checkpoint")) as file:
        done = checkpoint.json.loads(bytes(file["header"]))["passes"]
    spp = done + 3
    code, _, err = render("--spp", spp, "--pass-spp", 1)
    assert code == 0 and f"resuming from {done} spp" in err
    assert render("--spp", spp, "--pass-spp", 1, output="local.exr")[0] == 0
    (found, header), (expected, _) = (read_exr(scene.with_name(name)) for name in ("out.exr", "local.exr"))
    np.testing.assert_array_equal(found, expected)
    assert header["mi_refract:spp"] == spp and done > 0
