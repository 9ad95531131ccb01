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
LINES = "FdC"  # by which Abbe's number is defined
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
    """A glass whose index depends on the wavelength, or that absorbs; its two indices are those at the d line.

    `said`: the parameters that say so. `spectrum`: the index of the denser medium over that of the other at
    WAVELENGTHS; () for one number. σ of either side: light that travels t keeps exp(−σ t) of its red, green and blue.
    """

    said: str = field(compare=False)
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

    `normals` (V, 3): of the sphere or the cylinder at each vertex, None where the surface itself is flat.
    """

    name: str
    vertices: NDArray[np.float64]  # (V, 3)
    faces: NDArray[np.int64]  # (F, 3), indices of vertices
    material: Material
    normals: NDArray[np.float64] | None = None

    def triangles(self) -> NDArray[np.float64]:
        """(F, 3, 3): the corners of each triangle."""
        return self.vertices[self.faces]


@dataclass(frozen=True)
class Lamp:
    """A lamp without size. Names of lamps and meshes are unique; directions, in which light travels, have length 1."""

    name: str

    @property
    def kind(self) -> str:
        """Mitsuba's name of the plugin: point, spot or directional."""
        return type(self).__name__.removesuffix("Lamp").lower()


@dataclass(frozen=True)
class PointLamp(Lamp):
    """`intensity`, per steradian, in every direction: a surface that faces it has intensity/distance² of irradiance."""

    position: Colour
    intensity: Colour


@dataclass(frozen=True)
class SpotLamp(PointLamp):
    """Up to `beam_degrees` from `direction` all of `intensity`, none from `cutoff_degrees` on, linear between."""

    direction: Colour
    beam_degrees: float
    cutoff_degrees: float


@dataclass(frozen=True)
class DirectionalLamp(Lamp):
    """Parallel light from infinitely far away. `irradiance`: of a surface at right angles to it."""

    direction: Colour
    irradiance: Colour


@dataclass(frozen=True)
class Environment:
    """Radiance from infinitely far away by direction, (H, W, 3), interpolated linearly between columns and rows.

    In the map's own coordinates, with +y the zenith, the pixel in row j and column i is the radiance seen in direction
    (sin φ sin θ, cos θ, −cos φ sin θ) with θ = π j / (H − 1), so that the first and the last row are the poles, and
    φ = 2π (i + ½) / W. `rotation` (3, 3) is orthonormal; its columns are the map's axes in the scene's coordinates.
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
    """A scene. `sky`: radiance from infinitely far away, 0 for none. `max_depth`: of a path, as Mitsuba counts."""

    name: str
    meshes: tuple[Mesh, ...]
    sky: Colour | Environment
    camera: Camera
    max_depth: int
    lamps: tuple[Lamp, ...] = ()

    @property
    def materials(self) -> tuple[Material, ...]:
        """Every material once, in the order of the meshes."""
        return tuple(dict.fromkeys(mesh.material for mesh in self.meshes))
