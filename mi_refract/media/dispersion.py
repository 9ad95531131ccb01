"""A material as a function from wavelength to index, and dispersion formulas: n from λ in nm and coefficients.

A formula takes floats, numpy arrays or Dr.Jit arrays, in double precision; Dr.Jit can differentiate it.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

from mi_refract.numerics import Mask, Number, differentiated

# Wavelengths in nm of spectral lines by their letters, as in glass catalogues.
# fmt: off
LINES = {
    "i": 365.0146, "h": 404.6561, "g": 435.8343, "F'": 479.9914, "F": 486.1327, "e": 546.0740, "d": 587.5618,
    "D": 589.2938, "C'": 643.8469, "C": 656.2725, "r": 706.5188, "s": 852.1101, "t": 1013.98,
}
# fmt: on
Coefficients = Mapping[str, Number]
ANY = (0.0, math.inf)
NANOMETRES = 1000  # in a µm
TABLE_VALUES = "values"  # optional coefficient of a table: all its values in one array


def nanometres(micrometres: float) -> float:
    """The wavelength in nm, rounded to 15 digits: so the decimal 0.3597 becomes the same number as 359.7."""
    return float(f"{NANOMETRES * micrometres:.15g}")


def where(condition: Mask, x: Number, y: Number) -> Number:
    """`x` where the condition is True, else `y`; for any kind of number."""
    if any(map(dr.is_array_v, (condition, x, y))):
        return dr.select(condition, x, y)
    import numpy as np

    return np.where(condition, x, y)


class Dispersion:
    """n(λ) with named coefficients."""

    def index(self, wavelength: Number, c: Coefficients) -> Number:
        """The index at a wavelength; here the same at all wavelengths."""
        return c["n"] + 0 * wavelength

    def poles(self, c: Coefficients) -> dict[str, float]:
        """Wavelengths in nm at which n is infinite, by the coefficient that determines them; here none."""
        return {}


CONSTANT = Dispersion()


@dataclass(frozen=True)
class Terms(Dispersion):
    """n or n² as `constant` + Σ a λ^p + Σ B λ²/(λ² − C): Cauchy's, Sellmeier's and Schott's formulas.

    powers: pairs of a coefficient's name and p. resonances: pairs of the names of B and C. C is in nm²; if `squared`,
    the coefficient is its root, the wavelength of the resonance in nm.
    """

    power: int  # 1: the sum is n, 2: it is n²
    constant: float = 0.0
    powers: tuple[tuple[str, float], ...] = ()
    resonances: tuple[tuple[str, str], ...] = ()
    squared: bool = False

    def index(self, wavelength: Number, c: Coefficients) -> Number:
        """The index at a wavelength; NaN if n² is negative."""
        square = wavelength * wavelength
        total = self.constant + 0 * wavelength
        for name, p in self.powers:
            power = wavelength ** abs(p) if p % 2 else 1 + 0 * square
            for _ in range(0 if p % 2 else int(abs(p)) // 2):
                power = power * square
            total = total + c[name] * (1 / power if p < 0 else power)
        for b, r in self.resonances:
            total = total + c[b] * (square / (square - (c[r] * c[r] if self.squared else c[r])))
        if self.power == 1:
            return total
        if dr.is_array_v(total):
            return dr.sqrt(total)
        import numpy as np

        with np.errstate(invalid="ignore"):
            return np.sqrt(total)

    def poles(self, c: Coefficients) -> dict[str, float]:
        """The wavelengths of the resonances."""
        squares = {r: float(c[r] ** 2 if self.squared else c[r]) for _, r in self.resonances}
        return {name: math.sqrt(square) for name, square in squares.items() if square > 0}


class Abbe(Dispersion):
    """A glass given by n_d and V_d: n = n_d + (n_d − 1)/V_d g, g = (λ⁻² − λ_d⁻²)/(λ_F⁻² − λ_C⁻²).

    This is Cauchy's formula with two terms that has this n_d and this V_d = (n_d − 1)/(n_F − n_C).
    """

    def index(self, wavelength: Number, c: Coefficients) -> Number:
        """The index at a wavelength; infinite only at λ = 0."""
        d, f, line_c = (LINES[line] ** -2 for line in "dFC")
        g = (1 / (wavelength * wavelength) - d) / (f - line_c)
        return c["n_d"] + (c["n_d"] - 1) / c["V_d"] * g


@dataclass(frozen=True)
class Table(Dispersion):
    """n at given, increasing wavelengths, linear between them. The coefficients are the values of n."""

    knots: tuple[float, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients: `n_587_6` is n at 587.6 nm; with 9 digits, or 17 if knots agree in 9."""
        digits = 9 if len({f"{knot:.9g}" for knot in self.knots}) == len(self.knots) else 17
        return tuple("n_" + f"{knot:.{digits}g}".replace(".", "_") for knot in self.knots)

    def index(self, wavelength: Number, c: Coefficients) -> Number:
        """The index at a wavelength, 0 outside the knots. `c[TABLE_VALUES]`: all values in one array, for kernels."""
        last, names = len(self.knots) - 2, self.names
        segment: Any  # the number of the segment that contains the wavelength
        values: Any
        if not dr.is_array_v(wavelength):
            import numpy as np

            segment = np.searchsorted(self.knots[1:-1], wavelength)  # a knot belongs to the segment that it ends
            if np.ndim(segment):
                values = np.array([c[name] for name in names])
                start, end = values[segment], values[segment + 1]
            else:
                start, end = c[names[segment]], c[names[segment + 1]]
            left, right = np.array(self.knots)[segment], np.array(self.knots)[segment + 1]
        elif not dr.is_jit_v(wavelength) or dr.depth_v(wavelength) > 1:
            return type(wavelength)([self.index(component, c) for component in wavelength])
        else:
            wide: Any = type(wavelength)
            knots, values = wide(self.knots), c.get(TABLE_VALUES)
            if values is None:
                values = wide([dr.detach(c[name])[0] if dr.is_array_v(c[name]) else c[name] for name in names])
            segment = dr.zeros(dr.uint32_array_t(wide))
            for bit in reversed(range(last.bit_length())):  # the last segment that starts below the wavelength, or 0
                later = dr.minimum(segment + (1 << bit), last)
                segment = dr.select(dr.gather(wide, knots, later) < wavelength, later, segment)
            left, right = (dr.gather(wide, knots, segment + i) for i in (0, 1))
            start, end = (dr.gather(wide, values, segment + i) for i in (0, 1))
        share = (wavelength - left) / (right - left)  # exactly 0 at `left` and 1 at `right`, so knots keep their values
        between = start * (1 - share) + end * share
        if dr.is_array_v(wavelength):
            for i, name in enumerate(names):
                value = c[name]
                if differentiated(value) or dr.width(value) > 1:
                    weight = dr.select(segment == i, 1 - share, dr.select(segment + 1 == i, share, 0))
                    between += weight * (value - (dr.detach(value) if dr.width(value) == 1 else dr.detach(value)[0]))
        return where((wavelength >= self.knots[0]) & (wavelength <= self.knots[-1]), between, 0 * wavelength)


