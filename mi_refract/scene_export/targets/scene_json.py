"""A plain scene as `scene.json`, a PLY file per mesh, and `sky.exr` where the sky is a map."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

from ..plain_scene import Environment, Material, PlainScene
from .environment_map import Lookup, longitude_latitude
from .shared_files import Files, exr, ply


def files(plain: PlainScene, direction_at: Lookup) -> Files:
    """The files, by name. The renderer shows the sky's pixel at (u, v) in direction `direction_at(u, v)`."""
    meshes = {f"{mesh.name}.ply": ply(mesh) for mesh in plain.meshes}
    places = {mesh.name: {"file": f"{mesh.name}.ply"} for mesh in plain.meshes}
    return {"scene.json": document(plain, places)} | meshes | sky(plain, direction_at)


def document(plain: PlainScene, places: Mapping[str, Mapping[str, str]]) -> bytes:
    """The text of `scene.json`. `places`: by mesh, where its triangles are."""
    names = material_names(plain)
    shown: dict[str, Any] = {
        "name": plain.name,
        "max_depth": plain.max_depth,
        "camera": dataclasses.asdict(plain.camera),
        "sky": {"environment": "sky.exr"} if isinstance(plain.sky, Environment) else {"radiance": plain.sky},
        "materials": {
            name: {"type": type(material).__name__.lower()} | dataclasses.asdict(material)
            for material, name in names.items()
        },
        "meshes": {mesh.name: {**places[mesh.name], "material": names[mesh.material]} for mesh in plain.meshes},
    }
    return json.dumps(shown, indent=1).encode()


def material_names(plain: PlainScene) -> dict[Material, str]:
    """A name for each material."""
    return {material: f"material{number}" for number, material in enumerate(plain.materials)}


def sky(plain: PlainScene, direction_at: Lookup) -> Files:
    """`sky.exr` where the sky is a map, resampled for a renderer with this `direction_at`."""
    if not isinstance(plain.sky, Environment):
        return {}
    return {"sky.exr": exr(longitude_latitude(plain.sky, direction_at))}
