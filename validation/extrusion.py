"""Extruded: a planar scene as upright walls in Mitsuba, with the `refract` BSDF, along the same rays.

Each segment becomes a wall of two triangles along z, arcs in facets; the walls between two media are a mesh with the
left medium outside. Rays in the plane z = 0 are traced by Mitsuba's own intersection and the plugin's own samples,
reflected only where all is reflected, and compared with the retrace of the same facets. Behind a boundary Mitsuba
moves a ray along the normal, by up to 1500 u (1 + max |p|), which `spawn_ray` does: that is a share of the bound then.
Moved along itself by as much instead, a ray stays on its line, and all that is left is rounding.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_refract import curves
from mi_refract.bsdf import PLUGIN
from mi_refract.planar import Event, Paths, Segments
from mi_refract.rows import Row

from . import planar
from .growth import growth
from .layered import OFFSET
from .plan import Context, Task
from .planar import FOLDER, Case, judge
from .retrace import Array, retrace

TITLE = "Planar, extruded"
TEXT = __doc__.partition("\n")[2].strip()
TERMS = planar.TERMS | {
    "along the ray": "rays moved along themselves behind a boundary, so that they do not meet it again",
    "spawn_ray": "moved along the normal, as Mitsuba does by itself; the bound counts that in",
    "planar − extruded": "largest distance between the points of `planar.trace` and of Mitsuba, over the extent",
}
STUDY = "extrusion"
SCALAR = "needs a compiled variant: a loop over rays in Python would take hours"
U = 2.0**-24
FACETS = 64  # of an arc
LARGEST = 10_000  # walls
RAYS = 100  # of the file's, and as many scattered
BELOW, ABOVE = -1.0, 2.0  # z of the walls: the triangles' common edge is not where most rays are, in the middle


def tasks(context: Context) -> list[Task]:
    """One task per scene file."""
    return [Task(f"extruded: {path.stem}", functools.partial(scene_rows, context, path))
            for path in sorted(FOLDER.glob("*.toml"))]  # fmt: skip


def scene_rows(context: Context, path: Path) -> list[Row]:
    if context.variant.startswith("scalar"):
        return [Row(STUDY, PLUGIN, path.stem, context.variant, reason=SCALAR)]
    case = faceted(planar.case_of(path, RAYS))
    if len(case.segments) > LARGEST:
        return [Row(STUDY, PLUGIN, path.stem, context.variant, reason=f"more than {LARGEST} walls")]
    scene = extrude(case.segments)
    rows = []
    for name, spawn in SPAWNS.items():
        paths = trace(scene, case, spawn.next)
        values = judge(paths, spawn.allow(case), U)
        budgets = {"error / bound": 1.0, "astray, far": 0.0}
        replay = {"scene": path.name, "facets": FACETS, "rays": len(case.origins), "seed": planar.SEED}
        rows.append(Row(STUDY, f"{PLUGIN}, {name}", path.stem, context.variant, values, budgets, replay=replay))
    return rows


# The scene -----------------------------------------------------------------------------------------------------


def faceted(case: Case, count: int = FACETS) -> Case:
    """The same with facets for arcs, refracted wherever possible."""
    segments = facets(case.segments, count)
    every = case.reflect == 0
    origins, directions = case.origins[every], case.directions[every]
    exact = retrace(segments, origins, directions, case.max_depth)
    return Case(case.name, segments, origins, directions, case.max_depth, case.reflect[every], exact)


def facets(segments: Segments, count: int) -> Segments:
    """Each arc as `count` chords; straight segments as they are."""
    if segments.control is None:
        return segments
    straight = (segments.control == (segments.start + segments.end) / 2).all(1)
    along = curves.points(segments, count)[~straight]
    pieces = (segments.start[straight], along[:, :-1]), (segments.end[straight], along[:, 1:])
    start, end = (np.concatenate([x, y.reshape(-1, 2)]) for x, y in pieces)
    media = [np.append(n[straight], np.repeat(n[~straight], count)) for n in (segments.n_left, segments.n_right)]
    return Segments(start, end, *media)


def extrude(segments: Segments) -> Any:
    """A Mitsuba scene; the walls' normals point to the left. Faces carry the number of their segment."""
    import mitsuba as mi

    media = np.stack([segments.n_left, segments.n_right], 1)
    pairs, which = np.unique(media, axis=0, return_inverse=True)
    walls = {f"walls_{k}": wall(segments, np.flatnonzero(which.ravel() == k), *pair) for k, pair in enumerate(pairs)}
    return mi.load_dict({"type": "scene", **walls})


