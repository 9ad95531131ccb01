"""What of judged answers may show a usual mistake, kept without the answers themselves.

A sample of the answers is evenly over the set, so a bit of every ray says whether it may be in it; what a loss of
precision accounts for is a count.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mi_refract.accuracy import Judgement, absolute_radicand

from .judged_answers import JudgedAnswers
from .kept_errors import SomeErrors, median

WIDEST_BOUND = 1e-3  # radians: under a wider bound an answer is no evidence
F32 = 2.0**-24
MOST_DIGITS = 15
LENGTHS, FLOAT32 = "lengths", "float32"  # what is lost, beside digits: "1" to "15"


@dataclass(frozen=True)
class Evidence:
    """Of N rays. Masks are packed, eight rays a byte.

    `accounted`: how many of the wrong answers a loss of precision accounts for, by its name.
    """

    rays: int
    wrong: np.ndarray  # wrong, and evidence
    right: np.ndarray  # not wrong, and evidence
    compared: np.ndarray
    wrong_compared: np.ndarray  # of the rays compared (in `JudgedPart.angles`) those that are wrong
    wrong_count: int
    accounted: dict[str, int]


def evidence(judged: JudgedAnswers) -> Evidence:
    """That of some answers."""
    verdict = judged.verdict
    usable = verdict.bounds.decided & (verdict.bounds.chord <= WIDEST_BOUND)
    wrong, compared = verdict.wrong, verdict.compared
    accounted = {name: int(mask[wrong].sum()) for name, mask in _accounted(verdict).items()} if wrong.any() else {}
    return Evidence(
        rays=len(wrong),
        wrong=np.packbits(usable & wrong),
        right=np.packbits(usable & ~wrong),
        compared=np.packbits(compared),
        wrong_compared=np.packbits(wrong[compared]),
        wrong_count=int(wrong.sum()),
        accounted=accounted,
    )


def _accounted(verdict: Judgement) -> dict[str, np.ndarray]:
    """(N,) the answers that are as a loss of precision would leave them, by its name."""
    bounds, u = verdict.bounds, 2 * F32  # u of the inputs, u of the formula
    k, exact = bounds.k, bounds.exact
    float32 = bounds.budget.chord(u, k, exact.cos_t, exact.transmitted, cos_i=exact.cos_i)
    lost = verdict.misjudged & (absolute_radicand(bounds.rays) <= bounds.budget.radicand_error_bound(u, k))
    within = {str(digits): bounds.chord + 10.0**-digits for digits in range(1, MOST_DIGITS + 1)}
    found = {name: verdict.compared & (verdict.error <= bound) for name, bound in within.items()}
    found[FLOAT32] = verdict.compared & (verdict.error <= float32) | lost
    return found | {LENGTHS: verdict.compared & (verdict.angle <= bounds.chord)}


@dataclass(frozen=True)
class AllEvidence:
    """That of all rays: of parts in the order of the rays, and the angles of the rays compared."""

    parts: Sequence[Evidence]
    angles: SomeErrors

    @property
    def wrong_count(self) -> int:
        """How many answers are wrong."""
        return sum(each.wrong_count for each in self.parts)

    def accounted(self, name: str) -> int:
        """How many of them a loss of precision accounts for."""
        return sum(each.accounted.get(name, 0) for each in self.parts)

    @functools.cached_property
    def median(self) -> float:
        """Of all angles."""
        return median(self.angles.pieces)

    @functools.cached_property
    def wrong_median(self) -> float:
        """Of the angles of wrong answers."""
        return median(lambda: (all_[mask] for all_, mask in zip(self.angles.pieces(), self._wrong(), strict=True)))

    def _wrong(self) -> Iterator[np.ndarray]:
        for each, (_, count) in zip(self.parts, self.angles.runs, strict=True):
            yield np.unpackbits(each.wrong_compared, count=count).astype(bool)

    def evenly(self, name: str, count: int) -> np.ndarray:
        """Indices of `count` rays or fewer, evenly over those in the mask of that name."""
        totals = np.array([int(np.unpackbits(getattr(each, name)).sum()) for each in self.parts])
        step = max(1, -(-int(totals.sum()) // count))
        ends, begin, found = np.cumsum(totals), 0, [np.empty(0, np.int64)]
        for each, total, end in zip(self.parts, totals, ends, strict=True):
            first = -(int(end) - int(total)) % step
            if first < total:
                mask = np.unpackbits(getattr(each, name), count=each.rays)
                found.append(begin + np.flatnonzero(mask)[first::step])
            begin += each.rays
        return np.concatenate(found)
