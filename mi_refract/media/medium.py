"""A material as an index of refraction by wavelength, and the ratio of two."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import drjit as dr

from mi_refract.numerics import Number

from .dispersion import CONSTANT, Coefficients, Dispersion
from .number_kinds import like, nan_unless, wide

ANY = (0.0, math.inf)


@dataclass(frozen=True)
class Medium:
    """n(λ) of a material. λ is in nm; indices are in double precision, whatever the type of λ."""

    name: str
    dispersion: Dispersion
    coefficients: dict[str, float]
    valid: tuple[float, float] = ANY  # nm; outside there is no index
    relative_to: str = ""  # "air" (20 °C, 101325 Pa, dry) or "vacuum"; "" where it is not said
    is_air: bool = False
    fitted: tuple[float, float] = ANY  # nm; outside, but within `valid`, the formula extrapolates

    @property
    def dispersive(self) -> bool:
        """Whether n depends on λ."""
        return self.dispersion is not CONSTANT

    def index(self, wavelength: Number, coefficients: Coefficients | None = None) -> Number:
        """n at a wavelength in nm.

        wavelength: float, numpy array of any shape, or Dr.Jit array. coefficients: other values of some of the medium's
        own, for derivatives. Outside `valid`, or where n is not a positive number: NaN in Dr.Jit arrays, ValueError for
        the others. Outside `fitted`: a warning, but for Dr.Jit arrays.
        """
        found = self.index_or_nan(wavelength, coefficients)
        if not dr.is_array_v(wavelength):
            import numpy as np

            if np.isnan(found).any():
                low, high = self.valid
                at = np.atleast_1d(wavelength)[np.isnan(np.atleast_1d(found))][0]
                text = f"{self.name}: no index at {at:g} nm"
                raise ValueError(f"{text}; expected a wavelength from {low:g} to {high:g} nm")
            low, high = self.fitted
            asked = np.atleast_1d(wavelength)
            if (beyond := asked[(asked < low) | (asked > high)]).size:
                text = f"{self.name}: the index at {beyond[0]:g} nm is an extrapolation"
                warnings.warn(f"{text}; its formula is fitted from {low:g} to {high:g} nm", stacklevel=2)
        return found

    def index_or_nan(self, wavelength: Number, coefficients: Coefficients | None = None) -> Number:
        """As `index`, with NaN for every type instead of an error."""
        x = wide(wavelength)
        inside = (x > 0) & (x >= self.valid[0]) & (x <= self.valid[1])
        n = self.dispersion.index(nan_unless(inside, x), self._all(coefficients))
        return like(nan_unless((n > 0) & (n < math.inf), n), wavelength)

    def _all(self, coefficients: Coefficients | None) -> Coefficients:
        return {**self.coefficients, **(coefficients or {})}
