"""Repeats randomised studies with other seeds, in the profiles `standard` and `full`.

A bound is derived for every ray, so it must hold for every seed, not only for the seed of the study.
"""

from __future__ import annotations

import functools
import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from mi_refract.report.row import Row
from validation.run.context import Context, profiles
from validation.run.seeds import STEP, shifted
from validation.study import Study, Task

OTHERS = {"standard": 3, "full": 10}  # profile → number of other seeds; each runs at the size of the profile `quick`


def by_tasks(tasks: Callable[[Context], list[Task]]) -> Callable[[Context], list[Row]]:
    """Return a `Study.again` that repeats all tasks of a study."""
    return lambda context: [row for task in tasks(context) for row in task.run()]


def tasks(study: Study, context: Context) -> list[Task]:
    """Return one task per other seed of a randomised study; none in the profile `quick`."""
    if study.again is None:
        return []
    count = OTHERS.get(context.profile.name, 0)
    small = replace(context, profile=profiles(context.variant)["quick"])
    return [
        Task(f"{study.name}: other seed {i} of {count}", functools.partial(rows_of, study, small, i))
        for i in range(1, count + 1)
    ]


def rows_of(study: Study, context: Context, shift: int) -> list[Row]:
    """Return one row with the largest value over its budget, and all rows that break a budget.

    If the study could run nothing, return one row that is not run, with the reason of the study's rows.
    """
    assert study.again is not None
    # The report shows images of the study's own seed only.
    with shifted(shift), tempfile.TemporaryDirectory() as folder:
        rows = [replace(row, images={}) for row in study.again(replace(context, out=Path(folder)))]
    measured, case = [row for row in rows if row.values], f"other seed {shift}"
    if rows and not measured:
        return [replace(rows[0], subject="every subject", case=case, setting="")]
    shares = [share(row.values[m], bound) for row in measured for m, bound in row.budgets.items()]
    broken = [replace(row, case=f"{row.case}, {case}") for row in measured if row.broken]
    values = {"checks": float(len(shares)), "broken": float(len(broken)), "largest share": max(shares, default=0.0)}
    values |= {"nothing checked": float(not shares)}
    replay = {"seeds": f"each {STEP * shift} above the study's own", "profile": context.profile.name}
    budgets = {"broken": 0.0, "nothing checked": 0.0}
    return [Row(study.name, "every subject", case, "", values, budgets, replay=replay), *broken]


def own_case(case: str) -> str:
    """Return the case of a row without its other seed; "" for the row of all cases with another seed."""
    return re.sub(r"(, )?other seed \d+$", "", case)


def share(value: float, bound: float) -> float:
    """Return `value` / `bound`. For a bound of 0: 0 if the value is 0, infinity if it is larger. NaN stays NaN."""
    if bound > 0 or value != value:
        return value / bound if bound > 0 else value
    return 0.0 if value <= bound else float("inf")
