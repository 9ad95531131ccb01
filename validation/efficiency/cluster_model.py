"""How long a render takes on many workers: a formula, from the cost of each thing that is done for it.

    efficiency = P c / (W t),    t = S + max(workers, links, scheduler, client) + end

P passes of c seconds each on W workers. What is done beside each other counts by its largest part:

    workers    the tasks, each given to the worker that is free first: ⌈T/W⌉ where all T are alike; F folds over W
    links      7 of 8 nodes of each fold go to another worker, at b bytes a second in each direction of each worker
    scheduler  (T + F) (s + s′ W): one task after the other; s′ where each task lists the workers that may run it;
               and r for each of N nodes, where these reach the client through it
    client     (T + F) (q + q′ W) to ask, and of each of N nodes its way here, a copy, a sum, and a look at all others

`end`: the folds of the last node, one level after the other, and its way to the client. S: what a worker does before
its first pass. What this leaves out only makes t longer: so it is a bound, which the simulation comes near.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from mi_refract.rendering.cluster_passes import AHEAD, LEVELS, NODE_SECONDS, NODES, TASK_SECONDS
from mi_refract.rendering.pass_plan import next_stop
from mi_refract.rendering.pass_sums import ARITY

PARTS = ("workers", "links", "scheduler", "client")


@dataclass(frozen=True)
class Costs:
    """Seconds of one thing each, where nothing else is said; the film is the same for all.

    `fixed`, `sample`: of a pass, beside its samples and for one sample in every pixel. `copy`, `add`: of a node's
    arrays. `bandwidth`: bytes a second of a link. `task`, `task_worker`: s and s′; `submit`, `submit_worker`: q and q′.
    `look`: the client's, for each node that is begun, whenever a node comes. `begin`: S.
    """

    fixed: float = 0.0
    sample: float = 0.0
    copy: float = 0.0
    add: float = 0.0
    node_bytes: float = 0.0
    bandwidth: float = math.inf
    task: float = 0.0
    task_worker: float = 0.0
    submit: float = 0.0
    submit_worker: float = 0.0
    look: float = 0.0
    relay: float = 0.0
    receive: float = 0.0
    begin: float = 0.0

    @property
    def transfer(self) -> float:
        """Of a node from one process to another."""
        return self.node_bytes / self.bandwidth

    @property
    def fold(self) -> float:
        """Of ARITY nodes that are there."""
        return self.copy + (ARITY - 1) * self.add

    def of_pass(self, spp: int) -> float:
        """On one worker."""
        return self.fixed + spp * self.sample


@dataclass(frozen=True)
class Scheme:
    """What is asked of the cluster.

    `listed`: each task lists its workers, as it must where one of those present is refused. `relayed`: nodes reach the
    client through the scheduler, as they must where it cannot reach the workers; instead of over its own link.
    """

    name: str
    listed: bool = False
    relayed: bool = False

    def costs(self, costs: Costs) -> Costs:
        """Those that remain."""
        if not self.listed:
            costs = replace(costs, task_worker=0.0, submit_worker=0.0)
        return costs if self.relayed else replace(costs, relay=0.0, receive=costs.transfer)


PRESENT = Scheme("as it is")
LISTED = Scheme("a worker is refused", listed=True)
RELAYED = Scheme("workers out of reach", relayed=True)
SCHEMES = (PRESENT, LISTED, RELAYED)


@dataclass(frozen=True)
class Prediction:
    """Of a render on `workers`: seconds of each of PARTS, `begin` and `end`, and the work of one worker alone."""

    workers: int
    work: float
    parts: dict[str, float]
    begin: float
    end: float

    @property
    def seconds(self) -> float:
        """From the first task to the whole image."""
        return self.begin + max(self.parts.values()) + self.end

    @property
    def efficiency(self) -> float:
        """The share of the workers' time in which they render."""
        return self.work / (self.workers * self.seconds) if self.seconds else 1.0

    @property
    def limit(self) -> str:
        """What most of the lost time is due to."""
        busy = self.work / self.workers
        part = max(self.parts, key=lambda name: self.parts[name])
        lost = {f"the {part}" if part != "workers" else "granularity and folds": self.parts[part] - busy}
        lost |= {"the begin of workers": self.begin, "the folds at the end": self.end}
        return max(lost, key=lambda name: lost[name])


def levels(seconds: float, workers: int) -> tuple[int, int]:
    """Of a task and of a node, once a pass is known to take so many seconds: as `ClusterPasses.levels`."""
    task = max((k for k in range(LEVELS) if ARITY**k * seconds <= TASK_SECONDS), default=0)
    node = max((k for k in range(LEVELS + 1) if ARITY**k * seconds <= NODE_SECONDS * workers), default=0)
    return min(task, node), max(node, first_level(workers))


def first_level(workers: int) -> int:
    """Of the nodes that are asked for before: of no more passes than there are workers."""
    return max(k for k in range(LEVELS + 1) if workers >= ARITY**k)


def asked(passes: int, seconds: float, workers: int) -> Iterator[tuple[int, int]]:
    """The nodes that the client asks for, in order: (level of their tasks, their own level)."""
    begin, stop, count = 0, min(1, passes), 0
    while begin < passes:
        while stop <= begin:
            stop = min(next_stop(stop), passes)
        task, largest = levels(seconds, workers) if count >= AHEAD * workers else (0, first_level(workers))
        level = _level(begin, stop, largest)
        task = min(task, level)
        yield task, level
        count += ARITY ** (level - task)
        begin += ARITY**level


def _level(begin: int, stop: int, largest: int) -> int:
    """Of the first of `aligned_nodes`."""
    level = 0
    while level < largest and begin % (size := ARITY ** (level + 1)) == 0 and begin + size <= stop:
        level += 1
    return level


def predict(passes: int, spp: int, workers: int, costs: Costs, scheme: Scheme = PRESENT) -> Prediction:
    """So many passes of `spp` samples per pixel."""
    costs, c = scheme.costs(costs), costs.of_pass(spp)
    nodes = list(asked(passes, c, workers))
    sizes = [ARITY**task for task, level in nodes for _ in range(ARITY ** (level - task))]
    folds = sum(_folds(level - task) for task, level in nodes)
    tasks, begun = len(sizes) + folds, min(len(nodes), max(NODES, AHEAD * workers))
    per_node = costs.receive + costs.copy + costs.add + costs.look * begun
    inner = (passes - len(sizes)) * costs.add
    parts = {
        "workers": _makespan(sizes, workers) * c + (folds * costs.fold + inner) / workers,
        "links": folds * (ARITY - 1) * costs.transfer / workers,
        "scheduler": tasks * (costs.task + workers * costs.task_worker) + len(nodes) * costs.relay,
        "client": tasks * (costs.submit + workers * costs.submit_worker) + len(nodes) * per_node,
    }
    task, level = nodes[-1]
    end = (level - task) * ((ARITY - 1) * costs.transfer + costs.fold) + costs.receive + costs.copy + costs.add
    return Prediction(workers, passes * c, parts, costs.begin, end)


def _folds(levels: int) -> int:
    """Of a tree with so many levels above its tasks: 1 + 8 + 64 …"""
    return sum(ARITY**k for k in range(levels))


def _makespan(sizes: list[int], workers: int) -> float:
    """Passes of the worker that has most, where each task goes to the one that is free first."""
    if len(set(sizes)) == 1:
        return -(-len(sizes) // workers) * sizes[0]
    free = [0] * min(workers, len(sizes))
    for size in sizes:
        heapq.heapreplace(free, free[0] + size)
    return max(free)
