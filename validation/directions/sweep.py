"""Sweep: every regime at full size. A fast second solution finds the worst rays, and the oracle certifies these.

The fast solution (the "screen") is exact to 2⁻¹⁴⁰ of the radicand's terms. Ball arithmetic then certifies the rays with
the largest errors, rays on which a formula and the screen disagree about total internal reflection, and rays too near
to the critical angle for the screen. Only certified errors are shown.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mi_refract import oracle, regimes
from mi_refract.accuracy import BUDGETS, judge_formula
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import Rays
from mi_refract.report.row import Row
from validation import limits, repeated
from validation.reference.fast_reference import Screen
from validation.run import seeds
from validation.run.array_settings import DOCUMENTED, Setting, budget_of, settings
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND, MISCLASSIFIED, MISCLASSIFIED_FAR, ROUNDINGS, WORST_IN_U
from validation.study import Study, Task, about

NAME = "sweep"
TERMS = {
    WORST_IN_U: "the largest certified chord error in units of roundoff, without misclassified rays",
    ERROR_OVER_BOUND: "the largest certified error of a ray, divided by its a-priori bound",
    MISCLASSIFIED: "rays whose total internal reflection was misclassified: by the screen if it is certain, otherwise "
    "among the certified rays",
    MISCLASSIFIED_FAR: "certified misclassified rays that the formula must classify correctly, as in the study of "
    "directions",
    "screen off": "the largest difference between the screen's chord error and the certified one, in u; infinite if "
    "the screen was certain of a wrong decision",
    "unresolved": "rays too near to the critical angle for the screen that were not certified",
}
SEED = 2031
CHUNK = 1 << 16
# How many unresolved rays, too near to the critical angle for the screen, are kept per worst ray.
UNRESOLVED_SHARE = 50


def tasks(context: Context) -> list[Task]:
    """Return one task per vectorised backend and precision."""
    return [
        Task(f"sweep: {setting.label}", functools.partial(_setting_rows, context, setting))
        for setting in settings(context)
        if not setting.is_scalar
    ]


def _setting_rows(context: Context, setting: Setting) -> list[Row]:
    if setting.vector is None:
        return [Row(NAME, name, "all regimes", setting.label, reason=setting.reason) for name in FORMULAS]
    profile = context.profile
    sizes = profile.sweep_rays, profile.certified
    rows = [row for regime in regimes.REGIMES for row in regime_rows(regime, setting, *sizes)]
    shown = [row for row in rows if row.subject not in DOCUMENTED]
    for name in DOCUMENTED:  # one row over all regimes
        parts = [row for row in rows if row.subject == name]
        worst = max(parts, key=lambda row: row.values[ERROR_OVER_BOUND])
        metrics = WORST_IN_U, ERROR_OVER_BOUND, "screen off"
        values = {m: float(np.max([row.values[m] for row in parts])) for m in metrics}
        counts = (MISCLASSIFIED, MISCLASSIFIED_FAR, "rays", "certified")
        values |= {m: sum(row.values[m] for row in parts) for m in counts}
        case = "all regimes of unit vectors"
        shown.append(Row(NAME, name, case, worst.setting, values, worst.budgets, replay=worst.replay))
    return shown


# One regime ----------------------------------------------------------------------------------------------------


@dataclass
class Best:
    """The rays with the highest scores so far, at most `size`, their chord errors, and the number of offered rays."""

    size: int
    rays: Rays | None = None
    score: np.ndarray = field(default_factory=lambda: np.empty(0))
    chord: np.ndarray = field(default_factory=lambda: np.empty(0))
    offered: int = 0

    def add(self, rays: Rays, score: np.ndarray, mask: np.ndarray, chord: np.ndarray) -> None:
        """Add the rays of a mask (N,) with their scores and chord errors (N,); keep the best."""
        self.offered += int(mask.sum())
        score, chord = (np.concatenate([old, x[mask]]) for old, x in ((self.score, score), (self.chord, chord)))
        best = np.argpartition(-score, self.size)[: self.size] if len(score) > self.size else np.arange(len(score))
        self.score, self.chord = score[best], chord[best]
        self.rays = Rays.joined([*([self.rays] if self.rays else []), rays[mask]])[best]


class Gathered(NamedTuple):
    """The results of one formula in one regime.

    `worst`: correctly classified rays nearest to their bounds. `misclassified`: misclassified rays, farthest from the
    critical angle first. The screen is certain of both. `unresolved`: rays that the screen cannot resolve, those first
    that it would classify differently.
    """

    worst: Best
    misclassified: Best
    unresolved: Best


def regime_rows(regime: str, setting: Setting, count: int, certified: int) -> list[Row]:
    """Return a row per formula with a budget in the regime: `count` rays are screened in chunks, of seeds SEED + i.

    `certified`: the number of worst rays to certify.
    """
    budgets = {name: formula.budget for name, formula in FORMULAS.items()}
    names = [name for name, b in budgets.items() if b.at_the_limit or not setting.no_budget(b, regime)]
    results = {name: Gathered(Best(certified), Best(certified), Best(UNRESOLVED_SHARE * certified)) for name in names}
    for i, start in enumerate(range(0, count, CHUNK)):
        rays = regimes.make(regime, min(CHUNK, count - start), setting.precision, seeds.current(SEED) + i)
        screen = Screen(rays, setting.vector)
        certain = ~screen.doubtful
        for name, (worst, misclassified, unresolved) in results.items():
            chord, wrong = screen.judge(FORMULAS[name])
            worst.add(rays, chord / screen.bound(budgets[name]), certain & ~wrong, chord)
            misclassified.add(rays, np.abs(screen.relative_radicand), certain & wrong, chord)
            unresolved.add(rays, wrong.astype(float), ~certain, chord)
    return [_certified_row(name, regime, setting, gathered, count) for name, gathered in results.items()]


def _certified_row(name: str, regime: str, setting: Setting, gathered: Gathered, count: int) -> Row:
    rays = Rays.joined([best.rays for best in gathered if best.rays is not None])
    certain = np.arange(len(rays)) < len(rays) - len(gathered.unresolved.score)
    entry, reason = regimes.REGIMES[regime], setting.no_budget(budget_of(name), regime)
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    judgement = judge_formula(FORMULAS[name], rays, exact, setting.vector, budget_of(name))
    wrong = judgement.misjudged
    values = {
        WORST_IN_U: float(np.max(judgement.chord, where=judgement.compared, initial=0)) / setting.roundoff,
        **({} if reason else judgement.values()),
        MISCLASSIFIED: float(gathered.misclassified.offered + (wrong & ~certain).sum()),
        "screen off": _disagreement(gathered, judgement.chord[certain] / setting.roundoff, wrong[certain]),
        "rays": float(count),
        "certified": float(len(rays)),
        "unresolved": float(gathered.unresolved.offered - (~certain).sum()),
    }
    budgets = {} if reason else {**BUDGETS, "screen off": limits.SCREEN_OFF}
    replay = {
        "regime": regime,
        "text": entry.text,
        "count": count,
        "chunk": CHUNK,
        "first seed": seeds.current(SEED),
        "worst ray": rays.hexed(int(np.argmax(judgement.share))),
        "misclassified": [rays.hexed(int(i)) for i in np.flatnonzero(wrong)[:3]],
    }
    return Row(NAME, name, regime, setting.label, values, budgets, reason=reason, replay=replay)


def _disagreement(gathered: Gathered, chord: np.ndarray, wrong: np.ndarray) -> float:
    """Return the screen's largest error in u on the worst and the misclassified rays; relative, × 1e6, above 1e6 u."""
    screened = gathered.worst.chord
    if wrong[: len(screened)].any() or not wrong[len(screened) :].all():
        return np.inf
    finite = np.isfinite(screened)
    if (finite != np.isfinite(chord[: len(screened)])).any():
        return np.inf
    screened, chord = screened[finite], chord[: len(screened)][finite]
    return float(np.max(np.abs(screened - chord) / np.maximum(1, chord / 1e6), initial=0))


STUDY = Study(NAME, "Sweep", about(__doc__), TERMS, tasks, scale=ROUNDINGS, again=repeated.by_tasks(tasks))
