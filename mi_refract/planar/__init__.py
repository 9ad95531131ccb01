"""Rays in two dimensions: boundaries between media, the paths of rays through them, scene files, figures.

Input: directed boundaries with a refractive index on either side, straight or arcs of conics, as arrays (`Segments`),
`shapes` or a scene file (TOML). Output: `Paths` (points, boundaries met, events, power), focal points, focal lengths,
an image.
"""

from . import curves, figure, focal_points, light, path_tree, scene_file, shapes
from .segments import Event, Paths, Segments
from .tracer import Tracer, trace

__all__ = [
    "Event",
    "Paths",
    "Segments",
    "Tracer",
    "curves",
    "figure",
    "focal_points",
    "light",
    "path_tree",
    "scene_file",
    "shapes",
    "trace",
]
