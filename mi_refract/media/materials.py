"""What a scene says of a material, as a `Medium`: a number, a formula, a glass of a catalogue, a material's name.

The materials that no catalogue of glass has: air, water, fused silica, diamond; and the ratio of two indices.
"""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from mi_refract.io.text import parse_number
from mi_refract.numerics import Number

from . import glass_catalogs
from .dispersion import ANY, CONSTANT, Abbe, Coefficients, Dispersion, Medium, Table, Terms, sellmeier

VISIBLE = 360.0, 830.0  # nm: where the eye, and Mitsuba, have a response to light
MICROMETRES = 1.0  # nm²: a resonance below is a number of square micrometres, as catalogues print it
CAUCHY_NAMES = "ABCDEFGH"
FORMULAS_OF_N = ("cauchy", "sellmeier", "sellmeier_nm", "abbe", "table")


def _air(name: str, constant: float, terms: tuple[tuple[float, float], ...], valid: tuple[float, float]) -> Medium:
    """10⁸ (n − 1) = constant + Σ k/(k₀ − σ²), σ = 1/λ in µm⁻¹: k/(k₀ − σ²) = (k/k₀) λ²/(λ² − 1/k₀)."""
    pairs = tuple((f"B{i}", f"C{i}") for i in range(1, len(terms) + 1))
    values = {b: 1e-8 * k / k_0 for (b, _), (k, k_0) in zip(pairs, terms, strict=True)}
    values |= {c: 1e6 / k_0 for (_, c), (_, k_0) in zip(pairs, terms, strict=True)}
    return Medium(name, Terms(1, 1 + 1e-8 * constant, resonances=pairs), values, valid, "vacuum", is_air=True)


MATERIALS = {
    medium.name: medium
    for medium in (
        # Dry, 15 °C, 101325 Pa, 450 ppm CO₂: P. E. Ciddor, Applied Optics 35 (1996), 1566.
        _air("AIR:ciddor", 0.0, ((5792105.0, 238.0185), (167917.0, 57.362)), (230.0, 1690.0)),
        # Dry, 15 °C, 101325 Pa, 300 ppm CO₂: B. Edlén, Metrologia 2 (1966), 71.
        _air("AIR:edlen", 8342.13, ((2406030.0, 130.0), (15997.0, 38.9)), (200.0, 1700.0)),
        # F. Peter, Zeitschrift für Physik 15 (1923), 358, measured from 226 to 644 nm. Towards long wavelengths the
        # formula tends to 2.3804, where 2.38 is measured: the crystal has no resonance up to 2500 nm.
        Medium("MATERIAL:diamond", *sellmeier((0.3306, 4.3356, 175.0, 106.0), squared=True), (226.0, 2500.0)),
        # At 20 °C: I. H. Malitson, J. Opt. Soc. Am. 55 (1965), 1205.
        Medium(
            "MATERIAL:fused-silica",
            *sellmeier((0.6961663, 0.4079426, 0.8974794, 68.4043, 116.2414, 9896.161), squared=True),
            (210.0, 3710.0),
            "air",
        ),
        # At 20.0 °C: M. Daimon and A. Masumura, Applied Optics 46 (2007), 3811; λ in µm there.
        Medium(
            "MATERIAL:water",
            *sellmeier(
                (
                    *(5.684027565e-1, 1.726177391e-1, 2.086189578e-2, 1.130748688e-1),
                    *(1e6 * c for c in (5.101829712e-3, 1.821153936e-2, 2.620722293e-2, 1.069792721e1)),
                )
            ),
            (182.0, 1129.0),
            "vacuum",
        ),
    )
}
_CIDDOR = MATERIALS["AIR:ciddor"]
# What catalogues of glass have around their samples: 20 °C, 101325 Pa, dry. n − 1 is proportional to the density, here
# that of an ideal gas: within 2e-8 of Ciddor's own tables.
LABORATORY_AIR = replace(
    _CIDDOR,
    name="air at 20 °C",
    coefficients={k: x * (288.15 / 293.15 if k.startswith("B") else 1) for k, x in _CIDDOR.coefficients.items()},
)


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
    if {inside.relative_to, outside.relative_to} != {"air", "vacuum"}:
        return n_inside / n_outside
    air = LABORATORY_AIR.index_or_nan(wavelength)
    if outside.relative_to == "vacuum":
        return n_inside + 0 * n_outside if outside.is_air else n_inside * air / n_outside
    return 1 / n_outside + 0 * n_inside if inside.is_air else n_inside / (n_outside * air)


