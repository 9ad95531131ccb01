"""Named, replayable sets of rays over the whole domain: easy ones, and those on which formulas lose accuracy.

In: the name of a regime, a count, a precision and a seed; the same give the same rays. Out: `Rays`, numpy arrays in
that precision. A regime builds its rays around given normals; `make` rounds them and returns the rounded rays.
`make_given` takes ratios of indices in place of a regime's own. No regime holds NaN or infinity, which are no
refraction.
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
