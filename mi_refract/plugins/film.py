"""The film of a sensor: its colours, its filter, and sums of splats that have the same bits in any order."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, TypeAlias

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import Count, Mask, Number, Point2, Sensor, Spectrum, Variant

if TYPE_CHECKING:  # the plugin needs no numpy
    import numpy as np
    from numpy.typing import NDArray

    Doubles: TypeAlias = NDArray[np.float64]

Film: TypeAlias = Any  # an `mi.Film`
Filter: TypeAlias = Any  # an `mi.ReconstructionFilter`

STEP = 1 / 256  # of a pixel, at which filters are integrated
# A float32 is an integer in units of 2^LOWEST. Its digits of 32 bits are added up in 64 bits, as integers have the same
# sum in any order of threads. A pixel takes 2^31 splats.
BITS = 32
DIGITS, LOWEST = 5, -87  # of values from 2^-64 to 2^64
SQUARES_DIGITS, SQUARES_LOWEST = 8, -135


class Splats:
    """Exact sums of what reaches each pixel, in each channel, under the film's reconstruction filter; or of squares."""

    def __init__(self, v: Variant, sensor: Sensor, channels: int, *, squares: bool = False) -> None:
        """`v`: the variant's module."""
        self.v, self.vectorised, self.channels, self.squares = v, dr.is_jit_v(v.Float), channels, squares
        self.per_sum, self.lowest = (SQUARES_DIGITS, SQUARES_LOWEST) if squares else (DIGITS, LOWEST)
        film = sensor.film()
        self.width, self.height = (int(n) for n in film.crop_size())
        self.rfilter: Any = None if film.rfilter().is_box_filter() else film.rfilter()
        self.reach = math.ceil(self.rfilter.radius() - 0.5) if self.rfilter else 0
        self.count = self.width * self.height * channels
        if self.vectorised:
            self.wide: Any = dr.uint64_array_t(v.Float)
            kind: Any = self.wide
            self.digits: Any = dr.zeros(kind, self.count * self.per_sum)
            dr.make_opaque(self.digits)
            self.beyond = dr.opaque(v.UInt32, 0, self.count)  # splats that are too large, or not finite
        else:
            self.sums = [0.0] * self.count

    def add(self, place: Point2, values: list[Number], active: Mask) -> None:
        """`place`: in pixels, from the corner of the film's crop window."""
        x, y = (self.v.Int32(dr.floor(place[i])) for i in range(2))
        for j in range(-self.reach, self.reach + 1):
            for i in range(-self.reach, self.reach + 1):
                weight, inside = 1.0, active
                if self.rfilter:
                    weight = self._weight(x + i + 0.5 - place.x) * self._weight(y + j + 0.5 - place.y)
                    inside = active & (x + i >= 0) & (x + i < self.width) & (y + j >= 0) & (y + j < self.height)
                index = ((y + j) * self.width + x + i) * self.channels
                for channel, value in enumerate(values):
                    share = value * weight
                    self._add(index + channel, dr.square(share) if self.squares else share, inside)

    def _weight(self, apart: Number) -> Number:
        near = dr.abs(apart) <= self.rfilter.radius()
        return dr.select(near, self.rfilter.eval(apart), 0)

    def _add(self, index: Count, value: Number, active: Mask) -> None:
        v = self.v
        if not self.vectorised:
            if active:
                self.sums[int(index)] += value
            return
        index = v.UInt32(dr.select(active, index, 0))
        bits: Any = dr.reinterpret_array(v.UInt32, v.Float32(value))
        shift = v.Int32((bits >> 23) & 255) - (150 + self.lowest)
        large = active & (shift >= BITS * (self.per_sum - 1))
        kept = active & (shift >= 0) & (large ^ True)
        dr.scatter_add(self.beyond, v.UInt32(1), index, large)
        shift = v.UInt32(dr.select(kept, shift, 0))
        whole = self.wide((bits & 0x7FFFFF) | 0x800000) << self.wide(shift % BITS)
        first = index * self.per_sum + shift // BITS
        for more, digit in enumerate((whole & 0xFFFFFFFF, whole >> BITS)):
            dr.scatter_add(self.digits, dr.select(bits >> 31 != 0, self.wide(0) - digit, digit), first + more, kept)

    def image(self) -> Any:
        """The sums, H × W × channels, in float64; NaN where a splat was too large or not finite."""
        import numpy as np

        shape = self.height, self.width, self.channels
        if not self.vectorised:
            return np.array(self.sums).reshape(shape)
        double: Any = dr.float64_array_t(self.v.Float)
        signed: Any = dr.int64_array_t(self.v.Float)
        first, sums = dr.arange(self.v.UInt32, self.count) * self.per_sum, dr.zeros(double, self.count)
        for i in reversed(range(self.per_sum)):
            digit = dr.gather(self.wide, self.digits, first + i)
            sums += double(dr.reinterpret_array(signed, digit)) * 2.0 ** (BITS * i + self.lowest)
        return np.array(dr.select(self.beyond > 0, dr.nan, sums)).reshape(shape)


def film_colours(v: Variant, spectrum: Spectrum, wavelengths: Number, channels: tuple[str, ...]) -> list[Number]:
    """What a film with these channels makes of a sample's spectrum: R, G, B, or X, Y, Z, or Y."""
    spectrum = v.unpolarized_spectrum(spectrum)
    if v.is_spectral:
        colour = v.spectrum_to_srgb(spectrum, wavelengths)
    else:
        colour = v.Color3f(spectrum.x) if v.is_monochromatic else v.Color3f(spectrum)
    if channels[0] == "X":
        colour = v.srgb_to_xyz(colour)
    return list(colour) if channels[0] in ("R", "X") else [v.luminance(colour)]


def expected_weights(film: Film) -> Doubles | None:
    """∫ w over all places of samples, for each pixel, H × W × 1; None for a box. Filters are products of two in 1D."""
    import numpy as np

    rfilter = film.rfilter()
    if rfilter.is_box_filter():
        return None
    weights = filter_weights(rfilter)
    half = len(weights) // 2
    ends, sums = np.arange(-half, half + 1) * STEP, np.cumsum([0, *weights]) * STEP

    def along(pixels: int) -> Doubles:
        middle = np.arange(pixels) + 0.5
        border = half if film.sample_border() else 0
        return np.asarray(np.interp(pixels + border - middle, ends, sums) - np.interp(-border - middle, ends, sums))

    width, height = (int(n) for n in film.crop_size())
    return np.asarray(along(height)[:, None, None] * along(width)[:, None])


def filter_weights(rfilter: Filter) -> Doubles:
    """The weights in one dimension, at STEPs from −radius to radius."""
    import numpy as np

    half = math.ceil(rfilter.radius() / STEP)
    places = (np.arange(-half, half) + 0.5) * STEP
    weights = rfilter.eval(mi.Float(places)) if dr.is_jit_v(mi.Float) else [rfilter.eval(place) for place in places]
    return np.where(np.abs(places) <= rfilter.radius(), np.array(weights, np.float64), 0)
