"""Formulas of dispersion: n as a function of the wavelength λ in nm and of coefficients.

A formula takes floats, numpy arrays or Dr.Jit arrays alike, in double precision; Dr.Jit differentiates it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import drjit as dr

from mi_refract.numerics import Mask, Number

# Spectral lines by their letters, in nm, as catalogues of glass print them.
LINES = {
    "i": 365.0146,
    "h": 404.6561,
    "g": 435.8343,
    "F'": 479.9914,
    "F": 486.1327,
    "e": 546.0740,
    "d": 587.5618,
    "D": 589.2938,
    "C'": 643.8469,
    "C": 656.2725,
    "r": 706.5188,
    "s": 852.1101,
    "t": 1013.98,
}
Coefficients = Mapping[str, Number]


def where(condition: Mask, x: Number, y: Number) -> Number:
    """`x` where the condition holds, else `y`; of any kind of number. NumPy is imported where it is used."""
    if any(map(dr.is_array_v, (condition, x, y))):
        return dr.select(condition, x, y)
    import numpy as np

    return np.where(condition, x, y)


def root(x: Number) -> Number:
    """√x, NaN below 0; of any kind of number."""
    if dr.is_array_v(x):
        return dr.sqrt(x)
    import numpy as np

    with np.errstate(invalid="ignore"):
        return np.sqrt(x)


class Dispersion(Protocol):
    """n(λ) with named coefficients."""

    def index(self, wavelength: Number, c: Coefficients) -> Number:
        """N, dimensionless."""

    def poles(self, c: Coefficients) -> dict[str, float]:
        """Wavelengths at which n is infinite, in nm, by the coefficient that puts them there."""


@dataclass(frozen=True)
class Terms:
    """n or n² as `constant` + Σ a λ^p + Σ B λ²/(λ² − C): Cauchy's, Sellmeier's and Schott's formulas.

    Powers: pairs of a coefficient's name and p. Resonances: pairs of the names of B and C, C in nm², or in nm where
    `squared` (the resonance's wavelength itself is given).
    """

    power: int  # 1: the sum is n, 2: it is n²
    constant: float = 0.0
    powers: tuple[tuple[str, int], ...] = ()
    resonances: tuple[tuple[str, str], ...] = ()
    squared: bool = False

    def index(self, wavelength: Number, c: Coefficients) -> Number:
        """See `Dispersion`."""
        square = wavelength * wavelength
        total = self.constant + 0 * wavelength
        for name, p in self.powers:
            power = 1 + 0 * square
            for _ in range(abs(p) // 2):
                power = power * square
            total = total + c[name] * (1 / power if p < 0 else power)
        for b, r in self.resonances:
            total = total + c[b] * (square / (square - (c[r] * c[r] if self.squared else c[r])))
        return total if self.power == 1 else root(total)

    def poles(self, c: Coefficients) -> dict[str, float]:
        """See `Dispersion`."""
        squares = {r: float(c[r] ** 2 if self.squared else c[r]) for _, r in self.resonances}
        return {name: math.sqrt(square) for name, square in squares.items() if square > 0}


@dataclass(frozen=True)
class Abbe:
    """A glass of which n_d and V_d are known: n = n_d + (n_d − 1)/V_d g, g = (λ⁻² − λ_d⁻²)/(λ_F⁻² − λ_C⁻²).

    That is Cauchy's formula with two terms, through n_d, with V_d = (n_d − 1)/(n_F − n_C).
    """

    def index(self, wavelength: Number, c: Coefficients) -> Number:
        """See `Dispersion`."""
        d, f, line_c = (LINES[line] ** -2 for line in "dFC")
        g = (1 / (wavelength * wavelength) - d) / (f - line_c)
        return c["n_d"] + (c["n_d"] - 1) / c["V_d"] * g

    def poles(self, c: Coefficients) -> dict[str, float]:
        """None: n is infinite at λ = 0 only."""
        return {}


@dataclass(frozen=True)
class Table:
    """n at given wavelengths, increasing, and between two of them linear. The coefficients are the values of n."""

    knots: tuple[float, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients: `n_587_6` is n at 587.6 nm; of nine digits, or 17 where knots agree to nine."""
        digits = 9 if len({f"{knot:.9g}" for knot in self.knots}) == len(self.knots) else 17
        return tuple("n_" + f"{knot:.{digits}g}".replace(".", "_") for knot in self.knots)

    def index(self, wavelength: Number, c: Coefficients) -> Number:
        """See `Dispersion`; 0 beyond the first knot and the last."""
        total = 0 * wavelength
        values = [c[name] for name in self.names]
        for i, (start, end) in enumerate(itertools.pairwise(self.knots)):
            after = wavelength >= start if i == 0 else wavelength > start
            share = (wavelength - start) / (end - start)  # 0 at `start`, 1 at `end`: there the value is the knot's own
            between = values[i] * (1 - share) + values[i + 1] * share
            total = total + where(after & (wavelength <= end), between, 0)
        return total

    def poles(self, c: Coefficients) -> dict[str, float]:
        """None."""
        return {}


@dataclass(frozen=True)
class Constant:
    """The same n at all wavelengths."""

    def index(self, wavelength: Number, c: Coefficients) -> Number:
        """See `Dispersion`."""
        return c["n"] + 0 * wavelength

    def poles(self, c: Coefficients) -> dict[str, float]:
        """None."""
        return {}


CONSTANT = Constant()
CAUCHY_NAMES = "ABCDEFGH"


def cauchy(values: Sequence[float]) -> tuple[Terms, dict[str, float]]:
    """n = A + B/λ² + C/λ⁴ + …, B in nm², C in nm⁴ (A.-L. Cauchy)."""
    names = CAUCHY_NAMES[: len(values)]
    return Terms(1, powers=tuple((name, -2 * i) for i, name in enumerate(names))), dict(zip(names, values, strict=True))


def sellmeier(values: Sequence[float], squared: bool = False) -> tuple[Terms, dict[str, float]]:
    """n² = 1 + Σ B_i λ²/(λ² − C_i), first all B, then all C in nm²; where `squared`, C_i = λ_i², and λ_i is given."""
    count, letter = len(values) // 2, "L" if squared else "C"
    pairs = tuple((f"B{i}", f"{letter}{i}") for i in range(1, count + 1))
    names = [b for b, _ in pairs] + [r for _, r in pairs]
    return Terms(2, 1.0, resonances=pairs, squared=squared), dict(zip(names, values, strict=True))


def polynomial(values: Mapping[int, float]) -> tuple[Terms, dict[str, float]]:
    """n² = Σ a_p λ^p for even p, λ in nm (Schott's formula of before 1992). Keys: p."""
    names = {p: f"a{p}" if p >= 0 else f"a_{-p}" for p in values}
    return Terms(2, powers=tuple((names[p], p) for p in values)), {names[p]: x for p, x in values.items()}
