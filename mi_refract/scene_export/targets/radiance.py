"""Radiance, used as a path tracer without shadow rays."""

from __future__ import annotations

import math

import numpy as np

from ..plain_scene import Diffuse, Environment, Glass, PlainScene
from .shared_files import Files, material_names, numbers, readme

COMMANDS = """
oconv scene.rad > scene.oct
vwrays -fd -x {width} -y {height} -pa 0 -pj 1 -c 1024 -vf camera.vf |
    rtrace -h -w -u+ -fdf -ab {bounces} -aa 0 -ad 1 -as 0 -lr -{limit} -lw 1e-2 \\
    scene.oct | total -if3 -of -m -1024 > image.f32

RAYPATH must name both this folder and Radiance's lib. 1024 is the number of samples per pixel.
image.f32 holds {height} rows of {width} pixels of 3 float32, the top row first.
"""
SOURCE = "sky source everywhere 0 0 4 0 0 1 360\n"
ASSUMPTIONS = (
    "At a boundary Radiance traces both rays while their share is above 0.01 (-lw). Below it, Russian roulette (a "
    "negative -lr) ends rays, without bias.",
    "-lr and -ab are Mitsuba's max_depth - 1. They count reflections only; max_depth also counts refractions. So "
    "Radiance has light that Mitsuba cuts off. If that matters, raise Mitsuba's max_depth: `nested` gains 0.2 % of its "
    "mean from 48 to 400.",
    "Lights and sky are `glow` of radius 0: Radiance traces no shadow rays to them, so caustics are complete.",
)


def files(plain: PlainScene) -> Files:
    """Return the export's files by name."""
    maps: Files = {}
    if isinstance(plain.sky, Environment):
        height, width = plain.sky.pixels.shape[:2]
        pixels = np.concatenate([plain.sky.pixels, plain.sky.pixels[:, :1]], axis=1)
        head = f"2\n0 {height - 1} {height}\n0 {width} {width + 1}\n"
        for i, colour in enumerate("rgb"):
            rows = [" ".join(map(repr, row)) for row in pixels[..., i].astype(float).tolist()]
            maps[f"sky_{colour}.dat"] = (head + "\n".join(rows) + "\n").encode()
        x, y, z = (f"({a!r})*Dx + ({b!r})*Dy + ({c!r})*Dz" for a, b, c in plain.sky.rotation.T.tolist())
        functions = (
            f"x = {x};\ny = {y};\nz = {z};\nturn = atan2(x, -z)/(2*PI) - {0.5 / width!r};\n"
            f"row = Acos(y)/PI*{height - 1};\ncolumn = (turn - floor(turn))*{width};\n"
        )
        maps["sky.cal"] = functions.encode()
        sky = "void colordata map 9 noop noop noop sky_r.dat sky_g.dat sky_b.dat sky.cal row column 0 0\n"
        sky += f"map glow sky 0 0 4 1 1 1 0\n{SOURCE}"
    else:
        sky = f"void glow sky 0 0 4 {numbers(plain.sky)} 0\n{SOURCE}" if any(plain.sky) else ""
    camera, names = plain.camera, material_names(plain)
    # A path of N segments has N − 1 reflections. -lr 0 would not limit them.
    reflections = plain.max_depth - 1
    commands = COMMANDS.format(width=camera.width, height=camera.height, bounces=reflections, limit=max(reflections, 1))
    meshes = [
        "".join(
            f"{names[mesh.material]} polygon {mesh.name}.{i} 0 0 9 {numbers(corners.ravel())}\n"
            for i, corners in enumerate(mesh.triangles())
        )
        for mesh in plain.meshes
    ]
    forward, half_width = np.subtract(camera.target, camera.origin), math.tan(math.radians(camera.fov_x_degrees) / 2)
    fov_y = math.degrees(2 * math.atan(half_width * camera.height / camera.width))
    view = f"-vp {numbers(camera.origin)} -vd {numbers(forward)} -vu {numbers(camera.up)}"
    materials = ""
    for material, name in names.items():
        if isinstance(material, Glass):  # an interface names the medium behind the normal first
            materials += f"void interface {name} 0 0 8 1 1 1 {material.int_ior!r} 1 1 1 {material.ext_ior!r}\n"
        elif isinstance(material, Diffuse):
            materials += f"void plastic {name} 0 0 5 {numbers(material.reflectance)} 0 0\n"
        else:
            materials += f"void glow {name} 0 0 4 {numbers(material.radiance)} 0\n"
    return maps | {
        "scene.rad": "\n".join([materials, *meshes, sky]).encode(),
        "camera.vf": f"VIEW= -vtv {view} -vh {camera.fov_x_degrees!r} -vv {fov_y!r}\n".encode(),
        "README.txt": readme(plain, "Radiance", commands, ASSUMPTIONS),
    }
