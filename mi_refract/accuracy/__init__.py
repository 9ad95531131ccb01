"""Errors of directions against the exact ones, and whether they are within their bounds, for formulas and programs.

Input: rays, their certified answers from the oracle, and the directions and decisions of a program or formula as numpy
arrays (`evaluate` computes them with a formula). Output: a `Judgement` with one verdict per ray, against the a-priori
bounds of `formulas.Budget`.
"""

from . import backward_error
from .judge import (
    BUDGETS,
    DirectionErrors,
    Judgement,
    RayBounds,
    Subject,
    absolute_radicand,
    arrays,
    errors,
    errors_of_normalised,
    evaluate,
    judge,
    judge_formula,
    lengths,
    relative_radicand,
)

__all__ = [
    "BUDGETS",
    "DirectionErrors",
    "Judgement",
    "RayBounds",
    "Subject",
    "absolute_radicand",
    "arrays",
    "backward_error",
    "errors",
    "errors_of_normalised",
    "evaluate",
    "judge",
    "judge_formula",
    "lengths",
    "relative_radicand",
]
