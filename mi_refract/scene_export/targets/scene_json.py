"""Programs that read `scene.json`: Cycles and raysect by a script of their Pythons, and programs without a target."""

from __future__ import annotations

import io
from importlib.resources import files as resources

import numpy as np

from ..plain_scene import Diffuse, Environment, Glass, PlainScene
from .shared_files import (
    LIGHT_INSIDE,
    OWN_AXES,
    Files,
    json_and_ply,
    longitude_latitude,
    material_names,
    numbers,
    readme,
    scene_json,
    sky_exr,
)

# Cycles ------------------------------------------------------------------------------------------------------------

CYCLES_COMMANDS = """
pip install bpy==5.0.1          (Python 3.11)
python render.py --spp 256 --seeds 1 2 3 4 --out .
"""
CYCLES_ASSUMPTIONS = (
    "max_bounces and every other bounce limit are Mitsuba's max_depth - 2, at most 1024. min_light_bounces has the "
    "same value, which switches Russian roulette off.",
    "A box filter of one pixel, no clamping, no blurred caustics (blur_glossy = 0), light_sampling_threshold = 0, no "
    "adaptive sampling, no denoising.",
    "A light emits on one side and is black from behind.",
    "A map of the sky is resampled: in Cycles the zenith is +z, and no row is centred on a pole.",
    LIGHT_INSIDE,
)


def cycles_files(plain: PlainScene) -> Files:
    """Return the export's files by name."""
    files = json_and_ply(plain) | sky_exr(plain, ((-1, 0, 0), (0, 1, 0), (0, 0, 1)))
    return files | {
        "render.py": resources(__package__).joinpath("render_cycles.py").read_bytes(),
        "README.txt": readme(plain, "Cycles", CYCLES_COMMANDS, CYCLES_ASSUMPTIONS),
    }


# raysect -----------------------------------------------------------------------------------------------------------

RAYSECT_COMMANDS = """
pip install raysect==0.9.0
python render.py --spp 256 --seeds 1 2 3 4 --out .
"""
RAYSECT_ASSUMPTIONS = (
    "A ray carries a spectrum of three bins, which are red, green and blue; an index is the same for all of them.",
    "ray_max_depth is Mitsuba's max_depth. Russian roulette (extinction) and importance sampling are off: rays hit "
    "lamps and the sky by chance.",
    "raysect's own pinhole camera weighs a ray by its cosine to the viewing direction; the camera of render.py does "
    "not.",
    "At a smooth boundary Fresnel's R is the probability of reflection, as in Mitsuba; at the critical angle itself "
    "light is reflected.",
    "Coordinates are scaled so that the largest is 0.5: raysect intersects triangles in float32 and offsets new rays "
    "by 1e-6.",
    "The sky is an emitting sphere, 20 times as large as the scene. A map of the sky is resampled: no row is centred "
    "on a pole.",
    "A light emits on one side and is black from behind.",
    LIGHT_INSIDE,
)


def raysect_files(plain: PlainScene) -> Files:
    """Return the export's files by name."""
    files = json_and_ply(plain, sky_file="sky.npy")
    if isinstance(plain.sky, Environment):
        file = io.BytesIO()
        np.save(file, longitude_latitude(plain.sky, OWN_AXES))
        files["sky.npy"] = file.getvalue()
    return files | {
        "render.py": resources(__package__).joinpath("render_raysect.py").read_bytes(),
        "README.txt": readme(plain, "raysect", RAYSECT_COMMANDS, RAYSECT_ASSUMPTIONS),
    }


# Other programs: Wavefront OBJ, and everything else as JSON --------------------------------------------------------

OBJ_COMMANDS = """
scene.obj    the triangles, one object per mesh
scene.mtl    the materials, as far as Wavefront's format can describe them
scene.json   camera, sky, lamps, max_depth, all materials, and the material of each object by name
sky.exr      the sky by longitude and latitude; only for a sky that is a map
"""
OBJ_ASSUMPTIONS = (
    "Coordinates are right-handed. Triangles are counterclockwise as seen from the medium of a glass's ext_ior, and "
    "from the side on which a light emits. Lights are black from behind. All shading is flat.",
    "The camera is a pinhole that looks from origin to target; up points up in the image; fov_x_degrees is the angle "
    "from the left border to the right one. A pixel is the mean over its square.",
    "max_depth counts the segments of a path from the camera: 2 is light, one surface, camera.",
    "sky.exr: +y is the zenith. The pixel in row j of H and column i of W has its centre at theta = pi (j + 1/2) / H, "
    "phi = 2 pi (i + 1/2) / W, and is seen in direction (sin(phi) sin(theta), cos(theta), -cos(phi) sin(theta)).",
    "lamps have no size. The intensity of a point is per steradian: the irradiance of a surface that faces it is "
    "intensity / distance^2. A spot has its full intensity up to beam_degrees from its direction, none beyond "
    "cutoff_degrees, and is linear in the angle between. The irradiance of a directional lamp is measured on a surface "
    "perpendicular to its light. Light travels along direction.",
    "Your program may or may not scale radiance by the square of the index at a boundary: the images differ only if a "
    "camera, a light or a diffuse surface is inside glass.",
)


def obj_files(plain: PlainScene) -> Files:
    """Return the export's files by name."""
    names, lines, first = material_names(plain), ["mtllib scene.mtl\n"], 1  # OBJ counts vertices through all objects
    for mesh in plain.meshes:
        lines.append(f"o {mesh.name}\nusemtl {names[mesh.material]}\n")
        lines += [f"v {numbers(vertex)}\n" for vertex in mesh.vertices.tolist()]
        lines += [f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + first).tolist()]
        first += len(mesh.vertices)
    mtl = ""
    for material, name in names.items():
        mtl += f"newmtl {name}\n"
        if isinstance(material, Glass):
            mtl += f"illum 7\nKd 0 0 0\nKs 1 1 1\nTf 1 1 1\nNi {material.int_ior / material.ext_ior!r}\n"
        elif isinstance(material, Diffuse):
            mtl += f"illum 1\nKd {numbers(material.reflectance)}\n"
        else:
            mtl += f"illum 1\nKd 0 0 0\nKe {numbers(material.radiance)}\n"
    return sky_exr(plain, OWN_AXES) | {
        "scene.obj": "".join(lines).encode(),
        "scene.mtl": mtl.encode(),
        "scene.json": scene_json(plain, {mesh.name: {"object": mesh.name} for mesh in plain.meshes}),
        "README.txt": readme(plain, "a program of your own", OBJ_COMMANDS, OBJ_ASSUMPTIONS),
    }
