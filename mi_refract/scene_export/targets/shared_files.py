"""Files that several targets write: meshes, environment maps, README.txt."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mi_refract import __version__
from mi_refract.io.atomic import temporary_folder
from mi_refract.io.image_file import NO_DATE, write_exr

from ..plain_scene import Mesh, PlainScene

Files = dict[str, bytes]  # contents by name


def ply(mesh: Mesh) -> bytes:
    """Binary PLY, little-endian, float32, without normals."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    return header.encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()


def exr(pixels: NDArray[np.floating]) -> bytes:
    """An OpenEXR file of pixels (H, W, 3)."""
    with temporary_folder() as folder:
        path = folder / "map.exr"
        write_exr(path, pixels, metadata=NO_DATE)
        return path.read_bytes()


def numbers(values: Iterable[float], separator: str = " ") -> str:
    """The numbers as the shortest decimals that read back exactly in float64."""
    return separator.join(repr(float(value)) for value in values)


def readme(plain: PlainScene, target: str, commands: str, assumptions: Sequence[str]) -> bytes:
    """README.txt: the commands that render the scene, and the differences between the models."""
    camera = plain.camera
    lines = [
        f"{plain.name}: {len(plain.meshes)} flat-shaded meshes of {sum(len(m.faces) for m in plain.meshes)} triangles,",
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


LIGHT_INSIDE = (
    "Radiance is not scaled by the square of the index inside glass. The image is the same as long as camera, lights "
    "and diffuse surfaces are all in the outermost medium."
)
