"""Errors of the answers to a ray set, for one signal of total internal reflection."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract import oracle
from mi_refract.accuracy import Judgement, RayBounds, absolute_radicand, backward_error, judge
from mi_refract.formulas import FORMULAS, ROUNDING, Budget
from mi_refract.regimes import Array, Rays

from . import possible_directions, tir_signal
from .header import PRECISIONS
from .tir_signal import LOOSEST, SeenAnswers

Flags = NDArray[np.bool_]
Table = NDArray[np.void]  # a row for each ray, of named columns

WIDEST_BOUND = 1e-3  # radians: under a wider bound an answer is no evidence of a mistake
RIGHT = 4.0  # in u: what rounding a, n and k, and a few operations on them, leaves of an answer's backward error
F32 = 2.0**-24
MOST_DIGITS = 15


@dataclass(frozen=True)
class JudgedAnswers:
    """Answers b (N, 3) in the set's precision, and the verdict on each. Arrays are (N,).

    `impossible`: the error bound excuses the direction, and no documented formula gives it all the same. `backward`:
    backward errors in u, of the direction; of the decision, where a transmitted ray is called reflected.
    `most_backward`: in u, beyond which an answer is wrong.
    """

    b: Array
    verdict: Judgement
    impossible: Flags
    backward: Array
    most_backward: float = np.inf

    @property
    def wrong(self) -> Flags:
        """The wrong answers."""
        return self.verdict.wrong | self.impossible | ~(self.backward <= self.most_backward)

    @property
    def table(self) -> Table:
        """What is kept of each ray: errors as of `Judgement`, and which of these an answer is."""
        verdict, zero, wrong = self.verdict, ~self.b.any(axis=1), self.wrong
        undecidable = verdict.bounds.chord > possible_directions.UNDECIDABLE
        columns: dict[str, NDArray[Any]] = {
            "angle": verdict.angle,
            "drift": verdict.drift,
            "share": verdict.share,
            "backward": self.backward,
            "compared": verdict.compared,
            "blank": verdict.blank,
            "non-finite": verdict.blank & ~zero,
            "zero": verdict.blank & zero,
            "impossible": self.impossible,
            "tir_misclassified": verdict.misjudged,
            "tir_beyond_bound": verdict.far,
            "undecidable": undecidable,
            "judged": verdict.compared & ~undecidable,
            "evidence": verdict.bounds.decided & (verdict.bounds.chord <= WIDEST_BOUND),
            "beyond_bound": verdict.wrong,
            "wrong": wrong,
            "right": ~wrong & (self.backward <= RIGHT),
            "exact": verdict.meets(ROUNDING),
            **_losses(verdict),
        }
        table = np.empty(len(self.b), [(name, column.dtype) for name, column in columns.items()])
        for name, column in columns.items():
            table[name] = column
        return table


def _losses(verdict: Judgement) -> dict[str, NDArray[Any]]:
    """Which errors a loss of precision could have left: vectors not unit, float32, numbers of up to `digits` digits."""
    bounds, u = verdict.bounds, 2 * F32  # u of the inputs, u of the formula
    k, exact = bounds.k, bounds.exact
    float32 = bounds.budget.chord(u, k, exact.cos_t, exact.transmitted, cos_i=exact.cos_i)
    lost = verdict.misjudged & (absolute_radicand(bounds.rays) <= bounds.budget.radicand_error_bound(u, k))
    printed = verdict.compared & (verdict.error <= bounds.chord + 10.0 ** -np.arange(1, MOST_DIGITS + 1)[:, None])
    return {
        "digits": printed.sum(0, dtype=np.int8),
        "float32": verdict.compared & (verdict.error <= float32) | lost,
        "lengths": verdict.compared & (verdict.angle <= bounds.chord),
    }


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
    bounds = RayBounds(rays, seen.exact, budget, seen.u, normalised=True)
    reflected = tir_signal.reflected(seen, transmitted, tir, bounds.decided)
    # Zeros and NaN are no answer, unless they signal total internal reflection.
    blank = ~seen.is_direction & (~reflected | (tir in ("reflected", "tangent")))
    verdict = judge(seen.b, ~reflected, bounds, seen.exact.transmitted | (tir == "reflected"), blank)
    backward = _backward(seen, reflected, tir, verdict)
    return JudgedAnswers(seen.b, verdict, _impossible(seen, reflected, tir, verdict), backward, most_backward)


def _backward(seen: SeenAnswers, reflected: Flags, tir: str, verdict: Judgement) -> Array:
    transmitted, rays = seen.exact.transmitted, seen.rays
    mirror = reflected & (tir == "reflected")
    error = np.zeros(len(seen.b))
    directed = ~reflected | (mirror & ~transmitted)
    error[directed] = backward_error.of_directions(seen.b[directed], rays[directed], mirror[directed])
    lost = reflected & transmitted
    error[lost] = backward_error.of_decisions(rays[lost])
    with np.errstate(over="ignore"):
        return np.where(verdict.blank, np.inf, error / seen.u)


def _impossible(seen: SeenAnswers, reflected: Flags, tir: str, verdict: Judgement) -> Flags:
    """(N,) of the directions that `verdict` does not compare, or under a wide bound only, those that cannot be."""
    excused = ~verdict.compared | (verdict.bounds.chord > possible_directions.UNDECIDABLE)
    candidates = seen.is_direction & excused
    bounds = replace(verdict.bounds, budget=FORMULAS[LOOSEST].budget)
    impossible = np.zeros(len(candidates), bool)
    for mask, test in (
        (candidates & ~reflected, possible_directions.possible),
        (candidates & reflected & (tir == "tangent"), possible_directions.possible_tangent),
        (candidates & reflected & (tir == "reflected"), possible_directions.possible_mirror),
    ):
        some = np.flatnonzero(mask)
        impossible[some] = ~test(seen.b, bounds, some)
    return impossible
