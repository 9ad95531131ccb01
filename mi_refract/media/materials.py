"""Parse the specification of a material into a `Medium`: a number, a formula, a glass of a catalogue, or a name.

| text | index; λ in nm unless the name says µm |
|---|---|
| `1.5` | this number at all wavelengths; as a number or as text |
| `bk7` | a name in Mitsuba's table: one number for all wavelengths, for `bk7` 1.5046, which N-BK7 has at 1.2 µm |
| `cauchy(A, B, C, …)` | n = A + B/λ² + C/λ⁴ + …; B in nm², C in nm⁴ |
| `sellmeier(B1, …, C1, …)` | n² = 1 + Σ B λ²/(λ² − C); first all B, then all C, in nm² |
| `sellmeier_nm(B1, …, L1, …)` | the same with C = L², L in nm |
| `table(400: 1.53, 500: 1.52, …)` | linear between these wavelengths |
| `cauchy_um(…)`, `sellmeier_um(…)`, `table_um(…)` | the same with λ in µm: B in µm², C in µm⁴; Sellmeier's C in µm² |
| `abbe(n_d, V_d)` | Cauchy's formula with two terms, through n_d and V_d |
| `517642` | the six-digit code of a glass as text, n_d − 1 and V_d: `abbe(1.517, 64.2)` |
| `003283` | a code below 300 is that of n_d above 2: `abbe(2.003, 28.3)` |
| `SCHOTT:N-BK7` | a glass of the catalogues CDGM, Hikari, Hoya, Ohara, Schott, Sumita; spaces do not count |
| `file:glass.csv`, `file:glass.yml` | a table, or a page of refractiveindex.info (needs the extra `yaml`) |
| `file:catalogue.agf:GLASS` | a glass of a catalogue for Zemax |
| `MATERIAL:water` | at 20 °C, Daimon and Masumura 2007, relative to vacuum |
| `MATERIAL:fused-silica` | at 20 °C, Malitson 1965, relative to air |
| `MATERIAL:diamond` | Peter 1923 |
| `AIR:ciddor`, `AIR:edlen` | dry, 15 °C, 101325 Pa; Ciddor 1996, Edlén 1966 |
| `hold(…)` | around any of these: outside its range the index is that at the range's end |

Numbers in the wrong unit or order cause an error that suggests the right one: `cauchy(1.5046, 0.0042)`,
`abbe(64.2, 1.517)`, a formula or file with an index above 10.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_refract.io.text import parse_number
from mi_refract.numerics import Number

from . import glass_catalogs, index_files
from .dispersion import (
    CONSTANT,
    NANOMETRES,
    Abbe,
    Coefficients,
    Dispersion,
    Medium,
    Terms,
    nanometres,
    sellmeier,
    table,
)

VISIBLE = 360.0, 830.0  # nm: the range in which the eye, and Mitsuba, respond to light
MICROMETRES = 1.0  # nm², …: a smaller coefficient is probably in µm², …, as catalogues print it
CAUCHY_NAMES = "ABCDEFGH"
POWERS_OF_UNITS = "", "²", "⁴", "⁶", "⁸", "¹⁰", "¹²", "¹⁴"
FORMULAS_OF_N = ("cauchy", "sellmeier", "sellmeier_nm", "abbe", "table")
IN_MICROMETRES = ("cauchy", "sellmeier", "table")  # formulas that also exist as NAME_um
HOLD = re.compile(r"hold\s*\((.*)\)")
GLASS_CODE = re.compile(r"(\d{3})[-/]?(\d{3})(?:\.\d{3})?")  # 517642, or with Schott's density 517642.251
LEAST_CODE = 0.3  # n_d − 1 of a code below this has lost a 1: 003283 means n_d = 2.003, as no glass has n_d < 1.3
LARGEST_N = 10.0  # largest index of formulas in the visible range: silicon has 6.9
ABBE_NUMBERS = 5.0, 200.0  # range of V_d: glasses have 17 to 101
# nm: a wavelength below the first, and a table that ends below it or starts above the second, is in another unit.
SHORTEST, LONGEST = 30.0, 1e5
LONGEST_POLE = 1000.0  # µm²: in Sellmeier's formula of a glass, at least one C is below this, in the ultraviolet


def _air(name: str, constant: float, terms: tuple[tuple[float, float], ...], valid: tuple[float, float]) -> Medium:
    """10⁸ (n − 1) = constant + Σ k/(k₀ − σ²), σ = 1/λ in µm⁻¹: k/(k₀ − σ²) = (k/k₀) λ²/(λ² − 1/k₀)."""
    form, values = sellmeier([*(1e-8 * k / k_0 for k, k_0 in terms), *(1e6 / k_0 for _, k_0 in terms)])
    form = replace(form, power=1, constant=1 + 1e-8 * constant)
    return Medium(name, form, values, valid, "vacuum", is_air=True)


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
# The air around the samples of glass catalogues: 20 °C, 101325 Pa, dry. n − 1 is proportional to the density, here that
# of an ideal gas, which agrees with Ciddor's own tables to 2e-8. From 200 to 230 nm, and above 1690 nm, his formula is
# extrapolated: there Edlén's, which is fitted down to 200 nm, differs by up to 3e-7 and 1e-8.
LABORATORY_AIR = replace(
    _CIDDOR,
    name="air at 20 °C",
    valid=(MATERIALS["AIR:edlen"].valid[0], math.inf),
    fitted=_CIDDOR.valid,
    coefficients={k: x * (288.15 / 293.15 if k.startswith("B") else 1) for k, x in _CIDDOR.coefficients.items()},
)


def relative_index(
    inside: Medium,
    outside: Medium,
    wavelength: Number,
    inside_coefficients: Coefficients | None = None,
    outside_coefficients: Coefficients | None = None,
) -> Number:
    """n_inside / n_outside at a wavelength in nm; NaN, also for floats, if one of them has no index.

    Next to an index relative to air, air has the index 1. If one index is relative to air and the other to vacuum, the
    first is multiplied by the index of air at 20 °C and 101325 Pa, which is NaN below 200 nm.
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
    """n of a material at a wavelength in nm; arguments and errors as for `parse` and `Medium.index`."""
    return parse(spec).index(wavelength)


