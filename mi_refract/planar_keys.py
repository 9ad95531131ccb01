"""What a planar scene file may hold: one table of kinds and keys, and what is built of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from . import keys, shapes
from .curves import Curve, unit
from .keys import Key, Kind, Values
from .planar import Array

Indices = tuple[float, ...]  # one per colour


class Part(NamedTuple):
    """A curve between two media."""

    curve: Curve
    left: Indices
    right: Indices


SCENE = {
    "title": Key(keys.TEXT, "what the picture is called; the file's name by default", None),
    "index": Key(keys.INDEX, "of the medium around everything", [1.0]),
    "colours": Key(keys.TEXTS, "one for each wavelength, as matplotlib calls them; lists of indices are as long", None),
    "max_depth": Key(keys.whole(1, 100_000), "the most boundaries that a ray meets", 16),
    "branches": Key(keys.whole(0, 8), "the most partial reflections on a path; 0: refracted wherever possible", 0),
    "view": Key(keys.BOX, "what the picture shows; all shapes by default", None),
    "shape": Key(keys.TABLES, "[[shape]]: boundaries between media"),
    "beam": Key(keys.TABLES, "[[beam]]: rays to follow"),
}
PLACE = {
    "scale": Key(keys.SCALE, "stretches the shape, first of all", 1.0),
    "rotate": Key(keys.NUMBER, "then turns it counter-clockwise, in degrees", 0.0),
    "at": Key(keys.POINT, "then moves its origin there", [0.0, 0.0]),
}
FACETS = {"facets": Key(keys.whole(1, 1_000_000), "so many chords in place of all arcs of a curve", None)}
OUTSIDE = {
    "outside": Key(keys.INDEX, "index around the shape; that of the whole scene by default", None),
    "within": Key(keys.TEXT, "or the name of a shape above that it lies in", None),
}
SOLID = {"n": Key(keys.INDEX, "index inside"), "name": Key(keys.TEXT, "for `within`", None)} | OUTSIDE
THICKNESS = Key(keys.POSITIVE, "on the axis")


def _solid(build: Callable[[Values], Curve]) -> Callable[[Values], list[Part]]:
    return lambda v: [Part(build(v), v["n"], v["outside"])]


def _lens(v: Values) -> Curve:
    options = {name: v[name] for name in ("radius", "conic", "vertex")}
    return shapes.lens(v["curvature"], v["thickness"], **options)


def _ellipse_lens(v: Values) -> Curve:
    return shapes.ellipse_lens(v["n"][0] / v["outside"][0], v["focal_length"], v["thickness"], v["radius"])


def _luneburg(v: Values) -> list[Part]:
    layers = shapes.luneburg(v["radius"], v["layers"])
    media = [v["outside"], *(tuple(n * ratio for n in v["outside"]) for _, ratio in layers)]
    return [Part(c, inner, outer) for (c, _), (outer, inner) in zip(layers, itertools.pairwise(media), strict=True)]


def _arcs(pieces: str) -> Key:
    return Key(keys.NUMBERS, f"degrees by which {pieces} turns left, an arc of a circle; 0: straight", None)


SHAPES = {
    "polygon": Kind(
        "a closed chain of straight pieces and arcs of circles",
        {"points": Key(keys.POINTS, "its corners"), "arcs": _arcs("each piece, the last one to the first corner,")}
        | SOLID | PLACE | FACETS,
        _solid(lambda v: shapes.polygon(v["points"], v["arcs"])),
    ),
    "rectangle": Kind(
        "around its origin",
        {"width": Key(keys.POSITIVE, "along x"), "height": Key(keys.POSITIVE, "along y")} | SOLID | PLACE,
        _solid(lambda v: shapes.rectangle(v["width"], v["height"])),
    ),
    "prism": Kind(
        "a triangle with two equal sides, its apex up, its centroid at the origin",
        {"side": Key(keys.POSITIVE, "length of either side"), "apex": Key(keys.APEX, "the angle between them", 60.0)}
        | SOLID | PLACE,
        _solid(lambda v: shapes.prism(v["apex"], v["side"])),
    ),
    "circle": Kind(
        "around its origin",
        {"radius": Key(keys.POSITIVE, "from its origin")} | SOLID | PLACE | FACETS,
        _solid(lambda v: shapes.circle(v["radius"])),
    ),
    "ellipse": Kind(
        "around its origin",
        {"radii": Key(keys.POSITIVES, "half axes along x and y")}
        | SOLID | PLACE | FACETS,
        _solid(lambda v: shapes.ellipse(*v["radii"])),
    ),
    "lens": Kind(
        "two conic surfaces z = c r² / (1 + √(1 − (1 + K) c² r²)) on the x axis, with a rim between them",
        {
            "curvature": Key(keys.PAIR, "c of the front and of the back, positive where the centre lies toward +x"),
            "conic": Key(keys.PAIR, "K of each", [0.0, 0.0]),
            "thickness": THICKNESS,
            "radius": Key(keys.POSITIVE, "half the aperture; up to where the surfaces meet by default", None),
            "vertex": Key(keys.NUMBER, "where the front meets the axis", 0.0),
        } | SOLID | PLACE | FACETS,
        _solid(_lens),
    ),
    "ellipse_lens": Kind(
        "focuses rays along x into its origin: an ellipse of eccentricity outside/n (first colour), and a circle",
        {
            "focal_length": Key(keys.POSITIVE, "from the front to the focus"),
            "thickness": THICKNESS,
            "radius": Key(keys.POSITIVE, "half the aperture"),
        } | SOLID | PLACE | FACETS,
        _solid(_ellipse_lens),
    ),
    "luneburg": Kind(
        "a ball in concentric layers of index outside × √(2 − (r/radius)²)",
        {"radius": Key(keys.POSITIVE, "of the outermost"), "layers": Key(keys.whole(1, 10_000), "how many")}
        | OUTSIDE | PLACE | FACETS,
        _luneburg,
    ),
    "boundary": Kind(
        "an open chain of straight pieces and arcs of circles between two media",
        {
            "points": Key(keys.POINTS, "its vertices"),
            "arcs": _arcs("each piece"),
            "n_left": Key(keys.INDEX, "index on the left, seen along it"),
            "n_right": Key(keys.INDEX, "index on the right"),
        } | PLACE | FACETS,
        lambda v: [Part(shapes.polyline(v["points"], v["arcs"]), v["n_left"], v["n_right"])],
    ),
}  # fmt: skip


def _spread(first: Any, last: Any, count: int) -> Array:
    """Evenly from the first to the last; one is in the middle. What falls on whole numbers is exact."""
    if count == 1:
        return np.array([(first + last) / 2])
    steps = np.arange(count).reshape(-1, *[1] * np.ndim(first))
    return np.concatenate([(first + (last - first) * steps / (count - 1))[:-1], [last]])


def _parallel(v: Values) -> tuple[Array, Array]:
    origins = _spread(np.array(v["from"]), np.array(v["to"]), v["count"])
    return origins, np.broadcast_to(v["direction"], origins.shape)


def _fan(v: Values) -> tuple[Array, Array]:
    first, last = v["angles"]
    angles = _spread(first, last, v["count"])
    return np.broadcast_to(v["at"], (v["count"], 2)), np.array([unit(angle) for angle in angles])


def _rays(v: Values) -> tuple[Array, Array]:
    if len(v["origins"]) != len(v["directions"]):
        raise ValueError(f"directions: {len(v['directions'])}, for {len(v['origins'])} origins; accepted: as many")
    return np.array(v["origins"]), np.array(v["directions"])


BEAMS = {
    "parallel": Kind(
        "parallel rays from a line",
        {
            "from": Key(keys.POINT, "where the first one starts"),
            "to": Key(keys.POINT, "where the last one does"),
            "direction": Key(keys.DIRECTION, "of all"),
            "count": Key(keys.RAYS, "how many; 1: from the middle"),
        },
        _parallel,
    ),
    "fan": Kind(
        "rays from a point",
        {
            "at": Key(keys.POINT, "the point"),
            "angles": Key(keys.PAIR, "of the first and of the last one, in degrees"),
            "count": Key(keys.RAYS, "how many; 1: in the middle"),
        },
        _fan,
    ),
    "rays": Kind(
        "one by one",
        {"origins": Key(keys.POINTS, "where they start"), "directions": Key(keys.DIRECTIONS, "as many")},
        _rays,
    ),
}


def reference() -> str:
    """All kinds and keys as tables in Markdown, for the README."""
    shared = SOLID | PLACE | FACETS
    parts = [keys.key_table("key of the scene", SCENE), keys.key_table("key of a shape", shared)]
    parts += [keys.kind_table("kind of shape", SHAPES, shared), keys.kind_table("kind of beam", BEAMS, {})]
    return "\n\n".join(parts)
