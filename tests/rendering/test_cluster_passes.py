"""Passes on workers: the same bits as in one process, whoever renders what, is killed, or joins late."""

from __future__ import annotations

import os
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from support.dask_workers import accepted, joined, kill
from support.processes import python, until
from support.renders import GLASS

from mi_refract.cluster import workers as workers_module
from mi_refract.cluster.connection import connected
from mi_refract.cluster.on_worker import LLVM, MIXED, facts
from mi_refract.rendering import cluster_passes, scene_bundle
from mi_refract.rendering.cluster_passes import ClusterPasses, Part
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, resume
from mi_refract.rendering.pass_sums import PassSums
from mi_refract.rendering.scene_files import parse_scene


@pytest.fixture(scope="module")
def client():
    with connected(workers=2) as client:
        yield client


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(GLASS)
    return path


@pytest.fixture
def small_tasks(monkeypatch):
    """Every pass a task of its own, and all sums made by tasks that fold."""
    monkeypatch.setattr(cluster_passes, "TASK_SECONDS", 0.0)


def source(client, scene, variant, warn=lambda text: None, **options):
    bundle = scene_bundle.pack(parse_scene(scene))
    return ClusterPasses(accepted(client, variant, **options), bundle, variant, 0, warn)


def rendered(scene, spp, passes=None, watch=lambda render: None):
    """The sums of a render here or by `passes`, and the header of its image."""
    output = scene.with_name("here.exr" if passes is None else "there.exr")
    render = resume(Job(scene), output, Limits(spp=spp, pass_spp=1), restart=True)
    header = render.run(watch, passes and passes.nodes)
    return render.progress.sums(), header


def same(found, expected):
    """The same sums, to the last bit of float64, which the image does not show; and the same header."""
    (a, header), (b, other) = found, expected
    np.testing.assert_array_equal(a.total, b.total)
    np.testing.assert_array_equal(a.between, b.between)
    assert a.contrasts == b.contrasts and a.total.std() > 0
    names = ("spp", "passes", "variance_from", "nonfinite_pixels", "identity")
    assert [header[f"mi_refract:{n}"] for n in names] == [other[f"mi_refract:{n}"] for n in names]


def busy(client):
    return [key for keys in client.processing().values() for key in keys]


def test_two_workers_and_a_machine_with_another_llvm(client, scene, variant):
    """Which says so in the header."""
    found, expected = rendered(scene, 80, source(client, scene, variant)), rendered(scene, 80)
    same(found, expected)
    assert found[1]["mi_refract:machines"] == os.uname().nodename
    until(lambda: not busy(client), 10)
    if variant.startswith("llvm"):
        passes, own = source(client, scene, variant), facts(variant)
        passes.workers = workers_module.Workers(client, variant, own | {LLVM: "99.0"}, MIXED)
        passes.workers.wait()
        assert rendered(scene, 16, passes)[1]["mi_refract:machines"] == f"{os.uname().nodename} (libLLVM {own[LLVM]})"


@pytest.mark.usefixtures("small_tasks")
@pytest.mark.parametrize(("count", "spp"), [(1, 75), (2, 40)])
def test_workers_that_are_killed(client, scene, variant, count, spp):
    """One of two, or both, with SIGKILL, among tasks that fold; what replaces them is used."""
    passes, victims = source(client, scene, variant), []

    def watch(render):
        if render.progress.passes >= 3 and not victims:
            victims.extend(sorted(passes.workers.usable)[:count])
            for address in victims:
                kill(client, address)

    same(rendered(scene, spp, passes, watch), rendered(scene, spp))
    assert len(victims) == count
    # A dead worker may be in the scheduler's list for a while, also when those that came instead have done its work.
    until(lambda: len(client.nthreads()) == 2 and not {*victims} & {*client.nthreads()})


EIGHT = """
import random, time
from distributed import LocalCluster
from mi_refract.rendering import cluster_passes
render = cluster_passes.render_node
def late(*arguments):
    time.sleep(random.random() / 10)
    return render(*arguments)
cluster_passes.render_node = late
options = {"protocol": "tcp://", "dashboard_address": None, "silence_logs": 60}
cluster = LocalCluster(n_workers=8, threads_per_worker=1, processes=False, **options)
print(cluster.scheduler_address, flush=True)
time.sleep(600)
"""


@pytest.mark.usefixtures("small_tasks")
def test_eight_workers_out_of_order(scene, variant):
    with python(EIGHT) as process:
        try:
            with connected(process.stdout.readline().strip()) as client:
                passes = source(client, scene, variant)
                same(rendered(scene, 70, passes), rendered(scene, 70))
                assert len(passes.workers.machines) == 8
        finally:
            process.kill()


