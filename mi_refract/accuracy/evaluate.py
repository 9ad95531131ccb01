"""Formulas, called on rays that are numpy arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from mi_refract.numerics import ArrayType, Mask, Number, Vector3, from_numpy
from mi_refract.regimes import Array, Rays

# What is called as the entries of FORMULAS are: `subject(a, n, k) -> (b, transmitted)`.
Subject: TypeAlias = Callable[[Vector3, Vector3, Number], tuple[Vector3, Mask]]


def evaluate(subject: Subject, rays: Rays, vector: ArrayType) -> tuple[Array, NDArray[np.bool_]]:
    """(b, transmitted) of all rays, (N, 3) in extended precision and (N,).

    `vector`: the 3-vector type of Dr.Jit to compute with. With scalar types the subject is called ray by ray.
    """
    if dr.is_jit_v(vector):
        b, transmitted = subject(*arrays(rays, vector))
        dr.eval(b, transmitted)  # in one kernel
        parts = np.broadcast_arrays(*(np.array(x) for x in b))
        return np.stack(parts, 1).astype(np.longdouble), np.array(transmitted)
    pairs = [subject(vector(a), vector(n), float(k)) for a, n, k in zip(rays.a, rays.n, rays.k, strict=True)]
    return np.array([list(b) for b, _ in pairs], np.longdouble), np.array([t for _, t in pairs], bool)


def arrays(rays: Rays, vector: ArrayType) -> tuple[Vector3, Vector3, Number]:
    """(a, n, k) of all rays, as vectors of a vectorised type and their numbers."""
    return from_numpy(vector, rays.a), from_numpy(vector, rays.n), from_numpy(dr.value_t(vector), rays.k)
