"""`mi-refract render --scheduler tls://…`, with a scheduler and a worker that are started as the README says."""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
import sys
import time

import numpy as np
import pytest
from support.certificates import authority
from support.dask_workers import until
from support.processes import ENVIRONMENT

from mi_refract.io.image_file import read_exr

SCENE = """<scene version="3.0.0">
  <integrator type="path"/>
  <sensor type="perspective">
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
    <sampler type="independent"/>
  </sensor>
  <emitter type="constant"/>
  <shape type="sphere"><transform name="to_world"><translate z="4"/></transform><bsdf type="refract"/></shape>
</scene>"""


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    return authority(tmp_path_factory.mktemp("tls") / "own")


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    return authority(tmp_path_factory.mktemp("tls") / "other")


def options(folder, authority=None):
    certificate, key = folder / "cert.pem", folder / "key.pem"
    return ("--tls-ca-file", (authority or folder) / "cert.pem", "--tls-cert", certificate, "--tls-key", key)


@pytest.fixture(scope="module")
def scheduler(own):
    """The address of one that asks for TLS; a worker joins it."""
    file = own / "scheduler.json"
    common = ["--no-dashboard", "--scheduler-file", file, *options(own)]
    with contextlib.ExitStack() as stack:
        for words in (
            ["scheduler", "--host", "127.0.0.1", "--port", "0"],
            ["worker", "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1", "--local-directory", own],
        ):
            command = [sys.executable, "-m", "dask", *words, *common]
            process = subprocess.Popen(
                list(map(str, command)), env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            stack.callback(process.wait)
            stack.callback(process.kill)
        until(file.exists)
        yield json.loads(file.read_text())["address"]


@pytest.fixture
def render(tmp_path, run):
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE)

    def call(name, *options):
        chosen = ("--variant", "scalar_rgb", "--spp", 20, "--pass-spp", 1)
        return run("render", scene, "-o", tmp_path / name, *chosen, *options)

    return call


def test_the_bits_are_those_of_a_render_here(render, scheduler, own, tmp_path):
    assert scheduler.startswith("tls://")
    assert render("there.exr", "--scheduler", scheduler, *options(own))[0] == render("here.exr")[0] == 0
    found, expected = (read_exr(tmp_path / name)[0] for name in ("there.exr", "here.exr"))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    "case, message",
    [
        ("of another authority", r"no Dask scheduler answers: TLS certificate does not match"),
        ("by another authority", r"no Dask scheduler answers: .*: it may be without TLS, or of another authority;"),
        ("without a certificate", r"no --tls-ca-file or no --tls-cert; expected both, and --tls-key"),
        ("without TLS", r"no Dask scheduler answers: ConnectionResetError: .*: it may ask for TLS;"),
    ],
)
def test_refused(render, scheduler, own, other, tmp_path, case, message):
    """In one line, at once."""
    words = {
        "of another authority": (scheduler, *options(own, other)),
        "by another authority": (scheduler, *options(other, own)),
        "without a certificate": (scheduler,),
        "without TLS": (scheduler.replace("tls", "tcp"),),
    }[case]
    began = time.monotonic()
    code, out, err = render("no.exr", "--scheduler", *words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert re.search(f"--scheduler {words[0]}: {message}", err)
    assert time.monotonic() - began < 10
    assert not list(tmp_path.glob("*no.exr*"))
