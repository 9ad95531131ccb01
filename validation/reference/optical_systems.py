"""Optical systems with closed-form answers: rays, their boundaries, and the difference between a path and the answer.

Each system has three tracers: Snell's law in extended precision, which can perturb every value on the way; a formula
that refracts at each boundary; and Mitsuba (`validation/ground_truth/bench.py`). Positions and closed forms are in
extended precision: they are geometry, not refraction. Lengths are in mm, of the order of 100; bodies are of BK7 in air
unless stated otherwise. Formulas and Mitsuba get a system rotated by ASKEW, so that no axis is special.

Closed forms: `closed_forms`, and Born and Wolf, Principles of Optics, 4.2.3 (aplanatic points); Descartes, La
Dioptrique, 1637 (ellipsoid).
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path as File
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import closed_forms

Array = NDArray[Any]
Refract = Callable[[Array, Array, Any], Array]  # (a, n, k) → b; a, n, b: N × 3, k = n_from/n_to
Answers = dict[str, Array]  # by name, N × A × components; directions in radians
Moved = Callable[[int, str, Any, Any], Any]  # index of the boundary, name of the value, value, its axis → value

RAYS = 32
BK7 = np.longdouble(1.5168)  # a crown glass
WATER = np.longdouble(1.333)
SIDE, RADIUS, BUBBLE, THICKNESS = 60, 50.0, 5.0, 50  # sizes of the prism's section, balls, the small ball, the slab
PRINT = File(__file__).with_name("double_gauss_codev.json")
# Rounding of the printed numbers: see "digits" in the file.
TANGENT, POSITION = 5e-7, 2.3e-6
FIELDS = {0.0: 0.0, 0.176327: 10.0, 0.249328: 14.0}  # printed tangent: degrees
NUDGE = 1e-8  # perturbation of a value: mm, radians, or share of an index


# Vectors -------------------------------------------------------------------------------------------------------


def dot(x: Array, y: Array) -> Array:
    """Return the dot product of vectors (… × 3), as … × 1."""
    return np.asarray((x * y).sum(-1, keepdims=True))


def length(x: Array) -> Array:
    """Return the length of vectors (… × 3), as … × 1."""
    return np.sqrt(dot(x, x))


def unit(x: Array) -> Array:
    """Return vectors (… × 3), normalised."""
    return x / length(x)


def vectors(*components: Any) -> Array:
    """Return three components of any shapes as (N, 3) in extended precision."""
    return np.stack(np.broadcast_arrays(*(np.atleast_1d(np.asarray(x, np.longdouble)) for x in components)), axis=-1)


def degrees(first: float, last: float, count: int = RAYS) -> Array:
    """Return `count` angles from `first` to `last` degrees, in radians and extended precision."""
    return np.deg2rad(np.linspace(first, last, count).astype(np.longdouble))


def snell(a: Array, n: Array, k: Any) -> Array:
    """Return the refracted directions by the law's well-conditioned form; NaN for total internal reflection."""
    k = np.asarray(k, np.longdouble).reshape(-1, 1)
    c, w = dot(n, a), np.cross(n, a)
    root = np.copysign(np.sqrt(c * c - (k - 1) * (k + 1) * dot(w, w)), c)
    return np.asarray((k * np.cross(w, n) + root * n) / dot(n, n))


def across(x: Array, way: int) -> Array:
    """Return one of two unit vectors that are perpendicular to each vector and to each other."""
    smallest = np.eye(3, dtype=np.longdouble)[np.abs(x).argmin(axis=1)]
    aside = unit(np.cross(x, smallest))
    return np.cross(unit(x), aside) if way else aside


_X, _Y = unit(vectors(3, 1, 2)), unit(vectors(-1, 1, 1))
ASKEW = np.concatenate([_X, _Y, np.cross(_X, _Y)])


