"""Planted defects: each formula with one mistake, which the check of directions must detect.

The mistakes are misprints of the documents, and common ones. Each formula with a defect is checked against the original
formula's bound, on the same regimes of rays. A defect that no ray detects has escaped. The control is the formula
without a defect: no ray may fail.
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
from mi_refract.io.text import compact
from mi_refract.numerics import error_free
from mi_refract.regimes import Rays
from mi_refract.report.row import Row
from validation import repeated
from validation.run import seeds
from validation.run.array_settings import DOCUMENTED, Setting, running
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND, MISCLASSIFIED_FAR
from validation.study import Study, Task, about

NAME = "planted_defects"
SEED = 2028
COUNT, SCALAR_COUNT = 400, 20  # rays per regime
# Rare defects show on one ray in a hundred of this regime: the probability that none of 6400 rays shows one is e⁻⁵⁰.
RARE_REGIME, MORE = "critical, to the ulp", 16
EXACT = tuple(name for name in FORMULAS if name not in DOCUMENTED)

Answer = tuple[Any, Any]  # b and transmitted


@dataclass(frozen=True)
class Mutant:
    """A defect. `answer(formula, a, n, k)` evaluates a formula with the defect; `of`: the formulas that can have it.

    `rare`: the defect shows on too few rays for scalar arrays, which cost a Python call per operation.
    """

    text: str
    answer: Callable[[Any, Any, Any, Any], Answer]
    of: tuple[str, ...] = tuple(FORMULAS)
    rare: bool = False

    def make(self, formula: Any) -> Subject:
        """Return the formula with the defect."""
        return functools.partial(self.answer, formula)


# Defects of any formula f ----------------------------------------------------------------------------------------


def _after(change: Callable[..., Answer]) -> Callable[[Any, Any, Any, Any], Answer]:
    """Return a defect that applies `change(b, transmitted, a, n, k)` to a formula's answer."""
    return lambda f, *ray: change(*f(*ray), *ray)


def _one_sided(b: Any, transmitted: Any, a: Any, n: Any, k: Any) -> Answer:
    normal_part = dr.dot(n, b)
    return dr.select(transmitted, b - n * (normal_part + dr.abs(normal_part)), b), transmitted


def _slipped_cross(b: Any, transmitted: Any, a: Any, n: Any, k: Any) -> Answer:
    x, y, z = wedge(n, a)
    return b + contract(n, type(a)(0 * x, -2 * y, 0 * z)) * dr.select(transmitted, k, 1), transmitted


def _patched(owner: Any, name: str, replacement: Any) -> Callable[[Any, Any, Any, Any], Answer]:
    def answer(f: Any, a: Any, n: Any, k: Any) -> Answer:
        with mock.patch.object(owner, name, replacement):
            answer: tuple[Any, Any] = f(a, n, k)
            return answer

    return answer


# Defects of the documents, as printed ----------------------------------------------------------------------------


def _printed_000(f: Any, a: Any, n: Any, k: Any) -> Answer:
    w, a2 = wedge(n, a), dr.dot(a, a)
    radicand = a2 - k * k * dr.dot(w, w)
    refracted = k * contract(n, w) - n * dr.safe_sqrt(radicand)
    return dr.select(radicand >= 0, refracted, a - n * (2 * dr.dot(n, a))), radicand >= 0


def _printed_001(f: Any, a: Any, n: Any, k: Any) -> Answer:
    b, transmitted = f(a, n, k)
    c = k * dr.cross(a, n)
    length, cos = dr.norm(c), dr.dot(a, n)
    t = length * dr.cross(n, c * dr.rcp(length)) + n * dr.mulsign(dr.safe_sqrt(1 - length * length), cos)
    return dr.select(transmitted, t, b), transmitted


def _printed_002(f: Any, a: Any, n: Any, k: Any) -> Answer:
    c = dr.dot(n, a)
    radicand = 1 - k * k * (1 - c * c)
    refracted = n * (-k * c - dr.safe_sqrt(radicand)) + k * a
    return dr.select(radicand >= 0, refracted, a - n * (2 * c)), radicand >= 0


