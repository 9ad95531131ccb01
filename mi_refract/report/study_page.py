"""The content of the page, laid out from the rows: the first screen, panels, tables, plots and images.

Nothing is measured or judged here. `context` is what all rows share. Every entry is shown as it is, except five that
steer the page:

- `first_page`: questions and answers on top (`FirstPage`); words between backticks are code;
- `title`: the page's name;
- `studies`: {study: {"title", "text", "terms", "axes", "scale"}}, all optional: heading, introduction and glossary of a
  study; the fields of `plots.Axes`, which say how the curves of its rows are drawn; and the smallest and the largest
  number that mean something, between which the colours of its matrices run (by default those of its rows);
- `scatter`: [{"study", "x", "y", "title", "interval", "floor", "front"}]: plots of one metric against another, a panel
  per setting; all but the first three optional. `interval` are two metrics between which x lies, `floor` the subject
  whose x is a line (it has no y), `front` steps along the points that no other one of the panel beats in x and y;
- `replay`: the command that repeats the whole run, shown on top.
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
from .row import Row, as_json, by_study

STEERING = ("first_page", "title", "studies", "scatter", "replay")
ROLES = ("reference", "test", "overlay", "difference")
LABELS = ("subject", "case", "setting")
NOT_RUN = "not run"
State = Literal["yes", "no", "plain", "not measured"]
STATES: tuple[State, ...] = get_args(State)
COLUMNS = 13  # of a matrix, beside its labels: more do not fit into a window of 1280 pixels
CHARACTERS = 148  # of a table's line there
LISTED = 3  # failures on the first screen


class Answer(TypedDict):
    """A question, and the answer that the rows give.

    `state`: "yes" where every budget behind the answer held, "no" where one did not, "plain" where there is none, "not
    measured" where no row answers. `study`: the section to link to; NOT_RUN for the list of what was not run; or "".
    """

    question: str
    text: str
    state: State
    study: str


class ShownRow(TypedDict):
    """Images or curves of one row, by the row's name: their labels by role or by curve, and the caption."""

    row: str
    labels: Mapping[str, str]
    caption: str
    axes: NotRequired[Mapping[str, Any]]


class FirstPage(TypedDict):
    """All of the first screen: an introduction, answers, an image, a plot; all but the answers are optional."""

    lead: NotRequired[str]
    answers: Sequence[Answer]
    image: NotRequired[ShownRow]
    plot: NotRequired[ShownRow]


def prepare(rows: Sequence[Row], context: Mapping[str, Any], images: EmbeddedImages) -> dict[str, Any]:
    """The values for the template `report.html.j2`.

    Errors: ValueError where the first page has an unknown state or row; those of `EmbeddedImages.embed`.
    """
    verdicts = Counter(row.verdict for row in rows)
    failures = [row for row in rows if row.broken]
    # Of checks, as in the sentence above them; of rows where nothing is checked.
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
        for shown in filter(None, (first.get("image"), first.get("plot"))):
            if shown["row"] not in by_name:
                raise ValueError(f"first page: there is no row {shown['row']!r}")
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
        "context": {key: value for key, value in context.items() if key not in STEERING},
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
    """How many budgets of the rows are broken."""
    return sum(len(row.broken) for row in rows)


