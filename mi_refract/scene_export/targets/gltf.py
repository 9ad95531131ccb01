"""glTF 2.0 with Khronos' extensions for glass: `scene.glb`, and the same scene as `scene.gltf`."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mi_refract import __version__
from mi_refract.io.errors import ExportError, MissingExtraError

from ..plain_scene import (
    LINES,
    WAVELENGTHS,
    Diffuse,
    DirectionalLamp,
    Environment,
    Glass,
    Lamp,
    Light,
    Material,
    Mesh,
    PlainScene,
    PointLamp,
    SpotLamp,
    VolumeGlass,
)
from ..tessellation import Vertices, encloses, is_closed
from .shared_files import LIGHT_INSIDE, Axes, Files, exr, frame, outermost_index, outward, readme, sky_exr, turned

COMMANDS = """
scene.glb     the scene without its sky, in one file
scene.gltf    the same as JSON, with gltf_buffer.bin
sky.exr       the sky, by longitude and latitude, because glTF has none. Absent if the sky is black
"""
ASSUMPTIONS = (
    "glTF has no path depth, image size or filter. Use max_depth = {depth} (2 is light, one surface, camera), "
    "{width} x {height} pixels and a box filter. The scene's extras contain max_depth and the size, too.",
    "sky.exr holds linear radiance. Its top row is seen in direction +y, its middle column in +x, and columns to the "
    "right of it turn to +z, as in the equirectangular maps of three.js, and in Blender after its import.",
    "Indices are relative to the medium around all glass, {outside!r}, because glTF has 1 there.",
    "thicknessFactor is 4 V/S, the mean chord of a convex body. A path tracer only uses that it is not 0.",
    "A radiance of 1 is one candela per square metre in glTF, and a unit of the scene is one metre.",
    "A light that is open or faces inward has a black surface {offset:.3g} behind it: renderers disagree on how the "
    "back of a one-sided light looks.",
    "Diffuse surfaces have specularFactor = 0 and ior = 1. A renderer that ignores both gives them a glossy coat.",
    LIGHT_INSIDE,
)
SKY_AXES: Axes = (-1, 0, 0), (0, 0, -1), (0, 1, 0)  # of three.js
BLACK = (0.0, 0.0, 0.0)
BACK = 1e-5  # distance of a light's back, in units of its largest coordinate: about a hundred float32 roundoffs
# attenuationDistance in units of 1/σ. Blender uses σ = (1 − c)/distance instead of −log(c)/distance, where c is
# attenuationColor: a relative error of SHORT/2. Rounding c to float32 changes σ by 2^-24/SHORT.
SHORT = 2.0**-10
PUNCTUAL = "KHR_lights_punctual"
EDGE = 1e-3  # least width of a spot's edge, in units of its angle: glTF has no sharp edge
LEAST_NEAR = 1e-6  # near plane of a camera that lies on a surface


def files(plain: PlainScene) -> Files:
    """Return the export's files by name. ExportError for what glTF cannot hold, MissingExtraError without trimesh."""
    try:
        import trimesh
        from trimesh.exchange import gltf
    except ModuleNotFoundError:
        raise MissingExtraError("glTF needs trimesh: pip install 'mi-refract[gltf]'") from None
    for lamp in plain.lamps:
        if isinstance(lamp, SpotLamp) and lamp.cutoff_degrees > 90:
            angle = f"cutoff_angle = {lamp.cutoff_degrees:g} degrees"
            raise ExportError(f"{plain.name}: {lamp.name}: {angle}; expected at most 90 degrees, the limit of glTF")
    plain = outward(plain)
    outside = outermost_index(plain)
    oriented = [_around_glass(plain, mesh, outside) for mesh in plain.meshes]
    # Triangles of area 0 have no normal.
    oriented = [replace(mesh, faces=mesh.faces[np.linalg.norm(_areas(mesh), axis=1) > 0]) for mesh in oriented]
    meshes = [mesh for mesh in oriented if len(mesh.faces)]
    lights = [mesh for mesh in meshes if isinstance(mesh.material, Light)]
    offsets = {mesh.name: BACK * float(np.abs(mesh.vertices).max()) for mesh in lights}
    backs = [_back(mesh, offsets[mesh.name]) for mesh in lights]
    exported = [*_with_hollows(plain, meshes), *(back for back in backs if back)]
    materials = list(dict.fromkeys(mesh.material for mesh in exported))
    camera = plain.camera
    scene = trimesh.Scene(metadata={"max_depth": plain.max_depth, "width": camera.width, "height": camera.height})
    for mesh in map(_with_normals, exported):
        geometry = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False)
        scene.add_geometry(geometry, node_name=mesh.name, geom_name=mesh.name)
    forward = np.subtract(camera.target, camera.origin)
    right = np.cross(forward, camera.up)
    axes = np.stack([right, np.cross(right, forward), -forward], axis=1)
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = axes / np.linalg.norm(axes, axis=0), camera.origin
    # No mesh may have the name of the camera's node: the names of meshes have no hyphen, except in "-back". The angles
    # are replaced below.
    scene.camera = trimesh.scene.Camera("camera-node", fov=(1.0, 1.0))
    scene.camera_transform = to_world
    half_height = math.tan(math.radians(camera.fov_x_degrees) / 2) * camera.height / camera.width
    corners = np.concatenate([mesh.triangles() for mesh in meshes]) if meshes else np.empty((0, 3, 3))
    nearest = trimesh.triangles.closest_point(corners, np.broadcast_to(camera.origin, (len(corners), 3)))
    near = float(np.linalg.norm(nearest - camera.origin, axis=1).min(initial=1.0)) / 2 or LEAST_NEAR
    view = {"aspectRatio": camera.width / camera.height, "yfov": 2 * math.atan(half_height), "znear": near}

    def complete(tree: dict[str, Any]) -> None:
        """Add what trimesh does not write."""
        tree["asset"]["generator"] = f"mi_refract {__version__} by trimesh {trimesh.__version__}"
        tree["cameras"] = [{"name": "camera", "type": "perspective", "perspective": view}]
        for mesh, entry in zip(exported, tree.get("meshes", []), strict=True):
            (primitive,) = entry["primitives"]
            primitive["material"] = materials.index(mesh.material)
            for accessor in primitive["attributes"].values():  # accessors of equal data share a bufferView
                tree["bufferViews"][tree["accessors"][accessor]["bufferView"]]["byteStride"] = 12
        if materials:
            tree["materials"] = [_material(f"material{i}", x, meshes) for i, x in enumerate(materials)]
        extensions = {name for entry in tree.get("materials", []) for name in entry["extensions"]}
        if plain.lamps:
            tree["extensions"] = {PUNCTUAL: {"lights": [_punctual(lamp) for lamp in plain.lamps]}}
            count = len(tree["nodes"])
            tree["scenes"][0]["nodes"] += range(count, count + len(plain.lamps))
            for i, lamp in enumerate(plain.lamps):  # a lamp emits along its node's −z
                matrix = (frame(lamp) * [1, -1, -1, 1]).T.ravel().tolist()
                tree["nodes"].append({"name": lamp.name, "matrix": matrix, "extensions": {PUNCTUAL: {"light": i}}})
            extensions.add(PUNCTUAL)
        if extensions:
            tree["extensionsUsed"] = sorted(extensions)

    glb: bytes = gltf.export_glb(scene, include_normals=True, tree_postprocessor=complete)
    start, end = 20, 20 + int.from_bytes(glb[12:16], "little")  # position of the JSON, by the specification
    tree = json.loads(glb[start:end])
    tree.get("buffers", [{}])[0]["uri"] = "gltf_buffer.bin"
    contents = {
        "scene.glb": glb,
        "scene.gltf": json.dumps(tree, separators=(",", ":")).encode(),
        "gltf_buffer.bin": glb[end + 8 :],
    }
    sky = sky_exr(plain, SKY_AXES)
    if not isinstance(plain.sky, Environment) and any(plain.sky):
        sky = {"sky.exr": exr(np.full((4, 8, 3), plain.sky, np.float32))}
    values = {"depth": plain.max_depth, "width": camera.width, "height": camera.height, "outside": outside}
    notes = [text.format(**values, offset=max(offsets.values(), default=0.0)) for text in ASSUMPTIONS]
    notes += _notes_on_meshes(meshes) + _notes_on_lamps(plain.lamps)
    return contents | sky | {"README.txt": readme(plain, "a glTF renderer", COMMANDS, notes, "")}


