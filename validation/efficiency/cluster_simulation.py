"""A render on many workers in simulated time: the client's own code, and beside it a scheduler, workers and links.

`ClusterPasses` decides what is asked for and when, as it does on a cluster. The scheduler handles one message at a
time, half of a task's cost when it is asked for and half when it is finished. A worker does one thing at a time, the
earliest node's first; an idle one gets the first task that waits (as if Dask's work stealing cost nothing). A fold is
done where one of its nodes is, on the least busy of these workers; the others come over links that carry one node at a
time in each direction. All passes take the same time.
"""

from __future__ import annotations

import heapq
import itertools
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from mi_refract.rendering import cluster_passes
from mi_refract.rendering.cluster_passes import ClusterPasses, Part
from mi_refract.rendering.pass_plan import next_stop
from mi_refract.rendering.pass_sums import ARITY, PassSums
from validation.efficiency.cluster_model import PRESENT, Costs, Scheme

CLIENT = -1  # its number among the workers' links
_POLL = 0.5  # seconds: as the client's


@dataclass(eq=False)
class _Task:
    """A task and its future. `worker`: where its result is; `waiting`: parts, then transfers, that are not there."""

    world: World
    passes: int
    seconds: float
    parts: tuple[_Task, ...] = ()
    priority: int = 0
    worker: int = CLIENT
    waiting: int = 0
    finished: bool = False
    dependents: list[_Task] = field(default_factory=list)

    def done(self) -> bool:
        """Whether the client knows that it is finished."""
        self.world.run(self.world.client)
        return self.finished

    def __lt__(self, other: _Task) -> bool:
        return self.priority > other.priority


class World:
    """Scheduler, workers and links. `client`: what the client's clock says, in seconds."""

    def __init__(self, workers: int, costs: Costs, spp: int) -> None:
        """Workers may begin to render after `costs.begin`."""
        self.workers, self.costs, self.of_pass = workers, costs, costs.of_pass(spp)
        self.client = self.now = self._scheduler = 0.0
        self._events: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        self._count = itertools.count()
        self._sends: defaultdict[int, float] = defaultdict(float)  # when a link is free, by worker
        self._takes: defaultdict[int, float] = defaultdict(float)
        self._idle: list[int] = []
        self._renders: list[_Task] = []
        self._folds: list[list[_Task]] = [[] for _ in range(workers)]  # whose parts are there
        self._load = [0] * workers  # folds given to it
        for worker in range(workers):
            self._at(costs.begin, self._free, worker)

    # Events -----------------------------------------------------------------------------------------------------------

    def _at(self, when: float, what: Callable[..., None], *arguments: Any) -> None:
        heapq.heappush(self._events, (when, next(self._count), what, arguments))

    def run(self, until: float) -> None:
        """Let happen what happens up to then."""
        while self._events and self._events[0][0] <= until:
            self.now, _, what, arguments = heapq.heappop(self._events)
            what(*arguments)

    def wait(self, task: _Task, patience: float) -> bool:
        """Whether a task is finished within the client's patience; the client's clock goes on until it is."""
        deadline = self.client + patience
        self.run(self.client)
        while not task.finished:
            if not self._events:
                raise RuntimeError("a task was asked for that nobody will do")
            if self._events[0][0] > deadline:
                self.client = deadline
                return False
            self.run(self._events[0][0])
            self.client = max(self.client, self.now)
        return True

    # The client's client ----------------------------------------------------------------------------------------------

    status, scheduler = "running", None

    def submit(self, function: Callable[..., Any], *arguments: Any, priority: int = 0, **_: Any) -> _Task:
        """As `distributed.Client.submit`."""
        if function is cluster_passes.keep:
            return _Task(self, 0, 0.0, finished=True)
        self.client += self.costs.submit + self.workers * self.costs.submit_worker
        if function is cluster_passes.fold:
            task = _Task(self, sum(part.passes for part in arguments), self.costs.fold, arguments, priority)
        else:
            passes = ARITY ** int(arguments[2])
            task = _Task(self, passes, passes * self.of_pass + (passes - 1) * self.costs.add, priority=priority)
        self._at(self.client, self._message, self._asked, task)
        return task

    def receive(self, task: _Task) -> None:
        """Have a node come to the client, which waits for it."""
        self._sends[task.worker] = max(self.client, self._sends[task.worker]) + self.costs.transfer
        if self.costs.relay:
            self._scheduler = max(self._scheduler, self.client) + self.costs.relay
        self.client += self.costs.receive + self.costs.copy

    # Scheduler --------------------------------------------------------------------------------------------------------

    def _message(self, handle: Callable[[_Task], None], task: _Task) -> None:
        cost = (self.costs.task + self.workers * self.costs.task_worker) / 2
        self._scheduler = max(self._scheduler, self.now) + cost
        self._at(self._scheduler, handle, task)

    def _asked(self, task: _Task) -> None:
        for part in task.parts:
            if not part.finished:
                part.dependents.append(task)
                task.waiting += 1
        if not task.waiting:
            self._assign(task)

    def _ended(self, task: _Task) -> None:
        task.finished = True
        for each in task.dependents:
            each.waiting -= 1
            if not each.waiting:
                self._assign(each)

    def _assign(self, task: _Task) -> None:
        if not task.parts:
            heapq.heappush(self._renders, task)
            if self._idle:
                self._begin(self._idle.pop())
            return
        task.worker = min((part.worker for part in task.parts), key=lambda worker: self._load[worker])
        self._load[task.worker] += 1
        away = [part.worker for part in task.parts if part.worker != task.worker]
        task.waiting = len(away)
        for worker in away:
            self._at(self._transfer(self.now, worker, task.worker), self._arrived, task)
        if not away:
            self._ready(task)

    # Workers and links ------------------------------------------------------------------------------------------------

    def _transfer(self, when: float, source: int, target: int) -> float:
        end = max(when, self._sends[source], self._takes[target]) + self.costs.transfer
        self._sends[source] = self._takes[target] = end
        return end

    def _arrived(self, task: _Task) -> None:
        task.waiting -= 1
        if not task.waiting:
            self._ready(task)

    def _ready(self, task: _Task) -> None:
        heapq.heappush(self._folds[task.worker], task)
        if task.worker in self._idle:
            self._idle.remove(task.worker)
            self._begin(task.worker)

    def _free(self, worker: int) -> None:
        if self._folds[worker] or self._renders:
            self._begin(worker)
        else:
            self._idle.append(worker)

    def _begin(self, worker: int) -> None:
        folds, renders = self._folds[worker], self._renders
        own = bool(folds) and (not renders or not renders[0] < folds[0])
        task = heapq.heappop(folds if own else renders)
        if own:
            self._load[worker] -= 1
        task.worker = worker
        self._at(self.now + task.seconds, self._message, self._ended, task)
        self._at(self.now + task.seconds, self._free, worker)


