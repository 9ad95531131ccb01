"""The matrix as a page of its own, and as JSON: every system against every check, and what it gets wrong in a sentence.

It is made from the `rows.json` of a validation. Systems are in the order of how far they are from right: those with a
wrong answer last, and otherwise by their largest backward error, where k is large last of all: few are right there.
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
    "images": "the image's mean relative to that of the reference; and the smallest difference that a tile could show",
    "not run": "the system was not installed where this page was made; the command installs it",
} | {name: rays.text for name, rays in per_ray.SETS.items()}
TERMS[LARGE] += (
    ". A formula with 1 − k² (1 − c²) is not right here: near the normal the difference 1 − c² has few digits left of "
    "sin²θ_i, and its error counts k² times; |n × a|² keeps them"
)


def read(folder: Path) -> Stored:
    """The matrix of the validation whose report is in a folder. ValueError or OSError where there is none."""
    path, expected = folder / ROWS, f"expected the folder of {MADE_BY} --out {folder}"
    try:
        document = json.loads(path.read_text("utf-8"))
        rows = [row for row in document["rows"] if row["study"] in (per_ray.NAME, rendered_images.NAME)]
    except FileNotFoundError:
        raise FileNotFoundError(f"{path}: no such file; {expected}") from None
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path}: no rows of a validation; {expected}") from None
    if not rows:
        raise ValueError(f"{path}: no rows of other systems; {expected}")
    return matrix(rows)


def matrix(rows: Iterable[Stored]) -> Stored:
    """`{"schema": 1, "rays": [...], "images": [...], "not_run": [...]}` of the rows of both studies."""
    systems: dict[tuple[str, ...], list[Stored]] = {}
    for row in rows:
        precision = row["setting"] if row["study"] == per_ray.NAME else ""
        systems.setdefault((row["study"], row["subject"], precision), []).append(row)
    found: dict[str, list[Stored]] = {"rays": [], "images": [], "not_run": []}
    for (study, title, precision), cells in systems.items():
        about = {"system": title} | ({"precision": precision} if precision else {})
        ran = [cell for cell in cells if cell["values"]]
        if not ran:
            found["not_run"].append(about | {"reason": cells[0]["reason"]})
        elif study == per_ray.NAME:
            found["rays"].append(about | _rays(ran))
        else:
            found["images"].append(about | _images(ran))
    found["rays"].sort(key=_distance)
    found["images"].sort(key=lambda image: (image["wrong"], image["system"]))
    return {"schema": SCHEMA} | found


def _rays(cells: list[Stored]) -> Stored:
    """What a function of refraction got wrong, and its numbers by set."""
    sets = {}
    for cell in cells:
        backward = cell["values"].get(per_ray.BACKWARD)
        right = isinstance(backward, (int, float)) and backward <= RIGHT
        verdict = "wrong" if cell["verdict"] == "fail" else "right" if right else "within bound"
        worst = cell["values"].get(WORST_ANGLE)
        sets[cell["case"]] = {"verdict": verdict, "backward_error": backward, "worst_angle": worst}
    replay = cells[0]["replay"]
    about = {name: replay.get(name, "") for name in ("version", "total internal reflection", "remark")}
    wrong = [name for name, x in sets.items() if x["verdict"] == "wrong"]
    off = [
        f"{name} (up to {_shown(x['backward_error'])})" for name, x in sets.items() if x["verdict"] == "within bound"
    ]
    parts = [f"wrong: {', '.join(wrong)}"] if wrong else []
    parts += [f"exact only for inputs more than {RIGHT:g} roundings off: {', '.join(off)}"] if off else []
    sentence = "; ".join(parts) or "right in every set"
    remark = f"; {about['remark']}" if about["remark"] else ""
    return about | {"wrong": bool(wrong), "sentence": sentence + remark, "sets": sets}


def _images(cells: list[Stored]) -> Stored:
    """What differs in the images of a renderer, and its numbers by scene."""
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
    errors = {
        name: x["backward_error"] if isinstance(x["backward_error"], (int, float)) else math.inf
        for name, x in system["sets"].items()
    }
    large = errors.pop(LARGE, 0.0)
    return system["wrong"], max(errors.values(), default=0.0), large, system["system"]


def _shown(value: Any) -> str:
    return compact(value) if isinstance(value, (int, float)) else str(value or "–")


# Written -----------------------------------------------------------------------------------------------------------


def write_json(path: Path, found: Stored) -> None:
    """Strict JSON. OSError."""
    write_atomically(path, json.dumps(strict(found), indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def write_html(path: Path, found: Stored) -> None:
    """One page that needs no network. OSError."""
    right = sum(not system["wrong"] for system in found["rays"])
    images = f", {len(found['images'])} renderers by images" if found["images"] else ""
    content = {
        "title": "Refraction by other systems",
        "sentence": f"Which systems refract right: {len(found['rays'])} functions by rays{images}",
        "counts": [
            ("pass", "functions without a wrong answer", right),
            ("fail", "with wrong answers", len(found["rays"]) - right),
            ("info", "not run", len(found["not_run"])),
        ],
        "sets": list(per_ray.SETS),
        "rays": [x | {"cells": [set_cell(x["sets"].get(name)) for name in per_ray.SETS]} for x in found["rays"]],
        "scenes": list(rendered_images.SCENES),
        "renderers": [
            x | {"cells": [scene_cell(x["scenes"].get(name)) for name in rendered_images.SCENES]}
            for x in found["images"]
        ],
        "not_run": found["not_run"],
        "terms": TERMS,
        "command": f"{MADE_BY}; python -m validation renderers --page {path.name}",
    }
    write_page(path, "matrix.html.j2", content, EmbeddedImages())


def set_cell(found: Stored | None) -> tuple[str, str]:
    """The text of a cell and its class, of a set of rays."""
    if not found:
        return "–", ""
    states = {"right": "pass", "within bound": "missed", "wrong": "fail"}
    wrong = "wrong, " if found["verdict"] == "wrong" else ""
    return wrong + _shown(found["backward_error"]), states[found["verdict"]]


def scene_cell(found: Stored | None) -> tuple[str, str]:
    """The text of a cell and its class, of a scene."""
    if not found:
        return "–", ""
    state = {"equal": "pass", "different": "fail"}.get(found["verdict"], "missed")
    if not isinstance(found["mean_difference"], (int, float)):
        return found["verdict"], state
    visible = f", visible from {found['detectable']:.2%}" if isinstance(found["detectable"], (int, float)) else ""
    return f"{found['verdict']}: {found['mean_difference']:+.2%}{visible}", state
