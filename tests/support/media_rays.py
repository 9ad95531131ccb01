"""Media that need no catalogue, and answers of a program to rays that pass between them and air."""

import numpy as np
from support.ray_programs import glsl

from mi_refract.ray_sets.ray_set import Answers

CROWN, FLINT, WATER = "cauchy(1.5046, 4200)", "table(400: 1.85, 500: 1.80, 700: 1.76)", "MATERIAL:water"
MEDIA, WAVELENGTHS = (CROWN, FLINT, WATER), (486.1327, 587.5618)
ALL = {"media": MEDIA, "wavelengths": WAVELENGTHS}


def answered(to, ratio=None, direction=None, said=True):
    """Answers of a program that uses `ratio` (N,), by default that of the rays, and says so.

    `direction`: the ratio that its directions are for, if another.
    """
    k = to.rays.k if ratio is None else ratio
    b = glsl(to.rays.a, to.rays.n, (k if direction is None else direction).astype(to.rays.k.dtype))
    return Answers(to.ids, b.astype(np.float64), n_ratio=k.astype(np.float64) if said else None)
