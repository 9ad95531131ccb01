"""Scenes: what each of them needs of an integrator and of a study, as the loaded scene shows it, in this variant.

1 where it needs something. What it does not need is left out, and the remark says why: nothing is said of dispersion
where no index depends on the wavelength, and nothing of polarisation where nothing polarises.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

from mi_refract import needs
from mi_refract.bsdf import PLUGIN
from mi_refract.rows import Row

from .methods import opened
from .plan import SCENES, Context, Task

TITLE = "Scenes"
TEXT = __doc__.partition("\n")[2].strip()
TERMS = {
    "smooth": "some surface scatters, so that it can pay to sample the emitters there",
    "only_glass": "every lobe of every surface is a delta",
    "delta_emitters": "some emitter can be found by sampling it only",
}
STUDY = "scenes"


def tasks(context: Context) -> list[Task]:
    """One task per scene."""
    paths = sorted(SCENES.glob("*.xml"))
    return [Task(f"scenes: {path.stem}", functools.partial(scene_rows, context, path)) for path in paths]


def scene_rows(context: Context, path: Path) -> list[Row]:
    found = needs.inspect(opened(path, PLUGIN, context.profile.resolution))
    values = {name: float(value) for name, value in dataclasses.asdict(found).items() if name != "unknown"}
    remarks = [f"{feature} ({reason})" for feature, reason in found.left_out.items()]
    remark = f"left out: {'; '.join(remarks)}" if remarks else ""
    if found.unknown:
        remark = f"everything is presumed of {', '.join(found.unknown)}"
    return [Row(STUDY, "needs", path.stem, context.variant, values, reason=remark, replay={"scene": path.name})]