def _around_glass(plain: PlainScene, mesh: Mesh, outside: float) -> Mesh:
    """Return the mesh; glass is turned so that its normals point out of the glass, into the outermost medium."""
    material, place = mesh.material, f"{plain.name}: {mesh.name}"
    if isinstance(material, Diffuse) and max(material.reflectance) > 1:
        raise ExportError(f"{place}: reflectance = {material.reflectance}; expected at most 1 in glTF")
    if not isinstance(material, Glass):
        return mesh
    if not is_closed(mesh.faces):
        raise ExportError(f"{place}: glass with an open surface; expected a closed one: glTF's volumes are bounded")
    if not math.isclose(material.ext_ior, outside, rel_tol=1e-12):  # a hollow of the glass, or another glass
        mesh = turned(mesh)
        material = mesh.material
        assert isinstance(material, Glass)
    if not math.isclose(material.ext_ior, outside, rel_tol=1e-12):
        expected = f"expected the medium around all glass, {outside!r}, on one side, as in glTF"
        raise ExportError(f"{place}: media of {material.int_ior!r} and {material.ext_ior!r} touch; {expected}")
    if material.int_ior < outside:
        index = f"index {material.int_ior!r} is below {outside!r}, that of the medium around all glass"
        raise ExportError(f"{place}: {index}; expected at least that: glTF requires ior >= 1")
    if isinstance(material, VolumeGlass):
        if any(material.ext_sigma):
            fault = "the medium around all glass absorbs"
            raise ExportError(f"{place}: {material.parameters}: {fault}; expected no absorption there")
        if material.spectrum and not 0 < _abbe(material) < math.inf:
            raise ExportError(f"{place}: {material.parameters}; expected an index that falls with the wavelength")
    return mesh


