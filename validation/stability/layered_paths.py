"""Paths: rays through the layers of `scenes/mirage.xml` and `scenes/fibre.xml`, against the exact path.

A ray is traced through Mitsuba's scene with the plugin's own samples, transmitted wherever possible, and compared with
a path of straight segments and Snell's law in double precision. Both include Mitsuba's ray offset: in the mirage it
shifts rays by more than any other error, but does not change their directions. Every solid lies inside the one before
it, so each boundary separates two absolute indices. Layers cannot be much thinner than Mitsuba's ray offset, which
would skip them. The images show the mirage through a telescope and to the naked eye, and the fibre.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.formulas import FORMULAS
from mi_refract.image_diff import pixelwise
from mi_refract.plugins import PLUGIN
from mi_refract.rendering import scene_files
from mi_refract.report.row import Row
from validation import limits
from validation.run import seeds
from validation.run.array_settings import DOCUMENTED, RIGHT_PLUGINS
from validation.run.bsdf_sampling import OFFSET
from validation.run.context import SCENES, Context
from validation.run.metrics import BUILTIN_OFF_EXACT, OFF_EXACT, WRONG_PATH
from validation.run.render_methods import Camera, opened, save_image
from validation.study import Study, Task, about

INDICES, RATIOS = "exact, indices in float32", "exact, ratios in float32"
DIRECTION, MEDIAN_DIRECTION, PLACE = "direction", "median direction", "place"
TERMS = {
    "direction": "largest |d − exact| anywhere on a path, divided by the sine of the angle of entry",
    "direction / condition": "the same, divided by the factor by which a decreasing cosine magnifies any error",
    "direction / bound": "that over the bound of the ray's number of boundaries",
    PLACE: "largest distance from the exact path, divided by the exact path's extent across the layers",
    INDICES: "Snell's law in double precision for indices rounded to float32, the inputs of the built-in",
    RATIOS: "the same for ratios of neighbours rounded to float32, the inputs of the other formulas",
    WRONG_PATH: "rays that meet a wrong number of boundaries",
    "ray offset": "the place error if the exact path had no ray offset: the same for every plugin",
    "pixels off": "share of pixels with a channel that differs by more than 0.1 from the built-in's image, same seed",
    "pixels off, control": "the same between two formulas at the rounding limit: caused by flipped lobes alone",
    "exact (image)": "the image by Snell's and Fresnel's laws in double precision, with Mitsuba's ray offset",
    OFF_EXACT: "share of pixels with a channel that differs by more than 0.1 from the exact image, which uses other "
    "random numbers",
    BUILTIN_OFF_EXACT: "the same for the built-in's image",
    "off exact / built-in": "the ratio of these two shares",
}
AXES = {"x": "distance, or mrad of entry", "y": "deviation", "x_scale": "linear", "y_scale": "log"}
NAME = "paths"
BUILTIN = "dielectric"
SCALAR = "needs a compiled variant: on scalar arrays formulas compute in double precision"
SEED = 2028
RAYS = 64
VISIBLE = 0.1
EXACT_SPP = 64
# The images: a scene, its parameters, and the name of the view.
VIEWS: tuple[tuple[str, dict[str, str], str], ...] = (
    ("mirage", {}, "mirage, telescope"),
    ("mirage", {"fov": "1.3"}, "mirage, naked eye"),
    ("fibre", {}, "fibre"),
)


# Layers and exact paths ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Layers:
    """Media 0 (outermost) to N: medium k has `indices[k]` and lies between the boundaries k − 1 and k.

    A boundary is the plane y = `boundaries[k]` or, if `round`, the cylinder of that radius around the z axis. `axis`:
    the coordinate along which light travels, toward `end`, where paths are cut off. Lengths are in scene units.
    """

    scene: str
    indices: tuple[float, ...]
    boundaries: tuple[float, ...]
    round: bool
    axis: int
    end: float

    def normal(self, p: np.ndarray) -> np.ndarray:
        """Return the outward normal of the boundary at `p`."""
        return np.array([p[0], p[1], 0.0]) / math.hypot(p[0], p[1]) if self.round else np.array([0.0, 1.0, 0.0])

    def distance(self, p: np.ndarray, d: np.ndarray, boundary: int, inward: bool) -> float:
        """Return the distance from `p` along `d` to a boundary, met from outside if `inward`; inf without a hit."""
        if not 0 <= boundary < len(self.boundaries):
            return math.inf
        if not self.round:
            return (self.boundaries[boundary] - p[1]) / d[1] if inward == (d[1] < 0) else math.inf
        a, b = d[:2] @ d[:2], p[:2] @ d[:2]
        # b² − a c by Lagrange's identity, without cancellation of large terms.
        root2 = a * self.boundaries[boundary] ** 2 - (p[0] * d[1] - p[1] * d[0]) ** 2
        if root2 < 0 or (inward and b >= 0):
            return math.inf
        return float((-b - math.sqrt(root2)) / a if inward else (-b + math.sqrt(root2)) / a)


@dataclass(frozen=True)
class Path:
    """Straight segments from `starts` to `ends` (M × 3) in the media `media`, and their unit `directions`."""

    starts: np.ndarray
    ends: np.ndarray
    directions: np.ndarray
    media: tuple[int, ...]

    def segments(self) -> np.ndarray:
        """Return starts, directions and ends, M × 3 × 3."""
        return np.stack([self.starts, self.directions, self.ends], 1)

    def cosines(self, layers: Layers) -> np.ndarray:
        """Return |d · n| of every segment, with the normal n at its start."""
        return np.abs([d @ layers.normal(p) for p, d in zip(self.starts, self.directions, strict=True)])

    def at(self, layers: Layers, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the segments and the points whose coordinate along the axis has the values `along`."""
        axis = layers.axis
        forward = math.copysign(1.0, self.directions[0, axis])
        segment = np.searchsorted(forward * self.ends[:-1, axis], forward * along)
        distance = (along - self.starts[segment, axis]) / self.directions[segment, axis]
        return segment, self.starts[segment] + distance[:, None] * self.directions[segment]


