"""How far directions are from the exact ones, and whether that is within their error bounds. One judge for all.

In: rays, their certified answers from the oracle, and the directions and decisions of some program or formula as numpy
arrays (`evaluate` gets them from a formula). Out: a `Judgement`, ray by ray, against the a-priori bounds of
`formulas.Budget`.
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
