"""Planar, times: paths through the lens of document 004, against the number of segments.

Parallel rays cross two boundaries each. The time of a path is that of `Tracer.__call__`, from arrays of rays to arrays
of points, per ray. Sizes run in turn; medians over the rounds are reported, with 95 % intervals. Times depend on the
machine, so they have no budgets. Every segment is tried for every ray: the cost grows like M.
"""

from __future__ import annotations

import time

import numpy as np

from mi_refract.planar import Segments, Tracer, shapes
from mi_refract.planar.curves import affine
from mi_refract.report.row import Row
from validation.run import kernel_timing
from validation.run.array_settings import Setting
from validation.run.context import Context
from validation.study import Study, Task, about

from .against_retrace import by_setting

PER_PATH = "µs per path"
TERMS = {
    PER_PATH: "median time of a path of two boundaries; low, high: its 95 % interval",
    "ms to compile": "time of the first call less that of a later one; 0 where the kernel was in the cache",
    "ms to set up": "once for the segments",
    "M": "number of segments; the original program has 1172",
}
AXES = {"x": "segments", "y": PER_PATH, "x_scale": "log", "y_scale": "log", "slope": None}
NAME = "planar_times"
SEED = 2033
ORIGINAL = 1172  # chords of the original program
SIZES = (0, 10, 100, 1000)  # 0: as many as the original
ROUNDS = {"quick": 6, "standard": 7, "full": 21}
BRUTE = "brute"
FEWER = 256  # times fewer rays than in a stream
BOUNDARIES = 2


def tasks(context: Context) -> list[Task]:
    """One task per backend and precision."""
    return by_setting(context, NAME, "planar, times", "every size", measure, timed=True)


def lens(size: int) -> Segments:
    """The lens of document 004, of `size` chords; 0: of as many as the original."""
    curve = shapes.lens((0.04, -0.04), 16.4, conic=(1.9, 1.9), vertex=-8.2).mapped(affine(90, (1, 4)))
    return curve.faceted(size or ORIGINAL).between(4.4, 1.0)


class Run:
    """A tracer called once; `values`: its setup time, and later measurements."""

    def __init__(self, setting: Setting, size: int, count: int) -> None:
        """`count` rays all over the aperture in which they meet two boundaries."""
        x = np.sort(np.random.default_rng(SEED).uniform(-6, 6, count))
        self.rays = np.stack([x, np.full(count, -100.0)], 1), np.tile([0.0, 1.0], (count, 1))
        self.segments, start = lens(size), time.perf_counter()
        self.tracer = Tracer(self.segments, precision=np.dtype(setting.precision).name, backend=setting.backend)
        self.values = {"ms to set up": 1e3 * (time.perf_counter() - start)}
        self.first = self.clock()

    def clock(self) -> float:
        """Seconds to trace all of its rays."""
        start = time.perf_counter()
        self.tracer(*self.rays, BOUNDARIES)
        return time.perf_counter() - start


def measure(context: Context, setting: Setting) -> list[Row]:
    """A row per size, the last one with the curve."""
    count = context.profile.scalar_rays if setting.is_scalar else max(context.profile.streamed_rays // FEWER, 1)
    sizes = SIZES[:2] if setting.is_scalar else SIZES
    runs = {f"M = {size}" if size else "document 004": Run(setting, size, count) for size in sizes}
    timed = kernel_timing.rounds(runs, Run.clock, ROUNDS[context.profile.name])
    rows: list[Row] = []
    for case, run in runs.items():
        values = kernel_timing.interval(PER_PATH, [t / count * 1e6 for t in timed[case]]) | run.values
        values["ms to compile"] = 1e3 * max(0.0, run.first - float(np.median(timed[case])))
        replay = {"rays": count, "seed": SEED, "segments": len(run.segments)}
        rows.append(Row(NAME, BRUTE, case, setting.label, values, replay=replay))
    rows[-1].curves[BRUTE] = [(float(n), row.values[PER_PATH]) for n, row in zip(sizes, rows, strict=True) if n]
    return rows


STUDY = Study(NAME, "Planar, times", about(__doc__), TERMS, tasks, axes=AXES)
