"""The formulas of refraction, Fresnel's equations, and bounds of their errors.

Input: directions `a`, normals `n` and ratios `k` as Dr.Jit arrays, in the conventions of the package's docstring.
Output: `(b, transmitted)` from the entries of FORMULAS, powers and amplitudes from `fresnel`, and from `Budget` the
largest error that each answer may have. No module here imports Mitsuba.
"""

from . import fresnel
from .bounds import NEGLIGIBLE, ROUNDING, TEXTBOOK_BACKWARD, UNIT, Budget, cancelling, radicand_for
from .documented import contract, reflect, reflect_sandwich, refract_2d, wedge
from .table import AUTOMATIC, FORMULAS, LARGEST_RATIO, SMALLEST_RATIO, Formula, resolve
from .well_conditioned import LocalCosines, Refracted, local_cosines

__all__ = [
    "AUTOMATIC",
    "FORMULAS",
    "LARGEST_RATIO",
    "NEGLIGIBLE",
    "ROUNDING",
    "SMALLEST_RATIO",
    "TEXTBOOK_BACKWARD",
    "UNIT",
    "Budget",
    "Formula",
    "LocalCosines",
    "Refracted",
    "cancelling",
    "contract",
    "fresnel",
    "local_cosines",
    "radicand_for",
    "reflect",
    "reflect_sandwich",
    "refract_2d",
    "resolve",
    "wedge",
]
