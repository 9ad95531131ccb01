"""The systems with a known answer: slab, prism, aplanatic ball, ellipsoid lens, drop and double Gauss.

Lengths are in mm, of the order of 100; bodies are of BK7 in air unless stated otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from validation.reference import closed_forms, optical_systems
from validation.reference.optical_systems import ASKEW, BK7, Array, degrees, dot, unit, vectors
from validation.run.context import SCENES

from .traced_system import Answers, Ball, Bench, Boundary, Path, Plane

APEX = closed_forms.HALF_TURN / 3
SIDE = 60  # of the prism's section
RADIUS = 50.0
BUBBLE = 5.0
WATER = np.longdouble(1.333)


def glass(plugin: str, inside: Any, outside: Any = 1.0) -> dict[str, Any]:
    """Mitsuba's dictionary of a glass by its two indices."""
    return {"type": plugin, "int_ior": float(inside), "ext_ior": float(outside)}


def placed(scale: Any = 1.0) -> Any:
    """Mitsuba's transform of a shape: stretched along the axes, then turned by ASKEW."""
    import mitsuba as mi

    matrix = np.eye(4)
    matrix[:3, :3] = ASKEW.T * np.asarray(scale, float)
    return mi.ScalarTransform4f(matrix.tolist())


def _as_angle(chord: Array) -> Answers:
    """A small difference of unit directions (N × 3)."""
    return {"direction / °": np.rad2deg(chord)[:, None]}


def _miss(path: Path, focus: Array) -> Answers:
    """From the last line to a point."""
    to, b = focus - path.places[-1], path.directions[-1]
    return {"miss / mm": (to - dot(to, b) * b)[:, None]}


# Plane faces ---------------------------------------------------------------------------------------------------


def slab() -> Bench:
    """A block 50 mm thick, rays at 1 … 85°: moved aside by 50 mm sin(i − r)/cos r, their direction restored."""
    thickness, inward = 50, vectors([0], 0, 1)
    i = degrees(1, 85)
    a = vectors(np.sin(i), 0, np.cos(i))
    shift = thickness * closed_forms.lateral_shift(i, BK7)[:, None] * unit(inward - dot(inward, a) * a)
    origins = vectors([-25], 3, -thickness / 2) - 20 * a

    def off(path: Path) -> Answers:
        w = path.places[-1] - origins
        return {"shift / mm": (w - dot(w, a) * a - shift)[:, None]} | _as_angle(path.directions[-1] - a)

    def scenes(plugin: str) -> list[dict[str, Any]]:
        return [{"block": {"type": "cube", "to_world": placed([60, 60, thickness / 2]), "bsdf": glass(plugin, BK7)}}]

    faces = ((-thickness / 2, 1 / BK7), (thickness / 2, BK7))
    boundaries = tuple(Boundary(Plane(vectors([0], 0, z), inward), k, 90) for z, k in faces)
    return Bench(origins, a, boundaries, scenes, off)


def prism(i: Array, down: Any) -> Bench:
    """The prism of scenes/prism.xml, A = 60°: deviates by i + asin(n sin(A − r)) − A.

    Rays at incidences `i` onto the left side, `down` it from the apex by that share.
    """
    half, height = APEX / 2, SIDE * np.cos(APEX / 2)
    apex = vectors([0], 2 * height / 3, 0)
    normals = [vectors([0], np.sin(half), side * np.cos(half)) for side in (-1, 1)]
    angle = i - half
    a, after = (vectors(0 * i, np.sin(x), np.cos(x)) for x in (angle, angle - closed_forms.deviation(i, APEX, BK7)))
    place = apex + vectors([11], 0, 0) - np.reshape(down, (-1, 1)) * vectors([0], height, SIDE / 2)

    def scenes(plugin: str) -> list[dict[str, Any]]:
        file = {"type": "ply", "filename": str(SCENES / "meshes" / "prism.ply"), "face_normals": True}
        return [{"prism": {**file, "to_world": placed(), "bsdf": glass(plugin, BK7)}}]

    boundaries = tuple(Boundary(Plane(apex, n), k, 60) for n, k in zip(normals, (1 / BK7, BK7), strict=True))
    return Bench(place - 40 * a, a, boundaries, scenes, lambda path: _as_angle(path.directions[-1] - after))