def not_run(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows that were not run by their reason, the most frequent first."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        if row.verdict == NOT_RUN:
            groups.setdefault(row.reason, []).append(row)
    return dict(sorted(groups.items(), key=lambda item: -len(item[1])))


# Cells ----------------------------------------------------------------------------------------------------------------


def cell(row: Row, metric: str) -> dict[str, str] | None:
    """Text, state and bound of a value; the bound with how the value compares."""
    if metric not in row.values:
        return None
    if metric not in row.bounds:
        return {"state": "info", "text": compact(row.values[metric]), "budget": ""}
    text, budget = beside_bound(row.values[metric], row.bounds[metric])
    state = "fail" if metric in row.broken else "missed" if metric in row.missed else "pass"
    return {"state": state, "text": text, "budget": budget}


def phrase(row: Row, metric: str) -> str:
    """A metric, its value and its bound in a line."""
    shown = cell(row, metric)
    return " ".join(filter(None, (metric, shown["text"], shown["budget"]))) if shown else metric


def _shade(row: Row | None, metric: str, scale: tuple[float, float]) -> dict[str, Any]:
    """A cell of the matrix: its number, how deep its colour is on the logarithmic scale, what it broke or missed.

    `beyond`: whether the number is larger than the scale's end, or none.
    """
    if row is None or not row.values:
        text, state, hint = ("not run", "not-run", row.reason) if row else ("·", "none", "")
        return {"text": text, "state": state, "depth": 0, "hint": hint, "broken": [], "beyond": False}
    low, high = scale
    value, shown = row.values.get(metric, 0), cell(row, metric)
    place = math.log(value / low) / math.log(high / low) if low < value <= high else 0
    exceeded = (*row.broken, *row.missed)
    return {
        "text": shown["text"] if shown else "·",
        "state": row.verdict,
        "depth": round(place, 3) if value <= high else 1,  # NaN is no small error
        "beyond": not value <= high,
        "hint": "\n".join(phrase(row, m) for m in row.values),
        "broken": [shown["budget"] if shown and m == metric else phrase(row, m) for m in exceeded],
    }


# Studies --------------------------------------------------------------------------------------------------------------


def _study(name: str, rows: list[Row], context: Mapping[str, Any], images: EmbeddedImages, key: str) -> dict[str, Any]:
    about = context.get("studies", {}).get(name, {})
    metrics = list(dict.fromkeys(metric for row in rows for metric in row.values))
    axes = Axes(**about.get("axes", {}))
    plots = [
        (row, curves_svg(row.curves, axes, salt=f"{key}-{number}"), _undrawn(row.curves.values(), axes))
        for number, row in enumerate(rows)
        if row.curves
    ]
    scatters = [scatter for scatter in context.get("scatter", ()) if scatter["study"] == name]
    drawn = [_scatter(scatter, rows, f"{key}-scatter-{i}") for i, scatter in enumerate(scatters)]
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
    positive = [x for row in rows if 0 < (x := row.values.get(metrics[0], 0)) < math.inf] if metrics else []
    scale = about.get("scale") or ((min(positive), max(positive)) if positive else None)
    return {
        "key": key,
        "title": about.get("title", name),
        "text": about.get("text", ""),
        "terms": about.get("terms", {}),
        "failures": failed_checks(rows),
        "scale": scale,
        "panels": _panels(rows, metrics, scale),
        "missing": not_run(rows),
        "data": packed(as_json(rows)),
        "count": len(rows),
        "scatters": [scatter for scatter in drawn if scatter],
        "plots": plots,
        "figures": figures,
    }


def _panels(rows: list[Row], metrics: list[str], scale: tuple[float, float] | None) -> list[dict[str, Any]]:
    """A table per setting, under a matrix of subjects by cases, where there is enough to see; else one of all settings.

    The cases are the matrix's columns, or its lines where they are too many and more than the subjects. Subjects and
    cases of which nothing was run in a setting are left out. Without matrices, rows that share no metric with the
    others have a table of their own.
    """
    run = {(row.setting, label) for row in rows if row.values for label in (("s", row.subject), ("c", row.case))}
    rows = [row for row in rows if {(row.setting, ("s", row.subject)), (row.setting, ("c", row.case))} <= run]
    parts: dict[str, list[Row]] = {}
    for row in rows:
        parts.setdefault(row.setting, []).append(row)
    matrices: dict[str, dict[str, Any] | None] = dict.fromkeys(parts)
    for setting, part in parts.items():
        telling = [row for row in part if metrics[0] in row.values or row.broken]
        subjects, cases = (dict.fromkeys(getattr(row, label) for row in telling) for label in ("subject", "case"))
        cells = {(row.subject, row.case): row for row in part}
        if len(subjects) >= 3 and len(cases) >= 3 and len(cells) == len(part) and scale is not None:
            shades = {key: _shade(cells.get(key), metrics[0], scale) for key in itertools.product(subjects, cases)}
            if len(cases) > max(COLUMNS, len(subjects)):
                columns, lines = subjects, [(c, [shades[s, c] for s in subjects]) for c in cases]
            else:
                columns, lines = cases, [(s, [shades[s, c] for c in cases]) for s in subjects]
            matrices[setting] = {"metric": metrics[0], "columns": list(columns), "lines": lines}
    if any(matrices.values()):
        return [{"heading": s, "matrix": matrices[s], "table": _table(part, metrics, s)} for s, part in parts.items()]
    groups: list[tuple[set[str], list[int]]] = []  # metrics, and the places of the rows that have any of them
    rows = [row for row in rows if row.values]
    for place, row in enumerate(rows):
        joined, places = set(row.values), [place]
        for group in [group for group in groups if group[0] & joined]:
            groups.remove(group)
            joined, places = joined | group[0], places + group[1]
        groups.append((joined, sorted(places)))
    groups.sort(key=lambda group: group[1])
    tables = [_table([rows[place] for place in places], metrics) for _, places in groups]
    return [{"heading": "", "matrix": None, "table": table} for table in tables]


def _table(rows: list[Row], metrics: list[str], heading: str = "") -> dict[str, Any]:
    """Columns: the labels that differ between rows, then every metric; a label equal to the one above is marked.

    `parts`: the metrics of one table after the other, as many as fit into a line.
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
    left = room
    for metric in used:
        shown = [word for row in rows if (x := cell(row, metric)) for word in (x["text"], x["budget"])]
        width = max(map(len, metric.split() + shown)) + 3
        if width > left and parts[-1]:
            parts.append([])
            left = room
        parts[-1].append(metric)
        left -= width
    return {"keys": keys, "parts": parts, "lines": lines, "shared": " · ".join(shared)}


def _undrawn(lines: Iterable[Points], axes: Axes) -> int:
    return sum(len(points) - len(drawable(points, axes)) for points in lines)


def _scatter(scatter: Mapping[str, Any], rows: list[Row], salt: str) -> dict[str, Any] | None:
    x, y, floor = scatter["x"], scatter["y"], scatter.get("floor", "")
    panels: dict[str, Scatter] = {}
    for row in rows:
        panel = panels.setdefault(row.setting, Scatter())
        if x in row.values and y in row.values:
            panel.points.setdefault(row.subject, []).append((row.values[x], row.values[y]))
            low, high = (row.values.get(metric, math.nan) for metric in scatter.get("interval", (x, x)))
            panel.intervals.append((row.subject, low, high, row.values[y]))
        elif x in row.values and row.subject == floor:
            panel.floor = row.values[x]
    lines = [points for panel in panels.values() for points in panel.points.values()]
    if not lines:
        return None
    axes = Axes(x, y, x_scale="linear")
    svg = scatter_svg(panels, axes, floor=floor, front=scatter.get("front", False), salt=salt)
    return {"title": scatter.get("title", f"{y} against {x}"), "svg": svg, "omitted": _undrawn(lines, axes)}
