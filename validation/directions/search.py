"""Search for the worst rays: hill climbing on the bits of a ray, for every formula in every regime.

The first parents are the worst rays of a random sample of each regime. In each generation a parent gets children, in
which a few numbers are changed by 2ⁱ ulps; the worst child replaces the parent if it is at least as bad. The search
maximises two quantities: the chord error, and the distance from the critical angle at which total internal reflection
is still misclassified. Some children are moved to within a few ulps of the critical angle. All rays stay in the domain:
unit vectors stay unit up to rounding, lengths within 1e-18 … 1e18, ratios within those of the regime.

The tests replay the worst rays of earlier searches, tests/data/worst_rays.txt. A row of this study lists its worst rays
as lines of that file.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.random import Generator

from mi_refract import oracle, regimes
from mi_refract.accuracy import BUDGETS, Subject, judge_formula
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import REGIMES, Rays
from mi_refract.report.row import Row
from validation import repeated
from validation.reference.fast_reference import Screen
from validation.run import seeds
from validation.run.array_settings import Setting, budget_of, settings
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND, MISCLASSIFIED_FAR
from validation.study import Study, Task, about

NAME = "search"
TERMS = {
    ERROR_OVER_BOUND: "the largest certified error, divided by its ray's a-priori bound",
    MISCLASSIFIED_FAR: "rays whose total internal reflection the formula must classify correctly but does not",
    "rays tried": "number of children in all generations",
}
SEED = 2037
SAMPLE, LARGEST_SAMPLE = 4000, 1 << 16
FAMILIES = 6  # per regime and objective
CHILDREN = 24
TRIALS = 1024
WORST_RAYS = Path(__file__).parents[2] / "tests" / "data" / "worst_rays.txt"


def tasks(context: Context) -> list[Task]:
    """Return one task per formula, vectorised backend and precision."""
    return [
        Task(f"search: {name}, {setting.label}", functools.partial(_rows, context, name, setting))
        for setting in settings(context)
        if not setting.is_scalar
        for name in FORMULAS
    ]


def _rows(context: Context, name: str, setting: Setting) -> list[Row]:
    if setting.vector is None:
        return [Row(NAME, name, "all regimes", setting.label, reason=setting.reason)]
    generations, sample = context.profile.generations, min(context.profile.sweep_rays // 10, LARGEST_SAMPLE)
    names = [regime for regime in REGIMES if not setting.no_budget(budget_of(name), regime)]  # regimes with a budget
    herd = climb(name, FORMULAS[name], names, setting, generations, seeds.current(SEED), sample)
    worst = certify(name, FORMULAS[name], herd, setting)
    chords = [ray for ray in worst if ray.objective == "chord"]
    far = [ray.line() for ray in worst if ray.objective == "decision" and ray.share > 0]
    values = {ERROR_OVER_BOUND: float(np.max([ray.share for ray in chords], initial=0.0))}
    values |= {MISCLASSIFIED_FAR: float(len(far))}
    values["rays tried"] = float(generations * CHILDREN * len(herd))
    worst_lines = [ray.line() for ray in sorted(chords, key=lambda ray: -ray.share)[:3]]
    sizes = {"seed": seeds.current(SEED), "sample": sample, "generations": generations}
    replay = {**sizes, "worst": worst_lines, "misclassified": far[:3]}
    return [Row(NAME, name, "all regimes", setting.label, values, BUDGETS, replay=replay)]


# The herd ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Herd:
    """The parents, one per family: ray, regime (an index into `names`), whether its objective is "decision", score."""

    rays: Rays
    regime: np.ndarray
    decision: np.ndarray
    score: np.ndarray
    names: tuple[str, ...]

    def __len__(self) -> int:
        """The number of families."""
        return len(self.score)

    def of_regime(self, name: str) -> np.ndarray:
        """Return an attribute of each family's regime."""
        return np.asarray(np.array([getattr(REGIMES[regime], name) for regime in self.names])[self.regime])


