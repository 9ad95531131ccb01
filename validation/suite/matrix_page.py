"""The matrix as a page of its own, and as JSON: every system against every check, and what it gets wrong in a sentence.

It is made from the `rows.json` of a validation. Systems are in the order of how far they are from right: those with a
wrong answer last, and otherwise by their largest backward error but where k is large, which hardly anyone gets right.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mi_refract.io.atomic import write_atomically
from mi_refract.ray_sets.judged_answers import RIGHT
from mi_refract.report.embedded_images import EmbeddedImages
from mi_refract.report.html_page import write_page
from mi_refract.report.number_text import compact
from mi_refract.report.row import strict
from validation.run.metrics import DETECTABLE, MEAN_DIFFERENCE, WORST_ANGLE

from . import per_ray, rendered_images
from .renderers.system import LARGE

SCHEMA = 1
ROWS = "rows.json"
MADE_BY = "python -m validation suite"
Stored = dict[str, Any]  # a row of rows.json, or what is made of some
TERMS = {
    "number": "the largest backward error of the set, in roundings u: each answer is the exact refraction of inputs a, "
    f"n and k off by no more. Up to {RIGHT:g} the answers are right; above, they are as good as a textbook's formula, "
    "unless the cell says wrong",
    "images": "the image's mean beside that of the reference, relative; and the difference that would have been seen "
    "in a tile",
    "not run": "the system was not installed where this page was made; the command installs it",
} | {name: rays.text for name, rays in per_ray.SETS.items()}
TERMS[LARGE] += (
    ". A formula with 1 − k² (1 − c²) is not right here: near the normal the difference 1 − c² has few digits left of "
    "sin²θ_i, and its error counts k² times; |n × a|² keeps them"
)


def read(folder: Path) -> Stored:
    """The matrix of the validation whose report is in a folder. ValueError or OSError where there is none."""
    path = folder / ROWS
    accepted = f"expected the folder of {MADE_BY} --out {folder}"
    try:
        document = json.loads(path.read_text("utf-8"))
        rows = [row for row in document["rows"] if row["study"] in (per_ray.NAME, rendered_images.NAME)]
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file; {accepted}") from None
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path}: holds no rows; {accepted}") from None
    if not rows:
        raise ValueError(f"{path}: no system was asked; {accepted}")
    return matrix(rows)


def matrix(rows: Iterable[Stored]) -> Stored:
    """`{"schema": 1, "rays": [...], "images": [...], "not_run": [...]}` of the rows of both studies."""
    systems: dict[tuple[str, ...], list[Stored]] = {}
    for row in rows:
        precision = row["setting"] if row["study"] == per_ray.NAME else ""
        systems.setdefault((row["study"], row["subject"], precision), []).append(row)
    found: dict[str, list[Stored]] = {"rays": [], "images": [], "not_run": []}
    for (study, title, precision), cells in systems.items():
        ran = [cell for cell in cells if cell["values"]]
        about = {"system": title} | ({"precision": precision} if precision else {})
        if not ran:
            found["not_run"].append(about | {"reason": cells[0]["reason"]})
        elif study == per_ray.NAME:
            found["rays"].append(about | _rays(ran))
        else:
            found["images"].append(about | _images(ran))
    found["rays"].sort(key=_distance)
    found["images"].sort(key=lambda each: (each["wrong"], each["system"]))
    return {"schema": SCHEMA} | found


def _rays(cells: list[Stored]) -> Stored:
    sets = {
        cell["case"]: {
            "verdict": _grade(cell),
            "backward_error": cell["values"].get(per_ray.BACKWARD),
            "worst_angle": cell["values"].get(WORST_ANGLE),
        }
        for cell in cells
    }
    said = cells[0]["replay"]
    about = {name: said.get(name, "") for name in ("version", "total internal reflection", "remark")}
    wrong = any(each["verdict"] == "wrong" for each in sets.values())
    return about | {"wrong": wrong, "sentence": sentence(sets, about["remark"]), "sets": sets}


def _grade(cell: Stored) -> str:
    """ "right", "as good as a textbook's formula", or "wrong"."""
    if cell["verdict"] == "fail":
        return "wrong"
    backward = cell["values"].get(per_ray.BACKWARD)
    return "right" if isinstance(backward, (int, float)) and backward <= RIGHT else "within bound"


def sentence(sets: Stored, remark: str = "") -> str:
    """What a system gets wrong."""
    parts = []
    if wrong := [name for name, each in sets.items() if each["verdict"] == "wrong"]:
        parts.append(f"wrong: {', '.join(wrong)}")
    off = [
        f"{name} (up to {_shown(x['backward_error'])})" for name, x in sets.items() if x["verdict"] == "within bound"
    ]
    if off:
        parts.append(f"exact only for inputs more than {RIGHT:g} roundings off: {', '.join(off)}")
    text = "; ".join(parts) or "right in every set"
    return text + (f"; {remark}" if remark else "")


def _images(cells: list[Stored]) -> Stored:
    scenes = {
        cell["case"]: {
            "verdict": cell["replay"].get("verdict", "not rendered"),
            "mean_difference": cell["values"].get(MEAN_DIFFERENCE),
            "detectable": cell["values"].get(DETECTABLE),
        }
        for cell in cells
    }
    differs = [name for name, each in scenes.items() if each["verdict"] != "equal"]
    reasons = dict.fromkeys(cell["reason"] for cell in cells if cell["case"] in differs)
    wrong = any(cell["verdict"] == "fail" for cell in cells)
    return {"wrong": wrong, "sentence": "; ".join(reasons) or "equal to within noise in every scene", "scenes": scenes}


def _distance(system: Stored) -> tuple[bool, float, float, str]:
    def largest(names: Iterable[str]) -> float:
        found = [system["sets"][name]["backward_error"] for name in names if name in system["sets"]]
        return max((x if isinstance(x, (int, float)) else math.inf for x in found), default=0.0)

    return system["wrong"], largest(set(system["sets"]) - {LARGE}), largest([LARGE]), system["system"]


def _shown(value: Any) -> str:
    return compact(value) if isinstance(value, (int, float)) else str(value or "–")


# Written -----------------------------------------------------------------------------------------------------------


def write_json(path: Path, found: Stored) -> None:
    """Strict JSON. OSError."""
    write_atomically(path, json.dumps(strict(found), indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def write_html(path: Path, found: Stored) -> None:
    """One page that needs no network. OSError."""
    right = sum(not each["wrong"] for each in found["rays"])
    drawn = f", {len(found['images'])} renderers by images" if found["images"] else ""
    content = {
        "title": "Refraction by other systems",
        "sentence": f"Who refracts right: {len(found['rays'])} functions ray by ray{drawn}",
        "counts": [
            ("pass", "functions without a wrong answer", right),
            ("fail", "with wrong answers", len(found["rays"]) - right),
            ("info", "not run", len(found["not_run"])),
        ],
        "sets": list(per_ray.SETS),
        "rays": [each | {"cells": [_cell(each["sets"].get(name)) for name in per_ray.SETS]} for each in found["rays"]],
        "scenes": list(rendered_images.SCENES),
        "renderers": [
            each | {"cells": [_picture(each["scenes"].get(name)) for name in rendered_images.SCENES]}
            for each in found["images"]
        ],
        "not_run": found["not_run"],
        "terms": TERMS,
        "command": f"{MADE_BY}; python -m validation renderers --page {path.name}",
    }
    write_page(path, "matrix.html.j2", content, EmbeddedImages())


def _cell(found: Stored | None) -> tuple[str, str]:
    """The text of a cell and its class."""
    if not found:
        return "–", ""
    states = {"right": "pass", "within bound": "missed", "wrong": "fail"}
    wrong = "wrong, " if found["verdict"] == "wrong" else ""
    return wrong + _shown(found["backward_error"]), states[found["verdict"]]


def _picture(found: Stored | None) -> tuple[str, str]:
    if not found:
        return "–", ""
    state = {"equal": "pass", "different": "fail"}.get(found["verdict"], "missed")
    if not isinstance(found["mean_difference"], (int, float)):
        return found["verdict"], state
    seen = f", seen from {found['detectable']:.2%}" if isinstance(found["detectable"], (int, float)) else ""
    return f"{found['verdict']}: {found['mean_difference']:+.2%}{seen}", state
