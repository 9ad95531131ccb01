"""glTF 2.0 with Khronos' extensions for glass: `scene.glb`, and the same as `scene.gltf`."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mi_refract import __version__
from mi_refract.io.errors import MissingExtraError

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
scene.glb     all of the scene but its sky, in one file
scene.gltf    the same as JSON, with gltf_buffer.bin
sky.exr       the sky, by longitude and latitude; glTF holds none. Absent where the sky is black
"""
ASSUMPTIONS = (
    "glTF holds no depth of paths, no size of the image and no filter: max_depth = {depth} (2 is light, one surface, "
    "camera), {width} x {height} pixels, a box filter. extras of the scene say the same.",
    "sky.exr holds linear radiance. Its top row is seen in direction +y, its middle column in +x, and columns to the "
    "right of it turn to +z, as in the equirectangular maps of three.js, and in Blender after its import.",
    "Indices are relative to the medium around all glass, {outside!r}, because glTF has 1 there.",
    "thicknessFactor is 4 V/S, the mean chord of a convex body. A path tracer does not use it, only that it is not 0.",
    "A radiance of 1 is one candela per square metre there, and a unit of the scene is one metre.",
    "A light that is open has a black back, {offset:.3g} behind it: renderers disagree on what the back of a one-sided "
    "light shows.",
    "Diffuse surfaces have specularFactor = 0 and ior = 1. A renderer that ignores both gives them a glossy coat.",
    LIGHT_INSIDE,
)
SKY_AXES: Axes = (-1, 0, 0), (0, 0, -1), (0, 1, 0)  # of three.js
BLACK = (0.0, 0.0, 0.0)
BACK = 1e-5  # of the lamp's largest coordinate: some hundred roundoffs of float32
# Of 1/σ, the distance of attenuationColor c: Blender takes σ = (1 − c)/distance for −log(c)/distance, off by SHORT/2;
# c rounded to float32 is off by 2^-24/SHORT in σ.
SHORT = 2.0**-10
PUNCTUAL = "KHR_lights_punctual"
EDGE = 1e-3  # of a spot's angle: glTF has no sharp edge
LEAST_NEAR = 1e-6  # the near plane of a camera that lies on a surface


