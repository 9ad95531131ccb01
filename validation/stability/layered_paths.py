"""Paths: rays through the layers of `scenes/mirage.xml` and `scenes/fibre.xml`, against the exact path.

A ray is traced through Mitsuba's scene with the plugin's own samples, transmitted wherever possible, and compared with
a path of straight segments and Snell's law in double precision. Both include Mitsuba's ray offset: in the mirage it
moves rays by more than any other error, but it turns none. The images show the mirage through a telescope and to the
naked eye, and the fibre.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.formulas import FORMULAS, automatic
from mi_refract.image_diff import pixelwise
from mi_refract.plugins import PLUGIN
from mi_refract.rendering import scene_files
from mi_refract.report.row import Row
from validation import limits
from validation.reference import layered_scenes
from validation.reference.layered_scenes import FIBRE, MIRAGE, Layers, Path
from validation.run import seeds
from validation.run.context import SCENES, Context
from validation.run.metrics import WRONG_PATH
from validation.run.render_methods import save_image
from validation.study import Study, Task, about

INDICES, RATIOS = "exact, indices in float32", "exact, ratios in float32"
DIRECTION, MEDIAN_DIRECTION, PLACE = "direction", "median direction", "place"
TERMS = {
    "direction": "largest |d − exact| anywhere on a path, over the sine of the angle at which it enters",
    "direction / condition": "the same, divided by the factor by which a decreasing cosine magnifies any error",
    PLACE: "largest distance from the exact path, over that path's own extent across the layers",
    INDICES: "Snell's law in double precision for the indices rounded to float32, which the built-in starts from",
    RATIOS: "the same for the ratio of every two neighbours rounded to float32, which the other formulas start from",
    WRONG_PATH: "rays that meet a wrong number of boundaries",
    "ray offset": "the place error if the exact path had no ray offset: the same for every plugin",
    "pixels off": "pixels of which a channel differs by more than 0.1 from the built-in's, same seed",
    "pixels off, control": "the same between two formulas at the rounding limit: caused by flipped lobes alone",
}
AXES = {"x": "distance, or mrad of entry", "y": "deviation", "x_scale": "linear", "y_scale": "log"}
NAME = "paths"
BUILTIN = "dielectric"
SCALAR = "needs a compiled variant: on scalar arrays formulas compute in double precision"
SEED = 2028
RAYS = 64
VISIBLE = 0.1
# The images: a scene, what its parameters are, and the name of the view.
VIEWS: tuple[tuple[str, dict[str, str], str], ...] = (
    ("mirage", {}, "mirage, telescope"),
    ("mirage", {"fov": "1.3"}, "mirage, naked eye"),
    ("fibre", {}, "fibre"),
)


@dataclass(frozen=True)
class Bundle:
    """Rays by origin and direction (R × 3, exact in float32) in `media`, and which one the curves show."""

    origins: np.ndarray
    directions: np.ndarray
    media: np.ndarray
    shown: int

    def exact(self, layers: Layers, offset: float = layered_scenes.OFFSET) -> list[Path]:
        """Their exact paths through layers, with Mitsuba's ray offset or another one."""
        rays = zip(self.origins, self.directions, self.media, strict=True)
        return [layered_scenes.exact_path(layers, p, d, int(medium), offset) for p, d, medium in rays]


def tasks(context: Context) -> list[Task]:
    """One task per scene for the paths, one per view for the images; `quick` has the paths of the mirage."""
    scenes, seen = ((MIRAGE,), ()) if context.profile.quick else ((MIRAGE, FIBRE), VIEWS)
    paths = [(layers.scene, functools.partial(path_rows, context, layers)) for layers in scenes]
    views = [(f"image of the {view[2]}", functools.partial(view_rows, context, *view)) for view in seen]
    return [Task(f"paths: {name}", work) for name, work in paths + views]


def drawn_rows(context: Context) -> list[Row]:
    """The paths through the fibre, whose rays are random; those of the mirage are not."""
    return path_rows(context, FIBRE)


def plugins() -> list[str]:
    """The built-in, `refract`, and `refract` with each formula."""
    return [BUILTIN, PLUGIN, *(f"{PLUGIN}_{name}" for name in FORMULAS)]


# Paths ---------------------------------------------------------------------------------------------------------


def bundle(layers: Layers) -> Bundle:
    """Into the mirage at 0.15 to 9 thousandths of a radian; into the fibre anywhere, at angles that it guides."""
    if layers is MIRAGE:
        sine = np.geomspace(1.5e-4, 9e-3, RAYS)
        directions = np.stack([np.sqrt(1 - sine**2), -sine, 0 * sine], 1)
        origins, media = np.tile([-layered_scenes.POOL, 0.005, 0.0], (RAYS, 1)), np.zeros(RAYS, int)
        shown = RAYS * 2 // 5
    else:
        rng = np.random.default_rng(seeds.current(SEED))
        media = rng.integers(2, len(layers.indices) - 1, RAYS)
        edges = np.array([*layers.boundaries, 0.0])
        radius, n = (edges[media - 1] + edges[media]) / 2, np.array(layers.indices)[media]
        turn = rng.uniform(0, 2 * np.pi, RAYS)
        origins = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(RAYS, -layers.end)], 1)
        sine = rng.uniform(0.1, 0.9, RAYS) * np.sqrt(n**2 - layers.indices[1] ** 2) / n
        azimuth = rng.uniform(0, 2 * np.pi, RAYS)
        directions = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), -np.sqrt(1 - sine**2)], 1)
        shown = 0
    return Bundle(origins.astype(np.float32), directions.astype(np.float32), media, shown)


