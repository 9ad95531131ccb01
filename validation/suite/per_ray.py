"""Per ray: the refraction of other programs, each in a process of its own, against the certified answer.

A program reads rays as CSV and returns directions, as for `mi-refract rays run`. Each answer should be the exact
refraction, in direction and in length, of inputs within 8 roundings of the given ones (a goal). It must be within the
bound of the textbook formula for that ray, in the program's precision. A second goal: the worst error is within a
factor of 3 of the one recorded earlier, on rays of the same kinds, or, for programs added later, on these rays at the
default seed. A missed goal is shown but fails no run: the worst of some thousand rays depends on the sample. The set
"random" was fixed before any result. After the first results, the set "random, apart" was added, with twice as many
rays and without those near the critical angle, because chance decides how near these come. The goal is the same for
both. The set "near-critical" was never changed. An installed program fails if it crashes, hangs, or answers unknown
rays. A program that is not installed, or reports that it cannot run on this machine, is not run.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from mi_refract import regimes
from mi_refract.accuracy import absolute_radicand
from mi_refract.ray_sets import check_answers, ray_set
from mi_refract.ray_sets.check_answers import UNFIT
from mi_refract.ray_sets.files import as_csv, parse_answers
from mi_refract.ray_sets.header import PRECISIONS
from mi_refract.ray_sets.judged_answers import RIGHT
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.ray_sets.renderer_file import RaysCommand
from mi_refract.report.row import Row
from validation import limits, repeated
from validation.run import seeds
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND, MISCLASSIFIED, WORST_ANGLE
from validation.study import Study, Task, about

from .renderers import SYSTEMS, System, environments

NAME = "per_ray"
SEED = 2040
RECORDED, OFF_RECORDED = "recorded", "off the recorded"
BACKWARD = "backward error / u"
OTHER_SIGNAL = "other TIR signal"
RANDOM, APART, CRITICAL, GRAZING = "random", "random, apart", "near-critical", "grazing"
MATCHED, TOTAL, LARGE = "η ≈ 1", "total reflection", "k ≫ 1"
LEFT_OUT = 4e-4  # |cos²θ_t| up to which rays are not in the set APART


@dataclass(frozen=True)
class Set:
    """`count` rays of one kind: `draw` returns their angles of incidence and k, as in `regimes`.

    `stream`: seeds the random generator, together with the seed of the run.
    """

    count: int
    draw: regimes.Draw
    text: str
    stream: int


Angles = tuple[np.ndarray, np.ndarray]  # angles of incidence, and k


def _random(rng: np.random.Generator, count: int, eps: float) -> Angles:
    return np.arccos(rng.uniform(0, 1, count)), 1.5 ** rng.choice([-1.0, 1.0], count)


def _apart(rng: np.random.Generator, count: int, eps: float) -> Angles:
    cosine, k = rng.uniform(0, 1, 2 * count), 1.5 ** rng.choice([-1.0, 1.0], 2 * count)
    apart = np.flatnonzero(np.abs(1 - k * k * (1 - cosine * cosine)) > LEFT_OUT)[:count]
    return np.arccos(cosine[apart]), k[apart]


def _critical(rng: np.random.Generator, count: int, eps: float) -> Angles:
    k = rng.uniform(1.05, 2.5, count)
    return np.arcsin(1 / k) - _spread(rng, 1e-7, 1e-3, count), k


def _grazing(rng: np.random.Generator, count: int, eps: float) -> Angles:
    return np.pi / 2 - _spread(rng, 1e-5, 1e-2, count), np.full(count, 1 / 1.5)


def _matched(rng: np.random.Generator, count: int, eps: float) -> Angles:
    return np.arccos(rng.uniform(0.1, 1, count)), 1 + _spread(rng, 1e-7, 1e-3, count) * rng.choice([-1.0, 1.0], count)


def _total(rng: np.random.Generator, count: int, eps: float) -> Angles:
    return rng.uniform(np.arcsin(1 / 1.5) + 0.01, np.pi / 2 - 0.01, count), np.full(count, 1.5)


def _large(rng: np.random.Generator, count: int, eps: float) -> Angles:
    k = _spread(rng, 10, 1e4, count)
    return np.arcsin(rng.uniform(0, 0.999, count) / k), k


def _spread(rng: np.random.Generator, low: float, high: float, count: int) -> np.ndarray:
    return np.exp(rng.uniform(np.log(low), np.log(high), count))


SETS = {
    RANDOM: Set(10_000, _random, "cosine uniform, k = 1.5 or 1/1.5", 0),
    APART: Set(20_000, _apart, f"cosine uniform, k = 1.5 or 1/1.5; cos²θ_t at least {LEFT_OUT:g} from 0", 0),
    CRITICAL: Set(1000, _critical, "1e-7 … 1e-3 rad short of the critical angle, k in 1.05 … 2.5", 1),
    GRAZING: Set(1000, _grazing, "1e-5 … 1e-2 rad from the surface, k = 1/1.5", 2),
    MATCHED: Set(1000, _matched, "|k − 1| from 1e-7 to 1e-3, cosine uniform in 0.1 … 1", 3),
    TOTAL: Set(1000, _total, "0.01 rad or more beyond the critical angle and from the surface, k = 1.5", 4),
    LARGE: Set(1000, _large, "k from 10 to 10,000, k sin θ_i uniform in 0 … 0.999", 5),
}
TERMS = {name: f"{rays.count} rays: {rays.text}" for name, rays in SETS.items()} | {
    WORST_ANGLE: "the largest angle to the certified direction, without misclassified rays",
    RECORDED: "the largest such angle recorded earlier for this system",
    OFF_RECORDED: "the ratio of the two, or its reciprocal if that is larger; 1 inside a recorded range",
    ERROR_OVER_BOUND: "the largest error of a ray over its a-priori bound, that of the textbook formula",
    BACKWARD: "the largest m such that each direction, and each length, is exact for inputs perturbed by m roundings",
    "median backward error / u": "the median over the directions",
    "p99 backward error / u": "exceeded by one answer in 100",
    MISCLASSIFIED: "rays whose total internal reflection was misclassified",
    "wrong": "rays beyond the bound, misclassified although the bound decides them, or without a direction",
    "given up": "rays left out: so near the critical angle that the system treats them as totally reflected",
    "not seen to deviate": "1 if every answer is right although the system is known to be wrong in this set",
    "unfit": "answers that are missing, duplicate, for unknown rays, or for a ratio of indices that was not given",
    OTHER_SIGNAL: "1 if the program signals total internal reflection in another way than recorded",
    "unanswered": "rays without an answer, because the program crashed, hung or printed none",
}


def tasks(context: Context) -> list[Task]:
    """Return one task per function of each system."""
    return [
        Task(f"per ray: {call.title}, {call.precision}", functools.partial(call_rows, system, call, context))
        for system in SYSTEMS.values()
        for call in system.calls
    ]


def call_rows(system: System, call: RaysCommand, context: Context) -> list[Row]:
    """Return a row per set of rays, or one row with the reason why there are none."""
    rays, reason = all_rays(call.precision), environments.why_not(system, context.profile.name)
    row = functools.partial(Row, NAME, call.title, "every set", call.precision)

    def answer() -> Answers:
        return parse_answers(environments.ask(system, call.command, as_csv(rays)), call.title)

    answers, no_answer = environments.attempt(row, reason, ("unanswered", len(rays)), answer)
    return no_answer if answers is None else rows(call, rays, answers)


@seeds.cached
def all_rays(precision: str) -> RaySet:
    """Return the rays of all sets, one set after the other."""
    parts, ids, first = [], {}, 0
    dtype = PRECISIONS[precision]
    for name, kind in SETS.items():
        rng = np.random.default_rng([seeds.current(SEED), kind.stream])
        normal: np.ndarray = regimes.normalised(rng.normal(size=(kind.count, 3))).astype(dtype)
        a, n, k = (x.astype(dtype) for x in regimes.rays_at(kind.draw, rng, normal))
        # As written by `mi-refract rays export`: the normal faces the ray, which not every program can ensure itself.
        parts.append(ray_set.facing(regimes.Rays(a, n, k)))
        ids[name] = [first, first + kind.count - 1]
        first += kind.count
    header = {"precision": precision, "seed": seeds.current(SEED), "regimes": ids}
    return ray_set.with_checksum(RaySet(regimes.Rays.joined(parts), np.arange(first), header))


def rows(call: RaysCommand, rays: RaySet, answers: Answers) -> list[Row]:
    """Return a row per set. If no ray of a set was answered, its row only says so."""
    left_out = absolute_radicand(rays.rays) < call.gives_up
    findings = check_answers.check(rays[~left_out], answers[~np.isin(answers.ids, rays.ids[left_out])])
    version = str(answers.header.get("system", ""))
    problems = [f"{problem.kind} {problem.text}" for problem in findings.problems]
    mistake = [findings.diagnosis.text] if findings.diagnosis else []
    signal = f"total internal reflection: {findings.tir}"
    remark = "; ".join(filter(None, (version, signal, call.lengths, call.remark, *problems, *mistake)))
    errors_of = {regime.regime: regime for regime in findings.regimes}
    made = []
    for name, kind in SETS.items():
        errors = errors_of.get(name)
        values = {"unfit": float(findings.problem_count(*UNFIT, "index"))}
        budgets, goals = {"unfit": 0.0, "wrong": 0.0}, {}
        if errors is None:
            values["wrong"] = math.nan
        else:
            if errors.compared:
                values |= {WORST_ANGLE: errors.worst, "p99 rad": errors.p99, "mean rad": errors.mean}
            values |= {
                ERROR_OVER_BOUND: errors.error_over_bound,
                MISCLASSIFIED: float(errors.tir_misclassified),
                "wrong": float(errors.wrong),
                "median backward error / u": errors.backward_median,
                "p99 backward error / u": errors.backward_p99,
                # np.maximum keeps NaN.
                BACKWARD: float(np.maximum(errors.backward_worst, errors.backward_length)),
            }
            budgets[ERROR_OVER_BOUND], goals[BACKWARD] = 1.0, RIGHT
            if name == TOTAL and call.tir != "auto":
                values[OTHER_SIGNAL], budgets[OTHER_SIGNAL] = float(findings.tir != call.tir), 0.0
            if recorded := call.recorded_range(name):
                values |= {RECORDED: recorded[1], OFF_RECORDED: off_recorded(errors.worst, *recorded)}
                goals[OFF_RECORDED] = limits.RECORDED
            if name in call.deviations:
                values["not seen to deviate"] = float(errors.wrong == 0)
                budgets = {"unfit": 0.0, "not seen to deviate": 0.0}
        deviation = call.deviations.get(name, "")
        if call.gives_up:
            values["given up"] = float(left_out[rays.regime == name].sum())
        replay = {
            "set": kind.text,
            "seed": seeds.current(SEED),
            "command": " ".join(call.command),
            "worst": errors.replay if errors else None,
            "version": version,
            "total internal reflection": findings.tir,
            "remark": call.remark,
            "known to deviate": deviation,
        }
        deviates = f"; known to deviate: {deviation}" if deviation else ""
        made.append(Row(NAME, call.title, name, call.precision, values, budgets, goals, remark + deviates, replay))
    return made


def off_recorded(worst: float, low: float, high: float) -> float:
    """Return the factor by which `worst` is outside `low` … `high`, 1 if it is inside; NaN stays NaN."""
    if not worst > 0:
        return math.inf if worst == 0 else math.nan
    return max(worst / high, low / worst, 1.0)


STUDY = Study(NAME, "Per ray", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))
