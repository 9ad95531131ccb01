"""optiland's `RealRays.refract`, in double precision. With `glasses`: between its own glasses.

The catalogue is always given, since `Material("F2")` alone is Hikari's F2, not Schott's.
"""

import functools
import sys
from importlib.metadata import version

import numpy as np
import table
from optiland.materials import Material
from optiland.rays import RealRays

glass = functools.cache(lambda catalogue, name: Material(name, catalog=catalogue.lower(), match_policy="strict"))


def index(catalogue, name, wavelength):
    return np.ravel(glass(catalogue, name).n(wavelength / 1000))[0]


between_glasses = sys.argv[1:] == ["glasses"]
rays = table.Rays("float64", index if between_glasses else None)
zero = np.zeros(len(rays))
wavelength = rays.wavelength / 1000 if between_glasses else zero + 0.5
bundle = RealRays(zero, zero, zero, *rays.a.T, intensity=zero + 1, wavelength=wavelength)
bundle.refract(*rays.n.T, rays.n_from, rays.n_to)
table.write(rays, np.stack([bundle.L, bundle.M, bundle.N], axis=1), f"optiland {version('optiland')}")
