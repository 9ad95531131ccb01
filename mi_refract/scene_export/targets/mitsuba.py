"""Mitsuba: the same triangles and constants that every other target gets."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

import numpy as np

from ..plain_scene import Colour, Diffuse, Environment, Glass, Material, PlainScene
from .shared_files import Files, exr, numbers, ply_files, readme

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
{sky}
</scene>
"""


def files(plain: PlainScene) -> Files:
    """The files of the export, by name."""
    camera = plain.camera
    vectors = {name: numbers(getattr(camera, name), ", ") for name in ("origin", "target", "up")}
    shapes = "\n".join(
        f"""
    <shape type="ply" id={quoteattr(mesh.name)}>
        <string name="filename" value={quoteattr(mesh.name + ".ply")}/>
        <boolean name="face_normals" value="true"/>
        {_material(mesh.material)}
    </shape>"""
        for mesh in plain.meshes
    )
    text = SCENE.format(camera=camera, max_depth=plain.max_depth, shapes=shapes, sky=_sky(plain.sky), **vectors)
    sky = {"sky.exr": exr(plain.sky.pixels)} if isinstance(plain.sky, Environment) else {}
    own = {"scene.xml": text.encode(), "README.txt": readme(plain, "Mitsuba", COMMANDS, ())}
    return ply_files(plain) | sky | own


def _material(material: Material) -> str:
    if isinstance(material, Glass):
        return (
            f'<bsdf type="$bsdf"><float name="int_ior" value="{material.int_ior!r}"/>'
            f'<float name="ext_ior" value="{material.ext_ior!r}"/></bsdf>'
        )
    if isinstance(material, Diffuse):
        return f'<bsdf type="twosided"><bsdf type="diffuse">{_rgb("reflectance", material.reflectance)}</bsdf></bsdf>'
    return f'<emitter type="area">{_rgb("radiance", material.radiance)}</emitter>'


def _sky(sky: Colour | Environment) -> str:
    if isinstance(sky, Environment):
        matrix = np.eye(4)
        matrix[:3, :3] = sky.rotation
        turn = f'<transform name="to_world"><matrix value="{numbers(matrix.ravel())}"/></transform>'
        return f'\n    <emitter type="envmap"><string name="filename" value="sky.exr"/>{turn}</emitter>'
    return f'\n    <emitter type="constant">{_rgb("radiance", sky)}</emitter>' if any(sky) else ""


def _rgb(name: str, colour: Colour) -> str:
    return f'<rgb name="{name}" value="{numbers(colour, ", ")}"/>'
