"""Planar, extruded: a planar scene as upright walls in Mitsuba, with the BSDF `refract`, along the same rays.

Each segment becomes a wall of two triangles along z; arcs become facets. The walls between the same two media are one
mesh, whose outside is the left medium. Rays in the plane z = 0 are traced with Mitsuba's own intersection and the
plugin's own samples, reflected only where reflection is total, and compared with the retrace of the same facets. Behind
a boundary `spawn_ray` of Mitsuba moves a ray along the normal, by up to 1500 u (1 + max |p|), and the bound includes
this. In the rows "along the ray" a ray is moved along itself by as much instead, so that only rounding is left.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.planar import Event, Paths
from mi_refract.plugins import PLUGIN
from mi_refract.report.row import Row
from validation import repeated
from validation.reference.layered_scenes import OFFSET
from validation.reference.planar_retrace import Array
from validation.run import path_overlay, seeds
from validation.run.array_settings import Setting
from validation.run.context import Context
from validation.study import Study, Task, about

from . import against_retrace, wall_scene
from .against_retrace import FOLDER, Case, judge

TERMS = against_retrace.TERMS | {
    "along the ray": "rays moved along themselves behind a boundary, so that they do not meet it again",
    "spawn_ray": "rays moved along the normal, as Mitsuba does; the bound includes that",
    "from planar float32, float64": "largest distance from the points of `planar.trace`, over the extent, where both "
    "meet the same walls",
}
NAME = "extrusion"
SCALAR = "needs a compiled variant: a loop over rays in Python would take hours"
U = 2.0**-24
FACETS = 64  # of an arc, at most
Spawn = Callable[[Any, Any], Any]
LARGEST = 1500  # walls; arcs have fewer facets where there are more of them
DRAWN, SHOWN, PIXELS = "along the ray", 9, 192  # rays in an image, and its size before it is enlarged
RAYS = 100  # of the file's, and as many scattered


def tasks(context: Context) -> list[Task]:
    """One task per scene file; in the profile `quick` that of the lens."""
    shown = f"{against_retrace.SHOWN}.toml" if context.profile.quick else "*.toml"
    return [
        Task(f"extruded: {path.stem}", functools.partial(scene_rows, context, path))
        for path in sorted(FOLDER.glob(shown))
    ]


def scene_rows(context: Context, path: Path) -> list[Row]:
    """A row per way to go on behind a boundary."""
    if context.variant.startswith("scalar"):
        return [Row(NAME, PLUGIN, path.stem, context.variant, reason=SCALAR)]
    case = faceted(against_retrace.case_of(path, RAYS))
    scene, rows = wall_scene.extrude(case.segments), []
    planar_paths = {
        name: case.trace(Setting(context.variant.split("_")[0], np.dtype(name).type)) for name in ("float32", "float64")
    }
    for name, (spawn, offset) in SPAWNS.items():
        paths = trace(scene, case, spawn)
        values = judge(paths, case, U, offset)
        values |= {f"from planar {p}": apart(paths, other) / case.extent for p, other in planar_paths.items()}
        replay = {
            "scene": path.name,
            "walls": len(case.segments),
            "rays": len(case.origins),
            "seed": seeds.current(against_retrace.SEED),
        }
        images = {"overlay": _image(context, scene, case, paths)} if name == DRAWN else {}
        rows.append(
            Row(
                NAME,
                f"{PLUGIN}, {name}",
                path.stem,
                context.variant,
                values,
                against_retrace.GROWN,
                replay=replay,
                images=images,
            )
        )
    return rows


def apart(some: Paths, others: Paths) -> float:
    """Largest distance of points, of rays that meet the same boundaries; NaN where there are none."""
    same = (some.hits == others.hits).all(1)
    distance = np.hypot(*(some.points - others.points)[same].transpose(2, 0, 1))
    return float(np.nanmax(distance)) if same.any() else float("nan")


def _image(context: Context, scene: Any, case: Case, extruded: Paths) -> str:
    """The walls from above, the exact paths over them, and where Mitsuba's rays meet the walls."""
    view = wall_scene.Plan(scene, case.segments, PIXELS)
    shown = np.linspace(0, len(case.origins) // 2 - 1, SHOWN).astype(int)
    exact = case.exact
    ends = exact.points[shown, exact.met[shown]] + case.extent * exact.directions[shown]
    legs = [
        _flat(np.concatenate([points[np.isfinite(points[:, 0])], [end]]))
        for points, end in zip(exact.points[shown], ends, strict=True)
    ]
    met = extruded.points[shown, 1:].reshape(-1, 2)
    drawn = path_overlay.draw(view, legs, _flat(met[np.isfinite(met[:, 0])]))
    return path_overlay.save(context.out, f"extruded {case.name}", drawn, {"scene": f"{case.name}.toml"})


def _flat(points: Array) -> Array:
    """In the plane z = 0."""
    return np.column_stack([points, np.zeros(len(points))]).astype(float)


def faceted(case: Case) -> Case:
    """The same with facets for arcs, refracted wherever possible."""
    facets = max(1, min(FACETS, LARGEST // len(case.segments)))
    segments, every = wall_scene.facets(case.segments, facets), case.reflect == 0
    origins, directions = case.origins[every], case.directions[every]
    return Case(case.name, segments, origins, directions, case.max_depth, case.reflect[every])


# The rays ------------------------------------------------------------------------------------------------------


def along_the_ray(si: Any, d: Any) -> Any:
    """A ray from the interaction along `d`, moved along itself by Mitsuba's offset."""
    import mitsuba as mi

    ray = mi.Ray3f(si.p, d)
    ray.o = dr.fma(d, OFFSET * (1 + dr.max(dr.abs(si.p))), ray.o)
    return ray


# How a ray goes on from an interaction along a direction, and by how much that moves it along the normal, over u.
SPAWNS: dict[str, tuple[Spawn, float]] = {
    "along the ray": (along_the_ray, 0.0),
    "spawn_ray": (lambda si, d: si.spawn_ray(d), OFFSET / U),
}


def trace(scene: Any, case: Case, spawn: Spawn) -> Paths:
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
        event: Any = dr.select(through, mi.UInt32(int(Event.REFRACTED)), int(Event.REFLECTED))
        event = dr.select(found, dr.select(inside, event, int(Event.MAX_DEPTH)), int(Event.ESCAPED))
        dr.scatter(events, event, j * count + lane, active)
        return j + 1, inside, dr.select(inside, spawn(si, si.to_world(bs.wo)), ray)

    ray = mi.Ray3f(mi.Point3f(flat[0]), mi.Vector3f(flat[1]))
    start: Any = mi.UInt32(0), dr.full(mi.Bool, True, count), ray
    last: Any = dr.while_loop(start, lambda *state: state[1], step)
    met = np.array(points, float).reshape(2, depth, count).transpose(2, 1, 0)
    return Paths(
        np.concatenate([case.origins[:, None], met], 1),
        np.array(last[2].d, float).T[:, :2],
        np.array(hits).reshape(depth, count).T,
        np.array(events).astype(np.uint8).reshape(depth + 1, count).T,
        np.full((count, depth + 1), np.nan),
    )


STUDY = Study(NAME, "Planar, extruded", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))
