"""Passes on workers: the same bits as in one process, whoever renders what, is killed, or joins late."""

from __future__ import annotations

import os
import random
import re
import socket
import time
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.dask_workers import accepted, joined, kill, until
from support.processes import python

from mi_refract.cluster import workers as workers_module
from mi_refract.cluster.connection import connected
from mi_refract.cluster.worker_facts import facts
from mi_refract.rendering import cluster_passes, scene_bundle
from mi_refract.rendering.cluster_passes import ClusterPasses, Part, RenderedScene
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, resume
from mi_refract.rendering.pass_sums import PassSums

SCENE = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="5"/></integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,1,-4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
    <sampler type="independent"/>
  </sensor>
  <emitter type="constant">{radiance}</emitter>
  <shape type="sphere"><bsdf type="refract"/></shape>
  <shape type="cube"><transform name="to_world"><translate x="1" y="1.5"/></transform></shape>
</scene>"""
NAN = '<rgb name="radiance" value="nan"/>'


@pytest.fixture(scope="module")
def client():
    with connected(workers=2) as client:
        yield client


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.format(radiance=""))
    return path


@pytest.fixture
def small_tasks(monkeypatch):
    """Every pass a task of its own, and all sums made by tasks that fold."""
    monkeypatch.setattr(cluster_passes, "TASK_SECONDS", 0.0)


def rendering(scene, output, spp, **limits):
    return resume(Job(scene), output, Limits(spp=spp, pass_spp=1, **limits))


def source(client, scene, variant, warn=lambda text: None, **options):
    bundle = scene_bundle.pack(scene, {})
    return ClusterPasses(accepted(client, variant, **options), bundle, RenderedScene(variant, {}, 0), warn)


def local(scene, spp):
    return result(rendering(scene, scene.with_name(f"local{spp}.exr"), spp))


def remote(client, scene, variant, spp, watch=lambda render: None, passes=None):
    passes = passes or source(client, scene, variant)
    found = result(rendering(scene, scene.with_name("remote.exr"), spp), watch, passes)
    assert not passes._begun
    return found


def result(render, *arguments):
    """The sums of a render, and the header of its image."""
    header = render.run(*arguments)
    return render.progress.sums(), header


def same(found, expected):
    """The same sums, to the last bit of float64, which the image does not show; and the same header."""
    (a, header), (b, other) = found, expected
    np.testing.assert_array_equal(a.total, b.total)
    np.testing.assert_array_equal(a.between, b.between)
    assert a.contrasts == b.contrasts and a.total.std() > 0
    names = ("spp", "passes", "variance_from", "nonfinite_pixels", "identity")
    assert [header[f"mi_refract:{n}"] for n in names] == [other[f"mi_refract:{n}"] for n in names]


def test_two_workers(client, scene, variant):
    found = remote(client, scene, variant, 200)
    same(found, local(scene, 200))
    assert found[1]["mi_refract:machines"] == os.uname().nodename


@pytest.mark.usefixtures("small_tasks")
def test_one_of_two_is_killed(client, scene, variant):
    """With SIGKILL, among tasks that fold; what replaces it is used."""
    passes, victims = source(client, scene, variant), []

    def watch(render):
        if render.progress.passes >= 3 and not victims:
            victims.append(min(passes.workers.accepted))
            kill(client, victims[0])

    expected = local(scene, 75)
    same(remote(client, scene, variant, 75, watch, passes), expected)
    assert victims
    until(lambda: len(client.nthreads()) == 2)


@pytest.mark.usefixtures("small_tasks")
def test_all_are_killed(client, scene, variant):
    """Then the tasks that were asked of them are asked of those that come instead."""
    passes, victims = source(client, scene, variant), []

    def watch(render):
        if render.progress.passes >= 10 and not victims:
            victims.extend(passes.workers.accepted)
            for address in victims:
                kill(client, address)

    expected = local(scene, 40)
    same(remote(client, scene, variant, 40, watch, passes), expected)
    assert len(victims) == 2
    # A dead worker may be in the scheduler's list for a while, also when those that came instead have done its work.
    until(lambda: len(client.nthreads()) == 2 and not {*victims} & {*client.nthreads()})


EIGHT = """
import random, time
from distributed import LocalCluster
from mi_refract.cluster import on_worker
from mi_refract.rendering import cluster_passes
render, order = cluster_passes.render_node, []
def late(*arguments):
    time.sleep(random.random() / 10)
    return render(*arguments)
