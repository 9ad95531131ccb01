"""Renderers that render a plain scene: several independent pictures of it, each in a process of its own.

A picture is height × width × 3, linear, row 0 at the top.
"""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refract import export, images
from mi_refract.export import cycles, described, luxcore, povray, radiance
from mi_refract.images import Image
from mi_refract.plain_data import Plain

from . import SYSTEMS, environments, three

HOURS = 4 * 3600.0  # after which a renderer hangs


@dataclass(frozen=True)
class Painter:
    """`draw(plain, folder, spp, seeds)` leaves one picture a seed, from what it puts into an empty folder.

    `spp`: by scene of the study, the samples a pixel and picture that make a difference of 1 % visible where four
    pictures are judged; `assumed`: in what the models differ.
    """

    system: str
    draw: Callable[[Plain, Path, int, Sequence[int]], list[Image]]
    spp: Mapping[str, int]
    assumed: Sequence[str]


def _by_script(target: str) -> Callable[[Plain, Path, int, Sequence[int]], list[Image]]:
    """By the script that is exported with the scene."""

    def draw(plain: Plain, folder: Path, spp: int, seeds: Sequence[int]) -> list[Image]:
        export.write(plain, target, folder / "scene")
        program = [environments.python(SYSTEMS[target]), "render.py", "--spp", str(spp), "--out", str(folder)]
        environments.run([*program, "--seeds", *map(str, seeds)], timeout=HOURS, where=folder / "scene")
        return [_rgb(images.read(folder / f"seed{seed}.exr")) for seed in seeds]

    return draw


def _radiance(plain: Plain, folder: Path, spp: int, seeds: Sequence[int]) -> list[Image]:
    export.write(plain, "radiance", folder / "scene")
    camera = plain.camera
    sizes = map(str, (camera.width, spp, plain.max_depth, *seeds))
    places = str(folder / "scene"), str(folder)
    script = environments.script(SYSTEMS["radiance"], "radiance_pictures.py", *places, *sizes)
    environments.run(script, timeout=HOURS)
    return [_raw(folder / f"seed{seed}.f32", plain) for seed in seeds]


def _povray(plain: Plain, folder: Path, spp: int, seeds: Sequence[int]) -> list[Image]:
    """Deterministic but for where the grid of samples lies, √spp on a side of each pixel: by chance in each picture."""
    side, camera = math.isqrt(spp), plain.camera
    width, height = side * camera.width, side * camera.height
    finer = dataclasses.replace(plain, camera=dataclasses.replace(camera, width=width, height=height))
    export.write(finer, "povray", folder / "scene")
    made = []
    for seed in seeds:
        dx, dy = np.random.default_rng(seed).random(2)
        sizes = [f"+W{width}", f"+H{height}", f"Declare=dx={dx:.9f}", f"Declare=dy={dy:.9f}"]
        command = ["povray", "+Iscene.pov", "+Oimage.exr", "+FE", "-A", "-D", "File_Gamma=1.0", *sizes]
        environments.run(command, timeout=HOURS, where=folder / "scene")
        fine = _rgb(images.read(folder / "scene" / "image.exr")).pixels
        coarse = fine.reshape(camera.height, side, camera.width, side, 3).mean((1, 3), dtype=np.float64)
        made.append(images.named(f"seed {seed}", coarse.astype(np.float32)))
    return made


def _three(mis: str) -> Callable[[Plain, Path, int, Sequence[int]], list[Image]]:
    """With multiple importance sampling of the sky ("1"), as the library comes, or without ("0")."""

    def draw(plain: Plain, folder: Path, spp: int, seeds: Sequence[int]) -> list[Image]:
        chromium, node = three.browser(), shutil.which("node")
        if not (chromium and node):
            raise environments.Unable("no node or no Chromium in PATH")
        (folder / "scene").mkdir()
        for name, content in described.files(plain, equirectangular).items():
            (folder / "scene" / name).write_bytes(content)
        script = environments.SCRIPTS / "three_pictures.mjs"
        places = [str(script), str(environments.folder(SYSTEMS["three"])), chromium, str(folder / "scene"), str(folder)]
        sizes = map(str, (plain.camera.width, spp, mis, *seeds))
        environments.run([node, *places, *sizes], timeout=HOURS)
        return [_raw(folder / f"seed{seed}.f32", plain) for seed in seeds]

    return draw


def equirectangular(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The direction whose radiance three finds at (u, v), v from the top."""
    phi, theta = 2 * np.pi * (u - 0.5), np.pi * v
    return np.stack([np.cos(phi) * np.sin(theta), np.cos(theta), np.sin(phi) * np.sin(theta)], axis=-1)


def _raw(path: Path, plain: Plain) -> Image:
    shape = (plain.camera.height, plain.camera.width, 3)
    return images.named(path.name, np.frombuffer(path.read_bytes(), "<f4").reshape(shape))


def _rgb(image: Image) -> Image:
    return images.named(image.path.name, image.select(("R", "G", "B")))


THREE = (
    "A glass has one index, the quotient of the two; radiance is not scaled by the square of the index.",
    "The tent filter of its pixels is replaced by a box.",
    "Its Russian roulette is off, and its random numbers are those of a seed (PCG): its strata are the same in all "
    "pixels. MIS is its multiple importance sampling of the sky, on by default.",
    "A diffuse surface is its Disney lobe at roughness 0 and index 1, which is Lambert's; a lamp is a front that emits "
    "and a black back.",
    "bounces and transmissiveBounces are Mitsuba's max_depth.",
)


def _spp(sphere: int, prism: int, environment: int) -> dict[str, int]:
    return {"sphere": sphere, "prism": prism, "environment": environment}


PAINTERS: dict[str, Painter] = {
    "Radiance": Painter("radiance", _radiance, _spp(160, 112, 4), radiance.ASSUMPTIONS),
    "Cycles": Painter("cycles", _by_script("cycles"), _spp(128, 128, 32), cycles.ASSUMED),
    "LuxCore": Painter("luxcore", _by_script("luxcore"), _spp(320, 400, 288), luxcore.ASSUMED),
    "POV-Ray": Painter("povray", _povray, _spp(16, 16, 16), povray.ASSUMPTIONS),
    "three-gpu-pathtracer": Painter("three", _three("1"), {"prism": 8, "furnace": 8}, THREE),
    "three-gpu-pathtracer, no MIS": Painter("three", _three("0"), {"prism": 8, "furnace": 8}, THREE),
}
