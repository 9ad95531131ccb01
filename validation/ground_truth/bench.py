"""Optical systems as scenes in Mitsuba: traced rays, and bounds on Mitsuba's rounding errors in float32.

Mitsuba gets a system rotated by ASKEW; its intersections and its samples of the requested lobe are rotated back in
extended precision. Behind a boundary a ray continues STEP further along itself. Mitsuba's own offset, which is measured
for comparison, moves it along the normal by 1500 ε (1 + |p|), more than all other errors here.

The bound is of first order. Each boundary has a number of roundings; the effect of each on the answer comes from
differences of the exact path, and all effects are added. In units of u = 2⁻²⁴:

- FIRST: rounding of the first ray's direction and origin: 1u of each component.
- INTO: wi, three dot products of unit vectors, 3u each, √3 · 3u in all; Gram-Schmidt leaves a frame that is orthogonal
  and unit up to 7u, which rotates by half of that.
- NORMAL: of a face, edges between rotated corners (6u each), their product (3u), its length (2u), the rotation's own
  entries (2u); or a given normal by the inverse of a rotation (6u), product and length (5u), interpolation (5u). The
  error of a sphere's normal is smaller, plus the position's error over the radius.
- PLACE, relative to the largest length S: the ray's length, a coordinate, the shape's extent. A sphere: nearest point
  to the centre (2u), half the difference of squares (2.5u) and its root (3u), distance and position (2u), projection
  onto the sphere (4u); its own position, the step and the next vertex (4u); for an instance, the rotated ray and
  position (12u) instead of its own position. A triangle, by Möller and Trumbore: a numerator 7u and the denominator 6u
  in two directions (√2 · 13u), its inverse (1u), corners (3u), interpolation (3u), the step (1u). All over cos θ.
- ONWARD: wo by the formula (1u), three sums of products (√3 · 3u), the frame again (3.5u).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.plugins.refract import followed_context
from validation.reference import closed_forms, optical_systems
from validation.reference.optical_systems import ASKEW, BK7, Answers, Array, Boundary, Path, System, dot, length, unit
from validation.run.context import SCENES

U = 2.0**-24
FIRST, INTO, NORMAL, PLACE, ONWARD = 1.0, 9.0, 20.0, 28.0, 10.0
COUNTS = {"into": INTO, "normal": NORMAL, "place": PLACE, "onward": ONWARD}
STEP = 1e-2  # mm
APEX = closed_forms.HALF_TURN / 3


@dataclass(frozen=True)
class Bench:
    """A system and its scenes in Mitsuba: `scenes(plugin)`, one per boundary or one for all, as shapes by name.

    `nm`: wavelength of the rays, in a spectral variant.
    """

    system: System
    scenes: Callable[[str], list[dict[str, Any]]]
    nm: float | None = None

    def roundings(self) -> dict[tuple[int, str], Array]:
        """Return the rounding error of each value, N × 1; for positions in mm."""
        system, one = self.system, np.ones((len(self.system.origins), 1))
        sizes = {(-1, "place"): FIRST * length(system.origins), (-1, "onward"): FIRST * one}
        for j, (start, p, n, a, _) in enumerate(system.walk()):
            surface, size = system.boundaries[j].surface, system.boundaries[j].size
            longest = np.max([length(start), length(p), length(p - start), size * one], axis=0)
            place = PLACE * longest / np.abs(dot(n, a))
            sizes |= {(j, "place"): place, (j, "normal"): NORMAL + surface.bend * place}
            sizes |= {(j, "into"): INTO * one, (j, "onward"): ONWARD * one}
        return {key: U * size for key, size in sizes.items()}

    def effects(self, changes: Callable[[Path], Answers]) -> Iterator[tuple[float, Answers]]:
        """Yield for each value its number of roundings of 1u, and their effect size/NUDGE |change|, by answer.

        `changes`: returns the changes of the answers for a path with one value perturbed by NUDGE.
        """
        for (boundary, what), size in self.roundings().items():
            for way in range(3 if what == "place" else 2):
                path = self.system.path(moved=optical_systems.nudged(boundary, what, way))
                effect = {name: size / optical_systems.NUDGE * np.abs(x) for name, x in changes(path).items()}
                yield FIRST if boundary < 0 else COUNTS[what], effect

    @functools.cached_property
    def bounds(self) -> Answers:
        """Bounds on the norm of each answer's deviation, N × A, from roundings here and in the printed numbers."""
        system = self.system
        exact = system.off(system.path())

        def changes(path: Path) -> Answers:
            return {name: length(moved - exact[name])[..., 0] for name, moved in system.off(path).items()}

        effects = [effect for _, effect in self.effects(changes)]
        return {name: np.sum([x[name] for x in effects], axis=0) + system.printed.get(name, 0) for name in exact}

    @property
    def index_seen(self) -> float:
        """The smallest relative error of the denser sides' indices that moves an answer to its bound."""

        def denser(j: int, what: str, x: Any, axis: Any) -> Any:
            if what != "index" or x == 1:
                return x
            return x * (1 + optical_systems.NUDGE) if x > 1 else x / (1 + optical_systems.NUDGE)

        exact, wrong = self.system.off(self.system.path()), self.system.off(self.system.path(moved=denser))
        moved = {name: length(x - exact[name])[..., 0] / optical_systems.NUDGE for name, x in wrong.items()}
        return 1 / max(float((x / self.bounds[name]).max()) for name, x in moved.items())

    def traced(self, plugin: str, spawned: bool = False) -> Path:
        """Trace with Mitsuba in its current variant. `spawned`: with Mitsuba's own ray offset."""
        import mitsuba as mi

        system = self.system
        scenes = [mi.load_dict({"type": "scene", **shapes}) for shapes in self.scenes(plugin)]
        scenes *= len(system.boundaries) // len(scenes)
        origins, directions = ((x @ system.turn).astype(np.float32) for x in (system.origins, system.directions))
        if dr.is_jit_v(mi.Float):
            vectors = _through(scenes, system.boundaries, origins.T, directions.T, spawned, self.nm)
            vectors = np.moveaxis(vectors, 2, 3)
        else:
            rays = zip(origins, directions, strict=True)
            vectors = np.stack([_through(scenes, system.boundaries, o, d, spawned, self.nm) for o, d in rays], axis=2)
        places, directions = vectors
        return Path(places @ system.turn.T, unit(directions @ system.turn.T))

    def deviations(self, path: Path) -> Answers:
        """Return the norm of each answer's deviation, N × A; infinity for a ray that misses a boundary."""
        return {name: np.nan_to_num(length(x)[..., 0], nan=np.inf) for name, x in self.system.off(path).items()}


