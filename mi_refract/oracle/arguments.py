"""The arguments of the oracle: checks of shapes and dtypes, the mask of invalid rays, exact conversion of numbers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np


def checked(a: Any, n: Any, k: Any, contrast: Any) -> tuple:
    """Check shapes and dtypes; float64 arrays (it holds float32 exactly) and the mask of valid rays."""
    a = floats("a", a, ("N", 3))
    count = len(a)
    n, k = floats("n", n, (count, 3)), np.broadcast_to(floats("k", k, (), (count,)), (count,))
    valid = np.isfinite(a).all(axis=1) & np.isfinite(n).all(axis=1) & a.any(axis=1) & n.any(axis=1)
    valid &= np.isfinite(k) & (k > 0)
    if contrast is not None:
        contrast = np.broadcast_to(floats("contrast", contrast, (), (count,)), (count,))
        valid &= np.isfinite(contrast) & (contrast > -1)
    return a, n, k, contrast, valid


def floats(name: str, x: Any, *shapes: tuple) -> np.ndarray:
    """`x` as float64, exactly. One of `shapes`, where "N" is any length."""
    x = np.asarray(float(x) if isinstance(x, int) else x)
    fits = any(len(s) == x.ndim and all(map(lambda w, m: w in ("N", m), s, x.shape)) for s in shapes)
    if x.dtype not in (np.float32, np.float64) or not fits:
        accepted = " or ".join(f"({', '.join(map(str, s))})" if s else "a number" for s in shapes)
        raise ValueError(f"oracle: {name} is {x.dtype} {x.shape}; expected float32 or float64, {accepted}")
    return x.astype(np.float64)


def rays(a: np.ndarray, n: np.ndarray, k: np.ndarray, contrast: Any, index: np.ndarray) -> Iterator[tuple]:
    """Tuples (ax, ay, az, nx, ny, nz, k, contrast) of Python floats."""
    columns = [x.tolist() for x in (*a[index].T, *n[index].T, k[index])]
    return zip(*columns, [None] * len(index) if contrast is None else contrast[index].tolist(), strict=True)
