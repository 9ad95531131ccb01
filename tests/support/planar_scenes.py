"""Planar scenes for tests: polygons, a slab, a ball of exact arcs."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path

import numpy as np

from mi_refract.planar import Event, Segments
from mi_refract.planar.light import Light
from mi_refract.planar.scene_file import PlanarScene, Region

CORNERS = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)], float)
SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
SLAB = np.array([(0, -50), (1, -50), (1, 50), (0, 50)], float)


def polygon(points, n=1.5, outside=1.0):
    """Return the segments of a counter-clockwise polygon: the inside is on the left."""
    start = np.array(points, float)
    return Segments(start, np.roll(start, -1, axis=0), np.full(len(start), n), np.full(len(start), outside))


def together(*parts):
    names = [field.name for field in fields(Segments)]
    return Segments(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def star(count, seed=1, n=1.7):
    rng = np.random.default_rng(seed)
    angle, radius = np.sort(rng.uniform(0, 2 * np.pi, count)), rng.uniform(0.3, 1, count)
    return polygon(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]), n)


def story(paths, i=0):
    """Return the segments that path i hits, and its events."""
    hits, events = paths.hits[i], paths.events[i]
    return hits[hits >= 0].tolist(), [Event(e) for e in events if e != Event.NONE]


def ball(n=1.5):
    """Return the unit circle, made of four arcs."""
    start, control = CORNERS[::2], CORNERS[1::2]
    return Segments(start, np.roll(start, -1, axis=0), np.full(4, n), np.ones(4), control, np.full(4, math.sqrt(0.5)))


def scene(segments, origins, directions, **overrides):
    """Return a scene of rays and `segments` in vacuum; a tuple of segments has one entry per colour."""
    segments = segments if isinstance(segments, tuple) else (segments,)
    origins = np.array(origins, float)
    directions = np.broadcast_to(np.array(directions, float), origins.shape)
    directions = directions / np.hypot(*directions.T)[:, None]
    outline = CORNERS if segments[0].turn.any() else segments[0].start
    default = {
        "path": Path("test.toml"),
        "title": "A test",
        "shape_names": ("shape[0]",) * len(segments[0]),
        "light": Light(overrides.pop("colours", ("",) * len(segments))),
        "regions": (Region(outline, tuple(s.n_left[0] for s in segments)),),
        "index": (1.0,) * len(segments),
        "beams": np.zeros(len(origins), int),
        "max_depth": 20,
        "branches": 0,
        "view": None,
    }
    return PlanarScene(segments=segments, origins=origins, directions=directions, **default | overrides)


def beam(count, half, x=-3.0, y=0.0):
    """Return the origins of parallel rays."""
    return np.column_stack([np.full(count, x), y + np.linspace(-half, half, count)])