def exact_path(layers: Layers, p: np.ndarray, d: np.ndarray, medium: int, offset: float = OFFSET) -> Path:
    """Return the path of a ray from `p` in `medium` toward `d`, with Snell's law at each boundary.

    With P = n d the tangential part of P is conserved and P_n² changes by n'² − n² = (n' − n)(n' + n); if that makes it
    negative, P_n is reversed. In double precision c = P_n/n has an error of 2⁻⁵² n/P_n. The path includes Mitsuba's ray
    offset, unless `offset` = 0.
    """
    p, momentum = np.array(p, float), np.array(d, float)
    momentum *= layers.indices[medium] / np.linalg.norm(momentum)
    starts, ends, media = [], [], []
    while True:
        direction = momentum / np.linalg.norm(momentum)
        inner, outer = (layers.distance(p, direction, medium - out, not out) for out in (0, 1))
        last = (layers.end - p[layers.axis]) / direction[layers.axis]
        length = min(inner, outer, last)
        starts.append(p)
        ends.append(p + length * direction)
        media.append(medium)
        if length == last:
            break
        p, beyond = ends[-1], medium + 1 if inner < outer else medium - 1
        normal = layers.normal(p)
        along = float(momentum @ normal)
        n, n_beyond = layers.indices[medium], layers.indices[beyond]
        square = along * along + (n_beyond - n) * (n_beyond + n)
        after = math.copysign(math.sqrt(square), along) if square >= 0 else -along
        momentum, medium = momentum + (after - along) * normal, beyond if square >= 0 else medium
        p = p + normal * math.copysign(offset * (1 + np.abs(p).max()), after)
    points = np.array(starts), np.array(ends)
    return Path(*points, (points[1] - points[0]) / np.linalg.norm(points[1] - points[0], axis=1)[:, None], tuple(media))


# The scenes ----------------------------------------------------------------------------------------------------

POOL = 100.0  # half the length of the warm air
STEP = 0.02  # a solid is smaller than the one around it by this, on sides without light


