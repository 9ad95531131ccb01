"""Render a glTF scene, as Blender imports it, by Cycles: `python gltf_by_cycles.py FOLDER RENDER.py --spp 256 --out .`

FOLDER: a glTF export. RENDER.py: the script of a Cycles export of the same scene, for its settings and depth.
"""

import importlib.util
import sys
from pathlib import Path

import bpy

folder, path = map(Path, (sys.argv.pop(1), sys.argv.pop(1)))
spec = importlib.util.spec_from_file_location("render", path)
cycles = importlib.util.module_from_spec(spec)
spec.loader.exec_module(cycles)


def build(plain, _):
    """Import the glTF file, and add the sky, which is a file beside it."""
    bpy.ops.import_scene.gltf(filepath=str(folder / "scene.glb"), export_import_convert_lighting_mode="COMPAT")
    sky = {"environment": "sky.exr"} if (folder / "sky.exr").exists() else {"radiance": (0, 0, 0)}
    cycles.world(sky, folder)
    scene = bpy.context.scene
    scene.camera = next(thing for thing in bpy.data.objects if thing.type == "CAMERA")
    scene.camera.data.clip_end = 1e6


cycles.build = build
cycles.main()
