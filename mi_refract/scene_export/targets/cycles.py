"""The plain scene for Cycles: `scene.json`, a PLY file per mesh, and the script that Blender's Python runs on them."""

from __future__ import annotations

from importlib.resources import files as resources

import numpy as np

from mi_refract.scene_export.plain_scene import Plain

from . import scene_json
from .environment_map import Array
from .shared_files import LIGHT_INSIDE, Files, readme

COMMAND = """
pip install bpy==5.0.1          (Python 3.11)
python render.py --spp 256 --seeds 1 2 3 4 --out .
"""
ASSUMED = (
    "max_bounces and every other limit of bounces are Mitsuba's max_depth - 2, and min_light_bounces too: no Russian "
    "roulette.",
    "A box filter of one pixel, no clamping, no blurred caustics (blur_glossy = 0), light_sampling_threshold = 0, no "
    "adaptive sampling, no denoising.",
    "A lamp is an emission that is black from behind.",
    "A sky that is a map is resampled: Cycles's zenith is +z, and its rows have their centres between the poles.",
    LIGHT_INSIDE,
)


def files(plain: Plain) -> Files:
    return scene_json.files(plain, looked_up) | {
        "render.py": resources(__package__).joinpath("render_cycles.py").read_bytes(),
        "README.txt": readme(plain, "Cycles", COMMAND, ASSUMED),
    }


def looked_up(u: Array, v: Array) -> Array:
    """The direction whose radiance Cycles finds at (u, v) of an image, v from the top."""
    phi, theta = np.pi * (1 - 2 * u), np.pi * v
    return np.stack([np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), np.cos(theta)], axis=-1)
