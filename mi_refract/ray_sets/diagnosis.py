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

from mi_refract.accuracy import RayBounds, lengths
from mi_refract.regimes import Rays

from .evidence import F32, FLOAT32, LENGTHS, AllEvidence
from .judged_answers import JudgedAnswers
from .ray_set import indices

VISIBLE, SAME = 0.1, 5e-3  # radians
MOST, ALL = 0.9, 0.99  # the share of the answers that a mistake, or a loss of precision, must explain
FEWEST = 10  # answers: fewer are no evidence
SAMPLE = 150  # wrong answers, and as many right ones
DIGITS = {2.0**-24: 7, 2.0**-53: 15}  # by roundoff: fewer digits than distinguish its numbers


@dataclass(frozen=True)
class Explanation:
    """A mistake, the share of a sample of the answers that it explains, and the median angle to its directions."""

    mistake: str
    text: str
    share: float
    median: float  # radians
    explains: bool


def refract(a: np.ndarray, n: np.ndarray, k: np.ndarray) -> np.ndarray:
    """The refracted direction (N, 3) for unit a and n (N, 3), k (N,), two-sided; NaN where nothing is transmitted.

    b = k a + n (s √(c² − (k² − 1) ‖n × a‖²) − k c),   c = n·a,  s = sign(c)
    """
    k, c = k[:, None], (a * n).sum(1, keepdims=True)
    across = np.cross(n, a)
    root = np.sqrt(c * c - (k * k - 1) * (across * across).sum(1, keepdims=True))
    return k * a + n * (np.copysign(root, c) - k * c)


@dataclass(frozen=True)
class Case:
    """Rays (N) on which mistakes are evaluated: unit `a` and `n`, the rays as given, and the right answers."""

    a: np.ndarray
    n: np.ndarray
    k: np.ndarray
    rays: Rays
    right: np.ndarray
    transmitted: np.ndarray

    @staticmethod
    def of(bounds: RayBounds, index: np.ndarray) -> Case:
        """The rays with these indices."""
        rays = bounds.rays[index]
        a, n = (v.astype(float) / lengths(v).astype(float)[:, None] for v in (rays.a, rays.n))
        exact = bounds.exact
        return Case(a, n, rays.k.astype(float), rays, exact.direction[index], exact.transmitted[index])

    def with_k(self, k: np.ndarray) -> np.ndarray:
        """(N, 3): the directions for another ratio of indices."""
        return refract(self.a, self.n, k)

    @property
    def refracted(self) -> np.ndarray:
        """(N, 3): the right directions, NaN where nothing is transmitted."""
        return np.where(self.transmitted[:, None], self.right, np.nan)

    @property
    def inverted(self) -> np.ndarray:
        """(N, 3): the directions for 1/k."""
        return self.with_k(1 / self.k)

    @property
    def one_sided(self) -> np.ndarray:
        """(N, 3): the directions that code for normals that face the ray gives."""
        facing = (self.a * self.n).sum(1, keepdims=True) < 0
        return np.where(facing, self.refracted, _across(self.refracted, self.n))

    @property
    def mirrored(self) -> np.ndarray:
        """(N, 3): mirror directions, NaN where nothing is transmitted."""
        return np.where(self.transmitted[:, None], _across(self.a, self.n), np.nan)


def _across(v: np.ndarray, n: np.ndarray) -> np.ndarray:
    """`v` with its part along n reversed."""
    return v - 2 * (v * n).sum(1, keepdims=True) * n


# What each mistake answers -----------------------------------------------------------------------------------------

Predict = Callable[[Case], np.ndarray]


