"""Where rays start that leave a surface: beside it, farther than rounding moves the surface or the ray.

Mitsuba's `spawn_ray` starts a ray 1500 (1 + |p|) u from the surface, where |p| is the largest coordinate of its point
and u = 2⁻²⁴ in float32: 9 mm at 100 m. There a ray that enters a pane of 4 mm starts behind the pane, and its light
never leaves the glass. Rays from delta lobes start here at the distance

    min(32 (E + |p|), 1500 (1 + |p|)) u,

where E is the extent of the largest shape with such lobes. No ray met its own plane again at 8 (E + |p|) u.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import Interaction, Mask, Ray, Shape, Variant, Vector3, mitsuba_mesh

# The points of hits on these are known that well: on `QUADRICS` as measured on processors; CUDA has code of its own.
MESHES = {"BlenderMesh", "Cube", "Mesh", "OBJMesh", "PLYMesh", "SerializedMesh"}
QUADRICS = {"Disk", "Rectangle", "Sphere"}
MITSUBA, OURS = 1500, 32


class Size(NamedTuple):
    """Sizes of the bounding box of a shape: the largest, the smallest that is not flat, and its largest coordinate."""

    extent: float
    thickness: float
    place: float


def size_of(shape: Shape) -> Size | None:
    """None where it is not known, or where points on the shape are not known well enough."""
    name = shape.class_name()
    if name not in (MESHES if "cuda" in str(mi.variant()) else MESHES | QUADRICS):
        return None
    if name == "Mesh" and dr.flag(dr.JitFlag.FreezingScope):  # its vertices cannot be read
        return None
    box = mitsuba_mesh.bounding_box(shape)
    if not box.valid():
        return None
    low, high = [*box.min], [*box.max]
    place = max(*map(abs, low), *map(abs, high))
    sizes = [y - x for x, y in zip(low, high, strict=True)]
    flat = name in ("Disk", "Rectangle")
    thick = [size for size in sizes if size > 2 * mi.math.RayEpsilon / MITSUBA * place and not flat]
    return Size(max(sizes), min(thick, default=math.inf), place)


def extent_of(sizes: Sequence[Size | None]) -> float:
    """E in powers of two, so that similar scenes have the same kernel; ∞ where rays start as Mitsuba's do."""
    extent = max((math.inf if size is None else size.extent for size in sizes), default=math.inf)
    return 2.0 ** math.ceil(math.log2(extent)) if 0 < extent < math.inf else math.inf


def too_thin(size: Size | None, extent: float) -> str:
    """What is wrong with a shape that rays step over, as far as its bounding box shows; "" where nothing is.

    `extent`: E, as in `spawn_ray`.
    """
    if size is None:
        return ""
    distance = min(OURS / MITSUBA * (extent + size.place), 1 + size.place) * mi.math.RayEpsilon
    if size.thickness >= distance:
        return ""
    return f"is {size.thickness:.3g} thick, and rays start {distance:.3g} beside its surface, so its light is lost"


def spawn_ray(v: Variant, si: Interaction, d: Vector3, extent: float, delta: Mask) -> Ray:
    """The ray from a surface in the direction d. `extent`: E; `delta`: whether d is that of a delta lobe."""
    if extent == math.inf:
        return si.spawn_ray(d)
    u, size = v.math.RayEpsilon / MITSUBA, dr.max(dr.abs(si.p))
    distance = dr.fma(size, OURS * u, OURS * extent * u)
    far = (1 + size) * v.math.RayEpsilon
    if OURS * extent > MITSUBA:  # else it is the lesser one everywhere
        distance = dr.minimum(distance, far)
    if delta is not True:
        distance = dr.select(delta, distance, far)
    offset = dr.detach(dr.mulsign(distance, dr.dot(si.n, d)))
    return v.Ray3f(dr.fma(offset, dr.detach(si.n), si.p), d, si.time, si.wavelengths)