def _through(
    scenes: list[Any], boundaries: tuple[Boundary, ...], o: Array, d: Array, spawned: bool, nm: float | None = None
) -> Array:
    """Return positions and directions behind the boundaries, 2 × B × 3 (× N); in one kernel, except on CUDA."""
    import mitsuba as mi

    ray, places, directions = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)), [], []
    sampling = followed_context()
    for scene, boundary in zip(scenes, boundaries, strict=True):
        if nm is not None:
            ray.wavelengths = type(ray.wavelengths)(nm)
        si = scene.ray_intersect(ray)
        hit = si.is_valid()
        if hit is False:  # in a scalar variant sampling without a hit would crash the process
            return np.full((2, len(boundaries), 3), np.nan)
        sampling.component = int(boundary.k is not None)  # in both plugins 0 reflects, 1 transmits
        onward = si.to_world(si.bsdf().sample(sampling, si, 0.5, [0.5, 0.5])[0].wo)
        onward = dr.select(hit, onward, dr.nan)
        places.append(si.p)
        directions.append(onward)
        ray = si.spawn_ray(onward) if spawned else mi.Ray3f(dr.fma(STEP, onward, si.p), onward)
        ray.o.z -= boundary.thickness
        if dr.backend_v(ray.o) == dr.JitBackend.CUDA:  # with OptiX a kernel can trace one scene only
            dr.eval(ray, places, directions)
    dr.eval(places, directions)
    return np.array([[np.array(x, np.longdouble) for x in vectors] for vectors in (places, directions)])


# Scenes --------------------------------------------------------------------------------------------------------


