"""The common mistakes: the answers that each of them gives, and whether the program gave these answers.

A mistake is visible on a ray if it changes the direction by more than VISIBLE. There it explains an answer that is
within SAME of the direction that the mistake gives. A loss of precision predicts no direction: it is recognised by a
wider bound that contains the errors.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from mi_refract import oracle
from mi_refract.accuracy import lengths
from mi_refract.regimes import Array, Rays

from .judged_answers import F32, Index, JudgedAnswers, Table
from .ray_set import indices
from .tir_signal import Flags, unit

VISIBLE, SAME = 0.1, 5e-3  # radians
MOST, ALL = 0.9, 0.99  # shares of the answers that a mistake and a loss of precision must explain
HALF = 0.5  # share of all wrong answers, also those without a visible effect, that must equal those of the mistake
FEWEST = 10  # number of answers: fewer are no evidence
SAMPLE = 150  # number of wrong answers, and of right ones
TELLING_DIGITS = {2.0**-24: 7, 2.0**-53: 15}  # by roundoff: numbers with so few digits are fewer than its floats
FLOAT32, FEW_DIGITS, LENGTHS = "f32 where f64 was claimed", "too few digits", "missing normalisation"


@dataclass(frozen=True)
class Explanation:
    """A mistake, the share of the sampled answers that it explains, and the median angle to its directions."""

    mistake: str
    text: str
    share: float
    median: float  # radians
    explains: bool


def refract(a: Array, n: Array, k: Array) -> Array:
    """The refracted direction (N, 3) for unit a and n (N, 3), k (N,), on either side; NaN under total reflection.

    b = k a + n (s √(c² − (k² − 1) ‖n × a‖²) − k c),   c = n·a,  s = sign(c)
    """
    k, c = k[:, None], (a * n).sum(1, keepdims=True)
    across = np.cross(n, a)
    root = np.sqrt(c * c - (k * k - 1) * (across * across).sum(1, keepdims=True))
    return np.asarray(k * a + n * (np.copysign(root, c) - k * c))


# The answers of each mistake ---------------------------------------------------------------------------------------


def predictions(rays: Rays, exact: oracle.Certified) -> Iterator[tuple[str, str, Array]]:
    """(mistake, variant, directions (N, 3) that it gives); the variants of a mistake are consecutive.

    NaN where the mistake gives no direction, or where programs with this mistake differ.
    """
    a, n, k = unit(rays.a.astype(float)), unit(rays.n.astype(float)), rays.k.astype(float)
    c = (a * n).sum(1, keepdims=True)
    refracted = np.where(exact.transmitted[:, None], exact.direction, np.nan)

    def flipped(v: Array) -> Array:
        """`v` with its component along n reversed."""
        return np.asarray(v - 2 * (v * n).sum(1, keepdims=True) * n)

    inverted = refract(a, n, 1 / k)
    n_from, n_to = indices(k)
    yield "eta inverted", "k = n_to / n_from was used, or the normal's side chose it", inverted
    yield "an index ignored", "n_to was taken for 1", refract(a, n, n_from)
    yield "an index ignored", "n_from was taken for 1", refract(a, n, 1 / n_to)
    root = np.sqrt(1 - k[:, None] * (1 - c * c))
    squared = np.where(exact.transmitted[:, None], k[:, None] * (a - c * n) + np.copysign(root, c) * n, np.nan)
    yield "eta not squared", "the radicand has k in place of k²", squared
    yield "normal flipped", "the answer goes back to the side that the ray comes from", flipped(refracted)
    one_sided = np.where(c < 0, refracted, flipped(refracted))
    yield "normal flipped", "n was taken to face the ray, where it does not", one_sided
    yield "direction reversed", "a was taken to point away from the surface", -flipped(refracted)
    yield "direction reversed", "a was taken to point away from the surface, and its side chose the ratio", -inverted
    yield "direction reversed", "the answer points toward the surface", -refracted
    mirrored = np.where(exact.transmitted[:, None], flipped(a), np.nan)
    yield "reflected instead of refracted", "the answer is the mirror direction", mirrored

    tangent = a - c * n
    length = lengths(tangent).astype(float)[:, None]
    theta = np.arctan2(length, np.abs(c))
    for change, text in ((np.degrees, "turned into degrees"), (np.radians, "taken for degrees")):
        for angle, variant in (
            (change(np.arcsin(k[:, None] * np.sin(theta))), f"the angle of refraction was {text}"),
            (np.arcsin(k[:, None] * np.sin(change(theta))), f"the angle of incidence was {text}"),
        ):
            b = np.cos(angle) * np.sign(c) * n + np.sin(angle) * tangent / np.where(length > 0, length, 1)
            yield "degrees and radians", variant, b

    # Signed permutations of the axes, except the identity and −1: reversing all three axes is a mistake of its own.
    for order, signs in itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3)):
        if order == (0, 1, 2) and len(set(signs)) == 1:
            continue
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        name = ", ".join(f"{'-' if s < 0 else ''}{'xyz'[i]}" for i, s in zip(order, signs, strict=True))
        yield "handedness", f"the answer's x, y, z are the right answer's {name}", refracted @ matrix.T
        for vector, (read_a, read_n) in {"a": (a @ matrix.T, n), "n": (a, n @ matrix.T)}.items():
            # Programs differ if the normal is then on the other side.
            same_side = (read_a * read_n).sum(1, keepdims=True) * c > 0
            misread = np.where(same_side, refract(read_a, read_n, k), np.nan)
            yield "handedness", f"{vector} was read as its {name}", misread

    # The textbook formula, which is right for unit vectors only, with the vectors as they are in the rays.
    raw_a, raw_n = rays.a.astype(float), rays.n.astype(float)
    for names, x, y in (("a and n were", raw_a, raw_n), ("a was", raw_a, n), ("n was", a, raw_n)):
        radicand, along = 1 - k[:, None] ** 2 * (1 - (x * y).sum(1, keepdims=True) ** 2), (x * y).sum(1, keepdims=True)
        b = k[:, None] * x + y * (np.copysign(np.sqrt(radicand), along) - k[:, None] * along)
        yield LENGTHS, f"{names} taken for {'unit vectors' if ' and ' in names else 'a unit vector'}", unit(b)


# Comparison with the answers ---------------------------------------------------------------------------------------


def sample(table: Table) -> Index:
    """Rows of wrong and of right answers, evenly over the set, without rays whose bound allows large errors."""
    wrong = table["beyond_bound"]
    return np.concatenate([evenly(table["evidence"] & mask) for mask in (wrong, ~wrong)])


def evenly(mask: Flags) -> Index:
    """At most SAMPLE rows of the mask, evenly over it."""
    rows = np.flatnonzero(mask)
    return rows[:: max(1, -(-len(rows) // SAMPLE))]


def explain(judged: JudgedAnswers, table: Table, printed: Array) -> list[Explanation]:
    """Every mistake with the share of the answers that it explains. Precondition: some answers are wrong.

    `judged`: the answers of `sample(table)`; `table`: of all answers; `printed` (M, 3): answers as read from the file.
    """
    bounds, wrong = judged.verdict.bounds, judged.verdict.wrong
    roundoff, best = bounds.roundoff, dict[str, Explanation]()
    with np.errstate(all="ignore"):
        for name, text, predicted in predictions(bounds.rays, bounds.exact):
            visible = _angle(predicted, bounds.exact.direction) > VISIBLE
            angles = np.nan_to_num(_angle(judged.b, predicted), nan=np.inf)
            visible_angles = angles[visible]
            share = float(np.mean(visible_angles <= SAME)) if len(visible_angles) else 0.0
            wrong_angles = angles[wrong & np.isfinite(predicted).all(1)]
            enough = share >= MOST and (wrong_angles <= SAME).sum() >= HALF * len(wrong_angles)
            median = float(np.median(visible_angles)) if len(visible_angles) else math.nan
            explains = bool((visible & wrong).sum() >= FEWEST and enough)
            variant = Explanation(name, text, share, median, explains)
            best[name] = max(best.get(name, variant), variant, key=_strength)
    lengths_only = _loss(LENGTHS, "directions are right, but not of length 1", table, "lengths")
    best[LENGTHS] = max(best[LENGTHS], lengths_only, key=_strength)
    # float32 where float64 was claimed: nearly all errors have the size of float32's, and none is larger.
    everywhere = roundoff < F32 and _median_angle(table, table["compared"]) > F32 / 50
    float32 = _loss(FLOAT32, "errors are those of float32", table, "float32", everywhere)
    # Too few digits: rounding to them does not change any number, whole numbers aside.
    digits = Explanation(FEW_DIGITS, "numbers have all their digits", 0.0, math.nan, False)
    values = printed.ravel()
    values = values[np.rint(values) != values].tolist()
    candidates = range(1, TELLING_DIGITS[roundoff] + 1) if len(values) >= FEWEST else range(0)
    for count, (form, word) in itertools.product(candidates, (("f", "decimals"), ("g", "significant digits"))):
        if all(float(f"{x:.{count}{form}}") == x for x in values):
            digits = _loss(FEW_DIGITS, f"numbers are rounded to {count} {word}", table, "digits", least=count)
            break
    # Numbers of few digits may also be within the bound of float32.
    float32 = replace(float32, explains=float32.explains and not digits.explains)
    return [*best.values(), *([float32] if roundoff < F32 else []), digits]


def _strength(explanation: Explanation) -> tuple[bool, float]:
    return explanation.explains, explanation.share


def _angle(u: Array, v: Array) -> Array:
    """(N,) the angle between vectors (N, 3) of any length, in radians; NaN if one of them is zero or not finite."""
    across, along = lengths(np.cross(u, v)).astype(float), (u * v).sum(1)
    return np.where((across == 0) & (along == 0), np.nan, np.arctan2(across, along))


def _loss(name: str, text: str, table: Table, column: str, possible: bool = True, least: int = 1) -> Explanation:
    """A loss of precision, which explains the wrong answers whose number in `column` is `least` or more."""
    wrong = table["wrong"]
    count, total = int((table[column][wrong] >= least).sum()), int(wrong.sum())
    explains = bool(possible and count >= ALL * total and total >= FEWEST)
    return Explanation(name, text, count / total, _median_angle(table, wrong), explains)


def _median_angle(table: Table, mask: Flags) -> float:
    """The median angle of the compared directions in the mask; NaN if there are none."""
    angles = table["angle"][table["compared"] & mask]
    return float(np.median(angles)) if len(angles) else math.nan
