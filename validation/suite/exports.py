"""Exports: does another renderer make Mitsuba's image of a scene from the exported files?

Each renderer renders 16 × 9 pixels from what users get: the exported files, with the options of the exported
README.txt. Nothing in the scene is symmetric: four balls of different glass under a rotated sky, a lamp, a coloured
patch (not for POV-Ray, whose export holds glass and lights only), for Cycles also a point and a directional lamp, a
tilted camera, and a film that is not square. Both sides are means of several renders. Their RMSE may be twice what the
spread between renders predicts plus 1 % of the mean. A wrong camera, sky or index exceeds that many times over.

Khronos' `gltf-validator` checks the glTF export of each scene of `scenes/` that glTF can represent, and of a scene with
lamps without size and a unit sphere with vertex normals.
"""

from __future__ import annotations

import dataclasses
import functools
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mi_refract.io.errors import ExportError
from mi_refract.report.row import Row
from mi_refract.scene_export import from_mitsuba, targets, tessellation
from mi_refract.scene_export.plain_scene import (
    Camera,
    Diffuse,
    DirectionalLamp,
    Glass,
    Light,
    Material,
    Mesh,
    PlainScene,
    PointLamp,
    SpotLamp,
)
from validation import limits
from validation.run.context import SCENES, Context
from validation.study import Study, Task, about
from validation.suite.renderers.image_renderers import IMAGE_RENDERERS

from .rendered_images import RASTER, RENDERS, THREE, askew, by_plugin, why_not
from .renderers import SYSTEMS, environments
from .renderers.system import SCRIPTS

NAME = "exports"
SEEDS = range(1, RENDERS + 1)  # of the other renderer
SPP, SIZE = 512, (16, 9)
OVER, NOISE = "RMSE / allowed", "noise / mean"
ERRORS, WARNINGS = "errors", "warnings"
VALIDATOR, LEVEL = "gltf_validator", 2
TERMS = {
    OVER: "RMSE of the two means over pixels and channels; allowed: twice the noise that the spread between renders "
    "predicts, plus 1 % of the mean",
    NOISE: "the predicted noise of the difference of the two means",
    ERRORS: "in both files, `scene.glb` and `scene.gltf`, as for the warnings, which have a goal",
}
# Variants of the scene. Other renderers get it with the patch and without lamps without size.
SHOWN = {"POV-Ray": "no patch", "Cycles": "lamps", "Cycles, glTF": "lamps"}
LEFT_OUT = {
    THREE: "it counts the light of the sky twice, see the study of images; its variant without MIS is tested here",
    RASTER: "it traces no paths, see the study of images",
} | {title: "it is the reference" for title, renderer in IMAGE_RENDERERS.items() if renderer.system == "mitsuba"}
# Samples per pixel and render; 256 for the other renderers.
THEIRS = {"POV-Ray": 256, "Cycles": 512, "Cycles, glTF": 512, "LuxCore": 1024, "Radiance": 512}


def scene(shown: str = "") -> PlainScene:
    """Return the balls of `balls` from another viewpoint, with a lamp and a patch. `shown`: a value of SHOWN."""
    balls = from_mitsuba.load(SCENES / "balls.xml", level=2)
    camera = Camera((30.0, 15.0, 240.0), (3.0, -4.0, 0.0), (0.3, 1.0, 0.2), 48.0, *SIZE)
    extra = [_quad("lamp", (-100.0, 22.0), (-72.0, 50.0), Light((3.0, 2.0, 1.0)))]
    if shown != "no patch":
        extra.append(_quad("patch", (70.0, -50.0), (105.0, 10.0), Diffuse((0.2, 0.5, 0.9))))
    meshes, bulb = (*balls.meshes, *extra), PointLamp("bulb", (60.0, 0.0, 80.0), (6000.0, 3000.0, 9000.0))
    lamps = (bulb, DirectionalLamp("sun", (0.0, 0.6, -0.8), (1.0, 3.0, 2.0))) if shown == "lamps" else ()
    return dataclasses.replace(balls, name="balls", meshes=meshes, sky=askew(), camera=camera, lamps=lamps)