# Boundaries and systems ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plane:
    """A plane through `point` with a unit `normal` (1 × 3, or one for each ray)."""

    point: Array
    normal: Array
    bend = 0.0

    def meet(self, p: Array, d: Array) -> tuple[Array, Array]:
        """Return where rays from `p` along `d` (N × 3) hit the plane, and the unit normals there."""
        return p + d * (dot(self.normal, self.point - p) / dot(self.normal, d)), np.broadcast_to(self.normal, p.shape)


@dataclass(frozen=True)
class Ball:
    """An ellipsoid along the axes, or a sphere; `far`: hit from inside."""

    centre: Array
    axes: Array
    far: bool = False

    @property
    def bend(self) -> float:
        """The largest rotation of the normal in radians per mm."""
        return float(self.axes.max() / self.axes.min() ** 2)

    def meet(self, p: Array, d: Array) -> tuple[Array, Array]:
        """Return where rays from `p` along `d` (N × 3) hit it, and the unit normals there; NaN without a hit."""
        q, e = (p - self.centre) / self.axes, d / self.axes
        b, square = dot(q, e), dot(e, e)
        with np.errstate(invalid="ignore"):
            root = np.sqrt(b * b - square * (dot(q, q) - 1))
        p = p + d * ((root if self.far else -root) - b) / square
        return p, unit((p - self.centre) / self.axes**2)


@dataclass(frozen=True)
class Boundary:
    """A boundary. `k` = n_from/n_to, for all rays or for each; None: reflection. `size`: extent from the origin, mm.

    Behind it, the origin of coordinates is `thickness` further along z.
    """

    surface: Plane | Ball
    k: Any
    size: float = 0.0
    thickness: float = 0.0


@dataclass(frozen=True)
class Path:
    """N rays at B boundaries: their positions, and their unit directions behind each boundary, B × N × 3."""

    places: Array
    directions: Array


@dataclass(frozen=True)
class System:
    """Rays (N × 3, extended precision) and the boundaries that they meet one after the other.

    `off(path)`: the difference between path and closed form, by answer. `printed`: the rounding error of the closed
    form's own numbers, by answer. `turn`: the rotation for formulas and Mitsuba.
    """

    origins: Array
    directions: Array
    boundaries: tuple[Boundary, ...]
    off: Callable[[Path], Answers]
    turn: Array = field(default_factory=lambda: ASKEW)
    printed: dict[str, float] = field(default_factory=dict)

    def walk(
        self, refract: Refract = snell, moved: Moved = lambda j, what, x, axis: x
    ) -> Iterator[tuple[Array, Array, Array, Array, Array]]:
        """Yield at each boundary: previous position, position, normal, directions before and behind.

        `moved` may perturb the values "into", "normal", "index", "onward" and "place" of each boundary; −1: the start.
        """
        b = moved(-1, "onward", self.directions, self.directions)
        p = moved(-1, "place", self.origins, b)
        for j, boundary in enumerate(self.boundaries):
            start, (p, n) = p, boundary.surface.meet(p, b)
            a, normal = moved(j, "into", b, b), moved(j, "normal", n, n)
            if boundary.k is None:
                b = a - 2 * dot(normal, a) * normal
            else:
                b = refract(a, normal, moved(j, "index", boundary.k, None))
            b = moved(j, "onward", b, b)
            p = moved(j, "place", p, b)
            yield start, p, n, a, b
            p = p - vectors(0, 0, boundary.thickness)

    def steps(self) -> Generator[tuple[Array, Array, Array], Array, Path]:
        """Yield a, n and k at each refraction, receive b, and return the path."""
        p, b = self.origins, self.directions
        places, directions = [], []
        for boundary in self.boundaries:
            p, n = boundary.surface.meet(p, b)
            b = b - 2 * dot(n, b) * n if boundary.k is None else unit((yield b, n, np.asarray(boundary.k)))
            places.append(p)
            directions.append(b)
            p = p - vectors(0, 0, boundary.thickness)
        return Path(np.array(places), np.array(directions))

    def path(self, refract: Refract = snell, moved: Moved = lambda j, what, x, axis: x) -> Path:
        """Return the path by Snell's law in extended precision, or by a formula, in the system's coordinates."""
        steps = list(self.walk(refract, moved))
        return Path(np.array([p for _, p, _, _, _ in steps]), np.array([unit(b) for _, _, _, _, b in steps]))

    def errors(self, refract: Refract, moved: Moved = lambda j, what, x, axis: x) -> Array:
        """Return the errors of all answers (N × m) of a formula, which gets rotated vectors, against the exact path."""

        def rotated(a: Array, n: Array, k: Any) -> Array:
            return refract(a @ self.turn, n @ self.turn, k) @ self.turn.T

        answers, exact = (self.off(path) for path in (self.path(rotated, moved), self.path()))
        return np.concatenate([(answers[name] - x).reshape(len(x), -1) for name, x in exact.items()], axis=1)

    @functools.cached_property
    def condition(self) -> Array:
        """The first-order error of the answer in u, (N,), if the first a and every n, k and b err by u."""
        return self.condition_of(lambda moved: self.errors(snell, moved))

    def condition_of(self, changes: Callable[[Moved], Array]) -> Array:
        """Return the first-order change in u, (N,), if the first a and every n, k and b err by u.

        It is the sum of the norms of all derivatives: `changes(moved)` returns the changes (N × m) of the exact path.
        a, n and b are perturbed perpendicular to themselves, because their lengths do not matter.
        """
        total: Array = np.zeros(1, np.longdouble)
        for j, boundary in enumerate(self.boundaries):
            for what in (*["into"] * (j == 0), "normal", "index", "onward") if boundary.k is not None else ():
                moved = [changes(nudged(j, what, way)) for way in range(1 if what == "index" else 2)]
                total = total + np.sqrt(sum((x**2).sum(1) for x in moved)) / NUDGE
        return total


