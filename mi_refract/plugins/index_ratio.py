"""Ratios of indices that are not one number: by wavelength, or by the point of the surface.

Both give the ratio n_int/n_ext in double precision, lane by lane, and NaN where there is no index: such light is lost.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from mi_refract import media
from mi_refract.formulas import LARGEST_RATIO, SMALLEST_RATIO
from mi_refract.media import Medium
from mi_refract.numerics import differentiated, replace_grad

from .index_parameter import PLUGIN, read_index
from .integrator_context import warn_once

DEFAULTS = {"int_ior": "bk7", "ext_ior": "air"}
SIDES = tuple(DEFAULTS)
LOST = 1e-3  # of the colour of light of equal power at all wavelengths: the most that may lie outside a medium's range


class DispersiveRatio:
    """n_int/n_ext of two media by wavelength. Their coefficients are differentiable parameters, `int_ior_B` for one."""

    DRJIT_STRUCT: ClassVar = {"shown": dict, "exact": dict}  # for frozen functions

    def __init__(self, v: Any, inside: Medium, outside: Medium) -> None:
        """`v`: the variant's module."""
        self.inside, self.outside = inside, outside
        self.wide: Any = dr.float64_array_t(v.Float)
        self.shown: dict[str, Any] = {}
        self.exact: dict[str, Any] = {}
        self._show(SIDES[0], inside, _parameter_type(v))
        self._show(SIDES[1], outside, _parameter_type(v))
        self._hide()

    def _show(self, side: str, medium: Medium, number: Any) -> None:
        for name, value in medium.coefficients.items() if medium.dispersive else ():
            self.shown[f"{side}_{name}"], self.exact[f"{side}_{name}"] = number(value), self.wide(value)

    def _hide(self) -> None:
        """Opaque: an edit changes the data of a kernel and not its code."""
        dr.make_opaque(*self.shown.values(), *self.exact.values())

    def at(self, wavelength: Any) -> Any:
        """The ratio at a wavelength in nm, in float64; NaN outside the range of either medium."""
        inside, outside = (
            {key[len(side) + 1 :]: self._attached(key) for key in self.exact if key.startswith(side)} for side in SIDES
        )
        return media.relative_index(self.inside, self.outside, wavelength, inside, outside)

    def _attached(self, key: str) -> Any:
        """A coefficient in double precision, with a derivative in the number that is shown, formed in each render."""
        shown, exact = self.shown[key], self.exact[key]
        return replace_grad(exact, self.wide(shown)) if differentiated(shown) else exact

    @property
    def differentiated(self) -> bool:
        """Whether a coefficient carries a derivative."""
        return any(map(differentiated, self.shown.values()))

    def traverse(self, cb: Any) -> None:
        """Show the coefficients. No dot in a name: Mitsuba would call what was set by what follows the last one."""
        for name, value in self.shown.items():
            cb.put(name, value, mi.ParamFlags.Differentiable)

    def changed(self, keys: Iterable[str]) -> None:
        """Take over coefficients that were set; those that were not keep their double precision."""
        for key in keys or self.shown:
            if key in self.shown:
                shown = self.shown[key]
                if len(shown) != 1:
                    raise ValueError(f"{PLUGIN}: {key} has {len(shown)} entries; expected one number")
                self.exact[key] = self.wide(dr.detach(shown)) if dr.is_jit_v(shown) else self.wide(shown[0])
        self._hide()

    def names(self) -> str:
        """The media, for a message."""
        return f"{self.inside.name} in {self.outside.name}"

    def lines(self) -> list[str]:
        """For the plugin's text."""
        return [f"{side} = {x.name}" for side, x in zip(SIDES, (self.inside, self.outside), strict=True)]


def _parameter_type(v: Any) -> Any:
    """Scalar variants: Mitsuba can set an array of one number, but not a bare Python float."""
    scalar: Any = dr.scalar
    return v.Float if dr.is_jit_v(v.Float) else scalar.Array1f


