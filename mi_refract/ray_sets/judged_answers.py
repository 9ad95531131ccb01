"""Errors of the answers to a ray set, and the signal of total internal reflection that they use."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from mi_refract import oracle
from mi_refract.accuracy import Judgement, RayBounds, judge
from mi_refract.formulas import ROUNDING, Budget
from mi_refract.regimes import Rays

from . import tir_signal
from .header import PRECISIONS


@dataclass(frozen=True)
class JudgedAnswers:
    """Answers (N, 3) as given and in the set's precision, how they signal TIR, and the verdict on each."""

    raw: np.ndarray
    b: np.ndarray
    tir: str
    verdict: Judgement

    @functools.cached_property
    def rounded_exact(self) -> np.ndarray:
        """(N,) where rounding the exact answer could have given this one."""
        return self.verdict.meets(ROUNDING)


def judge_answers(
    b: np.ndarray, flag: np.ndarray | None, rays: Rays, precision: str, budget: Budget, tir: str = tir_signal.AUTO
) -> JudgedAnswers:
    """Compare `b` (N, 3) with the certified answers, within `budget`.

    `flag`: the column `transmitted` (N,), if there is one. `precision`: f32 or f64. `tir`: one of TIR, or AUTO.
    """
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False)
    bounds = RayBounds(rays, exact, budget, float(np.finfo(PRECISIONS[precision]).eps) / 2, normalised=True)
    with np.errstate(over="ignore"):
        rounded = b.astype(PRECISIONS[precision]).astype(np.float64)
    seen = tir_signal.SeenAnswers(rounded, rays, exact, bounds.roundoff)
    if tir == tir_signal.AUTO:
        tir = tir_signal.detect(seen, flag)
    reflected = tir_signal.reflected(seen, flag, tir, bounds.decided)
    blank = ~seen.is_direction & (~reflected | tir_signal.has_direction(tir))
    directed = exact.transmitted | (tir == "reflected")
    return JudgedAnswers(b, rounded, tir, judge(rounded, ~reflected, bounds, directed, blank))
