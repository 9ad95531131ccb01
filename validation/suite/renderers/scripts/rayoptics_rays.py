"""`bend` of rayoptics, a lens designer's ray tracer in double precision, ray by ray; its exception becomes NaN."""

from importlib.metadata import version

import numpy as np
import table
from rayoptics.raytr.raytrace import bend
from rayoptics.raytr.traceerror import TraceTIRError


def refract(a, n, n_from, n_to):
    try:
        return bend(a, n, n_from, n_to)
    except TraceTIRError:
        return np.full(3, np.nan)


rays = table.Rays("float64")
b = [refract(*ray) for ray in zip(rays.a, rays.n, rays.n_from.tolist(), rays.n_to.tolist(), strict=True)]
table.write(rays, b, f"rayoptics {version('rayoptics')}")
