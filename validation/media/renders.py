"""Renders with dispersive glass, and with glass that absorbs.

In a white furnace a dispersive ball is not seen: each channel is that of the light alone. Absorption is compared with
Mitsuba's `volpath`, whose dielectric boundaries enclose a homogeneous medium with an albedo of 0, by Welch's test on
tiles of independent renders; a slab with exp(−σ d) in the deterministic mode. The time of dispersion is over that of
the same scene with the index of its d line, and that of absorption over the same without it, both with as many samples.
"""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mi_refract import media
from mi_refract.image_diff import tile_statistics
from mi_refract.report.row import Row
from validation.limits import ABSORPTION_TIME, DISPERSION_TIME, FURNACE_CHANNEL, SLAB_ABSORPTION
from validation.run import kernel_timing
from validation.run.context import Context
from validation.run.metrics import DETECTABLE, SMALLEST_P, WELCH_ALARMS
from validation.run.render_methods import Camera, under
from validation.study import Study, Task, about

from .ray_directions import N_SF11

NAME = "dispersion and absorption"
SIGMA = (0.2, 0.6, 1.5)
SEEDS = {"quick": 8, "standard": 8, "full": 16}
DETECTED = "detectable per channel"
TERMS = {
    "off white": "largest difference of a channel's mean from that of the light, relative",
    DETECTED: "five standard deviations of a channel's mean, relative: what would have been seen",
    "off / detectable": "the former over the latter",
    "slab": "largest difference from exp(−σ d), relative",
    "time / without": "median over warm renders in turn",
    WELCH_ALARMS: "tiles and channels whose means differ; at most one image in 1000 by chance",
    DETECTABLE: "relative difference of a tile's mean that would have been an alarm, median over tiles",
}
BOX = {"type": "box"}


def scene(
    resolution: int, parts: dict[str, Any], integrator: dict[str, Any], light: dict[str, Any] | None = None
) -> Any:
    """Parts around the origin, seen from 5 units away, in light from everywhere."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "pixel_format": "rgb", "rfilter": BOX}
    place = mi.ScalarTransform4f().look_at([0, 1, 5], [0, 0, 0], [0, 1, 0])
    eye = {"type": "perspective", "fov": 30, "to_world": place, "film": film | {"component_format": "float32"}}
    whole = {"type": "scene", "sensor": eye, "integrator": integrator, "light": light or {"type": "constant"}}
    return mi.load_dict(whole | parts)


def ours(**parameters: Any) -> dict[str, Any]:
    """Our integrator."""
    return {"type": "refract_path", "max_depth": 32, "rr_depth": 32} | parameters


# The furnace -----------------------------------------------------------------------------------------------------


def furnace_rows(context: Context, variant: str, method: str, parameters: dict[str, Any]) -> list[Row]:
    """A ball of dense flint around a ball of water."""
    if reason := context.variants.get(variant, "not in this wheel"):
        return [Row(NAME, "furnace", method, variant, reason=reason)]
    ball = {"type": "sphere", "bsdf": {"type": "refract", "int_ior": N_SF11, "ext_ior": 1.0}}
    drop = {"type": "refract", "int_ior": "cauchy(1.3237, 3170)", "ext_ior": N_SF11}
    parts = {"ball": ball, "drop": {"type": "sphere", "radius": 0.5, "bsdf": drop}}
    spp = {"quick": 256, "standard": 1024, "full": 4096}[context.profile.name]
    with under(variant):
        seen = scene(32, parts, ours(rr_depth=10_000, **parameters))
        empty = scene(32, {}, ours())
        means = np.stack([Camera(seen)(spp, seed)[0].mean((0, 1)) for seed in range(16)])
        white = np.stack([Camera(empty)(4 * spp, 100 + seed)[0].mean((0, 1)) for seed in range(16)])
    error = np.sqrt((means.var(0, ddof=1) + white.var(0, ddof=1)) / 16)
    off = np.abs(means.mean(0) / white.mean(0) - 1)
    detectable = 5 * error / white.mean(0)
    values = {"off white": off.max(), DETECTED: detectable.max(), "off / detectable": (off / detectable).max()}
    budgets = {"off / detectable": 1.0} | ({} if context.profile.quick else {DETECTED: FURNACE_CHANNEL})
    replay = {"spp": spp, "seeds": 16, "resolution": 32}
    return [Row(NAME, "furnace", method, variant, {k: float(x) for k, x in values.items()}, budgets, replay=replay)]


# Absorption ------------------------------------------------------------------------------------------------------


def _rgb(sigma: Sequence[float]) -> dict[str, Any]:
    return {"type": "rgb", "value": list(sigma)}


def _medium(sigma: Sequence[float]) -> dict[str, Any]:
    """Mitsuba takes colours up to 1 here, and a factor of all of them."""
    most = max(sigma)
    return {"type": "homogeneous", "albedo": 0.0, "sigma_t": _rgb([x / most for x in sigma]), "scale": most}


def _glass(absorbing: bool, inside: tuple[float, ...], outside: tuple[float, ...] | None = None, n: float = 1.5) -> Any:
    """A boundary of ours, or of Mitsuba's with media on its sides, as parts of a shape."""
    if absorbing:
        more = {"ext_absorption": _rgb(outside)} if outside else {}
        bsdf = {"type": "refract", "int_ior": n, "ext_ior": 1.5 if outside else 1.0}
        return {"bsdf": bsdf | {"int_absorption": _rgb(inside)} | more}
    sides = {"interior": inside} | ({"exterior": outside} if outside else {})
    medium = {name: _medium(x) for name, x in sides.items()}
    return {"bsdf": {"type": "dielectric", "int_ior": n, "ext_ior": 1.5 if outside else 1.0}} | medium


