"""raysect's `Dielectric` for rays between glasses and air, with the glasses of its library, Schott's catalogue of 2000.

A ray of raysect has the mean of the index over its range of wavelengths, 375 to 785 nm if nothing else is said. Here
the range is as narrow as rounding allows, and the ratio is that of the means. It bends as in `raysect_rays.py`.
"""

import functools
from importlib.metadata import version

import glasses
import numpy as np
from raysect.core import AffineMatrix3D, Intersection, Normal3D, Point3D, Vector3D
from raysect.optical import ConstantSF, Ray, World
from raysect.optical.library import schott
from raysect.optical.material import Dielectric
from raysect.primitive import Box

HERE, PLACE = Point3D(0, 0, 0), AffineMatrix3D()
HALF = 1e-6  # nm, of the range
EMPTY, BODY = World(), Box()


class Kept(Ray):
    """A ray that remembers its daughter's direction."""

    daughter = None

    def spawn_daughter(self, origin, direction):
        self.daughter = direction
        return super().spawn_daughter(origin, direction)


@functools.cache
def dispersion(medium):
    return ConstantSF(1) if medium == "air" else schott(medium.partition(":")[2]).index


def index(maker, name, wavelength):
    return dispersion(f"{maker}:{name}").average(wavelength - HALF, wavelength + HALF)


def refract(a, n, wavelength, left, entered):
    return bent(a, n, wavelength, left, entered, True) or bent(a, n, wavelength, left, entered, False)


def bent(a, n, wavelength, left, entered, transmission_only):
    """The daughter's direction, or None. The normal points against the ray, so that it enters the medium."""
    glass = Dielectric(dispersion(entered), ConstantSF(1), dispersion(left), transmission_only)
    ray = Kept(HERE, Vector3D(*a), wavelength - HALF, wavelength + HALF, 1)
    normal = Normal3D(*n)
    crossing = Intersection(ray, 0.0, BODY, HERE, HERE, HERE, normal, False, PLACE, PLACE)
    glass.evaluate_surface(EMPTY, ray, BODY, HERE, False, HERE, HERE, normal, PLACE, PLACE, crossing)
    return ray.daughter


rays = glasses.Rays(index)
columns = zip(rays.a.tolist(), rays.n.tolist(), rays.wavelength.tolist(), rays.left, rays.entered, strict=True)
b = [[found.x, found.y, found.z] for found in (refract(*ray) for ray in columns)]
glasses.write(rays, np.array(b), f"raysect {version('raysect')}")
