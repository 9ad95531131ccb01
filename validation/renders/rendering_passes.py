"""Renders in passes: is their estimated error right, do they stop where they should, and what do passes cost?

Small renders, each with its own seed, end by `--until` at the error that 12 passes have on average: there an estimate
ends a render by chance. Their true error is measured against a render of a hundred times as many samples. With 95 %
probability it is below the error asked for, by the method's own claim. The budget is the largest count that has a
probability of more than 0.001 then, so that the study fails by chance once in 1000 runs.

One call of `mi.render` and as many samples in passes take turns; the ratio is of processor time. A render in passes
ends with a file of its image and variance. The second ratio is that to a call whose image is written, too.
"""

from __future__ import annotations

import functools
import math
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io.image_file import write_exr
from mi_refract.plugins import PLUGIN
from mi_refract.rendering import end_conditions
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, LongRender, resume
from mi_refract.report.row import Row
from validation import limits
from validation.run.context import SCENES, Context
from validation.run.render_methods import under
from validation.study import Study, Task, about

ONE_CALL, WRITTEN = "time of passes / one call", "time of passes / one call, written"
TERMS = {
    "renders": "small ones, each with its own seed",
    "beyond": "renders whose true error is above the one they ended by",
    "outside": "renders whose true error is outside the interval that they state",
    "stated / true": "the mean of the squared errors that are stated, over that of the true ones",
    "passes": "that a render took on average",
    ONE_CALL: "processor time; median of alternating pairs; low, high: their extremes",
    WRITTEN: "the same, to one call and the time to write its image; median",
}
NAME = "passes"
COUNTS = {"quick": 20, "standard": 100, "full": 500}  # renders of each scene
STILLS = ("sphere", "nested")
RESOLUTION, PASS_SPP = 24, 2
REFERENCE = 100  # times the samples of 12 passes: 1 % of their squared error
PAIRS = {"quick": 0, "standard": 7, "full": 9}
TIMED_SPP = {"quick": (), "standard": (64, 256), "full": (64, 256, 1024)}


def tasks(context: Context) -> list[Task]:
    """One per scene for the errors, and one for the time."""
    if context.variant.startswith("scalar"):
        reason = "scalar variants render by `mi.render`, a hundred times as slowly"
        return [Task(NAME, lambda: [Row(NAME, "until", "scenes", context.variant, reason=reason)])]
    errors = [Task(f"passes: {name}", functools.partial(error_rows, context, name)) for name in STILLS]
    return errors + [
        Task(f"passes: time, {spp} spp", functools.partial(time_rows, context, spp), timed=True)
        for spp in TIMED_SPP[context.profile.name]
    ]


@dataclass(frozen=True)
class _Still:
    """A small scene, loaded once for all its renders."""

    job: Job
    folder: Path

    def render(self, seed: int, given: Limits) -> LongRender:
        """One render of it from its first pass to its end."""
        job = Job(self.job.scene, self.job.defines, seed)
        found = resume(job, self.folder / "image.exr", given, restart=True)
        found.run()
        return found


@contextmanager
def _still(context: Context, name: str) -> Iterator[_Still]:
    with under(context.variant), tempfile.TemporaryDirectory() as folder:
        defines = {"res": str(RESOLUTION), "bsdf": PLUGIN}
        yield _Still(Job(SCENES / f"{name}.xml", defines), Path(folder))


def error_rows(context: Context, name: str, seed: int = 0) -> list[Row]:
    """One row: how often the errors of many renders are what they say."""
    count = COUNTS[context.profile.name]
    with _still(context, name) as still:
        reference = still.render(2**31 + seed, Limits(spp=12 * PASS_SPP * REFERENCE, pass_spp=64)).image()
        assert reference is not None
        twelve = still.render(2**31 + seed + 1, Limits(spp=96 * PASS_SPP, pass_spp=PASS_SPP)).error()
        assert twelve is not None
        asked = twelve.value * math.sqrt(96 / 12)
        seeds = range(seed * count + 1, (seed + 1) * count + 1)
        found = np.array([_errors(still.render(s, Limits(until=asked, pass_spp=PASS_SPP)), reference) for s in seeds])
    true, stated, low, high, passes = found.T
    values = {
        "renders": float(count),
        "beyond": float((true > asked).sum()),
        "outside": float(((true < low) | (true > high)).sum()),
        "stated / true": float((stated**2).mean() / (true**2).mean()),
        "passes": float(passes.mean()),
    }
    most = _most(count)
    replay = {"scene": name, "resolution": RESOLUTION, "asked": asked, "seeds": [seeds[0], seeds[-1]]}
    budgets = {"beyond": most, "outside": most}
    return [Row(NAME, "--until", name, context.variant, values, budgets, replay=replay)]


def _errors(render: LongRender, reference: np.ndarray) -> tuple[float, float, float, float, int]:
    """True error, stated error with its interval, and passes."""
    image, stated = render.image(), render.error()
    assert image is not None and stated is not None
    true = math.sqrt(np.mean((image - reference) ** 2)) / abs(reference.mean())
    return true, stated.value, stated.low, stated.high, render.progress.passes


def _most(count: int) -> float:
    """Of so many renders the largest number that may be beyond."""
    from scipy.stats import binom

    return float(binom.ppf(1 - limits.STOPPED_WRONGLY, count, 1 - end_conditions.LEVEL))


def time_rows(context: Context, spp: int) -> list[Row]:
    """One row: processor time of a render in passes over that of one call."""
    import mitsuba as mi

    ratios = []
    with under(context.variant), tempfile.TemporaryDirectory() as folder:
        job, output = Job(SCENES / "sphere.xml", {"res": "512", "bsdf": PLUGIN}), Path(folder) / "passes.exr"
        one = Path(folder) / "one.exr"
        for _ in range(PAIRS[context.profile.name] + 1):
            passes = resume(job, output, Limits(spp=spp), restart=True)
            called, image = _timed(lambda scene=passes.scene: np.array(mi.render(scene, spp=spp)))
            written, _ = _timed(lambda image=image: write_exr(one, image))
            in_passes, _ = _timed(passes.run)
            ratios.append((in_passes / called, in_passes / (called + written)))
    low, middle, high = np.quantile(ratios[1:], (0, 0.5, 1), axis=0)  # the first pair compiles
    values = {ONE_CALL: middle[0], "low": low[0], "high": high[0], WRITTEN: middle[1]}
    replay = {"scene": "sphere", "resolution": image.shape[0], "spp": spp, "pairs": len(ratios) - 1}
    values = {name: float(value) for name, value in values.items()}
    goals = {ONE_CALL: limits.PASSES_TIME}
    return [Row(NAME, f"{spp} spp", "sphere", context.variant, values, goals=goals, replay=replay)]


def _timed(work: Any) -> tuple[float, Any]:
    start = time.process_time()
    found = work()
    return time.process_time() - start, found


STUDY = Study(NAME, "Passes", about(__doc__), TERMS, tasks)