def absorbing_parts(name: str, absorbing: bool) -> dict[str, Any]:
    """The scene by its name, of our boundaries or of Mitsuba's."""
    import mitsuba as mi

    ball = {"type": "sphere"} | _glass(absorbing, SIGMA)
    inner = {"type": "sphere", "radius": 0.5} | _glass(absorbing, (1.0, 0.1, 0.3), SIGMA, 1.33)
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).scale(3)}
    matt = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "diffuse", "reflectance": 0.6}}
    matt |= {} if absorbing else {"exterior": _medium(SIGMA)}
    return {
        "sphere": {"ball": ball, "wall": wall},
        "nested": {"ball": ball, "inner": inner, "wall": wall},
        "matt inside": {"box": {"type": "cube"} | _glass(absorbing, SIGMA), "matt": matt, "wall": wall},
    }[name]


def volpath_rows(context: Context, name: str) -> list[Row]:
    """Welch's test on tiles of 8² pixels."""
    count, spp = SEEDS[context.profile.name], {"quick": 64, "standard": 256, "full": 1024}[context.profile.name]
    one, two = ours(max_depth=16), {"type": "volpath", "max_depth": 64, "rr_depth": 64}
    ours_, theirs = (scene(48, absorbing_parts(name, x), x_by) for x, x_by in ((True, one), (False, two)))
    reference, test = (
        np.stack([Camera(made)(spp, base + seed)[0] for seed in range(count)])
        for made, base in ((theirs, 0), (ours_, 100))
    )
    tests = tile_statistics.compare_stacks(reference, test, 8, 1e-3, 1e-5)
    values = {WELCH_ALARMS: float(tests.alarms), SMALLEST_P: tests.smallest_p, DETECTABLE: tests.minimum_detectable()}
    replay = {"spp": spp, "seeds": count, "resolution": 48}
    return [Row(NAME, "volpath", name, context.variant, values, {WELCH_ALARMS: 0.0}, replay=replay)]


