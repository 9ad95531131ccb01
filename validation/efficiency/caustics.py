"""Caustics: light that has left glass, or a mirror, and meets a matt surface that the camera sees.

`path` finds such light only where a path from the matt surface happens to meet the lamp, and light of lamps of no size
never. *Energy*: what reaches a disk below a ball and below a plano-convex lens, both on the axis of the lamp, against a
converged quadrature of the rays in a plane through that axis (`validation/reference/caustic_energy.py`). *Images*: six
bodies over a matt floor and lamps of growing size, of the same irradiance, against the sum of two of Mitsuba's
integrators that share no path: what is seen on surfaces that scatter by `ptracer`, what is seen in glass by `path`. All
methods have the sampler `independent`, and as many samples. MSE × time is compared with that of path + dielectric, of
the whole image and where the caustic is seen: in pixels that see no glass, and have more than a quarter of their light
by it. Where `path` has met no lamp its error is too small, so these ratios are upper bounds. What small lamps light
through glass and is seen through glass again stays noise in all methods, and is not compared; the reference has that
noise, too, so the MSE of a whole image with a very small lamp says little. *Noise by class*: which paths make the
noise that is left with small lamps. Of what is seen in glass, L S+ E is what is left over a nearly black floor,
L D (S|D)* S E has the noise with a point lamp, and L S+ D (S|D)* S E has the rest.
"""

from __future__ import annotations

import functools
import math
import statistics
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refract.image_diff import tile_statistics
from mi_refract.plugins import PLUGIN
from mi_refract.report.row import Reason, Row
from validation import limits
from validation.reference import caustic_energy
from validation.run import kernel_timing
from validation.run.context import Context
from validation.run.metrics import (
    DETECTABLE,
    EQUAL_TIME,
    EQUAL_TIME_CAUSTIC,
    SMALLEST_P,
    TIME_OVER_BUILTIN,
    WELCH_ALARMS,
)
from validation.run.render_methods import BUILTIN, DIELECTRIC, FROM_LAMPS, OURS, Camera, Method, save_image
from validation.study import Study, Task, about

from . import caustic_scenes as scenes
from .error_against_time import SCALAR, Measured, errors, measure

