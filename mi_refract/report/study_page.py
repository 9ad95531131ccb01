"""The content of a study's page, made from rows: the first screen, panels, tables, plots and images.

Nothing is measured or judged here. `context` has the properties that all rows share. Its entries are shown unchanged,
except five that control the page:

- `first_page`: questions and answers at the top (`FirstPage`); words between backticks are code;
- `title`: the title of the page;
- `studies`: {study: {"title", "text", "terms", "axes", "scale"}}, all optional: heading, introduction and glossary of a
  study; the fields of `plots.Axes` for the curves of its rows; and the smallest and the largest number of the colour
  scale of its matrices (by default those of its rows);
- `scatter`: [{"study", "x", "y", "title", "interval", "floor", "front"}]: plots of one metric against another, a panel
  per setting; all but the first three are optional. `interval`: two metrics that are the lower and the upper bound of
  x; `floor`: a subject whose x is drawn as a line (it has no y); `front`: draw steps along the Pareto front of a panel;
- `replay`: the command that repeats the whole run, shown at the top.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NotRequired, TypedDict, get_args

from mi_refract.io.text import beside_bound, compact

from .embedded_images import EmbeddedImages, packed
from .plots import Axes, Points, Scatter, curves_svg, drawable, scatter_svg
from .row import Row, by_study, strict_json

CONTROLS = ("first_page", "title", "studies", "scatter", "replay")  # entries of the context
ROLES = ("reference", "test", "overlay", "difference")
LABELS = ("subject", "case", "setting")
NOT_RUN = "not run"
State = Literal["yes", "no", "plain", "not measured"]
STATES: tuple[State, ...] = get_args(State)
COLUMNS = 13  # columns of a matrix that fit into a window of 1280 pixels, without its labels
CHARACTERS = 148  # characters of a table's line in such a window
LISTED = 3  # failures on the first screen


class Answer(TypedDict):
    """A question, and the answer that the rows give.

    `state`: "yes" if every budget behind the answer held, "no" if one did not, "plain" if there is none, "not measured"
    if no row answers the question, or noise hides the answer. `study`: the section to link to; NOT_RUN: the list of
    rows that were not run; or "".
    """

    question: str
    text: str
    state: State
    study: str


class ShownRow(TypedDict):
    """Images or curves of a row to show: the row's name, labels by role or by curve, and the caption."""

    row: str
    labels: Mapping[str, str]
    caption: str
    axes: NotRequired[Mapping[str, Any]]


class FirstPage(TypedDict):
    """The first screen: an introduction, answers, an image, a plot; all but the answers are optional."""

    lead: NotRequired[str]
    answers: Sequence[Answer]
    image: NotRequired[ShownRow]
    plot: NotRequired[ShownRow]


def prepare(rows: Sequence[Row], context: Mapping[str, Any], images: EmbeddedImages) -> dict[str, Any]:
    """Return the values for the template `report.html.j2`.

    Errors: ValueError if the first page has an unknown state or row; those of `EmbeddedImages.embed`.
    """
    verdicts = Counter(row.verdict for row in rows)
    failures = [row for row in rows if row.broken]
    # "pass" and "fail" count checks, as in the sentence above them; the others count rows.
    held = sum(len(row.budgets) - len(row.broken) for row in rows if row.values)
    counts = {"pass": held, "fail": failed_checks(rows), NOT_RUN: verdicts[NOT_RUN], "info": verdicts["info"]}
    studies = by_study(rows)
    keys = {name: f"study-{number}" for number, name in enumerate(studies, 1)}
    screen: dict[str, Any] = {}
    first: FirstPage | None = context.get("first_page")
    if first:  # answers with links to the studies, panes of the image, SVG of the plot
        screen = {"lead": first.get("lead", ""), "answers": [], "image": None, "plot": None}
        for answer in first["answers"]:
            if answer["state"] not in STATES:
                raise ValueError(f"first page: state {answer['state']!r}; expected {', '.join(STATES)}")
            link = "missing" if answer["study"] == NOT_RUN else keys.get(answer["study"], "")
            screen["answers"].append({**answer, "link": link})
        by_name = {row.name: row for row in rows}
        for shown_row in filter(None, (first.get("image"), first.get("plot"))):
            if shown_row["row"] not in by_name:
                raise ValueError(f"first page: there is no row {shown_row['row']!r}")
        if image := first.get("image"):
            files = by_name[image["row"]].images
            panes = [images.embed(files[role]) | {"role": role, "label": x} for role, x in image["labels"].items()]
            screen["image"] = {"panes": panes, "caption": image["caption"]}
        if plot := first.get("plot"):
            curves = {label: by_name[plot["row"]].curves[name] for name, label in plot["labels"].items()}
            svg = curves_svg(curves, Axes(**plot.get("axes", {})), salt="first", size=(6.2, 2.3))
            screen["plot"] = {"svg": svg, "caption": plot["caption"]}
    return {
        "first": screen,
        "title": context.get("title", "mi_refract"),
        "state": "fail" if verdicts["fail"] else "pass" if verdicts["pass"] else "empty",
        "counts": list(counts.items()),
        "context": {key: value for key, value in context.items() if key not in CONTROLS},
        "command": context.get("replay", ""),
        "failures": failures,
        "failed": counts["fail"],
        "unlisted": failed_checks(failures[LISTED:]),
        "missing": not_run(rows),
        "absent": verdicts[NOT_RUN],
        "studies": [_study(name, members, context, images, keys[name]) for name, members in studies.items()],
        "listed": LISTED,
        "cell": cell,
        "phrase": phrase,
    }


