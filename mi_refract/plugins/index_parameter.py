"""The indices of a boundary, as parameters of `refract`: numbers, names, dispersive media, textures.

Mitsuba's names stay what they are in its table: constants. A texture holds an index in each point of the surface.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from mi_refract import media
from mi_refract.media import Medium

from .spectrum_parameter import read_knots

ACCEPTED = "a positive finite number, or a material's name, a glass or formula (mi_refract.media), spectrum or texture"


PLUGIN = "refract"


def read_ior(props: Any, name: str, default: str) -> float:
    """An index of refraction that is one number, in double precision. ValueError for all else, and as `read_index`."""
    index = read_index(mi, props, name, default)
    if isinstance(index, Medium) and not index.dispersive:
        return float(index.index(media.LINES["d"]))
    raise ValueError(f"{PLUGIN}: {name} = {props[name]}; expected here one index for all wavelengths, everywhere")


def read_index(v: Any, props: Any, name: str, default: str) -> Any:
    """The parameter's `Medium`, or a texture. `v`: the variant's module.

    ValueError with plugin, parameter, value and what is accepted.
    """
    value = props.get(name, default)
    label = f"{PLUGIN}: {name}"
    if isinstance(value, (str, int, float)) and not isinstance(value, bool):
        return media.parse(value, name=label)
    knots = read_knots(value)
    if knots is None:
        if isinstance(value, mi.Object) and hasattr(value, "is_spatially_varying"):
            return value
        raise ValueError(f"{label} = {value!r}; expected {ACCEPTED}")
    if not knots.wavelengths:
        return media.parse(knots.values[0], name=label)
    table = "table(" + ", ".join(f"{w!r}: {n!r}" for w, n in zip(*knots, strict=True)) + ")"
    if not v.is_spectral:
        raise ValueError(f"{label}: a spectrum has become a colour here; expected {name} = {table!r}, a string")
    return media.parse(table, name=label)
