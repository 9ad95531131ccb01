"""Mitsuba scenes as inputs: read as `render` and `scene export` read them, up to the first sample.

Beside a mutated scene there is a false plugin for every word of the good ones. Mitsuba says so where it opens one.
"""

from __future__ import annotations

import dataclasses
import math
import re
import resource
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from mi_refract.plugins import scene_parser
from mi_refract.rendering import scene_files
from mi_refract.scene_export import from_mitsuba, write_files

from .parser import Parser

SCENES = Path(__file__).parents[2] / "scenes"
NAMES = ("balls", "furnace", "nested", "prism", "slab", "sphere")
LEVEL = 1  # of the tessellation
MEMORY = 2 << 30  # bytes: the largest film is accepted
SMALL = {"res": "4", "bsdf": "dielectric", "max_depth": "8"}
PIXELS = 64
HEADER = 700  # bytes of the sky in front of its pixels
TARGETS = [name for name in write_files.TARGETS if name != "povray"]  # which has glass and lights only
WORD = re.compile(r"[A-Za-z_][\w-]*")
MESH = """<scene version="3.0.0">
<integrator type="path"><integer name="max_depth" value="8"/></integrator>
<sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="4"/><integer name="height" value="4"/></film></sensor>
<shape type="ply">
<string name="filename" value="mutated.ply"/><bsdf type="dielectric"/></shape></scene>"""


def parsers(folder: Path) -> dict[str, Parser]:
    """Those of scenes and of their meshes, by name, in the variant scalar_rgb. The scenes' files go into `folder`."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    shutil.copytree(SCENES / "meshes", folder / "meshes")
    shutil.copy(SCENES / "lamps.exr", folder)
    (folder / "mesh.xml").write_text(MESH)
    scenes = tuple((SCENES / f"{name}.xml").read_bytes() for name in NAMES)
    _set_bait(folder / "plugins", scenes)
    mesh, sky = (SCENES / "meshes" / "prism.ply").read_bytes(), (SCENES / "lamps.exr").read_bytes()
    (folder / "sky.xml").write_text((SCENES / "balls.xml").read_text().replace("lamps.exr", "mutated.exr"))
    return {
        "scene, XML": Parser(".xml", scenes, _bounded(_rendered_by_turns)),
        "scene to export, XML": Parser(".xml", scenes, _bounded(_exported)),
        "sky, EXR": Parser(".exr", (sky,), _bounded(lambda path: _rendered(folder / "sky.xml", SMALL)), HEADER),
        "mesh, PLY": Parser(".ply", (mesh,), _bounded(lambda path: _rendered(folder / "mesh.xml", {}))),
    }


def _set_bait(folder: Path, scenes: tuple[bytes, ...]) -> None:
    """A file for each plugin that a scene may come to name: no native code, so that to load it is an error."""
    folder.mkdir()
    words = {word for scene in scenes for word in WORD.findall(scene.decode())}
    for name in words | scene_parser.known_plugins():
        (folder / f"{name}.so").write_text("native code")


def _bounded(read: Callable[[Path], str]) -> Callable[[Path], str]:
    """`read`, which must neither open the bait nor take more than MEMORY."""

    def bounded(path: Path) -> str:
        before = _peak()
        try:
            wrong = read(path)
        except ValueError as error:
            if "Error while loading plugin" in str(error):
                return f"a plugin of the scene's own was opened: {error}"
            if _peak() - before <= MEMORY:
                raise
            wrong = ""
        return wrong or ("" if _peak() - before <= MEMORY else f"took {_peak() - before} bytes of memory")

    return bounded


def _peak() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _rendered_by_turns(path: Path) -> str:
    """Every other scene as it is, whose film is made; the others small, and so they are rendered."""
    return _rendered(path, SMALL if path.stat().st_size % 2 else {})


def _rendered(path: Path, defines: Mapping[str, str]) -> str:
    import mitsuba as mi

    scene = scene_files.load_scene(path, defines)
    meshes = (shape for shape in scene.shapes() if shape.is_mesh())
    if any(np.max(np.array(mesh.faces_buffer()), initial=0) >= mesh.vertex_count() for mesh in meshes):
        return "a face without its vertices"
    film = scene.sensors()[0].film()
    if math.prod(film.crop_size()) <= PIXELS:
        mi.render(scene, spp=1)
    else:
        film.prepare([])
    return ""


def _exported(path: Path) -> str:
    """The scene is written for one of the targets, by turns."""
    plain = from_mitsuba.load(path, level=LEVEL)
    target = TARGETS[path.stat().st_size % len(TARGETS)]
    write_files.TARGETS[target](plain)
    parts = [*dataclasses.astuple(plain.camera), *(x for m in plain.materials for x in dataclasses.astuple(m))]
    return "" if np.isfinite(np.hstack(parts)).all() else "a number that is not finite"
