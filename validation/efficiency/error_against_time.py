"""Efficiency: the error of an image against render time, by integrator, BSDF and sampler.

The reference is the mean of renders by the built-in (path + dielectric with `independent`) at the largest number of
samples per pixel. The variance of that mean is subtracted from the error. All methods render the same seed once per
round, with the better of Mitsuba's stratified samplers. Ratios are formed within a round; their median over the rounds
is reported. A method must not gain time by bias: the run fails if the mean of its images differs from the built-in's,
in a tile or in the whole image.

In Mitsuba's stratified samplers the numbers of two dimensions may be dependent, so the built-in with them may have
another expected image: the alarms of its row. `refract_path` has numbers of its own then, and is compared with the
reference; `path` with another BSDF is compared with renders by the built-in with the same sampler.
"""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refract.plugins import scene_features
from mi_refract.report.row import Reason, Row
from validation import limits
from validation.run import kernel_timing
from validation.run.context import NO_REFERENCE, SCENES, Context, beyond_builtin
from validation.run.metrics import DETECTABLE_IMAGE, EQUAL_TIME, EQUAL_TIME_DEFAULTS, TIME_OVER_BUILTIN, WELCH_ALARMS
from validation.run.render_methods import (
    BUILTIN,
    FROM_LAMPS,
    METHODS,
    OURS,
    Camera,
    Method,
    camera,
    welch_values_with_whole,
)
from validation.study import Study, Task, about