cluster_passes.render_node = late
options = {"protocol": "tcp://", "dashboard_address": None, "silence_logs": 60}
cluster = LocalCluster(n_workers=8, threads_per_worker=1, processes=False, **options)
print(cluster.scheduler_address, flush=True)
time.sleep(600)
"""


def finished(passes):
    """Workers and first passes of the tasks in the order in which they end, filled while rendering."""
    asked, found = cluster_passes.ClusterPasses._asked, []
    passes.addresses = Counter()

    def noted(*arguments):
        node = asked(passes, *arguments)
        for task in node.tasks if node else ():
            task.add_done_callback(lambda future, first=node.first: found.append(first))
        return node

    note = passes._note

    def counted(node, part):
        passes.addresses.update(part.nonfinite.keys())
        note(node, part)

    passes._asked, passes._note = noted, counted
    return found


@pytest.mark.usefixtures("small_tasks")
def test_eight_workers_out_of_order(scene, variant):
    with python(EIGHT) as process:
        address = process.stdout.readline().strip()
        try:
            with connected(address) as client:
                passes = source(client, scene, variant)
                order = finished(passes)
                same(remote(client, scene, variant, 100, passes=passes), local(scene, 100))
                assert len(passes.addresses) == 8
                assert order != sorted(order)
        finally:
            process.kill()


def test_a_worker_that_joins_late_is_used(client, scene, variant, monkeypatch):
    monkeypatch.setattr(workers_module, "_BETWEEN_LOOKS", 0.1)
    monkeypatch.setattr(cluster_passes, "NODE_SECONDS", 0.0)  # so that it lasts
    passes, before = source(client, scene, variant), set(client.nthreads())
    finished(passes)
    late = lambda: {*passes.addresses} - before  # noqa: E731
    run, began = rendering(scene, scene.with_name("remote.exr"), 100_000), time.monotonic()
    with joined(client):

        class Used(Exception):
            """Ends the render."""

        def watch(render):
            if late():
                raise Used
            if time.monotonic() - began > 120:
                pytest.fail("120 s without the worker that joins")

        with pytest.raises(Used):
            run.run(watch, passes)
    assert not passes._begun
    assert run.checkpoint.exists()
    until(lambda: set(client.nthreads()) == before)


def test_what_is_begun_is_cancelled_with_the_iterator(client, scene, variant):
    passes = source(client, scene, variant)
    nodes = passes.nodes(0, 8, 10**6, 0, 1)
    next(nodes)
    assert passes._begun
    nodes.close()
    assert not passes._begun
    until(lambda: not [key for keys in client.processing().values() for key in keys], 10)


def test_a_node_whose_folds_are_folded_is_given_up(client, scene, variant, monkeypatch):
    """Nobody asks for the inner folds: a scheduler that is told to cancel what they need closes the connection."""
    monkeypatch.setattr(ClusterPasses, "levels", lambda self: (0, 2))
    passes = source(client, scene, variant)
    passes._series = 0, 1
    passes.workers.look(at_once=True)
    passes._begin(0, 64, 64)
    assert [node.level for node in passes._begun] == [2]
    passes.close()
    [(_, sums, _)] = passes.nodes(0, 1, 1, 0, 1)
    np.testing.assert_array_equal(sums.total, local(scene, 1)[0].total)
    until(lambda: not [key for keys in client.processing().values() for key in keys], 10)


def test_what_was_begun_ahead_serves_the_next_call(client, scene, variant):
    passes = source(client, scene, variant)
    list(passes.nodes(0, 1, 16, 0, 1))
    ahead = [node.result.key for node in passes._begun if node.stop <= 8]
    assert ahead
    list(passes.nodes(1, 8, 16, 0, 1))
    assert not {*ahead} & {node.result.key for node in passes._begun}
    other = [sums for _, sums, _ in passes.nodes(8, 9, 9, 5, 1)]  # of other seeds
    expected = next(iter(passes.nodes(13, 14, 14, 0, 1)))[1]
    np.testing.assert_array_equal(other[0].total, expected.total)
    passes.close()


def test_who_is_refused_gets_no_task(client, scene, variant):
    passes = source(client, scene, variant)
    passes.scene = replace(passes.scene, expected=facts(variant))  # by which the refused one would take a task
    finished(passes)
    honest, liar = sorted(passes.workers.accepted)
    del passes.workers.accepted[liar]
    passes.workers.refused[liar] = "made up"
    same(remote(client, scene, variant, 40, passes=passes), local(scene, 40))
    assert set(passes.addresses) == {honest}


def test_what_is_folded_stays_as_it_is():
    """Dask keeps it, and may fold it again."""
    parts = [Part(PassSums(1, 1, np.full((1, 1, 3), x), np.zeros((1, 1, 3))), {"a": x, "b": 1}, 0.5) for x in range(8)]
    folded = cluster_passes.fold(*parts)
    assert [part.sums.total[0, 0, 0] for part in parts] == [*range(8)]
    assert (folded.sums.total[0, 0, 0], folded.nonfinite, folded.seconds) == (28, {"a": 7, "b": 1}, 4.0)


def test_a_machine_whose_pixels_are_not_finite_is_named(client, scene, variant):
    scene.write_text(SCENE.format(radiance=NAN))
    said = []
    found = remote(client, scene, variant, 4, passes=source(client, scene, variant, said.append))
    assert found[1]["mi_refract:nonfinite_pixels"] == local(scene, 4)[1]["mi_refract:nonfinite_pixels"] > 0
    assert len(said) == 1
    assert re.fullmatch(rf"{re.escape(socket.gethostname())}: \d+ pixels of a pass are not finite", said[0])


def test_a_worker_that_just_came_looks_by_itself_whether_it_may_have_a_task(client, scene, variant):
    """It is not asked by name then; here none may, by what is expected, and all are accepted when they are asked."""
    passes = source(client, scene, variant)
    passes.scene = replace(passes.scene, expected=facts(variant) | {"drjit": "0"})
    looks, look = [], passes.workers.look
    passes.workers.look = lambda **options: (looks.append(options), look(**options))[1]
    same(remote(client, scene, variant, 4, passes=passes), local(scene, 4))
    assert {"at_once": True} in looks


class Answer:
    """A future that is done."""

    status = "finished"

    def __init__(self, value=None, error=None):
        self.value, self.error = value, error

    def result(self):
        if self.error:
            raise self.error
        return self.value

    def done(self):
        return True


def test_no_pass_is_lost_where_nobody_is_left_who_may_render_it(monkeypatch):
    """The last worker goes, one that must not have the task gets it and refuses; the next one comes later."""
    refused = []

    class Client:
        status, scheduler = "running", None

        def submit(self, task, *arguments, **_):
            if task is not cluster_passes.render_node:
                return Answer()
            first = arguments[3]
            if first == 0 and not refused:
                refused.append(first)
                return Answer(error=cluster_passes.RefusedWorkerError("tcp://bad"))
            sums = np.full((1, 1, 3), float(first))
            return Answer(Part(PassSums(1, 1, sums, 0 * sums), {"good": 0}, 1.0))

        def cancel(self, *_, **__):
            pass

    workers = SimpleNamespace(client=Client(), accepted={"last": 1}, machines={}, all_accepted=True)

    def look(at_once=False):
        if at_once:
            workers.accepted.clear()
        elif not workers.accepted:
            workers.accepted["good"] = 1

    workers.look = look
    monkeypatch.setattr(cluster_passes, "_POLL", 0.01)
    found = ClusterPasses(workers, None, RenderedScene("x", {}, 0, {})).nodes(0, 4, 4, 0, 1)
    assert [int(sums.total[0, 0, 0]) for _, sums, _ in found] == [0, 1, 2, 3]


def test_an_error_of_the_scene_is_that_of_a_local_render(client, scene, variant):
    """Which is raised when it is rendered: the scene scatters, so that nothing of it is deterministic."""
    text = scene.read_text().replace('type="path">', 'type="refract_path"><boolean name="deterministic" value="true"/>')
    assert "deterministic" in text
    scene.write_text(text)
    errors = []
    for passes in (None, source(client, scene, variant)):
        with pytest.raises(ValueError, match="deterministic") as caught:
            rendering(scene, scene.with_name("x.exr"), 4).run(passes=passes)
        errors.append(str(caught.value))
    assert errors[0] == errors[1]


def test_workers_with_another_llvm_are_told_apart_in_the_header(client, scene, variant):
    """Where they are accepted, their machines' names say so."""
    if not variant.startswith("llvm"):
        pytest.skip("needs LLVM")
    passes = source(client, scene, variant)
    other = facts(variant) | {"libLLVM": "99.0"}
    workers = workers_module.Workers(client, variant, other, {"libLLVM", "vector width"})
    workers.wait()
    passes.workers = workers
    found = remote(client, scene, variant, 16, passes=passes)
    here = facts(variant)["libLLVM"]
    assert found[1]["mi_refract:machines"] == f"{os.uname().nodename} (libLLVM {here})"


@pytest.mark.parametrize(
    "seconds, workers, levels",
    [(None, 2, (0, 0)), (10.0, 2, (0, 0)), (10.0, 16, (0, 1)), (0.3, 2, (1, 1)), (0.01, 2, (2, 3)), (1.0, 200, (0, 3))],
)
def test_levels_follow_the_time_of_a_pass(seconds, workers, levels):
    class Accepted:
        accepted = dict.fromkeys(map(str, range(workers)), 1)

    passes = ClusterPasses(Accepted(), None, None)
    passes._pass_seconds.extend([] if seconds is None else [seconds * random.uniform(0.99, 1)] * 5)
    assert passes.levels() == levels
