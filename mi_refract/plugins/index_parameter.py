"""The indices of a boundary, as parameters of `refract`: numbers, names, dispersive media, textures.

Mitsuba's material names mean the constants of its table. A ratio of indices that is not one number is a function of the
wavelength (`DispersiveRatio`) or of the point on the surface (`TexturedRatio`), in float64. Where no index exists it is
NaN, and such light is lost.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from mi_refract import media
from mi_refract.formulas import LARGEST_RATIO, SMALLEST_RATIO
from mi_refract.media import TABLE_VALUES, Medium, Table
from mi_refract.numerics import (
    ArrayType,
    Interaction,
    Mask,
    Number,
    Properties,
    Texture,
    Variant,
    differentiated,
    replace_grad,
)

PLUGIN = "refract"  # the name of the BSDF in Mitsuba
DEFAULTS = {"int_ior": "bk7", "ext_ior": "air"}
EXPECTED = "a positive finite number, or a material's name, a glass or formula (mi_refract.media), spectrum or texture"
warned: set[str] = set()  # texts that `warn_once` has logged
LUMINANCE = 0.212671, 0.715160, 0.072169  # weights of linear sRGB in the luminance, as in Mitsuba
THICK = 1.0  # metres: absorption that takes longer to halve the light does not matter
LOST = 1e-3  # the largest share of the colour of white light that may lie outside a medium's range


def warn_once(text: str) -> None:
    """Write a warning to Mitsuba's log, once a process."""
    if text not in warned:
        warned.add(text)
        mi.Log(mi.LogLevel.Warn, text)  # type: ignore[operator]


def parameter_type(v: Variant) -> ArrayType:
    """Return the type of numbers that `mi.traverse` exposes. In scalar variants Mitsuba cannot set a Python float."""
    scalar: Any = dr.scalar
    number: ArrayType = v.Float if dr.is_jit_v(v.Float) else scalar.Array1f
    return number


def one_number(name: str, value: Number) -> Number:
    """Return the value of a parameter of type `parameter_type`; ValueError if an edit gave it several entries.

    It is not read: numbers cannot be read while a function is recorded.
    """
    if len(value) != 1:
        raise ValueError(f"{PLUGIN}: {name} has {len(value)} entries; expected one number")
    return value if dr.is_jit_v(value) else value[0]


