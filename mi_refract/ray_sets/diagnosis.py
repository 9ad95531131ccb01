"""The usual mistakes: the answers that each one would give, and whether the program gave those.

A mistake is visible on a ray where it changes the direction by more than VISIBLE. It explains an answer there that is
within SAME of the direction that the mistake gives. A loss of precision predicts no direction: it is recognised by a
wider bound that contains the errors.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mi_refract.accuracy import Judgement, RayBounds, absolute_radicand, lengths
from mi_refract.regimes import Array, Rays

from .judged_answers import JudgedAnswers, Table
from .ray_set import indices

Index = NDArray[np.intp]
Flags = NDArray[np.bool_]

VISIBLE, SAME = 0.1, 5e-3  # radians
MOST, ALL = 0.9, 0.99  # the share of the answers that a mistake, or a loss of precision, must explain
FEWEST = 10  # answers: fewer are no evidence
SAMPLE = 150  # wrong answers, and as many right ones
F32 = 2.0**-24
MOST_DIGITS = 15
LENGTHS, FLOAT32 = "lengths", "float32"  # names of losses, beside the numbers of digits, "1" to "15"
DIGITS = {2.0**-24: 7, 2.0**-53: 15}  # by roundoff: fewer digits than distinguish its numbers


@dataclass(frozen=True)
class Explanation:
    """A mistake, the share of a sample of the answers that it explains, and the median angle to its directions."""

    mistake: str
    text: str
    share: float
    median: float  # radians
    explains: bool


def refract(a: Array, n: Array, k: Array) -> Array:
    """The refracted direction (N, 3) for unit a and n (N, 3), k (N,), two-sided; NaN where nothing is transmitted.

    b = k a + n (s √(c² − (k² − 1) ‖n × a‖²) − k c),   c = n·a,  s = sign(c)
    """
    k, c = k[:, None], (a * n).sum(1, keepdims=True)
    across = np.cross(n, a)
    root = np.sqrt(c * c - (k * k - 1) * (across * across).sum(1, keepdims=True))
    b: Array = k * a + n * (np.copysign(root, c) - k * c)
    return b


@dataclass(frozen=True)
class Case:
    """Rays (N) on which mistakes are evaluated: unit `a` and `n`, the rays as given, and the right answers."""

    a: Array
    n: Array
    k: Array
    rays: Rays
    right: Array
    transmitted: Flags

    @staticmethod
    def of(bounds: RayBounds, index: Index) -> Case:
        """The rays with these indices."""
        rays = bounds.rays[index]
        a, n = (v.astype(float) / lengths(v).astype(float)[:, None] for v in (rays.a, rays.n))
        exact = bounds.exact
        return Case(a, n, rays.k.astype(float), rays, exact.direction[index], exact.transmitted[index])

    def with_k(self, k: Array) -> Array:
        """(N, 3): the directions for another ratio of indices."""
        return refract(self.a, self.n, k)

    @property
    def refracted(self) -> Array:
        """(N, 3): the right directions, NaN where nothing is transmitted."""
        return np.where(self.transmitted[:, None], self.right, np.nan)

    @property
    def inverted(self) -> Array:
        """(N, 3): the directions for 1/k."""
        return self.with_k(1 / self.k)

    @property
    def one_sided(self) -> Array:
        """(N, 3): the directions that code for normals that face the ray gives."""
        facing = (self.a * self.n).sum(1, keepdims=True) < 0
        return np.where(facing, self.refracted, _across(self.refracted, self.n))

    @property
    def mirrored(self) -> Array:
        """(N, 3): mirror directions, NaN where nothing is transmitted."""
        return np.where(self.transmitted[:, None], _across(self.a, self.n), np.nan)


def _across(v: Array, n: Array) -> Array:
    """`v` with its part along n reversed."""
    return np.asarray(v - 2 * (v * n).sum(1, keepdims=True) * n)


# What each mistake answers -----------------------------------------------------------------------------------------

Predict = Callable[[Case], Array]


def _by_angle(change: Callable[[Array, Array], Array]) -> Predict:
    """Code that computes with angles: `change(angle of incidence, k)` is the angle of refraction."""

    def predict(case: Case) -> Array:
        c = (case.a * case.n).sum(1, keepdims=True)
        tangent = case.a - c * case.n
        length = lengths(tangent).astype(float)[:, None]
        angle = change(np.arctan2(length, np.abs(c)), case.k[:, None])
        b = np.cos(angle) * np.sign(c) * case.n + np.sin(angle) * tangent / np.where(length > 0, length, 1)
        return np.asarray(b)

    return predict


def _refracted(theta: Array, k: Array) -> Array:
    return np.arcsin(k * np.sin(theta))


def _as_given(vector: str) -> Predict:
    """The textbook formula, right for unit vectors only, with a, n or both ("a", "n", "an") left at its length."""

    def predict(case: Case) -> Array:
        a = case.rays.a.astype(float) if "a" in vector else case.a
        n = case.rays.n.astype(float) if "n" in vector else case.n
        k, c = case.k[:, None], (a * n).sum(1, keepdims=True)
        b: Array = k * a + n * (np.copysign(np.sqrt(1 - k * k * (1 - c * c)), c) - k * c)
        return np.asarray(b / lengths(b).astype(float)[:, None])

    return predict


def _misread(vector: str, matrix: Array) -> Predict:
    """Code that permutes or reverses the axes of a or n. NaN where the normal changes sides: there programs differ."""

    def predict(case: Case) -> Array:
        turned = {"a": case.a, "n": case.n}
        turned[vector] = turned[vector] @ matrix.T
        facing = (turned["a"] * turned["n"]).sum(1) * (case.a * case.n).sum(1) > 0
        return np.where(facing[:, None], refract(**turned, k=case.k), np.nan)

    return predict


def _axes() -> Iterator[tuple[str, Array]]:
    """Signed permutations of the axes, without the identity and −1: to reverse all three is another mistake."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            if order != (0, 1, 2) or len(set(signs)) > 1:
                matrix = np.zeros((3, 3))
                matrix[range(3), order] = signs
                yield ", ".join(f"{'-' if s < 0 else ''}{'xyz'[i]}" for i, s in zip(order, signs, strict=True)), matrix


