"""Per ray: the refraction of other programs, each in a process of its own, against the certified answer.

A program reads rays as CSV and answers with directions; `mi-refract rays run` does and checks the same. Each answer
should be the exact refraction of inputs within 4 roundings of those given (a goal), and must be within the bound of
the textbook formula, in the program's precision, for that ray. The worst errors of each program were recorded earlier
on rays of the same kinds (the rays themselves were not kept), of the programs that came later on these very rays, at
the default seed; another goal is to be within a factor of 3 of these. Goals are shown where they are missed and fail no
run: the worst of some thousand rays depends on which they are. The set "random" is the first one, as it was before any
result. After the first results its rays near the critical angle were left out, for chance decides how near they come,
and it was made twice as large: that is the set "random, apart". The goal is the same for both. The set "near-critical"
was never changed. A program fails that is installed and crashes, hangs, or answers rays that it was not given. One that
is not installed, or says that it cannot run on this machine, is not run.
"""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from mi_refract import regimes
from mi_refract.accuracy import absolute_radicand
from mi_refract.ray_sets import check_answers, ray_set
from mi_refract.ray_sets.check_answers import PROBLEMS, Findings, RegimeErrors
from mi_refract.ray_sets.files import as_csv, parse_answers
from mi_refract.ray_sets.header import PRECISIONS
from mi_refract.ray_sets.judged_answers import RIGHT
from mi_refract.ray_sets.ray_set import Answers, RaySet
from mi_refract.ray_sets.renderer_file import RaysCommand
from mi_refract.report.row import Reason, Row
from validation import limits, repeated
from validation.run import seeds
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND, MISCLASSIFIED, WORST_ANGLE
from validation.study import Study, Task, about
from validation.suite.renderers.system import (
    APART,
    CRITICAL,
    GRAZING,
    LARGE,
    MATCHED,
    RANDOM,
    TOTAL,
    System,
)

from .renderers import SYSTEMS, environments

Numbers = dict[str, float]
NAME = "per_ray"
SEED = 2040
RECORDED, OFF_RECORDED = "recorded", "off the recorded"
BACKWARD = "backward error / u"
LEFT_OUT = 4e-4  # cos²θ_t in size, up to which rays are not in the set APART


@dataclass(frozen=True)
class Set:
    """`count` rays of a kind: `draw` gives their angles from the normal and k, as in `regimes`.

    `stream`: beside the seed, what the random generator begins with.
    """

    count: int
    draw: regimes.Draw
    text: str
    stream: int


def _random(rng: np.random.Generator, count: int, eps: float) -> tuple[np.ndarray, np.ndarray]:
    return np.arccos(rng.uniform(0, 1, count)), 1.5 ** rng.choice([-1.0, 1.0], count)


def _apart(rng: np.random.Generator, count: int, eps: float) -> tuple[np.ndarray, np.ndarray]:
    cosine, k = rng.uniform(0, 1, 2 * count), 1.5 ** rng.choice([-1.0, 1.0], 2 * count)
    apart = np.flatnonzero(np.abs(1 - k * k * (1 - cosine * cosine)) > LEFT_OUT)[:count]
    return np.arccos(cosine[apart]), k[apart]


def _critical(rng: np.random.Generator, count: int, eps: float) -> tuple[np.ndarray, np.ndarray]:
    k = rng.uniform(1.05, 2.5, count)
    return np.arcsin(1 / k) - _spread(rng, 1e-7, 1e-3, count), k


def _grazing(rng: np.random.Generator, count: int, eps: float) -> tuple[np.ndarray, np.ndarray]:
    return np.pi / 2 - _spread(rng, 1e-5, 1e-2, count), np.full(count, 1 / 1.5)


def _matched(rng: np.random.Generator, count: int, eps: float) -> tuple[np.ndarray, np.ndarray]:
    return np.arccos(rng.uniform(0.1, 1, count)), 1 + _spread(rng, 1e-7, 1e-3, count) * rng.choice([-1.0, 1.0], count)


