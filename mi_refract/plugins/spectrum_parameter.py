"""Parameters of a plugin that are spectra: the numbers behind them, whatever Mitsuba made of what a scene says."""

from __future__ import annotations

from typing import Any, NamedTuple

import mitsuba as mi


class Knots(NamedTuple):
    """A piecewise linear function of the wavelength in nm; one knot is a constant."""

    wavelengths: tuple[float, ...]  # increasing; empty for a constant
    values: tuple[float, ...]


def read_knots(value: Any) -> Knots | None:
    """The knots of a `<spectrum>` or of a plugin `uniform`, `regular` or `irregular`; None for anything else."""
    if type(value).__name__ == "Spectrum":  # `mi.Spectrum` is another class in every variant
        return Knots(() if value.is_uniform() else _numbers(value.wavelengths), _numbers(value.values))
    kind = value.class_name() if isinstance(value, mi.Object) else ""
    if kind not in ("UniformSpectrum", "RegularSpectrum", "IrregularSpectrum"):
        return None
    shown = mi.traverse(value)
    if kind == "UniformSpectrum":
        return Knots((), _numbers(shown["value"]))
    values = _numbers(shown["values"])
    if kind == "IrregularSpectrum":
        return Knots(_numbers(shown["wavelengths"]), values)
    first, last = _numbers(shown["range"])
    steps = len(values) - 1
    return Knots(tuple(first + (last - first) * (i / steps) for i in range(len(values))), values)


def _numbers(value: Any) -> tuple[float, ...]:
    import numpy as np

    return tuple(float(x) for x in np.atleast_1d(np.array(value)).ravel())