def table(pairs: Sequence[tuple[float, float]]) -> tuple[Table, dict[str, float]]:
    """n from pairs of λ in nm and n, linear between them. ValueError, without the place, for an invalid table."""
    knots = tuple(w for w, _ in pairs)
    if len(knots) < 2 or not all(0 < a < b < math.inf for a, b in itertools.pairwise(knots)):
        raise ValueError("expected two or more wavelengths, increasing")
    if bad := [f"{n:g} at {w:g} nm" for w, n in pairs if not 0 < n < math.inf]:
        raise ValueError(f"n = {bad[0]}; expected a positive finite index")
    form = Table(knots)
    return form, dict(zip(form.names, (n for _, n in pairs), strict=True))


def sellmeier(values: Sequence[float], squared: bool = False) -> tuple[Terms, dict[str, float]]:
    """n² = 1 + Σ B_i λ²/(λ² − C_i); `values`: all B, then all C in nm², or if `squared` the λ_i with C_i = λ_i²."""
    letter = "L" if squared else "C"
    pairs = tuple((f"B{i}", f"{letter}{i}") for i in range(1, len(values) // 2 + 1))
    names = [b for b, _ in pairs] + [r for _, r in pairs]
    return Terms(2, 1.0, resonances=pairs, squared=squared), dict(zip(names, values, strict=True))


def power_series(power: int, terms: Iterable[tuple[float, float]]) -> tuple[Terms, dict[str, float]]:
    """n or n² (`power` 1 or 2) = Σ a λ^p, from pairs (a, p) for λ in µm. Coefficients a0, a2, a_2, … for λ in nm."""
    totals: dict[float, float] = {}
    for a, exact in terms:
        p = float(f"{exact:.15g}")  # so that different powers have different names
        totals[p] = totals.get(p, 0.0) + a
    names = {p: f"a{p:.15g}".replace("-", "_").replace(".", "_") for p in totals}
    form = Terms(power, powers=tuple((name, p) for p, name in names.items()))
    return form, {names[p]: a / NANOMETRES**p for p, a in totals.items()}


@dataclass(frozen=True)
class Medium:
    """n(λ) of a material. λ is in nm; indices are in double precision for any type of λ."""

    name: str
    dispersion: Dispersion
    coefficients: dict[str, float]
    valid: tuple[float, float] = ANY  # nm; outside it there is no index
    relative_to: str = ""  # "air" (20 °C, 101325 Pa, dry) or "vacuum"; "" if unknown
    is_air: bool = False
    fitted: tuple[float, float] = ANY  # nm; outside it, but within `valid`, the formula extrapolates
    hold: bool = False  # outside `valid`, use the index at its end
    k: tuple[tuple[float, ...], tuple[float, ...]] | None = None  # wavelengths in nm, imaginary parts of the index

    @property
    def dispersive(self) -> bool:
        """Whether n depends on λ."""
        return self.dispersion is not CONSTANT

    def index(self, wavelength: Number, coefficients: Coefficients | None = None) -> Number:
        """n at a wavelength.

        `wavelength`: in nm; a float, a numpy array of any shape, or a Dr.Jit array; the result has its shape.
        `coefficients`: values that replace some of the medium's own, for derivatives; ValueError for other names. With
        a Dr.Jit array among them the result is one, and a numpy array of wavelengths has at most one dimension.
        Outside `valid` without `hold`, or if n is not a positive number: NaN for Dr.Jit arrays, ValueError for floats
        and numpy arrays. For these there is a warning outside `fitted`, and outside `valid` with `hold`.
        """
        n = self.index_or_nan(wavelength, coefficients)
        if not dr.is_array_v(wavelength):
            import numpy as np

            wavelengths, (low, high) = np.atleast_1d(wavelength), self.valid
            missing = np.isnan(np.atleast_1d(n))
            if missing.any():
                text = f"{self.name}: no index at {wavelengths[missing][0]:g} nm"
                raise ValueError(f"{text}; expected a wavelength from {low:g} to {high:g} nm, or hold(…) around it")
            outside = wavelengths[(wavelengths < low) | (wavelengths > high)]
            if self.hold and outside.size:
                text = f"{self.name}: the index at {outside[0]:g} nm is that of the end of its range"
                warnings.warn(f"{text}, {low:g} to {high:g} nm", stacklevel=2)
            low, high = self.fitted
            outside = wavelengths[(wavelengths < low) | (wavelengths > high)]
            if outside.size:
                text = f"{self.name}: the index at {outside[0]:g} nm is an extrapolation"
                warnings.warn(f"{text}; its formula is fitted from {low:g} to {high:g} nm", stacklevel=2)
        return n

    def index_or_nan(self, wavelength: Number, coefficients: Coefficients | None = None) -> Number:
        """As `index`, with NaN for every type where there is no index."""
        values = {**self.coefficients, **(coefficients or {})}
        compiled = [type(x) for x in (wavelength, *values.values()) if dr.is_array_v(x)]
        if compiled:  # also for coefficients alone: numpy's operators would lose their derivatives
            wide: Any = dr.float64_array_t(compiled[0])
            x = wide(wavelength)
        else:
            import numpy as np

            x = np.asarray(wavelength, np.float64)  # floats too, as numpy returns NaN where Python raises
        valid = x > 0
        if self.hold:
            x = dr.clip(x, *self.valid) if compiled else np.clip(x, *self.valid)
        valid &= (x >= self.valid[0]) & (x <= self.valid[1])
        if unknown := values.keys() - self.coefficients.keys() - {TABLE_VALUES}:
            known = ", ".join([*self.coefficients][:12])
            raise ValueError(f"{self.name}: unknown coefficient {min(unknown)}; expected {known}")
        n = self.dispersion.index(where(valid, x, math.nan), values)
        n = where((n > 0) & (n < math.inf), n, math.nan)
        return n if compiled or n.ndim else float(n)
