"""The export formats of a plain scene: `write(plain, "radiance", folder)`.

Each format has a function that returns the export's files by name. `COMMANDS` is the text on how to render;
`ASSUMPTIONS` lists where the renderer's model differs from Mitsuba's.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mi_refract.io import safe_files
from mi_refract.io.errors import ExportError

from ..plain_scene import Glass, PlainScene, VolumeGlass
from ..tessellation import is_closed
from . import gltf, luxcore, mitsuba, povray, radiance, scene_json, shared_files
from .shared_files import Files

__all__ = ["TARGETS", "gltf", "luxcore", "mitsuba", "povray", "radiance", "scene_json", "shared_files", "write"]

TARGETS: dict[str, Callable[[PlainScene], Files]] = {
    "cycles": scene_json.cycles_files,
    "luxcore": luxcore.files,
    "radiance": radiance.files,
    "raysect": scene_json.raysect_files,
    "povray": povray.files,
    "mitsuba": mitsuba.files,
    "obj+json": scene_json.obj_files,
    "gltf": gltf.files,
}
HOLD_VOLUMES = ("gltf",)  # targets with dispersion and absorption
# Targets with lamps without size. glTF leaves the falloff at a spot's edge to the renderer, as its README.txt says;
# Blender's spots have another falloff.
ALL_LAMPS = ("point", "spot", "directional")
HOLD_LAMPS = {"cycles": ("point", "directional"), "mitsuba": ALL_LAMPS, "obj+json": ALL_LAMPS, "gltf": ALL_LAMPS}
LEAST_DEPTH = {"cycles": 2, "luxcore": 2}  # these always sample lights at the first surface; other targets: 1
FARTHEST = {"povray": 1e6, "radiance": 1e9}  # largest coordinates: rays of these end after 1e7 and 1e10 units
# Least mean thickness of closed glass: rays of these miss surfaces nearer than 1e-4 and 1e-6 units to their start.
NEAREST = {"povray": 1e-3, "radiance": 1e-5}


def write(plain: PlainScene, target: str, folder: str | os.PathLike[str]) -> list[Path]:
    """Write the files of a target into a new or empty folder, all of them or none. Return their paths, sorted.

    ExportError for a scene that the target's format cannot hold, ValueError for an unknown target. OSError for a folder
    that contains files or cannot be written.
    """
    if target not in TARGETS:
        raise ValueError(f"target {target!r}: unknown; expected {', '.join(TARGETS)}")
    place = Path(folder).resolve()
    if place.is_dir():
        if any(place.iterdir()):
            raise FileExistsError(f"{folder}: already contains files; expected a new folder or an empty one")
    elif place.exists():
        raise NotADirectoryError(f"{folder}: is not a folder; expected a new folder or an empty one")
    safe_files.check_parent(place)
    for mesh in plain.meshes:
        if isinstance(mesh.material, VolumeGlass) and target not in HOLD_VOLUMES:
            expected = f"one number for all wavelengths and no absorption, or --to {' or '.join(HOLD_VOLUMES)}"
            raise ExportError(f"{plain.name}: {mesh.name}: {mesh.material.parameters}; expected {expected}")
    if plain.max_depth < LEAST_DEPTH.get(target, 1):
        raise ExportError(f"{plain.name}: max_depth = {plain.max_depth}; expected 2 or more, the least of {target}")
    bound = FARTHEST.get(target, math.inf)
    for name, points in [
        ("camera", np.array(plain.camera.origin)),
        *((mesh.name, mesh.vertices) for mesh in plain.meshes),
    ]:
        if (largest := float(np.abs(points).max(initial=0))) > bound:
            text = f"{plain.name}: {name}: a coordinate of {largest:g}"
            raise ExportError(f"{text}; expected up to {bound:g} for {target}")
    for mesh in plain.meshes:
        if target in NEAREST and isinstance(mesh.material, Glass) and is_closed(mesh.faces):
            a, b, c = mesh.triangles().swapaxes(0, 1)
            area, volume = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2, abs(mesh.volume())
            if 2 * volume < NEAREST[target] * area:
                fault = f"glass of mean thickness {2 * volume / area:.3g}"
                raise ExportError(
                    f"{plain.name}: {mesh.name}: {fault}; expected {NEAREST[target]:g} or more for {target}"
                )
    for lamp in plain.lamps:
        if lamp.kind not in HOLD_LAMPS.get(target, ()):
            fault = f"a {lamp.kind} lamp is not exported to {target}"
            supporting = [name for name, kinds in HOLD_LAMPS.items() if lamp.kind in kinds]
            expected = f"area lamps, an environment, or --to {' or '.join(supporting)}"
            raise ExportError(f"{plain.name}: {lamp.name}: {fault}; expected {expected}")
    files = TARGETS[target](plain)
    with safe_files.replacing(place, folder=True) as temporary:
        for name, content in files.items():
            (temporary / name).write_bytes(content)
    return [Path(folder) / name for name in sorted(files)]