def _read(scene: str) -> Layers:
    """Read the layers of a scene file: BSDFs to_1, to_2, …, and boxes layer_i from the top, or cylinders shell_i."""
    root = ET.parse(SCENES / f"{scene}.xml").getroot()

    def values(path: str, name: str = "value") -> list[float]:
        """Return an attribute of every element with this path from the root, within the elements of the layers."""
        layers = [x for x in root.iterfind(path.partition("/")[0]) if (x.get("id") or "").startswith(prefixes)]
        return [float(y.attrib[name]) for x in layers for y in x.iterfind(path.partition("/")[2])]

    prefixes = ("to_", "layer_", "shell_")
    indices = (values("bsdf/*[@name='ext_ior']")[0], *values("bsdf/*[@name='int_ior']"))
    if radii := values("shape/float[@name='radius']"):
        (first, *_) = root.iterfind("shape/point[@name='p1']")
        return Layers(scene, indices, tuple(radii), True, 2, round(1 - float(first.attrib["value"].split(",")[2]), 3))
    heights = zip(values("shape/*/translate", "y"), values("shape/*/scale", "y"), strict=True)
    boundaries = tuple(round(y + half, 4) for y, half in heights)
    return Layers(scene, indices, boundaries, False, 0, POOL - STEP * len(indices))


LAYERS = {scene: _read(scene) for scene in ("mirage", "fibre")}
MIRAGE, FIBRE = LAYERS.values()


# The study -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bundle:
    """Rays: origins and directions (R × 3, exact in float32), their media, and the index of the ray in the curves."""

    origins: np.ndarray
    directions: np.ndarray
    media: np.ndarray
    shown: int

    def exact(self, layers: Layers, offset: float = OFFSET) -> list[Path]:
        """Return the exact paths of the rays through layers, with Mitsuba's ray offset or another one."""
        rays = zip(self.origins, self.directions, self.media, strict=True)
        return [exact_path(layers, p, d, int(medium), offset) for p, d, medium in rays]


def tasks(context: Context) -> list[Task]:
    """Return one task per scene for the paths and one per view for the images; `quick` has the mirage's paths only."""
    scenes, views = ((MIRAGE,), ()) if context.profile.quick else ((MIRAGE, FIBRE), VIEWS)
    paths = [(layers.scene, functools.partial(path_rows, context, layers)) for layers in scenes]
    images = [(f"image of the {view[2]}", functools.partial(view_rows, context, *view)) for view in views]
    return [Task(f"paths: {name}", work) for name, work in paths + images]


def drawn_rows(context: Context) -> list[Row]:
    """Return the paths through the fibre, whose rays are random; those of the mirage are not."""
    return path_rows(context, FIBRE)


def plugins() -> list[str]:
    """Return the names of the built-in, of `refract`, and of `refract` with each formula."""
    return [BUILTIN, PLUGIN, *(f"{PLUGIN}_{name}" for name in FORMULAS)]


# Paths ---------------------------------------------------------------------------------------------------------


def bundle(layers: Layers) -> Bundle:
    """Return rays into the mirage at 0.15 to 9 mrad, or into the fibre at random places and guided angles."""
    if layers is MIRAGE:
        sine = np.geomspace(1.5e-4, 9e-3, RAYS)
        directions = np.stack([np.sqrt(1 - sine**2), -sine, 0 * sine], 1)
        origins, media = np.tile([-POOL, 0.005, 0.0], (RAYS, 1)), np.zeros(RAYS, int)
        shown = RAYS * 2 // 5
    else:
        rng = np.random.default_rng(seeds.current(SEED))
        media = rng.integers(2, len(layers.indices) - 1, RAYS)
        edges = np.array([*layers.boundaries, 0.0])
        radius, n = (edges[media - 1] + edges[media]) / 2, np.array(layers.indices)[media]
        polar = rng.uniform(0, 2 * np.pi, RAYS)
        origins = np.stack([radius * np.cos(polar), radius * np.sin(polar), np.full(RAYS, -layers.end)], 1)
        sine = rng.uniform(0.1, 0.9, RAYS) * np.sqrt(n**2 - layers.indices[1] ** 2) / n
        azimuth = rng.uniform(0, 2 * np.pi, RAYS)
        directions = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), -np.sqrt(1 - sine**2)], 1)
        shown = 0
    return Bundle(origins.astype(np.float32), directions.astype(np.float32), media, shown)


