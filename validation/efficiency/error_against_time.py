"""Efficiency: the error of an image against render time, by integrator, BSDF and sampler.

The reference is the mean of independent renders by the built-in (path + dielectric with the better of its stratified
samplers) at the largest number of samples per pixel measured here; the variance of that mean is subtracted from the
error. All methods render the same seed once per round; a ratio is formed within a round, and the median over the rounds
is reported. A method must not be faster by being biased: the run fails if the mean of its images differs from the
built-in's.
"""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refract.image_diff import tile_statistics
from mi_refract.plugins import scene_features
from mi_refract.report.row import Reason, Row
from validation import limits
from validation.run import kernel_timing
from validation.run.context import NO_REFERENCE, SCENES, Context, beyond_builtin
from validation.run.metrics import (
    DETECTABLE,
    EQUAL_TIME,
    EQUAL_TIME_DEFAULTS,
    SMALLEST_P,
    TIME_OVER_BUILTIN,
    WELCH_ALARMS,
)
from validation.run.render_methods import BUILTIN, FROM_LAMPS, METHODS, OURS, Camera, Method, camera
from validation.study import Study, Task, about

TERMS = {
    TIME_OVER_BUILTIN: "at equal samples per pixel and the same sampler; low, high: its 95 % interval over the rounds",
    "MSE": "mean over pixels and channels of the squared error; relMSE: over reference² + 0.01",
    "MSE, trimmed": "without the 0.1 % of pixels where the squared error, or the relative one, is largest",
    EQUAL_TIME: "MSE × time over that of path + dielectric with the same sampler: 1 / relative efficiency",
    EQUAL_TIME_DEFAULTS: "the same over that of path + dielectric with `independent`, Mitsuba's default",
    WELCH_ALARMS: "tiles and channels whose mean differs from the reference's; at most one method in 1000 by chance",
}
AXES = {"x": "seconds", "y": "RMSE", "slope": -0.5}
NAME = "efficiency"
SCALAR = "needs a compiled variant: a scalar one's time is that of Python"
INDEPENDENT, STRATIFIED = "independent", ("multijitter", "orthogonal")
EPSILON, WORST = 0.01, 1e-3
TILE = 16
FIRST_REFERENCE = 1000  # seed: no method has seen any from here on
MEASURED = (*METHODS, FROM_LAMPS)  # in scenes without lamps the last is `refract_path` as it is
METRICS = ("MSE", "MSE, trimmed", "relMSE", "relMSE, trimmed")


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    `spp` are squares of primes: every sampler takes them as they are. Six rounds are the fewest that have a 95 %
    interval. The resolution is doubled, up to `LARGEST`, until the built-in takes `seconds`. `scenes`: () is all.
    """

    spp: tuple[int, ...]
    rounds: int
    references: int
    resolution: int = 128
    seconds: float = 0.0
    scenes: tuple[str, ...] = ()


EXTENTS = {
    "quick": Extent((4, 9), 6, 12, resolution=64, scenes=("sphere",)),
    "standard": Extent((4, 25), 6, 12, resolution=96),
    "full": Extent((4, 9, 25), 8, 16, seconds=0.25),
}
LARGEST = 512


@dataclass(frozen=True)
class Subject:
    """A method with a sampler, named only where it is not the scene's best stratified one."""

    method: Method
    sampler: str

    @property
    def name(self) -> str:
        """As it stands in the rows."""
        return self.method.name + (f", {INDEPENDENT}" if self.sampler == INDEPENDENT else "")


@dataclass(frozen=True)
class Measured:
    """Seconds and figures by round of one subject at one number of samples; its images at the most samples."""

    seconds: list[float]
    figures: dict[str, list[float]]
    images: list[np.ndarray]

    def cost(self, metric: str) -> list[float]:
        """Error times seconds, by round: half of it takes half of the time."""
        return [error * seconds for error, seconds in zip(self.figures[metric], self.seconds, strict=True)]


Found = dict[str, dict[int, Measured]]  # by subject and samples per pixel
Shoot = Callable[[int, int], tuple[np.ndarray, float]]  # samples per pixel and seed → image, seconds; as `Camera`
Figures = Callable[[np.ndarray, np.ndarray, np.ndarray], dict[str, float]]  # image, reference, its variance → errors


