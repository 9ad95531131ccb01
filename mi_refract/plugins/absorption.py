"""Absorption on both sides of a boundary: exp(−σ t) along a way of length t (Beer–Lambert). Parameters of `refract`.

`int_absorption`, `ext_absorption`: σ, a number or a spectrum, per unit of the scene. Or `int_colour`, in (0, 1], what
is left of white light after the way `int_colour_distance`: σ = −log(colour)/distance; `ext_colour` likewise.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from .spectrum_parameter import read_knots

SIDES = ("int", "ext")
# Attributes of a boundary: σ on the side from which light comes along `si.wi`, and on the other.
HERE, BEYOND = "absorption here", "absorption beyond"


def absorbing_parameter(bsdf: Any) -> str:
    """The name of the parameter of `refract` that makes it absorb; "" where it does not, and for other BSDFs."""
    sides = getattr(bsdf, "absorptions", {})
    return next((each.name for each in sides.values() if each), "")


class Absorption:
    """σ on one side of a boundary, from a texture that is the same everywhere on it."""

    DRJIT_STRUCT: ClassVar = {"texture": object}  # for frozen functions

    def __init__(self, name: str, texture: Any, factor: float, distance: float) -> None:
        """σ = factor × texture, or −log(texture)/distance where there is a distance."""
        self.name, self.texture, self.factor, self.distance = name, texture, factor, distance

    def eval(self, si: Any, active: Any) -> Any:
        """σ at the wavelengths of `si`."""
        value = self.texture.eval(si, active)
        if not self.distance:
            return value * self.factor
        # Where a lane is not active the texture gives 0.
        return -dr.log(dr.select(active, dr.maximum(value, _LEAST_COLOUR), 1)) / self.distance


def absorbed(sigma: Any, length: Any) -> Any:
    """exp(−σ t), with a derivative in σ that is 0 after an endless way."""
    return dr.exp(-sigma * dr.minimum(length, _ENDLESS))


_ENDLESS = 1e30  # σ times it is finite in float32, and its exponential is 0
_LEAST_COLOUR = 1e-30  # its logarithm is finite; a spectrum that Mitsuba makes of an RGB colour may end at 0


def read_absorption(plugin: str, props: Any, side: str) -> Absorption | None:
    """Of the side `int` or `ext`; None where nothing is said of it. ValueError with the parameter and what it takes."""
    sigma, colour, distance = f"{side}_absorption", f"{side}_colour", f"{side}_colour_distance"
    if sigma in props:
        if colour in props or distance in props:
            raise ValueError(f"{plugin}: {sigma} beside {colour}; expected one of the two")
        return _read(plugin, props, sigma, 0.0)
    if (colour in props) != (distance in props):
        missing = distance if colour in props else colour
        raise ValueError(f"{plugin}: {colour} and {distance}: {missing} is not given; expected both, or neither")
    if colour not in props:
        return None
    length = props[distance]
    if isinstance(length, bool) or not isinstance(length, (int, float)) or not 0 < length < math.inf:
        raise ValueError(f"{plugin}: {distance} = {length!r}; expected a positive finite length")
    return _read(plugin, props, colour, float(length))


def _read(plugin: str, props: Any, name: str, distance: float) -> Absorption:
    values = _values(props[name])
    accepted = "a number or a spectrum " + ("above 0 and up to 1" if distance else "≥ 0, and finite")
    if values is None:
        raise ValueError(f"{plugin}: {name} = {_brief(props[name])}; expected {accepted}; no texture")
    fits = all(0 < x <= 1 if distance else 0 <= x < math.inf for x in values)
    if not fits:
        raise ValueError(f"{plugin}: {name} = {_brief(props[name])}; expected {accepted}")
    # Mitsuba makes a spectrum of an RGB colour up to 1 only, and a smooth one of 1/2; of the others, in proportion.
    coloured = type(props[name]).__name__.endswith("Color3d") and not distance
    factor = 2 * max(values) if coloured and any(values) else 1.0
    return Absorption(name, _texture(props, name, factor), factor, distance)


def _values(value: Any) -> tuple[float, ...] | None:
    """The numbers that a parameter consists of; None where it varies over a surface."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return (float(value),)
    if type(value).__name__.endswith("Color3d"):
        return tuple(float(x) for x in value)
    knots = read_knots(value)
    return knots.values if knots else None


def _texture(props: Any, name: str, factor: float) -> Any:
    if factor == 1:
        return props.get_unbounded_texture(name)
    scaled = mi.Properties()
    scaled[name] = props[name] / factor
    props.mark_queried(name)
    return scaled.get_unbounded_texture(name)


def _brief(value: Any) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 80 else f"{text[:77]}…"
