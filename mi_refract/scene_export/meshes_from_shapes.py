"""Conversion of Mitsuba's shapes to flat meshes of one material each, in the scene's coordinates."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from mi_refract import media
from mi_refract.formulas import FORMULAS
from mi_refract.numerics import mitsuba_mesh
from mi_refract.plugins import PLUGIN, read_medium, scene_parser

from . import tessellation
from .mitsuba_nodes import Node
from .plain_scene import LINES, WAVELENGTHS, Colour, Diffuse, Glass, Lamp, Light, Material, Mesh, VolumeGlass
from .tessellation import Triangles, Vertices

GLASSES = ("dielectric", PLUGIN, *(f"{PLUGIN}_{name}" for name in FORMULAS))
FILES = ("obj", "ply")
# For each shape: the number of triangles at a tessellation level, and the function that makes them.
SHAPES: dict[str, tuple[Callable[[int], int], Callable[[int], Triangles]]] = {
    "cube": (lambda level: 12, lambda level: tessellation.cube()),
    "cylinder": (lambda level: 16 << level, tessellation.cylinder),
    "disk": (lambda level: 8 << level, tessellation.disk),
    "rectangle": (lambda level: 2, lambda level: tessellation.rectangle()),
    "sphere": (lambda level: 20 << 2 * level, tessellation.sphere),
}
ROUND = {"sphere": (1, 1, 1), "cylinder": (1, 1, 0)}  # normal = vertex times this
FARTHEST = 1e30  # largest coordinate: its products with directions fit in float32
MOST = 2**24  # largest number of triangles in a scene, checked before they are made
BLACK = (0.0, 0.0, 0.0)
DEFAULT = (0.5, 0.5, 0.5)  # Mitsuba's reflectance


@dataclass(frozen=True)
class Surface:
    """One material, or two in a checkerboard. `scales`: of the checkerboard's uv. `one_sided`: black from behind."""

    materials: tuple[Material, ...]
    scales: tuple[float, float] | None = None
    one_sided: bool = False


def meshes_of_shape(shape: Node, level: int, most: int = MOST, eye: Vertices | None = None) -> Iterator[Mesh]:
    """Yield the shape's meshes: two for a checkerboard, otherwise one.

    `eye` (3): position of the camera. ValueError for unsupported parameters, for a surface that would be black from
    `eye`, and for more than `most` triangles; these are counted before they are made.
    """
    surface, frame = _surface(shape), _frame(shape)
    is_flipped = shape.value(bool, "flip_normals", False)
    if surface.scales:
        _check_count(shape, 2 * math.prod(max(math.ceil(2 * scale), 1) for scale in surface.scales), most)
    elif shape.type in SHAPES:
        _check_count(shape, SHAPES[shape.type][0](level), most)
    parts = _parts(shape, surface, level, most)
    shape.finish()
    if surface.one_sided and not all(tessellation.is_closed(faces) for _, faces in parts):
        raise shape.error("diffuse on one side of an open surface", "its BSDF in a `twosided`, or a closed shape")
    for i, ((vertices, faces), material) in enumerate(zip(parts, surface.materials, strict=True)):
        if not len(faces):  # a checkerboard of one cell
            continue
        name = shape.props.id() or shape.type
        placed = vertices @ frame[:3, :3].T + frame[:3, 3]
        if not (np.abs(placed) <= FARTHEST).all():
            raise shape.error(f"coordinates beyond {FARTHEST:g}", "finite ones, up to that")
        normals = None
        if shape.type in ROUND:
            normals = (vertices * ROUND[shape.type]) @ frame[:3, :3].T * (-1 if is_flipped else 1)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        faces = faces[:, ::-1] if is_flipped else faces
        mesh = Mesh(f"{name}_{i}" if i else name, placed, faces, material, normals)
        if surface.one_sided and eye is not None:
            is_inward = mesh.volume() < 0
            is_behind = tessellation.encloses(placed[faces[:, ::-1] if is_inward else faces], eye) != is_inward
            if is_behind or tessellation.has_body_inside_out(placed, faces, eye):
                is_around = is_behind and not is_inward
                seen = "outside only, around the camera" if is_around else "inside only, seen from outside"
                raise shape.error(f"diffuse on the {seen}", "its BSDF in a `twosided`")
        yield mesh


def with_unique_names(parts: Iterable[Mesh | Lamp]) -> tuple[Mesh | Lamp, ...]:
    """Return the meshes and lamps with new names: letters, digits and underscores only, unique even ignoring case."""
    taken: set[str] = set()
    result: list[Mesh | Lamp] = []
    for part in parts:
        name = stem = re.sub(r"\W", "_", part.name, flags=re.ASCII)
        count = 1
        while name.lower() in taken:
            count += 1
            name = f"{stem}_{count}"
        taken.add(name.lower())
        result.append(replace(part, name=name))
    return tuple(result)


