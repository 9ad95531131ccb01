"""A dispersive prism by a second renderer: what dispersion changes in the image, here and there.

LuxCore is the one of the suite that has dispersion: n = A + B/λ², as `cauchy(A, B)`. Both renderers draw the prism
with and without B (without: the index of the d line), and the differences of the two images are compared. The models
differ: LuxCore draws a wavelength for each path and weighs it by a colour of its own, whose mean is not white, so that
its prism is darker by a few percent; and its light is RGB from end to end. So the mean of each square of pixels is
taken out, and what is left, the coloured edges, is correlated. Noise is not in it: products are of images with other
seeds.
"""

from __future__ import annotations

import dataclasses
import functools
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.media import LINES
from mi_refract.rendering import scene_files
from mi_refract.report.row import Row
from mi_refract.scene_export import write_files
from mi_refract.scene_export.plain_scene import Glass, PlainScene
from validation.run.context import Context
from validation.run.render_methods import Camera, under
from validation.study import Study, Task, about

from .rendered_images import SCENES, why_not
from .renderers import environments
from .renderers.image_renderers import IMAGE_RENDERERS
from .renderers.table import SYSTEMS

NAME = "dispersion by others"
OTHER, SCENE, VARIANT = "LuxCore", "prism", "llvm_ad_spectral"
A, B = 1.6, 20000.0  # B in nm²
RESOLUTION, SQUARE = 96, 6
SPP, THEIR_SPP, SEEDS = 1024, 512, 4
CHANNELS = "red", "green", "blue"
TERMS = {
    "correlation": "of what dispersion changes at the edges, by LuxCore and here; 1 where both agree, above by chance",
    "size": "of that change by LuxCore, over ours",
    "darker": "by how much dispersion lowers the mean of LuxCore's image, relative",
}


def tasks(context: Context) -> list[Task]:
    """One."""
    return [Task(NAME, functools.partial(rows, context))]


def rows(context: Context) -> list[Row]:
    """One row of figures, or why there is none."""
    case, setting = SCENE, f"{RESOLUTION}²"
    reason = context.variants.get(VARIANT, "not in this wheel") or why_not(SYSTEMS["luxcore"], context)
    if reason:
        return [Row(NAME, OTHER, case, setting, reason=reason)]
    try:
        ours, theirs = ([draw(b) for b in (0.0, B)] for draw in (_ours, _theirs))
    except (environments.Unable, environments.Broken) as why:
        return [Row(NAME, OTHER, case, setting, reason=" ".join(str(why).split()))]
    values = compared(*(pair[1] - pair[0] for pair in (ours, theirs)))
    values["darker"] = float(1 - theirs[1].mean() / theirs[0].mean())
    return [Row(NAME, OTHER, case, setting, values, replay={"A": A, "B": B, "spp": [SPP, THEIR_SPP], "seeds": SEEDS})]


def compared(ours: np.ndarray, theirs: np.ndarray) -> dict[str, float]:
    """Correlation and ratio of sizes by channel of two stacks of changes, seeds × H × W × 3, without their noise."""
    values = {}
    one, two = ([_edges(half.mean(0)) for half in np.array_split(side.astype(float), 2)] for side in (ours, theirs))
    for i, channel in enumerate(CHANNELS):
        (a, b), (c, d) = ([half[..., i] for half in side] for side in (one, two))
        own, other, both = (a * b).mean(), (c * d).mean(), ((a + b) * (c + d)).mean() / 4
        values[f"correlation, {channel}"] = float(both / np.sqrt(own * other)) if min(own, other) > 0 else np.nan
        values[f"size, {channel}"] = float(np.sqrt(other / own)) if min(own, other) > 0 else np.nan
    return values


def _edges(image: np.ndarray) -> np.ndarray:
    """`image` (H × W × C) less the mean of each square of pixels."""
    height, width, channels = image.shape
    squares = image.reshape(height // SQUARE, SQUARE, width // SQUARE, SQUARE, channels)
    left: np.ndarray = squares - squares.mean((1, 3), keepdims=True)
    return left.reshape(image.shape)


def _plain(n: float) -> PlainScene:
    """The scene with glass of this index."""

    def glass(mesh: Any) -> Any:
        material = mesh.material
        changed = dataclasses.replace(material, int_ior=n, ext_ior=1.0) if isinstance(material, Glass) else material
        return dataclasses.replace(mesh, material=changed)

    plain = SCENES[SCENE].load(RESOLUTION)
    return dataclasses.replace(plain, meshes=tuple(map(glass, plain.meshes)))


def _ours(b: float) -> np.ndarray:
    with tempfile.TemporaryDirectory() as folder, under(VARIANT):
        write_files.write(_plain(A + B / LINES["d"] ** 2), "mitsuba", Path(folder) / "scene")
        file = Path(folder) / "scene" / "scene.xml"
        text = _once(r'<integrator type="[^"]*"', '<integrator type="refract_path"', file.read_text())
        if b:
            text = _once(r'<float name="int_ior" value="[^"]*"\s*/>', _index(b), text)
        file.write_text(text)
        camera = Camera(scene_files.load_scene(file, {"bsdf": "refract"}))
        return np.stack([camera(SPP, seed)[0][..., :3] for seed in range(SEEDS)])


def _index(b: float) -> str:
    return f'<string name="int_ior" value="cauchy({A}, {b})"/>'


def _theirs(b: float) -> np.ndarray:
    """LuxCore's B is in µm², and its A the index without it."""

    def changed(folder: Path) -> None:
        file = folder / "scene.scn"
        added = rf"\g<0>\nscene.materials.\1.cauchyb = {b / 1e6}"
        file.write_text(_once(r'scene\.materials\.(\w+)\.type = "glass"', added, file.read_text()))

    plain = _plain(A if b else A + B / LINES["d"] ** 2)
    with tempfile.TemporaryDirectory() as folder:
        draw = IMAGE_RENDERERS[OTHER].draw
        images = draw(plain, Path(folder), THEIR_SPP, range(1, SEEDS + 1), **({"edit": changed} if b else {}))
    return np.stack([image.pixels for image in images])


def _once(pattern: str, by: str, text: str) -> str:
    """ValueError unless there is one such place."""
    found, count = re.subn(pattern, by, text)
    if count != 1:
        raise ValueError(f"{pattern!r} is there {count} times; expected once")
    return found


STUDY = Study(NAME, "Dispersion by others", about(__doc__), TERMS, tasks)
