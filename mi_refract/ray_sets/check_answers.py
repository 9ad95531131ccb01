"""Compare answers to a ray set with certified directions: how large the errors are, in which regimes, and why.

The oracle certifies every ray. An answer is right where its error is within the a-priori bound of a documented formula
for that very ray. Errors are angles, over the rays whose total internal reflection was classified correctly; the error
of the length is reported separately.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_refract.formulas import FORMULAS

from .diagnosis import Explanation, explain
from .header import Header, shown
from .judged_answers import JudgedAnswers, judge_answers
from .ray_set import Answers, RaySet
from .tir_signal import AUTO, FLAG, LOOSEST, TIR, UNCLEAR

LISTED_IDS = 5


@dataclass(frozen=True)
class RegimeErrors:
    """Errors of the answers to one regime. Angles to the certified direction, in radians; NaN without any compared."""

    regime: str
    rays: int  # answered
    compared: int  # rays whose direction was compared: TIR classified correctly, and the answer is a direction
    worst: float
    p99: float
    mean: float
    length_error: float  # the largest | |b| − 1 |, or | |b|/|a| − 1 | where that is less
    tir_misclassified: int  # called transmitted where all is reflected, or the reverse
    tir_beyond_bound: int  # those of them that are farther from the critical angle than the error bound excuses
    error_over_bound: float  # the largest ratio of an error to the bound of its ray
    undecidable: int  # rays whose bound is above 0.1 rad: a direction within it shows nothing
    judged: int  # rays compared that are not so
    wrong: int  # rays beyond their bound: angle, length or TIR; without a direction, or with an impossible one
    exact: int  # answers that are the certified ones, rounded
    replay: dict[str, Any]  # the ray with the largest ratio, in hexadecimal floats


@dataclass(frozen=True)
class Problem:
    """A defect of the set of answers, seen `count` times; `text` lists the first ids."""

    kind: str  # a key of PROBLEMS
    count: int
    text: str


# Each kind of problem, and whether the answers are then not those to the rays.
PROBLEMS = {
    "missing": True,
    "duplicate": True,
    "unknown": True,
    "non-finite": False,
    "zero": False,
    "impossible": False,
}


@dataclass(frozen=True)
class Findings:
    """The result of `check`. Without any answer there are no regimes."""

    precision: str
    ulp: float  # 2⁻²³ or 2⁻⁵²
    error_bound: str  # the formula whose bound was applied
    tir: str  # how total internal reflection is signalled; NONE where no ray has it, UNCLEAR where in no known way
    tir_given: bool  # by the caller
    regimes: tuple[RegimeErrors, ...]
    problems: tuple[Problem, ...]
    explanations: tuple[Explanation, ...]  # of wrong answers
    header: Header  # of the rays

    def total(self, name: str) -> int:
        """The sum of a count of `RegimeErrors` over the regimes."""
        return sum(getattr(each, name) for each in self.regimes)

    @property
    def answered(self) -> int:
        """Rays that were answered."""
        return self.total("rays")

    @property
    def wrong(self) -> int:
        """Rays whose answer is wrong."""
        return self.total("wrong")

    @property
    def farthest(self) -> RegimeErrors:
        """The regime with the largest angle. ValueError where nothing was answered."""
        return max(self.regimes, key=lambda each: (each.compared > 0, each.worst))

    @property
    def diagnosis(self) -> Explanation | None:
        """The mistake that explains the answers, where exactly one does."""
        found = [each for each in self.explanations if each.explains]
        return found[0] if len(found) == 1 else None

    @property
    def exit_code(self) -> int:
        """0: all answers are within the bound. 1: some are wrong. 2: missing, duplicate, or answers to other rays.

        1 also where no direction was judged: a program that answers nothing but rays in doubt, and those by giving
        up, has shown nothing.
        """
        if not self.answered or any(PROBLEMS[problem.kind] for problem in self.problems):
            return 2
        return int(self.wrong > 0 or self.tir == UNCLEAR or bool(self.problems) or not self.total("judged"))


def check(rays: RaySet, answers: Answers, *, tir: str = AUTO, error_bound: str = LOOSEST) -> Findings:
    """Compare every answer with the certified direction.

    `tir`: how the answers signal total internal reflection, one of TIR; detected where it is AUTO. `error_bound`: the
    formula of FORMULAS whose a-priori bound the errors must keep. ValueError for an unknown name, for tir = FLAG
    without the column `transmitted`, or for answers whose header is that of other rays.
    """
    _check_name("tir", tir, (AUTO, *TIR))
    _check_name("error_bound", error_bound, FORMULAS)
    if tir == FLAG and answers.transmitted is None:
        raise ValueError("tir = 'flag': there is no column `transmitted`; accepted: answers with one")
    if (given := answers.header.get("checksum")) not in (None, rays.header["checksum"]):
        accepted = f"{rays.header['checksum']}, or other rays with --rays FILE"
        raise ValueError(f"the answers are to rays with the checksum {shown(given)}; accepted: {accepted}")
    problems, order = _match_ids(rays, answers)
    kept = np.flatnonzero(order >= 0)
    b = answers.b[order[kept]]
    flag = None if answers.transmitted is None else answers.transmitted[order[kept]]
    judged = judge_answers(b, flag, rays.rays[kept], rays.precision, FORMULAS[error_bound].budget, tir)
    return Findings(
        precision=rays.precision,
        ulp=2 * rays.roundoff,
        error_bound=error_bound,
        tir=judged.tir,
        tir_given=tir != AUTO,
        regimes=tuple(_by_regime(rays, judged, kept)),
        problems=(*problems, *_not_directions(judged, rays.ids[kept])),
        explanations=tuple(explain(judged)) if judged.verdict.wrong.any() else (),
        header=rays.header,
    )


def _check_name(name: str, value: str, accepted: Collection[str]) -> None:
    if value not in accepted:
        raise ValueError(f"{name} = {value!r}: unknown; accepted: {', '.join(accepted)}")


def _match_ids(rays: RaySet, answers: Answers) -> tuple[list[Problem], np.ndarray]:
    """Problems of the ids; and (N,) for each ray the row of its first answer, or −1."""
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
    some = ", ".join(map(str, ids[:LISTED_IDS]))
    plural, more = "" if len(ids) == 1 else "s", ", …" if len(ids) > LISTED_IDS else ""
    return Problem(kind, len(ids), f"id{plural} {some}{more}")


def _not_directions(judged: JudgedAnswers, ids: np.ndarray) -> Iterator[Problem]:
    """Answers that are neither a direction nor the signal of total internal reflection, or an impossible one."""
    zero = ~judged.b.any(axis=1)
    for kind, mask in (("non-finite", judged.verdict.blank & ~zero), ("zero", judged.verdict.blank & zero)):
        if mask.any():
            yield _problem(kind, ids[mask])
    if judged.impossible.any():
        yield _problem("impossible", ids[judged.impossible])


# By regime ---------------------------------------------------------------------------------------------------------


def _by_regime(rays: RaySet, judged: JudgedAnswers, kept: np.ndarray) -> Iterator[RegimeErrors]:
    names = rays.regime[kept]
    for name in rays.header["regimes"]:
        index = np.flatnonzero(names == name)
        if len(index):
            yield _regime_errors(name, rays.ids[kept], judged, index)


def _regime_errors(name: str, ids: np.ndarray, judged: JudgedAnswers, index: np.ndarray) -> RegimeErrors:
    verdict = judged.verdict
    compared = index[verdict.compared[index]]
    angle, length = (x[compared] if len(compared) else np.full(1, np.nan) for x in (verdict.angle, verdict.drift))
    worst = index[
        np.lexsort((verdict.share[index], judged.impossible[index], verdict.far[index], verdict.blank[index]))[-1]
    ]
    return RegimeErrors(
        name,
        len(index),
        len(compared),
        worst=float(angle.max()),
        p99=float(np.quantile(angle, 0.99)),
        mean=float(angle.mean()),
        length_error=float(length.max()),
        tir_misclassified=int(verdict.misjudged[index].sum()),
        tir_beyond_bound=int(verdict.far[index].sum()),
        error_over_bound=float(verdict.share[index].max()),
        undecidable=int(judged.undecidable[index].sum()),
        judged=int((~judged.undecidable)[compared].sum()),
        wrong=int(judged.wrong[index].sum()),
        exact=int(judged.rounded_exact[index].sum()),
        replay=_replay(judged, int(worst), int(ids[worst])),
    )


def _replay(judged: JudgedAnswers, row: int, id_: int) -> dict[str, Any]:
    """A ray and its answer in hexadecimal floats."""
    bounds = judged.verdict.bounds
    return {
        "id": id_,
        **bounds.rays.hexed(row),
        "answer": [float(x).hex() for x in judged.b[row]],
        "exact": [float(x).hex() for x in bounds.exact.direction[row]],
        "transmitted": bool(bounds.exact.transmitted[row]),
    }
