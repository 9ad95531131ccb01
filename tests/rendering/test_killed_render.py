"""Renders that a signal ends, at random times: what is done is kept, and goes on with the same bits."""

from __future__ import annotations

import random
import signal
import time

import numpy as np
import pytest
from support.processes import python
from support.renders import BALL, pixels

from mi_refract.rendering import checkpoint
from mi_refract.rendering.long_render import Job, Limits, LongRender

pytestmark = pytest.mark.usefixtures("scalar_variant")

KILLED = """
import sys
from mi_refract import cli
run = cli._run
def run_with_checkpoints(arguments):
    from mi_refract.rendering import long_render  # numpy's threads start here
    long_render.BETWEEN_CHECKPOINTS = 0.05
    return run(arguments)
cli._run = run_with_checkpoints
limits = ["-D", "res=32", "--pass-spp", "4"]
sys.argv[1:] = ["render", sys.argv[1], "-o", sys.argv[2], *limits, *sys.argv[3:]]
sys.exit(cli.main())
"""


def ended_by(number, output, *options, spp=4800):
    """The exit code and the output of a render that a signal ends after its first passes, of seconds of them."""
    with python(KILLED, BALL, output, "--variant", "llvm_ad_rgb", "--spp", str(spp), *options) as process:
        deadline = time.monotonic() + 120
        before = checkpoint.path_of(output).stat().st_mtime_ns if checkpoint.path_of(output).exists() else 0
        while process.poll() is None and time.monotonic() < deadline:
            path = checkpoint.path_of(output)
            if path.exists() and path.stat().st_mtime_ns != before:
                break
            time.sleep(0.01)
        time.sleep(random.uniform(0, 0.3))
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
        return process.returncode, out, err


def test_sigkill_at_random_times_leaves_a_checkpoint_and_the_same_bits(tmp_path, llvm):
    output, codes, spp = tmp_path / "a.exr", [], 2400
    for _ in range(4):
        codes.append(ended_by(signal.SIGKILL, output, spp=spp)[0])
        if codes[-1] == 0:
            break
    assert codes[0] == -signal.SIGKILL
    if not output.exists():
        job = Job(BALL, {"res": "32"})
        render = LongRender(job, output, Limits(spp=spp, pass_spp=4))
        assert render.progress.passes
        render.run()
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    LongRender(Job(BALL, {"res": "32"}), tmp_path / "b.exr", Limits(spp=spp, pass_spp=4)).run()
    np.testing.assert_array_equal(pixels(output), pixels(tmp_path / "b.exr"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_keeps_what_is_done(tmp_path, llvm, number):
    output = tmp_path / "a.exr"
    code, _, err = ended_by(number, output)
    assert code == 128 + number, err
    assert "spp; run the same command again to resume" in err
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr.checkpoint"]
    render = LongRender(Job(BALL, {"res": "32"}), output, Limits(spp=4800, pass_spp=4))
    assert render.progress.passes > 0