def tasks(context: Context) -> list[Task]:
    """One task per scene that the built-in can render."""
    paths = [path for path in sorted(SCENES.glob("*.xml")) if not beyond_builtin(path)]
    return [
        Task(f"efficiency: {path.stem}", functools.partial(scene_rows, context, path), timed=True) for path in paths
    ]


def scene_rows(context: Context, path: Path, methods: tuple[Method, ...] = MEASURED) -> list[Row]:
    """A row per method and sampler, and one of the curves; a single one with the reason where nothing is measured."""
    extent = EXTENTS[context.profile.name]
    reason = ""
    if context.variant.startswith("scalar"):
        reason = SCALAR
    elif extent.scenes and path.stem not in extent.scenes:
        text = f"left out: the profile {context.profile.name} measures {', '.join(extent.scenes)}"
        reason = Reason(text, "`--profile full`")
    elif path.stem in NO_REFERENCE:
        reason = f"left out: {NO_REFERENCE[path.stem]}"
    else:
        look = builtin_camera(path, extent.resolution, INDEPENDENT, extent)
        noise = float(np.abs(look(1, seed=0)[0] - look(1, seed=1)[0]).max())
        if noise < limits.NOISE:
            reason = f"left out: no noise, so no error against time: two seeds differ by {noise:.1e} at most"
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
    look = cameras[builtins[1].name]
    references = np.stack([look(spp, seed=FIRST_REFERENCE + i)[0] for i in range(extent.references)])
    measured = measure(cameras, references, extent.spp, extent.rounds, errors)
    goals = goals_of(subjects, measured, scene_features.inspect(look.scene).only_glass)
    replay = {
        "scene": path.name,
        "resolution": resolution,
        "spp": spp,
        "rounds": extent.rounds,
        "reference renders": extent.references,
        "reference seeds from": FIRST_REFERENCE,
        "sampler": sampler,
    }
    about_sampler = f"the best stratified sampler here: {sampler}"
    for subject in subjects:
        values = _values(subject, builtins, measured, references)
        budgets = {} if subject.method == BUILTIN else {WELCH_ALARMS: 0.0}  # the reference is the built-in's own
        own = replay | {"method": subject.method.plugin(-1)}
        mine = goals.get(subject.name, {})
        rows.append(Row(NAME, subject.name, path.stem, context.variant, values, budgets, mine, about_sampler, own))
    curves = {
        name: [
            (statistics.median(m.seconds), math.sqrt(max(statistics.fmean(m.figures["MSE"]), 0)))  # RMSE
            for m in by_spp.values()
        ]
        for name, by_spp in measured.items()
    }
    own_variance = {"reference variance": float(references.var(0, ddof=1).mean() / len(references))}
    every = (NAME, "every method", path.stem, context.variant)
    rows.append(Row(*every, own_variance, {}, {}, about_sampler, replay, {}, curves))
    return rows


def builtin_camera(path: Path, resolution: int, sampler: str, extent: Extent) -> Camera:
    """The scene for the built-in, which chooses sampler and resolution."""
    return camera(path, BUILTIN, resolution, sampler=sampler, spp=extent.spp[-1])


def resolution_of(path: Path, extent: Extent) -> int:
    """The image size at which the fixed cost of a render is negligible beside that of its samples."""
    resolution = extent.resolution
    while resolution < LARGEST and extent.seconds:
        look = builtin_camera(path, resolution, INDEPENDENT, extent)
        if min(look(extent.spp[-1], seed=i)[1] for i in range(2)) >= extent.seconds:
            break
        resolution *= 2
    return resolution


def best_sampler(path: Path, resolution: int, extent: Extent, seeds: int = 3) -> str:
    """The stratified sampler with which the built-in has the least variance × time."""
    costs = {}
    for sampler in STRATIFIED:
        look = builtin_camera(path, resolution, sampler, extent)
        shots = [look(extent.spp[-1], seed=FIRST_REFERENCE - 1 - i) for i in range(seeds + 1)][1:]
        variance = np.stack([image for image, _ in shots]).var(0, ddof=1).mean()
        costs[sampler] = float(variance) * statistics.median(seconds for _, seconds in shots)
    return min(costs, key=lambda sampler: costs[sampler])


