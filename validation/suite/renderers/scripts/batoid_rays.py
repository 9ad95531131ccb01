"""batoid's `Plane.refract` in double precision: each ray meets a plane of its own, turned to have the ray's normal.

batoid turns the ray into the frame of that plane, where the normal is (0, 0, 1), and answers in it; turning back is
done here. Its planes have two media of one index each, and its rays a velocity of 1/index.
"""

from importlib.metadata import version

import batoid
import numpy as np
import table


def refract(a, frame, n_from, n_to):
    """The direction behind a plane through the origin; of NaN where batoid says that the ray failed."""
    media = batoid.ConstMedium(n_from), batoid.ConstMedium(n_to)
    ray = batoid.RayVector(*-a, *(a / n_from))
    batoid.Plane().refract(ray, *media, coordSys=batoid.CoordSys(rot=frame))
    return np.full(3, np.nan) if ray.failed[0] else frame @ ray.v[0] * n_to


rays = table.Rays("float64")
rows = zip(rays.a, table.frames(-rays.n), rays.n_from.tolist(), rays.n_to.tolist(), strict=True)
table.write(rays, [refract(*ray) for ray in rows], f"batoid {version('batoid')}")
