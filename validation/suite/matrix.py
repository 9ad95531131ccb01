"""Suite: every system against every check, from the rows of the studies "Per ray" and "Images".

For rays, a number is the largest angle to the certified direction in radians; for images, the relative difference of
the means. A cell fails if a row of its study fails. The remark of a row gives the version, and how the system differs
from its specification or from `refract`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mi_refract.io.safe_files import write_atomically
from mi_refract.io.text import compact
from mi_refract.ray_sets.judged_answers import RIGHT
from mi_refract.report.documents import write_page
from mi_refract.report.embedded_images import EmbeddedImages
from mi_refract.report.row import Row, strict
from mi_refract.report.study_page import Answer, State, phrase
from validation import limits, repeated
from validation.run.context import Context
from validation.run.metrics import DETECTABLE, MEAN_DIFFERENCE, WORST_ANGLE
from validation.study import Study, Task, about

from . import per_ray, rendered_images
from .per_ray import BACKWARD, LARGE, OFF_RECORDED, RECORDED
from .rendered_images import INCONCLUSIVE
from .renderers import System

NAME = "matrix"
OFF, FAILED = "off by", "failed checks"
TERMS = {
    OFF: "rays: the largest angle, in radians, without misclassified rays; images: |test / reference − 1| of the means",
    BACKWARD: per_ray.TERMS[BACKWARD],
    FAILED: "number of broken budgets in the row of that study",
    RECORDED: per_ray.TERMS[RECORDED],
    OFF_RECORDED: "the error over the one recorded earlier, or the reciprocal if that is larger; a goal",
    INCONCLUSIVE: "1 if noise could hide a relevant difference, whatever the means are; a goal",
    "differs": "1 if the images are different and this is known of the system; see its remark",
}
CHECKS = {per_ray.NAME: tuple(per_ray.SETS), rendered_images.NAME: tuple(rendered_images.SCENES)}
TEXT = (
    "Rays: the largest angle in radians, and the largest backward error m in u: the answers are exact for inputs off "
    f"by m\nroundings. m up to {RIGHT:g} is right, a goal; larger m are bold. Images: relative difference of means. "
    "✓: all rays are\nwithin their bounds; ✗: a bound is broken, and the run fails. Another goal is an error within a "
    f"factor of {limits.RECORDED:g} of the\none recorded earlier; otherwise the cell says "
    '"× recorded", or "recorded /" if the error is smaller. A missed goal fails nothing.'
)


def tasks(context: Context) -> list[Task]:
    """Return no tasks: the rows are made by `summary`."""
    return []


def summary(rows: Iterable[Row]) -> list[Row]:
    """Return a row per system, precision and check. A system that was not run has the reason in all its checks."""
    return [cell for row in rows if row.study in CHECKS for cell in _cells(row, repeated.own_case(row.case))]


def _cells(row: Row, case: str) -> list[Row]:
    cases = (case,) if case in CHECKS[row.study] else CHECKS[row.study] if case else ()
    system = f"{row.subject}, {row.setting}" if row.study == per_ray.NAME else row.subject
    if not row.values:
        return [Row(NAME, system, case, "", reason=row.reason, remedy=row.remedy) for case in cases]
    values, goals = {FAILED: float(len(row.broken))}, {}
    if row.study == rendered_images.NAME:
        verdict = row.replay.get("verdict")
        values |= {"differs": float(verdict == "different"), INCONCLUSIVE: float(verdict == INCONCLUSIVE)}
        values |= {OFF: abs(row.values[MEAN_DIFFERENCE])} if MEAN_DIFFERENCE in row.values else {}
        goals = {"differs": 0.0, INCONCLUSIVE: 0.0}
    else:
        values |= {OFF: row.values[WORST_ANGLE]} if WORST_ANGLE in row.values else {}
        values |= {name: row.values[name] for name in (BACKWARD, RECORDED, OFF_RECORDED) if name in row.values}
        goals = {name: row.goals[name] for name in (BACKWARD, OFF_RECORDED) if name in row.goals}
    failed = [f"{phrase(row, metric)} allowed" for metric in row.broken]
    reason = "; ".join(filter(None, (*failed, row.replay.get("renderer", ""), row.reason)))
    return [Row(NAME, system, case, "", values, {FAILED: 0.0}, goals, reason) for case in cases]


def with_summary(rows: list[Row]) -> list[Row]:
    """Return the rows of a run, with the summary inserted before the rows it is made from."""
    place = next((i for i, row in enumerate(rows) if row.study in CHECKS), len(rows))
    return [*rows[:place], *summary(rows), *rows[place:]]


def table(rows: list[Row]) -> tuple[str, list[str], list[list[str]]]:
    """Return the matrix as a table of the documentation: the text above it, its heading, and its lines.

    ValueError if no system was run.
    """
    systems: dict[str, dict[str, Row]] = {}
    for row in rows:
        if row.study == NAME:
            systems.setdefault(row.subject, {})[row.case] = row
    if not any(row.values for cells in systems.values() for row in cells.values()):
        raise ValueError("documentation: no other renderer was run; its table needs at least one")
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


# The page ----------------------------------------------------------------------------------------------------------
#
# Every system against every check, and a sentence on its errors, from the `rows.json` of a validation. Systems are
# sorted by their largest backward error, except that of large k, where few are right: it breaks ties. Systems with a
# wrong answer that is not a known deviation are last.

MADE_BY = "python -m validation suite"
Stored = dict[str, Any]  # a row of rows.json, or a summary of rows


def read(folder: Path) -> Stored:
    """Return the matrix of the validation whose report is in `folder`. ValueError or OSError if there is none."""
    path, expected = folder / "rows.json", f"expected the folder of {MADE_BY} --out {folder}"
    try:
        rows = [row for row in json.loads(path.read_text("utf-8"))["rows"] if row["study"] in CHECKS]
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file; {expected}") from None
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path}: no rows of a validation; {expected}") from None
    if not rows:
        raise ValueError(f"{path}: no rows of other systems; {expected}")
    return of_rows(rows)


def of_rows(rows: Iterable[Stored]) -> Stored:
    """Return `{"schema": 1, "rays": [...], "images": [...], "not_run": [...]}` from the rows of both studies."""
    systems: dict[tuple[str, ...], list[Stored]] = {}
    for row in ({**row, "case": repeated.own_case(row["case"])} for row in rows):
        if not row["case"]:
            continue
        precision = row["setting"] if row["study"] == per_ray.NAME else ""
        systems.setdefault((row["study"], row["subject"], precision), []).append(row)
    rays, images, not_run = list[Stored](), list[Stored](), list[Stored]()
    for (study, title, precision), cells in systems.items():
        label = {"system": title} | ({"precision": precision} if precision else {})
        measured = [cell for cell in cells if cell["values"]]
        if not measured:
            not_run.append(label | {"reason": cells[0]["reason"]})
        elif study == per_ray.NAME:
            rays.append(label | _of_rays(measured))
        else:
            images.append(label | _of_images(measured))
    rays.sort(key=_distance)
    images.sort(key=lambda image: (image["wrong"], image["system"]))
    return {"schema": 1, "rays": rays, "images": images, "not_run": not_run}


def answers(rows: Iterable[Row], own_renderers: Iterable[System]) -> list[Answer]:
    """Return the results of the renderers given with --renderer, for the first page: by function, and for images."""
    own = {(rendered_images.NAME, system.title, "") for system in own_renderers if system.images}
    own |= {(per_ray.NAME, call.title, str(call.precision)) for system in own_renderers for call in system.calls}

    def key(row: Row) -> tuple[str, str, str]:
        return row.study, row.subject, row.setting if row.study == per_ray.NAME else ""

    results = of_rows(row.as_dict() for row in rows if key(row) in own)
    made: list[Answer] = []
    for kind in ("rays", "images", "not_run"):
        for result in results[kind]:
            name = ", ".join(result[key] for key in ("system", "precision") if key in result)
            text = result["reason"] if kind == "not_run" else result["sentence"]
            verdicts = {scene["verdict"] for scene in result.get("scenes", {}).values()}
            unknown = kind == "not_run" or verdicts == {INCONCLUSIVE}
            state: State = "no" if result.get("wrong") else "not measured" if unknown else "yes"
            made.append({"question": f"Your renderer: {name}", "text": text, "state": state, "study": NAME})
    return made


def _of_rays(cells: list[Stored]) -> Stored:
    """Return a sentence on the errors of a function of refraction, and its numbers by set."""
    sets, deviations = {}, []
    for cell in cells:
        backward, worst = cell["values"].get(BACKWARD), cell["values"].get(WORST_ANGLE)
        right = isinstance(backward, (int, float)) and backward <= RIGHT
        verdict = "wrong" if cell["verdict"] == "fail" else "right" if right else "within bound"
        if verdict != "wrong" and cell["values"].get("wrong"):
            verdict = "deviates"
            deviations.append(f"{cell['case']} ({cell['replay'].get('known to deviate', '')})")
        sets[cell["case"]] = {"verdict": verdict, "backward_error": backward, "worst_angle": worst}
    remarks = {name: cells[0]["replay"].get(name, "") for name in ("version", "total internal reflection", "remark")}
    wrong = [name for name, x in sets.items() if x["verdict"] == "wrong"]
    within = {name: x["backward_error"] for name, x in sets.items() if x["verdict"] == "within bound"}
    off = [f"{name} (up to {compact(m) if isinstance(m, (int, float)) else m or '–'})" for name, m in within.items()]
    parts = [f"wrong: {', '.join(wrong)}"] if wrong else []
    parts += [f"known to deviate: {', '.join(deviations)}"] if deviations else []
    if not sets.keys() & per_ray.SETS:
        parts = [f"no answers: {cells[0]['reason']}"]
    parts += [f"exact only for inputs more than {RIGHT:g} roundings off: {', '.join(off)}"] if off else []
    sentence = "; ".join([*(parts or ["right in every set"]), *filter(None, [remarks["remark"]])])
    return remarks | {"wrong": bool(wrong), "sentence": sentence, "sets": sets}


def _of_images(cells: list[Stored]) -> Stored:
    """Return a sentence on the differences in the images of a renderer, and its numbers by scene."""
    scenes = {
        cell["case"]: {
            "verdict": cell["replay"].get("verdict", "not rendered"),
            "mean_difference": cell["values"].get(MEAN_DIFFERENCE),
            "detectable": cell["values"].get(DETECTABLE),
        }
        for cell in cells
    }
    reasons = dict.fromkeys(cell["reason"] for cell in cells if scenes[cell["case"]]["verdict"] != "equal")
    wrong = any(cell["verdict"] == "fail" for cell in cells)
    return {"wrong": wrong, "sentence": "; ".join(reasons) or "equal to within noise in every scene", "scenes": scenes}


def _distance(system: Stored) -> tuple[bool, float, float, str]:
    backward = {name: x["backward_error"] for name, x in system["sets"].items()}
    errors = {name: x if isinstance(x, (int, float)) else math.inf for name, x in backward.items()}
    large = errors.pop(LARGE, 0.0)
    return system["wrong"], max(errors.values(), default=0.0), large, system["system"]


def write_json(path: Path, stored: Stored) -> None:
    """Write strict JSON. OSError."""
    write_atomically(path, json.dumps(strict(stored), indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def write_html(path: Path, stored: Stored) -> None:
    """Write one HTML page that needs no network. OSError."""
    images = f", {len(stored['images'])} renderers by images" if stored["images"] else ""
    content = {
        "title": "Refraction by other systems",
        "sentence": f"Which systems refract right: {len(stored['rays'])} functions by rays{images}",
        "rays": stored["rays"],
        "renderers": stored["images"],
        "not_run": stored["not_run"],
        "sets": {name: kind.text for name, kind in per_ray.SETS.items()},
        "scenes": list(rendered_images.SCENES),
        "most_right": f"{RIGHT:g}",
        "large": LARGE,
        "command": f"{MADE_BY}; python -m validation renderers --page {path.name}",
    }
    write_page(path, "matrix.html.j2", content, EmbeddedImages())


STUDY = Study(NAME, "Suite", about(__doc__), TERMS, tasks, summarise=with_summary)
