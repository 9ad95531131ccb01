"""FORMULAS, the table of all formulas with sources and error bounds; the plugin, tests, timing and README use it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from mi_refract.numerics import Number, Vector3, as_component, ieee_quotients, scale_to_unit

from .bounds import CONTRASTING, ROUNDING, Budget, cancelling
from .documented import refract_cross, refract_decomposed, refract_rotated, refract_wedge, refract_wedge_contrast
from .well_conditioned import LocalCosines, Refracted, refract_compensated, refract_promoted

# The range of k that every formula takes. One end is the inverse of the other, for both directions through a boundary.
# Within it k², κ and Fresnel's terms neither over- nor underflow. In float32
#   promoted     k a + n (n·b − k n·a)/n² cancels: with v = 2⁻⁵³, the error of n·a is 2v, of the difference v, of n²
#                1.5v, of the quotient v. So that of b is at most 5.5 k v: 0.011u for k = 2²⁰, 0.9u for 8.5e7. ROUNDING
#                allows 0.0064u, less than the sum of these bounds; but of 2·10⁷ rays with k ≈ 2²⁰, chosen for the worst
#                rounding, none has a total error above 0.863u.
#   decomposed   k n·a − s √… loses the root if it is below ulp(k)/2: b may be 0 at normal incidence from 2²⁴ on.
SMALLEST_RATIO = 2.0**-20  # smallest k that a formula takes
LARGEST_RATIO = 2.0**20  # largest k that a formula takes


@dataclass(frozen=True)
class Formula:
    """A formula of refraction, `entry(a, n, k) -> (b, transmitted)`, with its source and its error budget.

    `source`: document and equation. `takes_contrast`, `takes_local`: whether the function takes these arguments.
    `scales`: whether its input must be scaled to lengths near 1. `time_goal`: the time limit per float32 ray on a CPU,
    as a multiple of the plain form's.
    """

    function: Callable[..., Refracted]
    source: str
    equation: str
    budget: Budget
    takes_contrast: bool = False
    takes_local: bool = False
    scales: bool = False
    time_goal: float | None = None

    def __call__(self, a: Vector3, n: Vector3, k: Number, contrast: Number = None) -> Refracted:
        """The refracted directions b (3,) of rays `a` (3,) at normals `n` (3,), and whether each is transmitted.

        Dr.Jit arrays of one backend and precision; `k` = n_from / n_to may be a number. `contrast`: κ = k² − 1, if it
        is known more accurately than from k. Invalid input gives NaN and False without an error: `a` or `n` zero or not
        finite, `k` outside 2⁻²⁰ … 2²⁰, `contrast` not finite or not above −1.
        """
        if dr.is_jit_v(a) and any(dr.is_diff_v(x) for x in (n, k, contrast) if x is not None):
            differentiable: Any = dr.diff_array_t(type(a))
            a = differentiable(a)  # it may have a type without derivatives
        n, k = type(a)(n), as_component(a, k)
        scale: Any = 1
        if self.scales:
            (a, scale), (n, _) = scale_to_unit(a), scale_to_unit(n)
        with ieee_quotients(a):
            b, transmitted = self.unchecked(a, n, k, contrast)
        # `b` has the length of `a`, and a zero or non-finite `n` makes it NaN: its length shows whether both are valid.
        b, length2 = b * scale, dr.dot(b, b)
        valid = (k >= SMALLEST_RATIO) & (k <= LARGEST_RATIO) & (length2 > 0) & (length2 < dr.inf)
        if contrast is not None:
            valid &= (contrast > -1) & (contrast < dr.inf)
        return dr.select(valid, b, dr.nan), valid & transmitted

    def unchecked(
        self, a: Vector3, n: Vector3, k: Number, contrast: Number = None, local: LocalCosines | None = None
    ) -> Refracted:
        """The formula without the checks of `__call__`, which are its precondition.

        NaN in `a` or `n` gives NaN and False; for a `k` that is NaN the ray is reflected.

        `local`: the cosines of a float32 ray, if `n` is the literal z axis and the caller has computed them already.
        """
        if self.takes_local:
            return self.function(a, n, k, contrast, local)
        return self.function(a, n, k, contrast) if self.takes_contrast else self.function(a, n, k)


# Every formula by its name.
FORMULAS = {
    "wedge": Formula(refract_wedge, "000, boxed", "b = k n(n∧a) + s n √(a² + k²(n∧a)²)", budget=cancelling(1)),
    "wedge_contrast": Formula(
        refract_wedge_contrast, "000, last form", "b = k n(n∧a) + s n √((n·a)² + (n∧a)²(k² − 1))", budget=CONTRASTING
    ),
    "cross": Formula(refract_cross, "001, eq. 6", "t = n×c + s √(1 − ‖c‖²) n, c = k (i×n)", budget=cancelling(1)),
    "decomposed": Formula(
        refract_decomposed, "002, eq. 1", "b = k a − n (k c − s √(1 − k²(1 − c²))), c = n·a", budget=cancelling(2)
    ),
    "rotated": Formula(refract_rotated, "004", "b = B (s √(1 − X²), X), X = k R/√(1 + R²)", budget=cancelling(1)),
    "compensated": Formula(
        refract_compensated,
        "this project",
        "b = (k w×n + s n √((n·a)² − κ w²))/n², w = n×a, κ = k² − 1; error-free transforms",
        budget=ROUNDING,
        takes_contrast=True,
        scales=True,
        time_goal=2.0,
    ),
    "promoted": Formula(
        refract_promoted,
        "this project",
        "the form of `compensated`, one precision up, rounded once",
        budget=ROUNDING,
        takes_contrast=True,
        takes_local=True,
        time_goal=1.1,
    ),
}


# The formula for "auto": the cheapest at the rounding limit in a local frame, where the normal is a literal axis.
# Fresnel's equations need everything that it computes in float64, so it is also the cheapest on GPUs with slow float64.
AUTOMATIC = "promoted"


def resolve(name: str) -> tuple[str, Formula]:
    """The key and entry behind `name`, a key of FORMULAS or "auto". ValueError otherwise."""
    key = AUTOMATIC if name == "auto" else name
    if key not in FORMULAS:
        raise ValueError(f"formula = {name!r}: unknown; expected auto, {', '.join(FORMULAS)}")
    return key, FORMULAS[key]
