"""raysect: `scene.json`, a PLY file per mesh, and a script that renders them."""

from __future__ import annotations

import io
import json
from importlib.resources import files as resources

import numpy as np

from ..plain_scene import Environment, PlainScene
from . import scene_json
from .environment_map import longitude_latitude
from .obj import direction_at
from .shared_files import LIGHT_INSIDE, Files, ply, readme

COMMANDS = """
pip install raysect==0.9.0
python render.py --spp 256 --seeds 1 2 3 4 --out .
"""
ASSUMPTIONS = (
    "A ray carries a spectrum of three bins, which are red, green and blue; an index is the same for all of them.",
    "ray_max_depth is Mitsuba's max_depth. Russian roulette (extinction) and importance sampling are off: a lamp and "
    "the sky are met by chance.",
    "raysect's pinhole camera weighs a ray by the cosine to where it looks; here it does not.",
    "At a smooth boundary reflection or transmission is chosen by Fresnel's R, as in Mitsuba; at the critical angle "
    "itself light is reflected.",
    "Coordinates are scaled so that the largest is 0.5: raysect meets triangles in float32 and starts rays 1e-6 beside "
    "them.",
    "The sky is a sphere that emits, 20 times as large as the scene. A map of it is resampled: no row is "
    "centred on a pole.",
    "A light emits on one side and is black from behind.",
    LIGHT_INSIDE,
)


def files(plain: PlainScene) -> Files:
    """The files of the export, by name."""
    places = {mesh.name: {"file": f"{mesh.name}.ply"} for mesh in plain.meshes}
    document = json.loads(scene_json.document(plain, places))
    made: Files = {f"{mesh.name}.ply": ply(mesh) for mesh in plain.meshes}
    if isinstance(plain.sky, Environment):
        made["sky.npy"] = _npy(longitude_latitude(plain.sky, direction_at))
        document["sky"] = {"environment": "sky.npy"}
    return made | {
        "scene.json": json.dumps(document, indent=1).encode(),
        "render.py": resources(__package__).joinpath("render_raysect.py").read_bytes(),
        "README.txt": readme(plain, "raysect", COMMANDS, ASSUMPTIONS),
    }


def _npy(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, pixels)
    return file.getvalue()
