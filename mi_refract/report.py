"""Rows → `rows.json`, `junit.xml`, one offline `report.html`, and a table for the terminal.

Everything here lays out what the rows already say; nothing is measured, averaged or judged.

`context` is what all rows share. Every entry is shown as it is, except four that steer the page:

- `title`: the page's name;
- `studies`: {study: {"title", "text", "terms", "error", "slope"}}, all optional: heading and introduction of a study,
  the name of the error in its curves (default relMSE) and the slope of their guide (default −1, since relMSE
  is a variance);
- `scatter`: [{"study", "x", "y", "title"}]: plots of one metric against another, a panel per setting;
- `replay`: the command that repeats the whole run, shown on top.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .figures import Pictures, apart, compact, curves_svg, drawable, scatter_svg
from .files import write_atomically
from .rows import SCHEMA, Row

if TYPE_CHECKING:
    from rich.console import RenderableType

VERDICTS = ("fail", "not run", "pass", "info")
STEERING = ("title", "studies", "scatter", "replay")
ROLES = ("reference", "test", "difference")
WORDS = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def write_json(path: str | Path, rows: Sequence[Row], context: Mapping[str, Any]) -> None:
    """Write the document `rows.py` describes, as strict JSON: NaN and the infinities become words.

    Errors: TypeError for a value JSON has no form for; OSError.
    """
    document = {"schema": SCHEMA, "context": context, "rows": [row.as_dict() for row in rows]}
    text = json.dumps(_strict(document), indent=1, allow_nan=False)
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
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        what = f"missing {error}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path}: {' '.join(what.split())}") from error


def _strict(value: Any) -> Any:
    if isinstance(value, float):  # numpy's float64 too, hence the conversion
        return float(value) if math.isfinite(value) else str(float(value))
    if isinstance(value, Mapping):
        return {str(key): _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return _strict(value.tolist())
    return str(value) if isinstance(value, Path) else value


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
    """One sentence: budgets measured and broken, goals missed, rows not run."""
    measured = sum(len(row.budgets) for row in rows if row.values)
    broken = sum(len(row.broken) for row in rows)
    missing = sum(row.verdict == "not run" for row in rows)
    if not measured:
        sentence = "No budget was measured"
    elif broken:
        sentence = f"{broken} of {_count(measured, 'budget')} broken"
    else:
        sentence = f"All {measured} budgets held" if measured > 1 else "The one budget held"
    missed = sum(len(row.missed) for row in rows)
    goals = sum(len(row.goals) for row in rows if row.values)
    sentence += f", {missed} of {_count(goals, 'goal')} missed" if missed else ""
    return sentence + (f", {_count(missing, 'row')} not run" if missing else "")


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _studies(rows: Iterable[Row]) -> dict[str, list[Row]]:
    studies: dict[str, list[Row]] = {}
    for row in rows:
        studies.setdefault(row.study, []).append(row)
    return studies


def write_junit(path: str | Path, rows: Sequence[Row], context: Mapping[str, Any]) -> None:
    """One suite per study, one case per measured budget, one skipped case per row that was not run.

    Rows that demand nothing are left out: a case that cannot fail is no test. Errors: OSError.
    """
    from xml.etree import ElementTree as xml

    root = xml.Element("testsuites", name=_xml(context.get("title", "mi_refract")))
    for study, members in _studies(rows).items():
        suite = xml.SubElement(root, "testsuite", name=_xml(study))
        for row in members:
            _junit_cases(suite, row)
        counts = Counter(child.tag for case in suite for child in case)
        tally = {"tests": len(suite), "failures": counts["failure"], "skipped": counts["skipped"]}
        suite.attrib.update({key: str(count) for key, count in tally.items()}, errors="0")
    for key in ("tests", "failures", "skipped", "errors"):
        root.set(key, str(sum(int(suite.get(key, "0")) for suite in root)))
    xml.indent(root)
    write_atomically(path, xml.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _junit_cases(suite: Any, row: Row) -> None:
    from xml.etree import ElementTree as xml

    name = " / ".join((row.subject, row.case, row.setting))
    if not row.values:
        case = xml.SubElement(suite, "testcase", classname=_xml(row.study), name=_xml(name))
        xml.SubElement(case, "skipped", message=_xml(row.reason))
    for metric, budget in row.budgets.items() if row.values else ():
        case = xml.SubElement(suite, "testcase", classname=_xml(row.study), name=_xml(f"{name}: {metric}"))
        if metric in row.broken:
            text, limit = apart(row.values[metric], budget)
            failure = xml.SubElement(case, "failure", message=_xml(f"{metric} {text}, budget {limit}"))
            parts = (f"value {row.values[metric]!r}, budget {budget!r}", row.reason, _replay(row))
            failure.text = _xml("\n".join(filter(None, parts)))


def _xml(text: Any) -> str:
    """Text in the characters XML 1.0 has; the others (terminal escapes, say) become U+FFFD."""
    return re.sub("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", str(text))


def summary(rows: Sequence[Row]) -> RenderableType:
    """Broken budgets and missed goals first, then verdicts by study, then the sentence, for rich's console."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    broken, missed = ([(row, m) for row in rows for m in getattr(row, kind)] for kind in ("broken", "missed"))
    parts: list[RenderableType] = []
    for heading, exceeded, style in (("broken budget", broken, "bold red"), ("missed goal", missed, "yellow")):
        table = Table(heading, "metric", box=None, title_justify="left", pad_edge=False)
        table.add_column("value", justify="right", style=style)
        table.add_column("bound", justify="right")
        for row, metric in exceeded:
            table.add_row(Text(row.name), Text(metric), *apart(row.values[metric], row.bounds[metric]))
        parts += [table, Text()] if exceeded else []
    counts = Table("study", box=None, pad_edge=False)
    for word in VERDICTS:
        counts.add_column(word, justify="right")
    for study, members in _studies(rows).items():
        tally = Counter(row.verdict for row in members)
        styles = {"fail": "bold red", "not run": "yellow", "pass": "green", "info": ""}
        cells = [Text(str(tally[w] or "·"), style=styles[w] if tally[w] else "dim") for w in VERDICTS]
        counts.add_row(Text(study), *cells)
    return Group(*parts, counts, Text(), Text(verdict(rows), style="bold red" if broken else "bold"))


