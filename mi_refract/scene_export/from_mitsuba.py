"""Read a Mitsuba XML file as a plain scene: `load("scenes/prism.xml", defines={"res": "64"})`."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mi_refract.io.image_file import read_exr

from .meshes_from_shapes import MOST, meshes_of_shape, with_unique_names
from .mitsuba_nodes import Node, SceneFile
from .plain_scene import Camera, Colour, DirectionalLamp, Environment, Lamp, Mesh, PlainScene, PointLamp, SpotLamp

LEVEL = 5  # default tessellation level: spheres of 20480 triangles, circles of 256 segments
LEVELS = range(9)
LAMPS = ("point", "spot", "directional")
SKY = "at least 2 × 2 pixels of R, G, B or X, Y, Z, finite and as Rec. 709 not negative"
CONVERSION = 1e-5  # relative error of Mitsuba's conversion to Rec. 709: its matrices have 7 digits
INTEGRATORS = ("path", "refract_path", "prb", "volpath", "prbvolpath")


def load(path: str | os.PathLike[str], *, level: int = LEVEL, defines: Mapping[str, str] | None = None) -> PlainScene:
    """Return the scene in a file, read by the active variant.

    `level`: tessellation level of curved shapes; each level halves the edges. `defines`: values that replace those of
    the file's `<default>`s. FileNotFoundError for a missing file. ExportError, one line, for content that a plain scene
    cannot hold: other plugins or parameters, smooth normals, open one-sided surfaces. ValueError, one line, for an
    invalid scene and for files that cannot be read.
    """
    path = Path(path)
    if level not in LEVELS:
        raise ValueError(f"level = {level}; expected a whole number from {LEVELS[0]} to {LEVELS[-1]}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such scene file")
    root = SceneFile(path, defines or {}).node(0)
    shapes: list[Mesh] = []
    lamps: list[Lamp] = []
    camera: Camera | None = None
    max_depth: int | None = None
    sky: Colour | Environment | None = None
    for child in sorted(root.children(), key=lambda child: child.kind == "Shape"):  # shapes last: they need the camera
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
        elif child.kind == "Emitter" and child.type in LAMPS:
            lamps.append(_lamp(child))
        elif child.kind == "Emitter" and sky is None:
            sky = _sky(child)
        elif child.kind not in ("BSDF", "Texture"):  # named ones are read with the shapes that use them
            raise child.error(f"one {child.kind.lower()} too many", "shapes, and one sensor, integrator and sky")
    root.finish()
    if camera is None:
        raise ValueError(f"{path}: no sensor; expected a scene with one")
    if max_depth is None:
        raise ValueError(f"{path}: no integrator; expected a scene with one")
    objects = with_unique_names([*shapes, *lamps])
    meshes = tuple(x for x in objects if isinstance(x, Mesh))
    renamed_lamps = tuple(x for x in objects if isinstance(x, Lamp))
    return PlainScene(path.stem, meshes, sky or (0.0, 0.0, 0.0), camera, max_depth, renamed_lamps)


def _camera(sensor: Node) -> Camera:
    """Read a perspective sensor. Clip planes are ignored: the export assumes that they remove nothing."""
    if sensor.type != "perspective":
        raise sensor.error("this sensor is not supported", "perspective")
    frame = sensor.transform()
    width = height = 0
    for child in sensor.children():
        if child.kind == "Film":
            kernel = next((kernel.type for kernel in child.children()), "gaussian, by default")
            if (child.type, kernel) != ("hdrfilm", "box"):
                raise child.error(f"a film with the filter {kernel}", "an hdrfilm with an rfilter box")
            child.ignore("pixel_format", "component_format", "file_format")
            width, height = child.value(int, "width", 768), child.value(int, "height", 576)
            if min(width, height) < 1:
                raise child.error(f"{width} × {height} pixels", "at least one")
            child.finish()
        elif child.kind != "Sampler":
            raise child.error(f"a {child.kind.lower()} of a sensor", "a film and a sampler")
    if not width:
        raise sensor.error("no film", "an hdrfilm with an rfilter box")
    sensor.ignore("near_clip", "far_clip", "focus_distance")
    axes, origin = frame[:3, :3] / np.linalg.norm(frame[:3, :3], axis=0), frame[:3, 3]
    # As far away as the coordinates are large: Cycles and LuxCore compute target − origin from points in float32.
    target = origin + max(1.0, np.linalg.norm(origin)) * axes[:, 2]
    fov, axis = sensor.value(float, "fov"), sensor.value(str, "fov_axis", "x")
    if not 0 < fov < 180:
        raise sensor.error(f"fov = {fov}", "an angle of 0 to 180 degrees")
    lengths = {"x": width, "y": height, "diagonal": math.hypot(width, height)}
    lengths |= {"smaller": min(width, height), "larger": max(width, height)}
    if axis not in lengths:
        raise sensor.error(f"fov_axis = {axis!r}", ", ".join(lengths))
    fov_x = math.degrees(2 * math.atan(math.tan(math.radians(fov) / 2) * width / lengths[axis]))
    sensor.finish()
    return Camera(_triple(origin), _triple(target), _triple(axes[:, 1]), fov_x, width, height)


def _rotation(emitter: Node) -> NDArray[np.float64]:
    """Return the rotation (3, 3) in `to_world`; its translation is ignored."""
    rotation = emitter.transform()[:3, :3]
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-9):
        raise emitter.error("to_world is not a rotation", "a rotation")
    return rotation


def _lamp(emitter: Node) -> Lamp:
    """Read a lamp without size. As in Mitsuba, `position` or `direction` beside `to_world` is an error (unread)."""
    name, has_transform = emitter.props.id() or emitter.type, "to_world" in emitter.names
    lamp: Lamp
    if emitter.type == "directional":
        direction = _rotation(emitter)[:, 2] if has_transform else emitter.point("direction", (0, 0, 1))
        if not (length := np.linalg.norm(direction)):
            raise emitter.error("direction = 0, 0, 0", "a vector of any length but 0")
        lamp = DirectionalLamp(name, _triple(direction / length), emitter.colour("irradiance", 1.0))
    elif emitter.type == "point":
        position = emitter.transform()[:3, 3] if has_transform else emitter.point("position", (0, 0, 0))
        lamp = PointLamp(name, _triple(position), emitter.colour("intensity", 1.0))
    else:
        direction, position = _rotation(emitter)[:, 2], emitter.transform()[:3, 3]
        cutoff = emitter.value(float, "cutoff_angle", 20.0)
        beam = emitter.value(float, "beam_width", 0.75 * cutoff)
        if not (0 < cutoff <= 180 and beam >= 0):
            raise emitter.error(f"cutoff_angle = {cutoff}, beam_width = {beam}", "angles of 0 to 180 degrees")
        intensity = emitter.colour("intensity", 1.0)
        lamp = SpotLamp(name, _triple(position), intensity, _triple(direction), min(beam, cutoff), cutoff)
    if not emitter.value(float, "sampling_weight", 1.0) > 0:
        raise emitter.error("sampling_weight = 0", "a positive number: Mitsuba never samples this lamp")
    emitter.finish()
    return lamp


def _triple(vector: NDArray[np.float64]) -> Colour:
    x, y, z = map(float, vector)
    return x, y, z


def _sky(emitter: Node) -> Colour | Environment:
    sky: Colour | Environment
    if emitter.type == "constant":
        sky = emitter.colour("radiance", 1.0)
    elif emitter.type == "envmap":
        path, scale = emitter.scene.resolve(emitter.value(str, "filename")), emitter.value(float, "scale", 1.0)
        if scale < 0:
            raise emitter.error(f"scale = {scale}", "at least 0")
        try:
            pixels, header = read_exr(path)
            names = header["channels"]
            has_colours = {*names} in ({*"RGB"}, {*"XYZ"})
            if has_colours:  # as Mitsuba reads them: X, Y, Z and other primaries become Rec. 709
                bitmap = mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
                pixels = np.array(bitmap)
                rounding = CONVERSION * np.abs(pixels).max(-1, keepdims=True)
                pixels[(-rounding < pixels) & (pixels < 0)] = 0
        except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: Mitsuba's
            raise ValueError(str(emitter.error(str(error), "an OpenEXR file"))) from None
        if not has_colours or min(pixels.shape[:2]) < 2 or not np.isfinite(pixels).all() or (pixels < 0).any():
            size = f"{pixels.shape[1]} × {pixels.shape[0]} pixels of {', '.join(names)}"
            raise emitter.error(f"{path}: {size}", SKY)
        if len(pixels) == 2:
            pixels = pixels[[0, 1, 1]]  # as Mitsuba does
        sky = Environment(scale * pixels, _rotation(emitter))
    else:
        raise emitter.error("this emitter is not supported", f"constant, envmap, {', '.join(LAMPS)}, area on a shape")
    emitter.ignore("sampling_weight", "mis_compensation")
    emitter.finish()
    return sky
