"""Optical glasses from the manufacturers' catalogues, in the file `glasses.json` of this folder.

For each catalogue it names the document that the numbers were copied from, with its date. For each glass it contains
[range, fitted, coefficients]: both ranges in nm, the coefficients in the manufacturer's order, for λ in µm. Indices are
relative to air at the manufacturers' conditions, 20 to 22 °C and 101325 Pa, dry.

The range of a glass contains the wavelengths for which its manufacturer prints an index, or a transmittance above 0.
The formula is fitted in a smaller range. Outside the fit an index is an extrapolation, whose error can be 0.01 at
2325 nm, and causes a warning.
"""

from __future__ import annotations

import difflib
import functools
import json
from pathlib import Path
from typing import NamedTuple

from .dispersion import NANOMETRES, Dispersion, Medium, power_series, sellmeier

FILE = Path(__file__).with_name("glasses.json")
CATALOGS = ("CDGM", "HIKARI", "HOYA", "OHARA", "SCHOTT", "SUMITA")
# Powers of λ, in µm, of the coefficients in the manufacturers' order; the other catalogues use Sellmeier's formula.
_TO_12TH = (0, 2, 4, -2, -4, -6, -8, -10, -12)
_TO_8TH = (0, 2, -2, -4, -6, -8)
POWERS = {"CDGM": _TO_8TH, "HIKARI": _TO_12TH, "HOYA": _TO_8TH, "SUMITA": _TO_8TH}


class Glass(NamedTuple):
    """An entry of the file."""

    range: tuple[float, float]  # nm; the glass has an index within it
    fitted: tuple[float, float]  # nm; the manufacturer's formula is fitted within it
    coefficients: tuple[float, ...]  # for λ in µm; empty if the manufacturer prints none


@functools.cache
def read(catalog: str) -> dict[str, Glass]:
    """All glasses of a catalogue by name. `catalog`: one of CATALOGS."""
    glasses = json.loads(FILE.read_text("utf-8"))[catalog]["glasses"]
    return {name: Glass(*map(tuple, entry)) for name, entry in glasses.items()}


def load(catalog: str, glass: str, label: str) -> Medium:
    """A glass by its name; case and spaces are ignored. ValueError for an unknown glass.

    catalog: one of CATALOGS. label: the parameter and its value, for the error.
    """
    glasses = read(catalog)
    known = {_plain(name): name for name in glasses}
    if _plain(glass) not in known:
        near = ", ".join(f"{catalog}:{known[name]}" for name in difflib.get_close_matches(_plain(glass), known, 3, 0.0))
        raise ValueError(f"{label}: unknown glass; expected one of the catalogue's {len(glasses)}; nearest: {near}")
    name = known[_plain(glass)]
    entry = glasses[name]
    if not entry.coefficients:
        raise ValueError(f"{label}: its catalogue has no formula for this glass; use another glass, or table(…)")
    form: Dispersion
    if catalog in POWERS:  # n² = Σ a_p λ^p, Schott's formula before 1992
        form, coefficients = power_series(2, zip(entry.coefficients, POWERS[catalog], strict=True))
    else:
        form, coefficients = sellmeier([x * (1 if i < 3 else NANOMETRES**2) for i, x in enumerate(entry.coefficients)])
    return Medium(f"{catalog}:{name}", form, coefficients, entry.range, "air", fitted=entry.fitted)


def called(glass: str) -> list[str]:
    """The glasses of all catalogues with this or a similar name, case ignored: `SCHOTT:N-BK7` for `n-bk7`."""
    known = {(c, _plain(name)): f"{c}:{name}" for c in CATALOGS for name in read(c)}
    near = difflib.get_close_matches(_plain(glass), {name for _, name in known}, 3, 0.85)
    near = near[:1] if _plain(glass) in near else near
    return [full for (_, name), full in known.items() if name in near]


def _plain(name: str) -> str:
    return "".join(name.lower().split())
