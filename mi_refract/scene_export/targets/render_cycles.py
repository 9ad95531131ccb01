"""Render `scene.json` with Cycles: `python render.py --spp 256 --seeds 1 2 3 4 --out .`

It writes one `seedN.exr` per seed. Run this script with a Python that has bpy; mi_refract never imports it. The
settings make Cycles a plain path tracer: box filter, no clamping, no blurred caustics, no adaptive sampling, no
denoising, one depth limit.
"""

import argparse
import json
import math
import re
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector


def main():
    """Render once per seed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--threads", type=int, default=0, help="0 for all")
    parser.add_argument("--out", type=Path, default=Path())
    options = parser.parse_args()
    folder = Path(__file__).resolve().parent
    plain = json.loads((folder / "scene.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build(plain, folder)
    settings(plain, options)
    scene = bpy.context.scene
    for seed in options.seeds:
        scene.cycles.seed = seed
        scene.render.filepath = str(options.out.resolve() / f"seed{seed}.exr")
        bpy.ops.render.render(write_still=True)
        print(scene.render.filepath, flush=True)


def build(plain, folder):
    """Create Blender's objects from `scene.json` and the files in its folder."""
    materials = {name: material(name, entry) for name, entry in plain["materials"].items()}
    for name, entry in plain["meshes"].items():
        vertices, faces = triangles(folder / entry["file"])
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata(vertices, [], faces)
        mesh.materials.append(materials[entry["material"]])
        bpy.context.scene.collection.objects.link(bpy.data.objects.new(name, mesh))
    for entry in plain.get("lamps", []):
        lamp(entry)
    world(plain["sky"], folder)
    camera(plain["camera"])


def triangles(path):
    """Return the vertices and faces of a binary PLY file of float32 positions and triangles."""
    header, _, data = path.read_bytes().partition(b"end_header\n")
    vertices, faces = (int(count) for count in re.findall(rb"element \w+ (\d+)", header))
    corners = np.frombuffer(data, [("count", "u1"), ("index", "<i4", 3)], faces, vertices * 12)
    return np.frombuffer(data, "<f4", vertices * 3).reshape(-1, 3).tolist(), corners["index"].tolist()


def material(name, entry):
    """Create a Blender material from an entry of "materials"."""
    result = bpy.data.materials.new(name)
    result.use_nodes = True
    nodes, links = result.node_tree.nodes, result.node_tree.links
    nodes.clear()
    surface = SHADERS[entry["type"]](nodes, links, entry)
    links.new(surface, nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
    return result


def glass(nodes, links, entry):
    """Return the shader output of a smooth glass."""
    node = nodes.new("ShaderNodeBsdfGlass")
    node.inputs["Color"].default_value = (1, 1, 1, 1)
    node.inputs["Roughness"].default_value = 0
    node.inputs["IOR"].default_value = entry["int_ior"] / entry["ext_ior"]
    return node.outputs[0]


def diffuse(nodes, links, entry):
    """Return the shader output of a Lambertian surface."""
    node = nodes.new("ShaderNodeBsdfDiffuse")
    node.inputs["Color"].default_value = (*entry["reflectance"], 1)
    node.inputs["Roughness"].default_value = 0
    return node.outputs[0]


def light(nodes, links, entry):
    """Return the shader output of a surface that emits on the side of its normal and is black from behind."""
    front, back, mix = (nodes.new(f"ShaderNode{kind}") for kind in ("Emission", "BsdfDiffuse", "MixShader"))
    front.inputs["Color"].default_value = (*entry["radiance"], 1)
    front.inputs["Strength"].default_value = 1
    back.inputs["Color"].default_value = (0, 0, 0, 1)
    links.new(nodes.new("ShaderNodeNewGeometry").outputs["Backfacing"], mix.inputs[0])
    links.new(front.outputs[0], mix.inputs[1])
    links.new(back.outputs[0], mix.inputs[2])
    return mix.outputs[0]


SHADERS = {"glass": glass, "diffuse": diffuse, "light": light}


def lamp(entry):
    """Add a lamp without size. In Blender a point's power is 4π × intensity, a sun's strength is its irradiance."""
    directional = entry["type"] == "directional"
    data = bpy.data.lights.new(entry["name"], "SUN" if directional else "POINT")
    data.color, data.energy = entry["irradiance" if directional else "intensity"], 1 if directional else 4 * math.pi
    item = bpy.data.objects.new(entry["name"], data)
    if directional:  # a sun emits along its −z
        data.angle = 0
        item.matrix_world = Vector(entry["direction"]).to_track_quat("-Z", "Y").to_matrix().to_4x4()
    else:
        data.shadow_soft_size = 0
        item.matrix_world = Matrix.Translation(Vector(entry["position"]))
    bpy.context.scene.collection.objects.link(item)


def world(sky, folder):
    """Set the sky: a map or one colour."""
    blender_world = bpy.data.worlds.new("sky")
    blender_world.use_nodes = True
    bpy.context.scene.world = blender_world
    nodes, links = blender_world.node_tree.nodes, blender_world.node_tree.links
    nodes.clear()
    background = nodes.new("ShaderNodeBackground")
    if "environment" in sky:
        image = nodes.new("ShaderNodeTexEnvironment")
        image.image = bpy.data.images.load(str(folder / sky["environment"]))
        image.image.colorspace_settings.name = "Non-Color"
        links.new(image.outputs[0], background.inputs["Color"])
    else:
        background.inputs["Color"].default_value = (*sky["radiance"], 1)
    links.new(background.outputs[0], nodes.new("ShaderNodeOutputWorld").inputs["Surface"])


def camera(entry):
    """Add the camera."""
    origin, target, up = (Vector(entry[key]) for key in ("origin", "target", "up"))
    back = (origin - target).normalized()
    right = up.cross(back).normalized()
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit = "HORIZONTAL"
    # Not by `lens.angle`, which Blender limits to 0.367 … 172.85 degrees; the least width and focal length are 1.
    ratio = 2 * math.tan(math.radians(entry["fov_x_degrees"]) / 2)  # of the sensor's width to the focal length
    lens.sensor_width, lens.lens = max(1, ratio), max(1, 1 / ratio)
    lens.clip_start, lens.clip_end = 1e-6, 1e30  # Blender has no smaller start
    item = bpy.data.objects.new("camera", lens)
    axes = Matrix((right, back.cross(right), back)).transposed().to_4x4()
    item.matrix_world = Matrix.Translation(origin) @ axes
    bpy.context.scene.collection.objects.link(item)
    bpy.context.scene.camera = item


def settings(plain, options):
    """Make Cycles a plain path tracer."""
    scene = bpy.context.scene
    render, cycles, view = scene.render, scene.cycles, plain["camera"]
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = view["width"], view["height"]
    render.resolution_percentage = 100
    if options.threads:
        render.threads_mode, render.threads = "FIXED", options.threads
    render.use_compositing = render.use_sequencer = False
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_mode, render.image_settings.color_depth = "RGB", "32"
    cycles.device, cycles.samples, cycles.seed = "CPU", options.spp, 0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 1.0
    cycles.blur_glossy = cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0
    cycles.light_sampling_threshold = 0
    cycles.caustics_reflective = cycles.caustics_refractive = True
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    # Mitsuba's depth N counts the camera's ray and the last emitter: N − 2 bounces between them.
    bounces = plain["max_depth"] - 2
    for limit in ("max_bounces", "diffuse_bounces", "glossy_bounces", "transmission_bounces", "min_light_bounces"):
        setattr(cycles, limit, min(bounces, 1024))


if __name__ == "__main__":
    main()
