"""Renders with dispersive glass, and with absorbing glass.

In a white furnace a dispersive ball is invisible: each channel is that of the light alone. Absorption is compared with
Mitsuba's `volpath`, where dielectric boundaries enclose a homogeneous medium of albedo 0, by Welch's test on tiles of
independent renders. A slab is compared with exp(−σ d) in the deterministic mode. The time of dispersion is over that of
the same scene with the index of its d line, the time of absorption over that without it, with equally many samples.
"""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refract import media
from mi_refract.report.row import Row
from validation.limits import ABSORPTION_SEEN, ABSORPTION_TIME, DISPERSION_TIME, FURNACE_CHANNEL, SLAB_ABSORPTION
from validation.run import kernel_timing
from validation.run.context import Context
from validation.run.metrics import DETECTABLE, DETECTABLE_IMAGE, WELCH_ALARMS
from validation.run.render_methods import OURS, Camera, sensor, under, welch_values_with_whole
from validation.study import Study, Task, about

from .ray_directions import N_SF11

NAME = "dispersion and absorption"
SIGMA, CORE = (0.2, 0.6, 1.5), (1.0, 0.1, 0.3)
SIZE = 48
DETECTED = "detectable per channel"
TERMS = {
    "off white": "largest relative difference of a channel's mean from that of the light",
    DETECTED: "the detectable difference: five standard errors of a channel's mean, relative",
    "off / detectable": "the former over the latter",
    "slab": "largest relative difference from exp(−σ d)",
    "time / without": "median over alternating warm renders",
    WELCH_ALARMS: "tiles and channels whose means differ; at most one image in 1000 by chance",
    DETECTABLE: "relative difference of a tile's mean that is detected with a probability of 99 %, median over tiles, "
    "worst channel",
    DETECTABLE_IMAGE: "the same for the mean of the whole image",
}
METHODS: dict[str, dict[str, Any]] = {"by chance": {}, "both lobes": {"split_depth": 2}}
Nodes = dict[str, Any]


def scene(resolution: int, parts: Nodes, integrator: Nodes) -> Any:
    """Return a scene of parts around the origin, seen from 5 units away, in a constant environment."""
    eye, light = sensor(resolution, 30, [0, 1, 5]), {"type": "constant"}
    return mi.load_dict({"type": "scene", "sensor": eye, "integrator": integrator, "light": light} | parts)


def ours(**parameters: Any) -> Nodes:
    """Return the description of `refract_path`."""
    return {"type": OURS, "max_depth": 32, "rr_depth": 32} | parameters


def glass(n: Any, outside: Any = 1.0, **absorption: Any) -> Nodes:
    """Return the description of a `refract` boundary."""
    return {"type": "refract", "int_ior": n, "ext_ior": outside} | absorption


def furnace_rows(context: Context, variant: str, method: str) -> list[Row]:
    """Return the row of a ball of dense flint around a ball of water."""
    if reason := context.variants.get(variant, "not in this wheel"):
        return [Row(NAME, "furnace", method, variant, reason=reason)]
    drop = {"type": "sphere", "radius": 0.5, "bsdf": glass("cauchy(1.3237, 3170)", N_SF11)}
    parts = {"ball": {"type": "sphere", "bsdf": glass(N_SF11)}, "drop": drop}
    spp = {"quick": 256, "standard": 1024, "full": 4096}[context.profile.name]
    with under(variant):
        balls, empty = Camera(scene(32, parts, ours(rr_depth=10_000, **METHODS[method]))), Camera(scene(32, {}, ours()))
        means = np.stack([balls(spp, seed)[0].mean((0, 1)) for seed in range(16)])
        white = np.stack([empty(4 * spp, 100 + seed)[0].mean((0, 1)) for seed in range(16)])
    error = np.sqrt((means.var(0, ddof=1) + white.var(0, ddof=1)) / 16)
    off = np.abs(means.mean(0) / white.mean(0) - 1)
    detectable = 5 * error / white.mean(0)
    values = {"off white": off.max(), DETECTED: detectable.max(), "off / detectable": (off / detectable).max()}
    budgets = {"off / detectable": 1.0} | ({} if context.profile.quick else {DETECTED: FURNACE_CHANNEL})
    replay = {"spp": spp, "seeds": 16, "resolution": 32}
    return [Row(NAME, "furnace", method, variant, {k: float(x) for k, x in values.items()}, budgets, replay=replay)]


def rgb(sigma: Sequence[float]) -> Nodes:
    """Return the description of a colour."""
    return {"type": "rgb", "value": list(sigma)}


def absorbing_parts(name: str, absorbing: bool) -> Nodes:
    """Return a scene by its name: with `refract` (`absorbing`), or with `dielectric` and media on its sides."""

    def shape(inside: Sequence[float], outside: Sequence[float] = (), n: float = 1.5) -> Nodes:
        around = 1.5 if outside else 1.0
        sides = {"int": inside} | ({"ext": outside} if outside else {})
        if absorbing:
            return {"bsdf": glass(n, around, **{f"{side}_absorption": rgb(x) for side, x in sides.items()})}
        mediums = {{"int": "interior", "ext": "exterior"}[side]: medium(x) for side, x in sides.items()}
        return {"bsdf": {"type": "dielectric", "int_ior": n, "ext_ior": around}} | mediums

    def medium(sigma: Sequence[float]) -> Nodes:
        """Return a homogeneous medium; Mitsuba takes a colour up to 1 and a scale."""
        most = max(sigma)
        return {"type": "homogeneous", "albedo": 0.0, "sigma_t": rgb([x / most for x in sigma]), "scale": most}

    ball = {"type": "sphere"} | shape(SIGMA)
    inner: dict[str, Any] = {"type": "sphere", "radius": 0.5} | shape(CORE, SIGMA, 1.33)
    matt: dict[str, Any] = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "diffuse", "reflectance": 0.6}}
    matt |= {} if absorbing else {"exterior": medium(SIGMA)}
    scenes: dict[str, Nodes] = {
        "sphere": {"ball": ball},
        "nested": {"ball": ball, "inner": inner},
        "matt inside": {"box": {"type": "cube"} | shape(SIGMA), "matt": matt},
    }
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).scale(3)}
    return scenes[name] | {"wall": wall}


