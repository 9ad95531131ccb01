"""One wavelength for all against one render per wavelength: error at equal time.

The usual way to render dispersion without it is a render for each of a number of bands, with the index of the band's
middle, whose sum is the image. It follows four wavelengths through every boundary, but each render knows one band only,
and the colours of an edge come in steps. The error is the variance of a pixel over independent renders; that of the
steps is not in it.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np

from mi_refract import media
from mi_refract.report.row import Row
from validation.run.context import Context
from validation.run.render_methods import Camera, under
from validation.study import Study, Task, about

from .ray_directions import N_SF11
from .renders import ours

NAME = "hero wavelength"
VARIANT = "llvm_ad_spectral"
BANDS = 16
SPP, SEEDS = 64, 8
TERMS = {
    "time": "of the bands over that of one render, with as many samples in all",
    "variance": "the same of the mean variance of a pixel",
    "error at equal time": "the product: above 1 one render with a hero wavelength is better",
    "means": "largest difference of the images' means, relative",
}


def _scene(n: float | str, band: tuple[float, float] | None = None) -> Any:
    """A ball in a sky of patches; `band`: the wavelengths in nm that the camera sees."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 64, "height": 64, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    place = mi.ScalarTransform4f().look_at([0, 1, 5], [0, 0, 0], [0, 1, 0])
    eye = {"type": "perspective", "fov": 30, "to_world": place, "film": film | {"component_format": "float32"}}
    if band:
        knots = ", ".join(f"{x:.9g}" for x in (band[0] - 1e-3, band[0], band[1], band[1] + 1e-3))
        eye["srf"] = {"type": "irregular", "wavelengths": knots, "values": "0, 1, 1, 0"}
    sky = np.random.default_rng(0).random((8, 16, 1)).astype(np.float32) * np.ones(3, np.float32)
    ball = {"type": "sphere", "bsdf": {"type": "refract", "int_ior": n, "ext_ior": 1.0}}
    parts = {"sensor": eye, "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)}, "ball": ball}
    return mi.load_dict({"type": "scene", "integrator": ours()} | parts)


def rows(context: Context) -> list[Row]:
    """The two ways in turn, with independent seeds."""
    if reason := context.variants.get(VARIANT, "not in this wheel"):
        return [Row(NAME, "refract_path", "ball", VARIANT, reason=reason)]
    edges = np.linspace(360.0, 830.0, BANDS + 1).tolist()
    bands = list(itertools.pairwise(edges))
    with under(VARIANT):
        hero = [Camera(_scene(N_SF11))]
        parts = [Camera(_scene(float(media.index(N_SF11, (a + b) / 2)), (a, b))) for a, b in bands]
        (one, fast), (many, slow) = (_measured(cameras) for cameras in (hero, parts))
    variances = [images.var(0, ddof=1).mean() for images in (one, many)]
    means = [images.mean((0, 1, 2)) for images in (one, many)]
    time, variance = slow / fast, variances[1] / variances[0]
    values = {"time": time, "variance": variance, "error at equal time": time * variance}
    values["means"] = np.abs(means[1] / means[0] - 1).max()
    replay = {"bands": BANDS, "spp": SPP, "seeds": SEEDS}
    return [Row(NAME, "refract_path", "ball", VARIANT, {k: float(x) for k, x in values.items()}, replay=replay)]


def _measured(cameras: list[Camera]) -> tuple[np.ndarray, float]:
    """Sums of the cameras' images, one a seed, and the median of their seconds; SPP samples in all of them together."""
    spp = SPP // len(cameras)
    for camera in cameras:
        camera(spp, 1000)  # compiles
    images, seconds = [], []
    for seed in range(SEEDS):
        parts = [camera(spp, len(cameras) * seed + i) for i, camera in enumerate(cameras)]
        images.append(sum(image[..., :3] for image, _ in parts))
        seconds.append(sum(time for _, time in parts))
    return np.stack(images), float(np.median(seconds))


def tasks(context: Context) -> list[Task]:
    """One."""
    return [Task(NAME, functools.partial(rows, context), timed=True)]


STUDY = Study(NAME, "Hero wavelength", about(__doc__), TERMS, tasks)
