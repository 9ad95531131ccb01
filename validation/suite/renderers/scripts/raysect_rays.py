"""raysect's `Dielectric`: it refracts each ray and passes the next one to `spawn_daughter`, which records it here.

It chooses reflection or transmission at random. With `transmission_only` it spawns no ray under total internal
reflection; it is then called again without this option and spawns the reflected ray. With `glasses` the media are those
of its library, Schott's catalogue of 2000. A ray uses the mean of the index over its range of wavelengths, by default
375 to 785 nm. Here the range is as narrow as rounding allows, and the ratio is that of the means.
"""

import functools
import sys
from importlib.metadata import version

import table
from raysect.core import AffineMatrix3D, Intersection, Normal3D, Point3D, Vector3D
from raysect.optical import ConstantSF, Ray, World
from raysect.optical.library import schott
from raysect.optical.material import Dielectric
from raysect.primitive import Box

HERE, PLACE = Point3D(0, 0, 0), AffineMatrix3D()
HALF = 1e-6  # nm: half the range of wavelengths
EMPTY, BODY = World(), Box()


class Kept(Ray):
    """A ray that records its daughter's direction."""

    daughter = None

    def spawn_daughter(self, origin, direction):
        self.daughter = direction
        return super().spawn_daughter(origin, direction)


@functools.cache
def dispersion(medium):
    return ConstantSF(1) if medium == "air" else schott(medium.partition(":")[2]).index


def index(maker, name, wavelength):
    return dispersion(f"{maker}:{name}").average(wavelength - HALF, wavelength + HALF)


def refract(*ray):
    daughter = bent(*ray, True) or bent(*ray, False)
    return daughter.x, daughter.y, daughter.z


def bent(a, n, left, entered, wavelengths, transmission_only):
    """Return the daughter's direction, or None. The normal faces the ray, so the ray enters the medium."""
    glass = Dielectric(entered, ConstantSF(1), left, transmission_only)
    ray, normal = Kept(HERE, Vector3D(*a), *wavelengths), Normal3D(*n)
    crossing = Intersection(ray, 0.0, BODY, HERE, HERE, HERE, normal, False, PLACE, PLACE)
    glass.evaluate_surface(EMPTY, ray, BODY, HERE, False, HERE, HERE, normal, PLACE, PLACE, crossing)
    return ray.daughter


if sys.argv[1:] == ["glasses"]:
    rays = table.Rays("float64", index)
    media = [list(map(dispersion, names)) for names in (rays.left, rays.entered)]
    wavelengths = [(w - HALF, w + HALF, 1) for w in rays.wavelength.tolist()]
else:
    rays = table.Rays("float64")
    media = [list(map(ConstantSF, indices)) for indices in (rays.n_from.tolist(), rays.n_to.tolist())]
    wavelengths = [()] * len(rays)
b = [refract(*ray) for ray in zip(rays.a.tolist(), rays.n.tolist(), *media, wavelengths, strict=True)]
table.write(rays, b, f"raysect {version('raysect')}")
