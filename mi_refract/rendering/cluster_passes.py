"""Passes of a render on the workers of a cluster, summed there in the tree's own nodes before they come back.

A task renders ARITY**k passes in a row, so that it takes seconds; other tasks fold ARITY nodes into one of the next
level, so that a node comes back every few seconds. Sums are made in the order of `PassTree`, so that the bits do not
depend on who made them.
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

TASK_SECONDS = 3.0  # of a task that renders more than one pass, at most: nobody waits longer for a slow worker
NODE_SECONDS = 5.0  # between two nodes, at most: a kill loses what is not yet a whole node
LEVELS = 4  # of a node, at most
AHEAD = 3  # tasks for each thread of the workers
NODES = 64  # that are begun at a time, at least; the workers keep what is finished of them
RETRIES = 2
_MEASURED = 16  # nodes whose time counts


@dataclass(frozen=True)
class Part:
    """The sums of a node, of which workers rendered how many pixels that are not finite, and their seconds in all."""

    sums: PassSums
    nonfinite: dict[str, int]  # the most of a pass, by the address of the worker
    seconds: float


# On a worker ----------------------------------------------------------------------------------------------------------


def keep(bundle: SceneBundle) -> SceneBundle:
    """The task that the others depend on: so the bundle goes to each worker once, also from the others."""
    return bundle


def unpack(bundle: SceneBundle) -> None:
    """Write the files of the bundle, for `render_node`."""
    folder = on_worker.scratch_folder()
    on_worker.one_at_a_time(lambda: scene_bundle.unpack(bundle, folder))


def render_node(bundle: SceneBundle, variant: str, seed: int, level: int, first: int, spp: int) -> Part:
    """Render ARITY**level passes of `spp` samples per pixel each, from number `first` on, and sum them.

    `seed`: of the render. Errors: those of `load_scene` and of the scene itself, with the names of the machine that
    made the bundle.
    """
    address, folder = on_worker.address(), on_worker.scratch_folder()

    def rendered() -> Part:
        began, bad = time.monotonic(), [0]
        scene, moved = scene_bundle.load(bundle, variant, folder)
        renderer = pass_renderer(scene, seed)

        def made(level: int, first: int) -> PassSums:
            if level:
                size = ARITY ** (level - 1)
                sums = made(level - 1, first)
                for i in range(1, ARITY):
                    sums.add(made(level - 1, first + i * size))
                return sums
            sums = renderer.render(first, spp)
            bad.append(nonfinite_pixels(sums))
            return sums

        with scene_bundle.original_names(moved):
            sums = made(level, first)
        return Part(sums, {address: max(bad)}, time.monotonic() - began)

    return on_worker.in_variant(variant, rendered)


def fold(*parts: Part) -> Part:
    """The node that these make, which follow each other. They stay as they are: Dask may want them again."""
    sums = parts[0].sums.copy()
    for part in parts[1:]:
        sums.add(part.sums)
    nonfinite: dict[str, int] = {}
    for part in parts:
        for address, count in part.nonfinite.items():
            nonfinite[address] = max(count, nonfinite.get(address, 0))
    return Part(sums, nonfinite, sum(part.seconds for part in parts))


# Here -----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Node:
    """A node that is being rendered. `needed`: one of these workers must be there; `tasks`: those that still render."""

    level: int
    first: int
    needed: frozenset[str]
    result: Any
    tasks: list[Any]

    @property
    def stop(self) -> int:
        return self.first + int(ARITY**self.level)


class ClusterPasses:
    """Renders passes on workers that are usable. To be closed at the end, which cancels what is still begun."""

    def __init__(
        self,
        workers: Workers,
        bundle: SceneBundle,
        variant: str,
        seed: int,
        warn: Callable[[str], None] = lambda text: None,
    ) -> None:
        """`warn` is called with the machines whose pixels are not finite."""
        self.workers, self.bundle, self.variant, self.seed, self.warn = workers, bundle, variant, seed, warn
        self._begun: deque[_Node] = deque()
        self._series = (0, 0)  # offset and samples of what is begun
        self._pass_seconds: deque[float] = deque(maxlen=_MEASURED)
        self._handed: dict[str, Any] = {}  # which workers have unpacked the bundle, or will
        self._kept: tuple[Any, frozenset[str]] = (None, frozenset())  # the bundle there, and who may make it
        self._warned: set[str] = set()
        self._count = itertools.count()

    def nodes(self, first: int, stop: int, last: int, offset: int, spp: int) -> Iterator[tuple[int, PassSums, str]]:
        """As `Passes`. What is begun beyond `stop` stays so for the next call, unless this iterator is closed early.

        ConnectionError, one line, where the scheduler or all workers have gone; errors of the scene as they are.
        """
        if self._series != (offset, spp) or (self._begun and self._begun[0].first != first):
            self.close()
        if self._series[1] != spp:
            self._pass_seconds.clear()
        self._series = offset, spp
        try:
            while first < stop:
                if self._begun and self._begun[0].stop > stop:
                    self.close()
                node, part = self._next(first, stop, last)
                if node.first != first:
                    raise RuntimeError(f"pass {node.first} came in place of {first}")
                first = node.stop
                self._pass_seconds.append(part.seconds / part.sums.passes)
                machines = {a: self.workers.machines.get(a, a) for a in part.nonfinite}
                for address, count in part.nonfinite.items():
                    if count and machines[address] not in self._warned:
                        self._warned.add(machines[address])
                        self.warn(f"{machines[address]}: {count} pixels of a pass are not finite")
                # A copy: what Dask gives may be read-only.
                yield node.level, part.sums.copy(), ", ".join(sorted(set(machines.values())))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Give up all that is begun."""
        while self._begun:
            self._give_up(self._begun.popleft())

    def _give_up(self, node: _Node) -> None:
        """Release a node: the scheduler forgets what nobody waits for, and all that only this needs.

        `client.cancel` is not for nodes: at a fold of folds, for which nobody waits, the scheduler fails an assertion
        and closes the connection (Dask 2026.8).
        """
        if self.workers.client.status == "running":
            with contextlib.suppress(Exception):  # it may go now
                for future in (*node.tasks, node.result):
                    future.release()

    def _next(self, first: int, stop: int, last: int) -> tuple[_Node, Part]:
        """The node that begins at `first`, when it is here; more are begun meanwhile."""
        client = self.workers.client
        while True:
            self.workers.look()
            there = frozenset(self.workers.usable)
            with cluster_errors(client):
                # Each worker unpacks the bundle once, first: Dask gives tasks to workers that have it already.
                self._handed = {address: done for address, done in self._handed.items() if address in there}
                for address in there - self._handed.keys():
                    options: dict[str, Any] = {"workers": [address], "pure": False, "priority": 1000}
                    self._handed[address] = client.submit(unpack, self._bundle(there), **options)
                # Nodes whose workers have all gone are submitted to others: Dask would wait for these to come back.
                for i, node in enumerate(self._begun):
                    if there and node.needed.isdisjoint(there) and node.result.status != "error":
                        self._give_up(node)
                        again = self._submitted(node.level, node.first, 0)
                        assert again is not None
                        self._begun[i] = again
                self._begin(first, stop, last)
            if not self._begun:
                time.sleep(0.5)
            elif finished(client, [self._begun[0].result]):
                for part in fetched(client, self._begun[0].result):
                    return self._begun.popleft(), part

    # What is begun ----------------------------------------------------------------------------------------------------

    def levels(self) -> tuple[int, int]:
        """The levels of a task and of a node, by the times so far.

        A node of as many passes as there are workers takes as long as one: of less the client would receive too many.
        """
        count = max(1, len(self.workers.usable))
        least = max(k for k in range(LEVELS + 1) if ARITY**k <= count)
        if not self._pass_seconds:
            return 0, least
        seconds = median(self._pass_seconds)
        task = max((k for k in range(LEVELS) if ARITY**k * seconds <= TASK_SECONDS), default=0)
        node = max((k for k in range(LEVELS + 1) if ARITY**k * seconds <= NODE_SECONDS * count), default=0)
        return min(task, node), max(node, least)

    def _begin(self, first: int, stop: int, last: int) -> None:
        """Begin nodes until each thread has AHEAD tasks; at least the one that is asked for."""
        most = AHEAD * sum(self.workers.usable.values())
        while True:
            for node in self._begun:
                node.tasks[:] = [task for task in node.tasks if not task.done()]  # what is done need not be kept for us
            begin, tasks = self._begun[-1].stop if self._begun else first, sum(len(node.tasks) for node in self._begun)
            if begin >= last or (self._begun and (tasks >= most or len(self._begun) >= max(NODES, most))):
                return
            while stop <= begin:
                stop = min(next_stop(stop + self._series[0]) - self._series[0], last)
            task, largest = self.levels()
            level, begin = aligned_nodes(begin, stop, largest)[0]
            if not (begun := self._submitted(level, begin, min(task, level))):
                return
            self._begun.append(begun)

    def _submitted(self, level: int, first: int, task: int) -> _Node | None:
        """A node, submitted to the workers that are usable now; None where there are none."""
        if not (allowed := frozenset(self.workers.usable)):
            return None
        (offset, spp), bundle, client = self._series, self._bundle(allowed), self.workers.client
        options: dict[str, Any] = {"retries": RETRIES, "pure": False, "priority": -next(self._count)}
        options["workers"] = sorted(allowed)
        parts = tasks = [
            client.submit(render_node, bundle, self.variant, self.seed, task, offset + number, spp, **options)
            for number in range(first, first + ARITY**level, ARITY**task)
        ]
        while len(parts) > 1:
            parts = [client.submit(fold, *parts[i : i + ARITY], **options) for i in range(0, len(parts), ARITY)]
        return _Node(level, first, self._kept[1] & allowed, parts[0], list(tasks))

    def _bundle(self, allowed: frozenset[str]) -> Any:
        """The bundle on the workers; sent again where all have gone that were allowed to have it."""
        if not self._kept[1] & allowed:
            future = self.workers.client.submit(keep, self.bundle, workers=sorted(allowed), pure=False)
            self._kept = future, allowed
        return self._kept[0]