def nudged(boundary: int, what: str, way: int) -> Moved:
    """Return a function that perturbs one value by NUDGE: an index relatively, a vector across (0, 1) or along (2)."""

    def moved(j: int, name: str, x: Any, axis: Any) -> Any:
        if (j, name) != (boundary, what):
            return x
        return x * (1 + NUDGE) if what == "index" else x + NUDGE * (across(axis, way) if way < 2 else unit(axis))

    return moved


def _direction(after: Array) -> Callable[[Path], Answers]:
    return lambda path: {"direction": (path.directions[-1] - after)[:, None]}


# Plane faces ---------------------------------------------------------------------------------------------------


def slab(last: float = 89) -> System:
    """A plane-parallel plate: it shifts rays by its thickness × sin(i − r)/cos r and keeps directions; 1 … 89°."""
    inward, i = vectors(0, 0, 1), degrees(1, last)
    a = vectors(np.sin(i), 0, np.cos(i))
    shift = THICKNESS * closed_forms.lateral_shift(i, BK7)[:, None] * unit(inward - dot(inward, a) * a)
    origins = vectors(-25, 3, -THICKNESS / 2) - 20 * a

    def off(path: Path) -> Answers:
        w = path.places[-1] - origins
        return {"shift": (w - dot(w, a) * a - shift)[:, None], "direction": (path.directions[-1] - a)[:, None]}

    faces = ((-THICKNESS / 2, 1 / BK7), (THICKNESS / 2, BK7))
    return System(origins, a, tuple(Boundary(Plane(vectors(0, 0, z), inward), k, 90) for z, k in faces), off)


def round_trip() -> System:
    """Into a denser medium and out of it through a parallel face: the final direction is the first.

    Rays at 1 … 89.9°, each with its own index between 1.0001 and 4.
    """
    i, index = degrees(1, 89.9), 1 + np.geomspace(1e-4, 3, 7)[np.arange(RAYS) % 7].astype(np.longdouble)
    a = vectors(np.sin(i), 0, np.cos(i))
    faces = ((0, 1 / index), (1, index))
    boundaries = tuple(Boundary(Plane(vectors(0, 0, z), vectors(0, 0, 1)), k) for z, k in faces)
    return System(-a, a, boundaries, _direction(a))


