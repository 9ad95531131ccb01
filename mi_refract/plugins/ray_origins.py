"""The origins of rays that leave a surface: at a distance from it that is larger than the rounding errors.

Mitsuba's `spawn_ray` starts a ray 1500 (1 + |p|) u from the surface, where |p| is the largest coordinate of the point
and u = 2⁻²⁴ in float32: 9 mm at 100 m. A ray that enters a pane of 4 mm then starts behind the pane, and its light
never leaves the glass. So this module starts the rays of delta lobes at the distance

    min(32 (E + |p| + t), 1500 (1 + |p|)) u,

where E is the extent of the largest shape with such lobes, and t the length of the ray that has hit the surface: the
error of a point on a sphere or disk grows with t. Where faces of a mesh are long and narrow, with the longest edge L
and the height h on it, hits err by up to u/8 L²/h. So E is L²/(64 h) where that is more.

Rays of other lobes, and rays to lamps and to the camera, start at Mitsuba's distance, or nearer where that could be
within or beyond glass just above the surface. Rays past lamps that are hidden start like those of delta lobes, with the
E of the lamps: a ray that meets its lamp again is moved again.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import drjit as dr
import mitsuba as mi

from mi_refract.numerics import Interaction, Mask, Ray, Sensor, Shape, Variant, Vector3, mitsuba_mesh

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# Shapes whose points are accurate enough: from 8 (E + |p| + t) u on, no ray was found to hit its own surface again.
ACCURATE = {"BlenderMesh", "Cube", "Mesh", "OBJMesh", "PLYMesh", "SerializedMesh", "Disk", "Rectangle", "Sphere"}
MITSUBA, OURS = 1500, 32


class Size(NamedTuple):
    """Sizes of a shape: its own E; of its bounding box the least extent that is not flat, and the place."""

    extent: float
    thickness: float
    place: float  # its largest coordinate


def size_of(shape: Shape) -> Size | None:
    """Return the size of a shape; None if it is unknown, or if points on the shape are not accurate enough."""
    name = shape.class_name()
    if name not in ACCURATE:
        return None
    readable = not dr.flag(dr.JitFlag.FreezingScope)  # vertices, unless a function is being recorded
    if shape.is_mesh() and not readable and name != "Cube":
        return None
    box = mitsuba_mesh.bounding_box(shape)
    if not box.valid():
        return None
    low, high = [*box.min], [*box.max]
    place = max(*map(abs, low), *map(abs, high))
    sizes = [y - x for x, y in zip(low, high, strict=True)]
    flat = name in ("Disk", "Rectangle")
    thick = [size for size in sizes if size > 2 * mi.math.RayEpsilon / MITSUBA * place and not flat]
    narrow = mitsuba_mesh.sliver_length(shape) / 64 if shape.is_mesh() and readable else 0
    return Size(max(*sizes, narrow), min(thick, default=math.inf), place)


def extent_of(sizes: Sequence[Size | None]) -> float:
    """Return E rounded up to a power of two, so that similar scenes share a kernel; ∞ if rays start as Mitsuba's do."""
    extent = max((math.inf if size is None else size.extent for size in sizes), default=math.inf)
    return 2.0 ** math.ceil(math.log2(extent)) if 0 < extent < math.inf else math.inf


def too_thin(size: Size | None, extent: float) -> str:
    """Return a text if a shape is so thin, by its bounding box, that rays start beyond it; else "". `extent`: E."""
    if size is None:
        return ""
    distance = min(OURS / MITSUBA * (extent + size.place), 1 + size.place) * mi.math.RayEpsilon
    if size.thickness >= distance:
        return ""
    place = f"{distance:.3g} or more from its surface"
    return f"is {size.thickness:.3g} thick, but rays start {place}, so its light is lost"


def places_of(sensors: Sequence[Sensor]) -> Callable[[], list[NDArray[np.float64]]]:
    """Return a function that returns the places of the cameras, which it reads once."""
    return functools.cache(lambda: [matrix(sensor.world_transform())[:3, 3] for sensor in sensors])


