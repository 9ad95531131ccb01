"""Renders in passes: is their estimated error correct, do they stop at the requested error, and what do passes cost?

Small renders, each with its own seed, stop by `--until` as soon as the upper end of the error's interval is below the
requested error, which is the average of these ends after 12 passes. So chance decides whether a render stops after 12
or after 16 passes. Their true error is measured against a render with a hundred times as many samples. The method
claims that it is below the requested error with 95 % probability. The budget is the largest number of exceptions that
then has a probability above 0.001. There are two such budgets in each of two scenes, and in each of them the renders of
`quick` stop alike once in 7000 runs, so the study fails by chance at most once in 230 runs.

Times are CPU times of a render in passes over one call of `mi.render` with as many samples, alternating. A render in
passes writes a file with its image and variance; the second ratio is to a call with the time to write its image.
"""

from __future__ import annotations

import functools
import math
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io.image_file import write_exr
from mi_refract.plugins import PLUGIN
from mi_refract.rendering.end_conditions import LEVEL, Limits
from mi_refract.rendering.long_render import Job, resume
from mi_refract.report.row import Row
from validation import limits
from validation.run.context import SCENES, Context
from validation.run.render_methods import under
from validation.study import Study, Task, about

ONE_CALL, WRITTEN = "time of passes / one call", "time of passes / one call, written"
ALIKE = "stopped alike"
TERMS = {
    "renders": "number of small renders, each with its own seed",
    "beyond": "renders whose true error is above the requested one",
    "outside": "renders whose true error is outside their estimated interval",
    "stated / true": "the mean of the estimated squared errors, over that of the true ones",
    "passes": "mean number of passes of a render",
    ALIKE: "largest share of the renders that end with the same number of passes; half of them if chance decides",
    ONE_CALL: "CPU time; median of alternating pairs; low, high: their extremes",
    WRITTEN: "the same, over one call and the time to write its image; median",
}
NAME = "passes"
COUNTS = {"quick": 20, "standard": 100, "full": 500}  # renders of each scene
STILLS = ("sphere", "nested")
RESOLUTION, PASS_SPP = 24, 2
REFERENCE = 100  # times the samples of 12 passes: it adds 1 % to their squared error
ASKED = 16  # renders whose average decides the requested error: known to a quarter of the spread of one
PAIRS = {"quick": 0, "standard": 7, "full": 9}
TIMED_SPP = {"quick": (), "standard": (64, 256), "full": (64, 256, 1024)}


def tasks(context: Context) -> list[Task]:
    """Return one task per scene for the errors, and one per sample count for the time."""
    if context.variant.startswith("scalar"):
        reason = "scalar variants render by `mi.render`, a hundred times as slowly"
        return [Task(NAME, lambda: [Row(NAME, "until", "scenes", context.variant, reason=reason)])]
    errors = [Task(f"passes: {name}", functools.partial(error_rows, context, name)) for name in STILLS]
    return errors + [
        Task(f"passes: time, {spp} spp", functools.partial(time_rows, context, spp), timed=True)
        for spp in TIMED_SPP[context.profile.name]
    ]


def error_rows(context: Context, name: str) -> list[Row]:
    """Return one row: how often the true errors of many renders agree with the estimated ones."""
    from scipy.stats import binom

    count, table = COUNTS[context.profile.name], []
    defines = {"res": str(RESOLUTION), "bsdf": PLUGIN}
    with under(context.variant), tempfile.TemporaryDirectory() as folder:

        def render(seed: int, **ends: Any) -> Any:
            """Return a finished render of the scene."""
            job = Job(SCENES / f"{name}.xml", defines, seed)
            finished: Any = resume(job, Path(folder) / "image.exr", Limits(**ends), restart=True)
            finished.run()
            return finished

        first = 2**31
        reference = render(first, spp=12 * PASS_SPP * REFERENCE, pass_spp=64).image()
        after_12 = (render(first + 1 + i, spp=12 * PASS_SPP, pass_spp=PASS_SPP).error() for i in range(ASKED))
        requested = float(np.mean([error.high for error in after_12]))
        seeds = range(1, count + 1)
        for one in (render(seed, until=requested, pass_spp=PASS_SPP) for seed in seeds):
            stated = one.error()
            true = math.sqrt(np.mean((one.image() - reference) ** 2)) / abs(reference.mean())
            table.append((true, stated.value, stated.low, stated.high, one.progress.passes))
    true, stated, low, high, passes = np.array(table).T
    values = {
        "renders": float(count),
        "beyond": float((~(true <= requested)).sum()),  # also NaN
        "outside": float((~((true >= low) & (true <= high))).sum()),
        "stated / true": float((stated**2).mean() / (true**2).mean()),
        "passes": float(passes.mean()),
        ALIKE: float(np.unique(passes, return_counts=True)[1].max() / count),
    }
    allowed = float(binom.ppf(1 - limits.STOPPED_WRONGLY, count, 1 - LEVEL))
    replay = {"scene": name, "resolution": RESOLUTION, "asked": requested, "seeds": [seeds[0], seeds[-1]]}
    budgets = {"beyond": allowed, "outside": allowed, ALIKE: limits.STOPPED_ALIKE}
    return [Row(NAME, "--until", name, context.variant, values, budgets, replay=replay)]


def time_rows(context: Context, spp: int) -> list[Row]:
    """Return one row: CPU time of a render in passes over that of one call."""
    import mitsuba as mi

    def timed(work: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
        start = time.process_time()
        result = work(*arguments)
        return time.process_time() - start, result

    def image_of(scene: Any) -> np.ndarray:
        return np.array(mi.render(scene, spp=spp))

    ratios = []
    with under(context.variant), tempfile.TemporaryDirectory() as folder:
        job, output = Job(SCENES / "sphere.xml", {"res": "512", "bsdf": PLUGIN}), Path(folder) / "passes.exr"
        for _ in range(PAIRS[context.profile.name] + 1):
            passes = resume(job, output, Limits(spp=spp), restart=True)
            called, image = timed(image_of, passes.scene)
            written, _ = timed(write_exr, Path(folder) / "one.exr", image)
            in_passes, _ = timed(passes.run)
            ratios.append((in_passes / called, in_passes / (called + written)))
    low, middle, high = np.quantile(ratios[1:], (0, 0.5, 1), axis=0)  # the first pair compiles
    values = {ONE_CALL: middle[0], "low": low[0], "high": high[0], WRITTEN: middle[1]}
    replay = {"scene": "sphere", "resolution": image.shape[0], "spp": spp, "pairs": len(ratios) - 1}
    values = {name: float(value) for name, value in values.items()}
    goals = {ONE_CALL: limits.PASSES_TIME}
    return [Row(NAME, f"{spp} spp", "sphere", context.variant, values, goals=goals, replay=replay)]


STUDY = Study(NAME, "Passes", about(__doc__), TERMS, tasks)