def parse(spec: float | str, name: str = "", find: Callable[[str], Path] = Path) -> Medium:
    """The medium for `spec`: a number, or a text of the module's table.

    ValueError, with `name` (that of the parameter) and the expected values, for anything else; for an n that is not
    positive at a wavelength from 360 to 830 nm, or in a formula or file above 10; and for numbers that are not finite.

    find: returns the path of a file from its name in the text.
    """
    label = f"{name} = {spec!r}" if name else repr(spec)
    if isinstance(spec, str):
        return _parse_text(spec.strip(), label, find)
    return _constant_medium(spec, label)


def _constant_medium(n: float, label: str) -> Medium:
    if isinstance(n, bool) or not isinstance(n, (int, float)) or not 0 < n < math.inf:
        raise ValueError(f"{label}; expected a positive finite number, or a material's name")
    if 100_000 <= n < 1_000_000 and n == int(n):
        raise ValueError(f"{label}; expected an index; the code of a glass is a text: '{n:.0f}'")
    return Medium(str(n), CONSTANT, {"n": float(n)})


def file_in(text: str) -> str:
    """The name of the file in a text: "glass.yml" for `hold(file:glass.yml)`; "" if it does not name a file."""
    inner = HOLD.fullmatch(text.strip())
    return index_files.split((inner[1] if inner else text).strip())[0]