def climb(
    name: str,
    subject: Subject,
    names: Iterable[str],
    setting: Setting,
    generations: int,
    seed: int = SEED,
    sample: int = SAMPLE,
) -> Herd:
    """Return the worst rays after `generations`. `subject` is evaluated and compared with the bound of `name`."""
    rng, names = np.random.default_rng(seed), tuple(names)
    herd = _parents(name, subject, names, setting, seed, sample)
    rows = np.arange(len(herd))
    for _ in range(generations):
        parents = np.repeat(rows, CHILDREN)
        children = _mutated(rng, herd.rays[parents], herd.of_regime("unit")[parents])
        # With the objective "decision" one child in four moves to the critical angle, otherwise one in sixteen.
        moving = np.flatnonzero(rng.random(len(parents)) < np.where(herd.decision[parents], 1 / 4, 1 / 16))
        order = np.arange(len(parents))
        order[moving] = len(parents) + np.arange(len(moving))
        children = Rays.joined([children, _to_critical(rng, children[moving])])[order]
        inside = _inside(children, herd, parents)
        score = _scores(name, subject, Screen(children, setting.vector), herd.decision[parents])
        score = np.where(inside, score, -np.inf)
        best = score.reshape(-1, CHILDREN).argmax(1) + rows * CHILDREN
        # A child as bad as its parent replaces it, so that the search crosses plateaus at random.
        replaced = inside[best] & (score[best] >= herd.score)
        rays = Rays.joined([herd.rays, children[best]])[np.where(replaced, len(herd) + rows, rows)]
        herd = Herd(rays, herd.regime, herd.decision, np.where(replaced, score[best], herd.score), names)
    return herd


def _parents(name: str, subject: Subject, names: tuple[str, ...], setting: Setting, seed: int, sample: int) -> Herd:
    """Return the worst rays of a sample of every regime, by either objective."""
    rays, scores = [], []
    for regime_name in names:
        screen = _sample(regime_name, setting, seed, sample)
        for objective in (False, True):
            score = _scores(name, subject, screen, np.full(sample, objective))
            worst_ones = np.argsort(-score, kind="stable")[:FAMILIES]
            rays.append(screen.rays[worst_ones])
            scores.append(score[worst_ones])
    regime = np.repeat(np.arange(len(names)), 2 * FAMILIES)
    decision = np.tile(np.repeat([False, True], FAMILIES), len(names))
    return Herd(Rays.joined(rays), regime, decision, np.concatenate(scores), names)


@functools.cache
def _sample(name: str, setting: Setting, seed: int, count: int) -> Screen:
    return Screen(regimes.make(name, count, setting.precision, seed), setting.vector)


def _scores(name: str, subject: Subject, screen: Screen, decision: np.ndarray) -> np.ndarray:
    """Return scores, higher for worse rays; −∞ for rays whose side of the surface the formula need not know.

    Chord: the error over its bound, for correctly classified rays. Decision: the distance from the critical angle of a
    wrong decision, minus this distance for a right one.
    """
    chord, wrong = screen.judge(subject)
    far, budget = np.abs(screen.relative_radicand), budget_of(name)
    by_chord = np.where(wrong, -np.inf, chord / screen.bound(budget))
    score = np.where(decision, np.where(wrong, far, -far), by_chord)
    score = np.where(budget.side_open(screen.roundoff, screen.cos_i), -np.inf, score)
    return np.where(screen.doubtful | np.isnan(score), -np.inf, score)


@np.errstate(over="ignore", invalid="ignore")  # a step may lead out of the domain
def _to_critical(rng: Generator, rays: Rays) -> Rays:
    """Move rays to the critical angle: a Newton step in one number, then the best of TRIALS combinations of ulps.

    The best combination is that with the smallest radicand to first order.
    """
    rows, precision = np.arange(len(rays)), rays.k.dtype
    numbers = np.column_stack([rays.a, rays.n, rays.k]).astype(np.float64)
    radicand, gradient = regimes.radicand_and_gradient(numbers[:, :3], numbers[:, 3:6], numbers[:, 6])
    j = rng.integers(0, 7, len(rays))
    numbers[rows, j] -= radicand / gradient[rows, j]
    ulps = np.spacing(np.abs(numbers).astype(precision)).astype(np.float64)
    numbers = numbers.astype(precision).astype(np.float64)
    radicand, gradient = regimes.radicand_and_gradient(numbers[:, :3], numbers[:, 3:6], numbers[:, 6])
    steps = rng.integers(-3, 4, (TRIALS, 7)) * (rng.random((TRIALS, 7)) < 0.5)
    best = np.abs(radicand[:, None] + (gradient * ulps) @ steps.T).argmin(1)
    numbers = (numbers + steps[best] * ulps).astype(precision)
    return Rays(numbers[:, :3], numbers[:, 3:6], numbers[:, 6])


