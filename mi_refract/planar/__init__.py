"""Rays in two dimensions: boundaries between media, the paths of rays through them, scene files, figures.

In: directed boundaries with a refractive index on either side, straight or arcs of conics, as arrays (`Segments`), as
`shapes` or as a scene file (TOML). Out: `Paths` (points, boundaries met, events, power), focal points, focal lengths,
an image.

`Event`, `Paths`, `Segments`, `Tracer` and `trace` are loaded when they are first used: geometry needs no ray tracing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .paths import Event, Paths
    from .segments import Segments
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
    "paraxial",
    "path_tree",
    "paths",
    "scene_file",
    "segments",
    "shapes",
    "trace",
    "tracer",
]

_MODULES = {"Event": "paths", "Paths": "paths", "Segments": "segments", "Tracer": "tracer", "trace": "tracer"}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_MODULES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
