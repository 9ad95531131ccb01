"""pyoptools' `Plane.propagate` in double precision, ray by ray, each turned into the frame of a plane.

A pyoptools surface takes rays in its own frame, where the normal of a plane is (0, 0, 1). Turning there and back is
done here.
"""

from importlib.metadata import version

import numpy as np
import table
from pyoptools.raytrace.ray import Ray
from pyoptools.raytrace.surface import Plane

PLANE = Plane()


def refract(a, frame, n_from, n_to):
    """The direction behind the plane; the one of the reflected ray where pyoptools gives that."""
    ray = Ray(origin=(0, 0, -1), direction=tuple(a @ frame), n=n_from)
    (child,) = PLANE.propagate(ray, n_from, n_to)
    return frame @ np.array(child.direction)


rays = table.Rays("float64")
rows = zip(rays.a, table.frames(-rays.n), rays.n_from.tolist(), rays.n_to.tolist(), strict=True)
table.write(rays, np.array([refract(*ray) for ray in rows]), f"pyoptools {version('pyoptools')}")