def _mutated(rng: Generator, rays: Rays, unit: np.ndarray) -> Rays:
    """Change a few numbers by ±2^j ulps, mostly with small j; normalise a quarter of the unit vectors again."""
    precision = rays.k.dtype
    limits = np.finfo(precision)
    bits = np.column_stack([rays.a, rays.n, rays.k]).view(f"i{precision.itemsize}")
    step = np.exp2(np.floor(limits.nmant * rng.random(bits.shape) ** 2)).astype(bits.dtype)
    step *= rng.choice(np.array([-1, 1], bits.dtype), bits.shape)
    # Zeros and denormal numbers do not change: they belong to other regimes.
    chance = rng.choice([0.05, 0.3], (len(rays), 1))
    changed = (rng.random(bits.shape) < chance) & (np.abs(bits.view(precision)) >= limits.smallest_normal)
    numbers = np.where(changed, bits + step, bits).view(precision)
    a, n, k = numbers[:, :3], numbers[:, 3:6], numbers[:, 6]
    normalise = (unit & (rng.random(len(k)) < 0.25))[:, None]
    a, n = (np.where(normalise, regimes.normalised(v), v).astype(precision) for v in (a, n))
    return Rays(a, n, k)


def _inside(rays: Rays, herd: Herd, parents: np.ndarray) -> np.ndarray:
    """Return which children are in the domain of their regime."""
    unit, largest_k = (herd.of_regime(name)[parents] for name in ("unit", "largest_k"))
    # Rounding the components changes a length by at most √3/2 u.
    slack = 3**0.5 / 4 * float(np.finfo(rays.k.dtype).eps)
    inside = (rays.k >= 1e-6) & (rays.k <= largest_k)
    for v in (rays.a, rays.n):
        wide = v.astype(np.longdouble)
        length = np.sqrt((wide * wide).sum(1))
        inside &= np.where(unit, np.abs(length - 1) <= slack, (length > 1e-18) & (length < 1e18))
    return np.asarray(inside)


# Results -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Found:
    """A ray of the results, a line of the file. `numbers` are a, n and k as seven hexadecimal floats.

    `objective` and `score`: "chord", the certified chord error in u; "decision" for a ray whose total internal
    reflection the formula misclassifies, |D| in u² of the radicand's terms. `share`, not in the file: the chord
    error over its bound; for a decision 1 if it had to be right, otherwise 0.
    """

    precision: str
    formula: str
    regime: str
    objective: str
    score: float
    numbers: tuple[str, ...]
    share: float = 0.0

    def line(self) -> str:
        """Return the line of the file."""
        vectors = " ".join(self.numbers[:3]), " ".join(self.numbers[3:6]), self.numbers[6]
        fields = self.precision, self.formula, self.regime, self.objective, f"{self.score:.4g}", *vectors
        return " | ".join(fields)

    @classmethod
    def parse(cls, line: str) -> Found:
        """Read a line. ValueError for a line of another form."""
        precision, formula, regime, objective, score, a, n, k = line.split(" | ")
        numbers = (*a.split(), *n.split(), k)
        if len(numbers) != 7 or not np.isfinite([float.fromhex(x) for x in numbers]).all():
            raise ValueError(f"not a ray: {line!r}; expected three numbers for a, three for n, one for k")
        return cls(precision, formula, regime, objective, float(score), numbers)


def certify(name: str, subject: Subject, herd: Herd, setting: Setting) -> list[Found]:
    """Return every parent with its certified score, judged by the budget of `name`."""
    rays, u = herd.rays, setting.roundoff
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    judgement = judge_formula(subject, rays, exact, setting.vector, budget_of(name))
    margin = np.abs(oracle.relative_radicand(rays.a, rays.n, rays.k)) / u**2
    results = []
    for i, wrong in enumerate((judgement.misjudged | judgement.far).tolist()):
        if wrong:
            objective, score, share = "decision", margin[i], judgement.far[i]
        else:
            objective, score, share = "chord", judgement.chord[i] / u, judgement.share[i]
        ray, regime = rays.hexed(i), herd.names[herd.regime[i]]
        numbers = *ray["a"], *ray["n"], ray["k"]
        results.append(Found(rays.k.dtype.name, name, regime, objective, float(score), numbers, float(share)))
    return results


def worst_rays(path: Path = WORST_RAYS) -> list[Found]:
    """Read the worst rays of earlier searches. ValueError for an invalid line."""
    return [Found.parse(line) for line in path.read_text().splitlines() if line and not line.startswith("#")]


def rays_of(lines: Iterable[Found], precision: str) -> Rays:
    """Return the exact rays of the lines of a precision."""
    numbers = [[float.fromhex(x) for x in line.numbers] for line in lines if line.precision == precision]
    table = np.array(numbers, dtype=precision).reshape(-1, 7)
    return Rays(table[:, :3], table[:, 3:6], table[:, 6])


STUDY = Study(NAME, "Search", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))