def _with_hollows(plain: PlainScene, meshes: Sequence[Mesh]) -> list[Mesh]:
    """Return the meshes, with each hollow merged into the glass around it: in glTF one mesh bounds a volume."""
    bodies = {mesh.name: mesh for mesh in meshes}
    glasses = [mesh for mesh in meshes if isinstance(mesh.material, Glass)]
    solids = sorted((mesh for mesh in glasses if mesh.volume() > 0), key=Mesh.volume)
    for hollow in (mesh for mesh in glasses if mesh.volume() <= 0):
        del bodies[hollow.name]
        candidates = (mesh for mesh in solids if mesh.material == hollow.material)
        solid = next((mesh for mesh in candidates if encloses(mesh.triangles(), hollow.vertices[0])), None)
        if solid is None:
            raise ExportError(f"{plain.name}: {hollow.name}: a hollow; expected the same glass around it")
        outer, inner = _with_normals(bodies[solid.name]), _with_normals(hollow)
        assert outer.normals is not None and inner.normals is not None
        vertices = np.concatenate([outer.vertices, inner.vertices])
        faces = np.concatenate([outer.faces, inner.faces + len(outer.vertices)])
        normals = np.concatenate([outer.normals, inner.normals])
        bodies[solid.name] = replace(outer, vertices=vertices, faces=faces, normals=normals)
    return list(bodies.values())


