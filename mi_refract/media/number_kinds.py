"""What formulas need of numbers, for floats, numpy arrays and Dr.Jit arrays. NumPy is imported where it is used."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr

from mi_refract.numerics import Mask, Number


def wide(x: Number) -> Number:
    """In double precision; a float as an array of numpy without dimensions, whose operations raise nothing."""
    if dr.is_array_v(x):
        double: Any = dr.float64_array_t(type(x))
        return double(x)
    import numpy as np

    return np.asarray(x, np.float64)


def like(x: Number, model: Number) -> Number:
    """A float where `model` is one, and `x` not more than that; otherwise `x`."""
    if dr.is_array_v(x) or dr.is_array_v(model):
        return x
    import numpy as np

    return float(x) if np.ndim(x) == np.ndim(model) == 0 else x


def where(condition: Mask, x: Number, y: Number) -> Number:
    """`x` where the condition holds, else `y`."""
    if any(dr.is_array_v(each) for each in (condition, x, y)):
        return dr.select(condition, x, y)
    import numpy as np

    return np.where(condition, x, y)


def root(x: Number) -> Number:
    """√x, NaN below 0."""
    if dr.is_array_v(x):
        return dr.sqrt(x)
    import numpy as np

    with np.errstate(invalid="ignore"):
        return np.sqrt(x)


def nan_unless(condition: Mask, x: Number) -> Number:
    """`x` where the condition holds, else NaN."""
    return where(condition, x, math.nan)