TERMS = {
    TIME_OVER_BUILTIN: "at equal samples per pixel and the same sampler; low, high: its 95 % interval over the rounds",
    "MSE": "mean over pixels and channels of the squared error; relMSE: over reference² + 0.01",
    "MSE, trimmed": "without the 0.1 % of pixels with the largest squared error, absolute or relative",
    EQUAL_TIME: "MSE × time over that of path + dielectric with the same sampler: 1 / relative efficiency",
    EQUAL_TIME_DEFAULTS: "the same over path + dielectric with `independent`, Mitsuba's default sampler",
    WELCH_ALARMS: "tiles and channels, and the whole image, whose mean differs from the reference's; at most one "
    "method in 1000 by chance. No budget for path + dielectric: with a stratified sampler these are its bias",
    DETECTABLE_IMAGE: "relative difference of the whole image's mean that is detected with a probability of 99 %",
}
AXES = {"x": "seconds", "y": "RMSE", "slope": -0.5}
NAME = "efficiency"
SCALAR = "needs a compiled variant: in a scalar one, Python dominates the time"
INDEPENDENT, STRATIFIED = "independent", ("multijitter", "orthogonal")
EPSILON, WORST = 0.01, 1e-3
TILE = 16
FIRST_REFERENCE = 1000  # first seed of the references; methods have smaller seeds
MEASURED = (*METHODS, FROM_LAMPS)  # in scenes without lamps, FROM_LAMPS renders like `refract_path`
METRICS = ("MSE", "MSE, trimmed", "relMSE", "relMSE, trimmed")


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    `references`: renders by the built-in with `independent`; with the better sampler there are a quarter as many.
    `spp` are squares of primes, which no sampler rounds. At least six rounds are needed for a 95 % interval. The
    resolution is doubled, up to `LARGEST`, until the built-in takes `seconds`. `scenes`: () is all.
    """

    spp: tuple[int, ...]
    rounds: int
    references: int
    resolution: int = 128
    seconds: float = 0.0
    scenes: tuple[str, ...] = ()


EXTENTS = {
    "quick": Extent((4, 9), 6, 48, resolution=64, scenes=("sphere",)),
    "standard": Extent((4, 25), 6, 48, resolution=96),
    "full": Extent((4, 9, 25), 8, 64, seconds=0.25),
}
LARGEST = 512


@dataclass(frozen=True)
class Subject:
    """A method with a sampler; the name has the sampler only if it is `independent`."""

    method: Method
    sampler: str

    @property
    def name(self) -> str:
        """The subject of its rows."""
        return self.method.name + (f", {INDEPENDENT}" if self.sampler == INDEPENDENT else "")


@dataclass(frozen=True)
class Measured:
    """One subject at one number of samples: seconds and figures by round; images only at the largest number."""

    seconds: list[float]
    figures: dict[str, list[float]]
    images: list[np.ndarray]

    def cost(self, metric: str) -> list[float]:
        """Return error × seconds by round."""
        return [error * seconds for error, seconds in zip(self.figures[metric], self.seconds, strict=True)]


BySubject = dict[str, dict[int, Measured]]  # by subject and samples per pixel
Shoot = Callable[[int, int], tuple[np.ndarray, float]]  # samples per pixel and seed → image, seconds; as `Camera`
Figures = Callable[[np.ndarray, np.ndarray, np.ndarray], dict[str, float]]  # image, reference, its variance → errors


def tasks(context: Context) -> list[Task]:
    """Return one task per scene that the built-in can render."""
    paths = [path for path in sorted(SCENES.glob("*.xml")) if not beyond_builtin(path)]
    return [
        Task(f"efficiency: {path.stem}", functools.partial(scene_rows, context, path), timed=True) for path in paths
    ]


def scene_rows(context: Context, path: Path, methods: tuple[Method, ...] = MEASURED) -> list[Row]:
    """Return a row per method and sampler and one of the curves, or one row with the reason why there are none."""
    extent = EXTENTS[context.profile.name]
    reason = ""
    if context.scalar:
        reason = SCALAR
    elif extent.scenes and path.stem not in extent.scenes:
        text = f"left out: the profile {context.profile.name} measures {', '.join(extent.scenes)}"
        reason = Reason(text, "`--profile full`")
    elif path.stem in NO_REFERENCE:
        reason = f"left out: {NO_REFERENCE[path.stem]}"
    else:
        reason = why_no_error(builtin_camera(path, extent.resolution, INDEPENDENT, extent))
    if reason:
        return [Row(NAME, "every method", path.stem, context.variant, reason=reason)]
    return _measured_rows(context, path, extent, methods)


def _measured_rows(context: Context, path: Path, extent: Extent, methods: tuple[Method, ...]) -> list[Row]:
    rows = []
    resolution = resolution_of(path, extent)
    sampler = best_sampler(path, resolution, extent)
    builtins = [Subject(BUILTIN, INDEPENDENT), Subject(BUILTIN, sampler)]
    subjects = builtins + [Subject(m, sampler) for m in methods if m != BUILTIN]
    spp = extent.spp[-1]
    cameras = {s.name: camera(path, s.method, resolution, sampler=s.sampler, spp=spp) for s in subjects}
    references, same_sampler = (
        np.stack([cameras[builtin.name](spp, seed=FIRST_REFERENCE + i)[0] for i in range(count)])
        for builtin, count in zip(builtins, (extent.references, extent.references // 4), strict=True)
    )
    measured = measure(cameras, references, extent.spp, extent.rounds, errors)
    goals = goals_of(subjects, measured, scene_features.inspect(cameras[builtins[0].name].scene).only_glass)
    replay = {
        "scene": path.name,
        "resolution": resolution,
        "spp": spp,
        "rounds": extent.rounds,
        "reference renders": extent.references,
        "reference seeds from": FIRST_REFERENCE,
        "sampler": sampler,
    }
    remark = f"the best stratified sampler here: {sampler}"
    for subject in subjects:
        expected = references if subject.method == BUILTIN or subject.method.integrator == OURS else same_sampler
        values = _values(subject, builtins, measured, expected)
        budgets = {} if subject.method == BUILTIN else {WELCH_ALARMS: 0.0}
        subject_replay = replay | {"method": subject.method.plugin(-1)}
        row = functools.partial(Row, NAME, subject.name, path.stem, context.variant)
        rows.append(row(values, budgets, goals.get(subject.name, {}), remark, subject_replay))
    curves = {
        name: [
            (statistics.median(m.seconds), math.sqrt(max(statistics.fmean(m.figures["MSE"]), 0)))  # RMSE
            for m in by_spp.values()
        ]
        for name, by_spp in measured.items()
    }
    values = {"reference variance": float(references.var(0, ddof=1).mean() / len(references))}
    row = functools.partial(Row, NAME, "every method", path.stem, context.variant)
    rows.append(row(values, reason=remark, replay=replay, curves=curves))
    return rows


def why_no_error(builtin: Shoot) -> str:
    """Return why a scene has no error against time; "" if images of two seeds differ."""
    noise = float(np.abs(builtin(1, 0)[0] - builtin(1, 1)[0]).max())
    if noise < limits.NOISE:  # false for NaN
        return f"left out: no noise, so no error against time (two seeds differ by at most {noise:.1e})"
    return ""


def builtin_camera(path: Path, resolution: int, sampler: str, extent: Extent) -> Camera:
    """Return the built-in's camera of a scene, by which sampler and resolution are chosen."""
    return camera(path, BUILTIN, resolution, sampler=sampler, spp=extent.spp[-1])


def resolution_of(path: Path, extent: Extent) -> int:
    """Return the image size at which the fixed cost of a render is negligible compared to that of its samples."""
    resolution = extent.resolution
    while resolution < LARGEST and extent.seconds:
        builtin = builtin_camera(path, resolution, INDEPENDENT, extent)
        if min(builtin(extent.spp[-1], seed=i)[1] for i in range(2)) >= extent.seconds:
            break
        resolution *= 2
    return resolution


