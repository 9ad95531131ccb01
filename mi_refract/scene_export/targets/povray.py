"""POV-Ray: glass and lights only, because POV-Ray traces no light between diffuse surfaces."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import numpy as np

from mi_refract.io.errors import ExportError

from ..plain_scene import Diffuse, Environment, Glass, Light, Mesh, PlainScene
from ..tessellation import encloses, is_closed
from .shared_files import LIGHT_INSIDE, Files, numbers, outermost_index, outward, readme, sky_exr

COMMANDS = """
povray +Iscene.pov +Oimage.exr +FE +W{width} +H{height} -A -D File_Gamma=1.0 Declare=dx=0.5 Declare=dy=0.5

0 <= dx, dy < 1 is the position of the only sample in each pixel. To apply a box filter, average images with random dx
and dy.
"""
ASSUMPTIONS = (
    "max_trace_level counts as Mitsuba's max_depth does, up to 256. At a boundary POV-Ray traces both rays until the "
    "share of a ray is below 1e-7 (adc_bailout).",
    "A ray is inside a body after an odd number of intersections with its surface. So glass must be closed, and nested "
    "bodies must not touch.",
    "A map of the sky is resampled: POV-Ray shows its first column in direction +x.",
    "Mesh vertices are float32, and the pixels of the image are half floats.",
    LIGHT_INSIDE,
)
BAILOUT = "1e-7"


def files(plain: PlainScene) -> Files:
    """Return the export's files by name. ExportError for open glass and for diffuse surfaces."""
    for mesh in plain.meshes:
        place = f"{plain.name}: {mesh.name}"
        if isinstance(mesh.material, Glass) and not is_closed(mesh.faces):
            raise ExportError(f"{place}: glass with an open surface; POV-Ray needs a closed surface")
        if isinstance(mesh.material, Diffuse) and any(mesh.material.reflectance):
            raise ExportError(f"{place}: a diffuse surface; the export to POV-Ray supports glass and lights only")
    # In POV-Ray the outermost medium has index 1: indices are relative to it.
    plain = outward(plain)
    outside = outermost_index(plain)
    # POV-Ray has one index per body. The medium around a body is the smallest other body that encloses it.
    meshes = sorted(plain.meshes, key=Mesh.volume)
    bodies = [(mesh, glass) for mesh in meshes if isinstance(glass := mesh.material, Glass)]
    boxes = [(mesh.vertices.min(0), mesh.vertices.max(0)) for mesh, _ in bodies]
    for i, (mesh, glass) in enumerate(bodies):
        low, high = boxes[i]
        around_it = ((boxes[j][0] <= low).all() and (high <= boxes[j][1]).all() for j in range(i + 1, len(bodies)))
        larger = itertools.compress(bodies[i + 1 :], around_it)
        around = next((x.int_ior for body, x in larger if encloses(body.triangles(), mesh.vertices[0])), outside)
        if glass.ext_ior != around:
            text = f"{plain.name}: {mesh.name}: ext_ior = {glass.ext_ior}"
            raise ExportError(f"{text}; expected {around}, the index of the medium around it")
    if isinstance(plain.sky, Environment):
        sky = 'sky_sphere { pigment { image_map { exr "sky.exr" gamma 1.0 map_type 1 interpolate 2 } } }\n'
    else:
        sky = f"background {{ rgb {_vector(plain.sky)} }}\n"
    settings = (
        "#version 3.7;\n"
        f"global_settings {{ assumed_gamma 1.0 max_trace_level {min(plain.max_depth, 256)} adc_bailout {BAILOUT} }}\n"
    )
    # Right-handed: Right points right in the image. Shifted by (dx − ½, dy − ½) pixels.
    camera = plain.camera
    forward = np.subtract(camera.target, camera.origin)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right *= 2 * math.tan(math.radians(camera.fov_x_degrees) / 2) / np.linalg.norm(right)
    up = np.cross(right, forward) * camera.height / camera.width
    view = (
        "#ifndef (dx) #declare dx = 0.5; #end\n#ifndef (dy) #declare dy = 0.5; #end\n"
        f"#declare Right = {_vector(right)};\n#declare Up = {_vector(up)};\n"
        f"camera {{ perspective location {_vector(camera.origin)} right Right up Up\n"
        f"  direction {_vector(forward)} + Right*(dx - 0.5)/{camera.width} - Up*(dy - 0.5)/{camera.height} }}\n"
    )
    commands = COMMANDS.format(width=camera.width, height=camera.height)
    return sky_exr(plain, ((1, 0, 0), (0, 0, 1), (0, 1, 0))) | {
        "scene.pov": "\n".join([settings, view, sky, *(_mesh(mesh, outside) for mesh in plain.meshes)]).encode(),
        "README.txt": readme(plain, "POV-Ray 3.7", commands, ASSUMPTIONS),
    }


def _vector(values: Iterable[float]) -> str:
    return f"<{numbers(values, ', ')}>"


def _mesh(mesh: Mesh, outside: float) -> str:
    vertices = ",\n".join(map(_vector, mesh.vertices))
    # Counterclockwise in these right-handed coordinates is clockwise in POV-Ray's.
    faces = ",\n".join(f"<{c}, {b}, {a}>" for a, b, c in mesh.faces.tolist())
    no_reflection, material = "ambient 0 diffuse 0", mesh.material
    if isinstance(material, Glass):
        finish = f"finish {{ {no_reflection} reflection {{ 0, 1 fresnel on }} conserve_energy }}"
        appearance = f"texture {{ pigment {{ rgbt 1 }} {finish} }} interior {{ ior {material.int_ior / outside!r} }}"
    else:
        colour = material.radiance if isinstance(material, Light) else (0.0, 0.0, 0.0)
        front = f"texture {{ pigment {{ rgb {_vector(colour)} }} finish {{ {no_reflection} emission 1 }} }}"
        appearance = f"{front} interior_texture {{ pigment {{ rgb 0 }} finish {{ {no_reflection} }} }}"
    return (
        f"mesh2 {{ // {mesh.name}\n  vertex_vectors {{ {len(mesh.vertices)},\n{vertices} }}\n"
        f"  face_indices {{ {len(mesh.faces)},\n{faces} }}\n  {appearance}\n}}\n"
    )
