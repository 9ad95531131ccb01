"""Optical glasses from the makers' catalogues: the file `glasses.json` here.

For each catalogue it names the document that the numbers were copied from, with its date; for each glass it has [range,
fitted, coefficients]: both ranges in nm, the coefficients in the maker's order, for λ in µm. Indices are relative to
air at the makers' conditions, 20 to 22 °C and 101325 Pa, dry.

A glass has an index within its range: between the wavelengths for which its maker prints an index, or a transmittance
above 0. The maker's formula is fitted in a smaller range: between the fit and the end of the transmittance an index is
an extrapolation, which can be off by 0.01 at 2325 nm, and is a warning.
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
# Powers of λ of the coefficients in the makers' order; the others are Sellmeier's. λ is in µm there.
_TO_12TH = (0, 2, 4, -2, -4, -6, -8, -10, -12)
_TO_8TH = (0, 2, -2, -4, -6, -8)
POWERS = {"CDGM": _TO_8TH, "HIKARI": _TO_12TH, "HOYA": _TO_8TH, "SUMITA": _TO_8TH}


class Glass(NamedTuple):
    """An entry of the file."""

    range: tuple[float, float]  # nm, where it has an index
    fitted: tuple[float, float]  # nm, where its maker's formula is meant to be right
    coefficients: tuple[float, ...]  # λ in µm; none where the maker prints none


@functools.cache
def read(catalog: str) -> dict[str, Glass]:
    """All glasses of a catalogue by name. `catalog`: one of CATALOGS."""
    glasses = json.loads(FILE.read_text("utf-8"))[catalog]["glasses"]
    return {name: Glass(*map(tuple, entry)) for name, entry in glasses.items()}


def load(catalog: str, glass: str, label: str) -> Medium:
    """A glass by its name, in any case, with or without spaces. ValueError for one that is unknown.

    catalog: one of CATALOGS. label: the parameter and its value, for the message.
    """
    glasses = read(catalog)
    known = {_plain(name): name for name in glasses}
    if _plain(glass) not in known:
        near = ", ".join(f"{catalog}:{known[name]}" for name in difflib.get_close_matches(_plain(glass), known, 3, 0.0))
        raise ValueError(f"{label}: unknown glass; expected one of the catalogue's {len(glasses)}; nearest: {near}")
    entry = glasses[name := known[_plain(glass)]]
    if not entry.coefficients:
        raise ValueError(f"{label}: its catalogue has no formula for this glass; use another glass, or table(…)")
    form: Dispersion
    if catalog in POWERS:  # n² = Σ a_p λ^p, Schott's formula of before 1992
        form, coefficients = power_series(2, zip(entry.coefficients, POWERS[catalog], strict=True))
    else:
        form, coefficients = sellmeier([x * (1 if i < 3 else NANOMETRES**2) for i, x in enumerate(entry.coefficients)])
    return Medium(f"{catalog}:{name}", form, coefficients, entry.range, "air", fitted=entry.fitted)


def called(glass: str) -> list[str]:
    """`SCHOTT:N-BK7` for `n-bk7`: the glasses of all catalogues that have this name, in any case, or a similar one."""
    known = {(c, _plain(name)): f"{c}:{name}" for c in CATALOGS for name in read(c)}
    near = difflib.get_close_matches(_plain(glass), {name for _, name in known}, 3, 0.85)
    near = near[:1] if _plain(glass) in near else near
    return [full for (_, name), full in known.items() if name in near]


def _plain(name: str) -> str:
    return "".join(name.lower().split())