def prism(apex: Any, i: Array, down: Any = 0.4, index: Any = BK7) -> System:
    """A prism, which deviates by i + asin(n sin(A − r)) − A; rays hit its left side at the share `down`."""
    half = apex / 2
    height, angle = SIDE * np.cos(half), i - half
    top = vectors(0, 2 * height / 3, 0)
    normals = [vectors(0, np.sin(half), side * np.cos(half)) for side in (-1, 1)]
    a, after = (vectors(0, np.sin(x), np.cos(x)) for x in (angle, angle - closed_forms.deviation(i, apex, index)))
    place = top + vectors(11, 0, 0) - np.reshape(down, (-1, 1)) * vectors(0, height, SIDE * np.sin(half))
    boundaries = tuple(Boundary(Plane(top, n), k, 60) for n, k in zip(normals, (1 / index, index), strict=True))
    return System(place - 40 * a, a, boundaries, _direction(after))


def least_deviated() -> System:
    """Prisms of 10 … 80° at minimum deviation, 2 asin(n sin(A/2)) − A."""
    apex = 2 * degrees(5, 40)
    return prism(apex, closed_forms.least_deviated(apex, BK7))


# Balls ---------------------------------------------------------------------------------------------------------


def ball(far: bool = False) -> Ball:
    """A ball around the origin."""
    return Ball(vectors(0, 0, 0), RADIUS * vectors(1, 1, 1), far)


def _miss(path: Path, focus: Array) -> Answers:
    """Return the vector from the last line to a point."""
    to, b = focus - path.places[-1], path.directions[-1]
    return {"miss": (to - dot(to, b) * b)[:, None]}


def aplanatic() -> System:
    """A ball of radius R: all rays aimed at the point n R behind its centre meet at R/n behind it."""
    angle, around = degrees(100, 179), degrees(0, 3000)
    towards = angle - closed_forms.refracted(angle, BK7)  # the angle at the centre; the ratio of the sines is n
    radius = np.sin(towards)
    p = RADIUS * vectors(radius * np.cos(around), radius * np.sin(around), np.cos(towards))
    a = unit(RADIUS * vectors(0, 0, BK7) - p)
    boundaries = (Boundary(ball(), 1 / BK7, RADIUS),)
    return System(p - 60 * a, a, boundaries, lambda path: _miss(path, RADIUS * vectors(0, 0, 1 / BK7)))


def weierstrass() -> System:
    """A ball's aplanatic points: all rays from R/n inside leave as if from n R; 91 … 179° to the axis."""
    angle, around = degrees(91, 179), degrees(0, 3000)
    towards = angle - closed_forms.refracted(angle, BK7)
    radius = np.sin(towards)
    p = RADIUS * vectors(radius * np.cos(around), radius * np.sin(around), np.cos(towards))
    start = np.broadcast_to(RADIUS * vectors(0, 0, 1 / BK7), p.shape)
    after = unit(p - RADIUS * vectors(0, 0, BK7))
    return System(start, unit(p - start), (Boundary(ball(far=True), BK7, RADIUS),), _direction(after))


def ellipsoid(last: float = 89) -> System:
    """An ellipsoid of eccentricity 1/n, and a sphere around its far focus, where all rays along the axis meet.

    Up to 89° of eccentric anomaly.
    """
    e, anomaly, around = 1 / BK7, degrees(1, last), degrees(0, 3000)
    minor = np.sqrt((1 - e) * (1 + e))
    axes, focus = RADIUS * vectors(minor, minor, 1), RADIUS * vectors(0, 0, e)
    place = axes * vectors(np.sin(anomaly) * np.cos(around), np.sin(anomaly) * np.sin(around), -np.cos(anomaly))
    boundaries = (
        Boundary(Ball(vectors(0, 0, 0), axes), 1 / BK7, RADIUS),
        Boundary(Ball(focus, BUBBLE * vectors(1, 1, 1)), BK7, RADIUS),
    )
    a = np.broadcast_to(vectors(0, 0, 1), place.shape)
    return System(place - 40 * a, a, boundaries, lambda path: _miss(path, focus))


