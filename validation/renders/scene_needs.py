"""Scenes: what each of them needs of an integrator and of a study, as the loaded scene shows it, in this variant.

1 where it has something that needs care. What a scene lacks is left out, of kernels and of studies: nothing is said of
dispersion where no index depends on the wavelength, and nothing of polarisation where nothing polarises. The remark
names what is left out, the replay the reason of each.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

from mi_refract.plugins import scene_features
from mi_refract.plugins.refract import PLUGIN
from mi_refract.report.row import Row
from validation.run.context import Context
from validation.run.render_methods import opened
from validation.study import Study, Task, about

TERMS = {
    "smooth": "some surface scatters, so that it can pay to sample the emitters there",
    "only glass": "every lobe of every surface is a delta",
    "delta emitters": "some emitter can be found by sampling it only",
}
NAME = "scenes"


def tasks(context: Context) -> list[Task]:
    """One task per scene."""
    return [Task(f"scenes: {path.stem}", functools.partial(scene_rows, context, path)) for path in context.scenes]


def scene_rows(context: Context, path: Path) -> list[Row]:
    """One row: what the loaded scene has that needs care."""
    found = scene_features.inspect(opened(path, PLUGIN, context.profile.resolution))
    values = {name.replace("_", " "): float(x) for name, x in dataclasses.asdict(found).items() if name != "unknown"}
    remark = f"left out: {', '.join(found.left_out)}"
    if found.unknown:
        remark = f"everything is presumed of {', '.join(found.unknown)}"
    replay = {"scene": path.name, "left out": found.left_out}
    return [Row(NAME, "needs", path.stem, context.variant, values, reason=remark, replay=replay)]


STUDY = Study(NAME, "Scenes", about(__doc__), TERMS, tasks)
