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


def error_rows(context: Context, name: str, seed: int = 0) -> list[Row]:
    """One row: how often the errors of many renders are what they say."""
    from scipy.stats import binom

    count, table = COUNTS[context.profile.name], []
    defines = {"res": str(RESOLUTION), "bsdf": PLUGIN}
    with under(context.variant), tempfile.TemporaryDirectory() as folder:

        def render(seed: int, **ends: Any) -> Any:
            """One render of it from its first pass to its end."""
            job = Job(SCENES / f"{name}.xml", defines, seed)
            whole: Any = resume(job, Path(folder) / "image.exr", Limits(**ends), restart=True)
            whole.run()
            return whole

        reference = render(2**31 + seed, spp=12 * PASS_SPP * REFERENCE, pass_spp=64).image()
        twelve = render(2**31 + seed + 1, spp=96 * PASS_SPP, pass_spp=PASS_SPP).error()
        asked = twelve.value * math.sqrt(96 / 12)
        seeds = range(seed * count + 1, (seed + 1) * count + 1)
        for one in (render(seed, until=asked, pass_spp=PASS_SPP) for seed in seeds):
            stated = one.error()
            true = math.sqrt(np.mean((one.image() - reference) ** 2)) / abs(reference.mean())
            table.append((true, stated.value, stated.low, stated.high, one.progress.passes))
    true, stated, low, high, passes = np.array(table).T
    values = {
        "renders": float(count),
        "beyond": float((true > asked).sum()),
        "outside": float(((true < low) | (true > high)).sum()),
        "stated / true": float((stated**2).mean() / (true**2).mean()),
        "passes": float(passes.mean()),
    }
    # Of so many renders the largest number that may be beyond.
    most = float(binom.ppf(1 - limits.STOPPED_WRONGLY, count, 1 - LEVEL))
    replay = {"scene": name, "resolution": RESOLUTION, "asked": asked, "seeds": [seeds[0], seeds[-1]]}
    budgets = {"beyond": most, "outside": most}
    return [Row(NAME, "--until", name, context.variant, values, budgets, replay=replay)]


def time_rows(context: Context, spp: int) -> list[Row]:
    """One row: processor time of a render in passes over that of one call."""
    import mitsuba as mi

    def timed(work: Callable[..., Any], *arguments: Any, **named: Any) -> tuple[float, Any]:
        start = time.process_time()
        made = work(*arguments, **named)
        return time.process_time() - start, made

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