def lit() -> PlainScene:
    """Return a unit sphere of glass, and one lamp of each kind without size."""
    vertices, faces = tessellation.sphere(LEVEL)
    ball, place, ahead = Mesh("ball", vertices, faces, Glass(1.5, 1.0), vertices), (1.0, 2.0, 3.0), (0.0, 0.6, -0.8)
    intensity = place
    lamps = PointLamp("point", place, intensity), DirectionalLamp("sun", ahead, intensity)
    spots = (SpotLamp(f"spot{beam:g}", place, intensity, ahead, beam, 30.0) for beam in (0.0, 20.0, 30.0))
    camera = Camera((0.0, 0.0, 9.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, *SIZE)
    return PlainScene("lamps", (ball,), (0.0, 0.0, 0.0), camera, 8, (*lamps, *spots))


def _quad(name: str, low: tuple[float, float], high: tuple[float, float], material: Material) -> Mesh:
    """Return a rectangle in the plane z = 0 that faces +z."""
    corners = [(low[0], low[1], 0.0), (high[0], low[1], 0.0), (high[0], high[1], 0.0), (low[0], high[1], 0.0)]
    return Mesh(name, np.array(corners), np.array([(0, 1, 2), (0, 2, 3)]), material)


def tasks(context: Context) -> list[Task]:
    """Return one task per renderer, and one for the glTF validator."""
    titles = [title for title in IMAGE_RENDERERS if title not in LEFT_OUT]
    images = [Task(f"exports: {title}", functools.partial(rows, context, title)) for title in titles]
    return [*images, Task(f"exports: {SYSTEMS[VALIDATOR].title}", functools.partial(validated, context))]


def rows(context: Context, title: str) -> list[Row]:
    """Return one row: a renderer against `refract`."""
    system = SYSTEMS[IMAGE_RENDERERS[title].system]
    row = functools.partial(Row, NAME, title, "balls", f"{SIZE[0]} × {SIZE[1]}")
    lost = "not rendered", float(len(SEEDS))
    theirs, no_answer = environments.attempt(row, why_not(system, context), lost, lambda: drawn(title))
    if theirs is None:
        return no_answer
    values, budgets = compared(reference(SHOWN.get(title, "")), theirs), {OVER: 1.0, NOISE: limits.EXPORT_NOISE}
    replay = {"renderer": system.source, "spp": THEIRS.get(title, 256), "reference spp": SPP, "seeds": [*SEEDS]}
    return [row(values, budgets, replay=replay)]


def validated(context: Context) -> list[Row]:
    """Return a row per scene: the messages of Khronos' validator on its glTF export. Not run if glTF cannot hold it."""
    system, made = SYSTEMS[VALIDATOR], []
    paths = sorted(SCENES.glob("*.xml"))
    scenes = {path.stem: functools.partial(from_mitsuba.load, path, level=LEVEL) for path in paths} | {"lamps": lit}
    for name, load in scenes.items():
        row = functools.partial(Row, NAME, system.title, name, "glTF")

        def counts(load: Callable[[], PlainScene] = load) -> dict[str, float]:
            with tempfile.TemporaryDirectory() as folder:
                try:
                    written = targets.write(load(), "gltf", Path(folder) / "scene")
                except ExportError as error:
                    raise environments.Unable(str(error)) from None
                files = [str(file) for file in written if file.suffix in (".glb", ".gltf")]
                command = ("node", str(SCRIPTS / "validate_gltf.mjs"), "{environment}")
                lines = [line.split() for line in environments.ask(system, command, "\n".join(files)).splitlines()]
            if len(lines) != len(files) or not files:
                raise ValueError(f"{len(lines)} answers for {len(files)} files; expected one per file")
            return {name: float(sum(int(line[i]) for line in lines)) for i, name in enumerate((ERRORS, WARNINGS))}

        reason, lost = environments.why_not(system, context.profile.name), (ERRORS, 1.0)
        values, no_answer = environments.attempt(row, reason, lost, counts)
        made += no_answer if values is None else [row(values, {ERRORS: 0.0}, {WARNINGS: 0.0})]
    return made


def drawn(title: str) -> np.ndarray:
    """Return images by another renderer: renders × height × width × 3."""
    with tempfile.TemporaryDirectory() as folder:
        images = IMAGE_RENDERERS[title].draw(scene(SHOWN.get(title, "")), Path(folder), THEIRS.get(title, 256), SEEDS)
    return np.stack([image.pixels for image in images]).astype(np.float64)


@functools.cache
def reference(shown: str) -> np.ndarray:
    """Return images by this plugin in the current variant: renders × height × width × 3."""
    return np.stack(by_plugin(scene(shown), SPP)).astype(np.float64)


def compared(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Return the values of a row. A pixel that is not finite makes them NaN, which breaks the budget."""
    noise = float(np.sqrt(sum((side.var(0, ddof=1) / len(side)).mean() for side in (ours, theirs))))
    rmse = float(np.sqrt(np.square(theirs.mean(0) - ours.mean(0)).mean()))
    mean = float(ours.mean())
    allowed = limits.EXPORT_SIGMAS * noise + limits.EXPORT_SYSTEMATIC * mean
    return {OVER: rmse / allowed, NOISE: noise / mean, "RMSE / mean": rmse / mean}


STUDY = Study(NAME, "Exports", about(__doc__), TERMS, tasks)