def _handedness() -> dict[str, Predict]:
    table: dict[str, Predict] = {}
    for name, matrix in _axes():
        table[f"the answer's x, y, z are the right answer's {name}"] = functools.partial(_turned, matrix)
        for vector in ("a", "n"):
            table[f"{vector} was read as its {name}"] = _misread(vector, matrix)
    return table


def _turned(matrix: Array, case: Case) -> Array:
    return case.refracted @ matrix.T


MISTAKES: dict[str, dict[str, Predict]] = {
    "eta inverted": {
        "k = n_to / n_from was used, or the normal's side chose it": lambda case: case.inverted,
    },
    "an index ignored": {
        "n_to was taken for 1": lambda case: case.with_k(indices(case.k)[0]),
        "n_from was taken for 1": lambda case: case.with_k(1 / indices(case.k)[1]),
    },
    "normal flipped": {
        "the answer goes back to the side that the ray comes from": lambda case: _across(case.refracted, case.n),
        "n was taken to face the ray, where it does not": lambda case: case.one_sided,
    },
    "direction reversed": {
        "a was taken to point away from the surface": lambda case: -_across(case.refracted, case.n),
        "a was taken to point away from the surface, and its side chose the ratio": lambda case: -case.inverted,
        "the answer points toward the surface": lambda case: -case.refracted,
    },
    "reflected instead of refracted": {
        "the answer is the mirror direction": lambda case: case.mirrored,
    },
    "degrees and radians": {
        "the angle of refraction was turned into degrees": _by_angle(lambda t, k: np.degrees(_refracted(t, k))),
        "the angle of refraction was taken for degrees": _by_angle(lambda t, k: np.radians(_refracted(t, k))),
        "the angle of incidence was turned into degrees": _by_angle(lambda t, k: _refracted(np.degrees(t), k)),
        "the angle of incidence was taken for degrees": _by_angle(lambda t, k: _refracted(np.radians(t), k)),
    },
    "handedness": _handedness(),
    "missing normalisation": {
        "a and n were taken for unit vectors": _as_given("an"),
        "a was taken for a unit vector": _as_given("a"),
        "n was taken for a unit vector": _as_given("n"),
    },
}


# Comparison with the answers ---------------------------------------------------------------------------------------


def losses(verdict: Judgement) -> dict[str, int]:
    """How many of the wrong answers are as a loss of precision would leave them, by its name."""
    if not verdict.wrong.any():
        return {}
    bounds, u = verdict.bounds, 2 * F32  # u of the inputs, u of the formula
    k, exact = bounds.k, bounds.exact
    float32 = bounds.budget.chord(u, k, exact.cos_t, exact.transmitted, cos_i=exact.cos_i)
    lost = verdict.misjudged & (absolute_radicand(bounds.rays) <= bounds.budget.radicand_error_bound(u, k))
    within = {str(digits): bounds.chord + 10.0**-digits for digits in range(1, MOST_DIGITS + 1)}
    masks = {name: verdict.compared & (verdict.error <= bound) for name, bound in within.items()}
    masks[FLOAT32] = verdict.compared & (verdict.error <= float32) | lost
    masks[LENGTHS] = verdict.compared & (verdict.angle <= bounds.chord)
    return {name: int(mask[verdict.wrong].sum()) for name, mask in masks.items()}


