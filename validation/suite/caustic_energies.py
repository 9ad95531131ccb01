"""Caustics by others: the power on a disk below a ball and a plano-convex lens of glass, by photons and by paths.

The ball is lit by a point lamp, the lens by parallel light. Both bodies are those of the study of caustics, made of
triangles. Renderers have different units of light, so the sum over the image is divided by that of the same disk
without glass, whose power is known. The exact power is a quadrature over rays in a plane through the axis. The bound
tests the level only: facets change the power below the ball by 1 %, and POV-Ray and Radiance estimate a density from
photons. LuxCore traces paths from both ends.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refract.io.image_file import Image
from mi_refract.report.row import Row
from mi_refract.scene_export.plain_scene import Camera, Diffuse, Glass, Mesh, PlainScene
from validation import limits
from validation.reference import caustic_energy
from validation.reference.caustic_energy import ON_AXIS, PARALLEL, POINT, TOP
from validation.run.context import Context
from validation.study import Study, Task, about

from .renderers import SYSTEMS, environments, image_renderers

NAME = "caustics by others"
OFF, SPREAD = "energy off", "spread"
TERMS = {
    OFF: "|power on the disk over the exact one − 1|",
    SPREAD: "largest over smallest power of the renders − 1, if they are random",
}
LAMPS = {"ball": POINT, "lens": PARALLEL}  # with these lamps, no rim of a caustic is near the rim of the disk
PROFILES = {"ball": caustic_energy.ball_profile, "lens": caustic_energy.lens_profile}
BOUNDARIES, RESOLUTION, RINGS, TURNS = 6, 64, 96, 288
SEEDS = (1, 2)
LOST = "not rendered", 1.0
REFLECTANCE = caustic_energy.REFLECTANCE


@dataclass(frozen=True)
class Renderer:
    """`draw(plain, lamp, folder)` renders images of a scene with a lamp of this kind."""

    system: str
    draw: Callable[[PlainScene, str, Path], list[Image]]


def plain_scene(body: str, glass: bool) -> PlainScene:
    """Return the disk below a body, and the body itself if `glass`."""
    radius = ON_AXIS[body, LAMPS[body]][1]
    flat = revolved("disk", np.array([[0, 0], [radius, 0], [0, 0]]), Diffuse((REFLECTANCE,) * 3))
    meshes = [dataclasses.replace(flat, faces=flat.faces[:TURNS])]  # its upper side
    if glass:
        meshes.append(revolved(body, PROFILES[body](RINGS), Glass(1.5, 1.0)))
    x, y, z = map(float, caustic_energy.VIEWPOINT)
    view = Camera((x, y, z), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), caustic_energy.FIELD, RESOLUTION, RESOLUTION)
    return PlainScene(f"caustic_{body}", tuple(meshes), (0.0, 0.0, 0.0), view, BOUNDARIES + 2)


def revolved(name: str, profile: np.ndarray, material: Glass | Diffuse) -> Mesh:
    """Return the closed surface of revolution of a profile (N × 2: distance from the y axis, y), from top to bottom."""
    turn = 2 * np.pi * np.arange(TURNS) / TURNS
    rings = [np.stack([r * np.cos(turn), np.full(TURNS, y), -r * np.sin(turn)], 1) for r, y in profile[1:-1]]
    top, bottom = ([[0, profile[i, 1], 0]] for i in (0, -1))
    this = np.arange(TURNS)
    following, last = (this + 1) % TURNS, 1 + len(rings) * TURNS
    faces = [np.stack([0 * this, 1 + this, 1 + following], 1)]
    for start in range(1, last - TURNS, TURNS):
        a, b, c, d = start + this, start + following, start + TURNS + following, start + TURNS + this
        faces += [np.stack([a, d, c], 1), np.stack([a, c, b], 1)]
    faces.append(np.stack([last - TURNS + following, last - TURNS + this, np.full(TURNS, last)], 1))
    return Mesh(name, np.concatenate([top, *rings, bottom]), np.concatenate(faces), material)


# Renderers -----------------------------------------------------------------------------------------------------


def luxcore(plain: PlainScene, lamp: str, folder: Path) -> list[Image]:
    """Render by LuxCore's bidirectional path tracer."""
    kind = {POINT: f'type = "point"\nposition = 0 {TOP} 0', PARALLEL: 'type = "sharpdistant"\ndirection = 0 -1 0'}[lamp]

    def edit(scene: Path) -> None:
        settings = (scene / "scene.cfg").read_text().replace('"PATHCPU"', '"BIDIRCPU"')
        depths = f"path.maxdepth = {plain.max_depth}\nlight.maxdepth = {plain.max_depth}\n"
        (scene / "scene.cfg").write_text(settings + depths)
        with (scene / "scene.scn").open("a") as file:
            file.writelines(f"scene.lights.lamp.{line}\n" for line in kind.splitlines())

    return image_renderers.by_script("luxcore", "exr", plain, folder, 256, SEEDS, edit)