NAME = "caustics"
SEEN, LIT, MIRRORED, CAST = "(S|D)* D E", "L D (S|D)* S E", "L S+ E", "L S+ D (S|D)* S E"  # classes of paths
BY_PART = "noise by class"
ENERGY_OF, OFF, NOISE, MISSING = "energy: ", "energy off", "standard error", "light missing"
TERMS = {
    EQUAL_TIME: "MSE × time over that of path + dielectric with the same sampler and as many samples; low, high: its "
    "95 % interval over the rounds",
    EQUAL_TIME_CAUSTIC: "the same of the pixels where the caustic is seen",
    TIME_OVER_BUILTIN: "at equal samples per pixel; low, high: its 95 % interval",
    "MSE": "mean over pixels and channels of the squared error",
    MISSING: "of the pixels where the caustic is seen: 1 − the mean of the images over that of the reference",
    WELCH_ALARMS: "tiles and channels, and the caustic and all else, whose mean differs from the reference's; at most "
    "one row in 500 by chance; of small lamps in pixels that see no glass",
    DETECTABLE: "of the mean over the caustic, or over all else, where it is larger",
    OFF: "|power on the disk over the exact one − 1|",
    NOISE: "of the power over the exact one",
    "quadrature": "bound of the error of the exact power, relative",
    SEEN: "share in the noise (variance, all pixels and channels): of what is seen outside glass",
    LIT: "of surfaces that the lamp lights straight, seen in glass",
    MIRRORED: "of the lamp itself, seen in glass: found by paths that meet it",
    CAST: "of caustics seen in glass: neither end can be connected",
}
# What is rendered: integrator settings, and the BSDF of glass. `ptracer` stands for the sum of two integrators.
BY_CLASS = Method("path + ptracer", "ptracer", DIELECTRIC)
METHODS = (BUILTIN, Method(OURS, OURS, PLUGIN, {"caustics": "path"}), FROM_LAMPS, BY_CLASS)
HOLDING = FROM_LAMPS, BY_CLASS  # the caustics of lamps of any size
# Of a disk: the image is a caustic and nothing else.
ENERGY = replace(FROM_LAMPS, parameters={"caustics": "lamp", "light_paths": 4.0}), BY_CLASS
DEPTH, TILE, SHARE = 12, 8, 0.25
FIRST_REFERENCE = 1000  # seed: no method has seen any from here on
NOT_AIMED = 8
MORE = {"diamond": 4, "ring": 8}  # times the samples that are tested: the caustic is dim, or on few pixels
NOISE_RENDERS, NEARLY_BLACK = 4, 1e-6  # of the noise by class: times the rounds; the reflectance of a floor
BOUNDARIES = 6  # that light which counts for the energy of a caustic may meet


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    Images: `spp` of each of `rounds` timed renders, six being the fewest that have a 95 % interval; `checked_spp` of
    each of `renders` whose mean is tested, and of as many references, times MORE. `lamps` of the ball, and
    `other_lamps` of all other bodies. Energy: `energy_spp` of each of `renders`; `ptracer`, which does not aim parallel
    light at the body, has NOT_AIMED times as many.
    """

    resolution: int
    spp: int
    checked_spp: int
    energy_spp: int
    lamps: tuple[str, ...]
    other_lamps: tuple[str, ...] = ()
    rounds: int = 6
    renders: int = 8

    def checked(self, body: str) -> int:
        """Samples per pixel of renders that are tested, and of references."""
        return self.checked_spp * MORE.get(body, 1)

    def cases(self) -> list[tuple[str, str]]:
        """Bodies with lamps."""
        first, *others = scenes.BODIES
        return [(first, x) for x in self.lamps] + [(body, x) for body in others for x in self.other_lamps]


SQUARE = f"square {scenes.SMALL}"
EXTENTS = {
    "quick": Extent(32, 256, 3072, 128, (SQUARE,)),
    "standard": Extent(48, 144, 4096, 128, scenes.LAMPS, (SQUARE,)),
    "full": Extent(64, 256, 4096, 256, scenes.LAMPS, scenes.LAMPS),
}


def tasks(context: Context) -> list[Task]:
    """One per body on an axis, and one per body and lamp."""
    if context.scalar:
        return [Task(NAME, lambda: [Row(NAME, "every method", "every scene", context.variant, reason=SCALAR)])]
    extent = EXTENTS[context.profile.name]
    found = [
        Task(f"{NAME}: energy, {body}, {lamp}", functools.partial(energy_rows, context, body, lamp))
        for body, lamp in caustic_energy.ON_AXIS
    ]
    for body, lamp in extent.cases():
        run = functools.partial(image_rows, context, body, lamp)
        found.append(Task(f"{NAME}: {body}, {lamp}", run, timed=True))
    left_out = len(scenes.BODIES) * len(scenes.LAMPS) - len(extent.cases())
    if left_out:
        reason = Reason(f"left out: {left_out} bodies and lamps", "`--profile full`")
        found.append(
            Task(f"{NAME}: others", lambda: [Row(NAME, "every method", "others", context.variant, reason=reason)])
        )
    return found


# Integrators ---------------------------------------------------------------------------------------------------


def seen_in_glass(nested: Any = None) -> Any:
    """An integrator: what `nested` sees where a ray first meets a delta lobe, else 0; without `nested` 1 there."""

    class SeenInGlass(mi.SamplingIntegrator):
        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            si = scene.ray_intersect(ray, active)
            glass = si.is_valid() & ~mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Smooth) & active
            light = nested.sample(scene, sampler, ray, medium, glass)[0] if nested else mi.Spectrum(1)
            return dr.select(glass, light, 0), glass, []

    return SeenInGlass(mi.Properties())


class SumOfClasses:
    """A scene by two integrators that share no path: `ptracer` connects only vertices that scatter to the camera."""

    def __init__(self, scene: Any, max_depth: int) -> None:
        """`scene` as Mitsuba loaded it."""
        depth = {"max_depth": max_depth, "rr_depth": max_depth}
        methods = mi.load_dict({"type": "ptracer"} | depth), seen_in_glass(mi.load_dict({"type": "path"} | depth))
        self.scene, self.parts = scene, [Camera(scene, method) for method in methods]

    def __call__(self, spp: int, seed: int) -> tuple[np.ndarray, float]:
        """The image and the seconds that both took."""
        (scattered, first), (in_glass, second) = (part(spp, seed) for part in self.parts)
        return scattered + in_glass, first + second


def camera_of(scene: Any, method: Method, max_depth: int = DEPTH) -> Camera | SumOfClasses:
    """A loaded scene by a method."""
    if method == BY_CLASS:
        return SumOfClasses(scene, max_depth)
    return Camera(scene, mi.load_dict(method.plugin(max_depth)))


# Energy --------------------------------------------------------------------------------------------------------


def energy_rows(context: Context, body: str, lamp: str, methods: tuple[Method, ...] = ENERGY) -> list[Row]:
    """A row for each method: the power on the disk against the quadrature."""
    extent, rows = EXTENTS[context.profile.name], []
    setup, radius = caustic_energy.ON_AXIS[body, lamp]
    exact, step = caustic_energy.flux(setup, radius, BOUNDARIES)
    for method in methods:
        row = functools.partial(Row, NAME, method.name, f"{ENERGY_OF}{body}, {lamp}", context.variant)
        if method == BY_CLASS and lamp == caustic_energy.POINT:
            rows.append(row(reason="ptracer does not aim: measured with a spot, which has the same light"))
            continue
        spp = extent.energy_spp * (NOT_AIMED if method == BY_CLASS and lamp == caustic_energy.PARALLEL else 1)
        scene, weights = scenes.disk_scene(body, lamp, method.bsdf, extent.resolution)
        look = camera_of(scene, method, BOUNDARIES + 2)
        shots = [look(spp, seed)[0] for seed in range(extent.renders)]
        ratios = [float((image.mean(-1) * weights).sum() / exact) for image in shots]
        values = {
            OFF: abs(statistics.fmean(ratios) - 1),
            NOISE: statistics.stdev(ratios) / math.sqrt(len(ratios)),
            "quadrature": step / exact,
        }
        budgets = {OFF: limits.CAUSTIC_ENERGY, NOISE: limits.CAUSTIC_NOISE}
        replay = {"method": method.plugin(BOUNDARIES + 2), "body": body, "lamp": lamp, "radius": radius}
        replay |= {"exact power": exact, "resolution": extent.resolution, "spp": spp, "renders": extent.renders}
        rows.append(row(values, budgets, replay=replay))
    return rows


# Images --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reference:
    """Independent renders of a case, and its pixels (height × width): those that see no glass, and the caustic."""

    renders: np.ndarray
    without_glass: np.ndarray
    caustic: np.ndarray


def reference(body: str, lamp: str, extent: Extent) -> Reference:
    """The reference by the sum of Mitsuba's two integrators."""
    scene, black = (scenes.scene(body, lamp, bsdf, extent.resolution) for bsdf in (DIELECTRIC, scenes.BLACK))
    look = SumOfClasses(scene, DEPTH)
    renders = np.stack([look(extent.checked(body), seed=FIRST_REFERENCE + i)[0] for i in range(extent.renders)])
    without_glass = Camera(scene, seen_in_glass())(64, seed=0)[0].max(-1) == 0
    direct = camera_of(black, BUILTIN)(extent.checked(body), seed=0)[0].mean(-1)
    # Of a render that is none of them: pixels that their noise had chosen would be too bright in them.
    light = look(extent.checked(body), seed=FIRST_REFERENCE - 1)[0].mean(-1)
    return Reference(renders, without_glass, without_glass & (light - direct > SHARE * light))


