"""The matrix as the table of a README: the worst of every system, check by check."""

from __future__ import annotations

from mi_refract.ray_sets.judged_answers import RIGHT
from mi_refract.report.number_text import compact
from mi_refract.report.row import Row
from validation import limits

from . import matrix, per_ray

TEXT = (
    "Rays: the largest angle in radians, and the largest backward error in u: the answers are exact for inputs so "
    f"many\nroundings off, and right up to {RIGHT:g}, a goal; what misses it is bold. Images: share of the mean. "
    "✓: every ray\nwithin its bound; ✗: a bound is broken, and the run fails. To be within a factor of "
    f"{limits.RECORDED:g} of the error recorded\nearlier is a goal: what misses it says "
    '"× recorded", or "recorded /" where the error is smaller, and fails nothing.'
)


def table(rows: list[Row]) -> tuple[str, list[str], list[list[str]]]:
    """The text above it, its head, and its lines. ValueError where no system was run."""
    cells: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row.study == matrix.NAME:
            cells.setdefault(row.subject, {})[row.case] = row
    if not any(row.values for each in cells.values() for row in each.values()):
        raise ValueError("README: no other renderer was run; its table needs some")
    checks = [check for each in matrix.CHECKS.values() for check in each]
    lines = [[system, *(_cell(found.get(check)) for check in checks)] for system, found in cells.items()]
    return TEXT, ["", *checks], lines


def _cell(row: Row | None) -> str:
    if row is None or not row.values:
        return "not run" if row else ""
    if matrix.OFF not in row.values:
        return "✗" if row.broken else "✓"
    word = " **different**" if row.values.get("differs") else ""
    word += " **inconclusive**" if row.values.get(matrix.INCONCLUSIVE) else ""
    if per_ray.OFF_RECORDED in row.missed:
        factor = compact(row.values[per_ray.OFF_RECORDED])
        less = row.values[matrix.OFF] < row.values.get(per_ray.RECORDED, 0)
        word += f" (recorded / {factor})" if less else f" ({factor} × recorded)"
    return compact(row.values[matrix.OFF]) + _backward(row) + word + (" ✗" if row.broken else "")


def _backward(row: Row) -> str:
    if per_ray.BACKWARD not in row.values:
        return ""
    text = f"{compact(row.values[per_ray.BACKWARD])} u"
    return f", **{text}**" if per_ray.BACKWARD in row.missed else f", {text}"
