"""The ratio of the indices of two media, which refraction depends on."""

from __future__ import annotations

from mi_refract.numerics import Number

from .dispersion import Coefficients
from .materials import LABORATORY_AIR
from .medium import Medium


def relative_index(
    inside: Medium,
    outside: Medium,
    wavelength: Number,
    inside_coefficients: Coefficients | None = None,
    outside_coefficients: Coefficients | None = None,
) -> Number:
    """n_inside / n_outside at a wavelength in nm; NaN, for floats as well, where one of them has no index.

    Beside an index that is relative to air, air has the index 1. Where the other one is relative to vacuum, the former
    is multiplied by the index of air at 20 °C and 101325 Pa.
    """
    n_inside = inside.index_or_nan(wavelength, inside_coefficients)
    n_outside = outside.index_or_nan(wavelength, outside_coefficients)
    if inside.relative_to == "air" and outside.relative_to == "vacuum":
        return n_inside + 0 * n_outside if outside.is_air else n_inside * _air(wavelength) / n_outside
    if outside.relative_to == "air" and inside.relative_to == "vacuum":
        return 1 / n_outside + 0 * n_inside if inside.is_air else n_inside / (n_outside * _air(wavelength))
    return n_inside / n_outside


def _air(wavelength: Number) -> Number:
    return LABORATORY_AIR.index_or_nan(wavelength)
