"""Errors of the answers to a ray set, and the signal of total internal reflection that they use."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract import oracle
from mi_refract.accuracy import Judgement, RayBounds, backward_error, judge
from mi_refract.formulas import FORMULAS, ROUNDING, Budget
from mi_refract.regimes import Array, Rays

from . import possible_directions, tir_signal
from .header import PRECISIONS
from .tir_signal import LOOSEST

Flags = NDArray[np.bool_]
Table = NDArray[np.void]  # a row for each ray, of named columns

WIDEST_BOUND = 1e-3  # radians: under a wider bound an answer is no evidence of a mistake
_FRESNEL = ("reflectance", "reflectance_low", "transmittance", "transmittance_low", "amplitude_s", "amplitude_p")
RIGHT = 4.0  # in u: what rounding a, n and k, and a few operations on them, leaves of an answer's backward error


@dataclass(frozen=True)
class JudgedAnswers:
    """Answers (N, 3) in the set's precision, how they signal TIR, and the verdict on each.

    `impossible`: (N,) where the error bound excuses the direction, and no documented formula gives it all the same.
    `reflected`: (N,) which rays they call totally reflected. `most_backward`: in u, beyond which an answer is wrong.
    """

    b: Array
    tir: str
    verdict: Judgement
    impossible: Flags
    reflected: Flags
    most_backward: float = np.inf

    @property
    def undecidable(self) -> Flags:
        """(N,) where the error bound is so wide that the direction shows nothing."""
        return self.verdict.bounds.chord > possible_directions.UNDECIDABLE

    @property
    def wrong(self) -> Flags:
        """(N,) the wrong answers."""
        return self.verdict.wrong | self.impossible | ~(self.backward <= self.most_backward)

    @property
    def right(self) -> Flags:
        """(N,) the exact refraction of inputs within RIGHT roundings of those given."""
        return ~self.wrong & (self.backward <= RIGHT)

    @functools.cached_property
    def backward(self) -> Array:
        """(N,) backward errors in u: of the direction; of the decision, where a transmitted ray is called reflected."""
        bounds, verdict = self.verdict.bounds, self.verdict
        mirror = self.reflected & (self.tir == "reflected")
        found = np.zeros(len(self.b))
        asked = ~self.reflected | (mirror & ~bounds.exact.transmitted)
        found[asked] = backward_error.of_directions(self.b[asked], bounds.rays[asked], mirror[asked])
        lost = self.reflected & bounds.exact.transmitted
        found[lost] = backward_error.of_decisions(bounds.rays[lost])
        with np.errstate(over="ignore"):
            in_u = np.where(verdict.blank, np.inf, found / bounds.roundoff)
        return in_u

    @functools.cached_property
    def rounded_exact(self) -> Flags:
        """(N,) where rounding the exact answer could have given this one."""
        return self.verdict.meets(ROUNDING)

    @property
    def table(self) -> Table:
        """(N,) what is kept of each ray: errors as of `Judgement`, and which of these an answer is."""
        verdict, zero = self.verdict, ~self.b.any(axis=1)
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
            "undecidable": self.undecidable,
            "judged": verdict.compared & ~self.undecidable,
            "evidence": verdict.bounds.decided & (verdict.bounds.chord <= WIDEST_BOUND),
            "beyond_bound": verdict.wrong,
            "wrong": self.wrong,
            "right": self.right,
            "exact": self.rounded_exact,
        }
        table = np.empty(len(self.b), [(name, column.dtype) for name, column in columns.items()])
        for name, column in columns.items():
            table[name] = column
        return table


def certified(rays: Rays) -> oracle.Certified:
    """The exact answers, without Fresnel's terms, which are not stored."""
    exact, none = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False), np.empty(0)
    powers: dict[str, Array] = dict.fromkeys(_FRESNEL, none)
    return replace(exact, **powers)


def see(b: Array, rays: Rays, precision: str, exact: oracle.Certified) -> tir_signal.SeenAnswers:
    """Answers `b` (N, 3), rounded to f32 or f64, beside the exact ones."""
    with np.errstate(over="ignore"):
        rounded = b.astype(PRECISIONS[precision]).astype(np.float64)
    return tir_signal.SeenAnswers(rounded, rays, exact, float(np.finfo(PRECISIONS[precision]).eps) / 2)


def judge_answers(
    b: Array,
    flag: Flags | None,
    rays: Rays,
    precision: str,
    budget: Budget,
    tir: str,
    *,
    exact: oracle.Certified | None = None,
    most_backward: float = np.inf,
) -> JudgedAnswers:
    """Compare `b` (N, 3) with the certified answers, within `budget`.

    `flag`: the column `transmitted` (N,), if there is one. `precision`: f32 or f64. `tir`: how total internal
    reflection is signalled. `exact`: the certified answers, where they are known. `most_backward`: in u, the largest
    backward error of an answer that is not wrong.
    """
    seen = see(b, rays, precision, exact or certified(rays))
    bounds = RayBounds(rays, seen.exact, budget, seen.u, normalised=True)
    reflected = tir_signal.reflected(seen, flag, tir, bounds.decided)
    blank = ~seen.is_direction & (~reflected | tir_signal.has_direction(tir))
    directed = seen.exact.transmitted | (tir == "reflected")
    verdict = judge(seen.b, ~reflected, bounds, directed, blank)
    impossible = _impossible(seen, reflected, tir, verdict)
    return JudgedAnswers(seen.b, tir, verdict, impossible, reflected, most_backward)


def _impossible(seen: tir_signal.SeenAnswers, reflected: Flags, tir: str, verdict: Judgement) -> Flags:
    """(N,) of the directions that `verdict` does not compare, or under a wide bound only, those that cannot be."""
    excused = ~verdict.compared | (verdict.bounds.chord > possible_directions.UNDECIDABLE)
    asked = seen.is_direction & excused & ~seen.exact.undecided
    bounds = replace(verdict.bounds, budget=FORMULAS[LOOSEST].budget)
    found = np.zeros(len(asked), bool)
    for mask, test in (
        (asked & ~reflected, possible_directions.possible),
        (asked & reflected & (tir == "tangent"), possible_directions.possible_tangent),
        (asked & reflected & (tir == "reflected"), possible_directions.possible_mirror),
    ):
        some = np.flatnonzero(mask)
        found[some] = ~test(seen.b, bounds, some)
    return found
