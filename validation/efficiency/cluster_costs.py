"""What each thing costs that is done for a render on a cluster, measured here.

Seconds of computing are CPU seconds of one thread, which a busy machine stretches least; of sending they are seconds of
the fastest of some tries. `python -m validation.efficiency.cluster_costs SCENE`: what a new process does before its
first pass, as JSON.
"""

from __future__ import annotations

import json
import os
import site
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from mi_refract.cluster import connection
from mi_refract.rendering import cluster_passes
from mi_refract.rendering.cluster_passes import ClusterPasses, Part
from mi_refract.rendering.pass_sums import PassSums
from validation.efficiency.cluster_model import Costs
from validation.run.context import SCENES

VARIANT = "llvm_ad_rgb"
PIXELS, SIDE = 1920 * 1080, 1440  # 1440² = 1920 × 1080
LINK = 1.25e9  # bytes a second: 10 Gbit/s between machines, assumed; less where Dask itself is slower
LISTED = 1000  # workers in the longer list
FIRST = 100  # number of a pass without second moments, as nearly all are
LIMIT = 300.0  # seconds of a process


@dataclass(frozen=True)
class Extent:
    """Passes are timed on `side` squared pixels, scaled to PIXELS. `tasks`, `listed`: empty ones that are sent."""

    side: int
    tasks: int
    listed: int
    tries: int