def write_html(path: str | Path, rows: Sequence[Row], context: Mapping[str, Any], folder: str | Path) -> None:
    """Write one page that needs no other file; `folder` is what the rows' picture paths are relative to.

    Pictures are embedded whole, three halves a pixel (a value past 65504 becomes infinite), each file once.
    Errors: FileNotFoundError or ValueError naming a picture that is missing or not RGB or gray; OSError.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    here = Path(__file__).parent
    strict: Any = {
        "autoescape": True,
        "undefined": StrictUndefined,
        "trim_blocks": True,
        "lstrip_blocks": True,
    }
    environment = Environment(loader=FileSystemLoader(here), **strict)
    environment.filters |= {"compact": compact, "words": _words}
    pictures = Pictures(Path(folder))
    page = _page(rows, context, pictures)
    inline = {name: Markup((here / f"report.{name}").read_text("utf-8")) for name in ("css", "js")}
    text = environment.get_template("report.html.j2").render(**page, **inline, pictures=pictures.embedded)
    write_atomically(path, text.encode("utf-8", "replace"))


def _page(rows: Sequence[Row], context: Mapping[str, Any], pictures: Pictures) -> dict[str, Any]:
    verdicts = Counter(row.verdict for row in rows)
    return {
        "title": context.get("title", "mi_refract"),
        "sentence": verdict(rows),
        "state": "fail" if verdicts["fail"] else "pass" if verdicts["pass"] else "empty",
        "counts": [(word, verdicts[word]) for word in ("pass", "fail", "not run", "info")],
        "context": {key: value for key, value in context.items() if key not in STEERING},
        "command": context.get("replay", ""),
        "failures": [{"row": r, "broken": [(m, _cell(r, m)) for m in r.broken],
                      "others": [_phrase(r, m) for m in r.values if m not in r.broken],
                      "replay": _replay(r)} for r in rows if r.broken],
        "missing": _missing(rows),
        "absent": verdicts["not run"],
        "studies": [
            _study(name, members, context, pictures, f"study-{number}")
            for number, (name, members) in enumerate(_studies(rows).items(), 1)
        ],
    }  # fmt: skip


def _missing(rows: Sequence[Row]) -> list[tuple[str, str, list[Row]]]:
    """The rows that were not run, one entry per study and reason."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row.verdict == "not run":
            groups.setdefault((row.study, row.reason), []).append(row)
    return [(*key, members) for key, members in groups.items()]


