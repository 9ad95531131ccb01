"""Passes on workers: the same bits as in one process, also if workers are killed or join late."""

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
    """Make every pass a separate task, so that other tasks compute all sums."""
    monkeypatch.setattr(cluster_passes, "TASK_SECONDS", 0.0)


def cluster_passes_of(client, scene, variant, warn=lambda text: None):
    bundle = scene_bundle.pack(parse_scene(scene))
    return ClusterPasses(accepted(client, variant), bundle, variant, 0, warn)


def rendered(scene, spp, passes=None, watch=lambda render: None):
    """Return the sums of a render and the header of its image; `passes`: by default in this process."""
    output = scene.with_name("local.exr" if passes is None else "cluster.exr")
    render = resume(Job(scene), output, Limits(spp=spp, pass_spp=1), restart=True)
    header = render.run(watch, passes and passes.nodes)
    return render.progress.sums(), header


def assert_same(result, expected):
    """Assert equal sums, to the last bit of float64, which the image does not contain, and equal headers."""
    (sums, header), (expected_sums, expected_header) = result, expected
    np.testing.assert_array_equal(sums.total, expected_sums.total)
    np.testing.assert_array_equal(sums.between, expected_sums.between)
    assert sums.contrasts == expected_sums.contrasts and sums.total.std() > 0
    for name in ("spp", "passes", "variance_from", "nonfinite_pixels", "identity"):
        assert header[f"mi_refract:{name}"] == expected_header[f"mi_refract:{name}"]


def running_tasks(client):
    return [key for keys in client.processing().values() for key in keys]


def test_two_workers_give_the_same_bits_and_the_header_names_machines(client, scene, variant):
    """The header also names another version of LLVM."""
    result = rendered(scene, 80, cluster_passes_of(client, scene, variant))
    assert_same(result, rendered(scene, 80))
    assert result[1]["mi_refract:machines"] == os.uname().nodename
    until(lambda: not running_tasks(client), 10)
    if variant.startswith("llvm"):
        passes, own = cluster_passes_of(client, scene, variant), facts(variant)
        passes.workers = workers_module.Workers(client, variant, own | {LLVM: "99.0"}, MIXED)
        passes.workers.wait()
        assert rendered(scene, 16, passes)[1]["mi_refract:machines"] == f"{os.uname().nodename} (libLLVM {own[LLVM]})"


@pytest.mark.usefixtures("small_tasks")
@pytest.mark.parametrize(("count", "spp"), [(1, 75), (2, 40)])
def test_killed_workers_do_not_change_the_bits(client, scene, variant, count, spp):
    """SIGKILL ends one of two workers, or both, during tasks that fold; new workers replace them."""
    passes, victims = cluster_passes_of(client, scene, variant), []

    def watch(render):
        if render.progress.passes >= 3 and not victims:
            victims.extend(sorted(passes.workers.usable)[:count])
            for address in victims:
                kill(client, address)

    assert_same(rendered(scene, spp, passes, watch), rendered(scene, spp))
    assert len(victims) == count
    # A dead worker may remain in the scheduler's list for a while, even after others have finished its work.
    # New workers import Mitsuba: that takes minutes on a busy machine.
    until(lambda: len(client.nthreads()) == 2 and not {*victims} & {*client.nthreads()}, seconds=300)


EIGHT = """
import random, time
from distributed import LocalCluster
from mi_refract.rendering import cluster_passes
render = cluster_passes.render_node
def delayed(*arguments):
    time.sleep(random.random() / 10)
    return render(*arguments)
cluster_passes.render_node = delayed
options = {"protocol": "tcp://", "dashboard_address": None, "silence_logs": 60}
cluster = LocalCluster(n_workers=8, threads_per_worker=1, processes=False, **options)
print(cluster.scheduler_address, flush=True)
time.sleep(600)
"""


@pytest.mark.usefixtures("small_tasks")
def test_tasks_that_finish_out_of_order_do_not_change_the_bits(scene, variant):
    with python(EIGHT) as process:
        try:
            with connected(process.stdout.readline().strip()) as client:
                passes = cluster_passes_of(client, scene, variant)
                assert_same(rendered(scene, 70, passes), rendered(scene, 70))
                assert len(passes.workers.machines) == 8
        finally:
            process.kill()


def test_a_worker_that_joins_late_is_used(client, scene, variant, monkeypatch):
    monkeypatch.setattr(workers_module, "BETWEEN_LOOKS", 0.1)
    monkeypatch.setattr(cluster_passes, "NODE_SECONDS", 0.0)  # so that the render takes long
    passes, before = cluster_passes_of(client, scene, variant), set(client.nthreads())
    render = resume(Job(scene), scene.with_name("cluster.exr"), Limits(spp=100_000, pass_spp=1))
    deadline = time.monotonic() + 120

    class Used(Exception):
        """Raised to end the render."""

    def watch(render):
        assert time.monotonic() < deadline
        new_workers = set(passes.workers.usable) - before
        for address, keys in client.processing().items():
            if address in new_workers and any("render_node" in str(key) for key in keys):
                raise Used

    with joined(client), pytest.raises(Used):
        render.run(watch, passes.nodes)
    assert render.checkpoints.path.exists()
    until(lambda: set(client.nthreads()) == before)