def _by_angle(change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Predict:
    """Code that computes with angles: `change(angle of incidence, k)` is the angle of refraction."""

    def predict(case: Case) -> np.ndarray:
        c = (case.a * case.n).sum(1, keepdims=True)
        tangent = case.a - c * case.n
        length = lengths(tangent).astype(float)[:, None]
        angle = change(np.arctan2(length, np.abs(c)), case.k[:, None])
        return np.cos(angle) * np.sign(c) * case.n + np.sin(angle) * tangent / np.where(length > 0, length, 1)

    return predict


def _refracted(theta: np.ndarray, k: np.ndarray) -> np.ndarray:
    return np.arcsin(k * np.sin(theta))


def _as_given(vector: str) -> Predict:
    """The textbook formula, right for unit vectors only, with a, n or both ("a", "n", "an") left at its length."""

    def predict(case: Case) -> np.ndarray:
        a = case.rays.a.astype(float) if "a" in vector else case.a
        n = case.rays.n.astype(float) if "n" in vector else case.n
        k, c = case.k[:, None], (a * n).sum(1, keepdims=True)
        b = k * a + n * (np.copysign(np.sqrt(1 - k * k * (1 - c * c)), c) - k * c)
        return b / lengths(b).astype(float)[:, None]

    return predict


def _misread(vector: str, matrix: np.ndarray) -> Predict:
    """Code that permutes or reverses the axes of a or n. NaN where the normal changes sides: there programs differ."""

    def predict(case: Case) -> np.ndarray:
        turned = {"a": case.a, "n": case.n}
        turned[vector] = turned[vector] @ matrix.T
        facing = (turned["a"] * turned["n"]).sum(1) * (case.a * case.n).sum(1) > 0
        return np.where(facing[:, None], refract(**turned, k=case.k), np.nan)

    return predict


def _axes() -> Iterator[tuple[str, np.ndarray]]:
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


def _turned(matrix: np.ndarray, case: Case) -> np.ndarray:
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


def sample(evidence: AllEvidence) -> np.ndarray:
    """Indices of wrong and of right answers, evenly over the set, without rays whose bound excuses large errors."""
    return np.concatenate([evidence.evenly(name, SAMPLE) for name in ("wrong", "right")])


def printed_sample(evidence: AllEvidence) -> np.ndarray:
    """Indices of answers whose digits are looked at."""
    return evidence.evenly("compared", SAMPLE)


def explain(judged: JudgedAnswers, evidence: AllEvidence, printed: np.ndarray) -> list[Explanation]:
    """Every mistake, and the share of the answers that it explains. Precondition: some answers are wrong.

    `judged`: the answers of `sample`; `printed` (M, 3): those of `printed_sample`, as given.
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


def _best_variant(name: str, table: dict[str, Predict], case: Case, b: np.ndarray, wrong: np.ndarray) -> Explanation:
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


def _angle(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(N,): the angle between vectors (N, 3) of any length, in radians; NaN where one is no direction."""
    across, along = lengths(np.cross(u, v)).astype(float), (u * v).sum(1)
    return np.where((across == 0) & (along == 0), np.nan, np.arctan2(across, along))


def _of_wrong(name: str, text: str, evidence: AllEvidence, accounted: int, enough: bool) -> Explanation:
    """`accounted`: how many of the wrong answers the mistake accounts for."""
    share = accounted / evidence.wrong_count if evidence.wrong_count else 0.0
    explains = bool(enough and share >= ALL and evidence.wrong_count >= FEWEST)
    return Explanation(name, text, share, evidence.wrong_median, explains)


def _wrong_lengths(evidence: AllEvidence) -> Explanation:
    text = "directions are right, but not of length 1"
    return _of_wrong("missing normalisation", text, evidence, evidence.accounted(LENGTHS), True)


def _float32(evidence: AllEvidence, roundoff: float) -> Explanation:
    """float32 where float64 was claimed: errors of float32's size nearly everywhere, and none that is larger."""
    everywhere = evidence.median > F32 / 50
    enough, text = roundoff < F32 and everywhere, "errors are those of float32"
    return _of_wrong("f32 where f64 was claimed", text, evidence, evidence.accounted(FLOAT32), enough)


def _few_digits(evidence: AllEvidence, printed: np.ndarray, roundoff: float) -> Explanation:
    """Numbers that were printed with too few digits."""
    values = printed.ravel()
    values = values[np.rint(values) != values].tolist()
    candidates = range(1, DIGITS[roundoff] + 1) if len(values) >= FEWEST else range(0)
    for digits, (form, word) in itertools.product(candidates, (("f", "decimals"), ("g", "significant digits"))):
        if all(float(f"{x:.{digits}{form}}") == x for x in values):
            # Half a unit of the last digit in each of three components.
            text = f"numbers are rounded to {digits} {word}"
            return _of_wrong("too few digits", text, evidence, evidence.accounted(str(digits)), True)
    return Explanation("too few digits", "numbers have all their digits", 0.0, math.nan, False)
