"""Small scenes of one BSDF with glass, as cells of one scene: for the study of neighbours.

Bars, a grille before the lamp and a sky of hard blocks give structure in every random number.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mitsuba as mi
import numpy as np

from .cases import BLACK, GLASS, Nodes, bitmap

WIDE = 6  # cells beside each other


def uneven(shape: tuple[int, int], low: float, high: float, grain: int = 1) -> Nodes:
    """A bitmap of two values in blocks without an order: hard edges at every scale."""
    blocks = np.random.default_rng(3).random(shape) < 0.5
    return bitmap(np.kron(np.where(blocks, high, low), np.ones((grain, grain)))[..., None] * np.ones(3))


def bars(place: Any, spans: Iterable[tuple[float, float]], name: str) -> Nodes:
    """Black bars across the square [-1, 1]² of `place`, each from and to a place in x."""
    parts = [mi.ScalarTransform4f().translate([(a + b) / 2, 0, 0]).scale([(b - a) / 2, 1, 1]) for a, b in spans]
    bar = {"type": "rectangle", "bsdf": BLACK}
    return {f"{name}{i}": bar | {"to_world": place @ part} for i, part in enumerate(parts)}


def lights(variant: str) -> Nodes:
    """A lamp behind a grille, and a sky: in spectral variants without polarisation the same in all directions."""
    place = mi.ScalarTransform4f
    down = place().translate([0, 0, 12]).rotate([1, 0, 0], 180).scale(8)
    spans = [(-1, -0.5), (0, 0.25), (0.5, 0.625), (0.75, 0.8125), (0.9375, 0.96875)]  # edges at every scale
    found = {"lamp": {"type": "rectangle", "to_world": down, "emitter": {"type": "area", "radiance": 0.8}}}
    found |= bars(place().translate([0, 0, -0.1]) @ down, spans, "down")
    found |= bars(place().translate([0, 0, -0.2]) @ down @ place().rotate([0, 0, 1], 90), spans, "across")
    if variant.endswith("spectral"):
        return found | {"sky": {"type": "constant", "radiance": 0.4}}
    sky = {"type": "envmap", "bitmap": uneven((64, 128), 0.3, 0.8, grain=4)["bitmap"]}
    return found | {"sky": sky | {"to_world": place().rotate([1, 0.3, 0.2], 70)}}


def _ball(bsdf: Nodes, radius: float, *center: float) -> Nodes:
    return {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf}


def _plate(bsdf: Nodes, angle: float, width: float, x: float, y: float) -> Nodes:
    turned = mi.ScalarTransform4f().translate([x, y, 0]).rotate([0, 1, 0], angle)
    return {"type": "rectangle", "to_world": turned.scale([width, 0.48, 1]), "bsdf": bsdf}


def beside(bsdf: Nodes, x: float, y: float) -> Nodes:
    """A plate seen from its side, as a turned normal then refuses a lobe; a ball of glass; bars before both."""
    over = mi.ScalarTransform4f().translate([x, y, 1.2]).scale(0.48)
    found = bars(over, [(-0.8, -0.6), (0.1, 0.2), (0.7, 0.9)], "bar")
    return found | {"plate": _plate(bsdf, 65, 1.1, x, y), "ball": _ball(GLASS, 0.2, x + 0.1, y, 0.5)}


def around(bsdf: Nodes, x: float, y: float) -> Nodes:
    """A ball around one of glass."""
    return {"outer": _ball(bsdf, 0.46, x, y, 0), "inner": _ball(GLASS, 0.22, x, y, 0.1)}


def within(bsdf: Nodes, x: float, y: float) -> Nodes:
    """A plate in a block of glass: all its light has come through the boundary."""
    block = mi.ScalarTransform4f().translate([x, y, 0]).scale([0.49, 0.49, 0.3])
    return {"block": {"type": "cube", "to_world": block, "bsdf": GLASS}, "plate": _plate(bsdf, 10, 0.48, x, y)}


CELLS = (beside, around, within)


def scene(bsdfs: Iterable[Nodes], variant: str) -> Any:
    """The cells of all BSDFs, one after the other in rows of `WIDE`."""
    found: Nodes = {"type": "scene"} | lights(variant)
    for i, bsdf in enumerate(bsdfs):
        found[f"bsdf{i}"] = bsdf | {"id": f"bsdf{i}"}
        for j, cell in enumerate(CELLS, len(CELLS) * i):
            parts = cell({"type": "ref", "id": f"bsdf{i}"}, j % WIDE + 0.5, j // WIDE + 0.5)
            found |= {f"{name} {j}": part for name, part in parts.items()}
    return mi.load_dict(found, parallel=False, optimize=False)
