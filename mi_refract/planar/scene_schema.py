"""What a planar scene file may hold: one table of kinds and keys, and how their curves and rays are built."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mi_refract.io.toml_schema import NUMBER, NUMBERS, POSITIVE, TABLES, TEXT, TEXTS, Key, Table, key_table, whole

from . import shapes
from .curves import Curve, unit
from .scene_values import (
    APEX,
    BOX,
    DIRECTION,
    DIRECTIONS,
    INDEX,
    PAIR,
    POINT,
    POINTS,
    POSITIVES,
    POWER,
    RAYS,
    SCALE,
    WAVELENGTHS,
    Indices,
    Kind,
    kind_table,
)
from .segments import Array


class Part(NamedTuple):
    """A curve between two media."""

    curve: Curve
    left: Indices
    right: Indices


SCENE = {
    "title": Key(TEXT, "title of the figure; the file's name by default", None),
    "index": Key(INDEX, "index of the medium around all shapes", [1.0]),
    "colours": Key(TEXTS, "one for each wavelength, by matplotlib's names; a list of indices must be as long", None),
    "wavelengths": Key(WAVELENGTHS, "in place of `colours`: so many evenly from 380 to 730 nm, or these", None),
    "light": Key(POWER, "the powers of the wavelengths: all the same, or those of daylight", "flat"),
    "max_depth": Key(whole(1, 100_000), "largest number of boundaries that a ray meets", 16),
    "branches": Key(whole(0, 8), "largest number of partial reflections on a path; 0: refracted wherever possible", 0),
    "view": Key(BOX, "the part that the figure shows; all shapes by default", None),
    "shape": Key(TABLES, "[[shape]]: boundaries between media"),
    "beam": Key(TABLES, "[[beam]]: rays to follow"),
}
PLACE = {
    "scale": Key(SCALE, "stretches the shape; done first", 1.0),
    "rotate": Key(NUMBER, "then turns it counter-clockwise, in degrees", 0.0),
    "at": Key(POINT, "then moves its origin there", [0.0, 0.0]),
}
FACETS = {"facets": Key(whole(1, 1_000_000), "number of chords that replace the arcs of a curve", None)}
OUTSIDE = {
    "outside": Key(INDEX, "index around the shape; that of the whole scene by default", None),
    "within": Key(TEXT, "instead of `outside`: the name of an earlier shape that this one lies in", None),
}
SOLID = {
    "n": Key(INDEX, "index inside"),
    "name": Key(TEXT, "a name that `within` of later shapes can use", None),
} | OUTSIDE
THICKNESS = Key(POSITIVE, "thickness on the axis")


def _solid(build: Callable[[Table], Curve]) -> Callable[[Table], list[Part]]:
    return lambda v: [Part(build(v), v["n"], v["outside"])]


def _lens(v: Table) -> Curve:
    options = {name: v[name] for name in ("radius", "conic", "vertex")}
    return shapes.lens(v["curvature"], v["thickness"], **options)


def _ellipse_lens(v: Table) -> Curve:
    return shapes.ellipse_lens(v["n"][0] / v["outside"][0], v["focal_length"], v["thickness"], v["radius"])


def _luneburg(v: Table) -> list[Part]:
    layers = shapes.luneburg(v["radius"], v["layers"])
    media = [v["outside"], *(tuple(n * ratio for n in v["outside"]) for _, ratio in layers)]
    return [Part(c, inner, outer) for (c, _), (outer, inner) in zip(layers, itertools.pairwise(media), strict=True)]


def _arcs(pieces: str) -> Key:
    return Key(NUMBERS, f"degrees by which {pieces} turns left as an arc of a circle; 0: straight", None)


SHAPES = {
    "polygon": Kind(
        "a closed chain of straight pieces and arcs of circles",
        {
            "points": Key(POINTS, "its corners"),
            "arcs": _arcs("each piece, the last one to the first corner,"),
        }
        | SOLID
        | PLACE
        | FACETS,
        _solid(lambda v: shapes.polygon(v["points"], v["arcs"])),
    ),
    "rectangle": Kind(
        "a rectangle around its origin",
        {"width": Key(POSITIVE, "along x"), "height": Key(POSITIVE, "along y")} | SOLID | PLACE,
        _solid(lambda v: shapes.rectangle(v["width"], v["height"])),
    ),
    "prism": Kind(
        "a triangle with two equal sides, its apex up, its centroid at the origin",
        {
            "side": Key(POSITIVE, "length of either side"),
            "apex": Key(APEX, "the angle between them", 60.0),
        }
        | SOLID
        | PLACE,
        _solid(lambda v: shapes.prism(v["apex"], v["side"])),
    ),
    "circle": Kind(
        "a circle around its origin",
        {"radius": Key(POSITIVE, "of the circle")} | SOLID | PLACE | FACETS,
        _solid(lambda v: shapes.circle(v["radius"])),
    ),
    "ellipse": Kind(
        "an ellipse around its origin",
        {"radii": Key(POSITIVES, "half axes along x and y")} | SOLID | PLACE | FACETS,
        _solid(lambda v: shapes.ellipse(*v["radii"])),
    ),
    "lens": Kind(
        "two conic surfaces z = c r² / (1 + √(1 − (1 + K) c² r²)) on the x axis, with a rim between them",
        {
            "curvature": Key(PAIR, "c of the front and of the back, positive where the centre lies toward +x"),
            "conic": Key(PAIR, "K of each", [0.0, 0.0]),
            "thickness": THICKNESS,
            "radius": Key(POSITIVE, "half the aperture; up to where the surfaces meet by default", None),
            "vertex": Key(NUMBER, "where the front meets the axis", 0.0),
        }
        | SOLID
        | PLACE
        | FACETS,
        _solid(_lens),
    ),
    "ellipse_lens": Kind(
        "focuses rays along x into its origin: an ellipse of eccentricity outside/n (first colour), and a circle",
        {
            "focal_length": Key(POSITIVE, "from the front to the focus"),
            "thickness": THICKNESS,
            "radius": Key(POSITIVE, "half the aperture"),
        }
        | SOLID
        | PLACE
        | FACETS,
        _solid(_ellipse_lens),
    ),
    "luneburg": Kind(
        "a ball in concentric layers of index outside × √(2 − (r/radius)²)",
        {
            "radius": Key(POSITIVE, "radius of the outermost layer"),
            "layers": Key(whole(1, 10_000), "number of layers"),
        }
        | OUTSIDE
        | PLACE
        | FACETS,
        _luneburg,
    ),
    "boundary": Kind(
        "an open chain of straight pieces and arcs of circles between two media",
        {
            "points": Key(POINTS, "its vertices"),
            "arcs": _arcs("each piece"),
            "n_left": Key(INDEX, "index on the left, seen along it"),
            "n_right": Key(INDEX, "index on the right"),
        }
        | PLACE
        | FACETS,
        lambda v: [Part(shapes.polyline(v["points"], v["arcs"]), v["n_left"], v["n_right"])],
    ),
}


def _spread(first: Any, last: Any, count: int) -> Array:
    """`count` values evenly from the first to the last; a single one is in the middle. Whole numbers stay exact."""
    if count == 1:
        return np.array([(first + last) / 2])
    steps = np.arange(count).reshape(-1, *[1] * np.ndim(first))
    return np.concatenate([(first + (last - first) * steps / (count - 1))[:-1], [last]])


def _parallel(v: Table) -> tuple[Array, Array]:
    origins = _spread(np.array(v["from"]), np.array(v["to"]), v["count"])
    return origins, np.broadcast_to(v["direction"], origins.shape)


def _fan(v: Table) -> tuple[Array, Array]:
    first, last = v["angles"]
    angles = _spread(first, last, v["count"])
    return np.broadcast_to(v["at"], (v["count"], 2)), np.array([unit(angle) for angle in angles])


def _rays(v: Table) -> tuple[Array, Array]:
    if len(v["origins"]) != len(v["directions"]):
        raise ValueError(f"directions: {len(v['directions'])}, for {len(v['origins'])} origins; expected as many")
    return np.array(v["origins"]), np.array(v["directions"])


BEAMS = {
    "parallel": Kind(
        "parallel rays from a line",
        {
            "from": Key(POINT, "start of the first ray"),
            "to": Key(POINT, "start of the last ray"),
            "direction": Key(DIRECTION, "of all rays"),
            "count": Key(RAYS, "number of rays; 1: from the middle"),
        },
        _parallel,
    ),
    "fan": Kind(
        "rays from a point",
        {
            "at": Key(POINT, "start of all rays"),
            "angles": Key(PAIR, "directions of the first and of the last ray, in degrees"),
            "count": Key(RAYS, "number of rays; 1: in the middle"),
        },
        _fan,
    ),
    "rays": Kind(
        "rays one by one",
        {"origins": Key(POINTS, "their starts"), "directions": Key(DIRECTIONS, "one for each start")},
        _rays,
    ),
}


def reference() -> str:
    """All kinds and keys as tables in Markdown: what `mi-refract trace --keys` prints."""
    shared = SOLID | PLACE | FACETS
    parts = [key_table("key of the scene", SCENE), key_table("key of a shape", shared)]
    parts += [
        kind_table("kind of shape", SHAPES, shared),
        kind_table("kind of beam", BEAMS, {}),
    ]
    return "\n\n".join(parts)
