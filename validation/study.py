"""A study: one question, its text in the report, and the tasks that answer it.

A module with a study ends with `STUDY = Study(...)`; `__main__.py` lists these modules.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from mi_refract.report.row import Row
from validation.run.context import Context


@dataclass(frozen=True)
class Task:
    """A unit of work. An interrupted run keeps the rows of finished tasks.

    `name`: unique within a run. `timed`: the rows hold times or depend on speed, so the task runs alone on this machine
    and never on a worker.
    """

    name: str
    run: Callable[[], list[Row]]
    timed: bool = False


@dataclass(frozen=True)
class Study:
    """One question and its measurements.

    `name` is the `study` of its rows. The report shows `title`, `text` and `terms` (metric or case → meaning).
    `tasks(context)` returns the tasks. `axes` names the axes of the curves in its rows, `scatter` the pairs of metrics
    that are plotted against each other, and `scale` the range of colours of its matrices: see
    `mi_refract.report.study_page`. `summarise(rows)` returns all rows of a run, with a summary of this study added.
    `again(context)`, for studies with random draws, returns the rows that depend on them (no times, no images);
    `validation.repeated` calls it with other seeds. `records` names subjects that are measured for comparison only.
    Rows without bound and remark belong to these subjects or to timed tasks.
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
        """What the report shows of the study: title, introduction, glossary, axes and scale."""
        text = " ".join(self.text.split())
        if self.records:
            text += f" Recorded without a bound: {', '.join(f'`{name}`' for name in self.records)}."
        description: dict[str, Any] = {"title": self.title, "text": text, "terms": dict(self.terms)}
        if self.axes:
            description["axes"] = dict(self.axes)
        if self.scale:
            description["scale"] = self.scale
        return description


def about(docstring: str | None) -> str:
    """Return a module's docstring without its first line and without a final paragraph that shows a command."""
    return (docstring or "").partition("\n")[2].partition("\n\n`python")[0].strip()
