"""The images for `mi-refract diff --self-test`: renders of a scene file, or of a built-in scene with a glass ball."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io.pixels import Pixels
from mi_refract.rendering.scene_files import load_scene

from . import variants

RENDERS, SPP = 16, 16
RESOLUTION = 64


def of_file(path: Path, allow_plugins: Collection[str] = ()) -> Pixels:
    """Independent renders of a scene file, number × H × W × C.

    `allow_plugins`: names of plugins that the scene may bring, which are code. Errors: those of `load_scene`.
    """
    variants.activate()
    return _rendered(load_scene(path, allow_plugins=allow_plugins))


def glass_ball() -> Pixels:
    """Independent renders of a glass ball on a floor under a sky and a lamp, number × H × W × 3."""
    variants.activate()
    import mitsuba as mi

    return _rendered(mi.load_dict(_glass_ball()))


def _rendered(scene: Any) -> Pixels:
    import mitsuba as mi

    return np.stack([np.array(mi.render(scene, spp=SPP, seed=seed)) for seed in range(RENDERS)])


def _glass_ball() -> dict[str, Any]:
    import mitsuba as mi

    look_at = mi.ScalarTransform4f().look_at
    film = {"width": RESOLUTION, "height": RESOLUTION, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    camera = look_at([0, -5, 2.5], [0, 0, 0.8], [0, 0, 1])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 16, "rr_depth": 16},
        "sensor": {"type": "perspective", "fov": 40, "to_world": camera, "film": {"type": "hdrfilm", **film}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.6, 0.8, 1.0]}},
        "lamp": {
            "type": "rectangle",
            "to_world": look_at([3, -2, 5], [0, 0, 0], [0, 0, 1]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.5, 2.0]}},
        },
        "floor": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(8),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}},
        },
        "ball": {"type": "sphere", "center": [0, 0, 1], "bsdf": {"type": "refract"}},
    }
