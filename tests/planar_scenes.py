"""Planar scenes made by hand, for tests: a slab, a ball of exact arcs, a box."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from mi_refract.planar import Segments
from mi_refract.planar_scene import PlanarScene, Region

CORNERS = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)], float)
SLAB = np.array([(0, -50), (1, -50), (1, 50), (0, 50)], float)


def polygon(points, n, outside=1.0):
    """Counter-clockwise: the inside is on the left."""
    count = len(points)
    return Segments(points, np.roll(points, -1, axis=0), np.full(count, n), np.full(count, outside))


def ball(n):
    """The unit circle, of four arcs."""
    start, control = CORNERS[::2], CORNERS[1::2]
    return Segments(start, np.roll(start, -1, axis=0), np.full(4, n), np.ones(4), control, np.full(4, math.sqrt(0.5)))


def scene(segments, origins, directions, **given):
    """Rays through `segments`, a tuple of them for several colours, around which there is vacuum."""
    segments = segments if isinstance(segments, tuple) else (segments,)
    origins = np.array(origins, float)
    directions = np.broadcast_to(np.array(directions, float), origins.shape)
    directions = directions / np.hypot(*directions.T)[:, None]
    outline = segments[0].start if segments[0].control is None else CORNERS
    default = {
        "path": Path("test.toml"),
        "title": "A test",
        "colours": ("",) * len(segments),
        "regions": (Region(outline, tuple(s.n_left[0] for s in segments)),),
        "index": (1.0,) * len(segments),
        "beams": np.zeros(len(origins), int),
        "max_depth": 20,
        "branches": 0,
        "view": None,
    }
    return PlanarScene(segments=segments, origins=origins, directions=directions, **default | given)


def beam(count, half, x=-3.0, y=0.0):
    """Origins of parallel rays."""
    return np.column_stack([np.full(count, x), y + np.linspace(-half, half, count)])
