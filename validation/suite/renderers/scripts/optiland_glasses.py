"""optiland's `RealRays.refract` for rays between glasses and air, with its own materials, by catalogue and name.

The catalogue is always said: `Material("F2")` alone is Hikari's F2, not Schott's.
"""

import functools
from importlib.metadata import version

import glasses
import numpy as np
from optiland.materials import Material
from optiland.rays import RealRays

glass = functools.cache(lambda catalogue, name: Material(name, catalog=catalogue.lower(), match_policy="strict"))

rays = glasses.Rays(lambda catalogue, name, wavelength: np.ravel(glass(catalogue, name).n(wavelength / 1000))[0])
zero = np.zeros(len(rays))
bundle = RealRays(zero, zero, zero, *rays.a.T, intensity=zero + 1, wavelength=rays.wavelength / 1000)
bundle.refract(*rays.n.T, rays.n_from, rays.n_to)
glasses.write(rays, np.stack([bundle.L, bundle.M, bundle.N], axis=1), f"optiland {version('optiland')}")
