"""Absorption on both sides of a boundary, as parameters of `refract`.

After a distance t, exp(−σ t) of the light is left (Beer–Lambert). `int_absorption`, `ext_absorption`: σ, a number or a
spectrum, per unit of the scene. Instead, `int_colour`, in (0, 1], is what is left of white light after the distance
`int_colour_distance`: σ = −log(colour)/distance; `ext_colour` likewise. Or `int_absorption` names a file with k, the
imaginary part of the index: σ = 4πk/λ, where `int_absorption_unit` is the scene's unit in metres.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import mitsuba.mitsuba_ext

from mi_refract import media
from mi_refract.numerics import BSDF, Interaction, Mask, Number, Properties, Spectrum, Texture

from .index_parameter import check_range, find_file, read_knots

# Attributes of a boundary: σ on the side that `si.wi` points to, and on the other side.
HERE, BEYOND = "absorption here", "absorption beyond"
ENDLESS = 1e30  # σ times this distance is finite in float32, and its exponential is 0
_parsed: Any = mitsuba.mitsuba_ext  # types that do not depend on the variant
LEAST_COLOUR = 1e-30  # its logarithm is finite; Mitsuba converts some RGB colours to spectra that reach 0


def absorbing_parameter(bsdf: BSDF) -> str:
    """Return the name of the first absorption parameter of a `refract`; "" if it has none, and for other BSDFs."""
    return next((side.name for side in getattr(bsdf, "absorptions", {}).values() if side), "")


class Absorption:
    """σ on one side of a boundary, given by a texture that does not vary over the surface."""

    DRJIT_STRUCT: ClassVar = {"texture": object}  # for frozen functions

    def __init__(self, name: str, texture: Texture, factor: float, distance: float) -> None:
        """σ = factor × texture, or −log(texture)/distance if `distance` is not 0."""
        self.name, self.texture, self.factor, self.distance = name, texture, factor, distance

    def eval(self, si: Interaction, active: Mask) -> Spectrum:
        """Return σ at the wavelengths of `si`."""
        value = self.texture.eval(si, active)
        if not self.distance:
            return value * self.factor
        # In inactive lanes the texture returns 0.
        return -dr.log(dr.select(active, dr.maximum(value, LEAST_COLOUR), 1)) / self.distance


def absorbed(sigma: Spectrum, length: Number) -> Spectrum:
    """Return exp(−σ t); after an infinite distance its derivative in σ is 0."""
    return dr.exp(-sigma * dr.minimum(length, ENDLESS))


def read_absorption(plugin: str, props: Properties, side: str) -> Absorption | None:
    """Return the absorption of a side, "int", "ext" or "camera"; None if the scene gives none.

    ValueError names the parameter.
    """
    sigma, colour, distance = f"{side}_absorption", f"{side}_colour", f"{side}_colour_distance"
    for name in (colour, distance):
        american = name.replace("colour", "color")
        if american in props:
            raise ValueError(f"{plugin}: unknown parameter {american}; expected {name}")
    if sigma in props:
        if colour in props or distance in props:
            raise ValueError(f"{plugin}: {sigma} and {colour} are both set; expected one of them")
        name, length = sigma, 0.0
    elif (colour in props) != (distance in props):
        missing = distance if colour in props else colour
        raise ValueError(f"{plugin}: {colour} and {distance}: {missing} is not given; expected both, or neither")
    elif colour not in props:
        return None
    else:
        name, length = colour, props[distance]
        if isinstance(length, bool) or not isinstance(length, (int, float)) or not 0 < length < math.inf:
            raise ValueError(f"{plugin}: {distance} = {length!r}; expected a positive finite length")

    value = props[name]
    if not length and ((isinstance(value, str) and media.file_in(value)) or f"{sigma}_unit" in props):
        return _from_k(plugin, name, value, props.get(f"{sigma}_unit", None))
    expected = "a number or a spectrum " + ("above 0 and up to 1" if length else "≥ 0, and finite")
    values = read_values(plugin, props, name, expected, bool(length), textures=False)
    is_colour = type(value).__name__.endswith("Color3d")
    if not (is_colour and mi.is_spectral) or length or not any(values):
        return Absorption(name, props.get_unbounded_texture(name), 1.0, float(length))
    # Mitsuba converts RGB colours up to 1 only to a spectrum, and those up to 1/2 to a smooth one. So scale them.
    factor, scaled = 2 * max(values), mi.Properties()
    scaled[name] = props[name] / factor
    props.mark_queried(name)
    return Absorption(name, scaled.get_unbounded_texture(name), factor, 0.0)


def read_values(
    plugin: str, props: Properties, name: str, expected: str, share: bool = False, textures: bool = True
) -> tuple[float, ...]:
    """Return the values of a number, an RGB colour or a spectrum; () for a texture, if `textures` are allowed.

    ValueError names the parameter if a value is negative or not finite; with `share`, if it is 0 or above 1.
    """
    value = props[name]
    values: tuple[float, ...] = ()
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        values = (float(value),)
    elif type(value).__name__.endswith("Color3d"):
        values = tuple(float(x) for x in value)
    elif knots := read_knots(value):
        values = knots[1]
    if not (values or textures) or not all(0 < x <= 1 if share else 0 <= x < math.inf for x in values):
        text = " ".join(str(value).split())
        texture = "" if values else "; no texture"
        raise ValueError(
            f"{plugin}: {name} = {text if len(text) <= 80 else f'{text[:77]}…'}; expected {expected}{texture}"
        )
    return values


def _from_k(plugin: str, name: str, text: Any, unit: Any) -> Absorption:
    """Return σ = 4πk/λ, with k from a file. ValueError names the parameter."""
    import numpy as np

    label = f"{plugin}: {name}"
    medium = media.parse(text, label, find_file) if isinstance(text, str) else None
    if not medium or not medium.k:
        raise ValueError(f"{label} = {text!r}; expected a number, a spectrum, or with {name}_unit a file with k")
    if isinstance(unit, bool) or not isinstance(unit, (int, float)) or not 0 < unit < math.inf:
        problem = f"{name} = {text!r}: {name}_unit is missing" if unit is None else f"{name}_unit = {unit!r}"
        raise ValueError(f"{plugin}: {problem}; expected the scene's unit in metres: 0.001 for mm")
    knots, k = medium.k
    effect = "has the absorption of the range's end"
    check_range(f"{label} = {text!r} has k", (knots[0], knots[-1]), medium.hold, effect)
    # k is linear between its knots, and outside them it has its value at the range's end. Mitsuba's spectrum is linear
    # in σ, so it needs steps of 1 nm, where k/λ differs from a line by at most 1/4λ² < 2e-6. It is in float32.
    visible = np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + 1)
    inner = [w for w in knots if mi.MI_CIE_MIN < w < mi.MI_CIE_MAX]
    wavelengths = np.unique(np.array([*visible, *inner], np.float32)).astype(float)
    values = 4e9 * math.pi * unit * np.interp(wavelengths, knots, k) / wavelengths
    sigma = mi.Properties()
    sigma[name] = _parsed.Spectrum(wavelengths.tolist(), values.tolist())
    return Absorption(name, sigma.get_unbounded_texture(name), 1.0, 0.0)
