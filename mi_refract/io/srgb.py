"""The transfer function of sRGB (IEC 61966-2-1)."""

from __future__ import annotations

from typing import Any

import numpy as np


def encoded(linear: Any) -> np.ndarray:
    """Linear values of any shape, clipped to 0 … 1, as sRGB codes from 0 to 1."""
    x = np.clip(linear, 0, 1)
    return np.asarray(np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055))


def decoded(code: Any) -> np.ndarray:
    """The inverse: codes from 0 to 1 as linear values."""
    code = np.asarray(code)
    return np.asarray(np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4))