def measure(
    cameras: Mapping[str, Shoot], references: np.ndarray, spps: tuple[int, ...], count: int, figures_of: Figures
) -> Found:
    """`Measured` by subject and samples per pixel. A round has an image of each, every second one in reverse order.

    `count`: of rounds; the first image of each is thrown away: it compiles. `figures_of`: as `errors`.
    """
    mean, own = references.mean(0), references.var(0, ddof=1) / len(references)
    found: Found = {name: {} for name in cameras}
    for spp in spps:
        shots: dict[str, list[tuple[np.ndarray, float]]] = {name: [] for name in cameras}
        order = list(cameras)
        for seed in range(count + 1):
            for name in order:
                shots[name].append(cameras[name](spp, seed))
            order.reverse()
        for name, (_, *rounds) in shots.items():
            by_round = [figures_of(image, mean, own) for image, _ in rounds]
            figures = {metric: [figure[metric] for figure in by_round] for metric in by_round[0]}
            kept = [image for image, _ in rounds] if spp == spps[-1] else []
            found[name][spp] = Measured([seconds for _, seconds in rounds], figures, kept)
    return found


def errors(image: np.ndarray, mean: np.ndarray, own: np.ndarray) -> dict[str, float]:
    """MSE and relMSE against `mean`, of which `own` is the variance, with and without the worst pixels."""
    squared = np.square(image - mean)
    found: dict[str, float] = {}
    for metric, scale in (("MSE", np.ones_like(mean)), ("relMSE", np.square(mean) + EPSILON)):
        by_pixel = (squared / scale).mean(-1).ravel()
        less = by_pixel - (own / scale).mean(-1).ravel()
        kept = np.argsort(by_pixel)[: by_pixel.size - math.ceil(WORST * by_pixel.size)]
        found |= {metric: float(less.mean()), f"{metric}, trimmed": float(less[kept].mean())}
    return found


def _values(subject: Subject, builtins: list[Subject], found: Found, references: np.ndarray) -> dict[str, float]:
    """Values at the most samples per pixel. `builtins`: path + dielectric with `independent`, and the best sampler."""
    spp = max(found[subject.name])
    test, default, best = (found[s.name][spp] for s in (subject, *builtins))
    same = default if subject == builtins[0] else best
    values = kernel_timing.ratio(EQUAL_TIME, test.cost("MSE"), same.cost("MSE"))
    values |= kernel_timing.ratio(EQUAL_TIME_DEFAULTS, test.cost("MSE"), default.cost("MSE"))
    values |= kernel_timing.ratio(TIME_OVER_BUILTIN, test.seconds, same.seconds)
    values |= {"seconds": statistics.median(test.seconds)}
    values |= {metric: statistics.fmean(test.figures[metric]) for metric in METRICS}
    for metric in METRICS[1:]:
        ratios = [t / s for t, s in zip(test.cost(metric), same.cost(metric), strict=True)]
        values[f"equal-time {metric}"] = statistics.median(ratios)
    asked = TILE, limits.WELCH_ERROR, limits.WELCH_MARGIN
    agreed = tile_statistics.compare_stacks(references, np.stack(test.images), *asked)
    return values | {
        WELCH_ALARMS: float(agreed.alarms),
        SMALLEST_P: agreed.smallest_p,
        DETECTABLE: agreed.minimum_detectable(),
    }


def goals_of(subjects: list[Subject], found: Found, only_glass: bool) -> dict[str, dict[str, float]]:
    """Goals by subject: of the best of our methods at equal time, on glass alone of the best that splits; of time."""
    ours = [s for s in subjects if s.method.integrator == OURS]
    rivals = [s for s in ours if s.method.parameters or not only_glass]
    goals: dict[str, dict[str, float]] = {s.name: {} for s in ours}
    if rivals:
        spp = max(found[rivals[0].name])
        best = min(rivals, key=lambda s: statistics.median(found[s.name][spp].cost("MSE")))
        goals[best.name] |= limits.ONLY_GLASS if only_glass else limits.MIXED
    for subject in ours:
        if only_glass and not subject.method.parameters:
            goals[subject.name][TIME_OVER_BUILTIN] = limits.ONLY_GLASS_TIME
    return goals


STUDY = Study(NAME, "Efficiency", about(__doc__), TERMS, tasks, axes=AXES)
