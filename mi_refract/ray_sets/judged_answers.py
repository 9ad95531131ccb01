"""Errors of the answers to a ray set, for one signal of total internal reflection.

Even if the error bound is too wide to judge a direction, rounding of a documented formula can give only some
directions: its error is at most L = linear u K in any direction, plus that of the root along the normal (see
`mi_refract.formulas.bounds`). With t the direction of `a` along the surface, m the normal on the side that the
transmitted ray goes to, and D = cos²θ_t, its answer for any length s > 0 is

    b = s (k sinθ t + r m + δ),   |δ| ≤ L,   r ≥ 0,   |r² − D| ≤ x

So b is in the plane of incidence, forward, and not on the side that the ray came from, for any x. A vector along the
surface that signals total internal reflection is in that plane and forward; a mirror direction is fully determined.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract import oracle
from mi_refract.accuracy import Judgement, RayBounds, backward_error, judge, lengths
from mi_refract.formulas import FORMULAS, ROUNDING, TEXTBOOK_BACKWARD, Budget
from mi_refract.regimes import Array, Rays

from . import tir_signal
from .header import PRECISIONS
from .tir_signal import LOOSEST, ComparedAnswers, Flags

Index = NDArray[np.intp]
Table = NDArray[np.void]  # a row for each ray, with named columns

UNDECIDABLE = 0.1  # radians: a direction with a larger bound is not judged
WIDEST_BOUND = 1e-3  # radians: an answer with a wider bound is no evidence of a mistake
RIGHT = TEXTBOOK_BACKWARD  # in u: the largest backward error of a right answer
F32 = 2.0**-24
MOST_DIGITS = 15


@dataclass(frozen=True)
class JudgedAnswers:
    """Answers b (N, 3) in the set's precision, and the verdict on each. Other arrays are (N,).

    `impossible`: whether no documented formula gives the direction, though the error bound allows it. `backward`: the
    backward error, in u, of the direction, or of the decision if a transmitted ray is classified as reflected.
    `backward_length`: the backward error of the length, in u; 0 if no length is judged. `most_backward`: in u; an
    answer with a larger backward error is wrong.
    """

    b: Array
    verdict: Judgement
    impossible: Flags
    backward: Array
    backward_length: Array
    most_backward: float = np.inf

    def backward_within(self, most: float) -> Flags:
        """Whether the backward errors of the direction or decision and of the length are at most `most`, in u."""
        return np.asarray(np.maximum(self.backward, self.backward_length) <= most)

    @property
    def wrong(self) -> Flags:
        """Whether each answer is wrong."""
        return self.verdict.wrong | self.impossible | ~self.backward_within(self.most_backward)

    @property
    def table(self) -> Table:
        """A row for each ray: its errors as in `Judgement`, the class of the answer, and whether a loss of precision
        explains it: vectors that are not unit (`lengths`), float32, or numbers of up to `digits` digits.
        """
        verdict, bounds, zero, wrong = self.verdict, self.verdict.bounds, ~self.b.any(axis=1), self.wrong
        undecidable = bounds.chord > UNDECIDABLE
        single = replace(verdict, bounds=replace(bounds, roundoff=2 * F32))  # u from the inputs, u from the formula
        excess = np.maximum(verdict.error - bounds.chord, verdict.drift - bounds.length)
        within_digits = verdict.compared & (excess <= 10.0 ** -np.arange(1, MOST_DIGITS + 1)[:, None])
        columns: dict[str, NDArray[Any]] = {
            "angle": verdict.angle,
            "drift": verdict.drift,
            "share": verdict.share,
            "backward": self.backward,
            "backward_length": self.backward_length,
            "compared": verdict.compared,
            "blank": verdict.blank,
            "non-finite": verdict.blank & ~zero,
            "zero": verdict.blank & zero,
            "impossible": self.impossible,
            "tir_misclassified": verdict.misjudged,
            "tir_beyond_bound": verdict.far,
            "undecidable": undecidable,
            "judged": verdict.compared & ~undecidable,
            "evidence": bounds.decided & (bounds.chord <= WIDEST_BOUND),
            "beyond_bound": verdict.wrong,
            "wrong": wrong,
            "right": ~wrong & self.backward_within(RIGHT),
            "exact": verdict.meets(ROUNDING),
            "digits": np.where(verdict.wrong, within_digits.sum(0), MOST_DIGITS).astype(np.int8),
            "float32": ~single.wrong,
            "lengths": verdict.wrong & verdict.compared & (verdict.angle <= bounds.chord),
        }
        table = np.empty(len(self.b), [(name, column.dtype) for name, column in columns.items()])
        for name, column in columns.items():
            table[name] = column
        return table


def certified(rays: Rays) -> oracle.Certified:
    """The exact answers without Fresnel's terms, which take half of the memory."""
    terms = ("reflectance", "reflectance_low", "transmittance", "transmittance_low", "amplitude_s", "amplitude_p")
    empty_terms: dict[str, Any] = dict.fromkeys(terms, np.empty(0))
    return replace(oracle.refract(rays.a, rays.n, rays.k, fresnel=False), **empty_terms)


