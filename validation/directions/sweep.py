"""Sweep: every regime at full size; a fast second solution finds the worst rays, and the oracle certifies these.

The fast solution (the "screen") is exact to 2⁻¹⁴⁰ of the radicand's terms. Ball arithmetic then certifies the rays with
the largest errors, those on which a formula and the screen disagree about total internal reflection, and those too near
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
    ERROR_OVER_BOUND: "the largest certified error of a ray over its a-priori bound",
    MISCLASSIFIED: "rays whose total internal reflection was misclassified: all on which the screen is certain, and "
    "of the others those that were certified",
    MISCLASSIFIED_FAR: "certified ones that the formula must classify correctly, as in the study of directions",
    "screen off": "the largest difference between the screen's chord error and the certified one, in u; infinite where "
    "the screen was certain of a decision and wrong",
    "unresolved": "rays too near to the critical angle for the screen, and not certified",
}
SEED = 2031
CHUNK = 1 << 16
# Rays nearer to the critical angle than the screen resolves, per kept one.
UNRESOLVED_SHARE = 50


def tasks(context: Context) -> list[Task]:
    """One per vectorised backend and precision."""
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
    kept = [row for row in rows if row.subject not in DOCUMENTED]
    for name in DOCUMENTED:  # one row, over all regimes it was swept in
        mine = [row for row in rows if row.subject == name]
        worst = max(mine, key=lambda row: row.values[ERROR_OVER_BOUND])
        values = {m: max(row.values[m] for row in mine) for m in (WORST_IN_U, ERROR_OVER_BOUND, "screen off")}
        counts = (MISCLASSIFIED, MISCLASSIFIED_FAR, "rays", "certified")
        values |= {m: sum(row.values[m] for row in mine) for m in counts}
        case = "all regimes of unit vectors"
        kept.append(Row(NAME, name, case, worst.setting, values, worst.budgets, replay=worst.replay))
    return kept


# One regime ----------------------------------------------------------------------------------------------------


@dataclass
class Best:
    """The rays with the highest scores so far, at most `size`, with their chords, and how many were offered."""

    size: int
    rays: Rays | None = None
    score: np.ndarray = field(default_factory=lambda: np.empty(0))
    chord: np.ndarray = field(default_factory=lambda: np.empty(0))
    offered: int = 0

    def add(self, rays: Rays, score: np.ndarray, mask: np.ndarray, chord: np.ndarray) -> None:
        """Offer the rays of a mask (N,), with their scores and chord errors (N,)."""
        self.offered += int(mask.sum())
        score, chord = (np.concatenate([old, x[mask]]) for old, x in ((self.score, score), (self.chord, chord)))
        best = np.argpartition(-score, self.size)[: self.size] if len(score) > self.size else np.arange(len(score))
        self.score, self.chord = score[best], chord[best]
        self.rays = Rays.joined([*([self.rays] if self.rays else []), rays[mask]])[best]


class Gathered(NamedTuple):
    """The results of one formula in one regime.

    `worst`: of the rays that the screen is certain of and that were decided rightly, those nearest to their bounds.
    `misclassified`: those decided wrongly, farthest from the critical angle first. `unresolved`: rays that the screen
    cannot resolve, those that it would decide differently first.
    """

    worst: Best
    misclassified: Best
    unresolved: Best


def regime_rows(regime: str, setting: Setting, count: int, kept: int) -> list[Row]:
    """A row per formula that has a budget in the regime: `count` rays are screened in chunks, of seeds SEED + i."""
    budgets = {name: formula.budget for name, formula in FORMULAS.items()}
    names = [name for name, b in budgets.items() if b.at_the_limit or not setting.no_budget(b, regime)]
    found = {name: Gathered(Best(kept), Best(kept), Best(UNRESOLVED_SHARE * kept)) for name in names}
    for i, start in enumerate(range(0, count, CHUNK)):
        rays = regimes.make(regime, min(CHUNK, count - start), setting.precision, seeds.current(SEED) + i)
        screen = Screen(rays, setting.vector)
        certain = ~screen.doubtful
        for name, (worst, misclassified, unresolved) in found.items():
            chord, wrong = screen.judge(FORMULAS[name])
            worst.add(rays, chord / screen.bound(budgets[name]), certain & ~wrong, chord)
            misclassified.add(rays, np.abs(screen.relative_radicand), certain & wrong, chord)
            unresolved.add(rays, wrong.astype(float), ~certain, chord)
    return [_certified_row(name, regime, setting, gathered, count) for name, gathered in found.items()]


def _certified_row(name: str, regime: str, setting: Setting, found: Gathered, count: int) -> Row:
    rays = Rays.joined([best.rays for best in found if best.rays is not None])
    certain = np.arange(len(rays)) < len(rays) - len(found.unresolved.score)
    entry, reason = regimes.REGIMES[regime], setting.no_budget(budget_of(name), regime)
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    seen = judge_formula(FORMULAS[name], rays, exact, setting.vector, budget_of(name))
    wrong = seen.misjudged
    values = {
        WORST_IN_U: float(np.max(seen.chord, where=seen.compared, initial=0)) / setting.roundoff,
        **({} if reason else seen.values()),
        MISCLASSIFIED: float(found.misclassified.offered + (wrong & ~certain).sum()),
        "screen off": _disagreement(found, seen.chord[certain] / setting.roundoff, wrong[certain]),
        "rays": float(count),
        "certified": float(len(rays)),
        "unresolved": float(found.unresolved.offered - (~certain).sum()),
    }
    budgets = {} if reason else {**BUDGETS, "screen off": limits.SCREEN_OFF}
    replay = {
        "regime": regime,
        "text": entry.text,
        "count": count,
        "chunk": CHUNK,
        "first seed": seeds.current(SEED),
        "worst ray": rays.hexed(int(np.argmax(seen.share))),
        "misclassified": [rays.hexed(int(i)) for i in np.flatnonzero(wrong)[:3]],
    }
    return Row(NAME, name, regime, setting.label, values, budgets, reason=reason, replay=replay)


def _disagreement(found: Gathered, chord: np.ndarray, wrong: np.ndarray) -> float:
    """How far the screen is off on the worst and the misclassified rays, in u; of errors above 1e6 u, in millionths."""
    screened = found.worst.chord
    if wrong[: len(screened)].any() or not wrong[len(screened) :].all():
        return np.inf
    finite = np.isfinite(screened)
    if (finite != np.isfinite(chord[: len(screened)])).any():
        return np.inf
    screened, chord = screened[finite], chord[: len(screened)][finite]
    return float(np.max(np.abs(screened - chord) / np.maximum(1, chord / 1e6), initial=0))


STUDY = Study(NAME, "Sweep", about(__doc__), TERMS, tasks, scale=ROUNDINGS, again=repeated.by_tasks(tasks))
