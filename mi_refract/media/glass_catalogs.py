"""Optical glasses from the makers' catalogues, as the package `opticalglass` holds them (extra `[glass]`).

It reads the makers' spreadsheets; formulas are evaluated here. Indices are relative to air at the makers' conditions,
20 to 22 °C and 101325 Pa, dry.

A glass has an index at wavelengths between those for which its maker prints an index, or a transmittance above 0. The
maker's formula is fitted in a smaller range, that of the printed indices (Ohara's technical information, 2.3, says so),
or less where FITTED says: between the fit and the end of the transmittance an index is an extrapolation, which can be
off by 0.01 at 2325 nm, and is a warning.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import math
import warnings
from dataclasses import dataclass
from typing import Any

from .dispersion import ANY, LINES, Dispersion, Medium, Terms, sellmeier

CATALOGS = {name: name.lower() for name in ("CDGM", "HIKARI", "HOYA", "OHARA", "SCHOTT", "SUMITA")}
# Powers of λ of the coefficients in the makers' order; the others are Sellmeier's. λ is in µm there.
_TO_12TH = (0, 2, 4, -2, -4, -6, -8, -10, -12)
_TO_8TH = (0, 2, -2, -4, -6, -8)
POWERS = {"CDGM": _TO_8TH, "HIKARI": _TO_12TH, "HOYA": _TO_8TH, "SUMITA": _TO_8TH}
NANOMETRES = 1000  # in a µm
# nm. Hoya prints its formula's own numbers beyond the t line: there no glass is off by more than the last digit, within
# it a third are. Schott's fit begins at the i line: of what it prints below, most is off by 1e-5 to 4e-5.
FITTED = {"HOYA": (365.0, 1014.0), "SCHOTT": (365.0, 2326.0)}


@dataclass(frozen=True)
class Glass:
    """A row of a catalogue."""

    coefficients: tuple[float, ...]  # λ in µm; none where the maker prints none
    printed: dict[str, float]  # n at spectral lines
    v_d: float
    range: tuple[float, float]  # nm, where it has an index
    fitted: tuple[float, float]  # nm, where its maker's formula is meant to be right


def names_glass(text: str) -> bool:
    """Whether a text names a glass of a catalogue, such as `SCHOTT:N-BK7`."""
    return ":" in text and text.partition(":")[0].strip().upper() in CATALOGS


def load(catalog: str, glass: str, label: str) -> Medium:
    """A glass by its name, in any case, with or without spaces.

    ValueError for one that is unknown, and where `opticalglass` is not installed.

    catalog: a key of CATALOGS. label: the parameter and its value, for the message.
    """
    try:
        glasses = read(catalog)
    except ModuleNotFoundError as error:
        text = f"{label}: {error.name} is not installed"
        raise ValueError(f"{text}; to read it: pip install 'mi-refract[glass]'") from None
    known = {_plain(name): name for name in glasses}
    if _plain(glass) not in known:
        near = ", ".join(f"{catalog}:{known[name]}" for name in difflib.get_close_matches(_plain(glass), known, 3, 0.0))
        raise ValueError(f"{label}: unknown glass; expected one of the catalogue's {len(glasses)}; nearest: {near}")
    row = glasses[name := known[_plain(glass)]]
    if not row.coefficients:
        raise ValueError(f"{label}: its catalogue has no formula for this glass; use another glass, or table(…)")
    form: Dispersion
    if catalog in POWERS:  # n² = Σ a_p λ^p, Schott's formula of before 1992
        names = {p: f"a{p}" if p >= 0 else f"a_{-p}" for p in POWERS[catalog]}
        form = Terms(2, powers=tuple((names[p], p) for p in names))
        coefficients = {names[p]: x / NANOMETRES**p for p, x in zip(names, row.coefficients, strict=True)}
    else:
        form, coefficients = sellmeier([x * (1 if i < 3 else NANOMETRES**2) for i, x in enumerate(row.coefficients)])
    return Medium(f"{catalog}:{name}", form, coefficients, row.range, "air", fitted=row.fitted)


def _plain(name: str) -> str:
    return "".join(name.lower().split())


@functools.cache
def read(catalog: str) -> dict[str, Glass]:
    """All glasses of a catalogue by name. ModuleNotFoundError where `opticalglass` is not installed."""
    module: Any = importlib.import_module(f"opticalglass.{CATALOGS[catalog]}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (name,) = [name for name in vars(module) if name.lower() == f"{CATALOGS[catalog]}catalog"]
        table, most, glasses = getattr(module, name)(), FITTED.get(catalog, ANY), {}
        for name, row in table.df.iterrows():
            printed, transmitting = _finite(row["refractive indices"]), _finite(row["internal transmission mm, 10"])
            lines = [float(LINES.get(line, line)) for line in printed if line in LINES or isinstance(line, float)]
            wavelengths = lines + [float(w) for w, share in transmitting.items() if share > 0]
            coefficients: tuple[float, ...] = ()
            if len(_finite(row["dispersion coefficients"])) == len(row["dispersion coefficients"]):
                coefficients = tuple(map(float, table.glass_coefs(name)))
            glasses[str(name).strip()] = Glass(
                coefficients,
                {line: n for line, n in printed.items() if line in LINES},
                float(row["abbe number"]["vd"]),
                (min(wavelengths), max(wavelengths)),
                (max(math.floor(min(lines)), most[0]), min(math.ceil(max(lines)), most[1])),
            )
        return glasses


def _finite(series: Any) -> dict[Any, float]:
    """The entries that are numbers, by column: a line's letter or a wavelength in nm."""
    pandas: Any = importlib.import_module("pandas")
    numbers = pandas.to_numeric(series, errors="coerce")
    return {column: float(x) for column, x in numbers.items() if math.isfinite(x)}