def least_deviated() -> Bench:
    """The prism of scenes/prism.xml at least deviation, 2 asin(n sin(A/2)) − A, anywhere on its side."""
    down = np.linspace(0.3, 0.6, optical_systems.RAYS)
    return prism(closed_forms.least_deviated(APEX, BK7) + 0 * down.astype(np.longdouble), down)


def deviated() -> Bench:
    """The same at incidences of 32 … 85°: i + asin(n sin(A − r)) − A."""
    return prism(degrees(32, 85), 0.4)


# Balls ---------------------------------------------------------------------------------------------------------


def aplanatic() -> Bench:
    """A ball of radius R = 50 mm: rays that aim at n R behind its centre all meet R/n behind it."""
    angle, around = degrees(100, 179), degrees(0, 3000)
    towards = angle - closed_forms.refracted(angle, BK7)  # the angle at the centre; the sines are as R to R/n
    radius = np.sin(towards)
    p = RADIUS * vectors(radius * np.cos(around), radius * np.sin(around), np.cos(towards))
    a = unit(RADIUS * vectors([0], 0, BK7) - p)
    ball = Boundary(Ball(vectors([0], 0, 0), RADIUS * vectors([1], 1, 1)), 1 / BK7, RADIUS)

    def scenes(plugin: str) -> list[dict[str, Any]]:
        return [{"ball": {"type": "sphere", "radius": RADIUS, "bsdf": glass(plugin, BK7)}}]

    return Bench(p - 60 * a, a, (ball,), scenes, lambda path: _miss(path, RADIUS * vectors([0], 0, 1 / BK7)))


def ellipsoid() -> Bench:
    """A lens with an ellipsoid of eccentricity 1/n before, half axis 50 mm, and a sphere around its far focus behind:
    rays along the axis, to 80° of eccentric anomaly, all meet there."""
    e, anomaly, around = 1 / BK7, degrees(1, 80), degrees(0, 3000)
    minor = np.sqrt((1 - e) * (1 + e))
    axes, focus = RADIUS * vectors([minor], minor, 1), RADIUS * vectors([0], 0, e)
    place = axes * vectors(np.sin(anomaly) * np.cos(around), np.sin(anomaly) * np.sin(around), -np.cos(anomaly))
    boundaries = (
        Boundary(Ball(vectors([0], 0, 0), axes), 1 / BK7, RADIUS),
        Boundary(Ball(focus, BUBBLE * vectors([1], 1, 1)), BK7, RADIUS),
    )

    def scenes(plugin: str) -> list[dict[str, Any]]:
        ball = {"type": "sphere", "bsdf": glass(plugin, BK7)}
        centre = (focus[0] @ ASKEW).astype(float).tolist()
        bubble = {"type": "sphere", "center": centre, "radius": BUBBLE, "bsdf": glass(plugin, 1, BK7)}
        stretched = {"type": "instance", "group": {"type": "ref", "id": "ball"}, "to_world": placed(axes[0])}
        return [{"ball": {"type": "shapegroup", "shape": ball}, "front": stretched, "bubble": bubble}]

    along = np.broadcast_to(vectors([0], 0, 1), place.shape)
    return Bench(place - 40 * along, along, boundaries, scenes, lambda path: _miss(path, focus))