def _study(name: str, rows: list[Row], context: Mapping[str, Any], pictures: Pictures, key: str) -> dict[str, Any]:
    about = context.get("studies", {}).get(name, {})
    metrics = list(dict.fromkeys(metric for row in rows for metric in row.values))
    labels = {"error": about.get("error", "relMSE"), "slope": about.get("slope", -1)}
    plots = [(row, curves_svg(row.curves, **labels, salt=f"{key}-{number}"), _left_out(row))
             for number, row in enumerate(rows) if row.curves]  # fmt: skip
    scatters = [scatter for scatter in context.get("scatter", ()) if scatter["study"] == name]
    return {
        "key": key,
        "title": about.get("title", name),
        "text": about.get("text", ""), "terms": about.get("terms", {}),
        "failures": sum(row.verdict == "fail" for row in rows),
        "scale": (scale := _scale(rows, metrics)),
        "panels": _panels(rows, metrics, scale),
        "scatters": [_scatter(s, rows, f"{key}-scatter-{i}") for i, s in enumerate(scatters)],
        "plots": plots,
        "figures": [_figure(row, pictures) for row in rows if row.pictures],
    }


def _panels(rows: list[Row], metrics: list[str], scale: tuple[float, float] | None) -> list[dict[str, Any]]:
    """A table per setting, under a matrix of subjects by cases, where there is enough to see."""
    settings = list(dict.fromkeys(row.setting for row in rows))
    parts = {setting: [row for row in rows if row.setting == setting] for setting in settings}
    matrices = {setting: _matrix(part, metrics, scale) for setting, part in parts.items()}
    if not any(matrices.values()):
        return [{"heading": "", "matrix": None, "table": _table(rows, metrics)}]
    return [
        {"heading": s, "matrix": matrices[s],
         "table": _table(parts[s], metrics, s) if any(row.values for row in parts[s]) else None,
         "reasons": list(dict.fromkeys(row.reason for row in parts[s]))}
        for s in settings
    ]  # fmt: skip


def _matrix(rows: list[Row], metrics: list[str], scale: tuple[float, float] | None) -> dict[str, Any] | None:
    subjects = list(dict.fromkeys(row.subject for row in rows))
    cases = list(dict.fromkeys(row.case for row in rows))
    cells = {(row.subject, row.case): row for row in rows}
    if len(subjects) < 3 or len(cases) < 3 or len(cells) < len(rows) or scale is None:
        return None
    lines = [(s, [_shade(cells.get((s, c)), metrics[0], scale) for c in cases]) for s in subjects]
    return {"metric": metrics[0], "cases": cases, "lines": lines}


def _shade(row: Row | None, metric: str, scale: tuple[float, float]) -> dict[str, Any]:
    """A cell of the matrix: its number, how deep its colour is on the logarithmic scale, what it broke."""
    if row is None or not row.values:
        text, state, hint = ("not run", "not-run", row.reason) if row else ("·", "none", "")
        return {"text": text, "state": state, "depth": 0, "hint": hint, "broken": []}
    low, high = map(math.log, scale)
    value = row.values.get(metric, 0)
    place = (math.log(value) - low) / (high - low) if 0 < value < math.inf and high > low else 0
    depth = round(place, 3) if value < math.inf else 1  # NaN is no small error
    hint = "\n".join(_phrase(row, m) for m in row.values)
    broken = [_bound(row, m) if m == metric else _phrase(row, m) for m in row.broken]
    cell = _cell(row, metric)
    return {
        "text": cell["text"] if cell else "·",
        "state": row.verdict,
        "depth": depth,
        "hint": hint,
        "broken": broken,
    }


