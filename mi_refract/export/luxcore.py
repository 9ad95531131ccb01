"""A plain scene for LuxCore: `scene.scn`, `scene.cfg`, a PLY file per mesh, and the script that renders them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files import write_atomically
from ..images import write_exr
from ..plain_data import Camera, Colour, Environment, Glass, Light, Material, Mesh, Plain
from .environment import longitude_latitude

SCRIPT = Path(__file__).with_name("render_luxcore.py")
README = """{name} for LuxCore 2.11 (pip install pyluxcore==2.11.2)

    python render.py --spp 256 --seeds 1 2 3 4 --out .

How it is made the same picture as Mitsuba's:
- path.pathdepth.* is Mitsuba's max_depth; no Russian roulette before it, no clamping, no light tracing.
- box filter of one pixel; LuxCore's film is one row off, so the screen window is moved by two over the height.
- radiance is scaled by the square of the index at a boundary, as in Mitsuba.
- a sky that is a map is resampled to LuxCore's z-up, mirrored longitudes and texel centres.
- spheres and checkerboards are flat triangles of one colour each.
"""
# Random numbers of their own in every sample: renders of two seeds are independent.
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
path.forceblackbackground.enable = 0
batch.haltspp = 256
"""


def write(plain: Plain, folder: Path) -> list[Path]:
    """What LuxCore needs to render it, in an existing folder; the files written. OSError."""
    names = {material: f"material{number}" for number, material in enumerate(plain.materials)}
    lines = camera_lines(plain.camera) + sky_lines(plain.sky, folder)
    for material, name in names.items():
        lines += [f"scene.materials.{name}.{line}" for line in material_lines(material)]
    for mesh in plain.meshes:
        write_ply(folder / f"{mesh.name}.ply", mesh)
        lines.append(f'scene.objects.{mesh.name}.ply = "{mesh.name}.ply"')
        lines.append(f'scene.objects.{mesh.name}.material = "{names[mesh.material]}"')
    texts = {
        "scene.scn": "\n".join(lines) + "\n",
        "scene.cfg": CONFIG.format(camera=plain.camera, depth=plain.max_depth),
        "README.txt": README.format(name=plain.name),
    }
    for name, text in texts.items():
        write_atomically(folder / name, text)
    shutil.copyfile(SCRIPT, folder / "render.py")
    sky = [folder / "sky.exr"] if isinstance(plain.sky, Environment) else []
    return [*(folder / name for name in texts), folder / "render.py", *sky, *(folder / f"{m.name}.ply" for m in plain.meshes)]


def camera_lines(camera: Camera) -> list[str]:
    shift, tall = 2 / camera.height, camera.height / camera.width
    window = (-1.0, 1.0, -tall - shift * tall, tall - shift * tall)
    own = {
        "lookat.orig": camera.origin, "lookat.target": camera.target, "up": camera.up, "screenwindow": window,
        "fieldofview": (camera.fov_x_degrees,), "autofocus.enable": (0,), "cliphither": (1e-3,), "clipyon": (1e6,),
    }  # fmt: skip
    return ['scene.camera.type = "perspective"', *(f"scene.camera.{key} = {_row(value)}" for key, value in own.items())]


def sky_lines(sky: Colour | Environment, folder: Path) -> list[str]:
    if isinstance(sky, Environment):
        write_exr(folder / "sky.exr", longitude_latitude(sky, _direction))
        own = {"type": '"infinite"', "file": '"sky.exr"', "gamma": "1", "storage": '"float"'}
    else:
        own = {"type": '"constantinfinite"', "color": _row(sky)}
    return [f"scene.lights.sky.{key} = {value}" for key, value in own.items()]


def _direction(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    phi, theta = 2 * np.pi * u, np.pi * v
    return np.stack([np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), np.cos(theta)], axis=-1)


def material_lines(material: Material) -> list[str]:
    if isinstance(material, Glass):
        return ['type = "glass"', "kr = 1 1 1", "kt = 1 1 1", f"interiorior = {_row([material.int_ior])}",
                f"exteriorior = {_row([material.ext_ior])}"]  # fmt: skip
    if isinstance(material, Light):
        return ['type = "matte"', "kd = 0 0 0", f"emission = {_row(material.radiance)}"]
    return ['type = "matte"', f"kd = {_row(material.reflectance)}"]


def write_ply(path: Path, mesh: Mesh) -> None:
    """Binary, float32, without normals: flat triangles."""
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    write_atomically(path, header.encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes())


def _row(values: object) -> str:
    return " ".join(f"{x:.9g}" for x in np.atleast_1d(values))
