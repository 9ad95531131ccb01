"""Rays through bodies in a scene of Mitsuba, boundary by boundary, and what its float32 may make of them.

A bench is described in coordinates of its own. Mitsuba has it turned by `systems.ASKEW`, so that no axis is special;
its intersections and its samples, of the lobe that is asked for, are turned back in extended precision. A ray goes on
along itself, STEP further: Mitsuba's own way, which is measured beside it, sets it off along the normal by 1500 ε
(1 + |p|), and that is more than everything else here.

The bound is of first order. Each boundary is given its share of roundings; what a change of any of them does to the
answer is taken from differences of the exact path, and all of them add up. In units of u = 2⁻²⁴:

- FIRST: the first ray's direction and origin, rounded: 1u of each component.
- INTO: wi, three dot products of unit vectors, 3u each, √3 · 3u in all; a frame that Gram-Schmidt leaves orthogonal and
  unit to 7u turns by half of that.
- NORMAL: of a face, edges between turned corners (6u each), their product (3u), its length (2u), the turn's own entries
  (2u); or a given normal by the inverse of a turn (6u), product and length (5u), interpolated (5u). A sphere's is off
  by less; and by its place's error over its radius.
- PLACE, of the largest length S in play: the ray's way, a coordinate, the shape's extent. A sphere: nearest point to
  the centre (2u), half the difference of squares (2.5u) and its root (3u), way and place (2u), back on the sphere (4u);
  its own place, the step onward and the next vertex (4u); of an instance, the ray and the place turned (12u) and no own
  place. A triangle, by Möller and Trumbore: a numerator 7u and the denominator 6u in two directions (√2 · 13u), its
  inverse (1u), corners (3u), interpolation (3u), the step (1u). All over cos θ.
- ONWARD: wo by the formula (1u), three sums of products (√3 · 3u), the frame again (3.5u).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np

from validation.reference.optical_systems import ASKEW, Array, across, dot, snell, unit, vectors

U = 2.0**-24
FIRST, INTO, NORMAL, PLACE, ONWARD = 1.0, 9.0, 20.0, 28.0, 10.0
STEP = 1e-2  # mm
NUDGE = 1e-8  # mm, and radians

Answers = dict[str, Array]
Moved = Callable[[int, str, Array, Array], Array]


@dataclass(frozen=True)
class Plane:
    """Through `point`, with a unit `normal`."""

    point: Array
    normal: Array
    bend = 0.0

    def meet(self, p: Array, d: Array) -> tuple[Array, Array]:
        """Where rays from `p` along `d` (N × 3) meet it, and the unit normals there."""
        return p + d * (dot(self.normal, self.point - p) / dot(self.normal, d)), np.broadcast_to(self.normal, p.shape)


@dataclass(frozen=True)
class Ball:
    """An ellipsoid along the axes, or a sphere; `far`: met from within."""

    centre: Array
    axes: Array
    far: bool = False

    @property
    def bend(self) -> float:
        """The most that its normal turns a mm."""
        return float(self.axes.max() / self.axes.min() ** 2)

    def meet(self, p: Array, d: Array) -> tuple[Array, Array]:
        """Where rays from `p` along `d` (N × 3) meet it, and the unit normals there."""
        q, e = (p - self.centre) / self.axes, d / self.axes
        b, square = dot(q, e), dot(e, e)
        root = np.sqrt(b * b - square * (dot(q, q) - 1))
        p = p + d * ((root if self.far else -root) - b) / square
        return p, unit((p - self.centre) / self.axes**2)


@dataclass(frozen=True)
class Boundary:
    """`k` = n_from/n_to; None: reflected. `size`: the extent of its shape from the origin, mm. Behind it, places
    count from `thickness` further along z."""

    surface: Plane | Ball
    k: Any
    size: float
    thickness: float = 0.0

    def turn(self, a: Array, n: Array) -> Array:
        """The directions behind it, by Snell's law or by reflection."""
        return a - 2 * dot(n, a) * n if self.k is None else snell(a, n, self.k)

    def denser(self, share: float) -> Boundary:
        """With more in the index of its denser side."""
        more = 1.0 if self.k is None or self.k == 1 else 1 + share if self.k > 1 else 1 / (1 + share)
        return self if self.k is None else dataclasses.replace(self, k=self.k * more)


@dataclass(frozen=True)
class Path:
    """Of N rays at B boundaries: places, and unit directions behind each, B × N × 3."""

    places: Array
    directions: Array


