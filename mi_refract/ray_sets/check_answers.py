"""Compare answers to a ray set with certified directions: how large the errors are, in which regimes, and why.

The oracle certifies every ray. An answer is wrong where its error is beyond the a-priori bound of a documented formula
for that very ray, and right where its backward errors are small, too. Errors are angles, over the rays whose total
internal reflection was classified correctly; the error of the length is reported separately. Where answers have a
column `n_ratio`, the program's ratio of indices, directions are compared with the certified ones for that ratio, and
the ratio with that of the ray.

All rays, their answers and certified answers are arrays. Whatever takes more memory than these is done in pieces.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract import oracle
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import Array, Rays

from . import diagnosis, tir_signal
from .diagnosis import Explanation
from .header import AUTO, FLAG, PRECISIONS, SAME, TIR, Header, described, has_media, shown
from .judged_answers import JudgedAnswers, Table, certified, judge_answers, see
from .ray_set import Answers, RaySet, in_regime
from .tir_signal import LOOSEST, UNCLEAR

PIECE = 2**18  # rays that are certified or judged at once, which takes 300 MB
LISTED_IDS = 5
SAME_ULPS = 4  # the largest relative difference between equal ratios of indices, where the file holds the indices


# Findings ----------------------------------------------------------------------------------------------------------


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
    judged: int  # rays compared that are not undecidable
    wrong: int  # rays beyond their bound: angle, length or TIR; without a direction, or with an impossible one
    exact: int  # answers that are the certified ones, rounded
    right: int  # answers that are the exact ones of inputs within RIGHT u, their lengths too, and not wrong
    backward_median: float  # of the backward errors of directions and decisions, in u
    backward_p99: float
    backward_worst: float
    backward_length: float  # the largest backward error of a length, in u
    replay: dict[str, Any]  # the ray with the largest ratio, in hexadecimal floats


@dataclass(frozen=True)
class Problem:
    """A defect of the set of answers, seen `count` times; `text` lists the first ids."""

    kind: str  # one of UNFIT, "non-finite", "zero", "impossible", "index"
    count: int
    text: str


UNFIT = ("missing", "duplicate", "unknown")  # problems of answers that are not those to the rays
# Of RegimeErrors, those that are sums over the rays.
COUNTS = ("tir_misclassified", "tir_beyond_bound", "undecidable", "judged", "wrong", "right", "exact")


@dataclass(frozen=True)
class RatioDifference:
    """The largest relative difference of the ratio that the program used to that of the ray, and this ray."""

    largest: float
    id: int
    ray: str  # its media and wavelength; "" without
    tolerance: float  # up to which two ratios count as equal


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
    most_backward: float = np.inf  # in u: the largest backward error of an answer that is not wrong
    digest: str = ""  # of the answers

    def total(self, name: str) -> int:
        """The sum of a count of `RegimeErrors` over the regimes."""
        return sum(getattr(regime, name) for regime in self.regimes)

    def problem_count(self, *kinds: str) -> int:
        """How many problems of these kinds there are."""
        return sum(problem.count for problem in self.problems if problem.kind in kinds)

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
    def diagnosis(self) -> Explanation | None:
        """The mistake that explains the answers, where exactly one does."""
        certain = [explanation for explanation in self.explanations if explanation.explains]
        return certain[0] if len(certain) == 1 else None

    @property
    def exit_code(self) -> int:
        """0: all answers are within the error bound, right or not. 1: some are wrong. 2: they do not match the rays.

        1 also where no direction was judged: a program that answers only undecidable rays has shown nothing.
        """
        if not self.answered or self.problem_count(*UNFIT):
            return 2
        return int(self.wrong > 0 or self.tir == UNCLEAR or bool(self.problems) or not self.total("judged"))


# The check ---------------------------------------------------------------------------------------------------------


def check_options(tir: str, error_bound: str, most_backward: float) -> None:
    """ValueError, one line, for an unknown name, or a limit of backward errors that is not above 0."""
    if tir not in (AUTO, *TIR):
        raise ValueError(f"TIR signal {tir!r}: unknown; expected {', '.join((AUTO, *TIR))}")
    if error_bound not in FORMULAS:
        raise ValueError(f"error bound {error_bound!r}: unknown; expected {', '.join(FORMULAS)}")
    if not most_backward > 0:
        raise ValueError(f"backward error {most_backward:g}; expected a positive number of roundings")


def check(
    rays: RaySet,
    answers: Answers,
    *,
    tir: str = AUTO,
    error_bound: str = LOOSEST,
    most_backward: float = np.inf,
    piece: int = PIECE,
) -> Findings:
    """Compare every answer with the certified direction; of several answers to a ray, the first.

    `tir`: how the answers signal total internal reflection, one of TIR; detected where it is AUTO. `error_bound`: the
    formula of FORMULAS whose a-priori bound the errors must keep. `most_backward`: the largest backward error, in u, of
    the direction and of the length of an answer that is not wrong. `piece`: rays certified or judged at once; the
    findings do not depend on it. ValueError as of `check_options`, for tir = FLAG without the column `transmitted`, or
    answers whose header is that of other rays.
    """
    check_options(tir, error_bound, most_backward)
    if tir == FLAG and answers.transmitted is None:
        raise ValueError("TIR signal 'flag': expected answers with a column `transmitted`")
    header, precision = rays.header, rays.precision
    if (checksum := answers.header.get("checksum")) not in (None, header["checksum"]):
        raise ValueError(f"the answers are to rays with the checksum {shown(checksum)}; expected {header['checksum']}")
    # The rays that have an answer, and the first answer to each, in order.
    ids, first, counts = np.unique(answers.ids, return_index=True, return_counts=True)
    place = np.searchsorted(ids, rays.ids).clip(max=max(len(ids) - 1, 0))
    answered = ids[place] == rays.ids if len(ids) else np.zeros(len(rays), bool)
    unknown = np.setdiff1d(ids, rays.ids, assume_unique=True)
    problems = {"missing": np.sort(rays.ids[~answered]), "duplicate": ids[counts > 1], "unknown": unknown}
    rays, answers = rays[answered], answers[first[place[answered]]]

    def judge(rows: NDArray[np.intp] | slice, exact: oracle.Certified | None = None) -> JudgedAnswers:
        some, budget = answers[rows], FORMULAS[error_bound].budget
        columns = some.b, some.transmitted, used(rays[rows], some), precision, budget, signal
        return judge_answers(*columns, exact=exact, most_backward=most_backward)

    pieces = [slice(start, start + piece) for start in range(0, len(rays), piece)]
    exact = [certified(used(rays[rows], answers[rows])) for rows in pieces]
    if tir != AUTO:
        signal = tir
    elif answers.transmitted is not None:
        signal = FLAG
    else:
        parts = zip(pieces, exact, strict=True)
        seen = (see(answers[x].b, used(rays[x], answers[x]), precision, certain) for x, certain in parts)
        signal = tir_signal.detect(seen)
    tables = [judge(slice(0)).table] + [judge(rows, exact.pop(0)).table for rows in pieces]
    table = np.concatenate(tables)
    explanations: list[Explanation] = []
    if table["wrong"].any():
        printed = answers.b[diagnosis.evenly(table["compared"])]
        explanations = diagnosis.explain(judge(diagnosis.sample(table)), table, printed)
    ulp = float(np.finfo(PRECISIONS[precision]).eps)
    ratio, other_ratio = None, np.zeros(len(rays), bool)
    if answers.n_ratio is not None and len(rays):
        k = rays.rays.k.astype(np.float64)
        differences = np.abs(answers.n_ratio - k) / k
        row = int(np.argmax(differences))
        id_, tolerance = int(rays.ids[row]), SAME if has_media(header) else SAME_ULPS * ulp
        ratio = RatioDifference(float(differences[row]), id_, described(header, id_), tolerance)
        other_ratio = differences > tolerance
    masks = {kind: table[kind] for kind in ("non-finite", "zero", "impossible")} | {"index": other_ratio}
    problems |= {kind: rays.ids[mask] for kind, mask in masks.items()}
    defects = []
    for kind, ids in problems.items():
        if len(ids):
            listed, more = ", ".join(map(str, ids[:LISTED_IDS])), ", …" if len(ids) > LISTED_IDS else ""
            defects.append(Problem(kind, len(ids), f"id{'' if len(ids) == 1 else 's'} {listed}{more}"))
    return Findings(
        precision=precision,
        ulp=ulp,
        error_bound=error_bound,
        tir=signal,
        tir_given=tir != AUTO,
        regimes=tuple(_by_regime(rays, answers, table)),
        problems=tuple(defects),
        explanations=tuple(explanations),
        header=header,
        ratio=ratio,
        most_backward=most_backward,
        digest=answers.digest,
    )


def used(rays: RaySet, answers: Answers) -> Rays:
    """The rays as the program took them: with the ratio of the indices that it used, where it reports it."""
    if answers.n_ratio is None:
        return rays.rays
    return Rays(rays.rays.a.astype(np.float64), rays.rays.n.astype(np.float64), answers.n_ratio)


def _by_regime(rays: RaySet, answers: Answers, table: Table) -> Iterator[RegimeErrors]:
    for name in rays.header["regimes"]:
        rows = np.flatnonzero(in_regime(rays.header, name, rays.ids))
        if not len(rows):
            continue
        part = table[rows]
        compared = part[part["compared"]]
        angles, backward = compared["angle"], part["backward"]
        worst = rows[np.lexsort([part[key] for key in ("share", "impossible", "tir_beyond_bound", "blank")])[-1:]]
        ray = used(rays[worst], answers[worst])
        exact = certified(ray)
        yield RegimeErrors(
            name,
            rays=len(part),
            compared=len(compared),
            worst=_quantile(angles, 1),
            p99=_quantile(angles, 0.99),
            mean=float(angles.mean()) if len(angles) else np.nan,
            length_error=float(compared["drift"].max()) if len(angles) else np.nan,
            error_over_bound=float(part["share"].max()),
            backward_median=_quantile(backward, 0.5),
            backward_p99=_quantile(backward, 0.99),
            backward_worst=_quantile(backward, 1),
            backward_length=float(part["backward_length"].max()),
            replay={
                "id": int(rays.ids[worst[0]]),
                **ray.hexed(0),
                "answer": [float(x).hex() for x in answers.b[worst[0]]],
                "exact": [float(x).hex() for x in exact.direction[0]],
                "transmitted": bool(exact.transmitted[0]),
            },
            **{count: int(part[count].sum()) for count in COUNTS},
        )


def _quantile(errors: Array, share: float) -> float:
    """NaN where there is none. Between a finite and an infinite error: the infinite one."""
    if not len(errors):
        return np.nan
    with np.errstate(invalid="ignore"):
        value = float(np.quantile(errors, share))
    return float(np.quantile(errors, share, method="higher")) if np.isnan(value) else value