def _check_count(shape: Node, count: int, most: int) -> None:
    if count > most:
        raise shape.error(f"{count} triangles where {most} are left", f"{MOST} in all; a lower level, fewer cells")


def _parts(shape: Node, surface: Surface, level: int, most: int) -> tuple[Triangles, ...]:
    """Return triangles in the shape's own coordinates, one part per material; of a file at most `most`."""
    if surface.scales:
        if shape.type != "rectangle":
            raise shape.error("a checkerboard", "one on a rectangle")
        return tessellation.checkerboard(*surface.scales)
    if shape.type in SHAPES:
        return (SHAPES[shape.type][1](level),)
    if shape.type not in FILES:
        raise shape.error("this shape is not supported", f"{', '.join((*SHAPES, *FILES))}")
    path, flat = shape.scene.resolve(shape.value(str, "filename")), shape.value(bool, "face_normals", False)
    try:
        with scene_parser.folders(scene_parser.own_folder()):
            if shape.type == "ply":
                scene_parser.check_faces(path)
            mesh = mi.load_dict({"type": shape.type, "filename": str(path.absolute()), "face_normals": flat})
    except RuntimeError as error:
        raise ValueError(str(shape.error(f"{path}: {error}", "a mesh that Mitsuba reads"))) from None
    if mitsuba_mesh.has_normals(mesh):
        raise shape.error("smooth normals", "face_normals = true")
    stored, indices = mitsuba_mesh.arrays(mesh)
    vertices, faces = stored.astype(np.float64), indices.astype(np.int64)
    _check_count(shape, len(faces), most)
    if not tessellation.is_closed(faces):  # vertices may be split, as for texture coordinates
        vertices, faces = tessellation.welded(vertices[faces])
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)  # a file may have vertices without a face, however far away
    return ((vertices[used], faces.reshape(-1, 3)),)


def _frame(shape: Node) -> Vertices:
    """Return the matrix (4, 4) from the coordinates of `_parts` to the scene's."""

    def positive(name: str, value: float) -> float:
        if value <= 0:
            raise shape.error(f"{name} = {value}", "a positive number")
        return value

    frame, local = shape.transform(), np.eye(4)
    if shape.type == "sphere":
        local[:3, 3] = shape.point("center", (0, 0, 0))
        local[:3, :3] *= positive("radius", shape.value(float, "radius", 1.0))
    elif shape.type == "cylinder":
        start, end = (shape.point(name, (0, 0, z)) for name, z in (("p0", 0), ("p1", 1)))
        radius = positive("radius", shape.value(float, "radius", 1.0))
        length = positive("length", float(np.linalg.norm(end - start)))
        local[:3, 3] = start
        local[:3, :3] = tessellation.basis((end - start) / length) * [radius, radius, length]
    combined = frame @ local
    if shape.type in ("sphere", "cylinder"):  # Mitsuba only stretches cylinders, along their axis
        squares = combined[:3, :3].T @ combined[:3, :3]
        allowed = squares.diagonal()[[0, 0, 0 if shape.type == "sphere" else 2]]
        if not np.allclose(squares, np.diag(allowed), rtol=1e-5, atol=1e-5 * squares.max()):
            raise shape.error(f"to_world deforms the {shape.type}", "one scale, rotations and translations")
    return combined


def _surface(shape: Node) -> Surface:
    """Read the BSDF and the area emitter of a shape."""
    bsdf = emitter = None
    for child in shape.children():
        if child.kind == "BSDF" and not bsdf:
            bsdf = child
        elif child.kind == "Emitter" and not emitter:
            emitter = child
        else:
            raise child.error(f"a {child.kind.lower()} of a shape", "one BSDF, one area emitter")
    if emitter is None:
        return _scattering(bsdf) if bsdf else Surface((Diffuse(DEFAULT),), one_sided=True)
    if emitter.type != "area":
        raise emitter.error("an emitter of a shape", "area")
    if bsdf and _scattering(bsdf).materials != (Diffuse(BLACK),):
        raise bsdf.error("the BSDF of a lamp", "none, or a black diffuse one")
    colours, scales = _colours(emitter, "radiance", None)
    emitter.ignore("sampling_weight")
    emitter.finish()
    return Surface(tuple(map(Light, colours)), scales)


