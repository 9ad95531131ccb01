"""Sweep: every regime at full size; the screen finds the worst rays, and the oracle certifies these.

The screen solves every ray a second way, right to 2⁻¹⁴⁰ of the radicand's terms. Certified by ball arithmetic are the
rays that it finds worst, those whose total internal reflection a formula decides as the screen does not, and those too
near to the critical angle for the screen. Only certified errors are shown.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mi_refract import oracle, regimes
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import Rays
from mi_refract.rows import Row

from .directions import Setting, at_the_limit, bound, decisive, errors, evaluate, settings
from .plan import Context, Task
from .screen import Screen

TITLE = "Sweep"
TEXT = __doc__.partition("\n")[2].strip()
TERMS = {
    "worst / u": "the largest certified chord error in units of roundoff, of the rays that were decided rightly",
    "misjudged": "rays whose total internal reflection was decided wrongly: all that the screen is certain of, and of the "
    "others those that were certified",
    "misjudged far": "certified ones that the formula must decide rightly, as in the study of directions",
    "screen off": "the largest difference between the screen's chord error and the certified one, in u; infinite where a "
    "decision that the screen is certain of was wrong",
    "unresolved": "rays nearer to the critical angle than the screen resolves that were not certified either",
}
SEED = 2031
CHUNK = 1 << 18
# What the screen may be off by: extended precision, which compares with the certified answer, costs as much.
SCREEN_BUDGET = 0.01
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
        return [Row("sweep", name, "all regimes", setting.label, reason=setting.reason) for name in FORMULAS]
    profile = context.profile
    rows = [row for regime in regimes.REGIMES for row in regime_rows(regime, setting, profile.sweep_rays, profile.certified)]
    documented = {name: [row for row in rows if row.subject == name] for name in FORMULAS if not at_the_limit(name)}
    return [row for row in rows if at_the_limit(row.subject)] + [_worst_of(name, r) for name, r in documented.items()]


def _worst_of(name: str, rows: list[Row]) -> Row:
    """One row for a documented formula, over the regimes in which it has a budget."""
    rows = [row for row in rows if row.budgets]
    worst = max(rows, key=lambda row: row.values["worst / u"])
    values = {"worst / u": worst.values["worst / u"]}
    values |= {metric: sum(row.values[metric] for row in rows) for metric in ("misjudged", "rays", "certified")}
    return Row("sweep", name, "all regimes of unit vectors", worst.setting, values, replay=worst.replay)


# One regime ----------------------------------------------------------------------------------------------------


class Best:
    """The rays with the highest scores so far, at most `size`, and how many were offered."""

    def __init__(self, size: int) -> None:
        self.size, self.offered = size, 0
        self._score, self._rays = np.empty(0), []  # type: tuple[np.ndarray, list[Rays]]

    def add(self, rays: Rays, score: np.ndarray, mask: np.ndarray) -> None:
        index = np.flatnonzero(mask)
        self.offered += len(index)
        index = index[np.argsort(-score[index], kind="stable")[: self.size]]
        self._rays.append(rays[index])
        self._score = np.concatenate([self._score, score[index]])
        best = np.argsort(-self._score, kind="stable")[: self.size]
        self._score, self._rays = self._score[best], [Rays.joined(self._rays)[best]]

    @property
    def rays(self) -> Rays:
        return self._rays[0]


@dataclass(frozen=True)
class Gathered:
    """What one formula leaves of a regime: the worst of the rays that the screen is certain of and that were decided
    rightly; the misjudged ones, farthest from the critical angle first; and rays that the screen cannot resolve, those
    that it would decide differently first.
    """

    worst: Best
    misjudged: Best
    unresolved: Best

    def add(self, screen: Screen, chord: np.ndarray, wrong: np.ndarray) -> None:
        rays, certain = screen.rays, ~screen.doubtful
        self.worst.add(rays, chord, certain & ~wrong)
        self.misjudged.add(rays, np.abs(screen.margin), certain & wrong)
        self.unresolved.add(rays, wrong.astype(float), ~certain)


def gather(regime: str, setting: Setting, count: int, kept: int) -> dict[str, Gathered]:
    """Screen `count` rays of a regime in chunks; chunk i has the seed SEED + i."""
    found = {name: Gathered(Best(kept), Best(kept), Best(UNRESOLVED_SHARE * kept)) for name in FORMULAS}
    for i, start in enumerate(range(0, count, CHUNK)):
        rays = regimes.make(regime, min(CHUNK, count - start), setting.precision, SEED + i)
        screen = Screen(rays, setting.vector)
        for name, formula in FORMULAS.items():
            found[name].add(screen, *screen.judge(formula))
    return found


def regime_rows(regime: str, setting: Setting, count: int, kept: int) -> list[Row]:
    found = gather(regime, setting, count, kept)
    return [_certified_row(name, regime, setting, found[name], count) for name in FORMULAS]


def _certified_row(name: str, regime: str, setting: Setting, found: Gathered, count: int) -> Row:
    rays = Rays.joined([found.worst.rays, found.misjudged.rays, found.unresolved.rays])
    certain = np.arange(len(rays)) < len(rays) - len(found.unresolved.rays)
    u, entry = setting.roundoff, regimes.REGIMES[regime]
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    b, transmitted = evaluate(FORMULAS[name], rays, setting.vector)
    chord, wrong = errors(b, rays, exact)[0] / u, transmitted != exact.transmitted
    worst = int(np.argmax(np.where(wrong, -1, chord)))
    values = {
        "worst / u": float(np.max(chord, where=~wrong, initial=0)),
        "misjudged": float(found.misjudged.offered + (wrong & ~certain).sum()),
        "misjudged far": float(decisive(name, rays[wrong], u, entry.largest_k).sum()),
        "screen off": _disagreement(name, setting, rays[certain], chord[certain], wrong[certain]),
        "rays": float(count),
        "certified": float(len(rays)),
        "unresolved": float(found.unresolved.offered - (~certain).sum()),
    }
    limit, reason = bound(name, regime, setting, entry.largest_k)
    budgets = {} if limit is None else {"worst / u": limit, "misjudged far": 0.0, "screen off": SCREEN_BUDGET}
    replay = {
        "regime": regime, "text": entry.text, "count": count, "chunk": CHUNK, "first seed": SEED,
        "worst ray": rays.hexed(worst), "misjudged": [rays.hexed(int(i)) for i in np.flatnonzero(wrong)[:3]],
    }  # fmt: skip
    return Row("sweep", name, regime, setting.label, values, budgets, reason=reason, replay=replay)


def _disagreement(name: str, setting: Setting, rays: Rays, chord: np.ndarray, wrong: np.ndarray) -> float:
    """How far the screen's judgement of certified rays is off, in u; of errors above 1e6 u, in a millionth of them."""
    if not len(rays):
        return 0.0
    screened, differs = Screen(rays, setting.vector).judge(FORMULAS[name])
    if (differs != wrong).any():
        return np.inf
    compared = ~wrong & np.isfinite(chord)
    return float(np.max(np.abs(screened - chord) / np.maximum(1, chord / 1e6), where=compared, initial=0))
