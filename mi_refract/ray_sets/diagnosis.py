"""The usual mistakes: the answers that each one would give, and whether the program gave those.

A mistake is visible on a ray where it changes the direction by more than VISIBLE. It explains an answer there that is
within SAME of the direction that the mistake gives. A loss of precision predicts no direction: it is recognised by a
wider bound that contains the errors.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mi_refract.accuracy import RayBounds, lengths
from mi_refract.regimes import Array, Rays

from .judged_answers import F32, Flags, JudgedAnswers, Table
from .ray_set import indices

Index = NDArray[np.intp]

VISIBLE, SAME = 0.1, 5e-3  # radians
MOST, ALL = 0.9, 0.99  # the share of the answers that a mistake, or a loss of precision, must explain
FEWEST = 10  # answers: fewer are no evidence
SAMPLE = 150  # wrong answers, and as many right ones
MOST_TELLING = {2.0**-24: 7, 2.0**-53: 15}  # by roundoff: digits, fewer than distinguish its numbers
FLOAT32, FEW_DIGITS = "f32 where f64 was claimed", "too few digits"


@dataclass(frozen=True)
class Explanation:
    """A mistake, the share of a sample of the answers that it explains, and the median angle to its directions."""

    mistake: str
    text: str
    share: float
    median: float  # radians
    explains: bool


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
    def of(bounds: RayBounds) -> Case:
        """All rays that have the bounds."""
        rays, exact = bounds.rays, bounds.exact
        a, n = (v.astype(float) / lengths(v).astype(float)[:, None] for v in (rays.a, rays.n))
        return Case(a, n, rays.k.astype(float), rays, exact.direction, exact.transmitted)

    @property
    def refracted(self) -> Array:
        """(N, 3): the right directions, NaN where nothing is transmitted."""
        return np.where(self.transmitted[:, None], self.right, np.nan)

    @property
    def one_sided(self) -> Array:
        """(N, 3): the directions of a formula for normals that face the ray."""
        facing = (self.a * self.n).sum(1, keepdims=True) < 0
        return np.where(facing, self.refracted, _across(self.refracted, self.n))


def refract(a: Array, n: Array, k: Array) -> Array:
    """The refracted direction (N, 3) for unit a and n (N, 3), k (N,), two-sided; NaN where nothing is transmitted.

    b = k a + n (s √(c² − (k² − 1) ‖n × a‖²) − k c),   c = n·a,  s = sign(c)
    """
    k, c = k[:, None], (a * n).sum(1, keepdims=True)
    across = np.cross(n, a)
    root = np.sqrt(c * c - (k * k - 1) * (across * across).sum(1, keepdims=True))
    b: Array = k * a + n * (np.copysign(root, c) - k * c)
    return b


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


def _snell(theta: Array, k: Array) -> Array:
    return np.arcsin(k * np.sin(theta))


def _as_given(vectors: str) -> Predict:
    """The textbook formula, right for unit vectors only, with a, n or both ("a", "n", "an") left at its length."""

    def predict(case: Case) -> Array:
        a = case.rays.a.astype(float) if "a" in vectors else case.a
        n = case.rays.n.astype(float) if "n" in vectors else case.n
        k, c = case.k[:, None], (a * n).sum(1, keepdims=True)
        b: Array = k * a + n * (np.copysign(np.sqrt(1 - k * k * (1 - c * c)), c) - k * c)
        return np.asarray(b / lengths(b).astype(float)[:, None])

    return predict


def _misread(vector: str, matrix: Array, case: Case) -> Array:
    """Code that permutes or reverses the axes of a or n. NaN where the normal changes sides: there programs differ."""
    turned = {"a": case.a, "n": case.n}
    turned[vector] = turned[vector] @ matrix.T
    facing = (turned["a"] * turned["n"]).sum(1) * (case.a * case.n).sum(1) > 0
    return np.where(facing[:, None], refract(**turned, k=case.k), np.nan)


def _turned(matrix: Array, case: Case) -> Array:
    return case.refracted @ matrix.T


def _handedness() -> Iterator[tuple[str, Predict]]:
    """Signed permutations of the axes, without the identity and −1: to reverse all three is another mistake."""
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        if order == (0, 1, 2) and len(set(signs)) == 1:
            continue
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        name = ", ".join(f"{'-' if s < 0 else ''}{'xyz'[i]}" for i, s in zip(order, signs, strict=True))
        yield f"the answer's x, y, z are the right answer's {name}", functools.partial(_turned, matrix)
        for vector in ("a", "n"):
            yield f"{vector} was read as its {name}", functools.partial(_misread, vector, matrix)


MISTAKES: dict[str, dict[str, Predict]] = {
    "eta inverted": {
        "k = n_to / n_from was used, or the normal's side chose it": lambda case: refract(case.a, case.n, 1 / case.k),
    },
    "an index ignored": {
        "n_to was taken for 1": lambda case: refract(case.a, case.n, indices(case.k)[0]),
        "n_from was taken for 1": lambda case: refract(case.a, case.n, 1 / indices(case.k)[1]),
    },
    "normal flipped": {
        "the answer goes back to the side that the ray comes from": lambda case: _across(case.refracted, case.n),
        "n was taken to face the ray, where it does not": lambda case: case.one_sided,
    },
    "direction reversed": {
        "a was taken to point away from the surface": lambda case: -_across(case.refracted, case.n),
        "a was taken to point away from the surface, and its side chose the ratio": (
            lambda case: -refract(case.a, case.n, 1 / case.k)
        ),
        "the answer points toward the surface": lambda case: -case.refracted,
    },
    "reflected instead of refracted": {
        "the answer is the mirror direction": (
            lambda case: np.where(case.transmitted[:, None], _across(case.a, case.n), np.nan)
        ),
    },
    "degrees and radians": {
        "the angle of refraction was turned into degrees": _by_angle(lambda t, k: np.degrees(_snell(t, k))),
        "the angle of refraction was taken for degrees": _by_angle(lambda t, k: np.radians(_snell(t, k))),
        "the angle of incidence was turned into degrees": _by_angle(lambda t, k: _snell(np.degrees(t), k)),
        "the angle of incidence was taken for degrees": _by_angle(lambda t, k: _snell(np.radians(t), k)),
    },
    "handedness": dict(_handedness()),
    "missing normalisation": {
        "a and n were taken for unit vectors": _as_given("an"),
        "a was taken for a unit vector": _as_given("a"),
        "n was taken for a unit vector": _as_given("n"),
    },
}


# Comparison with the answers ---------------------------------------------------------------------------------------


def sample(table: Table) -> Index:
    """Rows of wrong and of right answers, evenly over the set, without rays whose bound excuses large errors."""
    wrong = table["beyond_bound"]
    return np.concatenate([evenly(table["evidence"] & mask) for mask in (wrong, ~wrong)])


def evenly(mask: Flags) -> Index:
    """SAMPLE rows of the mask or fewer, evenly over it."""
    rows = np.flatnonzero(mask)
    return rows[:: max(1, -(-len(rows) // SAMPLE))]


def explain(judged: JudgedAnswers, table: Table, printed: Array) -> list[Explanation]:
    """Every mistake, and the share of the answers that it explains. Precondition: some answers are wrong.

    `judged`: the answers of `sample(table)`; `table`: of all; `printed` (M, 3): answers as they are in the file.
    """
    verdict = judged.verdict
    case, roundoff = Case.of(verdict.bounds), verdict.bounds.roundoff
    with np.errstate(all="ignore"):
        found = [
            max((_prediction(name, text, predict(case), case.right, judged.b, verdict.wrong)
                 for text, predict in variants.items()), key=_strength)
            for name, variants in MISTAKES.items()
        ]  # fmt: skip
    lengths_only = _loss("missing normalisation", "directions are right, but not of length 1", table, "lengths")
    found[-1] = max(found[-1], lengths_only, key=_strength)
    # float32 where float64 was claimed: errors of float32's size nearly everywhere, and none that is larger.
    everywhere = roundoff < F32 and _median_angle(table, table["compared"]) > F32 / 50
    float32 = _loss(FLOAT32, "errors are those of float32", table, "float32", everywhere)
    digits = _few_digits(table, printed, roundoff)
    # Numbers of few digits may keep the bound of float32, too.
    return [*found, replace(float32, explains=float32.explains and not digits.explains), digits]


def _prediction(name: str, text: str, predicted: Array, right: Array, b: Array, wrong: Flags) -> Explanation:
    visible = _angle(predicted, right) > VISIBLE
    angle = np.nan_to_num(_angle(b, predicted)[visible], nan=np.inf)
    share = float(np.mean(angle <= SAME)) if len(angle) else 0.0
    median = float(np.median(angle)) if len(angle) else math.nan
    return Explanation(name, text, share, median, bool((visible & wrong).sum() >= FEWEST and share >= MOST))


def _strength(explanation: Explanation) -> tuple[bool, float]:
    return explanation.explains, explanation.share


def _angle(u: Array, v: Array) -> Array:
    """(N,): the angle between vectors (N, 3) of any length, in radians; NaN where one is no direction."""
    across, along = lengths(np.cross(u, v)).astype(float), (u * v).sum(1)
    return np.where((across == 0) & (along == 0), np.nan, np.arctan2(across, along))


def _loss(name: str, text: str, table: Table, column: str, possible: bool = True, least: int = 1) -> Explanation:
    """A loss of precision: it explains the wrong answers whose number in the column is `least` or more."""
    wrong = table["beyond_bound"]
    count, total = int((table[column][wrong] >= least).sum()), int(wrong.sum())
    explains = bool(possible and count >= ALL * total and total >= FEWEST)
    return Explanation(name, text, count / total, _median_angle(table, wrong), explains)


def _median_angle(table: Table, mask: Flags) -> float:
    """Of the directions compared in the mask; NaN where there is none."""
    angles = table["angle"][table["compared"] & mask]
    return float(np.median(angles)) if len(angles) else math.nan


def _few_digits(table: Table, printed: Array, roundoff: float) -> Explanation:
    """Numbers that were printed with too few digits."""
    values = printed.ravel()
    values = values[np.rint(values) != values].tolist()
    candidates = range(1, MOST_TELLING[roundoff] + 1) if len(values) >= FEWEST else range(0)
    for digits, (form, word) in itertools.product(candidates, (("f", "decimals"), ("g", "significant digits"))):
        if all(float(f"{x:.{digits}{form}}") == x for x in values):
            return _loss(FEW_DIGITS, f"numbers are rounded to {digits} {word}", table, "digits", least=digits)
    return Explanation(FEW_DIGITS, "numbers have all their digits", 0.0, math.nan, False)
