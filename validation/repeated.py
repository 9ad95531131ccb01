"""Randomised studies once more, with other seeds: the profiles `standard` and `full` repeat every one of them.

A bound is derived for every ray, so it holds for every seed; a study that only its own seed passes has no bound.
"""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from mi_refract.report.row import Row
from validation.run.context import Context, profiles
from validation.run.seeds import STEP, shifted
from validation.study import Study, Task

OTHERS = {"standard": 3, "full": 10}  # other seeds of a profile; each at the size of the profile `quick`


def by_tasks(tasks: Callable[[Context], list[Task]]) -> Callable[[Context], list[Row]]:
    """`Study.again` of a study all of whose rows are to be repeated: those of its tasks."""
    return lambda context: [row for task in tasks(context) for row in task.run()]


def tasks(study: Study, context: Context) -> list[Task]:
    """One task per other seed of a randomised study; none in the profile `quick`."""
    if study.again is None:
        return []
    count = OTHERS.get(context.profile.name, 0)
    small = replace(context, profile=profiles(context.variant)["quick"])
    return [
        Task(f"{study.name}: other seed {i} of {count}", functools.partial(rows_of, study, small, i))
        for i in range(1, count + 1)
    ]


def rows_of(study: Study, context: Context, shift: int) -> list[Row]:
    """One row with the worst share of a budget, and, in full, every row that breaks one.

    Where nothing could be run, the one row is not run, for the reason of the study's rows.
    """
    assert study.again is not None
    with shifted(shift), tempfile.TemporaryDirectory() as folder:  # images are those of the study's own seed
        rows = [replace(row, images={}) for row in study.again(replace(context, out=Path(folder)))]
    found, case = [row for row in rows if row.values], f"other seed {shift}"
    if rows and not found:
        return [replace(rows[0], subject="every subject", case=case, setting="")]
    shares = [share(row.values[m], bound) for row in found for m, bound in row.budgets.items()]
    broken = [replace(row, case=f"{row.case}, other seed {shift}") for row in found if row.broken]
    values = {"checks": float(len(shares)), "broken": float(len(broken)), "largest share": max(shares, default=0.0)}
    values |= {"nothing checked": float(not shares)}
    replay = {"seeds": f"each {STEP * shift} above the study's own", "profile": context.profile.name}
    budgets = {"broken": 0.0, "nothing checked": 0.0}
    return [Row(study.name, "every subject", case, "", values, budgets, replay=replay), *broken]


def share(value: float, bound: float) -> float:
    """`value` over its bound; of a bound of 0 as the value says: 0 for 0, infinity for anything else, NaN stays."""
    if bound > 0 or value != value:
        return value / bound if bound > 0 else value
    return 0.0 if value <= bound else float("inf")
