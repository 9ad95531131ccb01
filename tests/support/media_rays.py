"""Media without a catalogue, and a program's answers to rays between these media and air."""

import numpy as np
from support.ray_programs import glsl

from mi_refract.ray_sets.ray_set import Answers

CROWN, FLINT, WATER = "cauchy(1.5046, 4200)", "table(400: 1.85, 500: 1.80, 700: 1.76)", "MATERIAL:water"
MEDIA, WAVELENGTHS = (CROWN, FLINT, WATER), (486.1327, 587.5618)
ALL = {"media": MEDIA, "wavelengths": WAVELENGTHS}


def answered(to, ratio=None, direction=None, said=True):
    """Return answers of a program that uses the index ratio `ratio` (N,), by default the rays' own.

    `direction`: the ratio that it uses for directions, if it differs. `said`: whether the answers contain `ratio`.
    """
    k = to.rays.k if ratio is None else ratio
    b = glsl(to.rays.a, to.rays.n, (k if direction is None else direction).astype(to.rays.k.dtype))
    return Answers(to.ids, b.astype(np.float64), n_ratio=k.astype(np.float64) if said else None)
