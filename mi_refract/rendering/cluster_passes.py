"""Passes of a render on the workers of a cluster, summed there in the tree's own nodes before they come back.

A task renders ARITY**k passes in a row, so that it takes seconds; other tasks fold ARITY nodes into one of the next
level, so that a node comes back every few seconds. Sums are made in the order of `PassTree`: who made them is not seen.
"""

from __future__ import annotations

import contextlib
import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent import futures
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

from mi_refract import backend
from mi_refract.cluster import on_worker, worker_facts
from mi_refract.cluster.connection import in_thread, scheduler_needed
from mi_refract.cluster.workers import Workers
from mi_refract.io.errors import NoWorkersError, RefusedWorkerError

from . import scene_bundle
from .pass_plan import next_stop
from .pass_sums import ARITY, PassSums, aligned_nodes
from .rendered_file import nonfinite_pixels
from .scene_bundle import SceneBundle

TASK_SECONDS = 3.0  # of a task that renders more than one pass, at most: nobody waits longer for a slow worker
# Between two nodes, at most. What a kill may lose: BETWEEN_CHECKPOINTS, and what is not yet a whole node.
NODE_SECONDS = 5.0
LEVELS = 4  # of a node, at most
AHEAD = 3  # tasks for each thread of the workers
NODES = 64  # that are begun at a time, at least; the workers keep what is finished of them
RETRIES = 2
_FIRST = 1000  # priority of what passes wait for
_MEASURED = 16  # nodes whose time counts
_POLL = 0.5  # seconds


@dataclass(frozen=True)
class Part:
    """The sums of a node; the addresses of the workers that rendered it, and their pixels that are not finite.

    `seconds`: of the workers, for all its passes.
    """

    sums: PassSums
    nonfinite: dict[str, int]
    seconds: float


@dataclass(frozen=True)
class RenderedScene:
    """What a worker must know beside the bundle: the variant, and the seed of the render.

    `expected`: facts that a worker must have, but for `tolerated`, where any may be given a task; None: none is asked.
    """

    variant: str
    seed: int
    expected: Mapping[str, str] | None = None
    tolerated: frozenset[str] = frozenset()


# On a worker ----------------------------------------------------------------------------------------------------------


def keep(bundle: SceneBundle) -> SceneBundle:
    """The task whose result the others ask for: so the bundle goes to each worker once, also from the others."""
    return bundle


def unpack(bundle: SceneBundle) -> None:
    """Write the files of the bundle, for `render_node`."""
    folder = on_worker.scratch_folder()
    on_worker.one_at_a_time(lambda: scene_bundle.unpack(bundle, folder))


def render_node(bundle: SceneBundle, scene: RenderedScene, level: int, first: int, spp: int) -> Part:
    """Render ARITY**level passes of `spp` samples per pixel each, from number `first` on, and sum them.

    Errors: those of `load_scene` and of the scene itself, with the paths of the machine that made the bundle;
    RefusedWorkerError.
    """
    if scene.expected is not None and worker_facts.differences(
        worker_facts.facts(scene.variant), scene.expected, scene.tolerated
    ):
        raise RefusedWorkerError(on_worker.address())
    address, threads, folder = on_worker.address(), on_worker.threads(), on_worker.scratch_folder()

    def rendered() -> Part:
        began = time.monotonic()
        if on_worker.variant() != scene.variant:
            backend.activate(scene.variant)
        on_worker.limit_threads(threads)
        sums, bad = _rendered(bundle, scene, folder, (level, first, spp))
        return Part(sums, {address: bad}, time.monotonic() - began)

    return on_worker.one_at_a_time(rendered)


def _rendered(
    bundle: SceneBundle, scene: RenderedScene, folder: str, node: tuple[int, int, int]
) -> tuple[PassSums, int]:
    """The sums of a node (level, first pass, samples of a pass), and the most pixels of a pass that are not finite."""
    from .render_pass import pass_renderer

    loaded, root = scene_bundle.load(bundle, scene.variant, folder)
    renderer, spp, bad = pass_renderer(loaded, scene.seed), node[2], [0]

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

    with scene_bundle.original_paths(root):
        return made(*node[:2]), max(bad)


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
    """A node that was asked for. `needed`: one of these workers must be there; `tasks`: those that still render."""

    level: int
    first: int
    needed: frozenset[str]
    result: Any
    tasks: list[Any]

    @property
    def stop(self) -> int:
        return self.first + ARITY**self.level


