"""Named, reproducible sets of rays over the whole domain: easy ones, and those on which formulas lose accuracy.

Input: the name of a regime, a count, a precision and a seed; equal arguments give equal rays, in float64 only on
processors with the same instructions. Output: `Rays`, numpy arrays in that precision. A regime builds its rays around
normals; `make` rounds them and returns the rounded rays. `make_given` uses given ratios of indices instead of the
regime's own. No regime contains NaN or infinity.
"""

from .angles import Draw, rays_at
from .rays import Array, Index, Rays, Triple, normalised, radicand, radicand_and_gradient
from .table import REGIMES, Regime, make, make_given

__all__ = [
    "REGIMES",
    "Array",
    "Draw",
    "Index",
    "Rays",
    "Regime",
    "Triple",
    "make",
    "make_given",
    "normalised",
    "radicand",
    "radicand_and_gradient",
    "rays_at",
]
