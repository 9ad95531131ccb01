"""The renderers of images: each renders several independent images of a plain scene, in a process of its own.

An image is height × width × 3, linear, row 0 at the top.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refract.io import image_file
from mi_refract.io.image_file import Image
from mi_refract.rendering import scene_files
from mi_refract.scene_export import targets
from mi_refract.scene_export.plain_scene import PlainScene
from mi_refract.scene_export.targets import luxcore, povray, radiance, scene_json
from validation.run.render_methods import Camera

from . import environments
from .system import SCRIPTS, SYSTEMS, System

HOURS = 4 * 3600.0  # seconds: a renderer that takes longer hangs
PASS = 2048  # samples per pixel


@dataclass(frozen=True)
class ImageRenderer:
    """`draw(plain, folder, spp, seeds)` writes the scene into an empty folder and renders one image per seed.

    `spp`: scene of the study → samples per pixel and image, enough to detect a difference of 1 % with four images.
    `assumed`: how the renderer's model differs.
    """

    system: str
    draw: Callable[..., list[Image]]
    spp: Mapping[str, int]
    assumed: Sequence[str]


def unedited(scene: Path) -> None:
    """Leave the files as they were exported."""


def by_script(
    target: str,
    ending: str,
    plain: PlainScene,
    folder: Path,
    spp: int,
    seeds: Sequence[int],
    edit: Callable[[Path], None] = unedited,
    more: Sequence[str] = (),
) -> list[Image]:
    """Render by the script that is exported with the scene, after `edit(folder)`, with `more` options."""
    targets.write(plain, target, folder / "scene")
    edit(folder / "scene")
    program = [environments.python(SYSTEMS[target]), "render.py", "--spp", str(spp), "--out", str(folder)]
    environments.run([*program, *more, "--seeds", *map(str, seeds)], timeout=HOURS, where=folder / "scene")
    return [_rgb(image_file.read(folder / f"seed{seed}.{ending}")) for seed in seeds]


def by_command(system: System, plain: PlainScene, folder: Path, spp: int, seeds: Sequence[int]) -> list[Image]:
    """Render by the command of the system's `mi-refract-renderer.toml`."""
    if system.images is None:
        raise ValueError(f"{system.name}: no [images]; expected a system with a command for images")
    targets.write(plain, system.images.export, folder / "scene")
    for seed in seeds:
        values = {"scene": folder / "scene", "image": folder / f"seed{seed}.exr", "spp": spp, "seed": seed}
        environments.ask(system, system.images.command, timeout=HOURS, values=values)
    return [_rgb(image_file.read(folder / f"seed{seed}.exr")) for seed in seeds]


def radiance_images(
    plain: PlainScene, folder: Path, spp: int, seeds: Sequence[int], edit: Callable[[Path], None] = unedited
) -> list[Image]:
    """Render by Radiance's rtrace with the options of README.txt, after `edit(folder)` of the exported files."""
    targets.write(plain, "radiance", folder / "scene")
    edit(folder / "scene")
    sizes = map(str, (plain.camera.width, plain.camera.height, spp, *seeds))
    words = str(folder / "scene"), str(folder), *sizes
    environments.run(environments.script(SYSTEMS["radiance"], "radiance_images.py", *words), timeout=HOURS)
    return [_raw(folder / f"seed{seed}.f32", plain) for seed in seeds]


