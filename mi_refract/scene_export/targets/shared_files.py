"""Files that several targets share: meshes, maps of the sky, `scene.json`, README.txt."""

from __future__ import annotations

import dataclasses
import json
import textwrap
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from mi_refract import __version__
from mi_refract.io.image_file import NO_DATE, write_exr
from mi_refract.io.safe_files import temporary_folder

from ..plain_scene import (
    DirectionalLamp,
    Environment,
    Glass,
    Lamp,
    Material,
    Mesh,
    PlainScene,
    PointLamp,
    SpotLamp,
    VolumeGlass,
)
from ..tessellation import basis, is_closed

Files = dict[str, bytes]  # contents by name
Array = NDArray[np.float64]
# Axes of a map of the sky by longitude and latitude: the directions at the left edge at half height, a quarter of the
# width to the right of it, and in the top row.
Axes = tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]
OWN_AXES: Axes = (0, 0, -1), (1, 0, 0), (0, 1, 0)  # Mitsuba's
# Factor of the resolution of a resampled map. Other renderers place texels at their centres; Mitsuba places its first
# and last row at the poles. A map is linear between its texels. A finer map reproduces this, except in cells that
# contain a texel of the original map.
FINER = 16
LARGEST = 16384  # longest side of a finer map: a common limit of textures, and 1.6 GB; a longer original loses a row
STRIP = 2**18  # texels that are computed at a time: intermediate results of 60 MB
LIGHT_INSIDE = (
    "Radiance is not scaled by the square of the index inside glass. The image is the same if camera, lights and "
    "diffuse surfaces are all in the outermost medium."
)


def numbers(values: Iterable[float], separator: str = " ") -> str:
    """Return the numbers as the shortest decimals that read back exactly in float64."""
    return separator.join(repr(float(value)) for value in values)


def readme(
    plain: PlainScene, target: str, commands: str, assumptions: Sequence[str], shading: str = "flat-shaded "
) -> bytes:
    """Return README.txt: the commands that render the scene, and the differences between the models."""
    camera = plain.camera
    lines = [
        f"{plain.name}: {len(plain.meshes)} {shading}meshes of {sum(len(m.faces) for m in plain.meshes)} triangles,",
        f"{camera.width} x {camera.height} pixels, box filter, linear Rec. 709. Written by mi_refract {__version__}.",
        "",
        f"To render with {target}:",
        "",
        textwrap.indent(textwrap.dedent(commands).strip(), "    "),
        "",
        *(["Assumptions, and differences between the models:", ""] if assumptions else []),
    ]
    for assumption in assumptions:
        lines += textwrap.wrap(assumption, 100, initial_indent="- ", subsequent_indent="  ")
    return ("\n".join(lines) + "\n").encode()


# Meshes and materials ----------------------------------------------------------------------------------------------


def material_names(plain: PlainScene) -> dict[Material, str]:
    """Return a name for each material."""
    return {material: f"material{number}" for number, material in enumerate(plain.materials)}


def turned(mesh: Mesh) -> Mesh:
    """Return the same glass boundary with opposite normals and exchanged media."""
    assert isinstance(mesh.material, Glass)
    material = dataclasses.replace(mesh.material, int_ior=mesh.material.ext_ior, ext_ior=mesh.material.int_ior)
    if isinstance(material, VolumeGlass):
        material = dataclasses.replace(material, int_sigma=material.ext_sigma, ext_sigma=material.int_sigma)
    normals = None if mesh.normals is None else -mesh.normals
    return dataclasses.replace(mesh, faces=mesh.faces[:, ::-1], normals=normals, material=material)


def outward(plain: PlainScene) -> PlainScene:
    """Return the same scene, with all closed glass turned so that normals point outward and `int_ior` is inside."""

    def inside_out(mesh: Mesh) -> bool:
        return isinstance(mesh.material, Glass) and is_closed(mesh.faces) and mesh.volume() < 0

    return dataclasses.replace(plain, meshes=tuple(turned(mesh) if inside_out(mesh) else mesh for mesh in plain.meshes))


def outermost_index(plain: PlainScene) -> float:
    """Return the index of the medium around all glass, after `outward`; 1 without glass."""
    glasses = [(mesh.vertices[:, 0].max(), mesh.material) for mesh in plain.meshes if isinstance(mesh.material, Glass)]
    return max(glasses, key=lambda glass: glass[0])[1].ext_ior if glasses else 1.0


