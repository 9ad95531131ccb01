"""Rows → `rows.json`, `junit.xml`, one offline `report.html`, and a table for the terminal.

Everything here lays out what the rows already say; nothing is measured, averaged or judged.

`context` is what all rows share; `study_page` says which of its entries steer the page.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refract.io.atomic import write_atomically
from mi_refract.io.sanitise import printable

from . import first_page, junit, study_page
from .embedded_images import EmbeddedImages
from .html_page import write_page
from .number_text import distinguishable
from .row import SCHEMA, Row, by_study, strict

if TYPE_CHECKING:
    from rich.console import RenderableType

WORDS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def write_json(path: str | Path, rows: Sequence[Row], context: Mapping[str, Any]) -> None:
    """Write the document `row.py` describes, as strict JSON: NaN and the infinities become words.

    Errors: TypeError for a value JSON has no form for; OSError.
    """
    document = {"schema": SCHEMA, "context": context, "rows": [row.as_dict() for row in rows]}
    text = json.dumps(strict(document), indent=1, allow_nan=False)
    write_atomically(path, text + "\n")


def read_json(path: str | Path) -> tuple[list[Row], dict[str, Any]]:
    """Read what `write_json` wrote. In `replay` and the context, non-finite numbers stay words.

    Errors: a one-line ValueError naming the file for another schema, a malformed document, or a verdict that
    does not follow from its row; OSError.
    """
    try:
        document = json.loads(Path(path).read_bytes(), parse_constant=_no_constant)
        found = document.get("schema") if isinstance(document, dict) else None
        if found != SCHEMA:
            raise ValueError(f"schema {found!r}, expected {SCHEMA}")
        rows = [_row(number, data) for number, data in enumerate(document["rows"])]
        return rows, dict(document["context"])
    except RecursionError:
        raise ValueError(f"{path}: brackets nested too deeply; expected JSON as `write_json` writes it") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        what = f"missing {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path}: {' '.join(what.split())}") from error


def _no_constant(word: str) -> float:
    raise ValueError(f"{word} is not strict JSON")


def _number(value: Any) -> float:
    if isinstance(value, str) and value in WORDS:
        return WORDS[value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value
    raise ValueError(f"{value!r} is not a number")


def _row(number: int, data: dict[str, Any]) -> Row:
    try:
        numbers = {f: {m: _number(v) for m, v in data[f].items()} for f in ("values", "budgets", "goals")}
        curves = {name: [(_number(x), _number(y)) for x, y in pts] for name, pts in data["curves"].items()}
        row = Row.from_dict(data | numbers | {"curves": curves})
        if data["verdict"] != row.verdict:
            raise ValueError(f"verdict {data['verdict']!r} does not follow from the values")
        return row
    except KeyError as error:
        raise ValueError(f"row {number}: missing {error}") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"row {number}: {error}") from error


def verdict(rows: Sequence[Row]) -> str:
    """One sentence: how many checks (budgets that were measured) passed or failed, how many rows were not run."""
    measured = sum(len(row.budgets) for row in rows if row.values)
    broken = sum(len(row.broken) for row in rows)
    missing = sum(row.verdict == "not run" for row in rows)
    if not measured:
        sentence = "Nothing was checked"
    elif broken:
        sentence = f"{broken:,} of {_count(measured, 'check')} failed"
    else:
        sentence = f"All {measured:,} checks passed" if measured > 1 else "The one check passed"
    return sentence + (f", {_count(missing, 'measurement')} not run" if missing else "")


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}" + ("" if number == 1 else "s")


def write_junit(path: str | Path, rows: Sequence[Row], context: Mapping[str, Any]) -> None:
    """One suite per study, one case per measured budget, one skipped case per row that was not run.

    Rows that demand nothing are left out: a case that cannot fail is no test. Errors: OSError.
    """
    suites = {study: [case for row in members for case in _cases(row)] for study, members in by_study(rows).items()}
    junit.write_junit(path, context.get("title", "mi_refract"), suites)


def _cases(row: Row) -> list[junit.Case]:
    name = " / ".join((row.subject, row.case, row.setting))
    if not row.values:
        return [junit.Case(row.study, name, "skipped", row.reason)]
    return [_case(row, f"{name}: {metric}", metric) for metric in row.budgets]


def _case(row: Row, name: str, metric: str) -> junit.Case:
    if metric not in row.broken:
        return junit.Case(row.study, name)
    value, budget = row.values[metric], row.budgets[metric]
    text, limit = distinguishable(value, budget)
    details = "\n".join(filter(None, (f"value {value!r}, budget {budget!r}", row.reason, row.replay_text)))
    return junit.Case(row.study, name, "failure", f"{metric} {text}, budget {limit}", details.splitlines())


def summary(rows: Sequence[Row], context: Mapping[str, Any] | None = None) -> RenderableType:
    """For rich's console: broken budgets, the answers of the context's `first_page`, then the verdict."""
    from rich.console import Group
    from rich.text import Text

    page = (context or {}).get("first_page")
    broken = [(row, metric) for row in rows for metric in row.broken]
    parts: list[RenderableType] = (
        [_bounds_table("broken budget", "budget", broken, "bold red"), Text()] if broken else []
    )
    parts += first_page.terminal(page) if page else []
    return Group(*parts, Text(verdict(rows), style="bold red" if broken else "bold"))


def goals_table(rows: Sequence[Row]) -> RenderableType:
    """For rich's console: every goal that was measured, the missed ones first, or a line that says there are none."""
    from rich.text import Text

    goals = [(row, metric) for row in rows if row.values for metric in row.goals]
    goals.sort(key=lambda goal: goal[1] not in goal[0].missed)
    return _bounds_table("goal", "goal", goals, "") if goals else Text("No goal was measured")


def _bounds_table(heading: str, bound: str, found: Sequence[tuple[Row, str]], style: str) -> RenderableType:
    from rich.table import Table
    from rich.text import Text

    table = Table(heading, "metric", box=None, pad_edge=False)
    table.add_column("value", justify="right", style=style)
    table.add_column(bound, justify="right")
    for row, metric in found:
        value, limit = distinguishable(row.values[metric], row.bounds[metric])
        missed = "yellow" if metric in row.missed else ""
        table.add_row(Text(printable(row.name)), Text(printable(metric)), Text(value, style=missed), limit)
    return table


def write_html(path: str | Path, rows: Sequence[Row], context: Mapping[str, Any], folder: str | Path) -> None:
    """Write one page that needs no other file; `folder` is what the rows' image paths are relative to.

    Images are embedded whole, three halves a pixel (a finite value past 65504 becomes 65504), each file once.
    Errors: FileNotFoundError or ValueError naming an image that is missing or not RGB or gray; OSError.
    """
    images = EmbeddedImages(Path(folder))
    content = study_page.prepare(rows, context, images) | {"sentence": verdict(rows)}
    write_page(path, "report.html.j2", content, images)
