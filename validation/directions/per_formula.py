"""Directions: every formula against the certified answer, ray by ray, and its run time.

The error of a ray is the chord |b/|a| − exact| in units of roundoff u (2⁻²⁴ or 2⁻⁵³), and the angle in radians. It is
compared with the formula's a-priori bound for that ray. Rays whose total internal reflection was misclassified are
counted, and excluded from the errors. Times are those of a kernel that streams rays from memory, divided by the time of
a kernel that only copies the same bytes (a + k n). In the plots of error against time the stepped line joins the
formulas that no other formula beats in both.
"""

from __future__ import annotations

import functools

import numpy as np

from mi_refract import oracle, regimes
from mi_refract.accuracy import BUDGETS, Judgement, RayBounds, Subject, judge, judge_formula, lengths
from mi_refract.formulas import FORMULAS, ROUNDING
from mi_refract.report.row import Row
from validation import limits
from validation.run import kernel_timing, seeds
from validation.run.array_settings import Setting, budget_of, running, settings
from validation.run.context import Context
from validation.run.metrics import (
    ERROR_OVER_BOUND,
    MISCLASSIFIED,
    MISCLASSIFIED_FAR,
    ROUNDINGS,
    TIME_OVER_COPY,
    WORST_ANGLE,
    WORST_CHORD,
    WORST_IN_U,
)
from validation.study import Study, Task, about

NAME = "directions"
FLOOR = "exact, rounded"
ALL = "all regimes"  # case of a formula's summary
TERMS = (
    {name: f"{formula.equation} (source: {formula.source})" for name, formula in FORMULAS.items()}
    | {name: regime.text for name, regime in regimes.REGIMES.items()}
    | {
        WORST_IN_U: "the largest chord error in units of roundoff; rounding the exact answer costs 0.87",
        ERROR_OVER_BOUND: "the largest error of a ray divided by its a-priori bound",
        MISCLASSIFIED: "rays whose total internal reflection was misclassified",
        MISCLASSIFIED_FAR: "misclassified rays that are farther from the critical angle than the formula's bound "
        "explains; for formulas at the rounding limit, rays whose radicand exceeds u² of its terms: below that "
        "either decision changes b by at most u",
        FLOOR: "the certified direction times |a|, rounded: no formula can do better. At most √3/2 u for |a| = 1, "
        "otherwise 1 u, because all components may be just above a power of two",
        "other side": "rays within 4u of the surface that a documented formula sends to its other side, because the "
        "formula's n·a is not more accurate; their bound is wider by 2 cosθ_t, and either decision is accepted",
        "no budget": "documented formulas require unit vectors: their rows for other vectors have no budget",
        "length drift": "relative difference between the lengths of b and a",
        "slack": "factor by which the constants of the bound could be smaller, in the linear term and under the root",
    }
    | kernel_timing.TERMS
)
SCATTER = tuple(
    {
        "study": NAME,
        "x": x,
        "y": WORST_IN_U,
        "title": f"Worst error against {x}",
        "front": True,
        "interval": [f"{x}, low", f"{x}, high"],
        "floor": kernel_timing.COPY,
    }
    for x in (TIME_OVER_COPY, "ns per ray")
)
SEED = 2026


def tasks(context: Context) -> list[Task]:
    """Return one task per backend and precision."""
    return [
        Task(f"directions: {setting.label}", functools.partial(setting_rows, context, setting), timed=True)
        for setting in settings(context)
    ]


@seeds.cached
def certified(regime: str, count: int, precision: type) -> tuple[regimes.Rays, oracle.Certified]:
    """Return `count` rays of a regime in a precision, and the oracle's answers."""
    rays = regimes.make(regime, count, precision, seeds.current(SEED))
    return rays, oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)


def setting_rows(context: Context, setting: Setting) -> list[Row]:
    """Return the rows of all formulas, Mitsuba's functions, the rounded exact answers, and the copy."""
    if setting.vector is None:
        return [Row(NAME, name, ALL, setting.label, reason=setting.reason) for name in (*FORMULAS, kernel_timing.COPY)]
    count = rays_of(context, setting)
    times = kernel_timing.measure(context, setting)
    rows = [_floor_row(regime, setting, count) for regime in regimes.REGIMES]
    for name, subject in setting.subjects.items():
        parts = [regime_row(name, subject, regime, setting, count) for regime in regimes.REGIMES]
        rows += [*parts, summary(name, parts, setting, times[name])]
    copying = Row(NAME, kernel_timing.COPY, ALL, setting.label, times[kernel_timing.COPY])
    return [*rows, copying]


def rays_of(context: Context, setting: Setting) -> int:
    """Return the number of rays per regime in a setting."""
    return context.profile.scalar_rays if setting.is_scalar else context.profile.rays


