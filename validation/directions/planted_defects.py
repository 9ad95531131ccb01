"""Planted defects: each formula with one mistake in it, which the check of the directions must detect.

The mistakes are those printed in the documents, and common ones. Each spoilt formula is checked against the bound of
the formula it was made from, on the same regimes of rays. A defect that no ray detects has escaped. The control is the
formula without a defect: no ray may fail it.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from unittest import mock

import drjit as dr
import numpy as np

from mi_refract import oracle, regimes
from mi_refract.accuracy import Judgement, Subject, judge_formula
from mi_refract.formulas import FORMULAS, contract, wedge
from mi_refract.numerics import error_free
from mi_refract.regimes import Rays
from mi_refract.report.number_text import compact
from mi_refract.report.row import Row
from validation import repeated
from validation.run import seeds
from validation.run.array_settings import Setting, settings
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND, MISCLASSIFIED_FAR
from validation.study import Study, Task, about

NAME = "planted_defects"
SEED = 2028
COUNT, SCALAR_COUNT = 400, 20  # rays per regime
EXACT = tuple(name for name, formula in FORMULAS.items() if formula.budget.at_the_limit)


@dataclass(frozen=True)
class Mutant:
    """`make(formula)` is the formula with the defect; `of` are the formulas to which it applies.

    `rare`: it shows on too few rays to be looked for on scalar arrays, which cost a call per operation.
    """

    text: str
    make: Callable[[Any], Subject]
    of: tuple[str, ...] = tuple(FORMULAS)
    rare: bool = False


# Slips one makes -----------------------------------------------------------------------------------------------


def _swapped_ratio(f: Any) -> Subject:
    return lambda a, n, k: f(a, n, 1 / k)


def _ratio_off(f: Any) -> Subject:
    return lambda a, n, k: f(a, n, k * (1 + 2.0**-10))


def _flipped_normal(f: Any) -> Subject:
    def subject(a: Any, n: Any, k: Any) -> Any:
        b, transmitted = f(a, n, k)
        return dr.select(transmitted, b - n * (2 * dr.dot(n, b)), b), transmitted

    return subject


def _one_sided(f: Any) -> Subject:
    def subject(a: Any, n: Any, k: Any) -> Any:
        b, transmitted = f(a, n, k)
        along = dr.dot(n, b)
        return dr.select(transmitted, b - n * (along + dr.abs(along)), b), transmitted

    return subject


def _slipped_cross(f: Any) -> Subject:
    def subject(a: Any, n: Any, k: Any) -> Any:
        b, transmitted = f(a, n, k)
        x, y, z = wedge(n, a)
        return b + contract(n, type(a)(0 * x, -2 * y, 0 * z)) * dr.select(transmitted, k, 1), transmitted

    return subject


def _never_reflected(f: Any) -> Subject:
    def subject(a: Any, n: Any, k: Any) -> Any:
        b, transmitted = f(a, n, k)
        return dr.select(transmitted, b, a), transmitted

    return subject


def _always(decision: bool) -> Callable[[Any], Subject]:
    def make(f: Any) -> Subject:
        def subject(a: Any, n: Any, k: Any) -> Any:
            b, transmitted = f(a, n, k)
            return b, transmitted | True if decision else transmitted & False

        return subject

    return make


def _last_bit(f: Any) -> Subject:
    def subject(a: Any, n: Any, k: Any) -> Any:
        b, transmitted = f(a, n, k)
        return b * (1 + 2 * dr.epsilon(type(a))), transmitted

    return subject


def _unit_normal_assumed(f: Any) -> Subject:
    def subject(a: Any, n: Any, k: Any) -> Any:
        b, transmitted = f(a, n, k)
        return b * dr.dot(n, n), transmitted

    return subject


def _narrow_contrast(f: Any) -> Subject:
    return lambda a, n, k: f(a, n, k, contrast=k * k - 1)


def _plain_radicand(f: Any) -> Subject:
    return lambda a, n, k: FORMULAS["wedge_contrast"](a, n, k)


def _patched(owner: Any, name: str, replacement: Any) -> Callable[[Any], Subject]:
    def make(f: Any) -> Subject:
        def subject(a: Any, n: Any, k: Any) -> Any:
            with mock.patch.object(owner, name, replacement):
                return f(a, n, k)

        return subject

    return make


def _unfused(x: Any, y: Any, z: Any) -> Any:
    return x * y + z


def _truncated(x: error_free.TripleWord) -> error_free.DoubleWord:
    return error_free.DoubleWord(x.hi, 0 * x.hi)


def _plainly_collected(x: error_free.TripleWord) -> error_free.TripleWord:
    return error_free.TripleWord(x.hi, (sum(x.first),), 0 * x.hi)


# Slips of the documents, as printed ----------------------------------------------------------------------------


def _printed_000(f: Any) -> Subject:
    def subject(a: Any, n: Any, k: Any) -> Any:
        w, a2 = wedge(n, a), dr.dot(a, a)
        radicand = a2 - k * k * dr.dot(w, w)
        refracted = k * contract(n, w) - n * dr.safe_sqrt(radicand)
        return dr.select(radicand >= 0, refracted, a - n * (2 * dr.dot(n, a))), radicand >= 0

    return subject


def _printed_001(f: Any) -> Subject:
    def subject(a: Any, n: Any, k: Any) -> Any:
        b, transmitted = f(a, n, k)
        c = k * dr.cross(a, n)
        length, cos = dr.norm(c), dr.dot(a, n)
        t = length * dr.cross(n, c * dr.rcp(length)) + n * dr.mulsign(dr.safe_sqrt(1 - length * length), cos)
        return dr.select(transmitted, t, b), transmitted

    return subject


def _printed_002(f: Any) -> Subject:
    def subject(a: Any, n: Any, k: Any) -> Any:
        c = dr.dot(n, a)
        radicand = 1 - k * k * (1 - c * c)
        refracted = n * (-k * c - dr.safe_sqrt(radicand)) + k * a
        return dr.select(radicand >= 0, refracted, a - n * (2 * c)), radicand >= 0

    return subject


def _printed_004(f: Any) -> Subject:
    """X = k R/(1 + R²) with R = sin/cos, in the plane of incidence."""

    def subject(a: Any, n: Any, k: Any) -> Any:
        c = dr.dot(n, a)
        tangent = a - n * c
        x = k * dr.abs(c) * dr.norm(tangent)  # R/(1 + R²) = sin cos
        transmitted = x <= 1
        refracted = tangent * (k * dr.abs(c)) + n * dr.mulsign(dr.safe_sqrt(1 - x * x), c)
        return dr.select(transmitted, refracted, tangent - n * c), transmitted

    return subject


MUTANTS = {
    "control": Mutant("the formula as it is", lambda f: f),
    "swapped k": Mutant("n_to / n_from for n_from / n_to", _swapped_ratio),
    "k off": Mutant("a ratio that is off by 2⁻¹⁰", _ratio_off),
    "flipped normal": Mutant("the root with the wrong sign: the refracted ray comes back", _flipped_normal),
    "one-sided": Mutant("the root without the sign of n·a", _one_sided),
    "slipped cross product": Mutant("n × a with a wrong sign in one component", _slipped_cross),
    "no mirror": Mutant("total internal reflection lets the ray pass", _never_reflected),
    "always transmitted": Mutant("`transmitted` is True for every ray", _always(True)),
    "never transmitted": Mutant("`transmitted` is False for every ray", _always(False)),
    "000 as printed": Mutant("n·a < 0 assumed", _printed_000, ("wedge",)),
    "001 as printed": Mutant("‖c‖ (n × ĉ), with ĉ = 0/0 at normal incidence", _printed_001, ("cross",)),
    "002 as printed": Mutant("N·L < 0 assumed", _printed_002, ("decomposed",)),
    "004 as printed": Mutant("X = k R/(1 + R²)", _printed_004, ("rotated",)),
    "one ulp": Mutant("the result times 1 + 2u", _last_bit, EXACT),
    "unit normal assumed": Mutant("the division by n² left out", _unit_normal_assumed, EXACT),
    "plain radicand": Mutant("(n·a)² − κ w² in working precision", _plain_radicand, EXACT),
    "narrow contrast": Mutant("κ = k² − 1 in working precision", _narrow_contrast, EXACT),
    "no fma": Mutant("x y + z rounded twice", _patched(dr, "fma", _unfused), ("compensated",)),
    "truncated radicand": Mutant(
        "its low part dropped", _patched(error_free.TripleWord, "double", _truncated), ("compensated",)
    ),
    "radicand of second order": Mutant(
        "sums of first order rounded",
        _patched(error_free.TripleWord, "collected", _plainly_collected),
        ("compensated",),
        rare=True,
    ),
}
TERMS = {name: mutant.text for name, mutant in MUTANTS.items()} | {
    "rays that see it": "rays whose error exceeds their bound, or whose decision is wrong beyond the margin",
    "escaped": "1 where no ray sees the defect",
}


# Judged --------------------------------------------------------------------------------------------------------


def tasks(context: Context) -> list[Task]:
    """On single precision where it is compiled, else on what there is."""
    running = [setting for setting in settings(context) if setting.vector is not None]
    setting = next((s for s in running if s.precision is np.float32), running[0])
    return [Task(f"planted defects: {setting.label}", functools.partial(_rows, setting))]


def _rows(setting: Setting) -> list[Row]:
    sample = draw(SCALAR_COUNT if setting.is_scalar else COUNT, setting.precision)
    return [_row(name, formula, setting, sample) for name in MUTANTS for formula in MUTANTS[name].of]


RARE = "shows on one ray in a hundred; scalar arrays are asked for too few"


def _row(name: str, formula: str, setting: Setting, sample: Sample) -> Row:
    if MUTANTS[name].rare and setting.is_scalar:
        return Row(NAME, name, formula, setting.label, reason=RARE)
    found = sample.judge(name, formula, setting.vector)
    seen = int(found.wrong.sum())
    values = {"rays that see it": float(seen), "escaped": float(seen == 0), **found.values()}
    budgets = {"rays that see it": 0.0} if name == "control" else {"escaped": 0.0}
    remark = sample.strongest(found) if seen else ""
    replay = {"seed": seeds.current(SEED), "rays": len(found.wrong)}
    return Row(NAME, name, formula, setting.label, values, budgets, reason=remark, replay=replay)


@dataclass(frozen=True)
class Sample:
    """Rays of all regimes in one set; `regime` names each ray's own, `unit` says whether its vectors are unit."""

    rays: Rays
    exact: oracle.Certified
    regime: np.ndarray
    unit: np.ndarray

    def judge(self, mutant: str, formula: str, vector: Any) -> Judgement:
        """Check a mutant against the bound of the formula it was made from, on the rays that this formula accepts."""
        spoilt, budget = MUTANTS[mutant].make(FORMULAS[formula]), FORMULAS[formula].budget
        part = self if budget.at_the_limit else self.only(self.unit)
        return judge_formula(spoilt, part.rays, part.exact, vector, budget)

    def only(self, mask: np.ndarray) -> Sample:
        """The rays of a mask (N,)."""

        def part(x: Any) -> Any:
            return type(x)(**{f.name: getattr(x, f.name)[mask] for f in dataclasses.fields(x)})

        return Sample(part(self.rays), part(self.exact), self.regime[mask], self.unit[mask])

    def strongest(self, found: Judgement) -> str:
        """ "regime, metric value": a wrong decision before a wrong direction, where most rays see it."""
        metric, mask = (MISCLASSIFIED_FAR, found.far) if found.far.any() else (ERROR_OVER_BOUND, found.wrong)
        names = self.regime if len(mask) == len(self.regime) else self.regime[self.unit]
        regime = max(dict.fromkeys(names), key=lambda name: int(mask[names == name].sum()))
        there = names == regime
        value = mask[there].sum() if metric == MISCLASSIFIED_FAR else found.share[there].max()
        return f"caught by {regime}: {metric} {compact(float(value))}"


