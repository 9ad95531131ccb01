"""Compare answers to a ray set with certified directions: how large the errors are, in which regimes, and why.

The oracle certifies every ray. An answer is wrong if its error exceeds the a-priori bound of a documented formula for
that ray, and right if its backward errors are small too. Errors are angles, over the rays whose total internal
reflection was classified correctly; the error of the length is reported separately. If answers have a column `n_ratio`,
the program's ratio of indices, directions are compared with the certified ones for that ratio, and the ratio is
compared with that of the ray.

All rays, their answers and certified answers are arrays. Steps that take more memory than these run on pieces of them.
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
from .judged_answers import JudgedAnswers, Table, certified, judge_answers, pair_with_exact
from .ray_set import Answers, RaySet, in_regime
from .tir_signal import LOOSEST, UNCLEAR

PIECE = 2**18  # rays that are certified or judged at once, which takes 300 MB
LISTED_IDS = 5  # of a problem
SAME_ULPS = 4  # without media, ratios of indices count as equal up to this relative difference, in ulps


# Findings ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RegimeErrors:
    """Errors of the answers to one regime. Angles to the certified direction in radians; NaN if none was compared."""

    regime: str
    rays: int  # answered
    compared: int  # rays whose direction was compared: TIR is classified correctly, and the answer is a direction
    worst: float
    p99: float
    mean: float
    length_error: float  # the largest | |b| − 1 |, or | |b|/|a| − 1 | if that is less
    tir_misclassified: int  # totally reflected rays classified as transmitted, or the reverse
    tir_beyond_bound: int  # misclassified rays farther from the critical angle than the error bound allows
    error_over_bound: float  # the largest ratio of an error to the bound of its ray
    undecidable: int  # rays whose bound is above 0.1 rad: a direction within it proves nothing
    judged: int  # compared rays that are not undecidable
    wrong: int  # rays whose angle, length or TIR is beyond its bound, or whose direction is missing or impossible
    exact: int  # answers equal to the certified ones, up to rounding
    right: int  # answers that are not wrong and, lengths included, are exact for inputs within RIGHT u
    backward_median: float  # of the backward errors of directions and decisions, in u
    backward_p99: float
    backward_worst: float
    backward_length: float  # the largest backward error of a length, in u
    replay: dict[str, Any]  # the ray with the largest error over its bound, in hexadecimal floats


@dataclass(frozen=True)
class Problem:
    """A defect of the set of answers that occurs `count` times; `text` lists the first ids."""

    kind: str  # one of UNFIT, "non-finite", "zero", "impossible", "index"
    count: int
    text: str


UNFIT = ("missing", "duplicate", "unknown")  # problems of answers that do not match the rays
# The fields of RegimeErrors that are counts of rays.
COUNTS = ("tir_misclassified", "tir_beyond_bound", "undecidable", "judged", "wrong", "right", "exact")


@dataclass(frozen=True)
class RatioDifference:
    """The largest relative difference between the ratio that the program used and that of the ray, and this ray."""

    largest: float
    id: int
    ray: str  # its media and wavelength; "" without media
    tolerance: float  # ratios count as equal up to this relative difference


@dataclass(frozen=True)
class Findings:
    """The result of `check`. Without answers, `regimes` is empty."""

    precision: str
    ulp: float  # 2⁻²³ or 2⁻⁵²
    error_bound: str  # the formula whose bound was applied
    tir: str  # the signal of total internal reflection; NONE if no ray has it, UNCLEAR if it is unknown or inconsistent
    tir_given: bool  # whether the caller chose the signal
    regimes: tuple[RegimeErrors, ...]
    problems: tuple[Problem, ...]
    explanations: tuple[Explanation, ...]  # of wrong answers
    header: Header  # of the rays
    ratio: RatioDifference | None = None  # if the answers have a column `n_ratio`
    most_backward: float = np.inf  # in u: an answer with a larger backward error is wrong
    digest: str = ""  # of the answers

    def total(self, name: str) -> int:
        """The sum of a count of `RegimeErrors` over the regimes."""
        return sum(getattr(regime, name) for regime in self.regimes)

    def problem_count(self, *kinds: str) -> int:
        """The number of answers or rays with a problem of these kinds."""
        return sum(problem.count for problem in self.problems if problem.kind in kinds)

    @property
    def answered(self) -> int:
        """The number of rays that were answered."""
        return self.total("rays")

    @property
    def wrong(self) -> int:
        """The number of wrong answers."""
        return self.total("wrong")

    @property
    def right(self) -> int:
        """The number of right answers: exact for inputs within a few roundings."""
        return self.total("right")

    @property
    def diagnosis(self) -> Explanation | None:
        """The mistake that explains the answers, if exactly one does."""
        certain = [explanation for explanation in self.explanations if explanation.explains]
        return certain[0] if len(certain) == 1 else None

    @property
    def exit_code(self) -> int:
        """0: all answers are within the error bound. 1: some are wrong. 2: they do not match the rays.

        Also 1 if no direction was judged: answers to undecidable rays alone prove nothing.
        """
        if not self.answered or self.problem_count(*UNFIT):
            return 2
        return int(self.wrong > 0 or self.tir == UNCLEAR or bool(self.problems) or not self.total("judged"))


# The check ---------------------------------------------------------------------------------------------------------


def check_options(tir: str, error_bound: str, most_backward: float) -> None:
    """ValueError, one line, for an unknown name, or a limit of backward errors that is not positive."""
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
    """Compare every answer with the certified direction; of several answers to a ray, only the first counts.

    `tir`: the signal of total internal reflection in the answers, one of TIR, or AUTO to detect it. `error_bound`: the
    formula of FORMULAS whose a-priori bound the errors must keep. `most_backward`: in u; an answer is wrong if the
    backward error of its direction or length is larger. `piece`: number of rays certified or judged at once; the
    findings do not depend on it. ValueError as for `check_options`, for tir = FLAG without the column `transmitted`,
    for answers whose header belongs to other rays, or for rays of f64 where numpy's `longdouble` has no more digits.
    """
    check_options(tir, error_bound, most_backward)
    if tir == FLAG and answers.transmitted is None:
        raise ValueError("TIR signal 'flag': expected answers with a column `transmitted`")
    header, precision = rays.header, rays.precision
    if precision == "f64" and (bits := np.finfo(np.longdouble).nmant) < 63:
        raise ValueError(f"rays of f64: numpy.longdouble has {bits + 1} bits on this system; expected 64 or more")
    checksum = answers.header.get("checksum")
    if checksum not in (None, header["checksum"]):
        text = f"the answers belong to rays with the checksum {shown(checksum)}"
        raise ValueError(f"{text}; expected {header['checksum']}")
    # Select the rays that have an answer, and the first answer to each, in the order of the rays.
    ids, first, counts = np.unique(answers.ids, return_index=True, return_counts=True)
    position = np.searchsorted(ids, rays.ids).clip(max=max(len(ids) - 1, 0))
    answered = ids[position] == rays.ids if len(ids) else np.zeros(len(rays), bool)
    unknown = np.setdiff1d(ids, rays.ids, assume_unique=True)
    problem_ids = {"missing": np.sort(rays.ids[~answered]), "duplicate": ids[counts > 1], "unknown": unknown}
    rays, answers = rays[answered], answers[first[position[answered]]]

    def judge(rows: NDArray[np.intp] | slice, exact: oracle.Certified | None = None) -> JudgedAnswers:
        selected, budget = answers[rows], FORMULAS[error_bound].budget
        columns = selected.b, selected.transmitted, rays_as_used(rays[rows], selected), precision, budget, signal
        return judge_answers(*columns, exact=exact, most_backward=most_backward)

    pieces = [slice(start, start + piece) for start in range(0, len(rays), piece)]
    exact = [certified(rays_as_used(rays[rows], answers[rows])) for rows in pieces]
    if tir != AUTO:
        signal = tir
    elif answers.transmitted is not None:
        signal = FLAG
    else:
        compared = (
            pair_with_exact(answers[rows].b, rays_as_used(rays[rows], answers[rows]), precision, exact_piece)
            for rows, exact_piece in zip(pieces, exact, strict=True)
        )
        signal = tir_signal.detect(compared)
    tables = [judge(slice(0)).table] + [judge(rows, exact.pop(0)).table for rows in pieces]
    table = np.concatenate(tables)
    explanations: list[Explanation] = []
    if table["wrong"].any():
        printed = answers.b[diagnosis.evenly(table["compared"])]
        explanations = diagnosis.explain(judge(diagnosis.sample(table)), table, printed)
    ulp = float(np.finfo(PRECISIONS[precision]).eps)
    ratio, different_ratio = None, np.zeros(len(rays), bool)
    if answers.n_ratio is not None and len(rays):
        k = rays.rays.k.astype(np.float64)
        differences = np.abs(answers.n_ratio - k) / k
        row = int(np.argmax(differences))
        id_, tolerance = int(rays.ids[row]), SAME if has_media(header) else SAME_ULPS * ulp
        ratio = RatioDifference(float(differences[row]), id_, described(header, id_), tolerance)
        different_ratio = ~(differences <= tolerance)
    masks = {kind: table[kind] for kind in ("non-finite", "zero", "impossible")} | {"index": different_ratio}
    problem_ids |= {kind: rays.ids[mask] for kind, mask in masks.items()}
    problems = []
    for kind, ids in problem_ids.items():
        if len(ids):
            listed, more = ", ".join(map(str, ids[:LISTED_IDS])), ", …" if len(ids) > LISTED_IDS else ""
            problems.append(Problem(kind, len(ids), f"id{'' if len(ids) == 1 else 's'} {listed}{more}"))
    return Findings(
        precision=precision,
        ulp=ulp,
        error_bound=error_bound,
        tir=signal,
        tir_given=tir != AUTO,
        regimes=tuple(_regime_errors(rays, answers, table)),
        problems=tuple(problems),
        explanations=tuple(explanations),
        header=header,
        ratio=ratio,
        most_backward=most_backward,
        digest=answers.digest,
    )


def rays_as_used(rays: RaySet, answers: Answers) -> Rays:
    """The rays with the ratio of indices that the program used, if it reports it."""
    if answers.n_ratio is None:
        return rays.rays
    return Rays(rays.rays.a.astype(np.float64), rays.rays.n.astype(np.float64), answers.n_ratio)


def _regime_errors(rays: RaySet, answers: Answers, table: Table) -> Iterator[RegimeErrors]:
    for name in rays.header["regimes"]:
        rows = np.flatnonzero(in_regime(rays.header, name, rays.ids))
        if not len(rows):
            continue
        judged = table[rows]
        compared = judged[judged["compared"]]
        angles, backward = compared["angle"], judged["backward"]
        worst = rows[np.lexsort([judged[key] for key in ("share", "impossible", "tir_beyond_bound", "blank")])[-1:]]
        ray = rays_as_used(rays[worst], answers[worst])
        exact = certified(ray)
        yield RegimeErrors(
            name,
            rays=len(judged),
            compared=len(compared),
            worst=_quantile(angles, 1),
            p99=_quantile(angles, 0.99),
            mean=float(angles.mean()) if len(angles) else np.nan,
            length_error=float(compared["drift"].max()) if len(angles) else np.nan,
            error_over_bound=float(judged["share"].max()),
            backward_median=_quantile(backward, 0.5),
            backward_p99=_quantile(backward, 0.99),
            backward_worst=_quantile(backward, 1),
            backward_length=float(judged["backward_length"].max()),
            replay={
                "id": int(rays.ids[worst[0]]),
                **ray.hexed(0),
                "answer": [float(x).hex() for x in answers.b[worst[0]]],
                "exact": [float(x).hex() for x in exact.direction[0]],
                "transmitted": bool(exact.transmitted[0]),
            },
            **{count: int(judged[count].sum()) for count in COUNTS},
        )


def _quantile(errors: Array, share: float) -> float:
    """The quantile; NaN without errors. Between a finite and an infinite error, the infinite one."""
    if not len(errors):
        return np.nan
    with np.errstate(invalid="ignore"):
        value = float(np.quantile(errors, share))
    return float(np.quantile(errors, share, method="higher")) if np.isnan(value) else value
