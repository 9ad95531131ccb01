"""The origins of rays that leave a surface: at a distance from it that is larger than the rounding errors.

Mitsuba's `spawn_ray` starts a ray 1500 (1 + |p|) u from the surface, where |p| is the largest coordinate of the point
and u = 2⁻²⁴ in float32: 9 mm at 100 m. A ray that enters a pane of 4 mm then starts behind the pane, and its light
never leaves the glass. So this module starts the rays of delta lobes at the distance

    min(32 (E + |p|), 1500 (1 + |p|)) u,

where E is the extent of the largest shape with such lobes. At 8 (E + |p|) u no ray was found to hit its own plane
again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import Interaction, Mask, Ray, Shape, Variant, Vector3

# Points of hits on these shapes are that accurate. For `QUADRICS` this was measured on CPUs; CUDA has its own code.
MESHES = {"BlenderMesh", "Cube", "Mesh", "OBJMesh", "PLYMesh", "SerializedMesh"}
QUADRICS = {"Disk", "Rectangle", "Sphere"}
MITSUBA, OURS = 1500, 32


def extent_of(shapes: Iterable[Shape]) -> float:
    """Return E rounded up to a power of two, so that similar scenes share a kernel; ∞ if rays start as Mitsuba's do."""
    shapes = list(shapes)
    boxes = [shape.bbox() for shape in shapes]
    exact = MESHES if "cuda" in str(mi.variant()) else MESHES | QUADRICS
    if not boxes or not all(box.valid() for box in boxes) or not {s.class_name() for s in shapes} <= exact:
        return math.inf
    extent = max(float(size) for box in boxes for size in box.extents())
    return 2.0 ** math.ceil(math.log2(extent)) if 0 < extent < math.inf else math.inf


def too_thin(shape: Shape, extent: float) -> str:
    """Return a text if a shape is so thin, by its bounding box, that rays start beyond it; else "". `extent`: E."""
    box = shape.bbox()
    if not box.valid() or shape.class_name() in ("Disk", "Rectangle"):
        return ""
    u, coordinate = 2.0**-24, max(abs(float(x)) for corner in (box.min, box.max) for x in corner)
    distance = min(OURS * (extent + coordinate), MITSUBA * (1 + coordinate)) * u
    sizes = (float(size) for size in box.extents())
    thickness = min((size for size in sizes if size > 2 * u * coordinate), default=math.inf)  # smaller ones: flat
    if thickness >= distance:
        return ""
    return f"is {thickness:.3g} thick, but rays start {distance:.3g} from its surface, so its light is lost"


def spawn_ray(v: Variant, si: Interaction, d: Vector3, extent: float, delta: Mask) -> Ray:
    """Return the ray from a surface in the direction d. `extent`: E; `delta`: whether d is that of a delta lobe."""
    if delta is False or extent == math.inf:
        return si.spawn_ray(d)
    u, size = v.math.RayEpsilon / MITSUBA, dr.max(dr.abs(si.p))
    distance = dr.fma(size, OURS * u, OURS * extent * u)
    far = (1 + size) * v.math.RayEpsilon
    if OURS * extent > MITSUBA:  # otherwise distance ≤ far everywhere
        distance = dr.minimum(distance, far)
    if delta is not True:
        distance = dr.select(delta, distance, far)
    offset = dr.detach(dr.mulsign(distance, dr.dot(si.n, d)))
    return v.Ray3f(dr.fma(offset, dr.detach(si.n), si.p), d, si.time, si.wavelengths)
