"""Scenes: which features each scene needs of an integrator and of a study, in this variant.

A feature is 1 where the scene has it. What a scene lacks is left out of kernels and of studies: for example dispersion
where no index depends on the wavelength, and polarisation where nothing polarises. The remark names what is left out,
the replay the reason for each.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

from mi_refract.plugins import PLUGIN, scene_features
from mi_refract.report.row import Row
from validation.run.context import Context
from validation.run.render_methods import opened
from validation.study import Study, Task, about

TERMS = {
    "smooth": "some surface scatters, so that it can pay to sample the emitters there",
    "only glass": "every lobe of every surface is a delta",
    "delta emitters": "some emitter can be found only by sampling it",
}
NAME = "scenes"


def tasks(context: Context) -> list[Task]:
    """One task per scene."""
    return [Task(f"scenes: {path.stem}", functools.partial(scene_rows, context, path)) for path in context.scenes]


def scene_rows(context: Context, path: Path) -> list[Row]:
    """One row: the features of the loaded scene."""
    found = scene_features.inspect(opened(path, PLUGIN, context.profile.resolution))
    values = {name.replace("_", " "): float(x) for name, x in dataclasses.asdict(found).items() if name != "unknown"}
    remark = f"left out: {', '.join(found.left_out)}"
    if found.unknown:
        remark = f"everything is presumed of {', '.join(found.unknown)}"
    replay = {"scene": path.name, "left out": found.left_out}
    return [Row(NAME, "needs", path.stem, context.variant, values, reason=remark, replay=replay)]


STUDY = Study(NAME, "Scenes", about(__doc__), TERMS, tasks)
