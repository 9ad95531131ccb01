"""Errors of the answers to a ray set, for one signal of total internal reflection.

Where the error bound is too wide to judge a direction, rounding of a documented formula still gives only some: it is
off by L = linear u K in any direction, and by its root along the normal (see `mi_refract.formulas.bounds`). With t the
direction of `a` along the surface, m the normal on the side that the transmitted ray goes to, D = cos²θ_t, it answers,
at any length s > 0,

    b = s (k sinθ t + r m + δ),   |δ| ≤ L,   r ≥ 0,   |r² − D| ≤ x

So b is in the plane of incidence, forward, and not on the side that the ray came from, whatever x is. A vector along
the surface that signals total internal reflection is in that plane and forward; a mirror direction is known entirely.
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
from .tir_signal import LOOSEST, SeenAnswers

Flags = NDArray[np.bool_]
Index = NDArray[np.intp]
Table = NDArray[np.void]  # a row for each ray, of named columns

UNDECIDABLE = 0.1  # radians: a direction is not judged where its bound is larger
WIDEST_BOUND = 1e-3  # radians: under a wider bound an answer is no evidence of a mistake
RIGHT = TEXTBOOK_BACKWARD  # in u: the largest backward error of a right answer
F32 = 2.0**-24
MOST_DIGITS = 15


@dataclass(frozen=True)
class JudgedAnswers:
    """Answers b (N, 3) in the set's precision, and the verdict on each. Arrays are (N,).

    `impossible`: the error bound excuses the direction, and no documented formula gives it all the same. `backward`:
    backward errors in u, of the direction; of the decision, where a transmitted ray is called reflected.
    `backward_length`: those of the length, 0 where none is judged. `most_backward`: in u, beyond which an answer is
    wrong.
    """

    b: Array
    verdict: Judgement
    impossible: Flags
    backward: Array
    backward_length: Array
    most_backward: float = np.inf

    def backward_within(self, most: float) -> Flags:
        """Whether the backward errors of direction, or decision, and length are at most this, in u."""
        return np.asarray(np.maximum(self.backward, self.backward_length) <= most)

    @property
    def wrong(self) -> Flags:
        """The wrong answers."""
        return self.verdict.wrong | self.impossible | ~self.backward_within(self.most_backward)

    @property
    def table(self) -> Table:
        """What is kept of each ray: errors as of `Judgement`, which of these an answer is, and which of them a loss of
        precision could have left: of vectors not unit, of float32, of numbers of up to `digits` digits.
        """
        verdict, bounds, zero, wrong = self.verdict, self.verdict.bounds, ~self.b.any(axis=1), self.wrong
        undecidable = bounds.chord > UNDECIDABLE
        single = replace(verdict, bounds=replace(bounds, roundoff=2 * F32))  # u of the inputs, u of the formula
        rest = np.maximum(verdict.error - bounds.chord, verdict.drift - bounds.length)
        printed = verdict.compared & (rest <= 10.0 ** -np.arange(1, MOST_DIGITS + 1)[:, None])
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
            "digits": np.where(verdict.wrong, printed.sum(0), MOST_DIGITS).astype(np.int8),
            "float32": ~single.wrong,
            "lengths": verdict.wrong & verdict.compared & (verdict.angle <= bounds.chord),
        }
        table = np.empty(len(self.b), [(name, column.dtype) for name, column in columns.items()])
        for name, column in columns.items():
            table[name] = column
        return table


def certified(rays: Rays) -> oracle.Certified:
    """The exact answers, without Fresnel's terms, which take half of the memory."""
    terms = ("reflectance", "reflectance_low", "transmittance", "transmittance_low", "amplitude_s", "amplitude_p")
    none: dict[str, Any] = dict.fromkeys(terms, np.empty(0))
    return replace(oracle.refract(rays.a, rays.n, rays.k, fresnel=False), **none)