@seeds.cached
def draw(count: int, precision: type) -> Sample:
    """`count` rays of every regime that is one on every backend, and normal incidence along the axes."""
    entries = {name: entry for name, entry in regimes.REGIMES.items() if not entry.rests_on_denormals}
    parts = {name: regimes.make(name, count, precision, seeds.current(SEED)) for name in entries}
    parts["along an axis"] = _along_axes(precision)
    units = [*(entry.unit for entry in entries.values()), True]
    a, n, k = (np.concatenate([getattr(rays, x) for rays in parts.values()]) for x in ("a", "n", "k"))
    lengths = [len(rays.k) for rays in parts.values()]
    exact = oracle.refract(a, n, k, fresnel=False, progress=False)
    return Sample(Rays(a, n, k), exact, np.repeat(list(parts), lengths), np.repeat(units, lengths))


def _along_axes(precision: type) -> Rays:
    """From either side, into the denser and the thinner medium."""
    n: np.ndarray = np.tile(np.eye(3, dtype=precision), (4, 1))
    side, k = np.repeat([[1.0], [-1.0]], 6, axis=0), np.tile(np.repeat([0.75, 1.5], 3), 2)
    return Rays((n * side).astype(precision), n, k.astype(precision))


STUDY = Study(NAME, "Planted defects", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))
