"""The systems that look up makers' glasses by name, and the glasses whose indices differ from those of this package."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

# At least one of each maker, and some whose index is known to depend on the edition of the catalogue.
GLASSES = (
    "SCHOTT:N-BK7",
    "SCHOTT:N-SF11",
    "SCHOTT:F2",
    "SCHOTT:N-LAK10",
    "SCHOTT:LLF1",
    "OHARA:S-FPL51",
    "HOYA:FCD1",
    "HIKARI:J-BK7A",
    "SUMITA:K-BK7",
    "SUMITA:K-GIR79",
    "SUMITA:K-SFLDn3",
    "CDGM:H-K9L",
    "CDGM:H-LaF4",
)


@dataclass(frozen=True)
class OtherIndex:
    """The known difference between a glass in a system's catalogue and in `mi_refract.media`."""

    recorded: float  # the largest relative difference at the wavelengths of `validation.suite.glasses`, three digits
    cause: str


@dataclass(frozen=True)
class GlassCatalogue:
    """Glasses of a system.

    `script`: a file of scripts/ that, with the argument `glasses`, reads rays with media and returns `n_ratio`.
    `glasses`: those of GLASSES that it has. `tir`: its signal of total internal reflection. `others`: glasses with a
    different index.
    """

    script: str
    glasses: tuple[str, ...]
    tir: str
    others: Mapping[str, OtherIndex] = field(default_factory=dict)


# optiland's copy of refractiveindex.info has the makers' catalogues for Zemax of other years.
_OPTILAND = {
    "CDGM:H-K9L": OtherIndex(
        1.19e-5,
        "CDGM's catalogue for Zemax of 2022 has Sellmeier's formula, n_g = 1.52669; its spreadsheet prints 1.52667",
    ),
    "CDGM:H-LaF4": OtherIndex(
        6.32e-5,
        "CDGM's catalogue for Zemax of 2022 has Sellmeier's formula, n_g = 1.77728; its spreadsheet prints 1.77717",
    ),
    "SUMITA:K-GIR79": OtherIndex(
        1.83e-3, "Sumita's catalogue of 2017 had n_d = 1.85588; today's glass of that name has 1.85920"
    ),
    "SUMITA:K-SFLDn3": OtherIndex(
        4.89e-5, "Sumita's catalogue of 2017 had n_d = 1.84666, V_d = 23.9; today's has 1.84670, 23.8"
    ),
}


_ROUNDED = "raysect stores 10 decimals of C1, in µm²"
_RAYSECT = {
    "SCHOTT:N-BK7": OtherIndex(3.76e-11, _ROUNDED),
    "SCHOTT:F2": OtherIndex(1.46e-11, _ROUNDED),
    "SCHOTT:N-LAK10": OtherIndex(8.29e-11, _ROUNDED),
    "SCHOTT:LLF1": OtherIndex(
        2.97e-5, "Schott's catalogue of 2000 had other coefficients, n_g = 1.56328; today's prints 1.56333"
    ),
}
# Name of a system → its glasses.
CATALOGUES = {
    "rayoptics": GlassCatalogue("rayoptics_rays.py", GLASSES, "nan"),
    "optiland": GlassCatalogue("optiland_rays.py", GLASSES, "nan", _OPTILAND),
    "raysect": GlassCatalogue("raysect_rays.py", tuple(_RAYSECT), "reflected", _RAYSECT),
    # No catalogue, but a telescope with two glasses by Schott's names.
    "batoid": GlassCatalogue("batoid_rays.py", ("SCHOTT:N-BK7", "SCHOTT:N-LAK10"), "nan"),
}
