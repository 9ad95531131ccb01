"""The first screen of a report: questions, answers in sentences, one image and one plot.

The caller makes a `FirstPage` from the rows and passes it as `context["first_page"]`; here it is laid out for the page
and for the terminal. Words between backticks are code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NotRequired, TypedDict, get_args

from .embedded_images import EmbeddedImages
from .plots import Axes, curves_svg
from .row import Row

if TYPE_CHECKING:
    from rich.console import RenderableType

NOT_RUN = "not run"
State = Literal["yes", "no", "plain", "not measured"]
STATES: tuple[State, ...] = get_args(State)


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


def prepare(rows: Sequence[Row], page: FirstPage, keys: Mapping[str, str], images: EmbeddedImages) -> dict[str, Any]:
    """The values for the template: answers with links (`keys`: study → anchor), panes and SVG.

    Errors: ValueError for an unknown state or row; those of `EmbeddedImages.embed`.
    """
    by_name = {row.name: row for row in rows}
    for answer in page["answers"]:
        if answer["state"] not in STATES:
            raise ValueError(f"first page: state {answer['state']!r}; expected {', '.join(STATES)}")
    for shown in filter(None, (page.get("image"), page.get("plot"))):
        if shown["row"] not in by_name:
            raise ValueError(f"first page: there is no row {shown['row']!r}")
    found: dict[str, Any] = {"lead": page.get("lead", ""), "image": None, "plot": None}
    found["answers"] = [{**answer, "link": keys.get(answer["study"], "")} for answer in page["answers"]]
    if image := page.get("image"):
        files = by_name[image["row"]].images
        panes = [images.embed(files[role]) | {"role": role, "label": x} for role, x in image["labels"].items()]
        found["image"] = {"panes": panes, "caption": image["caption"]}
    if plot := page.get("plot"):
        curves = {label: by_name[plot["row"]].curves[name] for name, label in plot["labels"].items()}
        svg = curves_svg(curves, Axes(**plot.get("axes", {})), salt="first", size=(6.2, 2.3))
        found["plot"] = {"svg": svg, "caption": plot["caption"]}
    return found


def terminal(page: FirstPage) -> list[RenderableType]:
    """The same sentences for rich's console: each question in bold, its answer below."""
    from rich.padding import Padding
    from rich.text import Text

    styles = {"yes": "bold green", "no": "bold red", "plain": "bold", "not measured": "bold yellow"}
    parts: list[RenderableType] = []
    for answer in page["answers"]:
        text = Text.assemble(*((part, "cyan" if i % 2 else "") for i, part in enumerate(answer["text"].split("`"))))
        parts += [Text(answer["question"].replace("`", ""), style=styles[answer["state"]]), Padding(text, (0, 0, 1, 2))]
    return parts


def not_run(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """The rows that were not run by their reason, the most frequent first."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        if row.verdict == "not run":
            groups.setdefault(row.reason, []).append(row)
    return dict(sorted(groups.items(), key=lambda item: -len(item[1])))
