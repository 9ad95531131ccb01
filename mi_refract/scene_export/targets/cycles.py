"""Cycles: `scene.json`, a PLY file per mesh, and a script for Blender's Python that renders them."""

from __future__ import annotations

from importlib.resources import files as resources

import numpy as np

from ..plain_scene import PlainScene
from . import scene_json
from .environment_map import Array
from .shared_files import LIGHT_INSIDE, Files, readme

COMMANDS = """
pip install bpy==5.0.1          (Python 3.11)
python render.py --spp 256 --seeds 1 2 3 4 --out .
"""
ASSUMPTIONS = (
    "max_bounces and every other limit of bounces are Mitsuba's max_depth - 2. min_light_bounces is so, too, and "
    "switches Russian roulette off.",
    "A box filter of one pixel, no clamping, no blurred caustics (blur_glossy = 0), light_sampling_threshold = 0, no "
    "adaptive sampling, no denoising.",
    "A light emits on one side and is black from behind.",
    "A map of the sky is resampled: in Cycles the zenith is +z, and no row is centred on a pole.",
    LIGHT_INSIDE,
)


def files(plain: PlainScene) -> Files:
    """The files of the export, by name."""
    return scene_json.files(plain, direction_at) | {
        "render.py": resources(__package__).joinpath("render_cycles.py").read_bytes(),
        "README.txt": readme(plain, "Cycles", COMMANDS, ASSUMPTIONS),
    }


def direction_at(u: Array, v: Array) -> Array:
    """(…, 3): the direction in which Cycles shows the pixel at (u, v) of the map, v from the top."""
    phi, theta = np.pi * (1 - 2 * u), np.pi * v
    return np.stack([np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), np.cos(theta)], axis=-1)