def failed_checks(rows: Iterable[Row]) -> int:
    """Return the number of broken budgets of the rows."""
    return sum(len(row.broken) for row in rows)


def not_run(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the rows that were not run, by their reason, the most frequent first."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        if row.verdict == NOT_RUN:
            groups.setdefault(row.reason, []).append(row)
    return dict(sorted(groups.items(), key=lambda item: -len(item[1])))


# Cells ----------------------------------------------------------------------------------------------------------------


def cell(row: Row, metric: str) -> dict[str, str] | None:
    """Return text, state and bound of a value, the bound after ≤ or >; None if the row lacks the metric."""
    if metric not in row.values:
        return None
    if metric not in row.bounds:
        return {"state": "info", "text": compact(row.values[metric]), "budget": ""}
    text, budget = beside_bound(row.values[metric], row.bounds[metric])
    state = "fail" if metric in row.broken else "missed" if metric in row.missed else "pass"
    return {"state": state, "text": text, "budget": budget}


def phrase(row: Row, metric: str) -> str:
    """Return a metric, its value and its bound as one text."""
    content = cell(row, metric)
    return " ".join(filter(None, (metric, content["text"], content["budget"]))) if content else metric


def _shade(row: Row | None, metric: str, scale: tuple[float, float]) -> dict[str, Any]:
    """Return a cell of the matrix: number, place on the logarithmic colour scale, broken and missed bounds."""
    if row is None or not row.values:
        text, state, hint = ("not run", "not-run", row.reason) if row else ("·", "none", "")
        return {"text": text, "state": state, "depth": 0, "hint": hint, "broken": [], "beyond": False}
    low, high = scale
    value, content = row.values.get(metric, 0), cell(row, metric)
    place = math.log(value / low) / math.log(high / low) if low < value <= high else 0
    exceeded = (*row.broken, *row.missed)
    return {
        "text": content["text"] if content else "·",
        "state": row.verdict,
        "depth": round(place, 3) if value <= high else 1,
        "beyond": not value <= high,  # also for NaN
        "hint": "\n".join(phrase(row, m) for m in row.values),
        "broken": [content["budget"] if content and m == metric else phrase(row, m) for m in exceeded],
    }


# Studies --------------------------------------------------------------------------------------------------------------


def _study(name: str, rows: list[Row], context: Mapping[str, Any], images: EmbeddedImages, key: str) -> dict[str, Any]:
    description = context.get("studies", {}).get(name, {})
    metrics = list(dict.fromkeys(metric for row in rows for metric in row.values))
    axes = Axes(**description.get("axes", {}))
    plots = [
        (row, curves_svg(row.curves, axes, salt=f"{key}-{number}"), _undrawn(row.curves.values(), axes))
        for number, row in enumerate(rows)
        if row.curves
    ]
    requests = [request for request in context.get("scatter", ()) if request["study"] == name]
    scatters = [_scatter(request, rows, f"{key}-scatter-{i}") for i, request in enumerate(requests)]
    figures = []
    for row in rows:
        if row.images:
            roles = sorted(row.images, key=lambda role: ROLES.index(role) if role in ROLES else len(ROLES))
            paints = {role: ("signed", 3) if role == "difference" else ("light", None) for role in roles}
            panes = [
                {"role": role, "paint": paint, "gain": gain} | images.embed(row.images[role])
                for role, (paint, gain) in paints.items()
            ]
            figures.append({"row": row, "panes": panes, "paired": roles[:2] == ["reference", "test"]})
    values = [row.values.get(metrics[0], 0) for row in rows] if metrics else []
    positive = [value for value in values if 0 < value < math.inf]
    scale = description.get("scale") or ((min(positive), max(positive)) if positive else None)
    return {
        "key": key,
        "title": description.get("title", name),
        "text": description.get("text", ""),
        "terms": description.get("terms", {}),
        "failures": failed_checks(rows),
        "scale": scale,
        "panels": _panels(rows, metrics, scale),
        "missing": not_run(rows),
        "data": packed(strict_json([row.as_dict() for row in rows])),
        "count": len(rows),
        "scatters": [scatter for scatter in scatters if scatter],
        "plots": plots,
        "figures": figures,
    }


def _panels(rows: list[Row], metrics: list[str], scale: tuple[float, float] | None) -> list[dict[str, Any]]:
    """Return a table per setting below a matrix of subjects by cases, or without any matrix a table of all settings.

    A setting has a matrix if it has at least 3 subjects and 3 cases. The cases are the columns, or the lines if there
    are too many and more than subjects. Subjects and cases without a run row in a setting are left out. Without
    matrices, rows that share no metric with the others have a separate table.
    """
    run = {(row.setting, label) for row in rows if row.values for label in (("s", row.subject), ("c", row.case))}
    rows = [row for row in rows if {(row.setting, ("s", row.subject)), (row.setting, ("c", row.case))} <= run]
    by_setting: dict[str, list[Row]] = {}
    for row in rows:
        by_setting.setdefault(row.setting, []).append(row)
    matrices: dict[str, dict[str, Any] | None] = dict.fromkeys(by_setting)
    for setting, members in by_setting.items():
        informative = [row for row in members if metrics[0] in row.values or row.broken]
        subjects, cases = (dict.fromkeys(getattr(row, label) for row in informative) for label in ("subject", "case"))
        cells = {(row.subject, row.case): row for row in members}
        if len(subjects) >= 3 and len(cases) >= 3 and len(cells) == len(members) and scale is not None:
            shades = {key: _shade(cells.get(key), metrics[0], scale) for key in itertools.product(subjects, cases)}
            if len(cases) > max(COLUMNS, len(subjects)):
                columns, lines = subjects, [(c, [shades[s, c] for s in subjects]) for c in cases]
            else:
                columns, lines = cases, [(s, [shades[s, c] for c in cases]) for s in subjects]
            matrices[setting] = {"metric": metrics[0], "columns": list(columns), "lines": lines}
    if any(matrices.values()):
        return [
            {"heading": setting, "matrix": matrices[setting], "table": _table(members, metrics, setting)}
            for setting, members in by_setting.items()
        ]
    groups: list[tuple[set[str], list[int]]] = []  # metrics, and the indices of the rows that have any of them
    rows = [row for row in rows if row.values]
    for index, row in enumerate(rows):
        joined, indices = set(row.values), [index]
        for group in [group for group in groups if group[0] & joined]:
            groups.remove(group)
            joined, indices = joined | group[0], indices + group[1]
        groups.append((joined, sorted(indices)))
    groups.sort(key=lambda group: group[1])
    tables = [_table([rows[index] for index in indices], metrics) for _, indices in groups]
    return [{"heading": "", "matrix": None, "table": table} for table in tables]


def _table(rows: list[Row], metrics: list[str], heading: str = "") -> dict[str, Any]:
    """Return a table. Its columns are the labels that differ between rows, then every metric.

    A label equal to the one above is marked. `parts`: the metrics, split into tables that fit into the page's width.
    """
    rows = [row for row in rows if row.values]
    keys = [k for k in LABELS if len({getattr(row, k) for row in rows}) > 1] or ["subject"]
    used = [m for m in metrics if any(m in row.values for row in rows)]
    lines, above = [], [""] * len(keys)
    for row in rows:
        labels = [getattr(row, key) for key in keys]
        lines.append((row, [(label, labels[: i + 1] == above[: i + 1]) for i, label in enumerate(labels)]))
        above = labels
    shared = [label for k in LABELS if k not in keys and (label := getattr(rows[0], k)) and label != heading]
    room = CHARACTERS - sum(max(len(getattr(row, key)) for row in rows) + 3 for key in keys)
    parts: list[list[str]] = [[]]
    remaining = room
    for metric in used:
        words = metric.split()
        for content in (cell(row, metric) for row in rows):
            words += [content["text"], content["budget"]] if content else []
        width = max(map(len, words)) + 3
        if width > remaining and parts[-1]:
            parts.append([])
            remaining = room
        parts[-1].append(metric)
        remaining -= width
    return {"keys": keys, "parts": parts, "lines": lines, "shared": " · ".join(shared)}


def _undrawn(lines: Iterable[Points], axes: Axes) -> int:
    """Return the number of points that cannot be drawn."""
    return sum(len(points) - len(drawable(points, axes)) for points in lines)


def _scatter(request: Mapping[str, Any], rows: list[Row], salt: str) -> dict[str, Any] | None:
    """Return the plot for an entry of `scatter` in the context; None if no point can be drawn."""
    x, y, floor = request["x"], request["y"], request.get("floor", "")
    panels: dict[str, Scatter] = {}
    for row in rows:
        panel = panels.setdefault(row.setting, Scatter())
        if x in row.values and y in row.values:
            panel.points.setdefault(row.subject, []).append((row.values[x], row.values[y]))
            low, high = (row.values.get(metric, math.nan) for metric in request.get("interval", (x, x)))
            panel.intervals.append((row.subject, low, high, row.values[y]))
        elif x in row.values and row.subject == floor:
            panel.floor = row.values[x]
    if not (lines := [points for panel in panels.values() for points in panel.points.values()]):
        return None
    axes = Axes(x, y, x_scale="linear")
    svg = scatter_svg(panels, axes, floor=floor, front=request.get("front", False), salt=salt)
    return {"title": request.get("title", f"{y} against {x}"), "svg": svg, "omitted": _undrawn(lines, axes)}
