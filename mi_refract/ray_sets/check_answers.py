"""Answers to a ray set against the certified ones: how far off, where, whether total internal reflection was seen.

Every ray is certified. An answer is held against the budget of a documented formula for that very ray: as good as
that is right. Errors are angles, in the rays that were decided rightly; lengths are looked at apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_refract.formulas import FORMULAS

from .diagnosis import Explanation, explain
from .ray_set import Answers, RaySet
from .tir_signal import AUTO, FLAG, TIR, UNCLEAR, Judged, judge

# The documented formula that is allowed most.
LOOSEST = max(FORMULAS, key=lambda name: (FORMULAS[name].budget.growth, FORMULAS[name].budget.radicand))
FIRST = 5


@dataclass(frozen=True)
class Figures:
    """One regime. Errors are angles to the certified direction, of the rays that were decided rightly, in radians."""

    regime: str
    rays: int  # answered
    judged: int  # rays whose direction was compared
    worst: float
    p99: float
    mean: float
    norm: float  # the largest | |b| − 1 |, or of |b|/|a| where that is less
    misjudged: int  # rays whose total internal reflection was decided wrongly
    far: int  # those of them that are farther from the critical angle than the budget leaves open
    share: float  # the largest share that an error takes of its ray's budget
    wrong: int  # rays beyond their budget: too far off, misjudged far, or without a direction
    limit: int  # rays whose answer is the exact one but for rounding
    replay: dict[str, Any]  # the ray with the largest share, in hexadecimal floats


@dataclass(frozen=True)
class Problem:
    """What is wrong with the answers as a set of numbers: `text` names the first of `count`."""

    kind: str  # a key of PROBLEMS
    count: int
    text: str


# What there can be, and whether the answers are then not those to the rays.
PROBLEMS = {"missing": True, "duplicate": True, "unknown": True, "non-finite": False, "zero": False}


@dataclass(frozen=True)
class Findings:
    """What `check` found. Where `answered` is 0 there are no regimes."""

    precision: str
    ulp: float  # 2⁻²³ or 2⁻⁵²
    budget: str  # the formula whose budget was applied
    tir: str  # how total internal reflection is told; NONE where no ray has it, UNCLEAR where in no known way
    told: bool  # by the caller
    regimes: tuple[Figures, ...]
    problems: tuple[Problem, ...]
    explanations: tuple[Explanation, ...]  # of wrong answers
    header: dict[str, Any]  # of the rays

    @property
    def answered(self) -> int:
        return sum(each.rays for each in self.regimes)

    @property
    def judged(self) -> int:
        return sum(each.judged for each in self.regimes)

    @property
    def wrong(self) -> int:
        return sum(each.wrong for each in self.regimes)

    @property
    def limit(self) -> int:
        return sum(each.limit for each in self.regimes)

    @property
    def farthest(self) -> Figures:
        """The regime with the largest angle. ValueError where nothing was answered."""
        return max(self.regimes, key=lambda each: (each.judged > 0, each.worst))

    @property
    def diagnosis(self) -> Explanation | None:
        """The mistake that explains the answers, where exactly one does."""
        found = [each for each in self.explanations if each.explains]
        return found[0] if len(found) == 1 else None

    @property
    def exit_code(self) -> int:
        """0: all within the budget. 1: some refraction is wrong. 2: answers are missing, doubled, or to other rays.

        1 too where no direction was compared: of rays that anyone may decide either way, all were given up.
        """
        if not self.answered or any(PROBLEMS[problem.kind] for problem in self.problems):
            return 2
        return int(self.wrong > 0 or self.tir == UNCLEAR or bool(self.problems) or not self.judged)


def check(rays: RaySet, answers: Answers, *, tir: str = AUTO, budget: str = LOOSEST) -> Findings:
    """Judge every answer. `tir`: how total internal reflection is told, one of TIR, or detected; `budget`: the formula
    of FORMULAS that the answers must be as good as.

    ValueError for an unknown name, a flag that is not there, or answers whose header is that of other rays.
    """
    _accepted("tir", tir, (AUTO, *TIR))
    _accepted("budget", budget, FORMULAS)
    if tir == FLAG and answers.transmitted is None:
        raise ValueError("tir = 'flag': there is no column `transmitted`; accepted: answers with one")
    if (told := answers.header.get("checksum")) not in (None, rays.header["checksum"]):
        raise ValueError(f"the answers are to rays with the checksum {told}; accepted: {rays.header['checksum']}")
    problems, order = _identified(rays, answers)
    kept = np.flatnonzero(order >= 0)
    b = answers.b[order[kept]]
    flag = None if answers.transmitted is None else answers.transmitted[order[kept]]
    judged = judge(b, flag, rays.rays[kept], rays.precision, FORMULAS[budget].budget, tir)
    return Findings(
        precision=rays.precision,
        ulp=2 * rays.roundoff,
        budget=budget,
        tir=judged.tir,
        told=tir != AUTO,
        regimes=tuple(_figures(rays, judged, kept)),
        problems=(*problems, *_blank(judged, rays.ids[kept])),
        explanations=tuple(explain(judged)) if judged.wrong.any() else (),
        header=rays.header,
    )


def _accepted(name: str, value: str, accepted: Any) -> None:
    if value not in accepted:
        raise ValueError(f"{name} = {value!r}: unknown; accepted: {', '.join(accepted)}")


def _identified(rays: RaySet, answers: Answers) -> tuple[list[Problem], np.ndarray]:
    """What is wrong with the ids, and for every ray the row of its first answer, or −1."""
    ids, first, counts = np.unique(answers.ids, return_index=True, return_counts=True)
    found = {
        "missing": np.setdiff1d(rays.ids, ids),
        "duplicate": ids[counts > 1],
        "unknown": np.setdiff1d(ids, rays.ids),
    }
    place = np.searchsorted(ids, rays.ids).clip(max=max(len(ids) - 1, 0))
    order = np.where(ids[place] == rays.ids, first[place], -1) if len(ids) else np.full(len(rays), -1)
    return [_problem(kind, which) for kind, which in found.items() if len(which)], order


def _problem(kind: str, ids: np.ndarray) -> Problem:
    some = ", ".join(map(str, ids[:FIRST]))
    return Problem(kind, len(ids), f"id{'' if len(ids) == 1 else 's'} {some}{', …' if len(ids) > FIRST else ''}")


def _blank(judged: Judged, ids: np.ndarray) -> Iterator[Problem]:
    zero = ~judged.b.any(axis=1)
    for kind, mask in (("non-finite", judged.blank & ~zero), ("zero", judged.blank & zero)):
        if mask.any():
            yield _problem(kind, ids[mask])


# By regime ---------------------------------------------------------------------------------------------------------


def _figures(rays: RaySet, judged: Judged, kept: np.ndarray) -> Iterator[Figures]:
    names = rays.regime[kept]
    for name in rays.header["regimes"]:
        index = np.flatnonzero(names == name)
        if len(index):
            yield _of_regime(name, rays.ids[kept], judged, index)


def _of_regime(name: str, ids: np.ndarray, judged: Judged, index: np.ndarray) -> Figures:
    compared = index[judged.compared[index]]
    angle, norm = (x[compared] if len(compared) else np.full(1, np.nan) for x in (judged.angle, judged.norm))
    worst = index[np.lexsort((judged.share[index], judged.far[index], judged.blank[index]))[-1]]
    replay = {
        "id": int(ids[worst]),
        **judged.rays.hexed(int(worst)),
        "answer": [float(x).hex() for x in judged.b[worst]],
        "exact": [float(x).hex() for x in judged.exact.direction[worst]],
        "transmitted": bool(judged.exact.transmitted[worst]),
    }
    return Figures(
        name,
        len(index),
        len(compared),
        worst=float(angle.max()),
        p99=float(np.quantile(angle, 0.99)),
        mean=float(angle.mean()),
        norm=float(norm.max()),
        misjudged=int(judged.misjudged[index].sum()),
        far=int(judged.far[index].sum()),
        share=float(judged.share[index].max()),
        wrong=int(judged.wrong[index].sum()),
        limit=int(judged.exact_to_rounding[index].sum()),
        replay=replay,
    )