EXTENTS = {
    "quick": Extent(SIDE // 4, 500, 100, 2),
    "standard": Extent(SIDE // 2, 2000, 300, 4),
    "full": Extent(SIDE, 5000, 500, 6),
}


def measured(scene: str, shared: dict[str, float], extent: Extent) -> dict[str, float]:
    """All costs with one scene. `shared`: those that do not depend on it."""
    return pass_seconds(scene, extent) | beginning(scene) | shared


def as_costs(found: dict[str, float], *, process: bool = False) -> Costs:
    """For the model. `process`: workers are started with the render."""
    begin = found["scene"] + found["kernels"] + (found["process"] if process else 0)
    same = (
        "fixed",
        "sample",
        "copy",
        "add",
        "task",
        "task_worker",
        "submit",
        "submit_worker",
        "look",
        "relay",
        "receive",
    )
    node = {"node_bytes": found["node MB"] * 1e6, "bandwidth": min(LINK, 1e6 * found["MB/s, workers"])}
    return Costs(**{name: found[name] for name in same}, **node, begin=begin)


# Rendering ------------------------------------------------------------------------------------------------------------


def pass_seconds(scene: str, extent: Extent) -> dict[str, float]:
    """Of a pass of PIXELS: `fixed` and `sample` of the line through the seconds of 1 and of 5 samples per pixel."""
    import drjit as dr

    renderer = _renderer(scene, extent.side)
    threads, scale = dr.thread_count(), PIXELS / extent.side**2
    dr.set_thread_count(1)
    try:
        renderer.render(FIRST, 1)
        one, five = (
            scale * _fastest(partial(renderer.render, FIRST, spp), extent.tries, time.process_time) for spp in (1, 5)
        )
    finally:
        dr.set_thread_count(threads)
    sample = (five - one) / 4
    return {"fixed": max(0.0, one - sample), "sample": sample, "lanes/s": PIXELS / sample}


def _renderer(scene: str, side: int) -> Any:
    from mi_refract.rendering.render_pass import pass_renderer
    from mi_refract.rendering.scene_files import load_scene

    return pass_renderer(load_scene(SCENES / f"{scene}.xml", {"res": str(side)}, ()), 0)


def _fastest(action: Callable[[], Any], tries: int, clock: Callable[[], float] = time.perf_counter) -> float:
    found = []
    for _ in range(tries):
        start = clock()
        action()
        found.append(clock() - start)
    return min(found)


def beginning(scene: str) -> dict[str, float]:
    """CPU seconds of a new process, with nothing compiled before: `process` and imports, the `scene`, its `kernels`."""
    with tempfile.TemporaryDirectory() as home:
        done = subprocess.run(
            [sys.executable, "-m", "validation.efficiency.cluster_costs", scene],
            cwd=SCENES.parent,
            check=False,
            env=os.environ | {"HOME": home, "PYTHONUSERBASE": site.getuserbase()},
            capture_output=True,
            text=True,
            timeout=LIMIT,
        )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise RuntimeError(f"{scene}: exit code {done.returncode}: {last}")
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def _begin(scene: str) -> dict[str, float]:
    """In this process, which is new."""
    import distributed  # noqa: F401  as a worker has it

    from mi_refract import backend

    backend.activate(VARIANT)
    imported = time.process_time()
    renderer = _renderer(scene, SIDE // 8)
    loaded = time.process_time()
    first = _fastest(lambda: renderer.render(FIRST, 1), 1, time.process_time)
    kernels = first - _fastest(lambda: renderer.render(FIRST, 1), 1, time.process_time)
    return {"process": imported, "scene": loaded - imported, "kernels": kernels}


# Nodes and messages ---------------------------------------------------------------------------------------------------


def shared(extent: Extent) -> dict[str, float]:
    """What does not depend on the scene. Two workers are started for it. ConnectionError where they cannot be."""
    found = sums_seconds(extent) | {"look": _look()}
    with connection.connected(workers=2) as client:
        client.wait_for_workers(2)
        addresses = sorted(client.nthreads())
        found |= _sending(client, addresses, extent.tries)
        few, many = (
            _messages(client, addresses, names, count) for names, count in ((0, extent.tasks), (LISTED, extent.listed))
        )
    for name in ("task", "submit"):
        each = max(0.0, many[name] - few[name]) / LISTED
        found |= {name: max(0.0, few[name] - 2 * each), f"{name}_worker": each}
    return found


def sums_seconds(extent: Extent) -> dict[str, float]:
    """Of a node's arrays: to copy them, to add others to them, to fold eight."""
    part, other = make_part(1.0), make_part(2.0)
    copy = _fastest(part.sums.copy, extent.tries, time.process_time)
    add = _fastest(lambda: part.sums.add(other.sums), extent.tries, time.process_time)
    fold = _fastest(lambda: cluster_passes.fold(*[other] * 8), 1, time.process_time)
    size = part.sums.total.nbytes + part.sums.between.nbytes
    return {"copy": copy, "add": add, "fold of 8": fold, "node MB": size / 1e6}


def make_part(value: float) -> Part:
    """A node of PIXELS."""
    total, between = (np.full((1080, 1920, 3), value) for _ in range(2))
    return Part(PassSums(1, 1, total, between), {}, 0.0)


def take(*_: Any) -> None:
    """A task that does nothing with what it is given."""


def _sending(client: Any, addresses: list[str], tries: int) -> dict[str, float]:
    """MB/s of a node between workers and to the client; `receive`, `relay`: its seconds through the scheduler."""
    giver, taker = ({"workers": [address], "pure": False} for address in addresses)
    found: dict[str, list[float]] = {"between": [], "here": [], "direct": [], "relay": []}
    client.submit(take, **taker).result()
    for i in range(tries):
        part = client.submit(make_part, float(i), **giver)
        client.submit(take, part, **giver).result()
        found["between"].append(_fastest(client.submit(take, part, **taker).result, 1))
        before = client.run_on_scheduler(time.process_time)
        found["here"].append(_fastest(part.result, 1))
        found["relay"].append(client.run_on_scheduler(time.process_time) - before)
        found["direct"].append(_fastest(partial(client.gather, part, direct=True), 1))
        del part
    least, size = {name: min(seconds) for name, seconds in found.items()}, make_part(0.0).sums.total.nbytes * 2 / 1e6
    rates = {"MB/s, workers": size / least["between"], "MB/s, client, direct": size / least["direct"]}
    return rates | {"receive": least["here"], "relay": least["relay"]}


def _messages(client: Any, addresses: list[str], names: int, count: int) -> dict[str, float]:
    """CPU seconds of the scheduler and of the client for each of `count` empty tasks that list `names` more workers."""
    listed = sorted([*addresses, *(f"tcp://10.0.{i // 250}.{i % 250}:40000" for i in range(names))])
    bundle = client.submit(take, pure=False, workers=listed)
    bundle.result()
    before, own = client.run_on_scheduler(time.process_time), time.process_time()
    tasks = [client.submit(take, bundle, i, workers=listed, retries=2, pure=False, priority=-i) for i in range(count)]
    client.gather(tasks)
    found = {"submit": time.process_time() - own, "task": client.run_on_scheduler(time.process_time) - before}
    client.cancel(tasks, force=True)
    return {name: seconds / count for name, seconds in found.items()}


def _look(nodes: int = 100) -> float:
    """Of the client, for each node that is begun, when it looks for nodes whose workers have gone: none has."""
    names = {f"tcp://10.0.{i // 250}.{i % 250}:40000": 1 for i in range(LISTED)}
    workers: Any = SimpleNamespace(accepted=names)
    source = ClusterPasses(workers, *[None] * 2)  # type: ignore[arg-type]
    result = SimpleNamespace(done=lambda: False)
    source._begun = deque(cluster_passes._Node(0, i, frozenset(names), result, []) for i in range(nodes))
    return _fastest(source._begin_again, 5, time.process_time) / nodes


if __name__ == "__main__":
    print(json.dumps(_begin(Path(sys.argv[1]).stem)))