def trace(scene: Any, layers: Layers, rays: Bundle, steps: int) -> np.ndarray:
    """Return start, direction and end of each segment in Mitsuba, S × 3 × R × 3; NaN after the end of a path.

    The sample 1 − 2⁻²⁴ reflects only if the reflectance is 1: total internal reflection.
    """
    import mitsuba as mi

    sampling, axis, sign, count = mi.BSDFContext(), layers.axis, math.copysign(1.0, layers.end), len(rays.media)
    segments = dr.full(mi.Float, dr.nan, steps * 9 * count)
    ray = mi.Ray3f(mi.Point3f(rays.origins.T), mi.Vector3f(rays.directions.T))

    def step(i: Any, active: Any, ray: Any) -> tuple[Any, Any, Any]:
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        for j, x in enumerate((*ray.o, *ray.d, *si.p)):
            dr.scatter(segments, x, (i * 9 + j) * count + dr.arange(mi.UInt32, count), active)
        active &= (sign * si.p[axis] < sign * layers.end) & ~si.shape.is_emitter()
        bs, _ = si.bsdf().sample(sampling, si, 1 - 2.0**-24, [0.5, 0.5], active)
        return i + 1, active, si.spawn_ray(si.to_world(bs.wo))

    start = dr.zeros(mi.UInt32, count), dr.full(mi.Bool, True, count), ray
    # One symbolic loop: otherwise each step would trace the callables of all media again.
    dr.while_loop(start, lambda i, active, ray: active & (i < steps), step)
    return np.moveaxis(np.array(segments, float).reshape(steps, 3, 3, count), 2, 3)


@dataclass(frozen=True)
class Deviation:
    """Errors of a traced path at the middle of each segment, where the ray offset does not separate the paths."""

    along: np.ndarray
    direction: np.ndarray
    conditioned: np.ndarray
    place: np.ndarray
    boundaries: int


