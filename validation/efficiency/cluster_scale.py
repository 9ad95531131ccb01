"""Scale: on how many workers of a cluster a render in passes is worth while.

Measured here: what a pass, a fold, a message to the scheduler, a node sent and the begin of a worker cost. From these a
model and a simulation say how long 1080p at 65,536 samples per pixel takes on 1 to 10,000 workers of one thread each.
The efficiency is the time of all passes on one worker over workers × time; it counts the scene and its kernels on every
worker, and not the start of its process. Links between machines are assumed to carry 10 Gbit/s, or what Dask reached
between two processes here, if that is less. Besides the package as it is two cases are shown: that a worker is refused,
and that the client cannot reach the workers. Both models are compared with local processes that sleep instead of
rendering.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import Any

from mi_refract.rendering.pass_plan import usual_spp
from mi_refract.report.number_text import compact
from mi_refract.report.row import Row
from validation import limits
from validation.efficiency import cluster_costs, cluster_model, cluster_processes, cluster_simulation
from validation.efficiency.cluster_model import PRESENT, SCHEMES, Costs, Prediction, Scheme
from validation.run.context import Context
from validation.study import Study, Task, about

NAME = "cluster_scale"
EFFICIENCY, LOST, REACH, BEST = "efficiency", "efficiency lost", "workers at ≥ 0.9", "best pass spp"
STARTED = "with processes"
OFF = "|simulated − measured|"
TERMS = {
    EFFICIENCY: "time of all passes on one worker / (workers × time); lost: 1 − efficiency",
    REACH: "the most workers up to which the model's efficiency is 0.9 or more",
    BEST: "samples per pixel of the pass, a power of two up to 512, with which the model ends first",
    STARTED: "the efficiency where the workers' processes are started with the render",
    "fixed": "CPU seconds of a pass of 1080p beside its samples; sample: for each sample in every pixel, one thread",
    "process": "CPU seconds of a new process until Mitsuba is imported; scene: to load it; kernels: to compile them",
    "task": "CPU seconds of the scheduler for a task; _worker: more for each worker listed; submit: of the client",
    "relay": "CPU seconds of the scheduler for a node that goes through it to the client; receive: the client's",
    "look": "CPU seconds of the client for each node that is begun and each worker, whenever a node comes",
    cluster_model.PRESENT.name: "all workers are accepted, and the client receives nodes from them",
    cluster_model.LISTED.name: "then each task lists those that are accepted",
    cluster_model.RELAYED.name: "then nodes reach the client through the scheduler",
}
AXES = {"x": "workers", "y": EFFICIENCY, "y_scale": "linear"}
TOTAL = 65_536  # samples per pixel
SCENES = ("sphere", "diamond")  # a cheap and an expensive one
PASS = usual_spp(1920 * 1080)  # samples per pixel
PASSES, LARGEST = (1, 4, 16), 512  # those of the curves, and the largest that is tried
USUAL_LIMIT = f"; with {PASS} it is "
TABLED = (PRESENT,)
SHOWN = (10, 100, 1000, 10_000)
GRID = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)
SIMULATED = {"standard": (1, 10, 100, 1000), "full": (1, 10, 100, 1000, 10_000)}
GOAL = 1000  # workers
SLEEP, EACH = 0.1, 40  # seconds of a pass, and passes for each process
PROCESSES = (1, 2, 4, 8)
SCALAR = "needs a compiled variant: a scalar one's pass takes minutes"


def tasks(context: Context) -> list[Task]:
    """Costs and model; in the profiles `standard` and `full` the simulation and the processes, too."""
    named: dict[str, Callable[[Context], list[Row]]] = {"costs": cost_rows, "model": model_rows}
    if not context.profile.quick:
        named |= {"simulation": simulated_rows, "processes": process_rows}
    return [
        Task(f"cluster scale: {name}", functools.partial(_rows, context, run), timed=True)
        for name, run in named.items()
    ]


def _rows(context: Context, run: Callable[[Context], list[Row]]) -> list[Row]:
    reason = SCALAR if context.variant.startswith("scalar") else ""
    try:
        return run(context) if not reason else [Row(NAME, "every scheme", "", context.variant, reason=reason)]
    except (ImportError, ConnectionError) as error:
        return [Row(NAME, "every scheme", "", context.variant, reason=str(error))]


@functools.cache
def found(profile: str) -> dict[str, dict[str, float]]:
    """All costs by scene."""
    extent = cluster_costs.EXTENTS[profile]
    shared = cluster_costs.shared(extent)
    return {scene: cluster_costs.measured(scene, shared, extent) for scene in SCENES}


def costs_of(context: Context, *, process: bool = False) -> dict[str, Costs]:
    """By scene, for the model."""
    return {
        scene: cluster_costs.as_costs(costs, process=process) for scene, costs in found(context.profile.name).items()
    }


def cost_rows(context: Context) -> list[Row]:
    """A row per scene."""
    busy = {"load average": os.getloadavg()[0], "threads": os.cpu_count()}
    return [
        Row(NAME, scene, "costs", "measured here", dict(costs), replay=busy)
        for scene, costs in found(context.profile.name).items()
    ]


# Model ----------------------------------------------------------------------------------------------------------------


@functools.cache
def predicted(spp: int, workers: int, costs: Costs, scheme: Scheme) -> Prediction:
    """Of TOTAL samples per pixel."""
    return cluster_model.predict(-(-TOTAL // spp), spp, workers, costs, scheme)


def best_pass(workers: int, costs: Costs, scheme: Scheme) -> tuple[int, Prediction]:
    """The samples per pixel of a pass, a power of two up to LARGEST, with which TOTAL of them end first."""
    sizes = [1 << k for k in range(LARGEST.bit_length())]
    return min(((spp, predicted(spp, workers, costs, scheme)) for spp in sizes), key=lambda each: each[1].seconds)


def model_rows(context: Context) -> list[Row]:
    """By scene and scheme: efficiencies by pass size, the best pass by workers, curves."""
    costs, started = costs_of(context), costs_of(context, process=True)
    rows = []
    for scene in SCENES:
        for scheme in TABLED:
            rows += [_size_row(scene, scheme, spp, costs[scene]) for spp in PASSES]
            rows += [_best_row(scene, scheme, workers, costs[scene], started[scene]) for workers in SHOWN]
            curves = _curves(costs[scene], scheme)
            most = {"best": max(y for points in curves.values() for x, y in points if x == GOAL)}
            rows.append(Row(NAME, scheme.name, f"{scene}: model", "curves", most, curves=curves))
    return rows


def _size_row(scene: str, scheme: Scheme, spp: int, costs: Costs) -> Row:
    by_workers = {workers: predicted(spp, workers, costs, scheme) for workers in GRID}
    values = {f"{EFFICIENCY}, {w}": by_workers[w].efficiency for w in SHOWN}
    reach = max((w for w in GRID if all(by_workers[v].efficiency >= 0.9 for v in GRID if v <= w)), default=0)
    beyond = next((w for w in GRID if w > reach), None)
    remark = f"on {beyond} workers the limit is {by_workers[beyond].limit}" if beyond else ""
    return Row(NAME, scheme.name, f"{scene}, {spp} spp a pass", "model", values | {REACH: reach}, reason=remark)


def _best_row(scene: str, scheme: Scheme, workers: int, costs: Costs, started: Costs) -> Row:
    spp, best = best_pass(workers, costs, scheme)
    usual = predicted(PASS, workers, costs, scheme)
    values = {
        EFFICIENCY: best.efficiency,
        BEST: float(spp),
        "seconds": best.seconds,
        STARTED: predicted(spp, workers, started, scheme).efficiency,
        f"{EFFICIENCY}, {PASS} spp": usual.efficiency,
    }
    remark = f"with {spp} spp a pass the limit is {best.limit}{USUAL_LIMIT}{usual.limit}"
    replay = {f"seconds, {name}": round(seconds, 3) for name, seconds in best.parts.items()}
    return Row(
        NAME, scheme.name, f"{scene}, {workers} workers", "model, best pass", values, reason=remark, replay=replay
    )


def _curves(costs: Costs, scheme: Scheme) -> dict[str, list[tuple[float, float]]]:
    found = {f"{n} spp a pass": [(float(w), predicted(n, w, costs, scheme).efficiency) for w in GRID] for n in PASSES}
    best = [(float(w), best_pass(w, costs, scheme)[1].efficiency) for w in GRID]
    return found | {"best pass": best}


# Simulation -----------------------------------------------------------------------------------------------------------


def simulated_rows(context: Context) -> list[Row]:
    """By scene, scheme and number of workers; of the last scheme with the best pass, too."""
    rows = []
    for scene, costs in costs_of(context).items():
        for scheme in SCHEMES:
            for workers in SIMULATED[context.profile.name] if scheme in TABLED else (GOAL,):
                rows.append(simulated_row(scene, scheme, workers, costs, PASS))
        best, _ = best_pass(GOAL, costs, PRESENT)
        if best != PASS:
            rows.append(simulated_row(scene, PRESENT, GOAL, costs, best))
    return rows


def simulated_row(scene: str, scheme: Scheme, workers: int, costs: Costs, spp: int) -> Row:
    """One simulation; a goal for GOAL workers."""
    efficiency = cluster_simulation.efficiency(-(-TOTAL // spp), spp, workers, costs, scheme)
    model = predicted(spp, workers, costs, scheme)
    values = {EFFICIENCY: efficiency, LOST: 1 - efficiency, "model": model.efficiency}
    goals = {LOST: limits.CLUSTER_LOST} if workers == GOAL else {}
    case = f"{scene}, {spp} spp a pass, {workers} workers"
    return Row(NAME, scheme.name, case, "simulated", values, goals=goals, reason=f"the limit is {model.limit}")


def process_rows(context: Context) -> list[Row]:
    """By number of processes, of passes that sleep."""
    scheme, known = PRESENT, next(iter(found(context.profile.name).values()))
    costs = Costs(fixed=SLEEP, **{n: known[n] for n in ("task", "task_worker", "submit", "submit_worker", "look")})
    rows = []
    for workers in PROCESSES:
        passes = EACH * workers
        values = cluster_processes.measured(workers, passes, SLEEP)
        simulated = cluster_simulation.efficiency(passes, 1, workers, costs, scheme)
        values |= {
            "simulated": simulated,
            "model": cluster_model.predict(passes, 1, workers, costs, scheme).efficiency,
            OFF: abs(simulated - values[EFFICIENCY]),
        }
        replay: dict[str, Any] = {"passes": passes, "seconds of a pass": SLEEP, "load average": os.getloadavg()[0]}
        goals = {OFF: limits.CLUSTER_PREDICTED}
        case = f"{workers} processes"
        rows.append(Row(NAME, scheme.name, case, "measured here", values, goals=goals, replay=replay))
    return rows


def table(rows: list[Row]) -> tuple[str, list[str], list[list[str]]]:
    """For the README: text, heading, and by scene and workers the efficiency with the usual pass and the best one."""
    found = [row for row in rows if row.study == NAME and row.subject == PRESENT.name and BEST in row.values]
    if not found:
        raise ValueError("README: no scale was modelled; its table needs a compiled variant and Dask")
    cells = []
    for row in found:
        best = f"{compact(row.values[EFFICIENCY])} ({row.values[BEST]:.0f} spp)"
        limit = row.reason.rpartition(USUAL_LIMIT)[2]
        cells.append([row.case, compact(row.values[f"{EFFICIENCY}, {PASS} spp"]), limit, best])
    heading = ["scene, workers", f"{PASS} spp a pass", "its limit", "best pass"]
    return f"1080p at {TOTAL:,} spp, workers of one thread; by the model, with costs measured here.", heading, cells


STUDY = Study(NAME, "Scale on a cluster", about(__doc__), TERMS, tasks, axes=AXES)
