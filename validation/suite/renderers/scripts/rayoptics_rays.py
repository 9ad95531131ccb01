"""rayoptics' `bend`, in double precision, ray by ray; its exception becomes NaN.

With `glasses`: between glasses and air, with the indices of opticalglass, by catalogue and name.
"""

import functools
import sys
from importlib.metadata import version

import numpy as np
import table
from opticalglass.glassfactory import create_glass
from rayoptics.raytr.raytrace import bend
from rayoptics.raytr.traceerror import TraceTIRError

CATALOGUES = {name.upper(): name for name in ("CDGM", "Hikari", "Hoya", "Ohara", "Schott", "Sumita")}
glass = functools.cache(lambda catalogue, name: create_glass(name, CATALOGUES[catalogue]))


def index(catalogue, name, wavelength):
    return glass(catalogue, name).rindex(wavelength)


def refract(a, n, n_from, n_to):
    try:
        return bend(a, n, n_from, n_to)
    except TraceTIRError:
        return np.full(3, np.nan)


between_glasses = sys.argv[1:] == ["glasses"]
rays = table.Rays("float64", index if between_glasses else None)
system = f"rayoptics {version('rayoptics')}" + (f", opticalglass {version('opticalglass')}" if between_glasses else "")
table.write(rays, [refract(*ray) for ray in rays.each()], system)
