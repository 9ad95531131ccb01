"""Renders: scenes with `refract` and with `dielectric`, with the same and with independent seeds, and times.

Scenes with dispersion or absorption are left out, since `dielectric` has neither.

With the same seed both plugins use the same random numbers, so the images agree except where a last bit changes the
choice between reflection and refraction. Let x be the changes of the pixels, independent under the box filter of the
scenes, and of either sign with equal probability. Then |Σ x| > z √(Σ x²) has a probability of at most 2 exp(−z²/2), by
Hoeffding's inequality. Independent seeds are compared by Welch's t-test on tiles. The error of an image is its relMSE
against the mean of the built-in's other renders, minus the variance of that mean. Times are of alternating warm renders
of at least 0.1 s; in shorter ones the half millisecond that Mitsuba needs per render to trace a plugin written in
Python would matter.
"""

from __future__ import annotations

import functools
import itertools
import math
import statistics
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.formulas import FORMULAS
from mi_refract.image_diff import pixelwise, tile_statistics
from mi_refract.plugins import PLUGIN
from mi_refract.report.row import Row
from validation import limits
from validation.run import kernel_timing
from validation.run.array_settings import RIGHT_PLUGINS
from validation.run.context import NO_REFERENCE, Context
from validation.run.metrics import CHANGED_SHARE, DETECTABLE, MEANS_DIFFER, TIME_OVER_DIELECTRIC, WELCH_ALARMS
from validation.run.render_methods import DIELECTRIC as BUILTIN
from validation.run.render_methods import Camera, opened, save_image, welch_values
from validation.study import Study, Task, about

NAME = "renders"
TIME = TIME_OVER_DIELECTRIC
TERMS = {
    "reference, test, difference": "dielectric, refract, refract − dielectric: means over the same seeds",
    CHANGED_SHARE: "pixels with a channel that differs by more than 1e-5, same seeds",
    WELCH_ALARMS: "tiles and channels whose means differ, independent seeds; at most one image in 1000 by chance",
    DETECTABLE: "relative difference of a tile's mean that is detected with a probability of 99 %, median over tiles, "
    "worst channel",
    TIME: "median over alternating warm renders; a goal, not a budget, because a busy machine disturbs it; with a "
    "name: of the plugin with that formula; low, high: the 95 % interval",
}
AXES = {"x": "seconds", "y": "relMSE", "slope": -1}  # relMSE is a variance
# Paths in these scenes are short: a difference in the last bit stays small, unless it changes the choice of a lobe.
SHORT_PATHS = {"sphere", "slab", "prism", "furnace"}
CHANGED = 1e-5
UNIFORM = 1e-3  # images whose range is at most this are not shown
TILE = 16
CURVE_SEEDS = 2
TIMED = 0.1  # seconds: the shortest render that is timed


def tasks(context: Context) -> list[Task]:
    """Return one task per scene and plugin of this package."""
    plugins = [PLUGIN] + [f"{PLUGIN}_{name}" for name in FORMULAS if context.profile.every_formula]
    return [
        Task(f"renders: {path.stem}, {plugin}", functools.partial(_compare, context, path, plugin), timed=True)
        for path in context.comparable
        for plugin in plugins
    ]