def test_closing_the_iterator_releases_submitted_nodes(client, scene, variant, monkeypatch):
    """Also folds of folds: if a client cancels them, the scheduler closes the connection."""
    monkeypatch.setattr(ClusterPasses, "levels", lambda self: (0, 2))
    passes = cluster_passes_of(client, scene, variant)
    nodes = passes.nodes(0, 128, 10**6, 0, 1)
    assert next(nodes)[0] == 2
    nodes.close()
    until(lambda: not running_tasks(client), 10)
    [(_, sums, _)] = passes.nodes(0, 1, 1, 0, 1)
    np.testing.assert_array_equal(sums.total, rendered(scene, 1)[0].total)


def test_calls_continue_each_other_and_an_offset_changes_the_seeds(client, scene, variant):
    passes = cluster_passes_of(client, scene, variant)
    nodes = [*passes.nodes(0, 1, 16, 0, 1), *passes.nodes(1, 8, 16, 0, 1)]
    assert sum(sums.passes for _, sums, _ in nodes) == 8
    [(_, with_offset, _)] = passes.nodes(8, 9, 9, 5, 1)
    [(_, expected, _)] = passes.nodes(13, 14, 14, 0, 1)
    np.testing.assert_array_equal(with_offset.total, expected.total)
    assert len(passes._pass_seconds) > 1
    next(passes.nodes(0, 1, 1, 0, 2))  # times of passes of another size do not count
    assert len(passes._pass_seconds) == 1
    passes.close()


def test_a_refused_worker_gets_no_task(client, scene, variant):
    passes = cluster_passes_of(client, scene, variant)
    accepted_worker, refused_worker = sorted(passes.workers.usable)
    del passes.workers.usable[refused_worker]
    passes.workers.refused[refused_worker] = "made up"
    passes.workers.machines = {accepted_worker: "accepted"}  # the header would contain the other worker's address
    result = rendered(scene, 40, passes)
    assert_same(result, rendered(scene, 40))
    assert result[1]["mi_refract:machines"] == "accepted"


def test_fold_leaves_its_parts_unchanged():
    """Dask keeps them, and may fold them again."""
    parts = [Part(PassSums(1, 1, np.full((1, 1, 3), x), np.zeros((1, 1, 3))), {"a": x, "b": 1}, 0.5) for x in range(8)]
    folded = cluster_passes.fold(*parts)
    assert [part.sums.total[0, 0, 0] for part in parts] == [*range(8)]
    assert (folded.sums.total[0, 0, 0], folded.nonfinite, folded.seconds) == (28, {"a": 7, "b": 1}, 4.0)


def test_non_finite_pixels_are_reported_once_per_machine(client, scene, variant):
    nan = 'type="constant"><rgb name="radiance" value="nan"/></emitter>'
    scene.write_text(GLASS.replace('type="constant"/>', nan))
    warnings = []
    header = rendered(scene, 4, cluster_passes_of(client, scene, variant, warnings.append))[1]
    assert header["mi_refract:nonfinite_pixels"] == rendered(scene, 4)[1]["mi_refract:nonfinite_pixels"] > 0
    (warning,) = warnings
    assert re.fullmatch(rf"{os.uname().nodename}: \d+ pixels of a pass are not finite", warning)


def test_an_error_of_the_scene_is_that_of_a_local_render(client, scene, variant):
    """The error is raised during the render: the scene scatters light, which `deterministic` does not support."""
    deterministic = 'type="refract_path"><boolean name="deterministic" value="true"/>'
    scene.write_text(GLASS.replace('type="path">', deterministic))
    errors = []
    for passes in (None, cluster_passes_of(client, scene, variant)):
        with pytest.raises(ValueError, match="deterministic") as error:
            rendered(scene, 4, passes)
        errors.append(str(error.value))
    assert errors[0] == errors[1]


@pytest.mark.parametrize(
    "seconds, workers, levels",
    [(None, 2, (0, 0)), (10.0, 2, (0, 0)), (10.0, 16, (0, 1)), (0.3, 2, (1, 1)), (0.01, 2, (2, 3)), (1.0, 200, (0, 3))],
)
def test_levels_follow_the_time_of_a_pass(seconds, workers, levels):
    passes = ClusterPasses(SimpleNamespace(usable=dict.fromkeys(range(workers), 1)), None, "", 0)
    passes._pass_seconds.extend([] if seconds is None else [seconds] * 5)
    assert passes.levels() == levels
