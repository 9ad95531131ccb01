"""What a scene says of a material, as a `Medium`: a number, a formula, a glass of a catalogue, a material's name."""

from __future__ import annotations

import difflib
import functools
import itertools
import math
import re
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from mi_refract.numerics import Number

from . import dispersion, glass_catalogs
from .dispersion import CAUCHY_NAMES, CONSTANT, Abbe, Dispersion, Table
from .materials import MATERIALS
from .medium import ANY, Medium

VISIBLE = 360.0, 830.0  # nm: where the eye, and Mitsuba, have a response to light
MICROMETRES = 1.0  # nm²: a resonance below is a number of square micrometres, as catalogues print it
Formula: TypeAlias = tuple[Dispersion, dict[str, float], tuple[float, float]]


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
            return _catalogued(text, label)
        return _formula(text, label) if "(" in text else _of_mitsuba(text, label)
    if isinstance(spec, bool) or not isinstance(spec, (int, float)) or not 0 < spec < math.inf:
        raise ValueError(f"{label}; expected a positive finite number, or a material's name")
    return Medium(str(spec), CONSTANT, {"n": float(spec)})


def _formula(text: str, label: str) -> Medium:
    """A medium that is valid up to the resonances on both sides of the visible, and has an index at all of it."""
    call = re.fullmatch(r"(\w+)\s*\((.*)\)", text)
    if not call or call[1] not in FORMULAS_OF_N:
        raise ValueError(f"{label}; expected {', '.join(f'{known}(…)' for known in FORMULAS_OF_N)}")
    form, coefficients, (low, high) = FORMULAS_OF_N[call[1]](call[2], label)
    for name, pole in form.poles(coefficients).items():
        if VISIBLE[0] <= pole <= VISIBLE[1]:
            raise ValueError(f"{label}: {name}: n is infinite at {pole:.6g} nm; expected no pole in 360 … 830 nm")
        low, high = (max(low, pole), high) if pole < VISIBLE[0] else (low, min(high, pole))
    medium = Medium(text, form, coefficients, (low, high))
    import numpy as np

    low, high = max(low, VISIBLE[0]), min(high, VISIBLE[1])
    wavelengths = np.linspace(low, high, 471)
    if low <= high and (missing := np.isnan(medium.index_or_nan(wavelengths))).any():
        at = wavelengths[missing][0]
        raise ValueError(
            f"{label}: n is not positive at {at:.6g} nm; expected a positive index everywhere in 360 … 830 nm"
        )
    return medium


def _numbers(arguments: str, label: str, counts: Sequence[int], says: str) -> list[float]:
    try:
        values = [float(x) for x in arguments.split(",")]
    except ValueError:
        values = []
    if len(values) not in counts or not all(map(math.isfinite, values)):
        raise ValueError(f"{label}; expected {says}, finite numbers")
    return values


def cauchy(arguments: str, label: str) -> Formula:
    """Of `A, B, …`."""
    counts = range(1, len(CAUCHY_NAMES) + 1)
    return *dispersion.cauchy(_numbers(arguments, label, counts, "cauchy(A, B, …), λ in nm, up to 8")), ANY


def sellmeier(arguments: str, label: str, squared: bool = False) -> Formula:
    """Of `B1, …, C1, …`; `squared`: of resonances L, whose squares are the C."""
    name, letter, unit, factor = ("sellmeier_nm", "L", "nm", "1e3") if squared else ("sellmeier", "C", "nm²", "1e6")
    says = f"{name}(B1, …, {letter}1, …), as many {letter} in {unit} as B, up to 6"
    values = _numbers(arguments, label, range(2, 14, 2), says)
    for i, x in enumerate(values[len(values) // 2 :], 1):
        if 0 < abs(x) < MICROMETRES or (squared and x < 0):
            micrometres = unit.replace("n", "µ")
            raise ValueError(f"{label}: {letter}{i} = {x:g}; expected {unit}; from {micrometres} multiply by {factor}")
    return *dispersion.sellmeier(values, squared), ANY


def abbe(arguments: str, label: str) -> Formula:
    """Of `n_d, V_d`."""
    n_d, v_d = _numbers(arguments, label, [2], "abbe(n_d, V_d)")
    if v_d == 0:
        raise ValueError(f"{label}: V_d = 0; expected (n_d − 1)/(n_F − n_C), which is not 0")
    return Abbe(), {"n_d": n_d, "V_d": v_d}, ANY


def table(arguments: str, label: str) -> Formula:
    """Of `wavelength: n, …`."""
    accepted = "expected table(400: 1.53, 500: 1.52, …), two or more, wavelengths in nm, increasing"
    try:
        knots = [(float(w), float(n)) for w, n in (pair.split(":") for pair in arguments.split(","))]
    except ValueError:
        raise ValueError(f"{label}: {accepted}") from None
    wavelengths = tuple(w for w, _ in knots)
    increasing = all(a < b for a, b in itertools.pairwise(wavelengths))
    if len(knots) < 2 or not increasing or not 0 < wavelengths[0] < wavelengths[-1] < math.inf:
        raise ValueError(f"{label}: {accepted}")
    if bad := [f"{n:g} at {w:g} nm" for w, n in knots if not 0 < n < math.inf]:
        raise ValueError(f"{label}: n = {bad[0]}; expected a positive finite index")
    form = Table(wavelengths)
    return form, dict(zip(form.names, (n for _, n in knots), strict=True)), (wavelengths[0], wavelengths[-1])


FORMULAS_OF_N: dict[str, Callable[[str, str], Formula]] = {
    "cauchy": cauchy,
    "sellmeier": sellmeier,
    "sellmeier_nm": functools.partial(sellmeier, squared=True),
    "abbe": abbe,
    "table": table,
}


def _catalogued(text: str, label: str) -> Medium:
    known = {name.lower(): medium for name, medium in MATERIALS.items()}
    if medium := known.get(text.lower()):
        return medium
    catalog, _, glass = (part.strip() for part in text.partition(":"))
    if catalog.upper() in glass_catalogs.CATALOGS:
        return glass_catalogs.load(catalog.upper(), glass, label)
    near = difflib.get_close_matches(text, MATERIALS, 3, 0.0)
    catalogs = ", ".join(f"{name}:…" for name in glass_catalogs.CATALOGS)
    raise ValueError(f"{label}: unknown material; nearest: {', '.join(near)}; expected these, or {catalogs}")


def _of_mitsuba(material: str, label: str) -> Medium:
    """A name of Mitsuba's table. It holds decimal numbers of at most seven digits in float32: the shortest gives them
    back.
    """
    import mitsuba as mi
    from mitsuba.mitsuba_ext import Properties

    variant: Any = mi.scalar_rgb  # the table is the same in all of them, and this one need not be set
    query = Properties()
    query["ior"] = material
    try:
        single = variant.lookup_ior(query, "ior", material)
    except RuntimeError as error:
        known = str(error).partition("choices are:")[2] or "the names of Mitsuba's table"
        raise ValueError(f"{label}: unknown material; expected {known.strip()}") from None
    absolute = "vacuum" if material in ("air", "vacuum") else ""
    return Medium(material, CONSTANT, {"n": float(f"{single:.7g}")}, relative_to=absolute, is_air=material == "air")