def _printed_004(f: Any, a: Any, n: Any, k: Any) -> Answer:
    """Return X = k R/(1 + R²) with R = sin/cos, in the plane of incidence."""
    c = dr.dot(n, a)
    tangent = a - n * c
    x = k * dr.abs(c) * dr.norm(tangent)  # R/(1 + R²) = sin cos
    refracted = tangent * (k * dr.abs(c)) + n * dr.mulsign(dr.safe_sqrt(1 - x * x), c)
    return dr.select(x <= 1, refracted, tangent - n * c), x <= 1


MUTANTS = {
    "control": Mutant("the formula as it is", lambda f, a, n, k: f(a, n, k)),
    "swapped k": Mutant("n_to / n_from instead of n_from / n_to", lambda f, a, n, k: f(a, n, 1 / k)),
    "k off": Mutant("a ratio with an error of 2⁻¹⁰", lambda f, a, n, k: f(a, n, k * (1 + 2.0**-10))),
    "flipped normal": Mutant(
        "the root with the wrong sign: the refracted ray stays on the side of the incident ray",
        _after(lambda b, t, a, n, k: (dr.select(t, b - n * (2 * dr.dot(n, b)), b), t)),
    ),
    "one-sided": Mutant("the root without the sign of n·a", _after(_one_sided)),
    "slipped cross product": Mutant("n × a with a wrong sign in one component", _after(_slipped_cross)),
    "no mirror": Mutant(
        "total internal reflection returns the incident direction",
        _after(lambda b, t, a, n, k: (dr.select(t, b, a), t)),
    ),
    "always transmitted": Mutant("`transmitted` is True for every ray", _after(lambda b, t, *_: (b, t | True))),
    "never transmitted": Mutant("`transmitted` is False for every ray", _after(lambda b, t, *_: (b, t & False))),
    "000 as printed": Mutant("n·a < 0 assumed", _printed_000, ("wedge",)),
    "001 as printed": Mutant("‖c‖ (n × ĉ), with ĉ = 0/0 at normal incidence", _printed_001, ("cross",)),
    "002 as printed": Mutant("N·L < 0 assumed", _printed_002, ("decomposed",)),
    "004 as printed": Mutant("X = k R/(1 + R²)", _printed_004, ("rotated",)),
    "one ulp": Mutant(
        "the result multiplied by 1 + 2u", _after(lambda b, t, *_: (b * (1 + 2 * dr.epsilon(type(b))), t)), EXACT
    ),
    "unit normal assumed": Mutant(
        "the division by n² left out", _after(lambda b, t, a, n, k: (b * dr.dot(n, n), t)), EXACT
    ),
    "plain radicand": Mutant(
        "(n·a)² − κ w² in working precision", lambda f, a, n, k: FORMULAS["wedge_contrast"](a, n, k), EXACT
    ),
    "narrow contrast": Mutant(
        "κ = k² − 1 in working precision", lambda f, a, n, k: f(a, n, k, contrast=k * k - 1), EXACT
    ),
    "no fma": Mutant("x y + z rounded twice", _patched(dr, "fma", lambda x, y, z: x * y + z), ("compensated",)),
    "truncated radicand": Mutant(
        "the radicand without its low part",
        _patched(error_free.TripleWord, "double", lambda x: error_free.DoubleWord(x.hi, 0 * x.hi)),
        ("compensated",),
    ),
    "radicand of second order": Mutant(
        "the radicand with rounded sums of first order",
        _patched(error_free.TripleWord, "collected", lambda x: error_free.TripleWord(x.hi, (sum(x.first),), 0 * x.hi)),
        ("compensated",),
        rare=True,
    ),
}
TERMS = {name: mutant.text for name, mutant in MUTANTS.items()} | {
    "rays that see it": "rays whose error exceeds their bound, or whose decision is wrong beyond the margin",
    "escaped": "1 if no ray detects the defect",
}


# Judged --------------------------------------------------------------------------------------------------------


def tasks(context: Context) -> list[Task]:
    """Return one task, in single precision if a compiled backend runs, otherwise in the first setting that runs."""
    available = running(context)
    setting = next((s for s in available if s.precision is np.float32), available[0])
    return [Task(f"planted defects: {setting.label}", functools.partial(rows, setting))]