def ply_files(plain: PlainScene) -> Files:
    """Return a PLY file per mesh: binary, little-endian, float32, without normals."""
    files = {}
    for mesh in plain.meshes:
        header = (
            "ply\nformat binary_little_endian 1.0\n"
            f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
            f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        )
        faces = np.empty(len(mesh.faces), [("count", "u1"), ("index", "<i4", 3)])
        faces["count"], faces["index"] = 3, mesh.faces
        files[f"{mesh.name}.ply"] = header.encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()
    return files


def scene_json(plain: PlainScene, where: Mapping[str, Mapping[str, str]], sky_file: str = "sky.exr") -> bytes:
    """Return `scene.json`. `where`: the location of each mesh's triangles, by mesh; `sky_file`: the file of a map."""
    names = material_names(plain)
    document = {
        "name": plain.name,
        "max_depth": plain.max_depth,
        "camera": dataclasses.asdict(plain.camera),
        "sky": {"environment": sky_file} if isinstance(plain.sky, Environment) else {"radiance": plain.sky},
        "materials": {
            name: {"type": type(material).__name__.lower()} | dataclasses.asdict(material)
            for material, name in names.items()
        },
        "meshes": {mesh.name: {**where[mesh.name], "material": names[mesh.material]} for mesh in plain.meshes},
    }
    if plain.lamps:
        document["lamps"] = [{"type": lamp.kind} | dataclasses.asdict(lamp) for lamp in plain.lamps]
    return json.dumps(document, indent=1).encode()


def json_and_ply(plain: PlainScene, sky_file: str = "sky.exr") -> Files:
    """Return `scene.json` and the PLY files that it names."""
    where = {mesh.name: {"file": f"{mesh.name}.ply"} for mesh in plain.meshes}
    return {"scene.json": scene_json(plain, where, sky_file)} | ply_files(plain)


def frame(lamp: Lamp) -> Array:
    """Return a lamp's frame (4, 4): the third axis is the direction of its light, the translation is its position.

    A lamp without a direction has the identity's axes; one without a position has no translation.
    """
    matrix = np.eye(4)
    if isinstance(lamp, SpotLamp | DirectionalLamp):
        matrix[:3, :3] = basis(np.array(lamp.direction))
    if isinstance(lamp, PointLamp):
        matrix[:3, 3] = lamp.position
    return matrix


# The sky -----------------------------------------------------------------------------------------------------------


def exr(pixels: NDArray[np.floating]) -> bytes:
    """Return the bytes of an OpenEXR file of pixels (H, W, 3)."""
    with temporary_folder() as folder:
        path = folder / "map.exr"
        write_exr(path, pixels, metadata=NO_DATE)
        return path.read_bytes()


def sky_exr(plain: PlainScene, axes: Axes) -> Files:
    """Return `sky.exr`, resampled for a renderer with these axes; no file unless the sky is a map."""
    if not isinstance(plain.sky, Environment):
        return {}
    return {"sky.exr": exr(longitude_latitude(plain.sky, axes))}


def longitude_latitude(environment: Environment, axes: Axes) -> NDArray[np.float32]:
    """Return the map (H, W, 3) for a renderer with these axes, whose pixels are at their centres."""
    rows, columns = environment.pixels.shape[:2]
    finer = max(1, min(FINER, LARGEST // max(rows, columns)))
    height, width = finer * (rows - 1), finer * columns
    result, strip = np.empty((height, width, 3), np.float32), max(1, STRIP // width)
    phi = 2 * np.pi * ((np.arange(width) + 0.5) / width)
    for top in range(0, height, strip):
        theta = np.pi * ((np.arange(top, min(top + strip, height))[:, None] + 0.5) / height)
        directions = np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), np.cos(theta) + 0 * phi
        result[top : top + strip] = radiance(environment, np.stack(directions, axis=-1) @ np.array(axes, float))
    return result


def radiance(environment: Environment, directions: Array) -> Array:
    """Return the radiance (…, 3) in these directions of the scene (…, 3), of any length but 0."""
    x, y, z = np.moveaxis(directions @ environment.rotation, -1, 0)
    pixels = environment.pixels
    height, width = pixels.shape[:2]
    column = np.arctan2(x, -z) / (2 * np.pi) * width - 0.5
    row = np.arctan2(np.hypot(x, z), y) / np.pi * (height - 1)
    left, top = np.floor(column).astype(int), np.clip(np.floor(row).astype(int), 0, height - 2)
    right, bottom = (left + 1) % width, top + 1
    a, b = (column - left)[..., None], (row - top)[..., None]
    upper = (1 - a) * pixels[top, left % width] + a * pixels[top, right]
    lower = (1 - a) * pixels[bottom, left % width] + a * pixels[bottom, right]
    return np.asarray((1 - b) * upper + b * lower)
