"""Programs without a target of their own: Wavefront OBJ with a material library, and everything else as JSON."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..plain_scene import Diffuse, Glass, Material, PlainScene
from . import scene_json
from .environment_map import Array
from .shared_files import Files, numbers, readme

COMMANDS = """
scene.obj    the triangles, one object per mesh
scene.mtl    the materials as far as Wavefront's format can say them
scene.json   camera, sky, max_depth, all materials, and the material of each object by name
sky.exr      only where the sky is a map, by longitude and latitude
"""
ASSUMPTIONS = (
    "Coordinates are right-handed. Triangles are counterclockwise as seen from the medium of a glass's ext_ior, and "
    "from the side on which a light emits. Lights are black from behind. All shading is flat.",
    "The camera is a pinhole that looks from origin to target; up points up in the image; fov_x_degrees is the angle "
    "from the left border to the right one. A pixel is the mean over its square.",
    "max_depth counts the segments of a path from the camera: 2 is light, one surface, camera.",
    "sky.exr: +y is the zenith. The pixel in row j of H and column i of W has its centre at theta = pi (j + 1/2) / H, "
    "phi = 2 pi (i + 1/2) / W, and is seen in direction (sin(phi) sin(theta), cos(theta), -cos(phi) sin(theta)).",
    "Your program may scale radiance by the square of the index at a boundary, or not: the images differ only where a "
    "camera, a light or a diffuse surface is inside glass.",
)


def files(plain: PlainScene) -> Files:
    """The files of the export, by name."""
    return scene_json.sky(plain, direction_at) | {
        "scene.obj": "".join(_objects(plain)).encode(),
        "scene.mtl": "".join(_material(*item) for item in scene_json.material_names(plain).items()).encode(),
        "scene.json": scene_json.document(plain, {mesh.name: {"object": mesh.name} for mesh in plain.meshes}),
        "README.txt": readme(plain, "a program of your own", COMMANDS, ASSUMPTIONS),
    }


def direction_at(u: Array, v: Array) -> Array:
    """(…, 3): as in Mitsuba, but with the pixels of all rows at their centres."""
    phi, theta = 2 * np.pi * u, np.pi * v
    return np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=-1)


def _objects(plain: PlainScene) -> Iterator[str]:
    """The text of the OBJ file. It counts vertices from 1, through all objects."""
    names, first = scene_json.material_names(plain), 1
    yield "mtllib scene.mtl\n"
    for mesh in plain.meshes:
        yield f"o {mesh.name}\nusemtl {names[mesh.material]}\n"
        yield "".join(f"v {numbers(vertex)}\n" for vertex in mesh.vertices.tolist())
        yield "".join(f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + first).tolist())
        first += len(mesh.vertices)


def _material(material: Material, name: str) -> str:
    if isinstance(material, Glass):
        return f"newmtl {name}\nillum 7\nKd 0 0 0\nKs 1 1 1\nTf 1 1 1\nNi {material.int_ior / material.ext_ior!r}\n"
    if isinstance(material, Diffuse):
        return f"newmtl {name}\nillum 1\nKd {numbers(material.reflectance)}\n"
    return f"newmtl {name}\nillum 1\nKd 0 0 0\nKe {numbers(material.radiance)}\n"