def files(plain: PlainScene) -> Files:
    """The files of the export, by name. ValueError for what glTF cannot hold, MissingExtraError without trimesh."""
    try:
        import trimesh
        from trimesh.exchange import gltf
    except ModuleNotFoundError:
        raise MissingExtraError("glTF needs trimesh: pip install 'mi-refract[gltf]'") from None
    for lamp in plain.lamps:
        if isinstance(lamp, SpotLamp) and lamp.cutoff_degrees > 90:
            wide = f"cutoff_angle = {lamp.cutoff_degrees:g} degrees"
            raise ValueError(f"{plain.name}: {lamp.name}: {wide}; expected at most 90, as glTF has it")
    plain = outward(plain)
    outside = outermost_index(plain)
    turned = (_around_glass(plain, mesh, outside) for mesh in plain.meshes)
    meshes = [mesh for mesh in map(_without_slivers, turned) if len(mesh.faces)]
    lit = [mesh for mesh in meshes if isinstance(mesh.material, Light)]
    lamps = {mesh.name: BACK * float(np.abs(mesh.vertices).max()) for mesh in lit}
    backs = [_back(mesh, lamps[mesh.name]) for mesh in lit]
    shown = [*_with_hollows(plain, meshes), *(back for back in backs if back)]
    materials = list(dict.fromkeys(mesh.material for mesh in shown))
    camera, extras = plain.camera, {"max_depth": plain.max_depth, "width": plain.camera.width}
    scene = trimesh.Scene(metadata=extras | {"height": camera.height})
    for mesh in map(_with_normals, shown):
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False)
        scene.add_geometry(solid, node_name=mesh.name, geom_name=mesh.name)
    ahead = np.subtract(camera.target, camera.origin)
    right = np.cross(ahead, camera.up)
    axes = np.stack([right, np.cross(right, ahead), -ahead], axis=1)
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = axes / np.linalg.norm(axes, axis=0), camera.origin
    scene.camera = trimesh.scene.Camera("camera", fov=(1.0, 1.0))  # its angles are replaced below
    scene.camera_transform = place
    high = math.tan(math.radians(camera.fov_x_degrees) / 2) * camera.height / camera.width
    corners = np.concatenate([mesh.triangles() for mesh in meshes]) if meshes else np.empty((0, 3, 3))
    nearest = trimesh.triangles.closest_point(corners, np.broadcast_to(camera.origin, (len(corners), 3)))
    near = float(np.linalg.norm(nearest - camera.origin, axis=1).min(initial=1.0)) / 2 or LEAST_NEAR
    view = {"aspectRatio": camera.width / camera.height, "yfov": 2 * math.atan(high), "znear": near}

    def complete(tree: dict[str, Any]) -> None:
        """Put in what trimesh has no words for."""
        tree["asset"]["generator"] = f"mi_refract {__version__} by trimesh {trimesh.__version__}"
        tree["cameras"] = [{"name": "camera", "type": "perspective", "perspective": view}]
        for mesh, made in zip(shown, tree.get("meshes", []), strict=True):
            (part,) = made["primitives"]
            part["material"] = materials.index(mesh.material)
            for accessor in part["attributes"].values():  # which share a view where their numbers are the same
                tree["bufferViews"][tree["accessors"][accessor]["bufferView"]]["byteStride"] = 12
        if materials:
            tree["materials"] = [_material(f"material{i}", each, meshes) for i, each in enumerate(materials)]
        used = {name for entry in tree.get("materials", []) for name in entry["extensions"]}
        if plain.lamps:
            tree["extensions"] = {PUNCTUAL: {"lights": [_punctual(lamp) for lamp in plain.lamps]}}
            count = len(tree["nodes"])
            tree["scenes"][0]["nodes"] += range(count, count + len(plain.lamps))
            tree["nodes"] += [_placed(i, lamp) for i, lamp in enumerate(plain.lamps)]
            used.add(PUNCTUAL)
        if used:
            tree["extensionsUsed"] = sorted(used)

    single: bytes = gltf.export_glb(scene, include_normals=True, tree_postprocessor=complete)
    start, end = 20, 20 + int.from_bytes(single[12:16], "little")  # of the JSON, by the specification
    tree = json.loads(single[start:end])
    tree.get("buffers", [{}])[0]["uri"] = "gltf_buffer.bin"
    several = {"scene.gltf": json.dumps(tree, separators=(",", ":")).encode(), "gltf_buffer.bin": single[end + 8 :]}
    sky = sky_exr(plain, SKY_AXES)
    if not isinstance(plain.sky, Environment) and any(plain.sky):
        sky = {"sky.exr": exr(np.full((4, 8, 3), plain.sky, np.float32))}
    values = {"depth": plain.max_depth, "width": camera.width, "height": camera.height, "outside": outside}
    said = [text.format(**values, offset=max(lamps.values(), default=0.0)) for text in ASSUMPTIONS] + _said(meshes)
    said += _said_of_lamps(plain.lamps)
    return several | sky | {"scene.glb": single, "README.txt": readme(plain, "a glTF renderer", COMMANDS, said, "")}


def _around_glass(plain: PlainScene, mesh: Mesh, outside: float) -> Mesh:
    """The mesh; of glass, turned so that its normals point out of the glass, into the medium around all of it."""
    material, place = mesh.material, f"{plain.name}: {mesh.name}"
    if isinstance(material, Diffuse) and max(material.reflectance) > 1:
        raise ValueError(f"{place}: reflectance = {material.reflectance}; expected at most 1 in glTF")
    if not isinstance(material, Glass):
        return mesh
    if not is_closed(mesh.faces):
        raise ValueError(f"{place}: glass with an open surface; expected a closed one: glTF's volumes are bounded")
    if not math.isclose(material.ext_ior, outside, rel_tol=1e-12):  # a hollow of the glass, or another glass
        mesh = turned(mesh)
        material = mesh.material
        assert isinstance(material, Glass)
    if not math.isclose(material.ext_ior, outside, rel_tol=1e-12):
        two = f"media of {material.int_ior!r} and {material.ext_ior!r} touch"
        raise ValueError(
            f"{place}: {two}; expected {outside!r}, the medium around all glass, on one side: glTF has no other"
        )
    if material.int_ior < outside:
        raise ValueError(
            f"{place}: index {material.int_ior!r} in {outside!r}; expected a glass of at least that: glTF's ior >= 1"
        )
    if isinstance(material, VolumeGlass):
        if any(material.ext_sigma):
            raise ValueError(
                f"{place}: {material.said}: the medium around all glass absorbs; expected one that does not"
            )
        if material.spectrum and not 0 < _abbe(material) < math.inf:
            raise ValueError(f"{place}: {material.said}; expected an index that falls with the wavelength")
    return replace(mesh, material=material)