def deviation(layers: Layers, exact: Path, segments: np.ndarray) -> Deviation:
    """Return the deviation of `segments` (starts, directions and ends, S × 3 × 3) from the exact path; NaN is skipped.

    A cosine c' behind a boundary obeys c' dc' = c dc: an error of ε at the entry becomes ε sin α / c' there, where α is
    the angle between ray and layers at the entry.
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
    """Return a row per plugin, rows of exact arithmetic with rounded inputs, and rows of curves."""
    if context.variant.startswith("scalar"):
        return [Row(NAME, plugin, layers.scene, context.variant, reason=SCALAR) for plugin in plugins()]
    import mitsuba as mi

    rays = bundle(layers)
    exact = rays.exact(layers)
    deviations: dict[str, list[Deviation]] = {}
    for plugin in plugins():
        scene = mi.load_file(str(SCENES / f"{layers.scene}.xml"), **scene_files.REPRODUCIBLE, bsdf=plugin)
        segments = trace(scene, layers, rays, 4 * max(len(path.media) for path in exact))
        deviations[plugin] = [deviation(layers, path, segments[:, :, i]) for i, path in enumerate(exact)]
    # The errors of the inputs alone: indices, or their ratios, rounded to float32.
    n = np.array(layers.indices)
    ratios = (n[1:] / n[:-1]).astype(np.float32).astype(float)
    for name, x in ((INDICES, n.astype(np.float32).astype(float)), (RATIOS, n[0] * np.cumprod([1.0, *ratios]))):
        others = rays.exact(dataclasses.replace(layers, indices=tuple(x.tolist())))
        deviations[name] = [deviation(layers, p, q.segments()) for p, q in zip(exact, others, strict=True)]
    replay = {"scene": f"{layers.scene}.xml", "rays": RAYS, "seed": seeds.current(SEED), "shown": rays.shown}
    rows = [
        _path_row(layers, name, exact, parts, setting=context.variant, replay=replay | {"plugin": name})
        for name, parts in deviations.items()
    ]
    # The shift of the exact paths by the ray offset; the median, as some rays turn at another layer without it.
    plain = zip(rays.exact(layers, offset=0.0), exact, strict=True)
    offset = {"ray offset": float(np.median([deviation(layers, p, q.segments()).place.max() for p, q in plain]))}
    row = functools.partial(Row, NAME, "every plugin", setting=context.variant, values=offset, replay=replay)
    return rows + [row(case=f"{layers.scene}: {case}", curves=x) for case, x in _curves(rays, deviations).items()]


def _curves(rays: Bundle, deviations: dict[str, list[Deviation]]) -> dict[str, dict[str, list[tuple[float, float]]]]:
    """Return curves by case and plugin: along the path that is shown, and at the end of every path."""
    entry = 1e3 * np.hypot(rays.directions[:, 1], rays.directions[:, 0] if rays.media.any() else 0)
    curves: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for plugin, parts in deviations.items():
        shown, end = parts[rays.shown], np.array([part.direction[-1] for part in parts])
        for case, x, y in (
            ("direction along a path", shown.along, shown.direction),
            ("place along a path", shown.along, shown.place),
            ("direction at the end, by angle of entry", entry, end),
        ):
            curves.setdefault(case, {})[plugin] = list(zip(x.tolist(), y.tolist(), strict=True))
    return curves


def _path_row(layers: Layers, name: str, exact: list[Path], parts: list[Deviation], **row: Any) -> Row:
    """Return the row of a plugin's paths, with budgets for forms at the rounding limit.

    No ray may take a wrong path; in the mirage the direction is bounded a priori. A boundary rounds the cosine twice
    (b, and to world coordinates), by u each. Each κ errs by u of itself, and the sum of all κ is at most sin² α:
    (2 m + 1) u after m boundaries. A curved boundary adds the rounding error of the intersection.
    """
    directions, places = ([float(getattr(part, x).max()) for part in parts] for x in ("direction", "place"))
    boundaries = [len(path.media) - 1 for path in exact]
    conditioned = np.array([part.conditioned.max() for part in parts])
    values = {
        DIRECTION: max(directions),
        "direction / condition": float(conditioned.max()),
        MEDIAN_DIRECTION: float(np.median(directions)),
        PLACE: max(places),
        "median place": float(np.median(places)),
        WRONG_PATH: float(sum(part.boundaries != m for part, m in zip(parts, boundaries, strict=True))),
    }
    if not layers.round:
        bounds = limits.PATH_BOUNDARY * (2 * np.array(boundaries) + 1)
        values["direction / bound"] = float((conditioned / bounds).max())
    formula = FORMULAS.get(name.removeprefix(f"{PLUGIN}_"))
    budgets: dict[str, float] = {}
    if name == PLUGIN or (formula and formula.budget.at_the_limit):
        budgets = {WRONG_PATH: 0.0}
        budgets |= {} if layers.round else {"direction / bound": 1.0}
    return Row(NAME, name, f"{layers.scene}: path", values=values, budgets=budgets, **row)


# Images ------------------------------------------------------------------------------------------------------


def view_rows(context: Context, scene: str, parameters: dict[str, Any], name: str) -> list[Row]:
    """Return the row of `refract`'s image against the built-in's, with the effect of flipped lobes as a control."""
    if context.variant.startswith("scalar"):
        return [Row(NAME, PLUGIN, f"{name}: image", context.variant, reason=SCALAR)]
    profile, right, exact = context.profile, RIGHT_PLUGINS[0], name == VIEWS[0][-1]
    spp, plugins = EXACT_SPP if exact else max(1, profile.spp // 4), (BUILTIN, PLUGIN, right)
    path = SCENES / f"{scene}.xml"
    scenes = {plugin: opened(path, plugin, profile.resolution, **parameters) for plugin in plugins}
    reference, test, control = (Camera(scenes[plugin])(spp, seed=0)[0] for plugin in plugins)
    values = {
        "pixels off": pixelwise.changes(reference, test, VISIBLE).share,
        "pixels off, control": pixelwise.changes(control, test, VISIBLE).share,
    }
    about = {"scene": f"{scene}.xml", "resolution": profile.resolution, "spp": spp, "seed": 0, **parameters}
    shown = {"reference": (BUILTIN, reference), "test": (PLUGIN, test)}
    replay, budgets = about | {"control": right}, {"pixels off, control": limits.FLIPPED}
    if exact:
        image = exact_image(LAYERS[scene], scenes[PLUGIN], spp)
        shown["exact"] = "exact", image
        off, builtin_off = (pixelwise.changes(image, x, VISIBLE).share for x in (test, reference))
        values |= {OFF_EXACT: off, BUILTIN_OFF_EXACT: builtin_off, "off exact / built-in": off / builtin_off}
        budgets["off exact / built-in"] = limits.OFF_EXACT
    images = {role: save_image(context.out, f"{name} {plugin}", x, about) for role, (plugin, x) in shown.items()}
    return [Row(NAME, PLUGIN, f"{name}: image", context.variant, values, budgets, replay=replay, images=images)]


def exact_image(layers: Layers, scene: Any, spp: int) -> np.ndarray:
    """Render plane layers through the scene's camera, by Snell's and Fresnel's laws in double precision.

    Random numbers choose between reflection and refraction. With P = n d as in `exact_path`, R of the s wave is
    ((P_n − P'_n)/(P_n + P'_n))²; R of the p wave differs by the relative step of the index, at most 7e-6.
    """
    import mitsuba as mi
    from mitsuba.ad.integrators.common import ADIntegrator

    sensor, count = scene.sensors()[0], len(layers.boundaries)
    sampler, spp = ADIntegrator.prepare(None, sensor, SEED, spp, [])
    ray, _, _ = ADIntegrator.sample_rays(None, scene, sensor, sampler)
    generator: Any = mi.PCG32
    number, width = mi.Float64, dr.width(ray.o)
    indices, heights = number(layers.indices), number(layers.boundaries)

    def step(p: Any, momentum: Any, medium: Any, random: Any, active: Any) -> tuple[Any, ...]:
        down = momentum.y < 0
        boundary, beyond = dr.select(down, medium, medium - 1), dr.select(down, medium + 1, medium - 1)
        active &= (boundary >= 0) & (boundary < count)
        height = dr.gather(number, heights, boundary, active)
        length = (height - p.y) / momentum.y
        active &= length * momentum.x < layers.end - p.x
        n, n_beyond = (dr.gather(number, indices, x, active) for x in (medium, beyond))
        before = dr.abs(momentum.y)
        after = dr.sqrt(dr.maximum(before * before + (n_beyond - n) * (n_beyond + n), 0))
        through = random.next_float64() >= dr.square((before - after) / (before + after))
        up = dr.select(through, dr.mulsign(after, momentum.y), -momentum.y)
        place = p + length * momentum
        place.y = height + dr.mulsign(OFFSET * (1 + dr.max(dr.abs(place))), up)
        p, momentum.y = dr.select(active, place, p), dr.select(active, up, momentum.y)
        return p, momentum, dr.select(active & through, beyond, medium), random, active

    start = mi.Point3d(ray.o), layers.indices[0] * dr.normalize(mi.Vector3d(ray.d)), dr.zeros(mi.Int32, width)
    state: Any = *start, generator(width), dr.full(mi.Bool, True, width)
    p, momentum, medium, *_ = dr.while_loop(state, lambda *state: state[-1], step)
    # The road is in the innermost medium; light leaves the other media into air through upright faces.
    leaves = medium < count
    p = dr.select(leaves, p + momentum * ((POOL + STEP - p.x) / momentum.x), p)
    squares = layers.indices[0] ** 2 - dr.square(momentum.y) - dr.square(momentum.z)
    momentum.x = dr.select(leaves, dr.sqrt(squares), momentum.x)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(p), mi.Vector3f(dr.normalize(momentum))))
    radiance = np.array(si.emitter(scene).eval(si), float).T
    return np.asarray(radiance.reshape(*sensor.film().crop_size()[::-1], spp, 3).mean(2))


RECORDS = (BUILTIN, *(f"{PLUGIN}_{name}" for name in DOCUMENTED), INDICES, RATIOS, "every plugin")
STUDY = Study(NAME, "Paths", about(__doc__), TERMS, tasks, axes=AXES, again=drawn_rows, records=RECORDS)
