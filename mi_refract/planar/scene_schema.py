"""What a planar scene file may hold: one table of kinds and keys, and what is built of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mi_refract.io import toml_schema
from mi_refract.io.toml_schema import Key, Kind, Values

from . import shapes
from .curves import Curve, unit
from .tracer import Array

Indices = tuple[float, ...]  # one per colour


class Part(NamedTuple):
    """A curve between two media."""

    curve: Curve
    left: Indices
    right: Indices


SCENE = {
    "title": Key(toml_schema.TEXT, "what the image is called; the file's name by default", None),
    "index": Key(toml_schema.INDEX, "of the medium around everything", [1.0]),
    "colours": Key(
        toml_schema.TEXTS, "one for each wavelength, as matplotlib calls them; lists of indices are as long", None
    ),
    "max_depth": Key(toml_schema.whole(1, 100_000), "the most boundaries that a ray meets", 16),
    "branches": Key(
        toml_schema.whole(0, 8), "the most partial reflections on a path; 0: refracted wherever possible", 0
    ),
    "view": Key(toml_schema.BOX, "what the image shows; all shapes by default", None),
    "shape": Key(toml_schema.TABLES, "[[shape]]: boundaries between media"),
    "beam": Key(toml_schema.TABLES, "[[beam]]: rays to follow"),
}
PLACE = {
    "scale": Key(toml_schema.SCALE, "stretches the shape, first of all", 1.0),
    "rotate": Key(toml_schema.NUMBER, "then turns it counter-clockwise, in degrees", 0.0),
    "at": Key(toml_schema.POINT, "then moves its origin there", [0.0, 0.0]),
}
FACETS = {"facets": Key(toml_schema.whole(1, 1_000_000), "so many chords in place of all arcs of a curve", None)}
OUTSIDE = {
    "outside": Key(toml_schema.INDEX, "index around the shape; that of the whole scene by default", None),
    "within": Key(toml_schema.TEXT, "or the name of a shape above that it lies in", None),
}
SOLID = {"n": Key(toml_schema.INDEX, "index inside"), "name": Key(toml_schema.TEXT, "for `within`", None)} | OUTSIDE
THICKNESS = Key(toml_schema.POSITIVE, "on the axis")


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
    return Key(toml_schema.NUMBERS, f"degrees by which {pieces} turns left, an arc of a circle; 0: straight", None)


SHAPES = {
    "polygon": Kind(
        "a closed chain of straight pieces and arcs of circles",
        {
            "points": Key(toml_schema.POINTS, "its corners"),
            "arcs": _arcs("each piece, the last one to the first corner,"),
        }
        | SOLID
        | PLACE
        | FACETS,
        _solid(lambda v: shapes.polygon(v["points"], v["arcs"])),
    ),
    "rectangle": Kind(
        "around its origin",
        {"width": Key(toml_schema.POSITIVE, "along x"), "height": Key(toml_schema.POSITIVE, "along y")} | SOLID | PLACE,
        _solid(lambda v: shapes.rectangle(v["width"], v["height"])),
    ),
    "prism": Kind(
        "a triangle with two equal sides, its apex up, its centroid at the origin",
        {
            "side": Key(toml_schema.POSITIVE, "length of either side"),
            "apex": Key(toml_schema.APEX, "the angle between them", 60.0),
        }
        | SOLID
        | PLACE,
        _solid(lambda v: shapes.prism(v["apex"], v["side"])),
    ),
    "circle": Kind(
        "around its origin",
        {"radius": Key(toml_schema.POSITIVE, "from its origin")} | SOLID | PLACE | FACETS,
        _solid(lambda v: shapes.circle(v["radius"])),
    ),
    "ellipse": Kind(
        "around its origin",
        {"radii": Key(toml_schema.POSITIVES, "half axes along x and y")} | SOLID | PLACE | FACETS,
        _solid(lambda v: shapes.ellipse(*v["radii"])),
    ),
    "lens": Kind(
        "two conic surfaces z = c r² / (1 + √(1 − (1 + K) c² r²)) on the x axis, with a rim between them",
        {
            "curvature": Key(
                toml_schema.PAIR, "c of the front and of the back, positive where the centre lies toward +x"
            ),
            "conic": Key(toml_schema.PAIR, "K of each", [0.0, 0.0]),
            "thickness": THICKNESS,
            "radius": Key(toml_schema.POSITIVE, "half the aperture; up to where the surfaces meet by default", None),
            "vertex": Key(toml_schema.NUMBER, "where the front meets the axis", 0.0),
        }
        | SOLID
        | PLACE
        | FACETS,
        _solid(_lens),
    ),
    "ellipse_lens": Kind(
        "focuses rays along x into its origin: an ellipse of eccentricity outside/n (first colour), and a circle",
        {
            "focal_length": Key(toml_schema.POSITIVE, "from the front to the focus"),
            "thickness": THICKNESS,
            "radius": Key(toml_schema.POSITIVE, "half the aperture"),
        }
        | SOLID
        | PLACE
        | FACETS,
        _solid(_ellipse_lens),
    ),
    "luneburg": Kind(
        "a ball in concentric layers of index outside × √(2 − (r/radius)²)",
        {
            "radius": Key(toml_schema.POSITIVE, "of the outermost"),
            "layers": Key(toml_schema.whole(1, 10_000), "how many"),
        }
        | OUTSIDE
        | PLACE
        | FACETS,
        _luneburg,
    ),
    "boundary": Kind(
        "an open chain of straight pieces and arcs of circles between two media",
        {
            "points": Key(toml_schema.POINTS, "its vertices"),
            "arcs": _arcs("each piece"),
            "n_left": Key(toml_schema.INDEX, "index on the left, seen along it"),
            "n_right": Key(toml_schema.INDEX, "index on the right"),
        }
        | PLACE
        | FACETS,
        lambda v: [Part(shapes.polyline(v["points"], v["arcs"]), v["n_left"], v["n_right"])],
    ),
}


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
            "from": Key(toml_schema.POINT, "where the first one starts"),
            "to": Key(toml_schema.POINT, "where the last one does"),
            "direction": Key(toml_schema.DIRECTION, "of all"),
            "count": Key(toml_schema.RAYS, "how many; 1: from the middle"),
        },
        _parallel,
    ),
    "fan": Kind(
        "rays from a point",
        {
            "at": Key(toml_schema.POINT, "the point"),
            "angles": Key(toml_schema.PAIR, "of the first and of the last one, in degrees"),
            "count": Key(toml_schema.RAYS, "how many; 1: in the middle"),
        },
        _fan,
    ),
    "rays": Kind(
        "one by one",
        {"origins": Key(toml_schema.POINTS, "where they start"), "directions": Key(toml_schema.DIRECTIONS, "as many")},
        _rays,
    ),
}


def reference() -> str:
    """All kinds and keys as tables in Markdown, for the README."""
    shared = SOLID | PLACE | FACETS
    parts = [toml_schema.key_table("key of the scene", SCENE), toml_schema.key_table("key of a shape", shared)]
    parts += [
        toml_schema.kind_table("kind of shape", SHAPES, shared),
        toml_schema.kind_table("kind of beam", BEAMS, {}),
    ]
    return "\n\n".join(parts)
