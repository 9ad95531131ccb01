"""The first screen of a report: questions, answers in sentences, one image and one plot.

A caller who knows what its studies mean makes a `FirstPage` from the rows and hands it over as
`context["first_page"]`; here it is laid out, for the page and for the terminal. Words between backticks are code.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict

from mi_refract.io.sanitise import printable_lines

from .embedded_images import EmbeddedImages
from .plots import Axes, curves_svg
from .row import Row

if TYPE_CHECKING:
    from rich.console import RenderableType

NOT_RUN = "not run"
STATES = ("yes", "no", "plain", "not measured")


class Answer(TypedDict):
    """A question, and the answer that the rows give.

    `state`: "yes" where every budget behind the answer held, "no" where one did not, "plain" where there is none, "not
    measured" where no row answers. `study` is the one that says more, NOT_RUN the list of what was not run, "" none.
    """

    question: str
    text: str
    state: str
    study: str


class ShownImage(TypedDict):
    """Images of one row, by the row's name: which roles, the label of each, and the caption."""

    row: str
    labels: Mapping[str, str]
    caption: str


class ShownPlot(TypedDict):
    """Curves of one row, by the row's name: which ones, the label of each, and the caption."""

    row: str
    labels: Mapping[str, str]
    axes: NotRequired[Mapping[str, Any]]
    caption: str


class FirstPage(TypedDict):
    """All of the first screen: what the reader must know, answers, an image, a plot; three of them may be left out."""

    lead: NotRequired[str]
    answers: Sequence[Answer]
    image: NotRequired[ShownImage]
    plot: NotRequired[ShownPlot]


def prepare(rows: Sequence[Row], page: FirstPage, keys: Mapping[str, str], images: EmbeddedImages) -> dict[str, Any]:
    """What the template shows: answers with links (`keys`: study → anchor), panes and SVG.

    Errors: ValueError for a state or a row that there is not; those of `EmbeddedImages.embed`.
    """
    for answer in page["answers"]:
        if answer["state"] not in STATES:
            raise ValueError(f"first page: state {answer['state']!r}; expected {', '.join(STATES)}")
    return {
        "lead": page.get("lead", ""),
        "answers": [{**answer, "link": keys.get(answer["study"], "")} for answer in page["answers"]],
        "image": _image(rows, page["image"], images) if "image" in page else None,
        "plot": _plot(rows, page["plot"]) if "plot" in page else None,
    }


def _row(rows: Sequence[Row], name: str) -> Row:
    for row in rows:
        if row.name == name:
            return row
    raise ValueError(f"first page: there is no row {name!r}")


def _image(rows: Sequence[Row], shown: ShownImage, images: EmbeddedImages) -> dict[str, Any]:
    row = _row(rows, shown["row"])
    panes = [
        {"role": role, "label": label, "paint": "light", "gain": None} | images.embed(row.images[role])
        for role, label in shown["labels"].items()
    ]
    return {"panes": panes, "caption": shown["caption"]}


def _plot(rows: Sequence[Row], shown: ShownPlot) -> dict[str, Any]:
    row = _row(rows, shown["row"])
    given = shown.get("axes", {})
    axes = Axes(**{field.name: given[field.name] for field in fields(Axes) if field.name in given})
    curves = {label: row.curves[name] for name, label in shown["labels"].items()}
    return {"svg": curves_svg(curves, axes, salt="first", size=(6.2, 2.3)), "caption": shown["caption"]}


def terminal(page: FirstPage) -> list[RenderableType]:
    """The same sentences for rich's console: each question in bold, its answer below."""
    from rich.padding import Padding
    from rich.text import Text

    styles = {"yes": "bold green", "no": "bold red", "plain": "bold", "not measured": "bold yellow"}
    parts: list[RenderableType] = []
    for answer in page["answers"]:
        text = Text()
        for index, piece in enumerate(answer["text"].split("`")):
            text.append(piece, style="cyan" if index % 2 else "")
        parts += [Text(answer["question"].replace("`", ""), style=styles[answer["state"]]), Padding(text, (0, 0, 1, 2))]
    return parts


def not_run(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows that were not run by their reason, the most frequent first."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        if row.verdict == "not run":
            groups.setdefault(row.reason, []).append(row)
    return dict(sorted(groups.items(), key=lambda item: -len(item[1])))


def code(text: str) -> Any:
    """Escaped HTML in which words between backticks are `<code>`."""
    from markupsafe import Markup, escape

    return Markup(re.sub("`([^`]*)`", r"<code>\1</code>", str(escape(printable_lines(text)))))
