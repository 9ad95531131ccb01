"""Suite: every system against every check, from the rows of the studies "Per ray" and "Images".

For rays, a number is the largest angle to the certified direction in radians; for images, the relative difference of
the means. A cell fails where the study that it comes from fails. Each row also gives the version, and where the system
does not do what it should, or what `refract` does.
"""

from __future__ import annotations

from collections.abc import Iterable

from mi_refract.ray_sets.judged_answers import RIGHT
from mi_refract.report.number_text import compact
from mi_refract.report.row import Row
from validation import limits
from validation.run.context import Context
from validation.run.metrics import MEAN_DIFFERENCE, WORST_ANGLE
from validation.study import Study, Task, about

from . import per_ray, rendered_images
from .per_ray import BACKWARD, OFF_RECORDED, RECORDED
from .rendered_images import INCONCLUSIVE

NAME = "matrix"
OFF = "off by"
TERMS = {
    OFF: "rays: the largest angle, in radians, without misclassified rays; images: |test / reference − 1| of the means",
    BACKWARD: per_ray.TERMS[BACKWARD],
    "disagrees": "1 where a budget is broken in the row that this comes from",
    RECORDED: per_ray.TERMS[RECORDED],
    OFF_RECORDED: "the error over the one recorded earlier, or the reverse if that is larger; a goal, which fails no "
    "run",
    INCONCLUSIVE: "1 where noise hides what the images are compared for: no pass, whatever the mean says",
    "differs": "1 where the images are different and this is known of the system; see its remark",
}
CHECKS = {per_ray.NAME: tuple(per_ray.SETS), rendered_images.NAME: tuple(rendered_images.SCENES)}
TEXT = (
    "Rays: the largest angle in radians, and the largest backward error in u: the answers are exact for inputs off by "
    f"that many\nroundings, and right up to {RIGHT:g}, a goal; what misses it is bold. Images: share of the mean. "
    "✓: every ray\nwithin its bound; ✗: a bound is broken, and the run fails. To be within a factor of "
    f"{limits.RECORDED:g} of the error recorded\nearlier is a goal: what misses it says "
    '"× recorded", or "recorded /" where the error is smaller, and fails nothing.'
)


def tasks(context: Context) -> list[Task]:
    """None: see `summary`."""
    return []


def summary(rows: Iterable[Row]) -> list[Row]:
    """A row per system, precision and check; one that was not run says why for each of its checks."""
    return [cell for row in rows if row.study in CHECKS for cell in _cells(row)]


def _cells(row: Row) -> list[Row]:
    cases = (row.case,) if row.case in CHECKS[row.study] else CHECKS[row.study]
    system = f"{row.subject}, {row.setting}" if row.study == per_ray.NAME else row.subject
    if not row.values:
        return [Row(NAME, system, case, "", reason=row.reason) for case in cases]
    values, goals = {"disagrees": float(bool(row.broken))}, {}
    if row.study == rendered_images.NAME:
        verdict = row.replay.get("verdict")
        values |= {"differs": float(verdict == "different"), INCONCLUSIVE: float(verdict == INCONCLUSIVE)}
        values |= {OFF: abs(row.values[MEAN_DIFFERENCE])} if MEAN_DIFFERENCE in row.values else {}
        goals = {"differs": 0.0, INCONCLUSIVE: 0.0}
    else:
        values |= {OFF: row.values[WORST_ANGLE]} if WORST_ANGLE in row.values else {}
        values |= {name: row.values[name] for name in (BACKWARD, RECORDED, OFF_RECORDED) if name in row.values}
        goals = {name: row.goals[name] for name in (BACKWARD, OFF_RECORDED) if name in row.goals}
    reason = "; ".join(filter(None, (row.replay.get("renderer", ""), row.reason)))
    return [Row(NAME, system, case, "", values, {"disagrees": 0.0}, goals, reason) for case in cases]


def with_summary(rows: list[Row]) -> list[Row]:
    """The rows of a run, with the summary before the rows it is made from."""
    place = next((i for i, row in enumerate(rows) if row.study in CHECKS), len(rows))
    return [*rows[:place], *summary(rows), *rows[place:]]


def table(rows: list[Row]) -> tuple[str, list[str], list[list[str]]]:
    """The matrix as the table of a README: the text above it, its head, and its lines.

    ValueError where no system was run.
    """
    systems: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row.study == NAME:
            systems.setdefault(row.subject, {})[row.case] = row
    if not any(row.values for cells in systems.values() for row in cells.values()):
        raise ValueError("README: no other renderer was run; its table needs at least one")
    checks = [check for names in CHECKS.values() for check in names]
    lines = [[system, *(_text(cells.get(check)) for check in checks)] for system, cells in systems.items()]
    return TEXT, ["", *checks], lines


def _text(row: Row | None) -> str:
    if row is None or not row.values:
        return "not run" if row else ""
    if OFF not in row.values:
        return "✗" if row.broken else "✓"
    text = compact(row.values[OFF])
    if BACKWARD in row.values:
        backward = f"{compact(row.values[BACKWARD])} u"
        text += f", **{backward}**" if BACKWARD in row.missed else f", {backward}"
    text += " **different**" if row.values.get("differs") else ""
    text += " **inconclusive**" if row.values.get(INCONCLUSIVE) else ""
    if OFF_RECORDED in row.missed:
        factor, less = compact(row.values[OFF_RECORDED]), row.values[OFF] < row.values.get(RECORDED, 0)
        text += f" (recorded / {factor})" if less else f" ({factor} × recorded)"
    return text + (" ✗" if row.broken else "")


STUDY = Study(NAME, "Suite", about(__doc__), TERMS, tasks, summarise=with_summary)