def radiance(plain: PlainScene, lamp: str, folder: Path) -> list[Image]:
    """Render by Radiance with a caustic photon map."""
    kind = {
        POINT: f"void light lamp 0 0 3 1e4 1e4 1e4\nlamp sphere place 0 0 4 0 {TOP} 0 0.01\n",
        PARALLEL: "void light lamp 0 0 3 1 1 1\nlamp source place 0 0 4 0 1 0 0.5\n",
    }[lamp]
    glass = len(plain.meshes) > 1

    def edit(scene: Path) -> None:
        with (scene / "scene.rad").open("a") as file:
            file.write(kind)
        mapped = "mkpmap -fo+ -apc caustic.pm 1000000 scene.oct\n" if glass else ""
        options = "-h -w -u+ -fdf -ab 0 -lr -8 -lw 1e-4" + " -ap caustic.pm 50" * glass
        text = (scene / "README.txt").read_text()
        command = f"{mapped}rtrace {options} scene.oct"
        (scene / "README.txt").write_text(re.sub(r"rtrace .*?scene\.oct", command, text, flags=re.DOTALL))

    return image_renderers.radiance_images(plain, folder, 64, SEEDS, edit)


def povray(plain: PlainScene, lamp: str, folder: Path) -> list[Image]:
    """Render by POV-Ray with photons, once: it has no seeds. The disk is added here: the export is of glass only."""
    disk, *glass = plain.meshes
    kind = {
        POINT: f"<0, {TOP}, 0> rgb 1e6 fade_distance 0.01 fade_power 2",
        PARALLEL: "<0, 20, 0> rgb 1 parallel point_at <0, 0, 0>",
    }[lamp]
    flat = f"pigment {{ rgb 1 }} finish {{ ambient 0 diffuse {REFLECTANCE} }}"
    more = (
        f"light_source {{ {kind} photons {{ reflection on refraction on }} }}\n"
        f"disc {{ 0, <0, 1, 0>, {np.abs(disk.vertices).max()} {flat} }}\n"
    )

    def edit(scene: Path) -> None:
        text = (scene / "scene.pov").read_text().replace("adc_bailout", "photons { count 1000000 } adc_bailout")
        target = "photons { target reflection on refraction on collect off } interior {"
        (scene / "scene.pov").write_text(text.replace("interior {", target) + more)

    return image_renderers.povray_images(dataclasses.replace(plain, meshes=tuple(glass)), folder, 64, SEEDS[:1], edit)


RENDERERS = {
    "LuxCore, bidirectional": Renderer("luxcore", luxcore),
    "POV-Ray, photons": Renderer("povray", povray),
    "Radiance, photon map": Renderer("radiance", radiance),
}


# Rows ----------------------------------------------------------------------------------------------------------


def tasks(context: Context) -> list[Task]:
    """Return one task per renderer and body."""
    return [
        Task(f"{NAME}: {title}, {body}", functools.partial(rows, context, title, body))
        for title in RENDERERS
        for body in LAMPS
    ]


def rows(context: Context, title: str, body: str) -> list[Row]:
    """Return one row: a renderer's power on the disk below a body."""
    renderer, lamp = RENDERERS[title], LAMPS[body]
    system, (setup, radius) = SYSTEMS[renderer.system], ON_AXIS[body, lamp]
    row = functools.partial(Row, NAME, title, f"{body}, {lamp}", f"{RESOLUTION}²")
    weights = caustic_energy.power_by_radiance(RESOLUTION)

    def sums(glass: bool) -> list[float]:
        with tempfile.TemporaryDirectory() as folder:
            images = renderer.draw(plain_scene(body, glass), lamp, Path(folder))
        return [float((image.pixels.mean(-1, dtype=np.float64) * weights).sum()) for image in images]

    reason = environments.why_not(system, context.profile.name)
    both, no_answer = environments.attempt(row, reason, LOST, lambda: (sums(glass=True), sums(glass=False)))
    if both is None:
        return no_answer
    caustic, plain = both
    direct = 2 * math.pi * (1 - TOP / math.hypot(TOP, radius)) if lamp == POINT else math.pi * radius**2
    exact, _ = caustic_energy.flux(setup, radius, BOUNDARIES)
    with np.errstate(divide="ignore", invalid="ignore"):  # images may be black
        power = float(np.divide(direct * statistics.fmean(caustic), statistics.fmean(plain)))
        spread = float(np.divide(max(caustic), min(caustic))) - 1
    values = {OFF: abs(power / exact - 1)} | ({SPREAD: spread} if len(caustic) > 1 else {})
    replay = {"renderer": system.source, "power": power, "exact power": exact, "seeds": [*SEEDS]}
    return [row(values, {OFF: limits.CAUSTIC_LEVEL}, replay=replay)]


STUDY = Study(NAME, "Caustics by others", about(__doc__), TERMS, tasks)