def drop(order: int) -> Bench:
    """A drop with `order` reflections inside."""
    i = degrees(2, 80)
    a, p, d = vectors(0 * i, 0, 1), RADIUS * vectors(np.sin(i), 0, -np.cos(i)), closed_forms.deflection(i, WATER, order)
    near, far = (Ball(vectors([0], 0, 0), RADIUS * vectors([1], 1, 1), far=x) for x in (False, True))
    surfaces = [(near, 1 / WATER), *[(far, None)] * order, (far, WATER)]
    boundaries = tuple(Boundary(surface, k, RADIUS) for surface, k in surfaces)

    def scenes(plugin: str) -> list[dict[str, Any]]:
        return [{"drop": {"type": "sphere", "radius": RADIUS, "bsdf": glass(plugin, WATER)}}]

    after = vectors(-np.sin(d), 0, np.cos(d))
    return Bench(p - 40 * a, a, boundaries, scenes, lambda path: _as_angle(path.directions[-1] - after))


def reflected_once() -> Bench:
    """A drop of index 1.333, R = 50 mm, rays at 2 … 80°, one reflection within: deflected by π + 2i − 4r."""
    return drop(1)


def reflected_twice() -> Bench:
    """The same with two reflections: 2π + 2i − 6r."""
    return drop(2)


# The double Gauss ----------------------------------------------------------------------------------------------


def double_gauss() -> Bench:
    """CODE V's double Gauss: places and tangents of nine rays at its eleven surfaces, as it prints them.

    Each surface is a whole sphere, or a rectangle, in a scene of its own whose origin is the vertex.
    """
    rows, before = optical_systems.double_gauss_data()["prescription"], [1.0]
    before += [index for _, _, index in rows[:-1]]
    surfaces = [(c, t, n_from, n_to) for (c, t, n_to), n_from in zip(rows, before, strict=True)]
    first, a = optical_systems.printed_rays()
    places, tangents = (np.asarray(x, np.longdouble).swapaxes(0, 1) for x in optical_systems.printed())

    def off(path: Path) -> Answers:
        p, b = (x.swapaxes(0, 1) for x in (path.places, path.directions))
        return {"place / mm": p - places, "tangent": b[..., :2] / b[..., 2:] - tangents}

    def scenes(plugin: str) -> list[dict[str, Any]]:
        return [{"surface": _surface(plugin, c, n_from, n_to)} for c, _, n_from, n_to in surfaces]

    boundaries = tuple(_boundary(*surface) for surface in surfaces)
    rounding = {"place / mm": np.sqrt(3) * optical_systems.POSITION, "tangent": np.sqrt(2) * optical_systems.TANGENT}
    return Bench(first - 20 * a, a, boundaries, scenes, off, turn=np.eye(3, dtype=np.longdouble), printed=rounding)


def _boundary(c: float, thickness: float, n_from: float, n_to: float) -> Boundary:
    surface: Plane | Ball = Plane(vectors([0], 0, 0), vectors([0], 0, 1))
    if c:
        radius = 1 / np.longdouble(c)
        surface = Ball(vectors([0], 0, radius), np.abs(radius) * vectors([1], 1, 1), far=c < 0)
    return Boundary(surface, np.longdouble(n_from) / n_to, 2 / abs(c) if c else 60, thickness)


def _surface(plugin: str, c: float, n_from: float, n_to: float) -> dict[str, Any]:
    """The side to which its normal points is the outside: of a sphere that bulges towards the light, the light's."""
    import mitsuba as mi

    if not c:
        return {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(40), "bsdf": glass(plugin, n_from, n_to)}
    inside, outside = (n_to, n_from) if c > 0 else (n_from, n_to)
    return {"type": "sphere", "center": [0, 0, 1 / c], "radius": 1 / abs(c), "bsdf": glass(plugin, inside, outside)}


BENCHES: dict[str, Callable[[], Bench]] = {
    "slab": slab,
    "prism, least deviation": least_deviated,
    "prism, 32 … 85°": deviated,
    "aplanatic ball": aplanatic,
    "ellipsoid lens": ellipsoid,
    "drop, one reflection": reflected_once,
    "drop, two reflections": reflected_twice,
    "double Gauss": double_gauss,
}