def drop(order: int, i: Array, index: Any = WATER) -> System:
    """A drop with `order` inner reflections and rays at incidences `i`, deflected by mπ + 2i − 2(m + 1) r."""
    a, p, d = vectors(0 * i, 0, 1), RADIUS * vectors(np.sin(i), 0, -np.cos(i)), closed_forms.deflection(i, index, order)
    surfaces = [(ball(), 1 / index), *[(ball(far=True), None)] * order, (ball(far=True), index)]
    boundaries = tuple(Boundary(surface, k, RADIUS) for surface, k in surfaces)
    return System(p - 40 * a, a, boundaries, _direction(vectors(-np.sin(d), 0, np.cos(d))))


def rainbow(order: int) -> System:
    """The rainbow of a drop of water: rays at the stationary D = mπ + 2i − 2(m + 1) r, from red to violet."""
    index = np.linspace(1.331, 1.344, RAYS).astype(np.longdouble)
    return drop(order, closed_forms.rainbow_incidence(index, order), index)


# The double Gauss ----------------------------------------------------------------------------------------------


@functools.cache
def double_gauss_data() -> dict[str, Any]:
    """Return a double Gauss and nine rays through it, as CODE V prints them; lengths in mm."""
    data: dict[str, Any] = json.loads(PRINT.read_text())
    return data


def double_gauss(prescription: Any = None) -> System:
    """CODE V's double Gauss: the printed positions and tangents of nine rays at its eleven surfaces.

    The vertex of each surface is an origin.
    """
    rays = double_gauss_data()["rays"]
    angle = np.deg2rad(np.array([FIELDS[ray["object"][4]] for ray in rays], np.longdouble))
    a = vectors(0, np.sin(angle), np.cos(angle))
    numbers = np.array([ray["surfaces"] for ray in rays], np.longdouble)  # rays × surfaces × 5
    boundaries, before = [], 1.0
    for c, thickness, after in prescription or double_gauss_data()["prescription"]:
        surface: Plane | Ball = Plane(vectors(0, 0, 0), vectors(0, 0, 1))
        if c:
            radius = 1 / np.longdouble(c)
            surface = Ball(vectors(0, 0, radius), np.abs(radius) * vectors(1, 1, 1), far=c < 0)
        boundaries.append(Boundary(surface, np.longdouble(before) / after, 2 / abs(c) if c else 60, thickness))
        before = after

    def off(path: Path) -> Answers:
        p, b = (x.swapaxes(0, 1) for x in (path.places, path.directions))
        return {"place": p - numbers[..., :3], "tangent": b[..., :2] / b[..., 2:] - numbers[..., 3:5]}

    printed = {"place": np.sqrt(3) * POSITION, "tangent": np.sqrt(2) * TANGENT}
    upright = np.eye(3, dtype=np.longdouble)
    return System(numbers[:, 0, :3] - 20 * a, a, tuple(boundaries), off, upright, printed)


def off_print(refract: Refract, prescription: Any = None) -> float:
    """Return the largest deviation from the printed numbers, divided by their rounding: up to 1 they agree."""
    system = double_gauss(prescription)
    off = system.off(system.path(refract))
    return float(max(np.abs(off["place"]).max() / POSITION, np.abs(off["tangent"]).max() / TANGENT))


# The systems for formulas; Mitsuba has some others.
SYSTEMS: dict[str, Callable[[], System]] = {
    "slab": functools.cache(slab),
    "round trip": functools.cache(round_trip),
    "prism": functools.cache(least_deviated),
    "Weierstrass sphere": functools.cache(weierstrass),
    "ellipsoid lens": functools.cache(ellipsoid),
    "double Gauss": functools.cache(double_gauss),
}
SYSTEMS |= {f"rainbow of order {m}": functools.cache(functools.partial(rainbow, m)) for m in (1, 2, 3, 4)}