def slab_row(context: Context) -> Row:
    """Without reflections: the index is that of the surroundings. Sides of 1 to 4 units, σ of 0.05 to 8."""
    import mitsuba as mi

    worst = 0.0
    for thickness in (1.0, 2.0, 4.0):
        for sigma in (0.05, 0.5, 2.0, 8.0 / thickness):
            place = mi.ScalarTransform4f().scale([20, 20, thickness / 2])
            bsdf = {"type": "refract", "int_ior": 1.0, "ext_ior": 1.0, "int_absorption": sigma}
            made = scene(1, {"slab": {"type": "cube", "to_world": place, "bsdf": bsdf}}, ours(deterministic=True))
            made_sensor = mi.load_dict(_straight())
            found = float(np.array(mi.render(made, sensor=made_sensor, spp=1))[0, 0, 0])
            worst = max(worst, abs(found / math.exp(-sigma * thickness) - 1))
    return Row(NAME, "slab", "exp(−σ d)", context.variant, {"slab": worst}, {"slab": SLAB_ABSORPTION})


def _straight() -> dict[str, Any]:
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": BOX, "component_format": "float32"}
    place = mi.ScalarTransform4f().look_at([0.1, 0.2, 5], [0.1, 0.2, 4], [0, 1, 0]).scale(1e-3)
    return {"type": "orthographic", "to_world": place, "film": film | {"pixel_format": "rgb"}}


# Times -----------------------------------------------------------------------------------------------------------


def time_rows(context: Context) -> list[Row]:
    """What dispersion and absorption add to the time of a render."""
    number = float(media.index(N_SF11, media.LINES["d"]))
    plain = {"type": "refract", "int_ior": number, "ext_ior": 1.0}
    kinds: dict[str, tuple[str, dict[str, Any], float]] = {
        "dispersion": ("llvm_ad_spectral", plain | {"int_ior": N_SF11}, DISPERSION_TIME),
        "absorption": ("llvm_ad_rgb", plain | {"int_absorption": _rgb(SIGMA)}, ABSORPTION_TIME),
    }
    rows = []
    for name, (variant, bsdf, goal) in kinds.items():
        if reason := context.variants.get(variant, "not in this wheel"):
            rows.append(Row(NAME, "time", name, variant, reason=reason))
            continue
        with under(variant):
            size = 256 if not context.profile.quick else 128
            cameras = {
                which: Camera(scene(size, {"ball": {"type": "sphere", "bsdf": each}}, ours()))
                for which, each in (("with", bsdf), ("without", plain))
            }
            times = _alternating(cameras, max(context.profile.repeats, 9))
        values = kernel_timing.ratio("time / without", times["with"], times["without"])
        rows.append(
            Row(NAME, "time", name, variant, values, goals={"time / without": goal}, replay={"resolution": size})
        )
    return rows


def _alternating(cameras: Mapping[str, Camera], repeats: int) -> dict[str, list[float]]:
    times: dict[str, list[float]] = {name: [] for name in cameras}
    for camera in cameras.values():
        camera(16, 0)
    for seed in range(repeats):
        for name, camera in cameras.items():
            times[name].append(statistics.median(camera(16, seed)[1] for _ in range(3)))
    return times


METHODS: dict[str, dict[str, Any]] = {"by chance": {}, "both lobes": {"split_depth": 2}}


def tasks(context: Context) -> list[Task]:
    """Furnaces, comparisons with `volpath`, a slab, times."""
    if context.scalar:
        return [Task(NAME, lambda: [Row(NAME, "all", "all", context.variant, reason="needs a compiled variant")])]
    found = [
        Task(f"{NAME}: furnace {variant}, {method}", functools.partial(furnace_rows, context, variant, method, x))
        for variant in ("llvm_ad_spectral", "llvm_ad_spectral_polarized", "cuda_ad_spectral")
        for method, x in METHODS.items()
    ]
    for name in ("sphere", "nested", "matt inside"):
        found.append(Task(f"{NAME}: {name}", functools.partial(volpath_rows, context, name)))
    found.append(Task(f"{NAME}: slab", lambda: [slab_row(context)]))
    return [*found, Task(f"{NAME}: times", functools.partial(time_rows, context), timed=True)]


STUDY = Study(NAME, "Dispersion and absorption", about(__doc__), TERMS, tasks)
