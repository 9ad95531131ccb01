"""Thin panes: is a pane of glass far from the origin invisible in uniform light?

A pane in a constant environment of radiance 1 is invisible: each ray carries 1, reflected or refracted. A ray that
starts beyond the other side of the pane never leaves the glass, and carries 1/n² of the light. A few rays may pass
between the two triangles of a face: no more than chance allows (Poisson), each off by n² − 1 = 1.27 at most. Mitsuba
starts rays at 9e-5 (1 + the largest coordinate) from the surface that they leave; `refract_path` starts those of delta
lobes closer to it (`plugins/ray_origins`).
"""

from __future__ import annotations

import functools

import numpy as np
from scipy import stats

from mi_refract.report.row import Row
from validation import limits
from validation.run.context import Context
from validation.run.render_methods import METHODS, OURS, Method, sensor
from validation.study import Study, Task, about

NAME = "thin panes"
OFF = "mean radiance off"
TERMS = {OFF: "|mean radiance − 1|; 1 − 1/1.5² = 0.556 if no ray leaves the glass"}
# Thickness and position along x, in metres; the pane is 2 m wide.
PANES = ((4e-3, 0.0), (4e-3, 10.0), (1e-3, 12.0), (4e-3, 100.0), (1e-4, 12.0))
SPP, RESOLUTION = 16, 64
MOST_OFF = 1.27  # |radiance − 1| of one ray: n² − 1 for the default glass


def tasks(context: Context) -> list[Task]:
    """Return one task per method that does not split."""
    return [
        Task(f"{NAME}: {method.name}", functools.partial(method_rows, context, method))
        for method in METHODS
        if "split" not in method.name
    ]


def method_rows(context: Context, method: Method) -> list[Row]:
    """Return a row per pane."""
    import mitsuba as mi

    resolution, rows = RESOLUTION // 2 if context.scalar else RESOLUTION, []
    rays = SPP * resolution**2
    lost = float(stats.poisson.isf(limits.NULL_ALARM, limits.PANE_RAYS * rays))
    allowed = min(limits.PANE, lost * MOST_OFF / rays)
    for thickness, x in PANES:
        turned = mi.ScalarTransform4f().translate([x, 0, 0]).rotate([0.48, 0.6, 0.64], 40)
        pane = {"type": "cube", "to_world": turned.scale([1, 1, thickness / 2]), "bsdf": {"type": method.bsdf}}
        eye = [*map(float, turned @ mi.ScalarPoint3f(0.3, 0.2, 4))]
        scene = {"type": "scene", "integrator": method.plugin(64), "sensor": sensor(resolution, 20, eye, (x, 0, 0))}
        image = np.array(mi.render(mi.load_dict(scene | {"pane": pane, "sky": {"type": "constant"}}), spp=SPP))
        case = f"{1000 * thickness:g} mm at {x:g} m"
        budgets = {OFF: allowed} if method.integrator == OURS else {}
        values = {OFF: float(abs(image.mean(dtype=np.float64) - 1))}
        rows.append(Row(NAME, method.name, case, context.variant, values, budgets, replay={"spp": SPP}))
    return rows


STUDY = Study(
    NAME, "Thin panes", about(__doc__), TERMS, tasks, records=tuple(m.name for m in METHODS if m.integrator != OURS)
)
