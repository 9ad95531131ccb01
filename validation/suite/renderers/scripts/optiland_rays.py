"""`RealRays.refract` of optiland, a lens designer's ray tracer in double precision."""

from importlib.metadata import version

import numpy as np
import table
from optiland.rays import RealRays

rays = table.Rays("float64")
zero = np.zeros(len(rays))
bundle = RealRays(zero, zero, zero, *rays.a.T, intensity=zero + 1, wavelength=zero + 0.5)
bundle.refract(*rays.n.T, rays.n_from, rays.n_to)
table.write(rays, np.stack([bundle.L, bundle.M, bundle.N], axis=1), f"optiland {version('optiland')}")