def pair_with_exact(b: Array, rays: Rays, precision: str, exact: oracle.Certified) -> ComparedAnswers:
    """Answers `b` (N, 3), rounded to f32 or f64, with the exact ones."""
    with np.errstate(over="ignore"):
        rounded = b.astype(PRECISIONS[precision]).astype(np.float64)
    return ComparedAnswers(rounded, rays, exact, float(np.finfo(PRECISIONS[precision]).eps) / 2)


def judge_answers(
    b: Array,
    transmitted: Flags | None,
    rays: Rays,
    precision: str,
    budget: Budget,
    tir: str,
    *,
    exact: oracle.Certified | None = None,
    most_backward: float = np.inf,
) -> JudgedAnswers:
    """Compare `b` (N, 3) with the certified answers within `budget`.

    `transmitted`: the column of that name (N,), if it exists. `precision`: f32 or f64. `tir`: the signal of total
    internal reflection. `exact`: the certified answers, if they are known. `most_backward`: in u; an answer with a
    larger backward error is wrong.
    """
    compared = pair_with_exact(b, rays, precision, exact or certified(rays))
    transmits = compared.exact.transmitted
    bounds = RayBounds(rays, compared.exact, budget, compared.u, normalised=True)
    reflected = tir_signal.reflected(compared, transmitted, tir, bounds.decided)
    # Zeros and NaN count as no answer, unless they signal total internal reflection.
    blank = ~compared.is_direction & (~reflected | (tir in ("reflected", "tangent")))
    verdict = judge(compared.b, ~reflected, bounds, transmits | (tir == "reflected"), blank)

    mirror, lost = reflected & (tir == "reflected"), reflected & transmits
    error, length = np.zeros((2, len(compared.b)))
    directed = (~reflected | (mirror & ~transmits)) & ~blank
    directions = compared.b[directed], rays[directed], mirror[directed]
    error[directed] = backward_error.of_directions(*directions)
    length[directed] = backward_error.of_lengths(*directions)
    error[lost] = backward_error.of_decisions(rays[lost])
    with np.errstate(over="ignore"):
        backward, backward_length = np.where(blank, np.inf, error / compared.u), length / compared.u

    loosest, impossible = replace(bounds, budget=FORMULAS[LOOSEST].budget), np.zeros(len(error), bool)
    for mask, signal in ((~reflected, ""), (reflected & (tir == "tangent"), tir), (mirror, tir)):
        rows = np.flatnonzero(compared.is_direction & mask)
        impossible[rows] = ~possible(compared.b, loosest, rows, signal)
    return JudgedAnswers(compared.b, verdict, impossible, backward, backward_length, most_backward)


def possible(b: Array, bounds: RayBounds, rows: Index, signal: str = "") -> Flags:
    """(M,) whether rounding of a documented formula can give the answers of `b` (N, 3) to the rays `rows` (M indices).

    `signal`: "tangent" or "reflected" if the directions signal total internal reflection; "" for transmitted ones.
    """
    # The components of b and of `a` along t, along m, and across both, in extended precision.
    a, n, b = (backward_error.unit(v[rows]) for v in (bounds.rays.a, bounds.rays.n, b))
    c = (a * n).sum(1, keepdims=True)
    m, tangent = np.where(c < 0, -n, n), a - c * n
    sine, cosine = lengths(tangent), np.abs(c[:, 0])
    t = tangent / np.where(sine > 0, sine, 1)[:, None]
    onward = (b * m).sum(1)
    tangential = b - onward[:, None] * m  # m before t: near the normal, t is orthogonal to m only up to rounding
    along = (tangential * t).sum(1)
    across = lengths(tangential - along[:, None] * t)

    u, k, exact = bounds.u[rows], bounds.k[rows], bounds.exact
    slack = np.asarray(bounds.budget.of_terms(u, np.minimum(k, 1.0) if signal == "reflected" else k))
    with np.errstate(invalid="ignore", divide="ignore"):
        if signal == "tangent":
            e = size = k * sine
            distance, forward = e * across / np.hypot(along, across), along
        elif signal == "reflected":
            size = np.ones(len(rows))
            distance = np.sqrt(across**2 + (sine * onward + cosine * along) ** 2)
            forward = sine * along - cosine * onward
        else:
            e = k * sine
            root2 = np.where(exact.transmitted[rows], exact.cos_t[rows] ** 2, 1 - e * e)
            x = bounds.budget.radicand_error_bound(u, k)
            low, high = (np.sqrt(np.maximum(root2 + sign * x, 0)) for sign in (-1, 1))
            onward = np.where(bounds.budget.side_open(u, exact.cos_i[rows]), np.abs(onward), onward)
            tangential2 = along**2 + across**2
            nearest = np.where(tangential2 > 0, e * onward * along / tangential2, low).clip(low, high)
            distance = np.sqrt((nearest**2 + e * e) * across**2 + (e * onward - nearest * along) ** 2)
            forward, size = e * along + nearest * onward, np.hypot(e, nearest)
        # Possible if a vector of this size is within `slack` of the line of b, and b does not point away from it.
        return np.asarray((size <= slack) | (distance <= slack) & (forward > 0))