def index(spec: float | str, wavelength: Number) -> Number:
    """n of a material at a wavelength in nm; see `parse` and `Medium.index` for what they take, and for errors."""
    return parse(spec).index(wavelength)


def parse(spec: float | str, name: str = "") -> Medium:
    """The material that `spec` says, λ in nm:

    - a number, or a name of Mitsuba's table of materials: the same n at all λ
    - `cauchy(A, B, …)`: n = A + B/λ² + C/λ⁴ + …
    - `sellmeier(B1, …, C1, …)`: n² = 1 + Σ B λ²/(λ² − C), C in nm²
    - `sellmeier_nm(B1, …, L1, …)`: the same with C = L², L in nm
    - `abbe(n_d, V_d)`: Cauchy's formula with two terms through both
    - `table(400: 1.53, 500: 1.52, …)`: linear between its wavelengths
    - `SCHOTT:N-BK7` and others of the catalogues CDGM, Hikari, Hoya, Ohara, Schott, Sumita (extra `[glass]`)
    - `MATERIAL:water`, `MATERIAL:fused-silica`, `MATERIAL:diamond`, `AIR:ciddor`, `AIR:edlen`

    ValueError, with `name` (that of the parameter) and what would be accepted, for anything else; for n that is not
    positive, or infinite, at a wavelength from 360 to 830 nm; and for numbers that are not finite.
    """
    label = f"{name} = {spec!r}" if name else repr(spec)
    if isinstance(spec, str):
        text = spec.strip()
        if ":" in text.partition("(")[0]:
            known = {name.lower(): medium for name, medium in MATERIALS.items()}
            if medium := known.get(text.lower()):
                return medium
            if glass_catalogs.names_glass(text):
                catalog, _, glass = (part.strip() for part in text.partition(":"))
                return glass_catalogs.load(catalog.upper(), glass, label)
            near = ", ".join(difflib.get_close_matches(text, MATERIALS, 3, 0.0))
            catalogs = ", ".join(f"{name}:…" for name in glass_catalogs.CATALOGS)
            raise ValueError(f"{label}: unknown material; nearest: {near}; expected these, or {catalogs}")
        if "(" in text:
            return _formula(text, label)
        # Mitsuba's table holds decimal numbers of at most seven digits in float32: the shortest gives them back.
        import mitsuba as mi
        from mitsuba.mitsuba_ext import Properties

        variant: Any = mi.scalar_rgb  # the table is the same in all of them, and this one need not be set
        query = Properties()
        query["ior"] = text
        try:
            single = variant.lookup_ior(query, "ior", text)
        except RuntimeError as error:
            expected = str(error).partition("choices are:")[2] or "the names of Mitsuba's table"
            raise ValueError(f"{label}: unknown material; expected {expected.strip()}") from None
        absolute = "vacuum" if text in ("air", "vacuum") else ""
        return Medium(text, CONSTANT, {"n": float(f"{single:.7g}")}, relative_to=absolute, is_air=text == "air")
    if isinstance(spec, bool) or not isinstance(spec, (int, float)) or not 0 < spec < math.inf:
        raise ValueError(f"{label}; expected a positive finite number, or a material's name")
    return Medium(str(spec), CONSTANT, {"n": float(spec)})