@dataclass(frozen=True)
class Bench:
    """Rays (N × 3, extended precision, lengths in mm), the boundaries that they meet one after the other, and their
    scenes: `scenes(plugin)`, one a boundary or one for all, shapes by name as Mitsuba describes them.

    `off(path)`: by answer, what the path says less the closed form, N × A × components. `printed`: how far from the
    truth the other side of that may itself be, by answer.
    """

    origins: Array
    directions: Array
    boundaries: tuple[Boundary, ...]
    scenes: Callable[[str], list[dict[str, Any]]]
    off: Callable[[Path], Answers]
    turn: Array = field(default_factory=lambda: ASKEW)
    printed: dict[str, float] = field(default_factory=dict)

    def exact(self, moved: Moved = lambda boundary, what, x, axis: x) -> Path:
        """In extended precision; `moved` may disturb anything on the way."""
        met = list(self._walk(moved))
        return Path(np.array([p for _, p, _, _, _ in met]), np.array([unit(b) for _, _, _, _, b in met]))

    def _walk(self, moved: Moved) -> Iterator[tuple[Array, ...]]:
        """At each boundary: where the rays come from, place, normal, directions before and behind."""
        b = moved(-1, "onward", self.directions, self.directions)
        p = moved(-1, "place", self.origins, b)
        for j, boundary in enumerate(self.boundaries):
            start, (p, n) = p, boundary.surface.meet(p, b)
            a = moved(j, "into", b, b)
            b = boundary.turn(a, moved(j, "normal", n, n))
            b = moved(j, "onward", b, b)
            p = moved(j, "place", p, b)
            yield start, p, n, a, b
            p = p - vectors(0, 0, boundary.thickness)

    def roundings(self) -> dict[tuple[int, str], Array]:
        """How far each value may be off: N × 1, of places in mm."""
        one = np.ones((len(self.origins), 1))
        sizes = {(-1, "place"): FIRST * length(self.origins), (-1, "onward"): FIRST * one}
        for j, (start, p, n, a, _) in enumerate(self._walk(lambda boundary, what, x, axis: x)):
            surface, size = self.boundaries[j].surface, self.boundaries[j].size
            longest = np.max([length(start), length(p), length(p - start), size * one], axis=0)
            place = PLACE * longest / np.abs(dot(n, a))
            sizes |= {(j, "place"): place, (j, "normal"): NORMAL + surface.bend * place}
            sizes |= {(j, "into"): INTO * one, (j, "onward"): ONWARD * one}
        return {key: U * size for key, size in sizes.items()}

    @functools.cached_property
    def bounds(self) -> Answers:
        """Of the norm of each answer's deviation, N × A: roundings, and what was printed."""
        exact = self.off(self.exact())
        totals = {name: np.full(x.shape[:2], self.printed.get(name, 0), np.longdouble) for name, x in exact.items()}
        for (boundary, what), size in self.roundings().items():
            for way in range(3 if what == "place" else 2):
                moved = self.off(self.exact(_nudged(boundary, what, way)))
                for name, total in totals.items():
                    total += size / NUDGE * length(moved[name] - exact[name])[..., 0]
        return totals

    @property
    def index_seen(self) -> float:
        """The least error, relative, of the index of the denser side everywhere that takes an answer to its bound."""
        exact = self.off(self.exact())
        wrong = dataclasses.replace(self, boundaries=tuple(x.denser(NUDGE) for x in self.boundaries))
        off = {name: length(x - exact[name])[..., 0] / NUDGE for name, x in wrong.off(wrong.exact()).items()}
        return 1 / max(float((x / self.bounds[name]).max()) for name, x in off.items())

    def traced(self, plugin: str, spawned: bool = False) -> Path:
        """By Mitsuba, in its present variant. `spawned`: rays go on as Mitsuba would have them."""
        import mitsuba as mi

        scenes = [mi.load_dict({"type": "scene", **shapes}) for shapes in self.scenes(plugin)]
        scenes *= len(self.boundaries) // len(scenes)
        origins, directions = ((x @ self.turn).astype(np.float32) for x in (self.origins, self.directions))
        if dr.is_jit_v(mi.Float):
            found = np.moveaxis(_through(scenes, self.boundaries, origins.T, directions.T, spawned), 2, 3)
        else:
            rays = zip(origins, directions, strict=True)
            found = np.stack([_through(scenes, self.boundaries, o, d, spawned) for o, d in rays], axis=2)
        places, directions = found
        return Path(places @ self.turn.T, unit(directions @ self.turn.T))

    def deviations(self, path: Path) -> Answers:
        """The norm of each answer's deviation, N × A; a ray that did not get there is off by infinity."""
        return {name: np.nan_to_num(length(x)[..., 0], nan=np.inf) for name, x in self.off(path).items()}


def length(x: Array) -> Array:
    """Of vectors (… × 3), as … × 1."""
    return np.sqrt(dot(x, x))


def _nudged(boundary: int, what: str, way: int) -> Moved:
    """Moves one value by NUDGE across its axis, or along it."""

    def moved(j: int, name: str, x: Array, axis: Array) -> Array:
        if (j, name) != (boundary, what):
            return x
        return x + NUDGE * (across(axis, way) if way < 2 else unit(axis))

    return moved


def _through(scenes: list[Any], boundaries: tuple[Boundary, ...], o: Array, d: Array, spawned: bool) -> Array:
    """Places and directions behind the boundaries, 2 × B × 3 (× N); one kernel where there are any."""
    import mitsuba as mi

    ray, places, directions = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)), [], []
    asked = mi.BSDFContext()
    for scene, boundary in zip(scenes, boundaries, strict=True):
        si = scene.ray_intersect(ray)
        met = si.is_valid()
        if met is False:  # a scalar variant has no BSDF to ask then, and ends the process
            return np.full((2, len(boundaries), 3), np.nan)
        asked.component = int(boundary.k is not None)  # of both plugins: 0 reflects, 1 transmits
        onward = si.to_world(si.bsdf().sample(asked, si, 0.5, [0.5, 0.5])[0].wo)
        onward = dr.select(met, onward, dr.nan)
        places.append(si.p)
        directions.append(onward)
        ray = si.spawn_ray(onward) if spawned else mi.Ray3f(dr.fma(STEP, onward, si.p), onward)
        ray.o.z -= boundary.thickness
    dr.eval(places, directions)
    return np.array([[np.array(x, np.longdouble) for x in vectors] for vectors in (places, directions)])
