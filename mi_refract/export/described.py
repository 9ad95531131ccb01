"""A plain scene as JSON beside its meshes: `scene.json`, a PLY file per mesh, `sky.exr` where the sky is a map."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from ..plain_data import Environment, Plain
from .common import Files, exr, ply
from .environment import Lookup, longitude_latitude


def files(plain: Plain, looked_up: Lookup) -> Files:
    """The sky's map is for a renderer that finds the direction `looked_up(u, v)` at (u, v), v from the top."""
    names = {material: f"material{number}" for number, material in enumerate(plain.materials)}
    sky: dict[str, Any] = {"radiance": plain.sky}
    maps: Files = {}
    if isinstance(plain.sky, Environment):
        sky, maps = {"environment": "sky.exr"}, {"sky.exr": exr(longitude_latitude(plain.sky, looked_up))}
    document = {
        "name": plain.name,
        "max_depth": plain.max_depth,
        "camera": dataclasses.asdict(plain.camera),
        "sky": sky,
        "materials": {
            name: {"type": type(material).__name__.lower()} | dataclasses.asdict(material)
            for material, name in names.items()
        },
        "meshes": {mesh.name: {"file": f"{mesh.name}.ply", "material": names[mesh.material]} for mesh in plain.meshes},
    }
    meshes = {f"{mesh.name}.ply": ply(mesh) for mesh in plain.meshes}
    return {"scene.json": json.dumps(document, indent=1).encode()} | meshes | maps