class DispersiveRatio:
    """n_int/n_ext of two media by wavelength. Their coefficients are differentiable parameters, such as `int_ior_B`."""

    DRJIT_STRUCT: ClassVar = {"shown": dict, "exact": dict}  # for frozen functions

    def __init__(self, v: Variant, inside: Medium, outside: Medium) -> None:
        """`v`: the variant's module."""
        self.sides = {"int_ior": inside, "ext_ior": outside}
        self.wide: ArrayType = dr.float64_array_t(v.Float)
        shown = [(f"{s}_{k}", x) for s, m in self.sides.items() if m.dispersive for k, x in m.coefficients.items()]
        number: Any = parameter_type(v)
        wide: Any = self.wide
        self.shown: dict[str, Number] = {name: number(value) for name, value in shown}
        self.exact: dict[str, Number] = {name: wide(value) for name, value in shown}
        # Coefficients that are values of a table: name of the coefficient → name of the array of values, and position.
        self.places: dict[str, tuple[str, int]] = {}
        for side, medium in self.sides.items():
            if isinstance(medium.dispersion, Table) and dr.is_jit_v(wide):
                values = f"{side}_{TABLE_VALUES}"
                self.exact[values] = wide([*medium.coefficients.values()])
                self.places |= {f"{side}_{key}": (values, i) for i, key in enumerate(medium.coefficients)}
        # Opaque, so that an edit changes the data of a kernel and not its code.
        dr.make_opaque(*self.shown.values(), *self.exact.values())

    def at(self, wavelength: Number) -> Number:
        """Return the ratio at a wavelength in nm, in float64; NaN outside the range of either medium.

        Each call builds the graph of the derivatives in the coefficients again, as `dr.backward` frees it.
        """
        values = dict(self.exact)
        for key, shown in self.shown.items():
            if differentiated(shown):
                values[key] = replace_grad(values[key], self.wide(shown))
        coefficients = [{k[len(s) + 1 :]: x for k, x in values.items() if k.startswith(s)} for s in self.sides]
        inside, outside = self.sides.values()
        return media.relative_index(inside, outside, wavelength, *coefficients)

    def visible(self) -> list[float]:
        """Return some wavelengths of visible light that both media have an index for."""
        import numpy as np

        ranges = [(mi.MI_CIE_MIN, mi.MI_CIE_MAX), *(side.valid for side in self.sides.values() if not side.hold)]
        first, last = max(low for low, _ in ranges), min(high for _, high in ranges)
        return np.linspace(first, last, 33).tolist() if first <= last else []

    @property
    def differentiated(self) -> bool:
        """Whether derivatives of a coefficient are tracked."""
        return any(map(differentiated, self.shown.values()))

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the coefficients. Names contain no dot: Mitsuba reports changes by what follows the last dot."""
        for name, value in self.shown.items():
            cb.put(name, value, mi.ParamFlags.Differentiable)

    def changed(self, keys: Collection[str]) -> None:
        """Read the edited coefficients; those that were not edited keep their double precision."""
        for key in [key for key in self.shown if not keys or key in keys]:
            shown = one_number(key, self.shown[key])
            self.exact[key] = self.wide(dr.detach(shown))
            if key in self.places:
                values, position = self.places[key]
                dr.scatter(self.exact[values], self.exact[key], position)
        dr.make_opaque(*self.shown.values(), *self.exact.values())


class TexturedRatio:
    """n_int/n_ext where one of them, or both, is a texture of numbers."""

    DRJIT_STRUCT: ClassVar = {"sides": dict}  # for frozen functions
    differentiated = False  # no coefficient exists; derivatives of a texture's values are tracked by the texture

    def __init__(self, v: Variant, sides: Mapping[str, Texture | float]) -> None:
        """`v`: the variant's module. `sides`: `int_ior` and `ext_ior`."""
        self.sides = sides
        self.wide: ArrayType = dr.float64_array_t(v.Float)

    def at(self, si: Interaction, active: Mask) -> Number:
        """Return the ratio in float64; NaN where it is not a ratio of indices."""
        inside, outside = (self.wide(n if isinstance(n, float) else n.eval_1(si, active)) for n in self.sides.values())
        eta = inside / outside
        return dr.select((eta >= SMALLEST_RATIO) & (eta <= LARGEST_RATIO), eta, dr.nan)

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the textures."""
        for name, texture in self.sides.items():
            if not isinstance(texture, float):
                cb.put(name, texture, mi.ParamFlags.Differentiable)

    def changed(self, keys: Collection[str]) -> None:
        """Do nothing: textures read their own edits."""


def read_ratio(v: Variant, props: Properties) -> tuple[DispersiveRatio | TexturedRatio | None, float]:
    """Return the ratio of a boundary if it is not one number, else None; and its value at the d line, 1 for textures.

    `v`: the variant's module. ValueError names plugin, parameter and what is expected. Logs a warning if a medium has a
    k that is not rendered.
    """
    import numpy as np

    indices = {name: read_index(v, props, name, default) for name, default in DEFAULTS.items()}
    dispersive = [name for name, index in indices.items() if isinstance(index, Medium) and index.dispersive]
    d_line = media.LINES["d"]
    if not all(isinstance(index, Medium) for index in indices.values()):
        if dispersive:
            raise ValueError(
                f"{PLUGIN}: {dispersive[0]} is dispersive, but the other index is a texture; expected one index for "
                "all wavelengths"
            )
        return TexturedRatio(v, {k: x.index(d_line) if isinstance(x, Medium) else x for k, x in indices.items()}), 1.0
    inside, outside = indices.values()
    number = float(media.relative_index(inside, outside, d_line))
    for name in dispersive:
        label, medium = f"{PLUGIN}: {name}: {indices[name].name}", indices[name]
        absorption = name.replace("ior", "absorption")
        if medium.k and not {absorption, name.replace("ior", "colour")} & {*props.keys()}:
            visible = np.arange(400.0, 701.0)
            with np.errstate(divide="ignore"):
                absorbing = 4 * math.pi * np.interp(visible, medium.k[0], medium.k[1], 0, 0)
                half_left = math.log(2) * 1e-9 * visible / absorbing  # metres
            shortest = half_left.min()
            if shortest < THICK:
                wavelength = visible[half_left.argmin()]
                warn_once(
                    f"{label} has k: of light at {wavelength:g} nm half is left after {shortest:.2g} m, which is "
                    f"rendered only with {absorption} and {absorption}_unit"
                )
        if not v.is_spectral:
            try:
                medium.index(d_line)
            except ValueError as error:
                raise ValueError(f"{PLUGIN}: {name}: {error}") from None
            warn_once(f"{label}: all light has the index of the d line, 587.6 nm, in this variant")
        else:
            effect = "has the index of the range's end" if medium.hold else "is lost"
            check_range(f"{label} has an index", medium.valid, medium.hold, effect)
    return DispersiveRatio(v, inside, outside) if dispersive else None, number


def check_range(label: str, valid: tuple[float, float], hold: bool, effect: str) -> None:
    """Log a warning if visible light lies outside a range in nm; ValueError if more than LOST does, without `hold`.

    The measure is the largest share of X, Y and Z, for light of equal power at all wavelengths. `label`: what has the
    range, `effect`: what happens to light outside of it, for the messages.
    """
    import numpy as np

    wavelengths = np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + 1.0)
    response: Any = mi.cie1931_xyz
    lanes = [mi.Float(wavelengths)] if dr.is_jit_v(mi.Float) else wavelengths.tolist()
    xyz = np.concatenate([np.array(response(x), float).reshape(3, -1) for x in lanes], axis=1)
    shares = xyz / xyz.sum(1, keepdims=True)
    lost = shares[:, (wavelengths < valid[0]) | (wavelengths > valid[1])].sum(1).max()
    label = f"{label} from {valid[0]:g} to {valid[1]:g} nm"
    share = f"{np.format_float_positional(100 * lost, 2, fractional=False, trim='-')}% of the colour"
    if lost > LOST and not hold:
        below = np.cumsum(shares, axis=1)
        low = wavelengths[np.argmax(below.max(0) > LOST / 2)]  # LOST / 2 on either side
        high = wavelengths[np.argmax(below.min(0) >= 1 - LOST / 2)]
        raise ValueError(
            f"{label}: {share} lies outside; expected at least {low:g} … {high:g} nm, or hold(…) around the text, to "
            "extend the values at its ends"
        )
    if lost:
        warn_once(f"{label}; other light ({share}) {effect}")


def find_file(name: str) -> Path:
    """Return the path by which Mitsuba finds a file; it looks in the folder of the scene first."""
    untyped: Any = mi  # its stubs have no types for file resolvers
    return Path(str(untyped.file_resolver().resolve(name)))


def read_ior(props: Properties, name: str, default: str) -> float:
    """Return an index that is one number, in double precision. ValueError for others, and as `read_index`."""
    medium = read_medium(props, name, default)
    if not medium.dispersive:
        return float(medium.index(media.LINES["d"]))
    raise ValueError(f"{PLUGIN}: {name} = {props[name]}; expected one number for all wavelengths and points")


def read_medium(props: Properties, name: str, default: str) -> Medium:
    """Return the parameter's `Medium`. ValueError for a texture, and as `read_index`."""
    index = read_index(mi, props, name, default)
    if isinstance(index, Medium):
        return index
    raise ValueError(f"{PLUGIN}: {name} = {props[name]}; expected the same index at all points")