def drawn_rows(context: Context) -> list[Row]:
    """Return the rows of all formulas in all regimes, without times."""
    return [
        regime_row(name, subject, regime, setting, rays_of(context, setting))
        for setting in running(context)
        for name, subject in setting.subjects.items()
        for regime in regimes.REGIMES
    ]


def _floor_row(regime: str, setting: Setting, count: int) -> Row:
    """Return the row of the certified answers themselves, rounded."""
    rays, exact = certified(regime, count, setting.precision)
    b = (exact.direction + exact.direction_low.astype(np.longdouble)) * lengths(rays.a)[:, None]
    b = b.astype(setting.precision).astype(np.longdouble)
    bounds = RayBounds(rays, exact, ROUNDING, setting.roundoff)
    return _row(FLOOR, regime, setting, rays, judge(b, exact.transmitted, bounds))


def regime_row(name: str, subject: Subject, regime: str, setting: Setting, count: int) -> Row:
    """Return the row of a formula on `count` rays of a regime."""
    rays, exact = certified(regime, count, setting.precision)
    judgement = judge_formula(subject, rays, exact, setting.vector, budget_of(name))
    return _row(name, regime, setting, rays, judgement, setting.no_budget(budget_of(name), regime))


@np.errstate(over="ignore")
def _row(name: str, regime: str, setting: Setting, rays: regimes.Rays, judgement: Judgement, reason: str = "") -> Row:
    """Return a row. `reason`: why the row has no budget; then it has no errors over bounds either."""
    u, compared = setting.roundoff, judgement.compared
    errors = (judgement.chord, judgement.angle, judgement.drift)
    chord, angle, drift = (x[compared] if compared.any() else np.zeros(1) for x in errors)
    p99 = functools.partial(np.quantile, q=0.99, method="higher")  # one of the values, which may be infinite
    values = {
        WORST_IN_U: float(chord.max()) / u,
        **({} if reason else judgement.values()),
        WORST_CHORD: float(chord.max()),
        "p99 / u": float(p99(chord)) / u,
        "mean / u": float(chord.mean()) / u,
        WORST_ANGLE: float(angle.max()),
        "p99 rad": float(p99(angle)),
        "mean rad": float(angle.mean()),
        "length drift": float(drift.max()),
        MISCLASSIFIED: float(judgement.misjudged.sum()),
        "other side": float(judgement.crossed.sum()),
    }
    worst = {"largest error": np.where(compared, judgement.chord, -1), "nearest to its bound": judgement.share}
    replay = {
        "regime": regime,
        "text": regimes.REGIMES[regime].text,
        "count": len(rays),
        "seed": seeds.current(SEED),
        **{title: rays.hexed(int(np.argmax(x))) for title, x in worst.items()},
        "needed": {"linear": float(judgement.linear_needed.max()), "radicand": float(judgement.radicand_needed.max())},
    }
    budgets = {} if reason else BUDGETS
    return Row(NAME, name, regime, setting.label, values, budgets, reason=reason, replay=replay)


def summary(name: str, parts: list[Row], setting: Setting, times: dict[str, float]) -> Row:
    """Return the row of the worst error over all regimes with a budget, and the time: a point in the scatter plot."""
    parts = [row for row in parts if row.budgets]
    metrics = WORST_IN_U, ERROR_OVER_BOUND, WORST_CHORD, WORST_ANGLE, "length drift"
    values = {m: max(row.values[m] for row in parts) for m in metrics}
    values |= {m: sum(row.values[m] for row in parts) for m in (MISCLASSIFIED, MISCLASSIFIED_FAR, "other side")}
    budgets = {}
    if min(row.replay["count"] for row in parts) >= limits.SLACK_FROM_RAYS:
        # Each constant of the bound over the smallest value that these rays allow, with the other constant unchanged.
        constants = {"linear": budget_of(name).linear, "radicand": budget_of(name).radicand}
        needed = {c: max(row.replay["needed"][c] for row in parts) for c in constants}
        slack = {f"slack, {c}": x / max(needed[c], 1e-3 * x) for c, x in constants.items() if x}
        values, budgets = values | slack, dict.fromkeys(slack, limits.SLACK)
    rays = sum(row.replay["count"] for row in parts)
    replay = {"rays": rays, "regimes": len(parts), "seed": seeds.current(SEED)}
    goals = kernel_timing.goals(name, setting)
    return Row(NAME, name, ALL, setting.label, values | times, budgets, goals, replay=replay)


STUDY = Study(NAME, "Directions", about(__doc__), TERMS, tasks, scatter=SCATTER, scale=ROUNDINGS, again=drawn_rows)
