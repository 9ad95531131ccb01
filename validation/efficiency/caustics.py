"""Caustics: light that glass or a mirror focuses on a matt surface that the camera sees.

`path` finds such light only if a path from the matt surface hits the lamp by chance, and never for lamps without size.

Energy: the power on a disk below a ball and below a plano-convex lens, both on the axis of the lamp, against a
converged quadrature over rays in a plane through that axis (`validation/reference/caustic_energy.py`).

Images: six bodies over a matt floor, with lamps of several sizes and the same irradiance. The reference is the sum of
two of Mitsuba's integrators that share no path: `ptracer` for what is seen on scattering surfaces, `path` for what is
seen in glass. All methods have the sampler `independent` and as many samples. MSE × time is relative to path +
dielectric, for the whole image and for the caustic: pixels that see no glass and receive more than a quarter of their
light through it. If `path` hit no lamp, its error is underestimated, so these ratios are upper bounds. What a small
lamp lights through glass and is seen through glass again is noise in all methods and is not compared. The reference has
this noise too, so the MSE of a whole image with a very small lamp says little.

Noise by class: the classes of paths that the noise with small lamps comes from. Of what is seen in glass, L S+ E is
measured with a nearly black floor, L D (S|D)* S E with a point lamp, and L S+ D (S|D)* S E is the rest.
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
    EQUAL_TIME_CAUSTIC: "the same for the pixels of the caustic",
    TIME_OVER_BUILTIN: "at equal samples per pixel; low, high: its 95 % interval",
    "MSE": "mean over pixels and channels of the squared error",
    MISSING: "for the pixels of the caustic: 1 − the mean of the images over that of the reference",
    WELCH_ALARMS: "tiles and channels, and the caustic and the rest, whose mean differs from the reference's; at most "
    "one row in 500 by chance; for small lamps in pixels that see no glass",
    DETECTABLE: "of the mean over the caustic or over the rest, whichever is larger; the rest may be black in the pool",
    OFF: "|power on the disk over the exact one − 1|",
    NOISE: "of the power over the exact one",
    "quadrature": "bound of the relative error of the exact power",
    SEEN: "share of the noise (variance, all pixels and channels) from what is seen outside glass",
    LIT: "share from surfaces lit directly by the lamp and seen in glass",
    MIRRORED: "share from the lamp itself, seen in glass: found by paths that hit it",
    CAST: "share from caustics seen in glass: neither end can be connected",
}
# Methods: integrator settings, and the BSDF of glass. `ptracer` stands for the sum of two integrators.
BY_CLASS = Method("path + ptracer", "ptracer", DIELECTRIC)
METHODS = (BUILTIN, Method(OURS, OURS, PLUGIN, {"caustics": "path"}), FROM_LAMPS, BY_CLASS)
# Methods for the disk, whose image holds nothing but the caustic.
ENERGY = replace(FROM_LAMPS, parameters={"caustics": "lamp", "light_paths": 4.0}), BY_CLASS
DEPTH, TILE, SHARE = 12, 8, 0.25
FIRST_REFERENCE = 1000  # first seed of the references; methods have smaller seeds
NOT_AIMED = 8  # factor of the samples of `ptracer` for lamps that it does not aim
# Factors of the tested samples: the caustic is dim or on few pixels, or the light seen in the water is noisy.
MORE = {"diamond": 4, "ring": 8, "pool, square 0.2": 16}
NOISE_RENDERS, NEARLY_BLACK = 4, 1e-6  # for the noise by class: renders per round; reflectance of the black floor
LEAKS = 1 / 30_000  # share of the light: about as many rays miss a boundary at edges (`plugins/medium_tracking`)
BOUNDARIES = 6  # the most boundaries of light that counts for the energy of a caustic


@dataclass(frozen=True)
class Extent:
    """How much is measured.

    Images: `rounds` timed renders of `spp` each (at least six for a 95 % interval), and `renders` of the tested method,
    of `checked_spp` × MORE each, as are the references. `unaimed`: factor of the light paths of references for lamps
    that `ptracer` does not aim. `lamps`: for the ball; `other_lamps`: for all other bodies.
    Energy: `renders` of `energy_spp` each; × NOT_AIMED for `ptracer` in parallel light, which it does not aim.
    """

    resolution: int
    spp: int
    checked_spp: int
    energy_spp: int
    lamps: tuple[str, ...]
    other_lamps: tuple[str, ...] = ()
    rounds: int = 6
    renders: int = 8
    unaimed: int = 1

    def checked(self, body: str, lamp: str) -> int:
        """Return the samples per pixel of tested renders and of references."""
        return self.checked_spp * MORE.get(f"{body}, {lamp}", MORE.get(body, 1))

    def cases(self) -> list[tuple[str, str]]:
        """Return the pairs of body and lamp."""
        first, *others = scenes.BODIES
        return [(first, x) for x in self.lamps] + [(body, x) for body in others for x in self.other_lamps]


SQUARE = f"square {scenes.SMALL}"
EXTENTS = {
    "quick": Extent(32, 256, 3072, 128, (SQUARE,)),
    "standard": Extent(48, 144, 4096, 128, scenes.LAMPS, (SQUARE,)),
    "full": Extent(64, 256, 4096, 256, scenes.LAMPS, scenes.LAMPS, unaimed=NOT_AIMED),
}


def tasks(context: Context) -> list[Task]:
    """Return one task per body on an axis, and one per body and lamp."""
    if context.scalar:
        return [Task(NAME, lambda: [Row(NAME, "every method", "every scene", context.variant, reason=SCALAR)])]
    extent = EXTENTS[context.profile.name]
    made = [
        Task(f"{NAME}: energy, {body}, {lamp}", functools.partial(energy_rows, context, body, lamp))
        for body, lamp in caustic_energy.ON_AXIS
    ]
    for body, lamp in extent.cases():
        run = functools.partial(image_rows, context, body, lamp)
        made.append(Task(f"{NAME}: {body}, {lamp}", run, timed=True))
    left_out = len(scenes.BODIES) * len(scenes.LAMPS) - len(extent.cases())
    if left_out:
        reason = Reason(f"left out: {left_out} bodies and lamps", "`--profile full`")
        row = Row(NAME, "every method", "others", context.variant, reason=reason)
        made.append(Task(f"{NAME}: others", lambda: [row]))
    return made


# Integrators ---------------------------------------------------------------------------------------------------


def seen_in_glass(nested: Any = None) -> Any:
    """Return an integrator for pixels that see a delta lobe first: `nested` there (or 1 without it), 0 elsewhere."""

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
    """A scene by two integrators that share no path: `ptracer` connects only scattering vertices to the camera."""

    def __init__(self, scene: Any, max_depth: int, light_images: int = 1) -> None:
        """Set up both integrators for a loaded scene. `light_images`: the number of images by `ptracer` per image."""
        self.light_images = light_images
        depth = {"max_depth": max_depth, "rr_depth": max_depth}
        methods = mi.load_dict({"type": "ptracer"} | depth), seen_in_glass(mi.load_dict({"type": "path"} | depth))
        self.scene, self.parts = scene, [Camera(scene, method) for method in methods]

    def __call__(self, spp: int, seed: int) -> tuple[np.ndarray, float]:
        """Return the image and the seconds that both integrators took."""
        from_lamps, of_path = self.parts
        count = self.light_images
        scattered, seconds = zip(*(from_lamps(spp, seed * count + i) for i in range(count)), strict=True)
        in_glass, more = of_path(spp, seed)
        return np.mean(scattered, axis=0) + in_glass, sum(seconds) + more


def camera_of(scene: Any, method: Method, max_depth: int = DEPTH) -> Camera | SumOfClasses:
    """Return the camera of a loaded scene by a method."""
    if method == BY_CLASS:
        return SumOfClasses(scene, max_depth)
    return Camera(scene, mi.load_dict(method.plugin(max_depth)))


# Energy --------------------------------------------------------------------------------------------------------


def energy_rows(context: Context, body: str, lamp: str, methods: tuple[Method, ...] = ENERGY) -> list[Row]:
    """Return a row per method: the power on the disk against the quadrature."""
    extent, rows = EXTENTS[context.profile.name], []
    setup, radius = caustic_energy.ON_AXIS[body, lamp]
    exact, step = caustic_energy.flux(setup, radius, BOUNDARIES)
    for method in methods:
        row = functools.partial(Row, NAME, method.name, f"{ENERGY_OF}{body}, {lamp}", context.variant)
        if method == BY_CLASS and lamp == caustic_energy.POINT:
            rows.append(row(reason="ptracer does not aim; it is measured with a spot, which has the same light"))
            continue
        spp = extent.energy_spp * (NOT_AIMED if method == BY_CLASS and lamp == caustic_energy.PARALLEL else 1)
        scene, weights = scenes.disk_scene(body, lamp, method.bsdf, extent.resolution)
        camera = camera_of(scene, method, BOUNDARIES + 2)
        images = [camera(spp, seed)[0] for seed in range(extent.renders)]
        ratios = [float((image.mean(-1) * weights).sum() / exact) for image in images]
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
    """Independent renders of a case, and masks (height × width) of pixels that see no glass and of the caustic.

    `direct`: whether light also reaches the camera without glass, more than passes between triangles.
    """

    renders: np.ndarray
    without_glass: np.ndarray
    caustic: np.ndarray
    direct: bool


def reference(body: str, lamp: str, extent: Extent) -> Reference:
    """Render the reference by the sum of Mitsuba's two integrators.

    `ptracer` starts its rays to the camera 9e-5 (1 + |p|) above a point p, so it sees past silhouettes: in direct light
    alone, tiles around a black ring are 0.1 to 0.2 % brighter than by `path`. "ring, spot" in `full` detects that.
    """
    scene, black = (scenes.scene(body, lamp, bsdf, extent.resolution) for bsdf in (DIELECTRIC, scenes.BLACK))
    spp = extent.checked(body, lamp)
    aimed = lamp not in (caustic_energy.POINT, caustic_energy.PARALLEL)
    camera = SumOfClasses(scene, DEPTH, light_images=1 if aimed else extent.unaimed)
    renders = np.stack([camera(spp, seed=FIRST_REFERENCE + i)[0] for i in range(extent.renders)])
    without_glass = Camera(scene, seen_in_glass())(64, seed=0)[0].max(-1) == 0
    direct = camera_of(black, BUILTIN)(spp, seed=0)[0].mean(-1)
    # Another render selects the pixels: pixels selected by the noise of the references would be too bright in them.
    light = camera(spp, seed=FIRST_REFERENCE - 1)[0].mean(-1)
    caustic = without_glass & (light - direct > SHARE * light)
    return Reference(renders, without_glass, caustic, bool(direct.mean() > LEAKS * light.mean()))


def image_rows(
    context: Context, body: str, lamp: str, methods: tuple[Method, ...] = METHODS, tested: Method = FROM_LAMPS
) -> list[Row]:
    """Return a row per method, of which the first is the built-in; for small lamps also one of the noise by class.

    The images of `tested` are compared with the references.
    """
    extent = EXTENTS[context.profile.name]
    truth = reference(body, lamp, extent)
    loaded = {m.bsdf: scenes.scene(body, lamp, m.bsdf, extent.resolution) for m in methods}
    cameras = {m.name: camera_of(loaded[m.bsdf], m) for m in methods}

    def figures(image: np.ndarray, mean: np.ndarray, own: np.ndarray) -> dict[str, float]:
        of_caustic = (x[truth.caustic][:, None] for x in (image, mean, own))
        return {EQUAL_TIME: errors(image, mean, own)["MSE"], EQUAL_TIME_CAUSTIC: errors(*of_caustic)["MSE"]}

    all_measured = measure(cameras, truth.renders, (extent.spp,), extent.rounds, figures)
    measured = {name: by_spp[extent.spp] for name, by_spp in all_measured.items()}
    side, case, rows = scenes.side_of(lamp), f"{body}, {lamp}", []
    small = 0 < side <= scenes.SMALL
    compared = truth.without_glass[..., None] | (not small)
    rest_is_lit = truth.direct or side > scenes.SMALL  # all light on the floor of the pool comes through water
    for method in methods:
        values, budgets = _times(measured[method.name], measured[methods[0].name], side), dict[str, float]()
        images, goals = np.stack(measured[method.name].images), dict[str, float]()
        if method == tested:
            spp = extent.checked(body, lamp)
            images = np.stack([cameras[method.name](spp, seed=i)[0] for i in range(extent.renders)])
            values |= _tested(truth.renders * compared, images * compared, truth.caustic, rest_is_lit)
            budgets = {WELCH_ALARMS: 0.0, DETECTABLE: limits.CAUSTIC_DETECTABLE}
            goals = limits.CAUSTICS if small else {}
        test_mean, reference_mean = (x[:, truth.caustic].mean() for x in (images, truth.renders))
        values[MISSING] = float(1 - test_mean / reference_mean)
        replay: dict[str, Any] = {"method": method.plugin(DEPTH), "body": body, "lamp": lamp}
        replay |= {"resolution": extent.resolution, "spp": extent.spp, "rounds": extent.rounds}
        replay |= {"renders": extent.renders, "spp of renders and references": extent.checked(body, lamp)}
        replay |= {"reference seeds from": FIRST_REFERENCE, "pixels of the caustic": int(truth.caustic.sum())}
        shown = {"reference": truth.renders.mean(0), "test": measured[method.name].images[0]}
        paths = {role: save_image(context.out, f"{case} {method.name} {role}", x, {}) for role, x in shown.items()}
        rows.append(Row(NAME, method.name, case, context.variant, values, budgets, goals, "", replay, paths))
    if small and FROM_LAMPS in methods:
        rows.append(noise_row(context, body, lamp, truth.without_glass))
    return rows


def noise_row(context: Context, body: str, lamp: str, without_glass: np.ndarray) -> Row:
    """Return the row of the noise of FROM_LAMPS by class of paths: covariances with the image, over its variance."""
    extent = EXTENTS[context.profile.name]
    renders = NOISE_RENDERS * extent.rounds

    def images(lamp: str, floor: float) -> np.ndarray:
        camera = camera_of(scenes.scene(body, lamp, FROM_LAMPS.bsdf, extent.resolution, floor), FROM_LAMPS)
        return np.stack([camera(extent.spp, seed)[0] for seed in range(renders)])

    all_paths = images(lamp, scenes.FLOOR)
    deviation = all_paths - all_paths.mean(0)
    total = np.square(deviation).sum()

    def share(part: np.ndarray, pixels: np.ndarray) -> float:
        return float(((part - part.mean(0)) * deviation)[:, pixels].sum() / total)

    # With a nearly black floor the paths are the same; a black floor would need fewer random numbers.
    values = {SEEN: share(all_paths, without_glass), MIRRORED: share(images(lamp, NEARLY_BLACK), ~without_glass)}
    values[LIT] = float(images(caustic_energy.POINT, scenes.FLOOR).var(0)[~without_glass].sum() * renders / total)
    values[CAST] = 1 - sum(values.values())
    replay = {"method": FROM_LAMPS.plugin(DEPTH), "body": body, "lamp": lamp, "resolution": extent.resolution}
    replay |= {"spp": extent.spp, "renders": renders}
    reason = f"of {FROM_LAMPS.name}: most comes from {max(values, key=lambda name: values[name])}"
    return Row(NAME, BY_PART, f"{body}, {lamp}", context.variant, values, reason=reason, replay=replay)


def _tested(references: np.ndarray, images: np.ndarray, caustic: np.ndarray, rest_is_lit: bool) -> dict[str, float]:
    """Return the values of Welch's test of tiles, and of the means over the caustic and over the rest.

    The two means give the detectable difference: NaN if either has no light, except for the rest without `rest_is_lit`.
    """
    levels = limits.WELCH_ERROR, limits.WELCH_MARGIN
    tiles = tile_statistics.compare_stacks(references, images, TILE, *levels)
    inside = caustic[..., None]
    reference, test = (np.concatenate([x * inside, x * ~inside], 2) for x in (references, images))
    means = tile_statistics.compare_stacks(reference, test, len(caustic), *levels)
    of_caustic, of_rest = np.moveaxis(means.levels[0].detectable(means.threshold), 1, 0)
    if not rest_is_lit:
        of_rest = np.where(np.isnan(of_rest), of_caustic, of_rest)
    return {
        WELCH_ALARMS: float(tiles.alarms + means.alarms),
        SMALLEST_P: min(tiles.smallest_p, means.smallest_p),
        DETECTABLE: float(np.maximum(of_caustic, of_rest).max()),
    }


def _times(test: Measured, builtin: Measured, side: float) -> dict[str, float]:
    """Return errors and times, and their products over the built-in's, which mean nothing for lamps without size."""
    values = kernel_timing.ratio(TIME_OVER_BUILTIN, test.seconds, builtin.seconds)
    for metric, name in ((EQUAL_TIME, "MSE"), (EQUAL_TIME_CAUSTIC, "MSE, caustic")):
        values |= kernel_timing.ratio(metric, test.cost(metric), builtin.cost(metric)) if side else {}
        values[name] = statistics.fmean(test.figures[metric])
    return values | {"seconds": statistics.median(test.seconds)}


STUDY = Study(NAME, "Caustics", about(__doc__), TERMS, tasks)
