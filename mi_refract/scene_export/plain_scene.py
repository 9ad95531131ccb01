"""A scene as plain data that any renderer can take: triangles, constants, one perspective camera.

Transforms are applied, named indices are numbers, curved shapes are flat triangles, a checkerboard is two meshes of
one colour each. Right-handed coordinates of the scene file; lengths in its unit; linear RGB of Rec. 709 primaries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Glass:
    """A smooth boundary of two lossless media; their absolute indices of refraction.

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
    """Emits `radiance` into every direction on the side of the faces' normals; black from behind. Reflects nothing."""

    radiance: Colour


Material = Glass | Diffuse | Light


@dataclass(frozen=True)
class Mesh:
    """Flat triangles of one material, counterclockwise seen from where their normals point. Names are unique."""

    name: str
    vertices: NDArray[np.float64]  # V × 3
    faces: NDArray[np.int64]  # F × 3
    material: Material

    def triangles(self) -> NDArray[np.float64]:
        """F × 3 × 3: the corners of each."""
        return self.vertices[self.faces]


@dataclass(frozen=True)
class Environment:
    """Radiance from infinitely far away by direction, H × W × 3, interpolated linearly in columns and rows.

    In the map's own coordinates, with +y the zenith, the pixel in row j and column i is the radiance seen in direction
    (sin φ sin θ, cos θ, −cos φ sin θ): θ = π j / (H − 1), so that first and last row are the poles, and
    φ = 2π (i + ½) / W. `rotation` (3 × 3, orthonormal, its columns the map's axes) takes these to the scene's.
    """

    pixels: NDArray[np.float32]
    rotation: NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole: looks from `origin` to `target`, width × height square pixels, each the mean over its own square."""

    origin: Colour
    target: Colour
    up: Colour
    fov_x_degrees: float
    width: int
    height: int


@dataclass(frozen=True)
class Plain:
    """`sky`: radiance from infinitely far away, 0 where there is none. `max_depth`: of a path, as Mitsuba counts."""

    name: str
    meshes: tuple[Mesh, ...]
    sky: Colour | Environment
    camera: Camera
    max_depth: int

    @property
    def materials(self) -> tuple[Material, ...]:
        """Each once, in the order of the meshes."""
        return tuple(dict.fromkeys(mesh.material for mesh in self.meshes))