def _parse_text(text: str, label: str, find: Callable[[str], Path]) -> Medium:
    if inner := HOLD.fullmatch(text):
        return replace(_parse_text(inner[1].strip(), label, find), name=text, hold=True)
    if code := GLASS_CODE.fullmatch(text):  # three digits of n_d − 1 and three of V_d
        n_d, v_d = int(code[1]) / 1000, int(code[2]) / 10
        return replace(_formula(f"abbe({n_d + (1 if n_d >= LEAST_CODE else 2):g}, {v_d:g})", label), name=text)
    try:
        number = parse_number(text)
    except ValueError:
        pass
    else:
        return _constant_medium(number, label)
    if index_files.split(text)[0]:
        return _checked(replace(index_files.read(text, label, find), name=text), label)
    if ":" in text.partition("(")[0]:
        known = {name.lower(): medium for name, medium in MATERIALS.items()}
        if medium := known.get(text.lower()):
            return medium
        catalog, _, glass = (part.strip() for part in text.partition(":"))
        if catalog.upper() in glass_catalogs.CATALOGS:
            return glass_catalogs.load(catalog.upper(), glass, label)
        near = ", ".join(difflib.get_close_matches(text, MATERIALS, 3, 0.0))
        catalogs = ", ".join(f"{name}:…" for name in glass_catalogs.CATALOGS)
        raise ValueError(f"{label}: unknown material; nearest: {near}; expected these, or {catalogs}, file:…")
    if "(" in text:
        return _formula(text, label)
    # Mitsuba's table contains decimal numbers of at most seven digits as float32: seven digits give back the decimals.
    import mitsuba as mi
    from mitsuba.mitsuba_ext import Properties

    variant: Any = mi.scalar_rgb  # the table is the same in all variants, and this one need not be set
    query = Properties()
    query["ior"] = text
    try:
        single = variant.lookup_ior(query, "ior", text)
    except RuntimeError as error:
        if glasses := ", ".join(glass_catalogs.called(text)):
            advice = f"a glass needs the name of its manufacturer: {glasses}"
            raise ValueError(f"{label}: unknown material; {advice}") from None
        expected = str(error).partition("choices are:")[2] or "the names of Mitsuba's table"
        raise ValueError(f"{label}: unknown material; expected {expected.strip()}") from None
    name = text.lower()  # the table ignores case
    absolute = "vacuum" if name in ("air", "vacuum") else ""
    return Medium(text, CONSTANT, {"n": float(f"{single:.7g}")}, relative_to=absolute, is_air=name == "air")