def _scattering(bsdf: Node) -> Surface:
    """Read a BSDF."""
    if bsdf.type == "twosided":
        inner = list(bsdf.children())
        bsdf.finish()
        if len(inner) != 1:
            raise bsdf.error("two BSDFs", "the same on both sides")
        if inner[0].type in GLASSES:
            raise bsdf.error(f"a {inner[0].type}", "a BSDF that transmits nothing")
        return replace(_scattering(inner[0]), one_sided=False)
    if bsdf.type in GLASSES:
        return Surface((_glass(bsdf),))
    if bsdf.type == "diffuse":
        colours, scales = _colours(bsdf, "reflectance", DEFAULT[0])
        bsdf.finish()
        if (largest := max(map(max, colours))) > 1:
            raise bsdf.error(f"a reflectance of {largest:g}", "at most 1")
        return Surface(tuple(map(Diffuse, colours)), scales, one_sided=any(colour != BLACK for colour in colours))
    raise bsdf.error("this BSDF is not supported", f"diffuse, twosided, {', '.join(GLASSES)}")


def _glass(bsdf: Node) -> Glass:
    """Read a glass: a Glass if two indices describe it (an absorption of 0 is none), otherwise a VolumeGlass."""
    sides = {"int_ior": "bk7", "ext_ior": "air"}
    for name in sides:
        if isinstance(value := bsdf.take(name), Node):
            raise bsdf.error(f"{name} is a {value.type}", "the same index at all points")
    try:
        with scene_parser.folders(*bsdf.scene.parsed.folders):
            inside, outside = (read_medium(bsdf.props, name, default) for name, default in sides.items())
        n_int, n_ext = (float(medium.index(media.LINES["d"])) for medium in (inside, outside))
    except ValueError as error:
        raise ValueError(f"{bsdf.scene.path}: {bsdf}: {str(error).removeprefix(f'{PLUGIN}: ')}") from None
    if bsdf.type == "dielectric":
        for name in sides:
            try:
                if isinstance(value := bsdf.props.get(name), str):
                    mi.load_dict({"type": bsdf.type, name: value})
            except RuntimeError:
                raise bsdf.error(f"{name} = {value}", "a name that Mitsuba knows") from None
    sigmas = {side: _sigma(bsdf, side) if bsdf.type != "dielectric" else BLACK for side in ("int", "ext")}
    parameters = [
        f"{name} = {bsdf.props.get(name, default)}"
        for (name, default), medium in zip(sides.items(), (inside, outside), strict=True)
        if medium.dispersive
    ]
    absorbing = {f"{side}_{name}" for side in sigmas for name in ("absorption", "colour") if any(sigmas[side])}
    parameters += [name for name in bsdf.names if name in absorbing]
    bsdf.ignore("formula")
    bsdf.finish()
    if not parameters:
        return Glass(n_int, n_ext)
    spectrum: tuple[float, ...] = ()
    if inside.dispersive or outside.dispersive:
        denser, other = (inside, outside) if n_int >= n_ext else (outside, inside)
        spectrum = tuple(np.asarray(media.relative_index(denser, other, np.array(WAVELENGTHS))).tolist())
        if missing := [f"{w:g} nm" for w, n in zip(WAVELENGTHS, spectrum, strict=True) if not math.isfinite(n)]:
            raise bsdf.error(f"{', '.join(parameters)}: no index at {missing[0]}", "one from 400 to 700 nm")
        n = spectrum[LINES.index("d")]
        n_int, n_ext = (n * n_ext, n_ext) if n_int >= n_ext else (n_int, n * n_int)
    return VolumeGlass(n_int, n_ext, ", ".join(parameters), spectrum, *sigmas.values())


def _sigma(bsdf: Node, side: str) -> Colour:
    """Return σ of a side in red, green and blue."""
    sigma, colour, distance = f"{side}_absorption", f"{side}_colour", f"{side}_colour_distance"
    if sigma in bsdf.names:
        return bsdf.colour(sigma, None)
    if colour not in bsdf.names:
        return BLACK
    transmittance, length = bsdf.colour(colour, None), bsdf.value(float, distance)
    if not all(0 < x <= 1 for x in transmittance) or length <= 0:
        what = f"{colour} = {transmittance} after {distance} = {length}"
        raise bsdf.error(what, "colours above 0 and up to 1, a length")
    r, g, b = (-math.log(x) / length for x in transmittance)
    return r, g, b


def _colours(node: Node, name: str, default: float | None) -> tuple[tuple[Colour, ...], tuple[float, float] | None]:
    """Return one colour and None, or the two colours of a checkerboard and the scales of its uv."""
    texture = node.take(name)
    if not isinstance(texture, Node):
        return (node.colour(name, default),), None
    if texture.type != "checkerboard":
        raise texture.error(f"a texture for the {name}", "checkerboard")
    colours = texture.colour("color0", 0.4), texture.colour("color1", 0.2)
    matrix = texture.transform("to_uv")
    texture.finish()
    if not (matrix == np.diag(matrix.diagonal())).all() or not (matrix[[0, 1], [0, 1]] > 0).all():
        raise texture.error("to_uv rotates or translates", "a scale")
    return colours, (float(matrix[0, 0]), float(matrix[1, 1]))