def glass(plugin: str, inside: Any, outside: Any = 1.0) -> dict[str, Any]:
    """Return Mitsuba's dictionary of a glass by its two indices; text is passed on unchanged."""
    inside = inside if isinstance(inside, str) else float(inside)
    return {"type": plugin, "int_ior": inside, "ext_ior": float(outside)}


def _placed(scale: Any = 1.0) -> Any:
    """Return Mitsuba's transform of a shape: scaled along the axes, then rotated by ASKEW."""
    import mitsuba as mi

    matrix = np.eye(4)
    matrix[:3, :3] = ASKEW.T * np.asarray(scale, float)
    return mi.ScalarTransform4f(matrix.tolist())


def _ellipsoid(plugin: str) -> list[dict[str, Any]]:
    front, bubble = (boundary.surface for boundary in optical_systems.ellipsoid().boundaries)
    assert isinstance(front, optical_systems.Ball) and isinstance(bubble, optical_systems.Ball)
    centre = (bubble.centre[0] @ ASKEW).astype(float).tolist()
    inner = {"type": "sphere", "center": centre, "radius": optical_systems.BUBBLE, "bsdf": glass(plugin, 1, BK7)}
    group = {"type": "shapegroup", "shape": {"type": "sphere", "bsdf": glass(plugin, BK7)}}
    stretched = {"type": "instance", "group": {"type": "ref", "id": "ball"}, "to_world": _placed(front.axes[0])}
    return [{"ball": group, "front": stretched, "bubble": inner}]


def _double_gauss(plugin: str) -> list[dict[str, Any]]:
    """Return a scene per surface, a whole sphere or a rectangle; the surface's vertex is the origin.

    The outside is the side of the normal: for a sphere that is convex towards the light, the side of the light.
    """
    import mitsuba as mi

    scenes, before = [], 1.0
    for c, _, after in optical_systems.double_gauss_data()["prescription"]:
        inside, outside = (after, before) if c > 0 else (before, after)
        if c:
            shape = {"type": "sphere", "center": [0, 0, 1 / c], "radius": 1 / abs(c)}
        else:
            shape = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(40)}
        scenes.append({"surface": shape | {"bsdf": glass(plugin, inside, outside)}})
        before = after
    return scenes


def prism(plugin: str, index: Any = BK7) -> list[dict[str, Any]]:
    """Return the scene of a prism of 60°."""
    mesh = {"type": "ply", "filename": str(SCENES / "meshes" / "prism.ply"), "face_normals": True}
    return [{"prism": mesh | {"to_world": _placed(), "bsdf": glass(plugin, index)}}]


def ball(plugin: str, index: Any = BK7) -> list[dict[str, Any]]:
    """Return the scene of a ball around the origin."""
    return [{"ball": {"type": "sphere", "radius": optical_systems.RADIUS, "bsdf": glass(plugin, index)}}]


def benches() -> dict[str, Bench]:
    """Return all benches by name."""
    down = np.linspace(0.3, 0.6, optical_systems.RAYS)
    incidence = np.full(optical_systems.RAYS, closed_forms.least_deviated(APEX, BK7))
    least = optical_systems.prism(APEX, incidence, down)

    def slab(plugin: str) -> list[dict[str, Any]]:
        block = {"type": "cube", "to_world": _placed([60, 60, optical_systems.THICKNESS / 2])}
        return [{"block": block | {"bsdf": glass(plugin, BK7)}}]

    drop = functools.partial(ball, index=optical_systems.WATER)
    return {
        "slab": Bench(optical_systems.slab(85), slab),
        "prism, least deviation": Bench(least, prism),
        "prism, 32 … 85°": Bench(optical_systems.prism(APEX, optical_systems.degrees(32, 85)), prism),
        "aplanatic ball": Bench(optical_systems.aplanatic(), ball),
        "ellipsoid lens": Bench(optical_systems.ellipsoid(80), _ellipsoid),
        "drop, one reflection": Bench(optical_systems.drop(1, optical_systems.degrees(2, 80)), drop),
        "drop, two reflections": Bench(optical_systems.drop(2, optical_systems.degrees(2, 80)), drop),
        "double Gauss": Bench(optical_systems.double_gauss(), _double_gauss),
    }