def trace(scene: Any, layers: Layers, rays: Bundle, steps: int) -> np.ndarray:
    """Start, direction and end of each segment as Mitsuba has it, S × 3 × R × 3; NaN after the end of a path.

    The sample 1 − 2⁻²⁴ reflects only where the reflectance is 1: total internal reflection.
    """
    import mitsuba as mi

    sampling, axis, sign, count = mi.BSDFContext(), layers.axis, math.copysign(1.0, layers.end), len(rays.media)
    found = dr.full(mi.Float, dr.nan, steps * 9 * count)
    ray = mi.Ray3f(mi.Point3f(rays.origins.T), mi.Vector3f(rays.directions.T))

    def step(i: Any, active: Any, ray: Any) -> tuple[Any, Any, Any]:
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        for j, x in enumerate((*ray.o, *ray.d, *si.p)):
            dr.scatter(found, x, (i * 9 + j) * count + dr.arange(mi.UInt32, count), active)
        active &= (sign * si.p[axis] < sign * layers.end) & ~si.shape.is_emitter()
        bs, _ = si.bsdf().sample(sampling, si, 1 - 2.0**-24, [0.5, 0.5], active)
        return i + 1, active, si.spawn_ray(si.to_world(bs.wo))

    start = dr.zeros(mi.UInt32, count), dr.full(mi.Bool, True, count), ray
    # One symbolic loop: each step would trace the callables of all media anew.
    dr.while_loop(start, lambda i, active, ray: active & (i < steps), step)
    return np.moveaxis(np.array(found, float).reshape(steps, 3, 3, count), 2, 3)


@dataclass(frozen=True)
class Deviation:
    """Of one traced path at the middle of each of its segments, which no ray offset separates from the exact one."""

    along: np.ndarray
    direction: np.ndarray
    conditioned: np.ndarray
    place: np.ndarray
    boundaries: int


def deviation(layers: Layers, exact: Path, segments: np.ndarray) -> Deviation:
    """`segments`: starts, directions and ends, S × 3 × 3, as far as they are finite.

    A cosine c' behind a boundary obeys c' dc' = c dc: so what is off by ε at the entry is off by ε sin α / c' there,
    α the angle between ray and layers at the entry.
    """
    starts, d, ends = segments[np.isfinite(segments).all((1, 2))].swapaxes(0, 1)
    d = d / np.linalg.norm(d, axis=1)[:, None]
    # The last segment ends far beyond the layers.
    beyond = (layers.end - starts[-1, layers.axis]) / d[-1, layers.axis]
    middle = np.concatenate([(starts[:-1] + ends[:-1]) / 2, [starts[-1] + d[-1] * beyond / 2]])
    segment, points = exact.at(layers, middle[:, layers.axis])
    across = np.delete(exact.starts - exact.starts[0], layers.axis, 1)
    extent = np.linalg.norm(across, axis=1).max() or math.inf
    sine = math.sqrt(1 - exact.directions[0, layers.axis] ** 2)
    direction = np.linalg.norm(d - exact.directions[segment], axis=1) / sine
    return Deviation(
        np.abs(middle[:, layers.axis] - exact.starts[0, layers.axis]),
        direction,
        direction * np.minimum(exact.cosines(layers)[segment] / sine, 1),
        np.linalg.norm(middle - points, axis=1) / extent,
        len(d) - 1,
    )


def path_rows(context: Context, layers: Layers) -> list[Row]:
    """A row of every plugin and of exact arithmetic with rounded inputs, and rows of curves."""
    if context.variant.startswith("scalar"):
        return [Row(NAME, plugin, layers.scene, context.variant, reason=SCALAR) for plugin in plugins()]
    import mitsuba as mi

    rays = bundle(layers)
    exact = rays.exact(layers)
    found: dict[str, list[Deviation]] = {}
    for plugin in plugins():
        scene = mi.load_file(str(SCENES / f"{layers.scene}.xml"), **scene_files.REPRODUCIBLE, bsdf=plugin)
        segments = trace(scene, layers, rays, 4 * max(len(path.media) for path in exact))
        found[plugin] = [deviation(layers, path, segments[:, :, i]) for i, path in enumerate(exact)]
    # The errors of the inputs alone: indices, or their ratios, rounded to float32 as a plugin may get them.
    n = np.array(layers.indices)
    ratios = (n[1:] / n[:-1]).astype(np.float32).astype(float)
    for name, x in ((INDICES, n.astype(np.float32).astype(float)), (RATIOS, n[0] * np.cumprod([1.0, *ratios]))):
        others = rays.exact(dataclasses.replace(layers, indices=tuple(x.tolist())))
        found[name] = [deviation(layers, p, q.segments()) for p, q in zip(exact, others, strict=True)]
    replay = {"scene": f"{layers.scene}.xml", "rays": RAYS, "seed": seeds.current(SEED), "shown": rays.shown}
    rows = [
        _path_row(layers, name, exact, parts, setting=context.variant, replay=replay | {"plugin": name})
        for name, parts in found.items()
    ]
    # How far the ray offset moves the exact paths; the median, as some turn elsewhere without it.
    plain = zip(rays.exact(layers, offset=0.0), exact, strict=True)
    offset = {"ray offset": float(np.median([deviation(layers, p, q.segments()).place.max() for p, q in plain]))}
    row = functools.partial(Row, NAME, "every plugin", setting=context.variant, values=offset, replay=replay)
    return rows + [row(case=f"{layers.scene}: {case}", curves=x) for case, x in _curves(rays, found).items()]


