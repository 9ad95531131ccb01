"""Colours: scenes with dispersion or absorption, in a spectral variant, by `refract_path`.

`dielectric` has neither, and no other integrator supports them: the images are shown without a budget. Tests check how
the plugins treat light of several wavelengths.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.plugins import PLUGIN
from mi_refract.report.row import Row
from validation.run.context import Context, beyond_builtin
from validation.run.render_methods import Camera, opened, save_image, under
from validation.study import Study, Task, about

NAME = "colours"
COLOUR = "colour"
TERMS = {
    COLOUR: "sum over the pixels of the largest channel minus the smallest, over the sum of all channels",
    "noise": "root mean square of the pixels' standard errors, over the mean of the image",
}
REPEATED = 4  # times as many renders as the profile's: single wavelengths have more noise than RGB
NOISE, MOST = 0.05, 16  # noise up to which more renders are added, up to 16 times as many
SCALAR = "needs a compiled variant: in a scalar one an image takes hours"
SHOWN = "shown, not judged: no other renderer here has dispersion and absorption"


def tasks(context: Context) -> list[Task]:
    """Return one task per scene that the built-in cannot render."""
    paths = [path for path in context.scenes if beyond_builtin(path)]
    return [Task(f"colours: {path.stem}", functools.partial(scene_rows, context, path)) for path in paths]


def scene_rows(context: Context, path: Path) -> list[Row]:
    """Return one row with the image, or with the reason why the spectral variant does not run."""
    variant = context.variant.replace("_rgb", "_spectral")
    reason = SCALAR if context.scalar else context.variants.get(variant, "not in this wheel")
    if reason:
        return [Row(NAME, PLUGIN, path.stem, variant, reason=reason)]
    profile = context.profile
    with under(variant):
        camera = Camera(opened(path, PLUGIN, profile.resolution))
        image, noise, seeds = _mean(camera, profile.spp, REPEATED * profile.pairs, 1 if profile.quick else MOST)
    replay: dict[str, Any] = {
        "scene": path.name,
        "plugin": PLUGIN,
        "variant": variant,
        "resolution": profile.resolution,
        "spp": profile.spp,
        "seeds": seeds,
    }
    shown = save_image(context.out, f"{path.stem}/{PLUGIN} spectral", image, replay)
    values = {COLOUR: float((image.max(2) - image.min(2)).sum() / image.sum()), "noise": noise}
    return [Row(NAME, PLUGIN, path.stem, variant, values, reason=SHOWN, replay=replay, images={"test": shown})]


def _mean(camera: Camera, spp: int, count: int, most: int) -> tuple[np.ndarray, float, int]:
    """Return the mean of `count` to `count × most` renders, its noise, and the number of renders."""
    total = squares = np.zeros(())
    for seed in range(count * most):
        render = camera(spp, seed=seed)[0].astype(float)
        total, squares, taken = total + render, squares + render * render, seed + 1
        if taken % count == 0:
            mean = total / taken
            noise = float(np.sqrt((squares / taken - mean**2).mean() / (taken - 1)) / mean.mean())
            if noise <= NOISE:
                break
    return mean, noise, taken


STUDY = Study(NAME, "Colours", about(__doc__), TERMS, tasks)
