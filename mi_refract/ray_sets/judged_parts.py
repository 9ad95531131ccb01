"""What is kept of judged rays, so that a set is judged in pieces, here or elsewhere, and no piece is kept whole.

Of every ray the angle and the backward error are kept, for quantiles and means over all, and three bits, for a sample
of the answers. The parts in the order of the rays give the same findings, whatever the pieces were and whoever judged
them.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mi_refract.accuracy import Judgement
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import Rays

from .evidence import Evidence, evidence
from .judged_answers import JudgedAnswers, judge_answers
from .stored_answers import LISTED_IDS
from .tir_signal import Signals

PIECE = 2**14  # rays of a piece, at most: about a second
COUNTS = {  # of `RegimeErrors`, where they are sums
    "tir_misclassified": lambda judged: judged.verdict.misjudged,
    "tir_beyond_bound": lambda judged: judged.verdict.far,
    "undecidable": lambda judged: judged.undecidable,
    "judged": lambda judged: judged.verdict.compared & ~judged.undecidable,
    "wrong": lambda judged: judged.wrong,
    "right": lambda judged: judged.right,
    "exact": lambda judged: judged.rounded_exact,
}


@dataclass(frozen=True)
class Question:
    """How answers are judged: their precision, the formula of the error bound, the signal of TIR.

    `counted`: whether to count the rays of each signal.
    """

    precision: str
    error_bound: str
    tir: str
    counted: bool = False
    most_backward: float = np.inf  # in u: an answer of which inputs farther off are needed is wrong
    same_ratio: float = 0.0  # the largest relative difference of `n_ratio` to k that is none


@dataclass(frozen=True)
class Piece:
    """Rays (N) of one regime, their ids (N,), the answers b (N, 3), and the columns `transmitted` (N,), `n_ratio` (N,).

    The columns are None where there are none.
    """

    regime: str
    rays: Rays
    ids: np.ndarray
    b: np.ndarray
    flag: np.ndarray | None
    ratio: np.ndarray | None = None

    @property
    def used(self) -> Rays:
        """The rays as the program took them: with the ratio of the indices that it used, where it says so."""
        if self.ratio is None:
            return self.rays
        return Rays(self.rays.a.astype(np.float64), self.rays.n.astype(np.float64), self.ratio)

    @functools.cached_property
    def ratio_difference(self) -> np.ndarray:
        """(N,) of the ratio that the program used, relative to that of the ray; zeros where it does not say."""
        k = self.rays.k.astype(np.float64)
        return np.zeros(len(k)) if self.ratio is None else np.abs(self.ratio - k) / k


@dataclass(frozen=True)
class Worst:
    """Of some rays the last of the largest rank: without a direction, TIR beyond its bound, impossible, share."""

    rank: tuple[float, ...]
    replay: dict[str, Any]


@dataclass(frozen=True)
class JudgedPart:
    """What is kept of a piece."""

    regime: str
    rays: int
    counts: dict[str, int]
    compared: int
    angles: np.ndarray  # of the rays compared, in their order; empty once they are kept elsewhere
    backward: np.ndarray  # backward errors of all rays, in u; likewise
    length_error: float  # the largest; NaN without any compared
    error_over_bound: float
    worst: Worst
    listed: dict[str, tuple[int, list[int]]]  # by kind of problem: how many rays have it, and the first ids
    signals: Signals | None
    evidence: Evidence
    ratio: tuple[float, int]  # the largest relative difference of the ratio used, and the id of its ray

    def without_errors(self) -> JudgedPart:
        """The rest of it, at most a byte a ray."""
        return replace(self, angles=np.empty(0), backward=np.empty(0))


def judge_part(piece: Piece, question: Question) -> JudgedPart:
    """Judge a piece; with the certified answers, which take most of the time."""
    budget = FORMULAS[question.error_bound].budget
    judged = judge_answers(
        piece.b,
        piece.flag,
        piece.used,
        question.precision,
        budget,
        question.tir,
        counted=question.counted,
        most_backward=question.most_backward,
    )
    verdict = judged.verdict
    compared = verdict.compared
    return JudgedPart(
        regime=piece.regime,
        rays=len(piece.ids),
        counts={name: int(mask(judged).sum()) for name, mask in COUNTS.items()},
        compared=int(compared.sum()),
        angles=verdict.angle[compared],
        backward=judged.backward,
        length_error=float(verdict.drift[compared].max()) if compared.any() else np.nan,
        error_over_bound=float(verdict.share.max()),
        worst=_worst(judged, piece.ids),
        listed=_not_directions(judged, piece.ids) | _other_ratios(piece, question.same_ratio),
        signals=judged.signals,
        evidence=evidence(judged),
        ratio=_largest_difference(piece),
    )


def _largest_difference(piece: Piece) -> tuple[float, int]:
    row = int(np.argmax(piece.ratio_difference))
    return float(piece.ratio_difference[row]), int(piece.ids[row])


def _other_ratios(piece: Piece, same: float) -> dict[str, tuple[int, list[int]]]:
    """Answers for which the program used another ratio of indices."""
    ids = piece.ids[piece.ratio_difference > same]
    return {"index": (len(ids), ids[:LISTED_IDS].tolist())}


def here(calls: Iterable[tuple[Piece, Question]]) -> Iterator[tuple[int, JudgedPart]]:
    """The parts by their numbers, judged in this process one after the other."""
    for number, call in enumerate(calls):
        yield number, judge_part(*call)


def last_of_largest(ranks: Iterable[tuple[float, ...]]) -> int:
    """The index of the last of the largest ranks; NaN is larger than any number."""
    columns = np.array(list(ranks), float).T
    return int(np.lexsort(columns[::-1])[-1])


def _worst(judged: JudgedAnswers, ids: np.ndarray) -> Worst:
    verdict: Judgement = judged.verdict
    row = int(np.lexsort((verdict.share, judged.impossible, verdict.far, verdict.blank))[-1])
    bounds = verdict.bounds
    rank = verdict.blank[row], verdict.far[row], judged.impossible[row], verdict.share[row]
    replay = {
        "id": int(ids[row]),
        **bounds.rays.hexed(row),
        "answer": [float(x).hex() for x in judged.b[row]],
        "exact": [float(x).hex() for x in bounds.exact.direction[row]],
        "transmitted": bool(bounds.exact.transmitted[row]),
    }
    return Worst(tuple(map(float, rank)), replay)


def _not_directions(judged: JudgedAnswers, ids: np.ndarray) -> dict[str, tuple[int, list[int]]]:
    """Answers that are neither a direction nor the signal of total internal reflection, or an impossible one."""
    zero, blank = ~judged.b.any(axis=1), judged.verdict.blank
    masks = {"non-finite": blank & ~zero, "zero": blank & zero, "impossible": judged.impossible}
    return {kind: (int(mask.sum()), ids[mask][:LISTED_IDS].tolist()) for kind, mask in masks.items()}
