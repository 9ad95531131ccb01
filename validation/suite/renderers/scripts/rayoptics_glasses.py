"""rayoptics' `bend` for rays between glasses and air, with the indices of opticalglass, by catalogue and name."""

import functools
from importlib.metadata import version

import glasses
import numpy as np
from opticalglass.glassfactory import create_glass
from rayoptics.raytr.raytrace import bend
from rayoptics.raytr.traceerror import TraceTIRError

CATALOGUES = {name.upper(): name for name in ("CDGM", "Hikari", "Hoya", "Ohara", "Schott", "Sumita")}
glass = functools.cache(lambda catalogue, name: create_glass(name, CATALOGUES[catalogue]))


def refract(a, n, n_from, n_to):
    try:
        return bend(a, n, n_from, n_to)
    except TraceTIRError:
        return np.full(3, np.nan)


rays = glasses.Rays(lambda catalogue, name, wavelength: glass(catalogue, name).rindex(wavelength))
b = [refract(*ray) for ray in zip(rays.a, rays.n, rays.n_from.tolist(), rays.n_to.tolist(), strict=True)]
glasses.write(rays, b, f"rayoptics {version('rayoptics')}, opticalglass {version('opticalglass')}")