class ClusterPasses:
    """Renders passes on workers that were accepted. To be closed at the end, which cancels what is still asked for."""

    def __init__(
        self,
        workers: Workers,
        bundle: SceneBundle,
        scene: RenderedScene,
        warn: Callable[[str], None] = lambda text: None,
    ) -> None:
        """`warn` is told of machines whose pixels are not finite."""
        self.workers, self.bundle, self.scene, self.warn = workers, bundle, scene, warn
        self._begun: deque[_Node] = deque()
        self._series = (0, 0)  # offset and samples of what is begun
        self._pass_seconds: deque[float] = deque(maxlen=_MEASURED)
        self._handed: dict[str, Any] = {}  # who has unpacked the bundle, or will
        self._kept: tuple[Any, frozenset[str]] = (None, frozenset())  # the bundle there, and who may make it
        self._warned: set[str] = set()
        self._count = itertools.count()

    def nodes(self, first: int, stop: int, last: int, offset: int, spp: int) -> Iterator[tuple[int, PassSums, str]]:
        """As `Passes`. What is begun beyond `stop` stays so for the next call, unless this iterator is closed early.

        ConnectionError, one line, where the scheduler or all workers have gone; errors of the scene as they are.
        """
        if self._series != (offset, spp) or (self._begun and self._begun[0].first != first):
            self.close()
        self._series = offset, spp
        try:
            while first < stop:
                if self._begun and self._begun[0].stop > stop:
                    self.close()
                with scheduler_needed(self.workers.client):
                    node, part = self._next(first, stop, last)
                if node.first != first:
                    raise RuntimeError(f"pass {node.first} came in place of {first}")
                first = node.stop
                self._note(node, part)
                yield node.level, part.sums.copy(), self._machines(part)  # a copy: what Dask gives may be read-only
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Give up all that is begun."""
        while self._begun:
            self._give_up(self._begun.popleft())

    def _give_up(self, node: _Node) -> None:
        """Ask for it no more: the scheduler forgets what nobody asks for, and all that only this needs.

        `client.cancel` is not for nodes: at a fold of folds, for which nobody asks, the scheduler fails an assertion
        and closes the connection (Dask 2026.8).
        """
        if self.workers.client.status == "running":
            with contextlib.suppress(Exception):  # it may go now
                for future in (*node.tasks, node.result):
                    future.release()

    def _next(self, first: int, stop: int, last: int) -> tuple[_Node, Part]:
        """The node that begins at `first`, when it is here; more are begun meanwhile."""
        asked, coming = None, None
        while True:
            self.workers.look()
            self._hand_out()
            self._begin_again()
            self._begin(first, stop, last)
            if not self._begun:
                time.sleep(_POLL)
                continue
            if coming is None or self._begun[0] is not asked:
                asked, coming = self._begun[0], in_thread(self._begun[0].result.result)
            if coming in futures.wait([coming], _POLL).done:
                self._begun.popleft()
                try:
                    return asked, self._part(asked, coming)
                except RefusedWorkerError:
                    self.workers.look(at_once=True)
                    if again := self._asked(asked.level, asked.first, 0, listed=True):
                        self._begun.appendleft(again)
                    else:
                        self.close()  # nobody may have it now: all is begun anew, from it on

    def _part(self, node: _Node, coming: futures.Future[Part]) -> Part:
        from distributed import KilledWorker

        try:
            return coming.result()
        except KilledWorker as error:
            raise NoWorkersError(
                f"passes {node.first} to {node.stop - 1}: {error.allowed_failures + 1} workers were lost that rendered "
                f"them, the last {error.last_worker.address}; expected workers with enough memory"
            ) from None

    def _note(self, node: _Node, part: Part) -> None:
        self._pass_seconds.append(part.seconds / part.sums.passes)
        for address, count in part.nonfinite.items():
            machine = self.workers.machines.get(address, address)
            if count and machine not in self._warned:
                self._warned.add(machine)
                self.warn(f"{machine}: {count} pixels of a pass are not finite")

    def _machines(self, part: Part) -> str:
        return ", ".join(sorted({self.workers.machines.get(address, address) for address in part.nonfinite}))

    # What is begun ----------------------------------------------------------------------------------------------------

    def levels(self) -> tuple[int, int]:
        """The levels of a task and of a node, by the times so far.

        A node of as many passes as there are workers takes as long as one: of less the client would receive too many.
        """
        count = max(1, len(self.workers.accepted))
        least = max(k for k in range(LEVELS + 1) if ARITY**k <= count)
        if not self._pass_seconds:
            return 0, least
        seconds = median(self._pass_seconds)
        task = max((k for k in range(LEVELS) if ARITY**k * seconds <= TASK_SECONDS), default=0)
        node = max((k for k in range(LEVELS + 1) if ARITY**k * seconds <= NODE_SECONDS * count), default=0)
        return min(task, node), max(node, least)

    def _begin(self, first: int, stop: int, last: int) -> None:
        """Begin nodes until each thread has AHEAD tasks; at least the one that is asked for."""
        while True:
            begin = self._begun[-1].stop if self._begun else first
            if begin >= last or (self._begun and self._enough()):
                return
            while stop <= begin:
                stop = min(next_stop(stop + self._series[0]) - self._series[0], last)
            task, largest = self.levels()
            level, begin = aligned_nodes(begin, stop, largest)[0]
            if not (node := self._asked(level, begin, min(task, level))):
                return
            self._begun.append(node)

    def _enough(self) -> bool:
        threads, tasks = sum(self.workers.accepted.values()), 0
        for node in self._begun:
            node.tasks[:] = [
                task for task in node.tasks if not task.done()
            ]  # what is done need not be kept there for us
            tasks += len(node.tasks)
        return tasks >= AHEAD * threads or len(self._begun) >= max(NODES, AHEAD * threads)

    def _asked(self, level: int, first: int, task: int, *, listed: bool = False) -> _Node | None:
        """A node, asked of the workers that are accepted now; None where there are none.

        They are listed at each task, which costs the scheduler 5 µs for every one, or where all are accepted and not
        `listed` each looks by itself whether it may have the task.
        """
        allowed = frozenset(self.workers.accepted)
        if not allowed:
            return None
        (offset, spp), bundle, client, scene = self._series, self._bundle(allowed), self.workers.client, self.scene
        options: dict[str, Any] = {"retries": RETRIES, "pure": False, "priority": -next(self._count)}
        if listed or not self.workers.all_accepted:
            options["workers"], scene = sorted(allowed), replace(scene, expected=None)
        size = ARITY**task
        parts = tasks = [
            client.submit(render_node, bundle, scene, task, offset + number, spp, **options)
            for number in range(first, first + ARITY**level, size)
        ]
        while len(parts) > 1:
            parts = [client.submit(fold, *parts[i : i + ARITY], **options) for i in range(0, len(parts), ARITY)]
        return _Node(level, first, self._kept[1] & allowed, parts[0], list(tasks))

    def _bundle(self, allowed: frozenset[str]) -> Any:
        """The bundle on the workers; sent again where all have gone that were allowed to have it."""
        future, holders = self._kept
        if not holders & allowed:
            future, holders = (
                self.workers.client.submit(keep, self.bundle, workers=sorted(allowed), pure=False),
                allowed,
            )
            self._kept = future, holders
        return future

    def _hand_out(self) -> None:
        """Have each worker unpack the bundle once. Of workers that are listed Dask chooses only who has it already."""
        there = frozenset(self.workers.accepted)
        self._handed = {address: done for address, done in self._handed.items() if address in there}
        for address in there - self._handed.keys():
            self._handed[address] = self.workers.client.submit(
                unpack, self._bundle(there), workers=[address], pure=False, priority=_FIRST
            )

    def _begin_again(self) -> None:
        """Ask others for nodes whose workers have all gone: Dask would wait for these to come back."""
        there = self.workers.accepted.keys()
        for i, node in enumerate(self._begun):
            if there and node.needed.isdisjoint(there) and node.result.status != "error":
                again = self._asked(node.level, node.first, 0)
                if again is not None:
                    self._give_up(node)
                    self._begun[i] = again
