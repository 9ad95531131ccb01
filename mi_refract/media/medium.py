"""A material as an index of refraction by wavelength."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import drjit as dr

from mi_refract.numerics import Number

from .dispersion import CONSTANT, Coefficients, Dispersion, where

ANY = (0.0, math.inf)


@dataclass(frozen=True)
class Medium:
    """n(λ) of a material. λ is in nm; indices are in double precision, whatever the type of λ."""

    name: str
    dispersion: Dispersion
    coefficients: dict[str, float]
    valid: tuple[float, float] = ANY  # nm; outside there is no index
    relative_to: str = ""  # "air" (20 °C, 101325 Pa, dry) or "vacuum"; "" where the source does not say
    is_air: bool = False
    fitted: tuple[float, float] = ANY  # nm; outside, but within `valid`, the formula extrapolates

    @property
    def dispersive(self) -> bool:
        """Whether n depends on λ."""
        return self.dispersion is not CONSTANT

    def index(self, wavelength: Number, coefficients: Coefficients | None = None) -> Number:
        """n at a wavelength.

        Args:
            wavelength: in nm; float, numpy array of any shape, or Dr.Jit array.
            coefficients: other values of some of the medium's own, for derivatives.

        Returns:
            Of the shape of `wavelength`. Dr.Jit arrays: NaN outside `valid`, or where n is not a positive number.

        Raises:
            ValueError: for the same, of floats and numpy arrays. Outside `fitted` these give a warning.
        """
        n = self.index_or_nan(wavelength, coefficients)
        if not dr.is_array_v(wavelength):
            import numpy as np

            wavelengths, (low, high) = np.atleast_1d(wavelength), self.valid
            if (missing := np.isnan(np.atleast_1d(n))).any():
                text = f"{self.name}: no index at {wavelengths[missing][0]:g} nm"
                raise ValueError(f"{text}; expected a wavelength from {low:g} to {high:g} nm")
            low, high = self.fitted
            if (beyond := wavelengths[(wavelengths < low) | (wavelengths > high)]).size:
                text = f"{self.name}: the index at {beyond[0]:g} nm is an extrapolation"
                warnings.warn(f"{text}; its formula is fitted from {low:g} to {high:g} nm", stacklevel=2)
        return n

    def index_or_nan(self, wavelength: Number, coefficients: Coefficients | None = None) -> Number:
        """As `index`, with NaN for every type instead of an error."""
        if compiled := dr.is_array_v(wavelength):
            wide: Any = dr.float64_array_t(type(wavelength))
            x = wide(wavelength)
        else:
            import numpy as np

            x = np.asarray(wavelength, np.float64)  # a float, too: operations of numpy give NaN and do not raise
        valid = (x > 0) & (x >= self.valid[0]) & (x <= self.valid[1])
        n = self.dispersion.index(where(valid, x, math.nan), {**self.coefficients, **(coefficients or {})})
        n = where((n > 0) & (n < math.inf), n, math.nan)
        return n if compiled or dr.is_array_v(n) or n.ndim else float(n)