def rows(setting: Setting) -> list[Row]:
    """Return the rows of every mutant of every formula."""
    sample = draw(SCALAR_COUNT if setting.is_scalar else COUNT, setting.precision)
    return [row(name, formula, setting, sample) for name in MUTANTS for formula in MUTANTS[name].of]


RARE = "shows on one ray in a hundred; scalar arrays compute too few"


def row(name: str, formula: str, setting: Setting, sample: Sample) -> Row:
    """Return the row of one mutant of a formula."""
    if MUTANTS[name].rare and setting.is_scalar:
        return Row(NAME, name, formula, setting.label, reason=RARE)
    judgement = sample.judge(name, formula, setting.vector)
    count = int(judgement.wrong.sum())
    values = {"rays that see it": float(count), "escaped": float(count == 0), **judgement.values()}
    budgets = {"rays that see it": 0.0} if name == "control" else {"escaped": 0.0}
    remark = sample.strongest(judgement) if count else ""
    replay = {"seed": seeds.current(SEED), "rays": len(judgement.wrong)}
    return Row(NAME, name, formula, setting.label, values, budgets, reason=remark, replay=replay)


@dataclass(frozen=True)
class Sample:
    """Rays of all regimes in one set. `regime`: each ray's regime; `unit`: whether its vectors are unit."""

    rays: Rays
    exact: oracle.Certified
    regime: np.ndarray
    unit: np.ndarray

    def judge(self, mutant: str, formula: str, vector: Any) -> Judgement:
        """Check a mutant against the original formula's bound, on the rays that this formula accepts."""
        function, budget = MUTANTS[mutant].make(FORMULAS[formula]), FORMULAS[formula].budget
        if budget.at_the_limit:
            return judge_formula(function, self.rays, self.exact, vector, budget)
        fields = {field.name: getattr(self.exact, field.name)[self.unit] for field in dataclasses.fields(self.exact)}
        exact = oracle.Certified(**fields)
        return judge_formula(function, self.rays[self.unit], exact, vector, budget)

    def strongest(self, judgement: Judgement) -> str:
        """Return the regime in which most rays detect the defect, and its metric: wrong decisions before errors."""
        wrong_decision = judgement.far.any()
        metric, mask = (MISCLASSIFIED_FAR, judgement.far) if wrong_decision else (ERROR_OVER_BOUND, judgement.wrong)
        names = self.regime if len(mask) == len(self.regime) else self.regime[self.unit]
        regime = max(dict.fromkeys(names), key=lambda name: int(mask[names == name].sum()))
        in_regime = names == regime
        value = mask[in_regime].sum() if wrong_decision else judgement.share[in_regime].max()
        return f"caught by {regime}: {metric} {compact(float(value))}"


@seeds.cached
def draw(count: int, precision: type) -> Sample:
    """Return `count` rays of every regime without denormal numbers, and rays of normal incidence along the axes.

    The regime of rare defects has MORE times as many rays, except on scalar arrays.
    """
    entries = {name: entry for name, entry in regimes.REGIMES.items() if not entry.rests_on_denormals}
    counts = dict.fromkeys(entries, count) | ({} if count == SCALAR_COUNT else {RARE_REGIME: MORE * count})
    parts = {name: regimes.make(name, n, precision, seeds.current(SEED)) for name, n in counts.items()}
    # Along the axes, from either side, into the denser and the thinner medium.
    n: np.ndarray = np.tile(np.eye(3, dtype=precision), (4, 1))
    side = np.repeat([[1.0], [-1.0]], 6, axis=0)
    k = np.tile(np.repeat([0.75, 1.5], 3), 2)
    parts["along an axis"] = Rays((n * side).astype(precision), n, k.astype(precision))
    units = [*(entry.unit for entry in entries.values()), True]
    rays = Rays.joined(list(parts.values()))
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    lengths = list(map(len, parts.values()))
    return Sample(rays, exact, np.repeat(list(parts), lengths), np.repeat(units, lengths))


STUDY = Study(NAME, "Planted defects", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))
