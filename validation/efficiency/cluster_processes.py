"""Local processes that sleep instead of rendering, through the client's code, a Dask scheduler and its workers."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np

from mi_refract.cluster import connection, on_worker
from mi_refract.rendering import cluster_passes
from mi_refract.rendering.cluster_passes import ClusterPasses, Part, RenderedScene
from mi_refract.rendering.pass_plan import next_stop
from mi_refract.rendering.pass_sums import ARITY, PassSums, PassTree
from mi_refract.rendering.scene_bundle import SceneBundle

NOTHING = SceneBundle("", "", {}, (), {})
SIZE = (4, 4, 3)  # of an image: memory and links do not count


def sleep(bundle: SceneBundle, scene: RenderedScene, level: int, first: int, spp: int) -> Part:
    """In place of `cluster_passes.render_node`: passes that take the seconds the scene says, and are their number."""
    began, passes = time.monotonic(), ARITY**level
    time.sleep(passes * float(scene.defines["seconds"]))
    total = float(spp * sum(range(first, first + passes)))
    sums = PassSums(spp * passes, passes, np.full(SIZE, total), np.zeros(SIZE))
    return Part(sums, {on_worker.address(): 0}, time.monotonic() - began)


@contextmanager
def sleeping() -> Iterator[None]:
    """Tasks sleep while this is entered."""
    before = cluster_passes.render_node
    cluster_passes.render_node = sleep
    try:
        yield
    finally:
        cluster_passes.render_node = before


def measured(workers: int, passes: int, seconds: float) -> dict[str, float]:
    """Seconds until so many processes are there, and of so many passes of `seconds` each on them.

    ConnectionError where they cannot be started; ValueError where the sums are not those of all passes.
    """
    start = time.perf_counter()
    with sleeping(), connection.connected(workers=workers) as client:
        client.wait_for_workers(workers)
        started = time.perf_counter() - start
        addresses = sorted(client.nthreads())
        client.gather([client.submit(_import, workers=[each], pure=False) for each in addresses])
        there: Any = SimpleNamespace(
            client=client, accepted=dict.fromkeys(addresses, 1), machines={}, look=lambda: None
        )
        source = ClusterPasses(there, NOTHING, RenderedScene("", {"seconds": str(seconds)}, 0))
        start = time.perf_counter()
        tree = _rendered(source, passes)
        took = time.perf_counter() - start
    sums = tree.sums()
    if sums is None or sums.passes != passes or sums.total.flat[0] != sum(range(passes)):
        raise ValueError("the sums are not those of all passes")
    return {"started": started, "seconds": took, "efficiency": passes * seconds / (workers * took)}


def _rendered(source: ClusterPasses, passes: int) -> PassTree:
    """As `LongRender` asks for passes and adds them up."""
    tree = PassTree()
    while tree.passes < passes:
        stop = min(next_stop(tree.passes) if tree.passes else 1, passes)
        for level, sums, _ in source.nodes(tree.passes, stop, passes, 0, 1):
            tree.add(sums, level)
    return tree


def _import() -> None:
    """A worker has imported this module when this is done."""