def povray_images(
    plain: PlainScene, folder: Path, spp: int, seeds: Sequence[int], edit: Callable[[Path], None] = unedited
) -> list[Image]:
    """Render by POV-Ray: means over a grid of samples, √spp per side of a pixel, the same image for every seed.

    The image has no noise. POV-Ray's random grids would move all pixels together, so a test of tiles could not estimate
    their noise. `edit(folder)` edits the exported files.
    """
    side, camera = math.isqrt(spp), plain.camera
    width, height = side * camera.width, side * camera.height
    finer = dataclasses.replace(plain, camera=dataclasses.replace(camera, width=width, height=height))
    targets.write(finer, "povray", folder / "scene")
    edit(folder / "scene")
    lines = (folder / "scene" / "README.txt").read_text().splitlines()
    command = next(line.split() for line in lines if line.split()[:1] == ["povray"])
    environments.run(command, timeout=HOURS, where=folder / "scene")
    fine = _rgb(image_file.read(folder / "scene" / "image.exr")).pixels
    coarse = fine.reshape(camera.height, side, camera.width, side, 3).mean((1, 3), dtype=np.float64)
    return [image_file.named(f"seed {seed}", coarse.astype(np.float32)) for seed in seeds]


def _three(mode: str, plain: PlainScene, folder: Path, spp: int, seeds: Sequence[int]) -> list[Image]:
    """Render by three.js: path traced with ("mis", its default) or without ("none") MIS of the sky, or "raster"."""
    chromium, node = next(filter(None, map(shutil.which, environments.BROWSERS)), None), shutil.which("node")
    if not (chromium and node):
        raise environments.Unable("no node or no Chromium in PATH")
    _write_gltf(plain, folder / "scene")
    script, home = SCRIPTS / "three_images.mjs", environments.folder(SYSTEMS["three"])
    sizes = (plain.camera.width, plain.camera.height, spp, mode, *seeds)
    words = [node, *map(str, (script, home, chromium, folder / "scene", folder, *sizes))]
    environments.run(words, timeout=HOURS)
    return [_raw(folder / f"seed{seed}.f32", plain) for seed in seeds]


def _cycles_gltf(plain: PlainScene, folder: Path, spp: int, seeds: Sequence[int]) -> list[Image]:
    """Render by Cycles the glTF export as Blender imports it, with the settings of the export to Cycles."""
    targets.write(plain, "cycles", folder / "cycles")
    _write_gltf(plain, folder / "scene")
    words = (folder / "scene", folder / "cycles" / "render.py", "--spp", spp, "--out", folder, "--seeds", *seeds)
    command = environments.script(SYSTEMS["cycles"], "gltf_by_cycles.py", *map(str, words))
    environments.run(command, timeout=HOURS)
    return [_rgb(image_file.read(folder / f"seed{seed}.exr")) for seed in seeds]


def _write_gltf(plain: PlainScene, folder: Path) -> None:
    """Export to glTF without vertex normals: Mitsuba's side has flat facets."""
    meshes = tuple(dataclasses.replace(mesh, normals=None) for mesh in plain.meshes)
    targets.write(dataclasses.replace(plain, meshes=meshes), "gltf", folder)


def _mitsuba(integrator: str, plain: PlainScene, folder: Path, spp: int, seeds: Sequence[int]) -> list[Image]:
    """Render by another integrator of Mitsuba, with `dielectric`, in this process and the current variant."""
    targets.write(plain, "mitsuba", folder / "scene")
    parameters = {"bsdf": "dielectric", "integrator": integrator}
    camera = Camera(scene_files.load_scene(folder / "scene" / "scene.xml", parameters))
    return [image_file.named(f"seed {seed}", mean(camera, spp, seed)) for seed in seeds]


