"""LuxCore: `scene.scn`, `scene.cfg`, a PLY file per mesh, and a script that renders them."""

from __future__ import annotations

from importlib.resources import files as resources

from ..plain_scene import Environment, Glass, Light, PlainScene
from .shared_files import Files, material_names, numbers, ply_files, readme, sky_exr

COMMANDS = """
pip install pyluxcore==2.11.2
python render.py --spp 256 --seeds 1 2 3 4 --out .
"""
ASSUMPTIONS = (
    "path.pathdepth.* is Mitsuba's max_depth. Russian roulette starts at that depth; no clamping, no light tracing.",
    "A box filter of one pixel. LuxCore's film is one row off, so the screen window is shifted down by one row.",
    "A map of the sky is resampled: in LuxCore the zenith is +z, longitudes increase in the other direction, and no "
    "row is centred on a pole.",
    "Radiance is scaled by the square of the index at a boundary, as in Mitsuba.",
)
# RANDOM: with this sampler the renders of two seeds are independent.
CONFIG = """renderengine.type = "PATHCPU"
sampler.type = "RANDOM"
scene.file = "scene.scn"
film.width = {camera.width}
film.height = {camera.height}
film.filter.type = "BOX"
film.filter.width = 0.5
film.outputs.0.type = "RGB"
film.outputs.0.filename = "scene.exr"
path.pathdepth.total = {depth}
path.pathdepth.diffuse = {depth}
path.pathdepth.glossy = {depth}
path.pathdepth.specular = {depth}
path.russianroulette.depth = {depth}
path.clamping.variance.maxvalue = 0
path.hybridbackforward.enable = 0
batch.haltspp = 256
"""


def files(plain: PlainScene) -> Files:
    """Return the export's files by name."""
    camera, names = plain.camera, material_names(plain)
    height, row = camera.height / camera.width, 2 / camera.width  # in a screen window of width 2
    view = {
        "lookat.orig": camera.origin,
        "lookat.target": camera.target,
        "up": camera.up,
        "fieldofview": [camera.fov_x_degrees],
        "screenwindow": [-1, 1, -height - row, height - row],
        "cliphither": [1e-9],
        "clipyon": [1e30],
        "autofocus.enable": [0],
    }
    lines = ['scene.camera.type = "perspective"', *(f"scene.camera.{key} = {numbers(view[key])}" for key in view)]
    if isinstance(plain.sky, Environment):
        # Without "clamp" LuxCore interpolates from one pole to the other.
        sky = {"type": '"infinite"', "file": '"sky.exr"', "gamma": "1", "storage": '"float"', "wrap": '"clamp"'}
    elif any(plain.sky):
        sky = {"type": '"constantinfinite"', "color": numbers(plain.sky)}
    else:
        sky = {}
    lines += [f"scene.lights.sky.{key} = {value}" for key, value in sky.items()]
    for material, name in names.items():
        if isinstance(material, Glass):
            inside, outside = numbers([material.int_ior]), numbers([material.ext_ior])
            properties = ['type = "glass"', "kr = 1 1 1", "kt = 1 1 1"]
            properties += [f"interiorior = {inside}", f"exteriorior = {outside}"]
        elif isinstance(material, Light):
            properties = ['type = "matte"', "kd = 0 0 0", f"emission = {numbers(material.radiance)}"]
        else:
            properties = ['type = "matte"', f"kd = {numbers(material.reflectance)}"]
        lines += [f"scene.materials.{name}.{line}" for line in properties]
    for mesh in plain.meshes:
        lines.append(f'scene.objects.{mesh.name}.ply = "{mesh.name}.ply"')
        lines.append(f'scene.objects.{mesh.name}.material = "{names[mesh.material]}"')
    contents = {
        "scene.scn": ("\n".join(lines) + "\n").encode(),
        "scene.cfg": CONFIG.format(camera=plain.camera, depth=plain.max_depth).encode(),
        "render.py": resources(__package__).joinpath("render_luxcore.py").read_bytes(),
        "README.txt": readme(plain, "LuxCore", COMMANDS, ASSUMPTIONS),
    }
    return ply_files(plain) | sky_exr(plain, ((1, 0, 0), (0, 1, 0), (0, 0, 1))) | contents