def image_rows(context: Context, body: str, lamp: str, methods: tuple[Method, ...] = METHODS) -> list[Row]:
    """A row per method, of which the first is the built-in; of a small lamp one more, of the noise by class."""
    extent = EXTENTS[context.profile.name]
    truth = reference(body, lamp, extent)
    loaded = {m.bsdf: scenes.scene(body, lamp, m.bsdf, extent.resolution) for m in methods}
    cameras = {m.name: camera_of(loaded[m.bsdf], m) for m in methods}

    def figures(image: np.ndarray, mean: np.ndarray, own: np.ndarray) -> dict[str, float]:
        of_caustic = (x[truth.caustic][:, None] for x in (image, mean, own))
        return {EQUAL_TIME: errors(image, mean, own)["MSE"], EQUAL_TIME_CAUSTIC: errors(*of_caustic)["MSE"]}

    found = measure(cameras, truth.renders, (extent.spp,), extent.rounds, figures)
    measured = {name: by_spp[extent.spp] for name, by_spp in found.items()}
    side, case, rows = scenes.side_of(lamp), f"{body}, {lamp}", []
    small = 0 < side <= scenes.SMALL
    compared = truth.without_glass[..., None] | (not small)
    for method in methods:
        values, budgets = _times(measured[method.name], measured[methods[0].name], side), dict[str, float]()
        images, holds = np.stack(measured[method.name].images), method in HOLDING
        if holds:
            images = np.stack([cameras[method.name](extent.checked(body), seed=i)[0] for i in range(extent.renders)])
            values |= _tested(truth.renders * compared, images * compared, truth.caustic)
            budgets = {WELCH_ALARMS: 0.0} | ({} if method == BY_CLASS else {DETECTABLE: limits.CAUSTIC_DETECTABLE})
        dark, light = (x[:, truth.caustic].mean() for x in (images, truth.renders))
        values[MISSING] = float(1 - dark / light)
        goals = limits.CAUSTICS if holds and small and method != BY_CLASS else {}
        replay: dict[str, Any] = {"method": method.plugin(DEPTH), "body": body, "lamp": lamp}
        replay |= {"resolution": extent.resolution, "spp": extent.spp, "rounds": extent.rounds}
        replay |= {"renders": extent.renders, "spp of renders and references": extent.checked(body)}
        replay |= {"reference seeds from": FIRST_REFERENCE, "pixels of the caustic": int(truth.caustic.sum())}
        shown = {"reference": truth.renders.mean(0), "test": measured[method.name].images[0]}
        paths = {role: save_image(context.out, f"{case} {method.name} {role}", x, {}) for role, x in shown.items()}
        rows.append(Row(NAME, method.name, case, context.variant, values, budgets, goals, "", replay, paths))
    if small and FROM_LAMPS in methods:
        rows.append(noise_row(context, body, lamp, truth.without_glass))
    return rows


