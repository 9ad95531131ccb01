"""Planar, times: paths through the lens of document 004, against the number of segments.

Parallel rays cross two boundaries each; beyond a thousand segments there are more lenses, and each ray crosses one of
them. The time of a path is the time of `Tracer.__call__`, from arrays of rays to arrays of points, per ray. Methods and
sizes run in turn; the rows have medians over the rounds, with 95 % intervals. Times depend on the machine, so they have
goals instead of budgets; equal bits of both methods are a budget. If the cost grows like log M, each doubling of the
number of segments M adds the same time: a line is fitted through the cost against log₂ M.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mi_refract.planar import Paths, Segments, Tracer, shapes
from mi_refract.planar.curves import affine
from mi_refract.planar.segments import Array
from mi_refract.report.row import Row
from validation import limits
from validation.run import kernel_timing
from validation.run.array_settings import Setting
from validation.run.context import Context
from validation.study import Study, Task, about

from .against_retrace import by_setting

PER_PATH = "µs per path"
TERMS = {
    PER_PATH: "median time of a path of two boundaries; low, high: its 95 % interval",
    "ms to compile": "time of the first call minus that of a later one; 0 if the kernel was in the cache",
    "ms to set up": "time to build the tables and the mesh, once per set of segments",
    "differing": "paths that differ between the two methods in any bit",
    "per doubling": "time that twice as many segments add, over the time at a thousand; from a thousand on",
    "most over a thousand": "time per path with the most segments, over the time with a thousand",
    "shuffled": "rays in random order; otherwise lens by lens, from one side of each to the other",
    "M": "number of segments; the original program has 1172",
}
AXES = {"x": "segments", "y": PER_PATH, "x_scale": "log", "y_scale": "log", "slope": None}
NAME = "planar_times"
SEED = 2033
ORIGINAL = 1172  # chords of the original program
SIZES = (10, 100, 1000, 10_000, 100_000, 1_000_000)
BRUTE_SIZES = (0, 10, 100, 1000)
ROUNDS = {"quick": 6, "standard": 7, "full": 21}
MESH, SHUFFLED, BRUTE = "mesh", "mesh, shuffled", "brute"
# The method, whether rays are shuffled, and the divisor of their number.
METHODS = {MESH: (MESH, False, 1), SHUFFLED: (MESH, True, 16), BRUTE: (BRUTE, False, 64)}
BOUNDARIES = 2


def tasks(context: Context) -> list[Task]:
    """Return one task per backend and precision."""
    return by_setting(context, NAME, "planar, times", "every size", _setting_rows, timed=True)


def _setting_rows(context: Context, setting: Setting) -> list[Row]:
    sizes = SIZES[:3] if context.profile.quick else SIZES
    return measure(context, setting, SIZES[:1] if setting.is_scalar else sizes)


@dataclass(frozen=True)
class Field:
    """A grid of `side`² copies of the lens; their centres are whole multiples of `pitch` (2,)."""

    segments: Segments
    side: int
    pitch: Array

    def beam(self, count: int, shuffled: bool) -> tuple[Array, Array]:
        """Return rays along the axes of random lenses, over the aperture in which rays cross two boundaries."""
        rng = np.random.default_rng(SEED)
        lens = np.sort(rng.integers(0, self.side**2, count))
        x = rng.uniform(-6, 6, count)
        x = x[np.lexsort([x, lens])] + self.pitch[0] * (lens % self.side)
        origins = np.stack([x, self.pitch[1] * (lens // self.side - 0.5)], 1)
        return rng.permutation(origins) if shuffled else origins, np.tile([0.0, 1.0], (count, 1))


@functools.cache
def field(size: int) -> Field:
    """Return about `size` segments, on lenses of a thousand; 0: one lens with as many chords as the original."""
    side = max(1, round(math.sqrt(size / 1000)))
    lens = shapes.lens((0.04, -0.04), 16.4, conic=(1.9, 1.9), vertex=-8.2).mapped(affine(90, (1, 4)))
    curve = lens.faceted(size // side**2 if size else ORIGINAL)
    pitch = 1.2 * np.ptp(curve.vertices, axis=0)
    places = pitch * np.stack(np.meshgrid(*[np.arange(side)] * 2), 2).reshape(-1, 1, 2)
    start, end = ((places + x).reshape(-1, 2) for x in (curve.start, curve.end))
    media = np.full(len(start), 4.4), np.ones(len(start))
    return Field(Segments(start, end, *media), side, pitch)


def measure(context: Context, setting: Setting, sizes: tuple[int, ...]) -> list[Row]:
    """Return a row per method and size, and a row of the curves."""
    count = context.profile.scalar_rays if setting.is_scalar else context.profile.streamed_rays // 4
    pairs = [(m, s) for s in (0, *sizes) for m in METHODS if m != BRUTE or s in BRUTE_SIZES]
    tracers = functools.cache(functools.partial(_tracer, setting))
    runs = {f"{method}, {size}": Run(tracers, method, size, count) for method, size in pairs}
    for name, seconds in kernel_timing.rounds(runs, Run.clock, ROUNDS[context.profile.name]).items():
        runs[name].take(seconds)
    rows = [_row(setting, run, runs.get(f"{BRUTE}, {run.size}")) for run in runs.values()]
    return rows if setting.is_scalar else [*rows, _growth_row(setting, list(runs.values()))]


def _row(setting: Setting, run: Run, brute: Run | None) -> Row:
    case, budgets, goals = f"M = {run.size}" if run.size else "document 004", {}, {}
    if run.method == MESH:
        goals = limits.PLANAR_TIMES.get((setting.label, case), {})
        if brute:
            run.values["differing"] = float(differing(run.tracer(*brute.rays, BOUNDARIES), brute.paths()))
            budgets = {"differing": 0.0}
    replay = {"rays": len(run.rays[0]), "seed": SEED, "segments": len(field(run.size).segments)}
    return Row(NAME, run.method, case, setting.label, run.values, budgets, goals, replay=replay)


def _tracer(setting: Setting, method: str, size: int) -> tuple[Tracer, float]:
    """Return a tracer, and the seconds to build it."""
    segments, precision, start = field(size).segments, np.dtype(setting.precision).name, time.perf_counter()
    tracer = Tracer(segments, precision=precision, backend=setting.backend, method=method)
    return tracer, time.perf_counter() - start


class Run:
    """A tracer that was called once; `values`: its setup time, and later measurements."""

    def __init__(self, tracers: Callable[[str, int], tuple[Tracer, float]], method: str, size: int, count: int) -> None:
        """`tracers(method, size)` returns a tracer and the seconds to build it. `count`: rays of fast methods."""
        kind, shuffled, divisor = METHODS[method]
        self.method, self.size = method, size
        self.rays = field(size).beam(max(count // divisor, 1), shuffled)
        self.tracer, seconds = tracers(kind, size)
        self.values = {"ms to set up": seconds * 1e3}
        self.first = self.clock()

    def take(self, seconds: list[float]) -> None:
        """Set `values` from the times of later calls."""
        self.values = kernel_timing.interval(PER_PATH, [t / len(self.rays[0]) * 1e6 for t in seconds]) | self.values
        self.values["ms to compile"] = 1e3 * max(0.0, self.first - float(np.median(seconds)))

    def paths(self) -> Paths:
        """Trace all rays."""
        return self.tracer(*self.rays, BOUNDARIES)

    def clock(self) -> float:
        """Return the seconds to trace all rays."""
        start = time.perf_counter()
        self.paths()
        return time.perf_counter() - start


def differing(some: Paths, others: Paths) -> int:
    """Return the number of rays with a point, a direction, a hit or an event that differs in any bit."""
    same = np.ones(len(some.hits), bool)
    for name in ("points", "directions", "hits", "events"):
        x, y = (np.ascontiguousarray(getattr(paths, name)) for paths in (some, others))
        bits = np.dtype(f"u{x.dtype.itemsize}")
        same &= (x.view(bits) == y.view(bits)).reshape(len(same), -1).all(1)
    return int((~same).sum())


def _growth_row(setting: Setting, runs: list[Run]) -> Row:
    """Return the row of µs per path against the number of segments, by method."""
    curves = {
        method: [(float(run.size), run.values[PER_PATH]) for run in runs if run.method == method and run.size]
        for method in METHODS
    }
    size, cost = np.array([point for point in curves[MESH] if point[0] >= 1000]).T
    slope = np.polyfit(np.log2(size), cost, 1)[0]
    growth = {"per doubling": float(slope / cost[0]), "most over a thousand": float(cost[-1] / cost[0])}
    return Row(NAME, "every method", PER_PATH, setting.label, growth, curves=curves)


STUDY = Study(NAME, "Planar, times", about(__doc__), TERMS, tasks, axes=AXES)