@dataclass(frozen=True)
class Evidence:
    """What shows a mistake: the table of all answers, and how many of the wrong ones `losses` account for."""

    table: Table
    losses: Mapping[str, int]

    @property
    def wrong_count(self) -> int:
        """How many answers are beyond their bound."""
        return int(self.table["beyond_bound"].sum())

    @property
    def sample(self) -> Index:
        """Rows of wrong and of right answers, evenly over the set, without rays whose bound excuses large errors."""
        wrong = self.table["beyond_bound"]
        return np.concatenate([_evenly(self.table["evidence"] & mask) for mask in (wrong, ~wrong)])

    @property
    def printed(self) -> Index:
        """Rows of answers whose digits are looked at."""
        return _evenly(self.table["compared"])

    def median_angle(self, mask: Flags) -> float:
        """Of the directions compared in the mask; NaN where there is none."""
        angles = self.table["angle"][self.table["compared"] & mask]
        return float(np.median(angles)) if len(angles) else math.nan


def _evenly(mask: Flags) -> Index:
    """SAMPLE rows of the mask or fewer, evenly over it."""
    rows = np.flatnonzero(mask)
    return rows[:: max(1, -(-len(rows) // SAMPLE))]


def explain(judged: JudgedAnswers, evidence: Evidence, printed: Array) -> list[Explanation]:
    """Every mistake, and the share of the answers that it explains. Precondition: some answers are wrong.

    `judged`: the answers of `evidence.sample`; `printed` (M, 3): those of `evidence.printed`, as given.
    """
    verdict = judged.verdict
    case, wrong = Case.of(verdict.bounds, np.arange(len(judged.b))), verdict.wrong
    with np.errstate(all="ignore"):
        found = [_best_variant(name, table, case, judged.b, wrong) for name, table in MISTAKES.items()]
        roundoff = verdict.bounds.roundoff
        lengths_only, float32 = _wrong_lengths(evidence), _float32(evidence, roundoff)
        digits = _few_digits(evidence, printed, roundoff)
    found[-1] = max(found[-1], lengths_only, key=_strength)
    # Numbers of few digits may keep the bound of float32, too.
    return [*found, replace(float32, explains=float32.explains and not digits.explains), digits]


def _best_variant(name: str, table: dict[str, Predict], case: Case, b: Array, wrong: Flags) -> Explanation:
    """Of the variants of a mistake, the one that explains most."""
    variants = []
    for text, predict in table.items():
        given = predict(case)
        visible = _angle(given, case.right) > VISIBLE
        angle = np.nan_to_num(_angle(b, given)[visible], nan=np.inf)
        share = float(np.mean(angle <= SAME)) if len(angle) else 0.0
        median = float(np.median(angle)) if len(angle) else math.nan
        enough = (visible & wrong).sum() >= FEWEST and share >= MOST
        variants.append(Explanation(name, text, share, median, bool(enough)))
    return max(variants, key=_strength)


def _strength(each: Explanation) -> tuple[bool, float]:
    return each.explains, each.share


def _angle(u: Array, v: Array) -> Array:
    """(N,): the angle between vectors (N, 3) of any length, in radians; NaN where one is no direction."""
    across, along = lengths(np.cross(u, v)).astype(float), (u * v).sum(1)
    return np.where((across == 0) & (along == 0), np.nan, np.arctan2(across, along))


def _of_wrong(name: str, text: str, evidence: Evidence, accounted: int, enough: bool) -> Explanation:
    """`accounted`: how many of the wrong answers the mistake accounts for."""
    share = accounted / evidence.wrong_count if evidence.wrong_count else 0.0
    explains = bool(enough and share >= ALL and evidence.wrong_count >= FEWEST)
    return Explanation(name, text, share, evidence.median_angle(evidence.table["beyond_bound"]), explains)


def _wrong_lengths(evidence: Evidence) -> Explanation:
    text = "directions are right, but not of length 1"
    return _of_wrong("missing normalisation", text, evidence, evidence.losses[LENGTHS], True)


def _float32(evidence: Evidence, roundoff: float) -> Explanation:
    """float32 where float64 was claimed: errors of float32's size nearly everywhere, and none that is larger."""
    everywhere = evidence.median_angle(evidence.table["compared"]) > F32 / 50
    enough, text = roundoff < F32 and everywhere, "errors are those of float32"
    return _of_wrong("f32 where f64 was claimed", text, evidence, evidence.losses[FLOAT32], enough)


def _few_digits(evidence: Evidence, printed: Array, roundoff: float) -> Explanation:
    """Numbers that were printed with too few digits."""
    values = printed.ravel()
    values = values[np.rint(values) != values].tolist()
    candidates = range(1, DIGITS[roundoff] + 1) if len(values) >= FEWEST else range(0)
    for digits, (form, word) in itertools.product(candidates, (("f", "decimals"), ("g", "significant digits"))):
        if all(float(f"{x:.{digits}{form}}") == x for x in values):
            # Half a unit of the last digit in each of three components.
            text = f"numbers are rounded to {digits} {word}"
            return _of_wrong("too few digits", text, evidence, evidence.losses[str(digits)], True)
    return Explanation("too few digits", "numbers have all their digits", 0.0, math.nan, False)
