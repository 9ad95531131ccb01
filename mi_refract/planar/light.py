"""The colours of the rays of a planar scene: by name, or by wavelength with powers and visible colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract import media
from mi_refract.backend import activate
from mi_refract.io.text import parse_number

from .segments import Array

VISIBLE = 380.0, 730.0  # nm: the range of a given number of wavelengths
SHORTEST, LONGEST = 100.0, 100_000.0  # nm
MOST = 256  # wavelengths
# Wavelengths can be white together if the least channel of their sum is above this share of the largest one. To balance
# more would change their hues: 450 and 550 nm would need 90 times their red. For the lines F, d and C it is 0.2.
BALANCED = 1 / 8


@dataclass(frozen=True)
class Light:
    """Colours, each traced separately.

    names: of the colours; ("",) for a single one without a name. wavelengths: in nm, one per colour; () for colours
    with names only. powers: relative, one per colour; () for equal ones.
    """

    names: tuple[str, ...] = ("",)
    wavelengths: tuple[float, ...] = ()
    powers: tuple[float, ...] = ()

    def __len__(self) -> int:
        """The number of colours."""
        return len(self.names)

    def indices(
        self,
        spec: str | float | Sequence[float],
        where: str,
        find: Callable[[str], Path] = Path,
        only_one: bool = False,
    ) -> tuple[float, ...]:
        """The index of a medium for each colour. `spec`: one number for all colours, one for each, or a material.

        A material's index is relative to air; for colours without wavelengths it is the index at the d line.
        `find`: returns the path of a file that `spec` names. `only_one`: refuse a number for each colour.
        ValueError for another count of numbers, as for `media.parse`, and for a wavelength out of the material's range.
        """
        if not isinstance(spec, str):
            numbers = tuple(media.parse(n, where).coefficients["n"] for n in np.ravel(spec).tolist())
            if only_one and len(numbers) > 1:
                text = f"{len(numbers)} numbers, for the wavelengths of the file"
                raise ValueError(f"{where}: {text}; expected 1, or a material, for other wavelengths")
            if len(numbers) not in (1, len(self)):
                raise ValueError(f"{where}: {len(numbers)} numbers; expected 1, or one for each of {len(self)} colours")
            return numbers * (len(self) // len(numbers))
        medium = media.parse(spec, where, find)
        wavelengths = np.array(self.wavelengths or (media.LINES["d"],) * len(self))
        try:
            n = medium.index(wavelengths)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        if medium.relative_to == "vacuum":
            n = np.ones_like(n) if medium.is_air else n / media.LABORATORY_AIR.index(wavelengths)
        return tuple(float(x) for x in n)


def of_wavelengths(nm: Sequence[float] | int, power: str = "flat") -> Light:
    """Colours for wavelengths in nm, or for a number of wavelengths evenly spread over the visible range.

    power: "flat", or "D65" for the powers of CIE's illuminant from Mitsuba.
    """
    values = np.linspace(*VISIBLE, nm) if isinstance(nm, int) else np.array(nm, float)
    wavelengths = tuple(float(w) for w in values)
    powers = (1.0,) * len(wavelengths)
    if power == "D65":
        import mitsuba as mi

        if mi.variant() is None:
            activate()
        # Keep the current variant, as switching there and back takes 0.1 s. Naming another one loads its classes.
        variant: Any = mi.scalar_spectral
        si, config = variant.SurfaceInteraction3f(), mi.parser.ParserConfig("scalar_spectral")
        spectrum: Any = mi.parser.instantiate(config, mi.parser.parse_dict(config, {"type": "d65"}))
        vector = type(si.wavelengths)
        powers = ()
        for w in wavelengths:
            si.wavelengths = vector(w)
            powers += (float(spectrum.eval(si)[0]),)
    return Light(tuple(f"{w:.6g} nm" for w in wavelengths), wavelengths, powers)


def parsed(text: str) -> list[float] | int:
    """Wavelengths in nm separated by commas, or their number. ValueError for anything else."""
    expected = f"expected wavelengths in nm, such as 486.1,587.6, or their number, from 2 to {MOST}"
    try:
        numbers = [parse_number(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--wavelengths {text}: {expected}") from None
    if len(numbers) == 1 and text.strip().isdigit() and 2 <= numbers[0] <= MOST:
        return int(numbers[0])
    if len(numbers) > MOST or not all(SHORTEST <= x <= LONGEST for x in numbers):
        raise ValueError(f"--wavelengths {text}: {expected}")
    return numbers


def linear_srgb(light: Light) -> Array:
    """The colour that the eye sees for each wavelength (C × 3, linear sRGB; negative if a screen cannot show it).

    All of them together are (1, 1, 1), white, if they are near it; otherwise, the largest channel of their sum is 1.
    ValueError if none is visible.
    """
    import mitsuba as mi

    if mi.variant() is None:
        activate()
    variant: Any = mi.scalar_rgb
    matrix = np.array([variant.xyz_to_srgb([float(i == j) for j in range(3)]) for i in range(3)], float)
    xyz = np.array([variant.cie1931_xyz(float(w)) for w in light.wavelengths], float)
    rgb: Array = (xyz * np.array(light.powers)[:, None]) @ matrix
    total = rgb.sum(0)
    if not total.any():
        text = f"wavelengths: none of {', '.join(light.names[:3])} is visible"
        raise ValueError(f"{text}; expected some from 360 to 830 nm")
    largest = total.max()
    rgb /= total if total.min() > BALANCED * largest else largest
    return rgb