def mean(camera: Camera, spp: int, seed: int) -> np.ndarray:
    """Return an image of `spp` samples, rendered in passes of at most PASS: more would need gigabytes."""
    passes = -(-spp // PASS)
    images = [camera(-(-spp // passes), 1000 * seed + i)[0][..., :3] for i in range(passes)]
    return np.asarray(np.mean(images, axis=0).astype(np.float32))


def _raw(path: Path, plain: PlainScene) -> Image:
    shape = (plain.camera.height, plain.camera.width, 3)
    return image_file.named(path.name, np.frombuffer(path.read_bytes(), "<f4").reshape(shape))


def _rgb(image: Image) -> Image:
    return image_file.named(image.path.name, image.select(("R", "G", "B")))


THREE = (
    "It reads the glTF export by three's GLTFLoader, with flat facets, as on Mitsuba's side.",
    "A glass has one index, the ratio of the two; radiance is not scaled by the square of the index.",
    "The tent filter of its pixels is replaced by a box.",
    "Its Russian roulette is off. Its random numbers come from a seed (PCG) instead of its strata, which are the same "
    "in all pixels. MIS is its multiple importance sampling of the sky, on by default.",
    "A diffuse surface is its Disney lobe at roughness 0 and index 1, which is Lambert's; a lamp is a surface with an "
    "emitting front and a black back.",
    "bounces and transmissiveBounces are Mitsuba's max_depth.",
)
RASTER = (
    THREE[0],
    "It is a rasteriser: surfaces do not light each other. Each pixel is the mean of a grid of samples, without noise.",
)
CYCLES_GLTF = (
    "It reads the glTF export by Blender's importer, with flat facets, as on Mitsuba's side.",
    *scene_json.CYCLES_ASSUMPTIONS,
)
MITSUBA = ("Mitsuba's `dielectric` in the same variant and scene file; no Russian roulette.",)
PTRACER = (
    *MITSUBA,
    "Paths start at lamps, and their last vertex is joined with the camera: whatever is seen in or through smooth "
    "glass stays black. Caustics on diffuse surfaces that are seen directly are rendered.",
)
POVRAY = ("Each pixel is the mean of a grid of 8 × 8 samples, without noise.", *povray.ASSUMPTIONS)


def _renderer(
    system: str, draw: Callable[..., list[Image]], assumed: Sequence[str], *spp: int, **more: int
) -> ImageRenderer:
    """Return a renderer. `spp`: for the scenes sphere, prism and environment; `more`: for other scenes."""
    return ImageRenderer(system, draw, dict(zip(("sphere", "prism", "environment"), spp, strict=False)) | more, assumed)


_volpath, _prb, _ptracer = (functools.partial(_mitsuba, name) for name in ("volpath", "prb", "ptracer"))
_cycles, _luxcore = (functools.partial(by_script, target, "exr") for target in ("cycles", "luxcore"))
_raysect = functools.partial(by_script, "raysect", "pfm")
IMAGE_RENDERERS: dict[str, ImageRenderer] = {
    "Mitsuba, volpath": _renderer("mitsuba", _volpath, MITSUBA, 1024, 768, 256, furnace=128, caustic=8192),
    "Mitsuba, prb": _renderer("mitsuba", _prb, MITSUBA, 1024, 768, 256, furnace=128, caustic=8192),
    "Mitsuba, ptracer": _renderer("mitsuba", _ptracer, PTRACER, caustic=32768, sphere=512),
    "Radiance": _renderer("radiance", radiance_images, radiance.ASSUMPTIONS, 960, 448, 24),
    "Cycles": _renderer("cycles", _cycles, scene_json.CYCLES_ASSUMPTIONS, 512, 128, 32),
    "Cycles, glTF": _renderer("cycles", _cycles_gltf, CYCLES_GLTF, 512, 128, 32),
    # Of these, furnace has no lamps, which raysect hits by chance only.
    "raysect": _renderer("raysect", _raysect, scene_json.RAYSECT_ASSUMPTIONS, 2048, 768, 256, furnace=128),
    "LuxCore": _renderer("luxcore", _luxcore, luxcore.ASSUMPTIONS, 1280, 1024, 576),
    "POV-Ray": _renderer("povray", povray_images, POVRAY, 64, 64, 64),
    "three-gpu-pathtracer": _renderer("three", functools.partial(_three, "mis"), THREE, prism=8, furnace=8),
    "three-gpu-pathtracer, no MIS": _renderer("three", functools.partial(_three, "none"), THREE, prism=8, furnace=8),
    "three, MeshPhysicalMaterial": _renderer("three", functools.partial(_three, "raster"), RASTER, prism=512),
}