def test_a_worker_that_joins_late_is_used(client, scene, variant, monkeypatch):
    monkeypatch.setattr(workers_module, "BETWEEN_LOOKS", 0.1)
    monkeypatch.setattr(cluster_passes, "NODE_SECONDS", 0.0)  # so that it lasts
    passes, before = source(client, scene, variant), set(client.nthreads())
    run = resume(Job(scene), scene.with_name("there.exr"), Limits(spp=100_000, pass_spp=1))
    deadline = time.monotonic() + 120

    class Used(Exception):
        """Ends the render."""

    def watch(render):
        assert time.monotonic() < deadline
        busy = (a for a, keys in client.processing().items() if any("render_node" in str(key) for key in keys))
        if (set(passes.workers.usable) - before) & set(busy):
            raise Used

    with joined(client), pytest.raises(Used):
        run.run(watch, passes.nodes)
    assert run.checkpoints.path.exists()
    until(lambda: set(client.nthreads()) == before)


def test_what_is_begun_is_given_up_with_the_iterator(client, scene, variant, monkeypatch):
    """Folds of folds, too: a scheduler that is told to cancel what they need closes the connection."""
    monkeypatch.setattr(ClusterPasses, "levels", lambda self: (0, 2))
    passes = source(client, scene, variant)
    nodes = passes.nodes(0, 128, 10**6, 0, 1)
    assert next(nodes)[0] == 2
    nodes.close()
    until(lambda: not busy(client), 10)
    [(_, sums, _)] = passes.nodes(0, 1, 1, 0, 1)
    np.testing.assert_array_equal(sums.total, rendered(scene, 1)[0].total)


def test_each_call_continues_the_last_one_and_an_offset_changes_the_seeds(client, scene, variant):
    passes = source(client, scene, variant)
    first = [*passes.nodes(0, 1, 16, 0, 1), *passes.nodes(1, 8, 16, 0, 1)]
    assert sum(sums.passes for _, sums, _ in first) == 8
    [(_, other, _)] = passes.nodes(8, 9, 9, 5, 1)
    [(_, expected, _)] = passes.nodes(13, 14, 14, 0, 1)
    np.testing.assert_array_equal(other.total, expected.total)
    assert len(passes._pass_seconds) > 1
    next(passes.nodes(0, 1, 1, 0, 2))  # passes of another size take another time
    assert len(passes._pass_seconds) == 1
    passes.close()


def test_who_is_refused_gets_no_task(client, scene, variant):
    passes = source(client, scene, variant)
    honest, liar = sorted(passes.workers.usable)
    del passes.workers.usable[liar]
    passes.workers.refused[liar] = "made up"
    passes.workers.machines = {honest: "honest"}  # another one would stand in the header by its address
    found = rendered(scene, 40, passes)
    same(found, rendered(scene, 40))
    assert found[1]["mi_refract:machines"] == "honest"


def test_what_is_folded_stays_as_it_is():
    """Dask keeps it, and may fold it again."""
    parts = [Part(PassSums(1, 1, np.full((1, 1, 3), x), np.zeros((1, 1, 3))), {"a": x, "b": 1}, 0.5) for x in range(8)]
    folded = cluster_passes.fold(*parts)
    assert [part.sums.total[0, 0, 0] for part in parts] == [*range(8)]
    assert (folded.sums.total[0, 0, 0], folded.nonfinite, folded.seconds) == (28, {"a": 7, "b": 1}, 4.0)


def test_what_is_wrong_with_the_scene_is_said_as_by_a_local_render(client, scene, variant):
    """An error that is raised when it is rendered: the scene scatters; and pixels that are not finite, by machine."""
    nan = 'type="constant"><rgb name="radiance" value="nan"/></emitter>'
    scene.write_text(GLASS.replace('type="constant"/>', nan))
    said, errors = [], []
    found = rendered(scene, 4, source(client, scene, variant, said.append))
    assert found[1]["mi_refract:nonfinite_pixels"] == rendered(scene, 4)[1]["mi_refract:nonfinite_pixels"] > 0
    assert len(said) == 1 and re.fullmatch(rf"{os.uname().nodename}: \d+ pixels of a pass are not finite", said[0])
    deterministic = 'type="refract_path"><boolean name="deterministic" value="true"/>'
    scene.write_text(GLASS.replace('type="path">', deterministic))
    for passes in (None, source(client, scene, variant)):
        with pytest.raises(ValueError, match="deterministic") as caught:
            rendered(scene, 4, passes)
        errors.append(str(caught.value))
    assert errors[0] == errors[1]


@pytest.mark.parametrize(
    "seconds, workers, levels",
    [(None, 2, (0, 0)), (10.0, 2, (0, 0)), (10.0, 16, (0, 1)), (0.3, 2, (1, 1)), (0.01, 2, (2, 3)), (1.0, 200, (0, 3))],
)
def test_levels_follow_the_time_of_a_pass(seconds, workers, levels):
    passes = ClusterPasses(SimpleNamespace(usable=dict.fromkeys(range(workers), 1)), None, "", 0)
    passes._pass_seconds.extend([] if seconds is None else [seconds] * 5)
    assert passes.levels() == levels