def inexact(shape: Shape, instances: Sequence[Shape] | None, places: Callable[[], list[NDArray[np.float64]]]) -> str:
    """Return a text if Mitsuba's points on a shape err by more than the distance at which rays start; else "".

    `shape`: a cylinder, or a cylinder or a sphere in a group; `instances`: those that show the group, or None. Points
    on a cylinder with the radius R at the distance D from a camera err by about 4 u D²/R, points on a sphere in an
    instance that scales it by s < 1 to the radius R by about 4 u D²/R (1/s − 1)²: the largest errors of 200,000 rays,
    not bounds. `places`: from `places_of`.
    """
    if dr.flag(dr.JitFlag.FreezingScope):  # numbers cannot be read
        return ""
    import numpy as np

    kind, own = shape.class_name(), matrix(mi.traverse(shape)["to_world"])
    for instance in [None] if instances is None else instances:
        outer = np.eye(4) if instance is None else matrix(mi.traverse(instance)["to_world"])
        scale = 1.0 if instance is None else float(np.linalg.svd(outer[:3, :3], compute_uv=False).min())
        radius = scale * float(np.linalg.norm(own[:3, 0]))
        if not radius > 0:  # no ray meets it
            continue
        centre = (outer @ own @ [0, 0, 0.5 if kind == "Cylinder" else 0, 1])[:3]
        distance = max((float(np.linalg.norm(place - centre)) for place in places()), default=0.0)
        factor = 1.0 if kind == "Cylinder" else max(1 / scale - 1, 0) ** 2
        start = mi.math.RayEpsilon * (1 + float(np.abs(centre).max()))
        error = 4 * mi.math.RayEpsilon / MITSUBA * distance**2 / radius * factor
        if error > start:
            where = "" if instance is None else f" in an instance that scales it by {scale:.3g}"
            remedy = "a mesh" if kind == "Cylinder" else "a mesh, or a sphere that is scaled itself"
            return (
                f"is a {kind}{where}, {distance:.3g} from a camera: Mitsuba's points on it err by up to {error:.2g}, "
                f"but rays start {start:.2g} from its surface; expected {remedy}"
            )
    return ""


def matrix(transform: Any) -> NDArray[np.float64]:
    """Return the matrix (4, 4) of a transformation, which compiled variants store as arrays of one number."""
    import numpy as np

    return np.array(transform.matrix, float).reshape(4, 4)


def spawn_ray(v: Variant, si: Interaction, d: Vector3, extent: float, delta: Mask) -> Ray:
    """Return the ray from a surface in the direction d. `extent`: E; `delta`: whether d is that of a delta lobe."""
    if extent == math.inf:
        return si.spawn_ray(d)
    u, size = v.math.RayEpsilon / MITSUBA, dr.max(dr.abs(si.p))
    far = (1 + size) * v.math.RayEpsilon
    distance = dr.minimum(dr.fma(size + si.t, OURS * u, OURS * extent * u), far)
    if delta is not True:
        # If the ray that has hit is short, `far` may be beyond the surface that it left: go at most half the way back.
        nearer = dr.minimum(far, dr.fma(0.5 * dr.abs(si.wi.z), si.t, distance))
        distance = dr.select(delta, distance, nearer)
    offset = dr.detach(dr.mulsign(distance, dr.dot(si.n, d)))
    return v.Ray3f(dr.fma(offset, dr.detach(si.n), si.p), d, si.time, si.wavelengths)


def ray_to(v: Variant, si: Interaction, p: Vector3, extent: float) -> Ray:
    """Return the ray from a surface that ends at the point p. `extent`: E."""
    ray = spawn_ray(v, si, p - si.p, extent, False)
    ray.d = p - ray.o
    ray.maxt = dr.norm(ray.d)
    ray.d /= ray.maxt
    return ray
