"""Where rays start that leave a surface: beside it, farther than rounding moves the surface or the ray.

Mitsuba's `spawn_ray` starts a ray 1500 (1 + |p|) u from the surface, where |p| is the largest coordinate of its point
and u = 2⁻²⁴ in float32: 9 mm at 100 m. There a ray that enters a pane of 4 mm starts behind the pane, and its light
never leaves the glass. Rays from delta lobes start here at the distance

    min(32 (E + |p|), 1500 (1 + |p|)) u,

where E is the extent of the largest shape with such lobes. No ray met its own plane again at 8 (E + |p|) u.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import Interaction, Mask, Ray, Shape, Variant, Vector3, mitsuba_mesh

# The points of hits on these are known that well: on `QUADRICS` as measured on processors; CUDA has code of its own.
MESHES = {"BlenderMesh", "Cube", "Mesh", "OBJMesh", "PLYMesh", "SerializedMesh"}
QUADRICS = {"Disk", "Rectangle", "Sphere"}
MITSUBA, OURS = 1500, 32


def extent_of(shapes: Iterable[Shape]) -> float:
    """E in powers of two, so that similar scenes have the same kernel; ∞ where rays start as Mitsuba's do."""
    shapes = list(shapes)
    boxes = [mitsuba_mesh.bounding_box(shape) for shape in shapes]
    exact = MESHES if "cuda" in str(mi.variant()) else MESHES | QUADRICS
    if not boxes or not all(box.valid() for box in boxes) or not {s.class_name() for s in shapes} <= exact:
        return math.inf
    extent = max(float(size) for box in boxes for size in box.extents())
    return 2.0 ** math.ceil(math.log2(extent)) if 0 < extent < math.inf else math.inf


def too_thin(shape: Shape, extent: float) -> str:
    """What is wrong with a shape that rays step over, as far as its bounding box tells; "" where nothing is.

    `extent`: E, as in `spawn_ray`.
    """
    box = mitsuba_mesh.bounding_box(shape)
    if not box.valid() or shape.class_name() in ("Disk", "Rectangle"):
        return ""
    u, place = 2.0**-24, max(abs(float(x)) for corner in (box.min, box.max) for x in corner)
    distance = min(OURS * (extent + place), MITSUBA * (1 + place)) * u
    thickness = min((size for size in map(float, box.extents()) if size > 2 * u * place), default=math.inf)  # else flat
    if thickness >= distance:
        return ""
    return f"is {thickness:.3g} thick, and rays start {distance:.3g} beside its surface, so its light is lost"


def spawn_ray(v: Variant, si: Interaction, d: Vector3, extent: float, delta: Mask) -> Ray:
    """The ray from a surface in the direction d. `extent`: E; `delta`: whether d is that of a delta lobe."""
    if delta is False or extent == math.inf:
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