def _with_normals(mesh: Mesh) -> Mesh:
    """Return the mesh with normals at its vertices; each face of a flat mesh gets its own three vertices."""
    if mesh.normals is not None:
        return mesh
    normals, faces = np.repeat(_facet_normals(mesh), 3, axis=0), np.arange(mesh.faces.size).reshape(-1, 3)
    return replace(mesh, vertices=mesh.triangles().reshape(-1, 3), faces=faces, normals=normals)


def _back(lamp: Mesh, offset: float) -> Mesh | None:
    """Return a black surface behind a light; None for a closed light that faces outward: its back is invisible."""
    if is_closed(lamp.faces) and lamp.volume() > 0:
        return None
    front = _with_normals(lamp)
    assert front.normals is not None
    vertices = front.vertices - offset * front.normals
    return Mesh(f"{lamp.name}-back", vertices, front.faces[:, ::-1], Light(BLACK), -front.normals)


def _areas(mesh: Mesh) -> Vertices:
    """Return the triangles' normals (F, 3), whose lengths are the areas."""
    a, b, c = mesh.triangles().swapaxes(0, 1)
    return np.cross(b - a, c - a) / 2


def _facet_normals(mesh: Mesh) -> Vertices:
    areas = _areas(mesh)
    return np.asarray(areas / np.linalg.norm(areas, axis=1, keepdims=True))


