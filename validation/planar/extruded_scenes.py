"""Planar, extruded: a planar scene as upright walls in Mitsuba, with the BSDF `refract`, along the same rays.

Each segment becomes a wall of two triangles along z; arcs become facets. The walls between the same two media are one
mesh, whose outside is the left medium. Rays in the plane z = 0 are traced with Mitsuba's own intersection and the
plugin's own samples, reflected only if reflection is total, and compared with the retrace of the same facets. Behind a
boundary, Mitsuba's `spawn_ray` moves a ray along the normal by up to 1500 u (1 + max |p|), which the bound includes. In
the rows "along the ray" a ray is moved along itself by as much instead, so that only rounding errors remain.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.numerics import mitsuba_mesh
from mi_refract.planar import Event, Paths, Segments
from mi_refract.planar.curves import points
from mi_refract.plugins import PLUGIN
from mi_refract.report.row import Row
from validation import repeated
from validation.run import seeds
from validation.run.array_settings import Setting
from validation.run.bsdf_sampling import OFFSET, along_the_ray
from validation.run.context import Context
from validation.study import Study, Task, about

from . import against_retrace
from .against_retrace import FOLDER, Case, judge

TERMS = against_retrace.TERMS | {
    "along the ray": "behind a boundary rays are moved along themselves, so that they do not hit it again",
    "spawn_ray": "rays are moved along the normal, as Mitsuba does; the bound includes this",
    "from planar float32, float64": "largest distance from the points of `planar.trace`, over the extent, for rays "
    "that hit the same walls",
}
NAME = "extrusion"
SCALAR = "needs a compiled variant: a loop over rays in Python would take hours"
U = 2.0**-24
FACETS = 64  # largest number of facets of an arc
LARGEST = 1500  # largest number of walls; it limits the facets of arcs
RAYS = 100  # number of the file's rays, and of random ones around them


def tasks(context: Context) -> list[Task]:
    """Return one task per scene file; `quick` has the lens only."""
    paths = sorted(FOLDER.glob(f"{against_retrace.SHOWN}.toml" if context.profile.quick else "*.toml"))
    return [Task(f"extruded: {path.stem}", functools.partial(scene_rows, context, path)) for path in paths]


def scene_rows(context: Context, path: Path) -> list[Row]:
    """Return a row per way to continue behind a boundary."""
    if context.variant.startswith("scalar"):
        return [Row(NAME, PLUGIN, path.stem, context.variant, reason=SCALAR)]
    case = faceted(against_retrace.case_of(path, RAYS))
    scene, backend, rows = extrude(case.segments), context.variant.split("_")[0], []
    precisions = {"float32": np.float32, "float64": np.float64}
    planar = {f"from planar {name}": case.trace(Setting(backend, kind)) for name, kind in precisions.items()}
    replay = {"scene": path.name, "walls": len(case.segments), "rays": len(case.origins)}
    replay["seed"] = seeds.current(against_retrace.SEED)
    for name, (spawn, offset) in SPAWNS.items():
        paths = trace(scene, case, spawn)
        values = judge(paths, case, U, offset)
        for key, others in planar.items():  # NaN if no ray hits the same walls
            same = (paths.hits == others.hits).all(1)
            distance = np.hypot(*(paths.points - others.points)[same].transpose(2, 0, 1)) / case.extent
            values[key] = float(np.nanmax(distance)) if same.any() else float("nan")
        subject, bounds = f"{PLUGIN}, {name}", against_retrace.GROWN
        rows.append(Row(NAME, subject, path.stem, context.variant, values, bounds, replay=replay))
    return rows


def faceted(case: Case) -> Case:
    """Return the case with chords instead of arcs, and only its rays that are refracted wherever possible."""
    segments, refracted = case.segments, case.reflect == 0
    rays = case.origins[refracted], case.directions[refracted], case.max_depth, case.reflect[refracted]
    straight = segments.turn == 0
    count = max(1, min(FACETS, LARGEST // len(segments)))
    vertices = points(segments, count)[~straight]
    ends = (segments.start[straight], vertices[:, :-1]), (segments.end[straight], vertices[:, 1:])
    start, end = (np.concatenate([x, y.reshape(-1, 2)]) for x, y in ends)
    left, right = (np.append(n[straight], np.repeat(n[~straight], count)) for n in (segments.n_left, segments.n_right))
    return Case(case.name, Segments(start, end, left, right), *rays)


# The walls -----------------------------------------------------------------------------------------------------

Z = -1.0, 2.0  # rays at z = 0 do not hit the common edge of a wall's triangles in its middle


def extrude(segments: Segments) -> Any:
    """Return a Mitsuba scene of walls with normals to the left. Faces have the index of their segment as attribute."""
    import mitsuba as mi

    media = np.stack([segments.n_left, segments.n_right], 1)
    pairs, which = np.unique(media, axis=0, return_inverse=True)
    meshes = {}
    for k, (left, right) in enumerate(pairs.tolist()):
        ids = np.flatnonzero(which.ravel() == k)
        count = len(ids)
        corners = [np.column_stack([end[ids], np.full(count, z)]) for z in Z for end in (segments.start, segments.end)]
        # Start, end, start above, end above; counter-clockwise as seen from the left of the segment.
        faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 3, 1], [0, 2, 3]])
        properties = mi.Properties()
        properties["face_normals"] = True
        properties["glass"] = mi.load_dict({"type": PLUGIN, "ext_ior": left, "int_ior": right})
        vertices, triangles = np.stack(corners, 1).reshape(-1, 3), faces.reshape(-1, 3)
        mesh = mitsuba_mesh.make(mi, vertices, triangles, properties=properties)
        mesh.add_attribute("face_segment", 1, np.repeat(ids, 2).astype(float).tolist())
        meshes[f"walls_{k}"] = mesh
    return mi.load_dict({"type": "scene", **meshes})


# The rays ------------------------------------------------------------------------------------------------------


# How a ray continues from an interaction in a direction, and its shift along the normal in units of u (1 + max |p|).
SPAWNS: dict[str, tuple[Callable[[Any, Any], Any], float]] = {
    "along the ray": (along_the_ray, 0.0),
    "spawn_ray": (lambda si, d: si.spawn_ray(d), OFFSET / U),
}


def trace(scene: Any, case: Case, spawn: Callable[[Any, Any], Any]) -> Paths:
    """Trace as `planar.trace` does, with Mitsuba. The sample 1 − 2⁻²⁴ reflects only if the reflectance is 1."""
    import mitsuba as mi

    sampling, count, depth = mi.BSDFContext(), len(case.origins), case.max_depth
    flat = [np.column_stack([x, np.zeros(count)]).T for x in (case.origins, case.directions)]
    positions = dr.full(mi.Float, dr.nan, 2 * depth * count)
    hits, events = dr.full(mi.Int32, -1, depth * count), dr.full(mi.UInt32, int(Event.NONE), (depth + 1) * count)
    lane = dr.arange(mi.UInt32, count)

    def step(j: Any, active: Any, ray: Any) -> tuple[Any, Any, Any]:
        si = scene.ray_intersect(ray, active)
        hit = active & si.is_valid()
        inside = hit & (j < depth)
        for axis in (0, 1):
            dr.scatter(positions, si.p[axis], (axis * depth + j) * count + lane, inside)
        segment = si.shape.eval_attribute_1("face_segment", si, inside)
        dr.scatter(hits, mi.Int32(dr.round(segment)), j * count + lane, inside)
        bs, _ = si.bsdf().sample(sampling, si, 1 - 2.0**-24, [0.5, 0.5], inside)
        through = mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaTransmission)
        event: Any = dr.select(through, mi.UInt32(int(Event.REFRACTED)), int(Event.REFLECTED))
        event = dr.select(hit, dr.select(inside, event, int(Event.MAX_DEPTH)), int(Event.ESCAPED))
        dr.scatter(events, event, j * count + lane, active)
        return j + 1, inside, dr.select(inside, spawn(si, si.to_world(bs.wo)), ray)

    ray = mi.Ray3f(mi.Point3f(flat[0]), mi.Vector3f(flat[1]))
    start: Any = mi.UInt32(0), dr.full(mi.Bool, True, count), ray
    last: Any = dr.while_loop(start, lambda *state: state[1], step)
    hit_points = np.array(positions, float).reshape(2, depth, count).transpose(2, 1, 0)
    return Paths(
        np.concatenate([case.origins[:, None], hit_points], 1),
        np.array(last[2].d, float).T[:, :2],
        np.array(hits).reshape(depth, count).T,
        np.array(events).astype(np.uint8).reshape(depth + 1, count).T,
        np.full((count, depth + 1), np.nan),
    )


STUDY = Study(NAME, "Planar, extruded", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))
