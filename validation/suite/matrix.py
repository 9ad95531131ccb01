"""Suite: every system against every check, out of the rows of Per ray and Images.

A number is how far off a system is at most: of rays the largest angle to the certified direction in radians, of
images the difference of the means, as a share. A cell fails where the study that it comes from does. Beside each row
stand the version, and what the system does otherwise than it should, or than `refract` does.
"""

from __future__ import annotations

from collections.abc import Iterable

from mi_refract.report.row import Row
from validation.run.context import Context, Task

from . import per_ray, rendered_images

TITLE = "Suite"
TEXT = __doc__.partition("\n")[2].strip()
STUDY = "matrix"
OFF = "off by"
TERMS = {
    OFF: "rays: the largest angle, in radians, of those decided rightly; images: |test / reference − 1| of the means",
    "disagrees": "1 where a budget of the row that this is taken from is broken",
    "differs": "1 where the images are different, as it is known of this system; see its sentence",
}
CHECKS = {per_ray.STUDY: tuple(per_ray.SETS), rendered_images.STUDY: tuple(rendered_images.SCENES)}


def tasks(context: Context) -> list[Task]:
    """None: see `summary`."""
    return []


def summary(rows: Iterable[Row]) -> list[Row]:
    """A row per system, precision and check; one that was not run says why for each of its checks."""
    return [each for row in rows if row.study in CHECKS for each in _cells(row)]


def _cells(row: Row) -> list[Row]:
    cases = (row.case,) if row.case in CHECKS[row.study] else CHECKS[row.study]
    if not row.values:
        return [Row(STUDY, _system(row), case, "", reason=row.reason) for case in cases]
    off = row.values.get("worst rad", abs(row.values["mean difference"]) if "mean difference" in row.values else None)
    differs = row.replay.get("verdict") == "different"
    values = {} if off is None else {OFF: off}
    values["disagrees"] = float(bool(row.broken))
    goals = {}
    if row.study == rendered_images.STUDY:
        values["differs"], goals["differs"] = float(differs), 0.0
    said = "; ".join(filter(None, (row.replay.get("renderer", ""), row.reason)))
    return [Row(STUDY, _system(row), case, "", values, {"disagrees": 0.0}, goals, said) for case in cases]


def _system(row: Row) -> str:
    """A function with its precision; renderers have none."""
    return f"{row.subject}, {row.setting}" if row.study == per_ray.STUDY else row.subject


def with_summary(rows: list[Row]) -> list[Row]:
    """The rows of a run with the summary before what it is taken from."""
    place = next((i for i, row in enumerate(rows) if row.study in CHECKS), len(rows))
    return [*rows[:place], *summary(rows), *rows[place:]]
