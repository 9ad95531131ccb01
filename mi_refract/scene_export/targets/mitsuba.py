"""Mitsuba: the same triangles and constants that every other target gets."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

import numpy as np

from ..plain_scene import Colour, Diffuse, DirectionalLamp, Environment, Glass, Lamp, PlainScene, PointLamp, SpotLamp
from .shared_files import Array, Files, exr, frame, numbers, ply_files, readme

COMMANDS = "mi-refract render scene.xml -o image.exr --spp 1024        (-D bsdf=dielectric for Mitsuba's own glass)"
SCENE = """<scene version="3.0.0">
    <default name="bsdf" value="refract"/>
    <default name="integrator" value="path"/>
    <default name="max_depth" value="{max_depth}"/>
    <default name="spp" value="64"/>

    <integrator type="$integrator">
        <integer name="max_depth" value="$max_depth"/>
        <integer name="rr_depth" value="$max_depth"/>
    </integrator>

    <sensor type="perspective">
        <transform name="to_world">
            <lookat origin="{origin}"
                    target="{target}"
                    up="{up}"/>
        </transform>
        <float name="fov" value="{camera.fov_x_degrees!r}"/>
        <string name="fov_axis" value="x"/>
        <float name="near_clip" value="1e-9"/>
        <float name="far_clip" value="1e30"/>
        <sampler type="independent">
            <integer name="sample_count" value="$spp"/>
        </sampler>
        <film type="hdrfilm">
            <integer name="width" value="{camera.width}"/>
            <integer name="height" value="{camera.height}"/>
            <string name="pixel_format" value="rgb"/>
            <string name="component_format" value="float32"/>
            <rfilter type="box"/>
        </film>
    </sensor>
{shapes}
{sky}{lamps}
</scene>
"""
SHAPE = """
    <shape type="ply" id={name}>
        <string name="filename" value={file}/>
        <boolean name="face_normals" value="true"/>
        {plugin}
    </shape>"""


def files(plain: PlainScene) -> Files:
    """Return the export's files by name."""
    camera = plain.camera
    vectors = {name: numbers(getattr(camera, name), ", ") for name in ("origin", "target", "up")}
    shapes = []
    for mesh in plain.meshes:
        if isinstance(material := mesh.material, Glass):
            indices = (f'<float name="{key}" value="{getattr(material, key)!r}"/>' for key in ("int_ior", "ext_ior"))
            plugin = f'<bsdf type="$bsdf">{"".join(indices)}</bsdf>'
        elif isinstance(material, Diffuse):
            diffuse = f'<bsdf type="diffuse">{_rgb("reflectance", material.reflectance)}</bsdf>'
            plugin = f'<bsdf type="twosided">{diffuse}</bsdf>'
        else:
            plugin = f'<emitter type="area">{_rgb("radiance", material.radiance)}</emitter>'
        shapes.append(SHAPE.format(name=quoteattr(mesh.name), file=quoteattr(f"{mesh.name}.ply"), plugin=plugin))
    sky, contents = "", {}
    if isinstance(plain.sky, Environment):
        to_world = np.eye(4)
        to_world[:3, :3] = plain.sky.rotation
        sky = f'\n    <emitter type="envmap"><string name="filename" value="sky.exr"/>{_to_world(to_world)}</emitter>'
        contents = {"sky.exr": exr(plain.sky.pixels)}
    elif any(plain.sky):
        sky = f'\n    <emitter type="constant">{_rgb("radiance", plain.sky)}</emitter>'
    parts = {"shapes": "\n".join(shapes), "sky": sky, "lamps": "".join(map(_lamp, plain.lamps))}
    text = SCENE.format(camera=camera, max_depth=plain.max_depth, **parts, **vectors)
    contents |= {"scene.xml": text.encode(), "README.txt": readme(plain, "Mitsuba", COMMANDS, ())}
    return ply_files(plain) | contents


def _lamp(lamp: Lamp) -> str:
    body = _to_world(frame(lamp))
    if isinstance(lamp, PointLamp):
        body += _rgb("intensity", lamp.intensity)
    if isinstance(lamp, DirectionalLamp):
        body += _rgb("irradiance", lamp.irradiance)
    if isinstance(lamp, SpotLamp):
        angles = {"cutoff_angle": lamp.cutoff_degrees, "beam_width": lamp.beam_degrees}
        body += "".join(f'<float name="{name}" value="{angle!r}"/>' for name, angle in angles.items())
    return f'\n    <emitter type="{lamp.kind}" id={quoteattr(lamp.name)}>{body}</emitter>'


def _to_world(matrix: Array) -> str:
    return f'<transform name="to_world"><matrix value="{numbers(matrix.ravel())}"/></transform>'


def _rgb(name: str, colour: Colour) -> str:
    return f'<rgb name="{name}" value="{numbers(colour, ", ")}"/>'
