"""Errors of the answers to a ray set, and the signal of total internal reflection that they use."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from mi_refract import oracle
from mi_refract.accuracy import Judgement, RayBounds, backward_error, judge
from mi_refract.formulas import FORMULAS, ROUNDING, Budget
from mi_refract.regimes import Rays

from . import certain_parts, tir_signal
from .header import PRECISIONS
from .tir_signal import LOOSEST

RIGHT = 4.0  # in u: what rounding a, n and k, and a few operations on them, leaves of an answer's backward error


@dataclass(frozen=True)
class JudgedAnswers:
    """Answers (N, 3) as given and in the set's precision, how they signal TIR, and the verdict on each.

    `signals`: how many rays give each signal; None unless they were counted.

    `impossible`: (N,) where the error bound excuses the direction, and no documented formula gives it all the same.
    `reflected`: (N,) which rays they call totally reflected. `most_backward`: in u, beyond which an answer is wrong.
    """

    raw: np.ndarray
    b: np.ndarray
    tir: str
    verdict: Judgement
    impossible: np.ndarray
    reflected: np.ndarray
    most_backward: float = np.inf
    signals: tir_signal.Signals | None = None

    @property
    def undecidable(self) -> np.ndarray:
        """(N,) where the error bound is so wide that the direction shows nothing."""
        return self.verdict.bounds.chord > certain_parts.UNDECIDABLE

    @property
    def wrong(self) -> np.ndarray:
        """(N,) the wrong answers."""
        return self.verdict.wrong | self.impossible | ~(self.backward <= self.most_backward)

    @property
    def right(self) -> np.ndarray:
        """(N,) the exact refraction of inputs within RIGHT roundings of those given."""
        return ~self.wrong & (self.backward <= RIGHT)

    @functools.cached_property
    def backward(self) -> np.ndarray:
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
    def rounded_exact(self) -> np.ndarray:
        """(N,) where rounding the exact answer could have given this one."""
        return self.verdict.meets(ROUNDING)


def judge_answers(
    b: np.ndarray,
    flag: np.ndarray | None,
    rays: Rays,
    precision: str,
    budget: Budget,
    tir: str = tir_signal.AUTO,
    *,
    counted: bool = False,
    most_backward: float = np.inf,
) -> JudgedAnswers:
    """Compare `b` (N, 3) with the certified answers, within `budget`.

    `flag`: the column `transmitted` (N,), if there is one. `precision`: f32 or f64. `tir`: one of TIR, or AUTO.
    `counted`: count the rays of each signal. `most_backward`: in u, the largest backward error of an answer that is
    not wrong.
    """
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    bounds = RayBounds(rays, exact, budget, float(np.finfo(PRECISIONS[precision]).eps) / 2, normalised=True)
    with np.errstate(over="ignore"):
        rounded = b.astype(PRECISIONS[precision]).astype(np.float64)
    seen = tir_signal.SeenAnswers(rounded, rays, exact, bounds.roundoff)
    if tir == tir_signal.AUTO and flag is not None:
        tir = tir_signal.FLAG
    signals = tir_signal.count(seen) if counted or tir == tir_signal.AUTO else None
    if tir == tir_signal.AUTO and signals:
        tir = signals.signal
    reflected = tir_signal.reflected(seen, flag, tir, bounds.decided)
    blank = ~seen.is_direction & (~reflected | tir_signal.has_direction(tir))
    directed = exact.transmitted | (tir == "reflected")
    verdict = judge(rounded, ~reflected, bounds, directed, blank)
    impossible = _impossible(seen, reflected, tir, verdict)
    return JudgedAnswers(b, rounded, tir, verdict, impossible, reflected, most_backward, signals)


def _impossible(seen: tir_signal.SeenAnswers, reflected: np.ndarray, tir: str, verdict: Judgement) -> np.ndarray:
    """(N,) of the directions that `verdict` does not compare, or under a wide bound only, those that cannot be."""
    excused = ~verdict.compared | (verdict.bounds.chord > certain_parts.UNDECIDABLE)
    asked = seen.is_direction & excused & ~seen.exact.undecided
    bounds = replace(verdict.bounds, budget=FORMULAS[LOOSEST].budget)
    found = np.zeros(len(asked), bool)
    for mask, test in (
        (asked & ~reflected, certain_parts.possible),
        (asked & reflected & (tir == "tangent"), certain_parts.possible_tangent),
        (asked & reflected & (tir == "reflected"), certain_parts.possible_mirror),
    ):
        some = np.flatnonzero(mask)
        found[some] = ~test(seen.b, bounds, some)
    return found