def _compare(context: Context, path: Path, plugin: str) -> list[Row]:
    profile, scene = context.profile, path.stem
    cameras = {name: Camera(opened(path, name, profile.resolution)) for name in (plugin, BUILTIN)}
    test, reference = (
        np.stack([camera(profile.spp, seed)[0] for seed in range(profile.pairs)]) for camera in cameras.values()
    )
    half, left_out = profile.pairs // 2, why_no_welch(test, reference)
    # Images of the same seeds, pixel by pixel; then Welch's test of images of independent seeds.
    pairs = pixelwise.changes(reference.reshape(-1, *reference.shape[2:]), test.reshape(-1, *test.shape[2:]), CHANGED)
    values = {CHANGED_SHARE: pairs.share, "largest change": pairs.largest, "RMSE": pairs.rms}
    values |= {MEANS_DIFFER: abs(pairs.mean_ratio - 1)}
    if not left_out:
        values |= welch_values(reference[half:], test[:half], TILE)
    times, goals = _timed(context, path, plugin, cameras)
    replay: dict[str, Any] = {
        "scene": path.name,
        "plugin": plugin,
        "variant": context.variant,
        "resolution": profile.resolution,
        "spp": profile.spp,
        "seeds": profile.pairs,
    }
    images, means = {}, (test.mean(0), reference.mean(0))
    if not np.ptp(means) <= UNIFORM:  # NaN is shown
        for role, image in (("reference", means[1]), ("test", means[0]), ("difference", means[0] - means[1])):
            name = BUILTIN if role == "reference" else f"{plugin} {role}"
            images[role] = save_image(context.out, f"{scene}/{name}", image, replay | {"role": role})
    curves: dict[str, list[tuple[float, float]]] = {}
    if plugin == PLUGIN and reference.std(0).max() >= CHANGED and scene not in NO_REFERENCE:
        # relMSE against seconds at growing samples per pixel, alternating; with seeds that the reference does not have.
        for spp, name in itertools.product(profile.curve_spp, cameras):
            points = [cameras[name](spp, seed=profile.pairs + i) for i in range(CURVE_SEEDS)]
            error = statistics.fmean(tile_statistics.relative_mse(image, reference) for image, _ in points)
            curves.setdefault(name, []).append((statistics.median(seconds for _, seconds in points), error))
    z = math.sqrt(2 * math.log(2 / limits.NULL_ALARM))
    chance, mean = z * pairs.rms / math.sqrt(reference[..., 0].size), float(reference.mean())
    allowed = min(limits.MEANS, limits.WELCH_MARGIN + (chance / mean if mean else 0))
    budgets, remark = _budgets(scene, left_out, allowed), NO_REFERENCE.get(scene, left_out)
    row = functools.partial(Row, NAME, plugin, scene, context.variant)
    return [row(values | times, budgets, goals, remark, replay, images, curves)]


def _budgets(scene: str, left_out: str, means: float) -> dict[str, float]:
    """Return the budgets of a scene. `means`: the most by which rounding and chance make the means differ, relative."""
    if scene in NO_REFERENCE:
        return {}
    budgets = {MEANS_DIFFER: means} | ({} if left_out else {WELCH_ALARMS: 0.0})
    return budgets | ({CHANGED_SHARE: limits.CHANGED} if left_out or scene in SHORT_PATHS else {})


def _timed(
    context: Context, path: Path, plugin: str, cameras: dict[str, Camera]
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the values "time / dielectric" of the plugin and of other forms, and the goals of those that have one."""
    import mitsuba as mi

    # The default times both forms at the rounding limit; `quick` saves their kernels.
    profile = context.profile
    others = RIGHT_PLUGINS if plugin == PLUGIN and not profile.quick else []
    cameras = cameras | {name: Camera(opened(path, name, profile.resolution)) for name in others}
    _, seconds = cameras[BUILTIN](profile.spp, seed=0)
    spp = profile.spp
    if dr.is_jit_v(mi.Float):  # a scalar plugin costs calls per sample: more samples do not reduce their share
        spp *= 2 ** max(0, math.ceil(math.log2(TIMED / seconds)))
    times = kernel_timing.rounds(cameras, lambda camera: camera(spp, seed=0)[1], profile.repeats)
    metrics = {plugin: TIME} | {name: f"{TIME}, {name.removeprefix(PLUGIN + '_')}" for name in others}
    values = {"timed renders": float(profile.repeats), "timed spp": float(spp)}
    for name, metric in metrics.items():
        values |= kernel_timing.ratio(metric, times[name], times[BUILTIN])
    # In scalar variants a Python plugin costs a call per operation, so only compiled variants have goals.
    with_goal = [] if context.scalar else metrics.values()
    return values, dict.fromkeys(with_goal, limits.RENDER_TIME)


def why_no_welch(test: np.ndarray, reference: np.ndarray) -> str:
    """Return why the images need no Welch's test; "" if they need it."""
    if np.array_equal(test, reference):
        return "left out: Welch's test, because images of the same seed are identical bit for bit"
    if reference.std(0).max() < CHANGED and test.std(0).max() < CHANGED:  # false for NaN
        return "left out: Welch's test and error against time, because independent seeds give the same image"
    return ""


STUDY = Study(NAME, "Renders", about(__doc__), TERMS, tasks, axes=AXES)
