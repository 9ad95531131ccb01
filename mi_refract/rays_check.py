"""Answers to a ray set against the certified ones: how far off, where, whether total internal reflection was seen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from .formulas import FORMULAS
from .rays import Answers, RaySet

# How an answer says that nothing is transmitted.
TIR = ("zero", "nan", "reflected", "tangent", "flag")
AUTO = "auto"
# The documented formula that is allowed most.
LOOSEST = max(FORMULAS, key=lambda name: (FORMULAS[name].budget.growth, FORMULAS[name].budget.radicand))


@dataclass(frozen=True)
class Figures:
    """One regime. Errors are angles to the certified direction, of the rays that were decided rightly, in radians."""

    regime: str
    rays: int
    judged: int  # rays whose direction was compared
    worst: float
    p99: float
    mean: float
    norm: float  # the largest | |b| − 1 |, or of |b|/|a| where that is less
    misjudged: int  # rays whose total internal reflection was decided wrongly
    far: int  # those of them that are farther from the critical angle than the budget leaves open
    share: float  # the largest share that an error takes of its ray's budget
    wrong: int  # rays beyond their budget: too far off, misjudged far, or without a direction
    replay: dict[str, Any]  # the worst ray, in hexadecimal floats


@dataclass(frozen=True)
class Problem:
    """What is wrong with the file, not with the refraction: `text` names the first of `count`."""

    kind: str  # "missing", "duplicate", "unknown", "non-finite"
    count: int
    text: str


@dataclass(frozen=True)
class Explanation:
    """A usual mistake, and the share of the answers (of a sample) that are what it would give, within the budget."""

    mistake: str
    text: str
    share: float
    worst: float  # angle to what it would give, radians
    explains: bool


@dataclass(frozen=True)
class Findings:
    precision: str
    ulp: float  # 2⁻²³ or 2⁻⁵²
    budget: str  # the formula whose budget was applied
    tir: str  # how total internal reflection is told; "none" where no ray has it, "unclear" where in no known way
    told: bool  # by the caller
    regimes: tuple[Figures, ...]
    problems: tuple[Problem, ...] = ()
    explanations: tuple[Explanation, ...] = ()
    context: dict[str, Any] = field(default_factory=dict)  # the ray set's header

    @property
    def diagnosis(self) -> Explanation | None:
        """The mistake that explains the answers, where exactly one does."""
        found = [each for each in self.explanations if each.explains]
        return found[0] if len(found) == 1 else None

    @property
    def exit_code(self) -> int:
        """0: all within the budget. 1: some refraction is wrong. 2: answers are missing, doubled, or to other rays."""
        if any(problem.kind in ("missing", "duplicate", "unknown") for problem in self.problems):
            return 2
        return int(any(each.wrong for each in self.regimes) or self.tir == "unclear" or bool(self.problems))


def check(rays: RaySet, answers: Answers, *, tir: str = AUTO, budget: str = LOOSEST) -> Findings:
    """Judge every answer. `tir`: one of TIR, or detected; `budget`: the formula of FORMULAS that it must be as good as.

    ValueError for an unknown name, or answers whose header says that they are to other rays.
    """
    raise NotImplementedError