def _curves(rays: Bundle, found: dict[str, list[Deviation]]) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """By case and plugin: along the path that is shown, and at the end of every path."""
    entry = 1e3 * np.hypot(rays.directions[:, 1], rays.directions[:, 0] if rays.media.any() else 0)
    curves: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for plugin, parts in found.items():
        shown, end = parts[rays.shown], np.array([part.direction[-1] for part in parts])
        for case, x, y in (
            ("direction along a path", shown.along, shown.direction),
            ("place along a path", shown.along, shown.place),
            ("direction at the end, by angle of entry", entry, end),
        ):
            curves.setdefault(case, {})[plugin] = list(zip(x.tolist(), y.tolist(), strict=True))
    return curves


def _path_row(layers: Layers, name: str, exact: list[Path], parts: list[Deviation], **row: Any) -> Row:
    """Of the forms at the rounding limit: no ray takes a wrong path; in the mirage the direction is bounded a priori.

    A boundary rounds the cosine twice (b, and to world coordinates), u each; κ is off by u, and all of them together
    are no more than sin² α: (2 m + 1) u after m boundaries. A curved boundary adds the rounding of the intersection.
    """
    directions, places = ([float(getattr(part, x).max()) for part in parts] for x in ("direction", "place"))
    met = [len(path.media) - 1 for path in exact]
    values = {
        DIRECTION: max(directions),
        "direction / condition": float(max(part.conditioned.max() for part in parts)),
        MEDIAN_DIRECTION: float(np.median(directions)),
        PLACE: max(places),
        "median place": float(np.median(places)),
        WRONG_PATH: float(sum(part.boundaries != m for part, m in zip(parts, met, strict=True))),
    }
    formula = FORMULAS.get(name.removeprefix(f"{PLUGIN}_"))
    budgets: dict[str, float] = {}
    if name == PLUGIN or (formula and formula.budget.at_the_limit):
        budgets = {WRONG_PATH: 0.0}
        budgets |= {} if layers.round else {"direction / condition": (2 * max(met) + 1) * limits.PATH_BOUNDARY}
    return Row(NAME, name, f"{layers.scene}: path", values=values, budgets=budgets, **row)


# Images ------------------------------------------------------------------------------------------------------


def view_rows(context: Context, scene: str, parameters: dict[str, Any], name: str) -> list[Row]:
    """`refract` and the built-in, image against image; and what flipped lobes alone do, as a control."""
    if context.variant.startswith("scalar"):
        return [Row(NAME, PLUGIN, f"{name}: image", context.variant, reason=SCALAR)]
    profile, right = context.profile, other_right_formula()
    spp = max(1, profile.spp // 4)

    def render(plugin: str) -> np.ndarray:
        import mitsuba as mi

        path = str(SCENES / f"{scene}.xml")
        loaded = mi.load_file(path, **scene_files.REPRODUCIBLE, bsdf=plugin, res=profile.resolution, **parameters)
        return np.array(mi.render(loaded, spp=spp, seed=0), dtype=np.float64)

    reference, test, control = map(render, (BUILTIN, PLUGIN, right))
    values = {
        "pixels off": pixelwise.changes(reference, test, VISIBLE).share,
        "pixels off, control": pixelwise.changes(control, test, VISIBLE).share,
    }
    about = {"scene": f"{scene}.xml", "resolution": profile.resolution, "spp": spp, "seed": 0, **parameters}
    shown = {"reference": (BUILTIN, reference), "test": (PLUGIN, test)}
    images = {role: save_image(context.out, f"{name} {plugin}", x, about) for role, (plugin, x) in shown.items()}
    replay, budgets = about | {"control": right}, {"pixels off, control": limits.FLIPPED}
    return [Row(NAME, PLUGIN, f"{name}: image", context.variant, values, budgets, replay=replay, images=images)]


def other_right_formula() -> str:
    """A plugin at the rounding limit whose formula is not the default's."""
    import mitsuba as mi

    default = automatic(dr.backend_v(mi.Float))
    return next(f"{PLUGIN}_{k}" for k, f in FORMULAS.items() if f.budget.at_the_limit and k != default)


STUDY = Study(NAME, "Paths", about(__doc__), TERMS, tasks, axes=AXES, again=drawn_rows)
