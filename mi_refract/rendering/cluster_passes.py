"""Passes of a render on the workers of a cluster, which sum them in nodes of `PassTree` before they return them.

A task renders ARITY**k consecutive passes, so that it takes seconds. Other tasks fold ARITY nodes into one of the next
level, so that the client receives a node every few seconds. The order of sums is that of `PassTree`, so the bits do not
depend on which worker computes them.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from statistics import median
from typing import Any

from mi_refract.cluster import on_worker
from mi_refract.cluster.connection import cluster_errors
from mi_refract.cluster.workers import Workers, fetched, finished

from . import scene_bundle
from .pass_plan import next_stop
from .pass_sums import ARITY, PassSums, aligned_nodes
from .render_pass import pass_renderer
from .rendered_file import nonfinite_pixels
from .scene_bundle import SceneBundle

TASK_SECONDS = 3.0  # largest time of a task of several passes, which limits the wait for a slow worker
NODE_SECONDS = 5.0  # largest time between two nodes: a kill loses nodes that are not complete
LEVELS = 4  # highest level of a node
AHEAD = 3  # submitted tasks per thread of the workers
NODES = 64  # limit of submitted nodes, unless AHEAD tasks per thread are more; workers keep the parts of these
RETRIES = 2
_MEASURED = 16  # latest nodes, whose times give the time of a pass


@dataclass(frozen=True)
class Part:
    """The sums of a node or of a part of it."""

    sums: PassSums
    nonfinite: dict[str, int]  # largest number of non-finite pixels in a pass, by the address of the worker
    seconds: float  # sum over all workers


# On a worker ----------------------------------------------------------------------------------------------------------


def keep(bundle: SceneBundle) -> SceneBundle:
    """Return the bundle. All tasks depend on this one, so each worker receives the bundle once, also from workers."""
    return bundle


def unpack(bundle: SceneBundle) -> None:
    """Write the files of the bundle, for `render_node`."""
    folder = on_worker.scratch_folder()
    on_worker.one_at_a_time(lambda: scene_bundle.unpack(bundle, folder))


def render_node(bundle: SceneBundle, variant: str, seed: int, level: int, first: int, spp: int) -> Part:
    """Render ARITY**level passes of `spp` samples per pixel each, from number `first` on, and sum them.

    `seed`: of the render. Errors: those of `load_scene` and of the scene itself, with the file names of the machine
    that made the bundle.
    """
    address, folder = on_worker.address(), on_worker.scratch_folder()

    def render() -> Part:
        start, nonfinite = time.monotonic(), [0]
        scene, moved = scene_bundle.load(bundle, variant, folder)
        renderer = pass_renderer(scene, seed)

        def node_sums(level: int, first: int) -> PassSums:
            if level:
                size = ARITY ** (level - 1)
                sums = node_sums(level - 1, first)
                for i in range(1, ARITY):
                    sums.add(node_sums(level - 1, first + i * size))
                return sums
            sums = renderer.render(first, spp)
            nonfinite.append(nonfinite_pixels(sums))
            return sums

        with scene_bundle.original_names(moved):
            sums = node_sums(level, first)
        return Part(sums, {address: max(nonfinite)}, time.monotonic() - start)

    return on_worker.in_variant(variant, render)


def fold(*parts: Part) -> Part:
    """Return the node of consecutive parts, and leave these unchanged, because Dask may need them again."""
    sums = parts[0].sums.copy()
    for part in parts[1:]:
        sums.add(part.sums)
    nonfinite: dict[str, int] = {}
    for part in parts:
        for address, count in part.nonfinite.items():
            nonfinite[address] = max(count, nonfinite.get(address, 0))
    return Part(sums, nonfinite, sum(part.seconds for part in parts))


# On the client --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Node:
    """A submitted node of ARITY**level passes from number `first` on."""

    level: int
    first: int
    needed: frozenset[str]  # workers, of which one must remain
    result: Any  # future of its `Part`
    tasks: list[Any]  # futures of the passes that are not finished

    @property
    def stop(self) -> int:
        return self.first + int(ARITY**self.level)


class ClusterPasses:
    """Renders passes on usable workers. Call `close` at the end, which releases all submitted nodes."""

    def __init__(
        self,
        workers: Workers,
        bundle: SceneBundle,
        variant: str,
        seed: int,
        warn: Callable[[str], None] = lambda text: None,
    ) -> None:
        """`warn`: called with a line for each machine that renders non-finite pixels."""
        self.workers, self.bundle, self.variant, self.seed, self.warn = workers, bundle, variant, seed, warn
        self._submitted: deque[_Node] = deque()
        self._series = (0, 0)  # offset and samples per pixel of the submitted passes
        self._pass_seconds: deque[float] = deque(maxlen=_MEASURED)
        self._unpacked: dict[str, Any] = {}  # futures of `unpack`, by the address of the worker
        self._sent: tuple[Any, frozenset[str]] = (None, frozenset())  # future of `keep`, and the workers it may run on
        self._warned: set[str] = set()
        self._count = itertools.count()

    def nodes(self, first: int, stop: int, last: int, offset: int, spp: int) -> Iterator[tuple[int, PassSums, str]]:
        """Yield nodes as `long_render.Passes`. Submitted nodes beyond `stop` remain for the next call.

        Closing the iterator early releases them. ConnectionError, one line, if the scheduler or all workers have gone;
        errors of the scene unchanged.
        """
        if self._series != (offset, spp) or (self._submitted and self._submitted[0].first != first):
            self.close()
        if self._series[1] != spp:
            self._pass_seconds.clear()
        self._series = offset, spp
        try:
            while first < stop:
                if self._submitted and self._submitted[0].stop > stop:
                    self.close()
                node, part = self._next(first, stop, last)
                if node.first != first:
                    raise RuntimeError(f"received pass {node.first}; expected {first}")
                first = node.stop
                self._pass_seconds.append(part.seconds / part.sums.passes)
                machines = {address: self.workers.machines.get(address, address) for address in part.nonfinite}
                for address, count in part.nonfinite.items():
                    if count and machines[address] not in self._warned:
                        self._warned.add(machines[address])
                        self.warn(f"{machines[address]}: {count} pixels of a pass are not finite")
                # A copy, because arrays from Dask may be read-only.
                yield node.level, part.sums.copy(), ", ".join(sorted(set(machines.values())))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release all submitted nodes."""
        while self._submitted:
            self._release(self._submitted.popleft())

    def _release(self, node: _Node) -> None:
        """Release the futures of a node, so that the scheduler forgets it and everything that only this node needs.

        `client.cancel` does not suit nodes: for a fold of folds that no client waits for, the scheduler fails an
        assertion and closes the connection (Dask 2026.8).
        """
        if self.workers.client.status == "running":
            with contextlib.suppress(Exception):  # the connection may be lost meanwhile
                for future in (*node.tasks, node.result):
                    future.release()

    def _next(self, first: int, stop: int, last: int) -> tuple[_Node, Part]:
        """Submit nodes until the one that begins at `first` is finished, and return this node."""
        client = self.workers.client
        while True:
            self.workers.look()
            usable = frozenset(self.workers.usable)
            with cluster_errors(client):
                # Each worker unpacks the bundle once, first: Dask prefers workers that have it already.
                self._unpacked = {address: future for address, future in self._unpacked.items() if address in usable}
                for address in usable - self._unpacked.keys():
                    options: dict[str, Any] = {"workers": [address], "pure": False, "priority": 1000}
                    self._unpacked[address] = client.submit(unpack, self._bundle(usable), **options)
                # Submit nodes again whose workers have all gone: Dask would wait for the same workers to return.
                for i, node in enumerate(self._submitted):
                    if usable and node.needed.isdisjoint(usable) and node.result.status != "error":
                        self._release(node)
                        new_node = self._submit(node.level, node.first, 0)
                        assert new_node is not None
                        self._submitted[i] = new_node
                self._submit_nodes(first, stop, last)
            if not self._submitted:
                time.sleep(0.5)
            elif finished(client, [self._submitted[0].result]):
                for part in fetched(client, self._submitted[0].result):
                    return self._submitted.popleft(), part

    # Submission -------------------------------------------------------------------------------------------------------

    def levels(self) -> tuple[int, int]:
        """Return the levels of a task and of a node, by the times so far.

        A node of up to as many passes as there are workers takes as long as one pass. If nodes were smaller, the client
        would receive too many.
        """
        count = max(1, len(self.workers.usable))
        least = max(k for k in range(LEVELS + 1) if ARITY**k <= count)
        if not self._pass_seconds:
            return 0, least
        seconds = median(self._pass_seconds)
        task = max((k for k in range(LEVELS) if ARITY**k * seconds <= TASK_SECONDS), default=0)
        node = max((k for k in range(LEVELS + 1) if ARITY**k * seconds <= NODE_SECONDS * count), default=0)
        return min(task, node), max(node, least)

    def _submit_nodes(self, first: int, stop: int, last: int) -> None:
        """Submit nodes until each thread has AHEAD tasks, and at least the one that begins at `first`."""
        most = AHEAD * sum(self.workers.usable.values())
        submitted = self._submitted
        while True:
            for node in submitted:
                node.tasks[:] = [task for task in node.tasks if not task.done()]  # workers may drop finished passes
            begin, tasks = submitted[-1].stop if submitted else first, sum(len(node.tasks) for node in submitted)
            if begin >= last or (submitted and (tasks >= most or len(submitted) >= max(NODES, most))):
                return
            while stop <= begin:
                stop = min(next_stop(stop + self._series[0]) - self._series[0], last)
            task_level, largest = self.levels()
            level, begin = aligned_nodes(begin, stop, largest)[0]
            if (new_node := self._submit(level, begin, min(task_level, level))) is None:
                return
            submitted.append(new_node)

    def _submit(self, level: int, first: int, task_level: int) -> _Node | None:
        """Submit a node to the workers that are usable now, and return it; None if there is no worker."""
        if not (usable := frozenset(self.workers.usable)):
            return None
        (offset, spp), bundle, client = self._series, self._bundle(usable), self.workers.client
        options: dict[str, Any] = {"retries": RETRIES, "pure": False, "priority": -next(self._count)}
        options["workers"] = sorted(usable)
        parts = tasks = [
            client.submit(render_node, bundle, self.variant, self.seed, task_level, offset + number, spp, **options)
            for number in range(first, first + ARITY**level, ARITY**task_level)
        ]
        while len(parts) > 1:
            parts = [client.submit(fold, *parts[i : i + ARITY], **options) for i in range(0, len(parts), ARITY)]
        return _Node(level, first, self._sent[1] & usable, parts[0], list(tasks))

    def _bundle(self, usable: frozenset[str]) -> Any:
        """Return the future of the bundle; it is sent again if all workers have gone that could have it."""
        if not self._sent[1] & usable:
            future = self.workers.client.submit(keep, self.bundle, workers=sorted(usable), pure=False)
            self._sent = future, usable
        return self._sent[0]
