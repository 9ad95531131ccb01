"""`refract` of prysm's ray tracer by Spencer and Murty, in double precision; ray by ray, for a call has one ratio."""

from importlib.metadata import version

import numpy as np
import table
from prysm.experimental.raytracing.spencer_and_murty import refract

rays = table.Rays("float64")
rows = zip(rays.n_from.tolist(), rays.n_to.tolist(), rays.a[:, None], -rays.n[:, None], strict=True)
with np.errstate(invalid="ignore"):
    b = np.concatenate([refract(*ray) for ray in rows])
table.write(rays, b, f"prysm {version('prysm')}")
