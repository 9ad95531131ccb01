"""Read a Mitsuba XML file as a plain scene: `load("scenes/prism.xml", res="64")`."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from mi_refract.io.image_file import read_exr

from .meshes_from_shapes import MOST, meshes_of_shape, with_unique_names
from .mitsuba_nodes import Node, SceneFile
from .plain_scene import Camera, Colour, Environment, Mesh, PlainScene

LEVEL = 5  # of the tessellation: spheres of 20480 triangles, circles of 256 segments
LEVELS = range(9)
INTEGRATORS = ("path", "refract_path", "prb", "volpath", "prbvolpath")


def load(path: str | os.PathLike[str], *, level: int = LEVEL, **defines: str) -> PlainScene:
    """The scene in a file, read by the active variant. `defines` replace its `<default>`s.

    `level`: of the tessellation of curved shapes; one more halves the edges. FileNotFoundError for a missing file.
    ValueError, one line, for a file that is no scene, and for what a plain scene cannot hold: other plugins or
    parameters, smooth normals, one-sided surfaces that are open.
    """
    path = Path(path)
    if level not in LEVELS:
        raise ValueError(f"level = {level}; expected a whole number from {LEVELS[0]} to {LEVELS[-1]}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such scene file")
    root = SceneFile(path, defines).node(0)
    shapes: list[Mesh] = []
    camera: Camera | None = None
    max_depth: int | None = None
    sky: Colour | Environment | None = None
    for child in sorted(root.children(), key=lambda child: child.kind == "Shape"):  # the camera before the shapes
        if child.kind == "Shape":
            eye = np.array(camera.origin) if camera else None
            shapes += meshes_of_shape(child, level, MOST - sum(len(mesh.faces) for mesh in shapes), eye)
        elif child.kind == "Sensor" and camera is None:
            camera = _camera(child)
        elif child.kind == "Integrator" and max_depth is None:
            if child.type not in INTEGRATORS:
                raise child.error("this integrator is not supported", ", ".join(INTEGRATORS))
            max_depth = child.value(int, "max_depth", -1)
            if max_depth < 1:
                raise child.error(f"max_depth = {max_depth}", "a positive whole number")
            if child.value(bool, "hide_emitters", False):
                raise child.error("hide_emitters", "false")
            child.ignore("rr_depth")
            child.finish()
        elif child.kind == "Emitter" and sky is None:
            sky = _sky(child)
        elif child.kind != "BSDF":  # a named BSDF is read with the shapes that use it
            raise child.error(f"one {child.kind.lower()} too many", "shapes, and one sensor, integrator and sky")
    root.finish()
    if camera is None:
        raise ValueError(f"{path}: no sensor; expected a scene with one")
    if max_depth is None:
        raise ValueError(f"{path}: no integrator; expected a scene with one")
    return PlainScene(path.stem, with_unique_names(shapes), sky or (0.0, 0.0, 0.0), camera, max_depth)


def _camera(sensor: Node) -> Camera:
    """A perspective sensor. Clip planes are ignored: they are assumed to cut nothing away."""
    if sensor.type != "perspective":
        raise sensor.error("this sensor is not supported", "perspective")
    frame = sensor.transform()
    width = height = 0
    for child in sensor.children():
        if child.kind == "Film":
            if filters := [kernel for kernel in child.children() if kernel.type != "box"]:
                raise filters[0].error("a reconstruction filter", "box")
            child.ignore("pixel_format", "component_format", "file_format")
            width, height = child.value(int, "width", 768), child.value(int, "height", 576)
            if min(width, height) < 1:
                raise child.error(f"{width} × {height} pixels", "at least one")
            child.finish()
        elif child.kind != "Sampler":
            raise child.error(f"a {child.kind.lower()} of a sensor", "a film and a sampler")
    sensor.ignore("near_clip", "far_clip", "focus_distance")
    axes, origin = frame[:3, :3] / np.linalg.norm(frame[:3, :3], axis=0), frame[:3, 3]
    (x, y, z), (to_x, to_y, to_z), (up_x, up_y, up_z) = np.stack([origin, origin + axes[:, 2], axes[:, 1]]).tolist()
    fov, axis = sensor.value(float, "fov"), sensor.value(str, "fov_axis", "x")
    if not 0 < fov < 180:
        raise sensor.error(f"fov = {fov}", "an angle of 0 to 180 degrees")
    lengths = {"x": width, "y": height, "diagonal": math.hypot(width, height)}
    lengths |= {"smaller": min(width, height), "larger": max(width, height)}
    if axis not in lengths:
        raise sensor.error(f"fov_axis = {axis!r}", ", ".join(lengths))
    fov_x = math.degrees(2 * math.atan(math.tan(math.radians(fov) / 2) * width / lengths[axis]))
    sensor.finish()
    return Camera((x, y, z), (to_x, to_y, to_z), (up_x, up_y, up_z), fov_x, width, height)


def _sky(emitter: Node) -> Colour | Environment:
    sky: Colour | Environment
    if emitter.type == "constant":
        sky = emitter.colour("radiance", 1.0)
    elif emitter.type == "envmap":
        path, scale = emitter.scene.resolve(emitter.value(str, "filename")), emitter.value(float, "scale", 1.0)
        try:
            pixels = read_exr(path)[0]
        except (OSError, ValueError) as error:
            raise emitter.error(str(error), "an OpenEXR file") from None
        if pixels.shape[2] != 3 or min(pixels.shape[:2]) < 2 or not np.isfinite(pixels).all() or (pixels < 0).any():
            raise emitter.error(f"{path}: {pixels.shape[1]} × {pixels.shape[0]} × {pixels.shape[2]}", "finite RGB")
        rotation = emitter.transform()[:3, :3]
        if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-9):
            raise emitter.error("to_world is not a rotation", "a rotation")
        sky = Environment(scale * pixels, rotation)
    else:
        raise emitter.error("this emitter is not supported", "constant, envmap, and area on a shape")
    emitter.ignore("sampling_weight", "mis_compensation")
    emitter.finish()
    return sky