def _total(rng: np.random.Generator, count: int, eps: float) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(np.arcsin(1 / 1.5) + 0.01, np.pi / 2 - 0.01, count), np.full(count, 1.5)


def _large(rng: np.random.Generator, count: int, eps: float) -> tuple[np.ndarray, np.ndarray]:
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
    OFF_RECORDED: "the ratio of the two, taken above 1; 1 inside a recorded range",
    ERROR_OVER_BOUND: "the largest error of a ray over its a-priori bound, that of the textbook formula",
    BACKWARD: "the largest one: each answer is the exact refraction of inputs within so many roundings of those given",
    "median backward error / u": "the median of them",
    "p99 backward error / u": "exceeded by one answer in 100",
    MISCLASSIFIED: "rays whose total internal reflection was misclassified",
    "wrong": "rays beyond the bound, misclassified although the bound decides them, or without a direction",
    "given up": "rays left out: so near to the critical angle that the system treats them as totally reflected",
    "not seen to deviate": "1 where every answer is right and the system is known to be wrong there",
    "unfit": "answers that are missing, duplicate, or to rays that were not given",
    "told otherwise": "1 where the program signals total internal reflection in another way than was recorded",
    "unanswered": "rays without an answer, because the program crashed, hung or printed none",
}


def tasks(context: Context) -> list[Task]:
    """One per function of each system."""
    return [
        Task(f"per ray: {call.title}, {call.precision}", functools.partial(call_rows, system, call, context))
        for system in SYSTEMS.values()
        for call in system.calls
    ]


def call_rows(system: System, call: RaysCommand, context: Context) -> list[Row]:
    """A row per set of rays, or one that says why there is none."""
    if reason := environments.absent(system):
        return [_unmeasured(call, reason)]
    if not system.small and context.profile.name != "full":
        return [_unmeasured(call, Reason(f"{system.megabytes} MB: in the full profile only", "`--profile full`"))]
    rays = given(call.precision)
    try:
        text = environments.ask(system, call.command, as_csv(rays))
        answers = parse_answers(text, call.title)
    except environments.Unable as reason_here:
        return [_unmeasured(call, f"cannot run here: {reason_here}")]
    except (environments.Broken, ValueError) as defect:
        values = {"unanswered": float(len(rays))}
        return [Row(NAME, call.title, "every set", call.precision, values, {"unanswered": 0}, reason=str(defect))]
    return rows(call, rays, answers)


def _unmeasured(call: RaysCommand, reason: str) -> Row:
    return Row(NAME, call.title, "every set", call.precision, reason=reason)


@seeds.cached
def given(precision: str) -> RaySet:
    """All sets, one after the other."""
    parts = {name: _made(kind, PRECISIONS[precision]) for name, kind in SETS.items()}
    return _gathered(parts, precision)


def _made(kind: Set, precision: type) -> regimes.Rays:
    rng = np.random.default_rng([seeds.current(SEED), kind.stream])
    normal: np.ndarray = regimes.normalised(rng.normal(size=(kind.count, 3))).astype(precision)
    a, n, k = regimes.rays_at(kind.draw, rng, normal)
    # As `mi-refract rays export` writes them: a program need not know rays from behind.
    return ray_set.facing(regimes.Rays(a.astype(precision), n.astype(precision), k.astype(precision)))


def _gathered(parts: dict[str, regimes.Rays], precision: str) -> RaySet:
    ends = itertools.accumulate(map(len, parts.values()))
    ids = {name: [end - len(part), end - 1] for (name, part), end in zip(parts.items(), ends, strict=True)}
    header = {"precision": precision, "seed": seeds.current(SEED), "regimes": ids}
    joined = regimes.Rays.joined(list(parts.values()))
    rays = RaySet(joined, np.arange(len(joined)), header)
    return replace(rays, header=header | {"checksum": ray_set.checksum(rays)})


# Judged ------------------------------------------------------------------------------------------------------------