def _formula(text: str, label: str) -> Medium:
    """The medium of a formula with its numbers. ValueError with the likely mistake: another unit, or another order."""
    call = re.fullmatch(r"(\w+?)(_um)?\s*\((.*)\)", text)
    if not call or call[1] not in FORMULAS_OF_N or (call[2] and call[1] not in IN_MICROMETRES):
        known = ", ".join(f"{formula}(…)" for formula in FORMULAS_OF_N)
        raise ValueError(f"{label}; expected {known}, or with _um, such as table_um(…)")
    name, arguments = call[1], call[3]
    unit, scale = ("µm", NANOMETRES) if call[2] else ("nm", 1)

    def numbers(counts: Sequence[int], expected: str) -> list[float]:
        try:
            values = [parse_number(x) for x in arguments.split(",")]
        except ValueError:
            values = []
        if len(values) not in counts or not all(map(math.isfinite, values)):
            raise ValueError(f"{label}; expected {expected}, finite numbers")
        return values

    def wrong_unit(quantity: str, value: float, power: str = "", factor: str = "") -> ValueError:
        other_unit, other_name = ("nm", name) if call[2] else ("µm", f"{name}_um")
        remedies = [f"multiply by {factor}"] if factor else []
        if name in IN_MICROMETRES:
            remedies.append(f"write {other_name}(…)")
        remedy = f"from {other_unit}{power} {', or '.join(remedies)}"
        return ValueError(f"{label}: {quantity} = {value:g}; expected {unit}{power}; {remedy}")

    form: Dispersion
    valid = SHORTEST, math.inf
    if name == "cauchy":  # n = A + B/λ² + C/λ⁴ + …, B in nm², C in nm⁴ (A.-L. Cauchy)
        values = numbers(range(1, len(CAUCHY_NAMES) + 1), f"{name}(A, B, …), λ in {unit}, up to 8")
        for i, x in enumerate(values[1:], 1):
            if not call[2] and 0 < abs(x) < MICROMETRES:
                raise wrong_unit(CAUCHY_NAMES[i], x, POWERS_OF_UNITS[i], f"1e{6 * i}")
        coefficients = {CAUCHY_NAMES[i]: x * scale ** (2 * i) for i, x in enumerate(values)}
        form = Terms(1, powers=tuple((letter, -2 * i) for i, letter in enumerate(coefficients)))
    elif name == "abbe":
        n_d, v_d = numbers([2], "abbe(n_d, V_d)")
        if n_d > v_d > 0:
            raise ValueError(f"{label}: n_d = {n_d:g}, V_d = {v_d:g}; expected n_d first: abbe({v_d:g}, {n_d:g})")
        if not 1 < n_d <= LARGEST_N:
            raise ValueError(f"{label}: n_d = {n_d:g}; expected an index above 1, up to {LARGEST_N:g}")
        if not ABBE_NUMBERS[0] <= v_d <= ABBE_NUMBERS[1]:
            low, high = ABBE_NUMBERS
            raise ValueError(f"{label}: V_d = {v_d:g}; expected (n_d − 1)/(n_F − n_C), from {low:g} to {high:g}")
        form, coefficients = Abbe(), {"n_d": n_d, "V_d": v_d}
    elif name == "table":
        try:
            pairs = [(parse_number(w), parse_number(n)) for w, n in (pair.split(":") for pair in arguments.split(","))]
        except ValueError:
            raise ValueError(f"{label}; expected table(400: 1.53, 500: 1.52, …), wavelengths in nm") from None
        try:
            form, coefficients = table([(nanometres(w) if call[2] else w, n) for w, n in pairs])
        except ValueError as error:
            raise ValueError(f"{label}: {error}") from None
        valid = form.knots[0], form.knots[-1]
        if valid[1] < SHORTEST or valid[0] > LONGEST:
            raise wrong_unit("the first wavelength", pairs[0][0])
    else:
        squared = name == "sellmeier_nm"
        letter, power, factor = ("L", "", "1e3") if squared else ("C", "²", "1e6")
        expected = f"{name}(B1, …, {letter}1, …), as many {letter} in {unit}{power} as B, up to 6"
        values = numbers(range(2, 14, 2), expected)
        poles = values[len(values) // 2 :]
        for i, x in enumerate(poles, 1):
            if not call[2] and (0 < abs(x) < MICROMETRES or (squared and x < 0)):
                raise wrong_unit(f"{letter}{i}", x, power, factor)
        if call[2] and min(poles) > LONGEST_POLE:
            raise wrong_unit("C1", poles[0], power)
        form, coefficients = sellmeier([*values[: len(poles)], *(x * scale**2 for x in poles)], squared)
    return _checked(Medium(text, form, coefficients, valid), label)


def _checked(medium: Medium, label: str) -> Medium:
    """The medium, valid between the poles on both sides of the visible range. ValueError if it has no index there."""
    import numpy as np

    (low, high), (first, last) = medium.valid, VISIBLE
    first, last = max(first, low), min(last, high)
    for resonance, pole in medium.dispersion.poles(medium.coefficients).items():
        if first <= pole <= last:
            raise ValueError(f"{label}: {resonance}: n is infinite at {pole:.6g} nm; expected no pole in 360 … 830 nm")
        low, high = (max(low, pole), high) if pole < first else (low, min(high, pole))
    medium = replace(medium, valid=(low, high))
    if first <= last:
        visible = np.linspace(first, last, 471)
        n = medium.index_or_nan(visible)
        missing = np.isnan(n)
        if missing.any():
            at = visible[missing][0]
            text = f"{label}: n is not positive at {at:.6g} nm"
            raise ValueError(f"{text}; expected a positive index everywhere in 360 … 830 nm")
        large = n > LARGEST_N
        if large.any():
            at = f"n = {n[large][0]:g} at {visible[large][0]:.6g} nm"
            expected = f"expected up to {LARGEST_N:g} in 360 … 830 nm; coefficients in another unit?"
            raise ValueError(f"{label}: {at}; {expected}")
    return medium