def _formula(text: str, label: str) -> Medium:
    """A medium that is valid up to the resonances on both sides of the visible, and has an index at all of it."""
    call = re.fullmatch(r"(\w+)\s*\((.*)\)", text)
    if not call or call[1] not in FORMULAS_OF_N:
        raise ValueError(f"{label}; expected {', '.join(f'{known}(…)' for known in FORMULAS_OF_N)}")
    name, arguments, (low, high) = call[1], call[2], ANY

    def numbers(counts: Sequence[int], says: str) -> list[float]:
        try:
            values = [parse_number(x) for x in arguments.split(",")]
        except ValueError:
            values = []
        if len(values) not in counts or not all(map(math.isfinite, values)):
            raise ValueError(f"{label}; expected {says}, finite numbers")
        return values

    form: Dispersion
    if name == "cauchy":  # n = A + B/λ² + C/λ⁴ + …, B in nm², C in nm⁴ (A.-L. Cauchy)
        values = numbers(range(1, len(CAUCHY_NAMES) + 1), "cauchy(A, B, …), λ in nm, up to 8")
        coefficients = dict(zip(CAUCHY_NAMES, values, strict=False))
        form = Terms(1, powers=tuple((letter, -2 * i) for i, letter in enumerate(coefficients)))
    elif name == "abbe":
        n_d, v_d = numbers([2], "abbe(n_d, V_d)")
        if v_d == 0:
            raise ValueError(f"{label}: V_d = 0; expected (n_d − 1)/(n_F − n_C), which is not 0")
        form, coefficients = Abbe(), {"n_d": n_d, "V_d": v_d}
    elif name == "table":
        expected = "expected table(400: 1.53, 500: 1.52, …), two or more, wavelengths in nm, increasing"
        try:
            knots = [(parse_number(w), parse_number(n)) for w, n in (pair.split(":") for pair in arguments.split(","))]
        except ValueError:
            raise ValueError(f"{label}: {expected}") from None
        wavelengths = tuple(w for w, _ in knots)
        increasing = all(a < b for a, b in itertools.pairwise(wavelengths))
        if len(knots) < 2 or not increasing or not 0 < wavelengths[0] < wavelengths[-1] < math.inf:
            raise ValueError(f"{label}: {expected}")
        if bad := [f"{n:g} at {w:g} nm" for w, n in knots if not 0 < n < math.inf]:
            raise ValueError(f"{label}: n = {bad[0]}; expected a positive finite index")
        form, low, high = (table := Table(wavelengths)), wavelengths[0], wavelengths[-1]
        coefficients = dict(zip(table.names, (n for _, n in knots), strict=True))
    else:
        squared = name == "sellmeier_nm"
        letter, unit, factor = ("L", "nm", "1e3") if squared else ("C", "nm²", "1e6")
        values = numbers(range(2, 14, 2), f"{name}(B1, …, {letter}1, …), as many {letter} in {unit} as B, up to 6")
        for i, x in enumerate(values[len(values) // 2 :], 1):
            if 0 < abs(x) < MICROMETRES or (squared and x < 0):
                expected = f"expected {unit}; from {unit.replace('n', 'µ')} multiply by {factor}"
                raise ValueError(f"{label}: {letter}{i} = {x:g}; {expected}")
        form, coefficients = sellmeier(values, squared)
    for resonance, pole in form.poles(coefficients).items():
        if VISIBLE[0] <= pole <= VISIBLE[1]:
            raise ValueError(f"{label}: {resonance}: n is infinite at {pole:.6g} nm; expected no pole in 360 … 830 nm")
        low, high = (max(low, pole), high) if pole < VISIBLE[0] else (low, min(high, pole))
    medium = Medium(text, form, coefficients, (low, high))
    import numpy as np

    low, high = max(low, VISIBLE[0]), min(high, VISIBLE[1])
    visible = np.linspace(low, high, 471)
    if low <= high and (missing := np.isnan(medium.index_or_nan(visible))).any():
        at = visible[missing][0]
        raise ValueError(
            f"{label}: n is not positive at {at:.6g} nm; expected a positive index everywhere in 360 … 830 nm"
        )
    return medium
