"""`mi-refract render --scheduler tls://…`, with a scheduler and a worker that are started as the README says."""

from __future__ import annotations

import json
import time

import dask
import numpy as np
import pytest
from distributed import Security
from support.dask_workers import program, tls_settings, until

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


OWN, OTHER = Security.temporary(), Security.temporary()
MIXED = Security.temporary()
MIXED.tls_ca_file = OWN.tls_ca_file  # trusts the scheduler, which does not trust it
DOUBTING = Security(**{f"tls_client_{part}": getattr(OWN, f"tls_client_{part}") for part in ("cert", "key")})
DOUBTING.tls_ca_file = OTHER.tls_ca_file


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """The address of one that asks for TLS; a worker joins it."""
    folder = tmp_path_factory.mktemp("tls")
    file = folder / "scheduler.json"
    common = ("--scheduler-file", str(file), "--host", "127.0.0.1", "--protocol", "tls")
    worker = ("worker", "--nthreads", "1", "--no-nanny", "--local-directory", str(folder))
    with program("scheduler", "--port", "0", *common, security=OWN), program(*worker, *common, security=OWN):
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


def test_the_bits_are_those_of_a_render_here(render, scheduler, tmp_path):
    assert scheduler.startswith("tls://")
    with dask.config.set(tls_settings(OWN)):
        assert render("there.exr", "--scheduler", scheduler)[0] == render("here.exr")[0] == 0
    found, expected = (read_exr(tmp_path / name)[0] for name in ("there.exr", "here.exr"))
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("security, protocol", [(MIXED, "tls"), (DOUBTING, "tls"), (Security(), "tls"), (OWN, "tcp")])
def test_refused(render, scheduler, tmp_path, security, protocol):
    """In one line, at once."""
    address, began = scheduler.replace("tls", protocol), time.monotonic()
    with dask.config.set(tls_settings(security)):
        code, out, err = render("no.exr", "--scheduler", address)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert f"--scheduler {address}: no Dask scheduler answers: " in err
    assert "and the files of `distributed.comm.tls` in Dask's configuration" in err
    assert time.monotonic() - began < 10
    assert not list(tmp_path.glob("*no.exr*"))
