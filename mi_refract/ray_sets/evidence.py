"""What of judged answers may show a usual mistake, kept without the answers themselves.

A sample of the answers is evenly over the set, so a bit of every ray says whether it may be in it; what a loss of
precision accounts for is a count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mi_refract.accuracy import Judgement, absolute_radicand

from .judged_answers import JudgedAnswers

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
    """That of all rays, in their order. Masks are (N,), `angles` and `wrong_compared` of the rays compared."""

    wrong: np.ndarray
    right: np.ndarray
    compared: np.ndarray
    wrong_compared: np.ndarray
    angles: np.ndarray
    wrong_count: int
    accounted: dict[str, int]


def joined(parts: Sequence[tuple[Evidence, np.ndarray]]) -> AllEvidence:
    """Parts with their angles, in the order of the rays."""

    def mask(name: str) -> np.ndarray:
        counts = [len(angles) if name == "wrong_compared" else each.rays for each, angles in parts]
        bits = [np.unpackbits(getattr(each, name), count=n) for (each, _), n in zip(parts, counts, strict=True)]
        return np.concatenate(bits).astype(bool)

    names = {name for each, _ in parts for name in each.accounted}
    return AllEvidence(
        wrong=mask("wrong"),
        right=mask("right"),
        compared=mask("compared"),
        wrong_compared=mask("wrong_compared"),
        angles=np.concatenate([angles for _, angles in parts]),
        wrong_count=sum(each.wrong_count for each, _ in parts),
        accounted={name: sum(each.accounted.get(name, 0) for each, _ in parts) for name in names},
    )
