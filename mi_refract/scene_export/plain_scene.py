"""A scene as plain data that any renderer can read: triangles, constants, one perspective camera.

Transforms are applied, named indices are numbers, curved shapes are flat triangles, and a checkerboard is two meshes of
one colour each. Coordinates are right-handed, those of the scene file, in its unit of length. Colours are linear RGB
with Rec. 709 primaries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Glass:
    """A smooth boundary between two lossless media with these absolute indices of refraction.

    The faces' normals point into the medium of `ext_ior`.
    """

    int_ior: float
    ext_ior: float


@dataclass(frozen=True)
class Diffuse:
    """A Lambertian surface, the same from both sides."""

    reflectance: Colour


@dataclass(frozen=True)
class Light:
    """A surface that emits `radiance` on the side of its normals, is black from behind, and reflects nothing."""

    radiance: Colour


Material = Glass | Diffuse | Light


@dataclass(frozen=True)
class Mesh:
    """Flat triangles of one material, counterclockwise as seen from the side of their normals. Names are unique."""

    name: str
    vertices: NDArray[np.float64]  # (V, 3)
    faces: NDArray[np.int64]  # (F, 3), indices of vertices
    material: Material

    def triangles(self) -> NDArray[np.float64]:
        """(F, 3, 3): the corners of each triangle."""
        return self.vertices[self.faces]


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

    @property
    def materials(self) -> tuple[Material, ...]:
        """Every material once, in the order of the meshes."""
        return tuple(dict.fromkeys(mesh.material for mesh in self.meshes))