def _with_hollows(plain: PlainScene, meshes: Sequence[Mesh]) -> list[Mesh]:
    """The meshes, with each hollow a part of the glass around it: a volume is what one mesh bounds."""
    bodies = {mesh.name: mesh for mesh in meshes}
    glasses = [mesh for mesh in meshes if isinstance(mesh.material, Glass)]
    solids = sorted((mesh for mesh in glasses if _volume(mesh) > 0), key=_volume)
    for hollow in (mesh for mesh in glasses if _volume(mesh) <= 0):
        del bodies[hollow.name]
        around = (each for each in solids if each.material == hollow.material)
        solid = next((each for each in around if encloses(each.triangles(), hollow.vertices[0])), None)
        if solid is None:
            raise ValueError(f"{plain.name}: {hollow.name}: a hollow; expected the same glass around it")
        one, other = _with_normals(bodies[solid.name]), _with_normals(hollow)
        vertices, normals = (
            np.concatenate([getattr(x, name) for x in (one, other)]) for name in ("vertices", "normals")
        )
        faces = np.concatenate([one.faces, other.faces + len(one.vertices)])
        bodies[solid.name] = replace(one, vertices=vertices, faces=faces, normals=normals)
    return list(bodies.values())


def _with_normals(mesh: Mesh) -> Mesh:
    """The mesh; a flat one with the normals of its faces, and so with corners of its own for each of them."""
    if mesh.normals is not None:
        return mesh
    normals, faces = np.repeat(_facet_normals(mesh), 3, axis=0), np.arange(mesh.faces.size).reshape(-1, 3)
    return replace(mesh, vertices=mesh.triangles().reshape(-1, 3), faces=faces, normals=normals)


def _volume(mesh: Mesh) -> float:
    return float(np.linalg.det(mesh.triangles()).sum() / 6)


def _back(lamp: Mesh, offset: float) -> Mesh | None:
    """A black surface behind a lamp; None where it is closed, so that nobody sees it from behind."""
    if is_closed(lamp.faces):
        return None
    front = _with_normals(lamp)
    assert front.normals is not None
    places, normals, faces = front.vertices - offset * front.normals, -front.normals, front.faces[:, ::-1]
    return Mesh(f"{lamp.name}-back", places, faces, Light(BLACK), normals)


def _areas(mesh: Mesh) -> Vertices:
    """(F, 3): normals of the triangles, as long as they are large."""
    a, b, c = mesh.triangles().swapaxes(0, 1)
    return np.cross(b - a, c - a) / 2


def _without_slivers(mesh: Mesh) -> Mesh:
    """The mesh without triangles that have no area, and so no normal."""
    return replace(mesh, faces=mesh.faces[np.linalg.norm(_areas(mesh), axis=1) > 0])


def _facet_normals(mesh: Mesh) -> Vertices:
    areas = _areas(mesh)
    return np.asarray(areas / np.linalg.norm(areas, axis=1, keepdims=True))


def _material(name: str, material: Material, meshes: Iterable[Mesh]) -> dict[str, Any]:
    """An entry of "materials". `meshes`: by whose chords the glass is as thick as it is."""
    base = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.0}
    entry: dict[str, Any] = {"name": name, "pbrMetallicRoughness": base, "doubleSided": isinstance(material, Diffuse)}
    if isinstance(material, Glass):
        n = material.int_ior / material.ext_ior
        parts = [mesh for mesh in meshes if mesh.material == material]
        surface = sum(np.linalg.norm(_areas(mesh), axis=1).sum() for mesh in parts)
        volume: dict[str, Any] = {"thicknessFactor": float(4 * sum(map(_volume, parts)) / surface)}
        entry["extensions"] = {
            "KHR_materials_transmission": {"transmissionFactor": 1.0},
            "KHR_materials_ior": {"ior": n},
            "KHR_materials_volume": volume,
        }
        if isinstance(material, VolumeGlass):
            if sigma := max(material.int_sigma):  # exp(−σ t) = colour^(t/distance)
                distance = SHORT / sigma
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
    """An entry of "lights": 1 W/sr is one candela, 1 W/m² one lux, as a radiance of 1 is one candela per m²."""
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