def read_index(v: Variant, props: Properties, name: str, default: str) -> Medium | Texture:
    """Return the parameter's `Medium` or texture. `v`: the variant's module.

    ValueError names plugin, parameter, value and what is expected.
    """
    value, label = props.get(name, default), f"{PLUGIN}: {name}"
    if isinstance(value, (str, int, float)) and not isinstance(value, bool):
        return media.parse(value, label, find_file)
    if knots := read_knots(value):
        if not knots[0]:
            return media.parse(knots[1][0], name=label)
        table = "table(" + ", ".join(f"{w!r}: {n!r}" for w, n in zip(*knots, strict=True)) + ")"
        if not v.is_spectral:
            raise ValueError(f"{label}: this variant converts spectra to colours; use the string {name} = {table!r}")
        return media.parse(table, name=label)
    if isinstance(value, mi.Object) and hasattr(value, "is_spatially_varying"):
        _check_texture(v, label, value)
        return value
    raise ValueError(f"{label} = {value!r}; expected {EXPECTED}")


def _check_texture(v: Variant, label: str, texture: Texture) -> None:
    """ValueError if a texture has a value that is not an index, as far as `mi.traverse` exposes its values.

    The index of an RGB colour is its luminance. In spectral variants RGB textures store coefficients of spectra, which
    are not checked.
    """
    import numpy as np

    parameters = mi.traverse(texture)
    for name in parameters.keys():  # noqa: SIM118 (no dict)
        if name.rpartition(".")[2] not in ("data", "value"):
            continue
        values = np.array(parameters[name], np.float64)
        values = values.reshape(-1, 3) if values.size == 3 and name.endswith("value") else values  # one colour
        if values.shape[-1:] == (3,):
            if v.is_spectral:
                continue
            values = values @ LUMINANCE
        invalid = values[~((values >= SMALLEST_RATIO) & (values <= LARGEST_RATIO))]
        if invalid.size:
            expected = f"indices from {SMALLEST_RATIO:.2g} to {LARGEST_RATIO:.2g}"
            raise ValueError(f"{label}: its texture contains {invalid[0]:g}; expected {expected} everywhere")


def read_knots(value: Any) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Return the knots of a `<spectrum>` or of a plugin `uniform`, `regular` or `irregular`; None for anything else.

    They define a piecewise linear function: increasing wavelengths in nm, () for a constant, and the values.
    """
    import numpy as np

    def numbers(value: Any) -> tuple[float, ...]:
        return tuple(np.array(value, float).ravel().tolist())

    if type(value).__name__ == "Spectrum":  # `mi.Spectrum` is another class in every variant
        return (() if value.is_uniform() else numbers(value.wavelengths), numbers(value.values))
    kind = value.class_name() if isinstance(value, mi.Object) else ""
    if kind not in ("UniformSpectrum", "RegularSpectrum", "IrregularSpectrum"):
        return None
    parameters = mi.traverse(value)
    if kind == "UniformSpectrum":
        return (), numbers(parameters["value"])
    values = numbers(parameters["values"])
    if kind == "IrregularSpectrum":
        return numbers(parameters["wavelengths"]), values
    (first, last), steps = numbers(parameters["range"]), len(values) - 1
    return tuple(first + (last - first) * (i / steps) for i in range(len(values))), values