def see(b: Array, rays: Rays, precision: str, exact: oracle.Certified) -> SeenAnswers:
    """Answers `b` (N, 3), rounded to f32 or f64, beside the exact ones."""
    with np.errstate(over="ignore"):
        rounded = b.astype(PRECISIONS[precision]).astype(np.float64)
    return SeenAnswers(rounded, rays, exact, float(np.finfo(PRECISIONS[precision]).eps) / 2)


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
    """Compare `b` (N, 3) with the certified answers, within `budget`.

    `transmitted`: the column of that name (N,), if there is one. `precision`: f32 or f64. `tir`: how total internal
    reflection is signalled. `exact`: the certified answers, where they are known. `most_backward`: in u, the largest
    backward error of an answer that is not wrong.
    """
    seen = see(b, rays, precision, exact or certified(rays))
    transmits = seen.exact.transmitted
    bounds = RayBounds(rays, seen.exact, budget, seen.u, normalised=True)
    reflected = tir_signal.reflected(seen, transmitted, tir, bounds.decided)
    # Zeros and NaN are no answer, unless they signal total internal reflection.
    blank = ~seen.is_direction & (~reflected | (tir in ("reflected", "tangent")))
    verdict = judge(seen.b, ~reflected, bounds, transmits | (tir == "reflected"), blank)

    mirror, lost = reflected & (tir == "reflected"), reflected & transmits
    error, length = np.zeros((2, len(seen.b)))
    directed = (~reflected | (mirror & ~transmits)) & ~blank
    of_directed = seen.b[directed], rays[directed], mirror[directed]
    error[directed], length[directed] = (
        backward_error.of_directions(*of_directed),
        backward_error.of_lengths(*of_directed),
    )
    error[lost] = backward_error.of_decisions(rays[lost])
    with np.errstate(over="ignore"):
        backward, backward_length = np.where(blank, np.inf, error / seen.u), length / seen.u

    loosest, impossible = replace(bounds, budget=FORMULAS[LOOSEST].budget), np.zeros(len(error), bool)
    for mask, signal in ((~reflected, ""), (reflected & (tir == "tangent"), tir), (mirror, tir)):
        some = np.flatnonzero(seen.is_direction & mask)
        impossible[some] = ~possible(seen.b, loosest, some, signal)
    return JudgedAnswers(seen.b, verdict, impossible, backward, backward_length, most_backward)


def possible(b: Array, bounds: RayBounds, some: Index, signal: str = "") -> Flags:
    """(M,) the answers of `b` (N, 3) to the rays `some` (M indices) that rounding of a formula may give.

    `signal`: how they signal total internal reflection, "tangent" or "reflected"; of transmitted directions "".
    """
    # The parts of b and of `a` along t, along m, and across both, in extended precision.
    # Divided first by the largest component: squares of the least numbers would be 0.
    vectors = (v[some].astype(np.longdouble) for v in (bounds.rays.a, bounds.rays.n, b))
    vectors = (v / np.abs(v).max(1, keepdims=True, initial=0) for v in vectors)
    a, n, b = (v / lengths(v)[:, None] for v in vectors)
    c = (a * n).sum(1, keepdims=True)
    m, tangent = np.where(c < 0, -n, n), a - c * n
    sine, cosine = lengths(tangent), np.abs(c[:, 0])
    t = tangent / np.where(sine > 0, sine, 1)[:, None]
    onward = (b * m).sum(1)
    rest = b - onward[:, None] * m  # first: next to the normal, t is not orthogonal to m to the last digit
    along = (rest * t).sum(1)
    across = lengths(rest - along[:, None] * t)

    u, k, exact = bounds.u[some], bounds.k[some], bounds.exact
    slack = np.asarray(bounds.budget.of_terms(u, np.minimum(k, 1.0) if signal == "reflected" else k))
    with np.errstate(invalid="ignore", divide="ignore"):
        if signal == "tangent":
            e = size = k * sine
            off, forward = e * across / np.hypot(along, across), along
        elif signal == "reflected":
            size = np.ones(len(some))
            off = np.sqrt(across**2 + (sine * onward + cosine * along) ** 2)
            forward = sine * along - cosine * onward
        else:
            e = k * sine
            root2 = np.where(exact.transmitted[some], exact.cos_t[some] ** 2, 1 - e * e)
            x = bounds.budget.radicand_error_bound(u, k)
            low, high = (np.sqrt(np.maximum(root2 + sign * x, 0)) for sign in (-1, 1))
            onward = np.where(bounds.budget.side_open(u, exact.cos_i[some]), np.abs(onward), onward)
            plane = along**2 + across**2
            nearest = np.where(plane > 0, e * onward * along / plane, low).clip(low, high)
            off = np.sqrt((nearest**2 + e * e) * across**2 + (e * onward - nearest * along) ** 2)
            forward, size = e * along + nearest * onward, np.hypot(e, nearest)
        # A vector of this size is within `slack` of the line of b, and b does not point away from it.
        return np.asarray((size <= slack) | (off <= slack) & (forward > 0))