def noise_row(context: Context, body: str, lamp: str, without_glass: np.ndarray) -> Row:
    """Shares of classes of paths in the noise of FROM_LAMPS: their covariances with the image, over its variance."""
    extent = EXTENTS[context.profile.name]
    renders = NOISE_RENDERS * extent.rounds

    def images(lamp: str, floor: float) -> np.ndarray:
        look = camera_of(scenes.scene(body, lamp, FROM_LAMPS.bsdf, extent.resolution, floor), FROM_LAMPS)
        return np.stack([look(extent.spp, seed)[0] for seed in range(renders)])

    every = images(lamp, scenes.FLOOR)
    apart = every - every.mean(0)
    whole = np.square(apart).sum()

    def share(part: np.ndarray, pixels: np.ndarray) -> float:
        return float(((part - part.mean(0)) * apart)[:, pixels].sum() / whole)

    # The same paths as in `every`: a floor that is black would need fewer random numbers.
    values = {SEEN: share(every, without_glass), MIRRORED: share(images(lamp, NEARLY_BLACK), ~without_glass)}
    values[LIT] = float(images(caustic_energy.POINT, scenes.FLOOR).var(0)[~without_glass].sum() * renders / whole)
    values[CAST] = 1 - sum(values.values())
    replay = {"method": FROM_LAMPS.plugin(DEPTH), "body": body, "lamp": lamp, "resolution": extent.resolution}
    replay |= {"spp": extent.spp, "renders": renders}
    reason = f"of {FROM_LAMPS.name}: most is of {max(values, key=lambda name: values[name])}"
    return Row(NAME, BY_PART, f"{body}, {lamp}", context.variant, values, reason=reason, replay=replay)


def _tested(references: np.ndarray, images: np.ndarray, caustic: np.ndarray) -> dict[str, float]:
    """Welch's test of tiles, and of two means: over the caustic, and over all else. The latter say what is seen."""
    how = limits.WELCH_ERROR, limits.WELCH_MARGIN
    tiles = tile_statistics.compare_stacks(references, images, TILE, *how)
    inside = caustic[..., None]
    reference, test = (np.concatenate([x * inside, x * ~inside], 2) for x in (references, images))
    means = tile_statistics.compare_stacks(reference, test, len(caustic), *how)
    return {
        WELCH_ALARMS: float(tiles.alarms + means.alarms),
        SMALLEST_P: min(tiles.smallest_p, means.smallest_p),
        DETECTABLE: float(np.nanmax(means.levels[0].detectable(means.threshold))),
    }


def _times(test: Measured, builtin: Measured, side: float) -> dict[str, float]:
    """Errors, times, and their products over the built-in's: of a lamp of no size that has no meaning."""
    values = kernel_timing.ratio(TIME_OVER_BUILTIN, test.seconds, builtin.seconds)
    for metric, name in ((EQUAL_TIME, "MSE"), (EQUAL_TIME_CAUSTIC, "MSE, caustic")):
        values |= kernel_timing.ratio(metric, test.cost(metric), builtin.cost(metric)) if side else {}
        values[name] = statistics.fmean(test.figures[metric])
    return values | {"seconds": statistics.median(test.seconds)}


STUDY = Study(NAME, "Caustics", about(__doc__), TERMS, tasks)
