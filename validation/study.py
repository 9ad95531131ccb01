"""A study: the question it asks, its text in the report, and the tasks that measure it.

A module that holds a study ends with `STUDY = Study(...)`; `__main__.py` lists these modules.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from mi_refract.report.row import Row
from validation.run.context import Context


@dataclass(frozen=True)
class Task:
    """A unit of work that is finished or not: an interrupted run keeps the rows of finished tasks.

    `name`: no other task of a run has it. `timed`: rows hold times or ratios of times, or depend on how fast something
    is; it runs alone on this machine, never on a worker.
    """

    name: str
    run: Callable[[], list[Row]]
    timed: bool = False


@dataclass(frozen=True)
class Study:
    """One question and its measurements.

    `name` is the `study` of its rows; `title`, `text` and `terms` (metric or case → meaning) are shown by the report.
    `tasks(context)` lists what is to be run. `axes` says what the curves of its rows are drawn over, `scatter` which
    metric is plotted against which, `scale` between which numbers its matrices have colours (all three as
    `mi_refract.report.study_page` describes them). `summarise(rows)` returns all rows of a run with the summary of this
    study among them. `again(context)`, of a study whose answer rests on random draws, gives the rows that they decide
    (no times, no images), for `validation.repeated` to repeat. `records`: subjects that are measured for comparison.
    Only they, and what is timed, have rows with neither bound nor remark.
    """

    name: str
    title: str
    text: str
    terms: Mapping[str, str]
    tasks: Callable[[Context], list[Task]]
    axes: Mapping[str, Any] = field(default_factory=dict)
    scale: tuple[float, float] | None = None
    scatter: tuple[Mapping[str, Any], ...] = ()
    summarise: Callable[[list[Row]], list[Row]] = list
    again: Callable[[Context], list[Row]] | None = None
    records: tuple[str, ...] = ()

    @property
    def described(self) -> dict[str, Any]:
        """What the report shows of the study: title, introduction, glossary and axes."""
        text = " ".join(self.text.split())
        text += f" Recorded without a bound: {', '.join(f'`{name}`' for name in self.records)}." if self.records else ""
        about: dict[str, Any] = {"title": self.title, "text": text, "terms": dict(self.terms)}
        return about | ({"axes": dict(self.axes)} if self.axes else {}) | ({"scale": self.scale} if self.scale else {})


def about(docstring: str | None) -> str:
    """A module's docstring without its first line, up to a paragraph that begins with a command."""
    return (docstring or "").partition("\n")[2].partition("\n\n`python")[0].strip()