def _material(name: str, material: Material, meshes: Iterable[Mesh]) -> dict[str, Any]:
    """Return an entry of "materials". `meshes`: thicknessFactor is the mean chord of those that have the material."""
    base = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.0}
    entry: dict[str, Any] = {"name": name, "pbrMetallicRoughness": base, "doubleSided": isinstance(material, Diffuse)}
    if isinstance(material, Glass):
        n = material.int_ior / material.ext_ior
        parts = [mesh for mesh in meshes if mesh.material == material]
        surface = sum(np.linalg.norm(_areas(mesh), axis=1).sum() for mesh in parts)
        volume: dict[str, Any] = {"thicknessFactor": float(4 * sum(map(Mesh.volume, parts)) / surface)}
        entry["extensions"] = {
            "KHR_materials_transmission": {"transmissionFactor": 1.0},
            "KHR_materials_ior": {"ior": n},
            "KHR_materials_volume": volume,
        }
        if isinstance(material, VolumeGlass):
            if any(material.int_sigma):  # exp(−σ t) = colour^(t/distance)
                distance = SHORT / max(material.int_sigma)
                volume["attenuationDistance"] = distance
                volume["attenuationColor"] = [math.exp(-x * distance) for x in material.int_sigma]
            if material.spectrum:
                entry["extensions"]["KHR_materials_dispersion"] = {"dispersion": 20 / _abbe(material)}
        return entry
    colour = material.reflectance if isinstance(material, Diffuse) else BLACK
    base["baseColorFactor"] = [*colour, 1.0]
    entry["extensions"] = {"KHR_materials_specular": {"specularFactor": 0.0}, "KHR_materials_ior": {"ior": 1.0}}
    if isinstance(material, Light):
        strength = max(1.0, *material.radiance)
        entry["emissiveFactor"] = [x / strength for x in material.radiance]
        if strength > 1:
            entry["extensions"]["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}
    return entry


def _punctual(lamp: Lamp) -> dict[str, Any]:
    """Return an entry of "lights": 1 W/sr is one candela, 1 W/m² one lux, as a radiance of 1 is one candela per m²."""
    assert isinstance(lamp, PointLamp | DirectionalLamp)
    colour = lamp.irradiance if isinstance(lamp, DirectionalLamp) else lamp.intensity
    strength = max(colour)
    entry = {"name": lamp.name, "type": lamp.kind, "intensity": strength}
    if strength:
        entry["color"] = [x / strength for x in colour]
    if isinstance(lamp, SpotLamp):
        inner, outer = map(math.radians, _cone(lamp))
        entry["spot"] = {"innerConeAngle": inner, "outerConeAngle": outer}
    return entry


def _cone(lamp: SpotLamp) -> tuple[float, float]:
    """Return the angles between which the intensity falls to 0, in degrees."""
    return min(lamp.beam_degrees, (1 - EDGE) * lamp.cutoff_degrees), lamp.cutoff_degrees


def _abbe(material: VolumeGlass) -> float:
    """Return Abbe's number V = (n_d − 1)/(n_F − n_C) of the relative index; infinite without dispersion."""
    f, d, c = material.spectrum[: len(LINES)]
    return (d - 1) / (f - c) if f != c else math.inf


def _notes_on_meshes(meshes: Sequence[Mesh]) -> list[str]:
    """Return the notes in README.txt on the facets of round shapes and on dispersion."""
    notes, angles = [], {mesh.name: _angular_error(mesh) for mesh in meshes if mesh.normals is not None}
    if angles:
        widest = max(angles, key=lambda name: angles[name])
        notes.append(
            "Spheres and cylinders have the normals of the round surface at their vertices. Facets are flat: the "
            f"largest angle between the normals of a facet and of the surface is {math.degrees(angles[widest]):.4f} "
            f"degrees ({widest}). Each level halves it. Renderers refract at the interpolated normals of the vertices; "
            "Mitsuba, in the export for it, refracts at the facets."
        )
    for material in dict.fromkeys(mesh.material for mesh in meshes):
        if isinstance(material, VolumeGlass) and material.spectrum:
            n, v = np.array(material.spectrum), _abbe(material)
            n_d = n[LINES.index("d")]
            # The formula of KHR_materials_dispersion, with its constants.
            n_gltf = n_d + (n_d - 1) / v * (523655 / np.square(WAVELENGTHS) - 1.5168)
            name = next(mesh.name for mesh in meshes if mesh.material == material)
            notes.append(
                f"{name}: {material.parameters} becomes Abbe's number {v:.4g}, because glTF has no other formula. From "
                f"400 to 700 nm its index differs from the scene's by up to {np.abs(n_gltf - n).max():.2g}."
            )
    return notes


def _notes_on_lamps(lamps: Sequence[Lamp]) -> list[str]:
    """Return the notes in README.txt on lamps without size: their units, and the falloff of spots."""
    if not lamps:
        return []
    notes = [
        "Lamps without size use KHR_lights_punctual, without a range: Mitsuba's 1 W/sr is one candela, 1 W/m^2 one "
        "lux. In Blender's importer they match lamps with a size only in the lighting mode Unitless (COMPAT); the "
        "Standard mode divides them by 683."
    ]
    for lamp in lamps:
        if isinstance(lamp, SpotLamp):
            inner, outer = _cone(lamp)
            angle = np.linspace(inner, outer, 1001)
            ours = np.interp(angle, [lamp.beam_degrees, outer], [1, 0])
            cosine, low, high = (np.cos(np.radians(x)) for x in (angle, outer, inner))
            sample = np.clip((cosine - low) / max(0.001, high - low), 0, 1) ** 2  # sample code of the extension
            notes.append(
                f"{lamp.name}: from {inner:.6g} to {outer:g} degrees glTF leaves the falloff to the renderer. The "
                "sample code of the extension differs from the scene by up to "
                f"{np.abs(sample - ours).max():.2g} of the intensity."
            )
    return notes


def _angular_error(mesh: Mesh) -> float:
    """Return the largest angle between the normals of a facet and of its corners, in radians."""
    assert mesh.normals is not None
    facets = _facet_normals(mesh)[:, None]
    corners = mesh.normals[mesh.faces]
    sines = np.linalg.norm(np.cross(facets, corners), axis=-1)
    return float(np.arctan2(sines, (facets * corners).sum(-1)).max())