def best_sampler(path: Path, resolution: int, extent: Extent, seeds: int = 3) -> str:
    """Return the stratified sampler with which the built-in has the least variance × time."""
    costs = {}
    for sampler in STRATIFIED:
        builtin = builtin_camera(path, resolution, sampler, extent)
        renders = [builtin(extent.spp[-1], seed=FIRST_REFERENCE - 1 - i) for i in range(seeds + 1)]
        warm = renders[1:]  # the first image compiles
        variance = np.stack([image for image, _ in warm]).var(0, ddof=1).mean()
        costs[sampler] = float(variance) * statistics.median(seconds for _, seconds in warm)
    return min(costs, key=lambda sampler: costs[sampler])


def measure(
    cameras: Mapping[str, Shoot], references: np.ndarray, spps: tuple[int, ...], count: int, figures_of: Figures
) -> BySubject:
    """Measure all subjects: `count` rounds with one image of each, every second round in reverse order.

    One more image of each, the first, compiles and is not measured. `figures_of`: such as `errors`.
    """
    mean, variance = references.mean(0), references.var(0, ddof=1) / len(references)
    measured: BySubject = {name: {} for name in cameras}
    for spp in spps:
        renders: dict[str, list[tuple[np.ndarray, float]]] = {name: [] for name in cameras}
        order = list(cameras)
        for seed in range(count + 1):
            for name in order:
                renders[name].append(cameras[name](spp, seed))
            order.reverse()
        for name, (_, *rounds) in renders.items():
            by_round = [figures_of(image, mean, variance) for image, _ in rounds]
            figures = {metric: [figure[metric] for figure in by_round] for metric in by_round[0]}
            images = [image for image, _ in rounds] if spp == spps[-1] else []
            measured[name][spp] = Measured([seconds for _, seconds in rounds], figures, images)
    return measured


def errors(image: np.ndarray, mean: np.ndarray, variance: np.ndarray) -> dict[str, float]:
    """Return MSE and relMSE against `mean`, minus its `variance`, with and without the worst pixels."""
    squared = np.square(image - mean)
    values: dict[str, float] = {}
    for metric, scale in (("MSE", np.ones_like(mean)), ("relMSE", np.square(mean) + EPSILON)):
        by_pixel = (squared / scale).mean(-1).ravel()
        unbiased = by_pixel - (variance / scale).mean(-1).ravel()
        trimmed = np.argsort(by_pixel)[: by_pixel.size - math.ceil(WORST * by_pixel.size)]
        values |= {metric: float(unbiased.mean()), f"{metric}, trimmed": float(unbiased[trimmed].mean())}
    return values


def _values(subject: Subject, builtins: list[Subject], measured: BySubject, references: np.ndarray) -> dict[str, float]:
    """Return the values of a row, at the most samples per pixel.

    `builtins`: path + dielectric with `independent`, and with the best sampler.
    """
    spp = max(measured[subject.name])
    test, default, best = (measured[s.name][spp] for s in (subject, *builtins))
    same = default if subject == builtins[0] else best
    values = kernel_timing.ratio(EQUAL_TIME, test.cost("MSE"), same.cost("MSE"))
    values |= kernel_timing.ratio(EQUAL_TIME_DEFAULTS, test.cost("MSE"), default.cost("MSE"))
    values |= kernel_timing.ratio(TIME_OVER_BUILTIN, test.seconds, same.seconds)
    values |= {"seconds": statistics.median(test.seconds)}
    values |= {metric: statistics.fmean(test.figures[metric]) for metric in METRICS}
    for metric in METRICS[1:]:
        ratios = [t / s for t, s in zip(test.cost(metric), same.cost(metric), strict=True)]
        values[f"equal-time {metric}"] = statistics.median(ratios)
    return values | welch_values_with_whole(references, np.stack(test.images), TILE)


def goals_of(subjects: list[Subject], measured: BySubject, only_glass: bool) -> dict[str, dict[str, float]]:
    """Return the goals by subject.

    The best of our methods has a goal at equal time: in scenes of glass only the best one that splits. It is chosen at
    fewer samples than its goal is measured at: the least of several in the same rounds would be too small. In scenes of
    glass, our method without parameters has a goal for its time.
    """
    ours = [s for s in subjects if s.method.integrator == OURS]
    candidates = [s for s in ours if s.method.parameters or not only_glass]
    goals: dict[str, dict[str, float]] = {s.name: {} for s in ours}
    if candidates:
        *_, spp, _ = sorted(measured[candidates[0].name])
        best = min(candidates, key=lambda s: statistics.median(measured[s.name][spp].cost("MSE")))
        goals[best.name] |= limits.ONLY_GLASS if only_glass else limits.MIXED
    for subject in ours:
        if only_glass and not subject.method.parameters:
            goals[subject.name][TIME_OVER_BUILTIN] = limits.ONLY_GLASS_TIME
    return goals


STUDY = Study(NAME, "Efficiency", about(__doc__), TERMS, tasks, axes=AXES)