class SimulatedPasses(ClusterPasses):
    """The client's code; only waiting and receiving are the world's."""

    def __init__(self, world: World) -> None:
        """All workers are accepted."""
        self.world = world
        accepted = dict.fromkeys(range(world.workers), 1)
        workers: Any = SimpleNamespace(client=world, accepted=accepted, machines={}, look=lambda: None)
        nothing: Any = None
        super().__init__(workers, nothing, nothing)

    def _next(self, first: int, stop: int, last: int) -> Any:
        while True:
            self.world.client += self.world.costs.look * len(self._begun)
            self._begin(first, stop, last)
            task = self._begun[0].result
            if self.world.wait(task, _POLL):
                break
        self.world.receive(task)
        node, nothing = self._begun.popleft(), np.zeros((0, 0, 1))
        return node, Part(PassSums(1, task.passes, nothing, nothing), {}, task.passes * self.world.of_pass)


def simulate(passes: int, spp: int, workers: int, costs: Costs, scheme: Scheme = PRESENT) -> float:
    """Seconds from the first task to the whole image, of so many passes of `spp` samples per pixel."""
    costs = scheme.costs(costs)
    world, done = World(workers, costs, spp), 0
    source = SimulatedPasses(world)
    while done < passes:
        stop = min(next_stop(done) if done else 1, passes)
        for _, sums, _ in source.nodes(done, stop, passes, 0, spp):
            done += sums.passes
            world.client += costs.add  # in the tree of `LongRender`
    return world.client


def efficiency(passes: int, spp: int, workers: int, costs: Costs, scheme: Scheme = PRESENT) -> float:
    """The share of the workers' time in which they render."""
    return passes * costs.of_pass(spp) / (workers * simulate(passes, spp, workers, costs, scheme))
