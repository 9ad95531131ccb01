"""raysect's `Dielectric`, whose own code bends each ray and hands the next one to `spawn_daughter`, where it is kept.

It chooses reflection or transmission by chance. With `transmission_only` it spawns no ray under total internal
reflection; then it is asked again without, and spawns the reflected one.
"""

from importlib.metadata import version

import numpy as np
import table
from raysect.core import AffineMatrix3D, Intersection, Normal3D, Point3D, Vector3D
from raysect.optical import ConstantSF, Ray, World
from raysect.optical.material import Dielectric
from raysect.primitive import Box

HERE, PLACE = Point3D(0, 0, 0), AffineMatrix3D()


class Kept(Ray):
    """A ray that remembers its daughter's direction."""

    daughter = None

    def spawn_daughter(self, origin, direction):
        self.daughter = direction
        return super().spawn_daughter(origin, direction)


def refract(a, n, n_from, n_to):
    return bent(a, n, n_from, n_to, True) or bent(a, n, n_from, n_to, False)


def bent(a, n, n_from, n_to, transmission_only):
    """The daughter's direction, or None. The normal points against the ray, so that it enters the medium."""
    glass = Dielectric(ConstantSF(n_to), ConstantSF(1), ConstantSF(n_from), transmission_only)
    ray, normal = Kept(HERE, Vector3D(*a)), Normal3D(*n)
    crossing = Intersection(ray, 0.0, BODY, HERE, HERE, HERE, normal, False, PLACE, PLACE)
    glass.evaluate_surface(EMPTY, ray, BODY, HERE, False, HERE, HERE, normal, PLACE, PLACE, crossing)
    return ray.daughter


EMPTY, BODY = World(), Box()
rays = table.Rays("float64")
columns = zip(rays.a.tolist(), rays.n.tolist(), rays.n_from.tolist(), rays.n_to.tolist(), strict=True)
b = [[found.x, found.y, found.z] for found in (refract(*ray) for ray in columns)]
table.write(rays, np.array(b), f"raysect {version('raysect')}")
