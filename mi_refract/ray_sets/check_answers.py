"""Compare answers to a ray set with certified directions: how large the errors are, in which regimes, and why.

The oracle certifies every ray. An answer is right where its error is within the a-priori bound of a documented formula
for that very ray. Errors are angles, over the rays whose total internal reflection was classified correctly; the error
of the length is reported separately. Where answers say which ratio of indices the program used, directions are compared
with the certified ones for that ratio, and the ratio with that of the ray.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mi_refract.accuracy import lengths
from mi_refract.formulas import FORMULAS

from . import diagnosis, judged_parts, media_rays, tir_signal
from .diagnosis import Explanation
from .evidence import AllEvidence
from .header import PRECISIONS, Header, shown
from .judged_answers import judge_answers
from .judged_parts import JudgedPart, Piece, Question
from .kept_errors import KeptErrors, SomeErrors
from .pieces import ArrayPieces, Pieces, StoredPieces
from .ray_set import Answers, RaySet
from .stored_answers import LISTED_IDS, StoredAnswers
from .stored_rays import StoredRays
from .tir_signal import AUTO, FLAG, LOOSEST, NONE, TIR, UNCLEAR

SEEN, GUESSED = 2**16, 2**9  # rays that are looked at, and judged, to guess the signal of total internal reflection


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


Judge = Callable[[Iterable[tuple[Piece, Question]]], Iterator[tuple[int, JudgedPart]]]


def check(
    rays: RaySet | StoredRays,
    answers: Answers | StoredAnswers,
    *,
    tir: str = AUTO,
    error_bound: str = LOOSEST,
    most_backward: float = np.inf,
    judge: Judge = judged_parts.here,
) -> Findings:
    """Compare every answer with the certified direction.

    `tir`: how the answers signal total internal reflection, one of TIR; detected where it is AUTO. `error_bound`: the
    formula of FORMULAS whose a-priori bound the errors must keep. `most_backward`: the largest backward error, in u, of
    an answer that is not wrong. `judge`: who judges pieces of the set; the findings do not depend on it, nor on whether
    rays and answers are arrays or stored: both are the same. ValueError for an unknown name, a `most_backward` not
    above 0, tir = FLAG without the column `transmitted`, or answers whose header is that of other rays.
    """
    _check_name("tir", tir, (AUTO, *TIR))
    _check_name("error_bound", error_bound, FORMULAS)
    _check_header(rays, answers, tir)
    pieces, mismatches = _matched(rays, answers)
    ulp = float(np.finfo(PRECISIONS[rays.precision]).eps)
    if not most_backward > 0:
        raise ValueError(f"most_backward = {most_backward}: accepted: a positive number of roundings")
    same = _same_ratio(rays.header, ulp)
    question = Question(rays.precision, error_bound, tir, most_backward=most_backward, same_ratio=same)
    signal, parts, angles, backward = _parts(pieces, question, judge)
    return Findings(
        precision=rays.precision,
        ulp=ulp,
        error_bound=error_bound,
        tir=signal,
        tir_given=tir != AUTO,
        regimes=tuple(_by_regime(rays.header, parts, angles, backward)),
        problems=(*(_listed(kind, *each) for kind, each in mismatches.items()), *_not_directions(parts)),
        explanations=_explanations(pieces, parts, angles, replace(question, tir=signal)),
        header=rays.header,
        ratio=_ratio_difference(rays.header, answers, parts, question.same_ratio),
    )


def _same_ratio(header: Header, ulp: float) -> float:
    return media_rays.SAME if media_rays.has_media(header) else SAME_ULPS * ulp


def _ratio_difference(
    header: Header, answers: Answers | StoredAnswers, parts: list[JudgedPart], same: float
) -> RatioDifference | None:
    given = answers.ratios if isinstance(answers, StoredAnswers) else answers.n_ratio
    if given is None or not parts:
        return None
    largest, id_ = max((part.ratio for part in parts), key=lambda found: found[0])
    return RatioDifference(largest, id_, media_rays.described(header, id_), same)


def _check_header(rays: RaySet | StoredRays, answers: Answers | StoredAnswers, tir: str) -> None:
    flagged = answers.flagged if isinstance(answers, StoredAnswers) else answers.transmitted is not None
    if tir == FLAG and not flagged:
        raise ValueError("tir = 'flag': there is no column `transmitted`; accepted: answers with one")
    if (given := answers.header.get("checksum")) not in (None, rays.header["checksum"]):
        accepted = f"{rays.header['checksum']}, or other rays with --rays FILE"
        raise ValueError(f"the answers are to rays with the checksum {shown(given)}; accepted: {accepted}")


def _matched(
    rays: RaySet | StoredRays, answers: Answers | StoredAnswers
) -> tuple[Pieces, dict[str, tuple[int, list[int]]]]:
    """The rays with their answers; and of each kind of mismatch how many ids have it, and the first of them."""
    if isinstance(rays, StoredRays) and isinstance(answers, StoredAnswers):
        return StoredPieces(rays, answers), answers.mismatches
    if isinstance(rays, RaySet) and isinstance(answers, Answers):
        mismatches, order = _match_ids(rays, answers)
        return ArrayPieces(rays, answers, order), mismatches
    raise TypeError("rays and answers; accepted: both stored, or neither")


def _parts(pieces: Pieces, question: Question, judge: Judge) -> tuple[str, list[JudgedPart], KeptErrors, KeptErrors]:
    """The signal of total internal reflection, and the parts judged by it, whose errors are kept apart.

    The signal is known after all rays are: that of a sample is taken first, and all are judged again if it was wrong.
    """
    detected = question.tir == AUTO and not pieces.flagged
    tir = FLAG if question.tir == AUTO else question.tir
    if detected:
        tir = _guess(pieces, question)
    while True:
        asked, found = replace(question, tir=tir, counted=detected), {}
        angles, backward = KeptErrors(pieces.total), KeptErrors(pieces.total)
        for number, part in judge((piece, asked) for piece in pieces):
            angles.put(number, part.angles)
            backward.put(number, part.backward)
            found[number] = part.without_errors()
        parts = [found[number] for number in range(len(found))]
        signal = tir_signal.joined([part.signals for part in parts if part.signals]).signal if detected else tir
        if signal == tir:
            return tir, parts, angles, backward
        tir, detected = signal, False


def _guess(pieces: Pieces, question: Question) -> str:
    """The signal of a few rays, evenly over the set; of those that seem totally reflected, where there are any."""
    some = pieces.sampled(np.arange(0, pieces.total, max(1, pieces.total // SEEN)))
    rays = some.used
    across = np.cross(rays.n.astype(float), rays.a.astype(float))
    with np.errstate(all="ignore"):
        sine = rays.k * (lengths(across) / (lengths(rays.a) * lengths(rays.n)))
    which = np.flatnonzero(sine > 1)
    which = which[:: max(1, len(which) // GUESSED)]
    if not len(which):
        return NONE
    flag = None if some.flag is None else some.flag[which]
    budget = FORMULAS[question.error_bound].budget
    return judge_answers(some.b[which], flag, rays[which], question.precision, budget).tir


def _explanations(
    pieces: Pieces, parts: list[JudgedPart], angles: KeptErrors, question: Question
) -> tuple[Explanation, ...]:
    if not any(part.evidence.wrong_count for part in parts):
        return ()
    found = AllEvidence([part.evidence for part in parts], angles.of(range(len(parts))))
    some, printed = (pieces.sampled(of(found)) for of in (diagnosis.sample, diagnosis.printed_sample))
    budget = FORMULAS[question.error_bound].budget
    judged = judge_answers(some.b, some.flag, some.used, question.precision, budget, question.tir)
    return tuple(diagnosis.explain(judged, found, printed.b))


def _check_name(name: str, value: str, accepted: Collection[str]) -> None:
    if value not in accepted:
        raise ValueError(f"{name} = {value!r}: unknown; accepted: {', '.join(accepted)}")


def _match_ids(rays: RaySet, answers: Answers) -> tuple[dict[str, tuple[int, list[int]]], np.ndarray]:
    """The mismatches of the ids, as of `_matched`; and (N,) for each ray the row of its first answer, or −1."""
    ids, first, counts = np.unique(answers.ids, return_index=True, return_counts=True)
    found = {
        "missing": np.setdiff1d(rays.ids, ids),
        "duplicate": ids[counts > 1],
        "unknown": np.setdiff1d(ids, rays.ids),
    }
    place = np.searchsorted(ids, rays.ids).clip(max=max(len(ids) - 1, 0))
    order = np.where(ids[place] == rays.ids, first[place], -1) if len(ids) else np.full(len(rays), -1)
    return {kind: (len(which), which[:LISTED_IDS].tolist()) for kind, which in found.items() if len(which)}, order


def _listed(kind: str, count: int, first: list[int]) -> Problem:
    some = ", ".join(map(str, first[:LISTED_IDS]))
    plural, more = "" if count == 1 else "s", ", …" if count > LISTED_IDS else ""
    return Problem(kind, count, f"id{plural} {some}{more}")


def _not_directions(parts: list[JudgedPart]) -> Iterator[Problem]:
    """Answers that are neither a direction nor the signal of total internal reflection, or an impossible one."""
    for kind in parts[0].listed if parts else ():
        counts, ids = zip(*(part.listed[kind] for part in parts), strict=True)
        if sum(counts):
            yield _listed(kind, sum(counts), [id_ for some in ids for id_ in some])


# By regime ---------------------------------------------------------------------------------------------------------


def _by_regime(
    header: Header, parts: list[JudgedPart], angles: KeptErrors, backward: KeptErrors
) -> Iterator[RegimeErrors]:
    for name in header["regimes"]:
        if numbers := [number for number, part in enumerate(parts) if part.regime == name]:
            of_regime = [parts[number] for number in numbers]
            yield _regime_errors(name, of_regime, angles.of(numbers), backward.of(numbers))


def _regime_errors(name: str, parts: list[JudgedPart], angles: SomeErrors, backward: SomeErrors) -> RegimeErrors:
    lengths_ = [part.length_error for part in parts if part.compared]
    worst = judged_parts.last_of_largest([part.worst.rank for part in parts])
    return RegimeErrors(
        name,
        rays=sum(part.rays for part in parts),
        compared=len(angles),
        worst=angles.largest,
        p99=angles.quantile(0.99),
        mean=angles.mean,
        length_error=float(np.max(lengths_)) if lengths_ else np.nan,
        error_over_bound=float(np.max([part.error_over_bound for part in parts])),
        backward_median=backward.quantile(0.5),
        backward_p99=backward.quantile(0.99),
        backward_worst=backward.largest,
        replay=parts[worst].worst.replay,
        **{count: sum(part.counts[count] for part in parts) for count in judged_parts.COUNTS},
    )