def rows(call: RaysCommand, rays: RaySet, answers: Answers) -> list[Row]:
    """One per set."""
    left_out = absolute_radicand(rays.rays) < call.gives_up
    findings = check_answers.check(_only(rays, ~left_out), _without(answers, rays.ids[left_out]))
    known = "; ".join(filter(None, (call.lengths, call.remark)))
    about = _remark(findings, str(answers.header.get("system", "")), known)
    made = []
    for name in SETS:
        figures = next((each for each in findings.regimes if each.regime == name), None)
        values, budgets, goals = _measured(name, call, findings, figures)
        deviates = f"; known to deviate: {call.deviations[name]}" if name in call.deviations else ""
        if call.gives_up:
            values["given up"] = float(left_out[rays.regime == name].sum())
        replay = {
            "set": SETS[name].text,
            "seed": seeds.current(SEED),
            "command": " ".join(call.command),
            "worst": figures.replay if figures else None,
            "version": str(answers.header.get("system", "")),
            "total internal reflection": findings.tir,
            "remark": call.remark,
        }
        made.append(Row(NAME, call.title, name, call.precision, values, budgets, goals, about + deviates, replay))
    return made


def _only(rays: RaySet, mask: np.ndarray) -> RaySet:
    return replace(rays, rays=rays.rays[mask], ids=rays.ids[mask])


def _without(answers: Answers, ids: np.ndarray) -> Answers:
    kept = ~np.isin(answers.ids, ids)
    flags = None if answers.transmitted is None else answers.transmitted[kept]
    return replace(answers, ids=answers.ids[kept], b=answers.b[kept], transmitted=flags)


def _remark(findings: Findings, system: str, known: str) -> str:
    """Who answered, the signal of total internal reflection, what is wrong with the answers, and what explains them."""
    problems = [f"{each.kind} {each.text}" for each in findings.problems]
    mistake = [findings.diagnosis.text] if findings.diagnosis else []
    return "; ".join(filter(None, (system, f"total internal reflection: {findings.tir}", known, *problems, *mistake)))


def _measured(
    name: str, call: RaysCommand, findings: Findings, figures: RegimeErrors | None
) -> tuple[Numbers, Numbers, Numbers]:
    """Values, budgets and goals. Where no ray of the set was answered, all that can be said is that it was not."""
    values = {"unfit": float(sum(each.count for each in findings.problems if PROBLEMS[each.kind]))}
    budgets = {"unfit": 0.0, "wrong": 0.0}
    goals: Numbers = {}
    if figures is None:
        return values | {"wrong": math.nan}, budgets, goals
    if figures.compared:
        values |= {WORST_ANGLE: figures.worst, "p99 rad": figures.p99, "mean rad": figures.mean}
    values |= {
        ERROR_OVER_BOUND: figures.error_over_bound,
        MISCLASSIFIED: float(figures.tir_misclassified),
        "wrong": float(figures.wrong),
    }
    values |= {
        "median backward error / u": figures.backward_median,
        "p99 backward error / u": figures.backward_p99,
        BACKWARD: figures.backward_worst,
    }
    goals[BACKWARD] = RIGHT
    budgets[ERROR_OVER_BOUND] = 1.0
    if name == TOTAL:
        values["told otherwise"], budgets["told otherwise"] = float(findings.tir != call.tir), 0.0
    if name in call.recorded:
        values |= {
            RECORDED: call.recorded[name][1],
            OFF_RECORDED: off(figures.worst, *call.recorded[name]),
        }
        goals[OFF_RECORDED] = limits.RECORDED
    if name in call.deviations:
        values["not seen to deviate"] = float(figures.wrong == 0)
        budgets = {"unfit": 0.0, "not seen to deviate": 0.0}
    return values, budgets, goals


def off(worst: float, low: float, high: float) -> float:
    """The factor by which `worst` is outside `low` … `high`, 1 where it is inside; NaN stays NaN."""
    if not worst > 0:
        return math.inf if worst == 0 else math.nan
    return max(worst / high, low / worst, 1.0)


STUDY = Study(NAME, "Per ray", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))
