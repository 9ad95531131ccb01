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

from .directions import Setting, at_the_limit, bound, decisive, errors, evaluate, held, settings
from .plan import Context, Task
from .screen import Screen

TITLE = "Sweep"
TEXT = __doc__.partition("\n")[2].strip()
TERMS = {
    "worst / u": "the largest certified chord error in units of roundoff, of the rays that were decided rightly and, "
    "for documented formulas, are not within 4u of the surface",
    "misjudged": "rays whose total internal reflection was decided wrongly: all that the screen is certain of, and of "
    "the others those that were certified",
    "misjudged far": "certified ones that the formula must decide rightly, as in the study of directions",
    "screen off": "the largest difference between the screen's chord error and the certified one, in u; infinite where "
    "a decision that the screen is certain of was wrong",
    "unresolved": "rays nearer to the critical angle than the screen resolves that were not certified either",
}
SEED = 2031
CHUNK = 1 << 16
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
    sizes = profile.sweep_rays, profile.certified
    rows = [row for regime in regimes.REGIMES for row in regime_rows(regime, setting, *sizes)]
    documented = {name: [row for row in rows if row.subject == name] for name in FORMULAS if not at_the_limit(name)}
    return [row for row in rows if at_the_limit(row.subject)] + [_worst_of(name, r) for name, r in documented.items()]


def _worst_of(name: str, rows: list[Row]) -> Row:
    """One row for a documented formula, over all regimes it was swept in."""
    worst = max(rows, key=lambda row: row.values["worst / u"])
    values = {"worst / u": worst.values["worst / u"]}
    values |= {metric: sum(row.values[metric] for row in rows) for metric in ("misjudged", "rays", "certified")}
    return Row("sweep", name, "all regimes of unit vectors", worst.setting, values, replay=worst.replay)


# One regime ----------------------------------------------------------------------------------------------------


class Best:
    """The rays with the highest scores so far, at most `size`, and how many were offered."""

    def __init__(self, size: int) -> None:
        self.size, self.offered = size, 0
        self.score: np.ndarray = np.empty(0)
        self._rays: list[Rays] = []

    def add(self, rays: Rays, score: np.ndarray, mask: np.ndarray) -> None:
        index = np.flatnonzero(mask)
        self.offered += len(index)
        index = index[_largest(score[index], self.size)]
        score = np.concatenate([self.score, score[index]])
        best = _largest(score, self.size)
        self.score, self._rays = score[best], [Rays.joined([*self._rays, rays[index]])[best]]

    @property
    def rays(self) -> Rays:
        return self._rays[0]


def _largest(x: np.ndarray, count: int) -> np.ndarray:
    """Indices of the `count` largest numbers, or of all."""
    return np.argpartition(-x, count)[:count] if len(x) > count else np.arange(len(x))


@dataclass(frozen=True)
class Gathered:
    """What one formula leaves of a regime: the worst of the rays that the screen is certain of and that were decided
    rightly; the misjudged ones, farthest from the critical angle first; and rays that the screen cannot resolve, those
    that it would decide differently first.
    """

    worst: Best
    misjudged: Best
    unresolved: Best

    def add(self, screen: Screen, held: np.ndarray, chord: np.ndarray, wrong: np.ndarray) -> None:
        rays, certain = screen.rays, ~screen.doubtful
        self.worst.add(rays, chord, certain & held & ~wrong)
        self.misjudged.add(rays, np.abs(screen.margin), certain & wrong)
        self.unresolved.add(rays, wrong.astype(float), ~certain)


def gather(regime: str, setting: Setting, count: int, kept: int) -> dict[str, Gathered]:
    """Screen `count` rays of a regime in chunks; chunk i has the seed SEED + i. By formula that has a budget there."""
    names = [name for name in FORMULAS if at_the_limit(name) or bound(name, regime, setting, 1.0)[0] is not None]
    found = {name: Gathered(Best(kept), Best(kept), Best(UNRESOLVED_SHARE * kept)) for name in names}
    for i, start in enumerate(range(0, count, CHUNK)):
        rays = regimes.make(regime, min(CHUNK, count - start), setting.precision, SEED + i)
        screen = Screen(rays, setting.vector)
        for name in names:
            found[name].add(screen, held(name, screen.cos_i, setting.roundoff), *screen.judge(FORMULAS[name]))
    return found


def regime_rows(regime: str, setting: Setting, count: int, kept: int) -> list[Row]:
    found = gather(regime, setting, count, kept)
    return [_certified_row(name, regime, setting, gathered, count) for name, gathered in found.items()]


def _certified_row(name: str, regime: str, setting: Setting, found: Gathered, count: int) -> Row:
    rays = Rays.joined([found.worst.rays, found.misjudged.rays, found.unresolved.rays])
    certain = np.arange(len(rays)) < len(rays) - len(found.unresolved.rays)
    u, entry = setting.roundoff, regimes.REGIMES[regime]
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    b, transmitted = evaluate(FORMULAS[name], rays, setting.vector)
    wrong = transmitted != exact.transmitted
    with np.errstate(over="ignore"):
        chord = errors(b, rays, exact)[0] / u
    worst = int(np.argmax(np.where(wrong, -1, chord)))
    values = {
        "worst / u": float(np.max(chord, where=~wrong, initial=0)),
        "misjudged": float(found.misjudged.offered + (wrong & ~certain).sum()),
        "misjudged far": float(decisive(name, rays[wrong], u, entry.largest_k).sum()),
        "screen off": _disagreement(found, chord[certain], wrong[certain]),
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


def _disagreement(found: Gathered, chord: np.ndarray, wrong: np.ndarray) -> float:
    """How far the screen is off on the worst and the misjudged rays, in u; of errors above 1e6 u, in millionths."""
    screened = found.worst.score
    if wrong[: len(screened)].any() or not wrong[len(screened) :].all():
        return np.inf
    finite = np.isfinite(screened)
    if (finite != np.isfinite(chord[: len(screened)])).any():
        return np.inf
    screened, chord = screened[finite], chord[: len(screened)][finite]
    return float(np.max(np.abs(screened - chord) / np.maximum(1, chord / 1e6), initial=0))