def _scale(rows: list[Row], metrics: list[str]) -> tuple[float, float] | None:
    values = [row.values[metrics[0]] for row in rows if metrics and metrics[0] in row.values]
    positive = [value for value in values if 0 < value < math.inf]
    return (min(positive), max(positive)) if positive else None


def _phrase(row: Row, metric: str) -> str:
    if metric not in row.bounds:
        return f"{metric} {compact(row.values[metric])}"
    return f"{metric} {apart(row.values[metric], row.bounds[metric])[0]} {_bound(row, metric)}"


def _bound(row: Row, metric: str) -> str:
    """The budget or goal with how the value stands to it; NaN is neither above nor below."""
    value, budget = row.values[metric], row.bounds[metric]
    sign = "≤" if value <= budget else ">" if value > budget else "≰"
    return f"{sign} {apart(value, budget)[1]}"


def _table(rows: list[Row], metrics: list[str], heading: str = "") -> dict[str, Any]:
    """Columns: what tells the rows apart, then every metric; a label equal to the one above is marked."""
    keys = [k for k in ("subject", "case", "setting") if len({getattr(row, k) for row in rows}) > 1]
    keys = keys or ["subject"]
    used = [m for m in metrics if any(m in row.values for row in rows)]
    lines, above = [], [""] * len(keys)
    for row in rows:
        labels = [getattr(row, key) for key in keys]
        again = [labels[: i + 1] == above[: i + 1] for i in range(len(keys))]
        cells = [_cell(row, metric) for metric in used]
        lines.append({"row": row, "labels": list(zip(labels, again, strict=True)), "cells": cells,
                      "replay": _replay(row)})  # fmt: skip
        above = labels
    shared = [getattr(rows[0], k) for k in ("subject", "case", "setting") if k not in keys]
    shared = [label for label in shared if label and label != heading]
    return {"keys": keys, "metrics": used, "lines": lines, "shared": " · ".join(shared)}


def _cell(row: Row, metric: str) -> dict[str, str] | None:
    if metric not in row.values:
        return None
    if metric not in row.bounds:
        return {"state": "info", "text": compact(row.values[metric]), "budget": ""}
    text = apart(row.values[metric], row.bounds[metric])[0]
    state = "fail" if metric in row.broken else "missed" if metric in row.missed else "pass"
    return {"state": state, "text": text, "budget": _bound(row, metric)}


def _replay(row: Row) -> str:
    """`row.replay` as JSON, one entry a line; "" where there is none."""
    form: Any = {"ensure_ascii": False, "default": str}
    entries = [f" {json.dumps(k, **form)}: {json.dumps(v, **form)}" for k, v in _strict(row.replay).items()]
    return "{\n" + ",\n".join(entries) + "\n}" if entries else ""


def _left_out(row: Row) -> int:
    return sum(len(points) - len(drawable(points, log_x=True)) for points in row.curves.values())


def _scatter(scatter: Mapping[str, str], rows: list[Row], salt: str) -> dict[str, Any]:
    x, y = scatter["x"], scatter["y"]
    panels: dict[str, dict[str, list[tuple[float, float]]]] = {}
    points = [(row, (row.values[x], row.values[y])) for row in rows if x in row.values and y in row.values]
    for row, point in points:
        panels.setdefault(row.setting, {}).setdefault(row.subject, []).append(point)
    omitted = len(points) - len(drawable([point for _, point in points], log_x=False))
    svg = scatter_svg(panels, x=x, y=y, salt=salt)
    return {"title": scatter.get("title", f"{y} against {x}"), "svg": svg, "omitted": omitted}


def _figure(row: Row, pictures: Pictures) -> dict[str, Any]:
    roles = [role for role in ROLES if role in row.pictures]
    roles += [role for role in row.pictures if role not in ROLES]
    panes = [(role, pictures.embed(row.pictures[role])) for role in roles]
    return {"row": row, "panes": panes, "paired": roles[:2] == ["reference", "test"]}


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_words(item)}" for key, item in value.items())
    return ", ".join(map(_words, value)) if isinstance(value, list | tuple) else str(value)