def volpath_rows(context: Context, name: str) -> list[Row]:
    """Return the row of Welch's test against `volpath`, on tiles of 8² pixels and on the whole image."""
    count, spp = (8, 64) if context.profile.quick else (16, 1024)
    volpath = {"type": "volpath", "max_depth": 64, "rr_depth": 64}
    test, reference = (
        np.stack([camera(spp, first + seed)[0] for seed in range(count)])
        for camera, first in (
            (Camera(scene(SIZE, absorbing_parts(name, True), ours(max_depth=16))), 100),
            (Camera(scene(SIZE, absorbing_parts(name, False), volpath)), 0),
        )
    )
    values = welch_values_with_whole(reference, test, tile=8)
    budgets = {WELCH_ALARMS: 0.0} | ({} if context.profile.quick else {DETECTABLE_IMAGE: ABSORPTION_SEEN})
    replay = {"spp": spp, "seeds": count, "resolution": SIZE}
    return [Row(NAME, "volpath", name, context.variant, values, budgets, replay=replay)]


def slab_rows(context: Context) -> list[Row]:
    """Return the row of slabs of 1 to 4 units, σ of 0.05 to 8, without reflections: the index is that around them."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "component_format": "float32"}
    place = mi.ScalarTransform4f().look_at([0.1, 0.2, 5], [0.1, 0.2, 4], [0, 1, 0]).scale(1e-3)
    straight = {"type": "orthographic", "to_world": place, "film": film | {"pixel_format": "rgb"}}
    off = list[float]()
    for thickness in (1.0, 2.0, 4.0):
        for sigma in (0.05, 0.5, 2.0, 8.0 / thickness):
            sides = mi.ScalarTransform4f().scale([20, 20, thickness / 2])
            slab = {"type": "cube", "to_world": sides, "bsdf": glass(1.0, int_absorption=sigma)}
            loaded = scene(1, {"slab": slab}, ours(deterministic=True))
            transmittance = float(np.array(mi.render(loaded, sensor=mi.load_dict(straight), spp=1))[0, 0, 0])
            off.append(abs(transmittance / math.exp(-sigma * thickness) - 1))
    values = {"slab": float(np.max(off))}
    return [Row(NAME, "slab", "exp(−σ d)", context.variant, values, {"slab": SLAB_ABSORPTION})]


def time_rows(context: Context) -> list[Row]:
    """Return the rows of the times with dispersion and with absorption, over those without."""
    plain, rows = glass(float(media.index(N_SF11, media.LINES["d"]))), []
    kinds: dict[str, tuple[str, Nodes, float]] = {
        "dispersion": ("llvm_ad_spectral", glass(N_SF11), DISPERSION_TIME),
        "absorption": ("llvm_ad_rgb", plain | {"int_absorption": rgb(SIGMA)}, ABSORPTION_TIME),
    }
    for kind, (variant, bsdf, goal) in kinds.items():
        if reason := context.variants.get(variant, "not in this wheel"):
            rows.append(Row(NAME, "time", kind, variant, reason=reason))
            continue
        size, metric = 128 if context.profile.quick else 256, "time / without"
        with under(variant):
            balls = {x: {"type": "sphere", "bsdf": y} for x, y in (("with", bsdf), ("without", plain))}
            cameras = {x: Camera(scene(size, {"ball": ball}, ours())) for x, ball in balls.items()}

            def clock(camera: Camera) -> float:
                return statistics.median(camera(16, 0)[1] for _ in range(3))

            times = kernel_timing.rounds(cameras, clock, max(context.profile.repeats, 9))
        values = kernel_timing.ratio(metric, times["with"], times["without"])
        rows.append(Row(NAME, "time", kind, variant, values, goals={metric: goal}, replay={"resolution": size}))
    return rows


def tasks(context: Context) -> list[Task]:
    """Return the tasks: furnaces, comparisons with `volpath`, a slab, times."""
    if context.scalar:
        return [Task(NAME, lambda: [Row(NAME, "all", "all", context.variant, reason="needs a compiled variant")])]
    partial = functools.partial
    variants = ("llvm_ad_spectral", "llvm_ad_spectral_polarized", "cuda_ad_spectral")
    furnaces = {f"furnace {v}, {m}": partial(furnace_rows, context, v, m) for v in variants for m in METHODS}
    scenes = {name: partial(volpath_rows, context, name) for name in ("sphere", "nested", "matt inside")}
    every = furnaces | scenes | {"slab": partial(slab_rows, context)}
    timed = Task(f"{NAME}: times", partial(time_rows, context), timed=True)
    return [*(Task(f"{NAME}: {name}", rows) for name, rows in every.items()), timed]


STUDY = Study(NAME, "Dispersion and absorption", about(__doc__), TERMS, tasks)
