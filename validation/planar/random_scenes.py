"""Random planar scenes: bodies of every kind, nested and turned, and rays through them, some of them reflected."""

from __future__ import annotations

import numpy as np

from mi_refract.planar import Segments, shapes
from mi_refract.planar.curves import Curve, affine
from validation.reference.planar_retrace import Array

SIDE = 3  # bodies in a row
DEPTH = 30


def bodies(rng: np.random.Generator) -> Segments:
    """A square of bodies, 1 apart, in air; every second one holds another."""
    parts: list[tuple[Curve, float, float]] = []
    for place in np.ndindex(SIDE, SIDE):
        size, n, inner = rng.uniform(0.2, 0.45), *rng.uniform(1.1, 2.5, 2)
        nest = affine(rng.uniform(0, 360))
        parts.append((_outline(rng, size).mapped(nest, place), n, 1.0))
        if rng.random() < 0.5:
            # Any of the outlines holds a circle of a tenth of its size around its origin.
            parts.append((shapes.circle(0.1 * size).mapped(nest, place), inner, n))
    arrays = [np.concatenate([getattr(c, name) for c, _, _ in parts]) for name in ("start", "end", "control", "weight")]
    media = [np.concatenate([np.full(len(part[0]), part[side]) for part in parts]) for side in (1, 2)]
    return Segments(*arrays[:2], *media, *arrays[2:])


def _outline(rng: np.random.Generator, size: float) -> Curve:
    makers = (
        lambda: shapes.circle(size),
        lambda: shapes.ellipse(size, size * rng.uniform(0.3, 1)),
        lambda: shapes.circle(size).faceted(int(rng.integers(5, 40))),
        lambda: shapes.prism(rng.uniform(30, 100), 1.2 * size),
        lambda: shapes.lens((1 / size, -1 / size), 0.5 * size, conic=(-2.0, 0.0), vertex=-size / 4, radius=size / 2),
    )
    return makers[rng.integers(len(makers))]()


def rays(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Origins outside, directions toward the bodies, and `reflect`: of a third of them, at some of the first three."""
    turn = rng.uniform(0, 2 * np.pi, count)
    directions = np.stack([np.cos(turn), np.sin(turn)], 1)
    origins = rng.uniform(-0.3, SIDE - 0.7, (count, 2)) - 5 * directions
    return origins, directions, rng.integers(0, 8, count) * (rng.random(count) < 1 / 3)