def _placed(index: int, lamp: Lamp) -> dict[str, Any]:
    """The node of a lamp, which shines along its −z."""
    matrix = frame(lamp) * [1, -1, -1, 1]
    return {"name": lamp.name, "matrix": matrix.T.ravel().tolist(), "extensions": {PUNCTUAL: {"light": index}}}


def _cone(lamp: SpotLamp) -> tuple[float, float]:
    """The angles between which the intensity falls, in degrees."""
    return min(lamp.beam_degrees, (1 - EDGE) * lamp.cutoff_degrees), lamp.cutoff_degrees


def _abbe(material: VolumeGlass) -> float:
    """V = (n_d − 1)/(n_F − n_C) of the index relative to the medium around; infinite without dispersion."""
    f, d, c = material.spectrum[: len(LINES)]
    return (d - 1) / (f - c) if f != c else math.inf


def _said(meshes: Sequence[Mesh]) -> list[str]:
    """What README.txt says of these meshes: how flat the round ones are, and what their formulas become."""
    said, angles = [], {mesh.name: _angular_error(mesh) for mesh in meshes if mesh.normals is not None}
    if angles:
        widest = max(angles, key=lambda name: angles[name])
        said.append(
            "Spheres and cylinders have normals at their vertices, those of the round surface. Facets are flat: the "
            f"largest angle between a facet's normal and that of the surface is {math.degrees(angles[widest]):.4f} "
            f"degrees ({widest}). One level more halves it. Renderers refract at the normals of the vertices, "
            "interpolated; Mitsuba, as exported for it, at the facets."
        )
    for material in dict.fromkeys(mesh.material for mesh in meshes):
        if isinstance(material, VolumeGlass) and material.spectrum:
            n, v = np.array(material.spectrum), _abbe(material)
            d = n[LINES.index("d")]
            # The formula of KHR_materials_dispersion, with its constants.
            theirs = d + (d - 1) / v * (523655 / np.square(WAVELENGTHS) - 1.5168)
            name = next(mesh.name for mesh in meshes if mesh.material == material)
            said.append(
                f"{name}: {material.said} becomes Abbe's number {v:.4g}, because glTF has no other formula. From 400 "
                f"to 700 nm its index differs from the scene's by up to {np.abs(theirs - n).max():.2g}."
            )
    return said


def _said_of_lamps(lamps: Sequence[Lamp]) -> list[str]:
    """What README.txt says of lamps without size: their units, and what their cones become."""
    if not lamps:
        return []
    said = [
        "Lamps without size are those of KHR_lights_punctual, without a range: 1 W/sr of Mitsuba's is one candela, "
        "1 W/m^2 one lux. Blender's importer has them as bright as lamps with a size in its lighting mode Unitless "
        "(COMPAT) only; its Standard mode divides them by 683."
    ]
    for lamp in lamps:
        if isinstance(lamp, SpotLamp):
            inner, outer = _cone(lamp)
            angle = np.linspace(inner, outer, 1001)
            ours = np.interp(angle, [lamp.beam_degrees, outer], [1, 0])
            cosine, low, high = (np.cos(np.radians(x)) for x in (angle, outer, inner))
            theirs = np.clip((cosine - low) / max(0.001, high - low), 0, 1) ** 2  # the extension's sample
            said.append(
                f"{lamp.name}: from {inner:.6g} to {outer:g} degrees glTF leaves the falloff to the renderer. That of "
                f"the extension's sample differs from the scene's by up to {np.abs(theirs - ours).max():.2g} of the "
                "intensity."
            )
    return said


def _angular_error(mesh: Mesh) -> float:
    """The largest angle between the normals of a facet and of its corners, in radians."""
    assert mesh.normals is not None
    facets = _facet_normals(mesh)[:, None]
    corners = mesh.normals[mesh.faces]
    sines = np.linalg.norm(np.cross(facets, corners), axis=-1)
    return float(np.arctan2(sines, (facets * corners).sum(-1)).max())
