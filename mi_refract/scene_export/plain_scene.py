"""A scene as plain data that any renderer can read: triangles, constants, one perspective camera.

Transforms are applied, named indices are numbers, curved shapes are flat triangles, and a checkerboard is two meshes of
one colour each. Coordinates are right-handed, those of the scene file, in its unit of length. Colours are linear RGB
with Rec. 709 primaries.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mi_refract import media

Colour = tuple[float, float, float]
LINES = "FdC"  # the spectral lines in the definition of Abbe's number
WAVELENGTHS = (*(media.LINES[line] for line in LINES), *map(float, range(400, 701, 10)))  # nm


@dataclass(frozen=True)
class Glass:
    """A smooth boundary between two lossless media with these absolute indices of refraction.

    The faces' normals point into the medium of `ext_ior`.
    """

    int_ior: float
    ext_ior: float


@dataclass(frozen=True)
class VolumeGlass(Glass):
    """A glass with dispersion or absorption; `int_ior` and `ext_ior` are its indices at the d line.

    `parameters`: the scene's parameters of dispersion and absorption, for messages. `spectrum`: index of the denser
    medium divided by that of the other at WAVELENGTHS; () without dispersion. `int_sigma`, `ext_sigma`: σ in red, green
    and blue; a path of length t transmits exp(−σ t).
    """

    parameters: str = field(compare=False)
    spectrum: tuple[float, ...] = ()
    int_sigma: Colour = (0.0, 0.0, 0.0)
    ext_sigma: Colour = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Diffuse:
    """A Lambertian surface, the same from both sides."""

    reflectance: Colour


@dataclass(frozen=True)
class Light:
    """A surface that emits `radiance` on the side of its normals, is black from behind, and reflects nothing."""

    radiance: Colour


Material = Glass | Diffuse | Light  # a VolumeGlass is a Glass


@dataclass(frozen=True)
class Mesh:
    """Flat triangles of one material, counterclockwise as seen from the side of their normals. Names are unique.

    `normals` (V, 3): normals of the sphere or the cylinder at each vertex, None for other shapes.
    """

    name: str
    vertices: NDArray[np.float64]  # (V, 3)
    faces: NDArray[np.int64]  # (F, 3), indices of vertices
    material: Material
    normals: NDArray[np.float64] | None = None

    def triangles(self) -> NDArray[np.float64]:
        """Return the corners of each triangle, (F, 3, 3)."""
        return self.vertices[self.faces]

    def volume(self) -> float:
        """Return the volume inside a closed mesh, below 0 if its normals point inward."""
        triangles = self.triangles()
        return float(np.linalg.det(triangles - triangles[:1, :1]).sum() / 6)  # far from the origin it would be rounding


@dataclass(frozen=True)
class Lamp:
    """A lamp without size. Names of lamps and meshes are unique. Light travels along `direction`, of length 1."""

    name: str

    @property
    def kind(self) -> str:
        """Mitsuba's name of the plugin: point, spot or directional."""
        return type(self).__name__.removesuffix("Lamp").lower()


@dataclass(frozen=True)
class PointLamp(Lamp):
    """A lamp of `intensity` per steradian in all directions: a facing surface's irradiance is intensity/distance²."""

    position: Colour
    intensity: Colour


@dataclass(frozen=True)
class SpotLamp(PointLamp):
    """A lamp of full intensity up to `beam_degrees` from `direction`, linearly falling to 0 at `cutoff_degrees`."""

    direction: Colour
    beam_degrees: float
    cutoff_degrees: float


@dataclass(frozen=True)
class DirectionalLamp(Lamp):
    """Parallel light from infinitely far away. `irradiance`: on a surface perpendicular to the light."""

    direction: Colour
    irradiance: Colour


@dataclass(frozen=True)
class Environment:
    """A map (H, W, 3) of radiance from infinitely far away, interpolated linearly between columns and rows.

    In the map's own coordinates, with +y the zenith, the pixel in row j and column i is the radiance seen in direction
    (sin φ sin θ, cos θ, −cos φ sin θ) with θ = π j / (H − 1) and φ = 2π (i + ½) / W. So the first and the last row are
    the poles. `rotation` (3, 3) is orthonormal; its columns are the map's axes in the scene's coordinates.
    """

    pixels: NDArray[np.float32]
    rotation: NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks from `origin` to `target`. A pixel is the mean over its own square (box filter)."""

    origin: Colour
    target: Colour
    up: Colour
    fov_x_degrees: float
    width: int
    height: int


@dataclass(frozen=True)
class PlainScene:
    """A scene. `sky`: radiance from infinitely far away, 0 for none. `max_depth`: longest path, in Mitsuba's count."""

    name: str
    meshes: tuple[Mesh, ...]
    sky: Colour | Environment
    camera: Camera
    max_depth: int
    lamps: tuple[Lamp, ...] = ()

    @property
    def materials(self) -> tuple[Material, ...]:
        """The distinct materials, in the order of the meshes."""
        return tuple(dict.fromkeys(mesh.material for mesh in self.meshes))