class TexturedRatio:
    """n_int/n_ext where one of them, or both, is a texture of numbers."""

    DRJIT_STRUCT: ClassVar = {"sides": dict}  # for frozen functions
    differentiated = False  # of numbers: a texture's values carry their own

    def __init__(self, v: Any, sides: Mapping[str, Any]) -> None:
        """`v`: the variant's module. `sides`: a texture or a number of `int_ior` and of `ext_ior`."""
        self.sides = sides
        self.wide: Any = dr.float64_array_t(v.Float)

    def at(self, si: Any, active: Any) -> Any:
        """The ratio in float64; NaN where it is not one."""
        inside, outside = (self.wide(n if isinstance(n, float) else n.eval_1(si, active)) for n in self.sides.values())
        eta = inside / outside
        return dr.select((eta >= SMALLEST_RATIO) & (eta <= LARGEST_RATIO), eta, dr.nan)

    def traverse(self, cb: Any) -> None:
        """Show the textures."""
        for name, texture in self.sides.items():
            if not isinstance(texture, float):
                cb.put(name, texture, mi.ParamFlags.Differentiable)

    def changed(self, keys: Iterable[str]) -> None:
        """Nothing: textures take over what is set."""

    def lines(self) -> list[str]:
        """For the plugin's text."""
        return [f"{side} = {index}" for side, index in self.sides.items()]


def read_ratio(v: Any, props: Any) -> tuple[DispersiveRatio | TexturedRatio | None, float]:
    """The ratio of a boundary where it is not one number, and the number: of the d line; 1 where a texture says it.

    `v`: the variant's module. ValueError with plugin, parameter and what is accepted.
    """
    indices = {name: read_index(v, props, name, default) for name, default in DEFAULTS.items()}
    dispersive = [name for name, index in indices.items() if isinstance(index, Medium) and index.dispersive]
    if not all(isinstance(index, Medium) for index in indices.values()):
        if dispersive:
            raise ValueError(f"{PLUGIN}: {dispersive[0]}; expected beside a texture one index for all wavelengths")
        line = media.LINES["d"]
        return TexturedRatio(v, {k: x.index(line) if isinstance(x, Medium) else x for k, x in indices.items()}), 1.0
    inside, outside = indices.values()
    number = float(media.relative_index(inside, outside, media.LINES["d"]))
    if not dispersive:
        return None, number
    for name in dispersive:
        if v.is_spectral and (text := _check_range(f"{PLUGIN}: {name}", indices[name])):
            warn_once(text)
        if not v.is_spectral:
            warn_once(f"{PLUGIN}: {name}: {indices[name].name}: all light has the index of the d line, 587.6 nm, here")
    return DispersiveRatio(v, inside, outside), number


def _check_range(label: str, medium: Medium) -> str:
    """What is lost outside a medium's range, "" for nothing. ValueError where it is more than `LOST` of the colour."""
    import numpy as np

    wavelengths = np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + 1.0)
    response = _responses(wavelengths)
    outside = (wavelengths < medium.valid[0]) | (wavelengths > medium.valid[1])
    lost = float((response[:, outside].sum(1) / response.sum(1)).max())
    if not lost:
        return ""
    text = f"{label}: {medium.name} has an index from {medium.valid[0]:g} to {medium.valid[1]:g} nm"
    if lost > LOST:
        raise ValueError(f"{text}: outside it is {lost:.1%} of the colour; expected a medium with at most {LOST:.1%}")
    return f"{text}; other light ({lost:.1e} of the colour) is lost there"


def _responses(wavelengths: Any) -> Any:
    """x̄, ȳ, z̄ in three rows."""
    import numpy as np

    response: Any = mi.cie1931_xyz
    if dr.is_jit_v(mi.Float):
        return np.array(response(mi.Float(wavelengths)))
    return np.array([[float(x) for x in response(float(w))] for w in wavelengths]).T
