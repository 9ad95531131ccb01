"""Reports of rows: `rows.json`, `junit.xml`, one offline `report.html`, and a table for the terminal.

Nothing is measured, averaged or judged here. `context` has the properties that all rows share; `study_page` documents
the entries that control the page.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refract.io.text import distinguishable, printable

from . import documents, study_page
from .documents import write_page
from .embedded_images import EmbeddedImages
from .row import SCHEMA, Row, by_study, write_strict_json

if TYPE_CHECKING:
    from rich.console import RenderableType


def write_json(path: str | Path, rows: Sequence[Row], context: Mapping[str, Any]) -> None:
    """Write `rows.json`, see module `row`, as strict JSON: NaN and infinities become strings.

    Errors: TypeError for a value that JSON cannot represent; OSError.
    """
    write_strict_json(path, {"schema": SCHEMA, "context": context, "rows": [row.as_dict() for row in rows]})


def verdict(rows: Sequence[Row]) -> str:
    """Return a sentence: how many checks (budgets of measured rows) passed or failed, how many rows were not run."""
    measured = sum(len(row.budgets) for row in rows if row.values)
    broken = study_page.failed_checks(rows)
    missing = sum(row.verdict == "not run" for row in rows)
    if not measured:
        sentence = "Nothing was checked"
    elif broken:
        sentence = f"{broken:,} of {measured:,} check{'s' * (measured != 1)} failed"
    else:
        sentence = f"All {measured:,} checks passed" if measured > 1 else "The one check passed"
    return sentence + (f", {missing:,} measurement{'s' * (missing != 1)} not run" if missing else "")


def write_junit(path: str | Path, rows: Sequence[Row], context: Mapping[str, Any]) -> None:
    """Write JUnit's XML: a suite per study, a case per measured budget, and a skipped case per row that was not run.

    Rows without a budget are left out, because they cannot fail. Errors: OSError.
    """

    def cases(row: Row) -> Iterator[documents.Case]:
        name = " / ".join((row.subject, row.case, row.setting))
        if not row.values:
            yield documents.Case(row.study, name, "skipped", row.reason)
            return
        for metric, budget in row.budgets.items():
            if metric in row.broken:
                text, limit = distinguishable(row.values[metric], budget)
                details = f"value {row.values[metric]!r}, budget {budget!r}\n{row.reason}\n{row.replay_text}"
                lines = [line for line in details.splitlines() if line]
                message = f"{metric} {text}, budget {limit}"
                yield documents.Case(row.study, f"{name}: {metric}", "failure", message, lines)
            else:
                yield documents.Case(row.study, f"{name}: {metric}")

    suites = {study: [case for row in members for case in cases(row)] for study, members in by_study(rows).items()}
    documents.write_junit(path, context.get("title", "mi_refract"), suites)


def summary(rows: Sequence[Row], context: Mapping[str, Any] | None = None) -> RenderableType:
    """Return the answers of the context's `first_page`, the broken budgets and the verdict, for rich's console."""
    from rich.console import Group
    from rich.padding import Padding
    from rich.text import Text

    broken = [(row, metric) for row in rows for metric in row.broken]
    parts: list[RenderableType] = []
    styles = {"yes": "bold green", "no": "bold red", "plain": "bold", "not measured": "bold yellow"}
    for answer in ((context or {}).get("first_page") or {}).get("answers", ()):
        text = Text.assemble(*((part, "cyan" if i % 2 else "") for i, part in enumerate(answer["text"].split("`"))))
        parts.append(Text(answer["question"].replace("`", ""), style=styles[answer["state"]]))
        parts.append(Padding(text, (0, 0, 1, 2)))
    if broken:
        parts += [_bounds_table("broken budget", "budget", broken, "bold red"), Text()]
    return Group(*parts, Text(verdict(rows), style="bold red" if broken else "bold"))


def goals_table(rows: Sequence[Row]) -> RenderableType:
    """Return every measured goal, missed ones first, or a line that says there are none, for rich's console."""
    from rich.text import Text

    goals = [(row, metric) for row in rows if row.values for metric in row.goals]
    goals.sort(key=lambda goal: goal[1] not in goal[0].missed)
    return _bounds_table("goal", "goal", goals, "") if goals else Text("No goal was measured")


def _bounds_table(heading: str, bound: str, bounds: Sequence[tuple[Row, str]], style: str) -> RenderableType:
    from rich.table import Table
    from rich.text import Text

    table = Table(heading, "metric", box=None, pad_edge=False)
    table.add_column("value", justify="right", style=style)
    table.add_column(bound, justify="right")
    for row, metric in bounds:
        value, limit = distinguishable(row.values[metric], row.bounds[metric])
        missed = "yellow" if metric in row.missed else ""
        table.add_row(Text(printable(row.name)), Text(printable(metric)), Text(value, style=missed), limit)
    return table


def write_html(path: str | Path, rows: Sequence[Row], context: Mapping[str, Any], folder: str | Path) -> None:
    """Write one page that needs no other file; `folder`: the folder that the rows' image paths are relative to.

    Images are embedded at full size, as half floats (a finite value beyond ±65504 becomes ±65504), each file once.
    Errors: FileNotFoundError or ValueError, with the path, for an image that is missing or neither RGB nor gray;
    OSError.
    """
    images = EmbeddedImages(Path(folder))
    content = study_page.prepare(rows, context, images) | {"sentence": verdict(rows)}
    write_page(path, "report.html.j2", content, images)