def wall(segments: Segments, chosen: Array, n_left: float, n_right: float) -> Any:
    """A mesh of the segments `chosen`, which part the same two media."""
    import mitsuba as mi

    count = len(chosen)
    ends = [np.asarray(x)[chosen] for x in (segments.start, segments.end)]
    corners = [np.column_stack([end, np.full(count, z)]) for z in (BELOW, ABOVE) for end in ends]
    # Start, end, start above, end above; seen from the left of the segment, counter-clockwise.
    faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 3, 1], [0, 2, 3]])
    properties = mi.Properties()
    properties["face_normals"] = True
    properties["glass"] = mi.load_dict({"type": PLUGIN, "ext_ior": float(n_left), "int_ior": float(n_right)})
    mesh = mi.Mesh("walls", 4 * count, 2 * count, props=properties)
    parameters = mi.traverse(mesh)
    for key, values in (("positions", np.stack(corners, 1).astype(np.float32)), ("faces", faces.astype(np.uint32))):
        name = next(name for name in parameters.keys() if name.endswith(key))  # noqa: SIM118  no dictionary
        parameters[name] = type(parameters[name])(values.ravel())
    mesh.add_attribute("face_segment", 1, np.repeat(chosen, 2).astype(float).tolist())
    parameters.update()
    return mesh


# The rays ------------------------------------------------------------------------------------------------------


def along_the_ray(si: Any, d: Any) -> Any:
    import mitsuba as mi

    ray = mi.Ray3f(si.p, d)
    ray.o = dr.fma(d, OFFSET * (1 + dr.max(dr.abs(si.p))), ray.o)
    return ray


@dataclass(frozen=True)
class Spawn:
    """How a ray goes on from an interaction along a direction, and by how much it is moved along the normal, over u."""

    next: Callable[[Any, Any], Any]
    offset: float

    def allow(self, case: Case) -> Case:
        """The case, its bound with that offset."""
        allowed = Case(**{name: getattr(case, name) for name in case.__dataclass_fields__})
        allowed.__dict__["bounds"] = growth(case.exact, case.segments, self.offset)
        return allowed


SPAWNS = {
    "along the ray": Spawn(along_the_ray, 0.0),
    "spawn_ray": Spawn(lambda si, d: si.spawn_ray(d), OFFSET / U),
}


def trace(scene: Any, case: Case, spawn: Callable[[Any, Any], Any]) -> Paths:
    """As `planar.trace`, by Mitsuba; the sample 1 − 2⁻²⁴ reflects only where the reflectance is 1."""
    import mitsuba as mi

    sampling, count, depth = mi.BSDFContext(), len(case.origins), case.max_depth
    flat = [np.column_stack([x, np.zeros(count)]).T for x in (case.origins, case.directions)]
    points = dr.full(mi.Float, dr.nan, 2 * depth * count)
    hits, events = dr.full(mi.Int32, -1, depth * count), dr.full(mi.UInt32, int(Event.NONE), (depth + 1) * count)
    lane = dr.arange(mi.UInt32, count)

    def step(j: Any, active: Any, ray: Any) -> tuple[Any, Any, Any]:
        si = scene.ray_intersect(ray, active)
        found = active & si.is_valid()
        inside = found & (j < depth)
        for axis in (0, 1):
            dr.scatter(points, si.p[axis], (axis * depth + j) * count + lane, inside)
        segment = si.shape.eval_attribute_1("face_segment", si, inside)
        dr.scatter(hits, mi.Int32(dr.round(segment)), j * count + lane, inside)
        bs, _ = si.bsdf().sample(sampling, si, 1 - 2.0**-24, [0.5, 0.5], inside)
        through = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)
        event = dr.select(through, mi.UInt32(int(Event.REFRACTED)), int(Event.REFLECTED))
        event = dr.select(found, dr.select(inside, event, int(Event.EXHAUSTED)), int(Event.ESCAPED))
        dr.scatter(events, event, j * count + lane, active)
        return j + 1, inside, dr.select(inside, spawn(si, si.to_world(bs.wo)), ray)

    ray = mi.Ray3f(mi.Point3f(flat[0]), mi.Vector3f(flat[1]))
    start = mi.UInt32(0), dr.full(mi.Bool, True, count), ray
    last: Any = dr.while_loop(start, lambda *state: state[1], step)
    met = np.array(points, float).reshape(2, depth, count).transpose(2, 1, 0)
    return Paths(
        np.concatenate([case.origins[:, None], met], 1), np.array(last[2].d, float).T[:, :2],
        np.array(hits).reshape(depth, count).T, np.array(events).astype(np.uint8).reshape(depth + 1, count).T,
        np.full((count, depth + 1), np.nan),
    )  # fmt: skip
