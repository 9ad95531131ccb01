"""Cycles' refraction closure: a camera in OSL shoots every ray at a triangle of its own, and the world returns it.

The triangle faces the ray, and gives the closure the ray's normal and index; the world's colour is the direction that
leaves, and black where the closure has none. So nothing of Cycles' geometry is in the answer. Runs in Blender's module.
"""

import contextlib
import os
import re
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
import table

START, SIZE = 0.25, 1e-3
WIDTH = 128
CAMERA = """
shader camera(output point position = 0.0, output vector direction = 0.0, output color throughput = 1.0)
{
    point at = camera_shader_raster_position();
    float x = (floor(at[0] * WIDTH) + 0.5) / WIDTH, y = 1 - (floor(at[1] * HEIGHT) + 0.5) / HEIGHT;
    color origin = texture("ORIGINS", x, y, "interp", "closest");
    color along = texture("DIRECTIONS", x, y, "interp", "closest");
    position = point(origin[0], origin[1], -origin[2]);
    direction = vector(along[0], along[1], -along[2]);
}
"""


def exr(path, pixels):
    """(H, W, 3), the first row at the bottom, as Blender keeps images."""
    height, width, _ = pixels.shape
    image = bpy.data.images.new(path.stem, width, height, float_buffer=True, is_data=True)
    image.pixels.foreach_set(np.dstack([pixels, np.ones((height, width, 1))]).astype(np.float32).ravel())
    image.filepath_raw, image.file_format = str(path), "OPEN_EXR"
    bpy.context.scene.render.image_settings.file_format = "OPEN_EXR"
    bpy.context.scene.render.image_settings.color_depth = "32"
    image.save()


def padded(x, height):
    """(N, 3) as an image of WIDTH; the rays past the last one repeat the first."""
    return np.concatenate([x, np.tile(x[:1], (height * WIDTH - len(x), 1))]).reshape(height, WIDTH, 3)


def triangles(rays, centres):
    """One per ray, perpendicular to it and facing it, with the closure's normal and index as attributes."""
    a = rays.a.astype(np.float64)
    u = np.cross(a, np.eye(3)[np.argmin(np.abs(a), axis=1)])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, a)
    corners = [centres + SIZE * (np.cos(t) * u + np.sin(t) * v) for t in np.arange(3) * 2 * np.pi / 3]
    mesh = bpy.data.meshes.new("rays")
    faces = np.arange(3 * len(rays)).reshape(-1, 3)
    mesh.from_pydata(np.stack(corners, axis=1).reshape(-1, 3).tolist(), [], faces.tolist())
    mesh.attributes.new("n", "FLOAT_VECTOR", "FACE").data.foreach_set("vector", rays.n.ravel())
    mesh.attributes.new("eta", "FLOAT", "FACE").data.foreach_set("value", rays.n_to / rays.n_from)
    return mesh


def attribute(tree, name, output):
    node = tree.nodes.new("ShaderNodeAttribute")
    node.attribute_name = name
    return node.outputs[output]


def material():
    found = bpy.data.materials.new("closure")
    found.cycles.use_bump_map_correction = False  # would bend the normal, which is not that of the triangle
    found.use_nodes = True
    tree = found.node_tree
    tree.nodes.clear()
    closure, out = tree.nodes.new("ShaderNodeBsdfRefraction"), tree.nodes.new("ShaderNodeOutputMaterial")
    closure.inputs["Color"].default_value = (1, 1, 1, 1)
    closure.inputs["Roughness"].default_value = 0
    tree.links.new(attribute(tree, "n", "Vector"), closure.inputs["Normal"])
    tree.links.new(attribute(tree, "eta", "Fac"), closure.inputs["IOR"])
    tree.links.new(closure.outputs[0], out.inputs["Surface"])
    return found


def world():
    found = bpy.data.worlds.new("directions")
    found.use_nodes = True
    tree = found.node_tree
    direction = tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(direction.outputs["Generated"], tree.nodes["Background"].inputs["Color"])
    found.cycles.sampling_method = "NONE"
    return found


def settings(scene, width, height):
    """One sample at the pixel's centre, nothing clamped, filtered or denoised."""
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 1
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = width, height, 100
    scene.cycles.use_adaptive_sampling = scene.cycles.use_denoising = False
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.sample_clamp_direct = scene.cycles.sample_clamp_indirect = scene.cycles.blur_glossy = 0
    scene.cycles.max_bounces = scene.cycles.transmission_bounces = scene.cycles.min_light_bounces = 4


def render(rays, folder):
    height = -(-len(rays) // WIDTH)
    centres = table.apart(rays)
    exr(folder / "origins.exr", padded(centres - START * rays.a, height))
    exr(folder / "directions.exr", padded(rays.a, height))
    constants = {"WIDTH": f"{WIDTH}.0", "HEIGHT": f"{height}.0"}
    constants |= {name: f"{folder}/{name.lower()}.exr" for name in ("ORIGINS", "DIRECTIONS")}
    (folder / "camera.osl").write_text(re.sub("|".join(constants), lambda found: constants[found[0]], CAMERA))
    scene = bpy.context.scene
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    mesh, camera = triangles(rays, centres), bpy.data.cameras.new("camera")
    mesh.materials.append(material())
    for name, data in (("rays", mesh), ("camera", camera)):
        scene.collection.objects.link(bpy.data.objects.new(name, data))
    scene.camera, scene.world = bpy.data.objects["camera"], world()
    settings(scene, WIDTH, height)
    camera.type, camera.custom_mode, camera.custom_filepath = "CUSTOM", "EXTERNAL", f"{folder}/camera.osl"
    scene.render.filepath = f"{folder}/out.exr"
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(f"{folder}/out.exr")
    pixels = np.empty(4 * WIDTH * height, np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(-1, 4)[: len(rays), :3]


@contextlib.contextmanager
def stdout_to_stderr():
    """Blender prints its progress where the answers go."""
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)


rays = table.Rays("float32")
with tempfile.TemporaryDirectory() as name, stdout_to_stderr():
    b = render(rays, Path(name))
table.write(rays, b, f"Cycles, Blender {bpy.app.version_string}")
