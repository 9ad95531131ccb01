"""Compare answers to a ray set with certified directions: how large the errors are, in which regimes, and why.

The oracle certifies every ray. An answer is right where its error is within the a-priori bound of a documented formula
for that very ray. Errors are angles, over the rays whose total internal reflection was classified correctly; the error
of the length is reported separately. Where answers say which ratio of indices the program used, directions are compared
with the certified ones for that ratio, and the ratio with that of the ray.

All rays, their answers and certified answers are arrays. Whatever takes more memory than these is done in pieces.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_refract import oracle
from mi_refract.formulas import FORMULAS, Budget
from mi_refract.regimes import Array, Rays

from . import diagnosis, matched_answers, media_rays, tir_signal
from .diagnosis import Explanation
from .header import PRECISIONS, Header, Ids, shown
from .judged_answers import Flags, JudgedAnswers, Table, certified, judge_answers, see
from .matched_answers import MatchedAnswers, Piece
from .ray_set import Answers, RaySet, in_regime
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
    right: int  # answers that are the exact ones of inputs within RIGHT u, and not wrong
    backward_median: float  # of the backward errors, in u
    backward_p99: float
    backward_worst: float
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
    "index": False,
}
# Of RegimeErrors, those that are sums over the rays.
COUNTS = ("tir_misclassified", "tir_beyond_bound", "undecidable", "judged", "wrong", "right", "exact")
SAME_ULPS = 4  # the largest relative difference of a ratio of indices that is none, where the file holds the indices


@dataclass(frozen=True)
class RatioDifference:
    """The largest relative difference of the ratio that the program used to that of the ray, and this ray."""

    largest: float
    id: int
    ray: str  # its media and wavelength; "" without
    accepted: float


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
    ratio: RatioDifference | None = None  # where answers say which ratio was used

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
    def right(self) -> int:
        """Rays whose answer is the exact one of inputs within a few roundings."""
        return self.total("right")

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


# The certified answers to pieces of the set, by the numbers of the pieces.
Certify = Callable[[Iterable[Rays]], Iterable[tuple[int, oracle.Certified]]]
Judge = Callable[..., JudgedAnswers]  # of a Piece, with `exact=` its certified answers where they are known


def certify_here(pieces: Iterable[Rays]) -> Iterator[tuple[int, oracle.Certified]]:
    """In this process, one piece after the other."""
    for number, rays in enumerate(pieces):
        yield number, certified(rays)


def check(
    rays: RaySet,
    answers: Answers,
    *,
    tir: str = AUTO,
    error_bound: str = LOOSEST,
    most_backward: float = np.inf,
    certify: Certify = certify_here,
) -> Findings:
    """Compare every answer with the certified direction.

    `tir`: how the answers signal total internal reflection, one of TIR; detected where it is AUTO. `error_bound`: the
    formula of FORMULAS whose a-priori bound the errors must keep. `most_backward`: the largest backward error, in u, of
    an answer that is not wrong. `certify`: who certifies pieces of the set. ValueError for an unknown name, a
    `most_backward` not above 0, tir = FLAG without the column `transmitted`, or answers whose header is that of other
    rays.
    """
    _check_name("tir", tir, (AUTO, *TIR))
    _check_name("error_bound", error_bound, FORMULAS)
    if not most_backward > 0:
        raise ValueError(f"most_backward = {most_backward}; expected a positive number of roundings")
    if tir == FLAG and answers.transmitted is None:
        raise ValueError("tir = 'flag': there is no column `transmitted`; expected answers with one")
    if (given := answers.header.get("checksum")) not in (None, rays.header["checksum"]):
        expected = f"{rays.header['checksum']}, or other rays with --rays FILE"
        raise ValueError(f"the answers are to rays with the checksum {shown(given)}; expected {expected}")
    matched, mismatches = matched_answers.match(rays, answers)
    exact = dict(certify(piece.used for piece in matched.pieces()))
    signal = tir if tir != AUTO else _signal(matched, exact)
    judge = functools.partial(_judged, rays.precision, FORMULAS[error_bound].budget, signal, most_backward)
    table, losses = _all_judged(matched, exact, judge)
    ulp = float(np.finfo(PRECISIONS[rays.precision]).eps)
    ratio, other_ratios = _ratio_difference(matched, ulp)
    masks = {kind: table[kind] for kind in ("non-finite", "zero", "impossible")} | {"index": other_ratios}
    unfit = {kind: matched.ids[mask] for kind, mask in masks.items()}
    return Findings(
        precision=rays.precision,
        ulp=ulp,
        error_bound=error_bound,
        tir=signal,
        tir_given=tir != AUTO,
        regimes=tuple(_by_regime(matched, table)),
        problems=tuple(_listed(kind, ids) for kind, ids in (mismatches | unfit).items() if len(ids)),
        explanations=tuple(_explanations(matched, table, losses, judge)),
        header=rays.header,
        ratio=ratio,
    )


def _check_name(name: str, value: str, expected: Collection[str]) -> None:
    if value not in expected:
        raise ValueError(f"{name} = {value!r}: unknown; expected {', '.join(expected)}")


def _signal(matched: MatchedAnswers, exact: Mapping[int, oracle.Certified]) -> str:
    """How the answers signal total internal reflection."""
    if matched.answers.transmitted is not None:
        return FLAG
    precision = matched.rays.precision
    return tir_signal.detect(see(x.b, x.used, precision, exact[number]) for number, x in enumerate(matched.pieces()))


def _judged(
    precision: str, budget: Budget, tir: str, most_backward: float, piece: Piece, exact: oracle.Certified | None = None
) -> JudgedAnswers:
    return judge_answers(
        *(piece.b, piece.transmitted, piece.used, precision, budget, tir), exact=exact, most_backward=most_backward
    )


def _all_judged(
    matched: MatchedAnswers, exact: dict[int, oracle.Certified], judge: Judge
) -> tuple[Table, Mapping[str, int]]:
    """The table of all answers, and how many of them `diagnosis.losses` account for. Takes pieces out of `exact`."""
    tables, losses = [judge(matched.take(slice(0))).table], Counter[str]()
    for number, piece in enumerate(matched.pieces()):
        judged = judge(piece, exact.pop(number))
        tables.append(judged.table)
        losses.update(diagnosis.losses(judged.verdict))
    return np.concatenate(tables), losses


def _ratio_difference(matched: MatchedAnswers, ulp: float) -> tuple[RatioDifference | None, Flags]:
    """The largest, and (N,) where it is more than that of one glass written in two ways; nothing if none is said."""
    if matched.answers.n_ratio is None or not len(matched.rows):
        return None, np.zeros(len(matched.rows), bool)
    header, differences = matched.rays.header, matched.ratio_differences()
    same = media_rays.SAME if media_rays.has_media(header) else SAME_ULPS * ulp
    row = int(np.argmax(differences))
    id_ = int(matched.ids[row])
    return RatioDifference(float(differences[row]), id_, media_rays.described(header, id_), same), differences > same


def _listed(kind: str, ids: Ids) -> Problem:
    first, more = ", ".join(map(str, ids[:LISTED_IDS])), ", …" if len(ids) > LISTED_IDS else ""
    return Problem(kind, len(ids), f"id{'' if len(ids) == 1 else 's'} {first}{more}")


def _explanations(
    matched: MatchedAnswers, table: Table, losses: Mapping[str, int], judge: Judge
) -> Iterable[Explanation]:
    if not table["beyond_bound"].any():
        return []
    evidence = diagnosis.Evidence(table, losses)
    return diagnosis.explain(judge(matched.take(evidence.sample)), evidence, matched.take(evidence.printed).b)


# By regime ---------------------------------------------------------------------------------------------------------


def _by_regime(matched: MatchedAnswers, table: Table) -> Iterator[RegimeErrors]:
    for name in matched.rays.header["regimes"]:
        rows = np.flatnonzero(in_regime(matched.rays.header, name, matched.ids))
        if len(rows):
            found = table[rows]
            worst = np.lexsort([found[key] for key in ("share", "impossible", "tir_beyond_bound", "blank")])[-1]
            yield _regime_errors(name, found, _replay(matched.take(rows[worst : worst + 1])))


def _regime_errors(name: str, found: Table, replay: dict[str, Any]) -> RegimeErrors:
    compared = found[found["compared"]]
    angles, backward = compared["angle"], found["backward"]
    return RegimeErrors(
        name,
        rays=len(found),
        compared=len(compared),
        worst=_quantile(angles, 1),
        p99=_quantile(angles, 0.99),
        mean=float(angles.mean()) if len(angles) else np.nan,
        length_error=float(compared["drift"].max()) if len(angles) else np.nan,
        error_over_bound=float(found["share"].max()),
        backward_median=_quantile(backward, 0.5),
        backward_p99=_quantile(backward, 0.99),
        backward_worst=_quantile(backward, 1),
        replay=replay,
        **{count: int(found[count].sum()) for count in COUNTS},
    )


def _quantile(errors: Array, share: float) -> float:
    """NaN where there is none. Between a finite and an infinite error: the infinite one."""
    if not len(errors):
        return np.nan
    with np.errstate(invalid="ignore"):
        found = float(np.quantile(errors, share))
    return float(np.quantile(errors, share, method="higher")) if np.isnan(found) else found


def _replay(one: Piece) -> dict[str, Any]:
    """A ray with its answer in hexadecimal floats."""
    exact = certified(one.used)
    return {
        "id": int(one.ids[0]),
        **one.used.hexed(0),
        "answer": [float(x).hex() for x in one.b[0]],
        "exact": [float(x).hex() for x in exact.direction[0]],
        "transmitted": bool(exact.transmitted[0]),
    }
