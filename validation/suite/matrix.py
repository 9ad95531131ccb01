"""Suite: every system against every check, from the rows of the studies "Per ray" and "Images".

For rays, a number is the largest angle to the certified direction in radians; for images, the relative difference of
the means. A cell fails where the study that it comes from fails. Each row also gives the version, and where the system
does not do what it should, or what `refract` does.
"""

from __future__ import annotations

from collections.abc import Iterable

from mi_refract.report.row import Row
from validation.run.context import Context
from validation.run.metrics import MEAN_DIFFERENCE, WORST_ANGLE
from validation.study import Study, Task, about

from . import per_ray, rendered_images
from .rendered_images import INCONCLUSIVE

NAME = "matrix"
OFF = "off by"
TERMS = {
    OFF: "rays: the largest angle, in radians, without misclassified rays; images: |test / reference − 1| of the means",
    per_ray.BACKWARD: per_ray.TERMS[per_ray.BACKWARD],
    "disagrees": "1 where a budget is broken in the row that this comes from",
    per_ray.RECORDED: per_ray.TERMS[per_ray.RECORDED],
    per_ray.OFF_RECORDED: "how many times the error recorded earlier, or that over it; a goal, which fails no run",
    INCONCLUSIVE: "1 where noise hides what the images are compared for: no pass, whatever the mean says",
    "differs": "1 where the images are different and this is known of the system; see its remark",
}
CHECKS = {per_ray.NAME: tuple(per_ray.SETS), rendered_images.NAME: tuple(rendered_images.SCENES)}


def tasks(context: Context) -> list[Task]:
    """None: see `summary`."""
    return []


def summary(rows: Iterable[Row]) -> list[Row]:
    """A row per system, precision and check; one that was not run says why for each of its checks."""
    return [each for row in rows if row.study in CHECKS for each in _cells(row)]


def _cells(row: Row) -> list[Row]:
    cases = (row.case,) if row.case in CHECKS[row.study] else CHECKS[row.study]
    if not row.values:
        return [Row(NAME, _system(row), case, "", reason=row.reason) for case in cases]
    off = row.values.get(WORST_ANGLE, abs(row.values[MEAN_DIFFERENCE]) if MEAN_DIFFERENCE in row.values else None)
    differs = row.replay.get("verdict") == "different"
    values = {} if off is None else {OFF: off}
    values["disagrees"] = float(bool(row.broken))
    values |= {name: row.values[name] for name in (per_ray.BACKWARD,) if name in row.values}
    goals = {name: goal for name, goal in row.goals.items() if name == per_ray.BACKWARD}
    if per_ray.OFF_RECORDED in row.goals:
        values |= {name: row.values[name] for name in (per_ray.RECORDED, per_ray.OFF_RECORDED) if name in row.values}
        goals[per_ray.OFF_RECORDED] = row.goals[per_ray.OFF_RECORDED]
    if row.study == rendered_images.NAME:
        values["differs"], goals["differs"] = float(differs), 0.0
        values[INCONCLUSIVE], goals[INCONCLUSIVE] = float(row.replay.get("verdict") == INCONCLUSIVE), 0.0
    said = "; ".join(filter(None, (row.replay.get("renderer", ""), row.reason)))
    return [Row(NAME, _system(row), case, "", values, {"disagrees": 0.0}, goals, said) for case in cases]


def _system(row: Row) -> str:
    """A function with its precision; renderers have none."""
    return f"{row.subject}, {row.setting}" if row.study == per_ray.NAME else row.subject


def with_summary(rows: list[Row]) -> list[Row]:
    """The rows of a run, with the summary before the rows it is made from."""
    place = next((i for i, row in enumerate(rows) if row.study in CHECKS), len(rows))
    return [*rows[:place], *summary(rows), *rows[place:]]


STUDY = Study(NAME, "Suite", about(__doc__), TERMS, tasks, summarise=with_summary)
