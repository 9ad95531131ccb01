"""Settings that a pilot chooses: their error × time over that of the best settings by hand and of Mitsuba's defaults.

`mi-refract render --settings auto` measures a few candidates before it renders. This study renders its choice and many
settings by hand. The first rounds select the settings by hand with the least error × time. Further rounds, with other
seeds, measure these, the choice and Mitsuba's defaults: the least of many in the same rounds would be too small. The
error is the variance over the rounds, which contains no bias; so the samplers are those with which `path` has the
least (study `samplers`). Times are those of whole images. The pilot's share of the render is included, its compilation
is not.
"""

from __future__ import annotations

import functools
import itertools
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refract.plugins import PLUGIN
from mi_refract.rendering.checkpoint import PILOT, SETTINGS
from mi_refract.rendering.end_conditions import Limits
from mi_refract.rendering.long_render import Job, resume
from mi_refract.rendering.render_settings import AUTO, DEFAULTS, Settings, parse_settings, settings_text, with_settings
from mi_refract.rendering.scene_files import load_parsed, parse_scene
from mi_refract.report.row import Reason, Row
from validation import limits
from validation.run import kernel_timing
from validation.run.context import SCENES, Context, beyond_builtin
from validation.run.metrics import EQUAL_TIME_DEFAULTS, EQUAL_TIME_HAND
from validation.run.render_methods import BUILTIN, DIELECTRIC, OURS, Camera, sensor
from validation.study import Study, Task, about

from . import caustic_scenes
from .error_against_time import SCALAR, why_no_error

NAME = "chosen settings"
EVERY = "every scene"
SHARE = "pilot / render"
TERMS = {
    EQUAL_TIME_HAND: "MSE × time, pilot included, over that of the best settings by hand; low, high: 95 % interval",
    EQUAL_TIME_DEFAULTS: f"the same over `path`, `{DIELECTRIC}` and `independent`, Mitsuba's defaults",
    SHARE: "time of the pilot over that of the render",
}


@dataclass(frozen=True)
class Extent:
    """How much is measured: `scenes` (() is all), and `rounds` images of `resolution`² pixels and `spp` each time."""

    scenes: tuple[str, ...]
    resolution: int
    spp: int = 49  # the square of a prime, which no sampler rounds: `orthogonal` would render 121 for 64
    rounds: int = 6
    samplers: tuple[str, ...] = ("multijitter", "orthogonal", "independent")
    depths: tuple[int, ...] = (0, 3)


EXTENTS = {
    "quick": Extent(("balls",), 64),
    "standard": Extent(("balls", "slab", "ball, square 0.05"), 128),
    "full": Extent((), 192),
}
# Scenes in addition to the scene files: typical ones and caustics.
CAUSTICS = tuple((body, f"square {side}") for body in ("ball", "glass of water", "diamond") for side in (0.05, 0.7))
OTHERS = ("cornell box", "cornell box, glass", "materials", *(", ".join(case) for case in CAUSTICS))


def tasks(context: Context) -> list[Task]:
    """Return one task per scene."""
    if context.scalar:
        return [Task(NAME, lambda: [Row(NAME, "auto", EVERY, context.variant, reason=SCALAR)])]
    extent = EXTENTS[context.profile.name]
    every = [path.stem for path in sorted(SCENES.glob("*.xml")) if not beyond_builtin(path)] + [*OTHERS]
    made = [
        Task(f"{NAME}: {name}", functools.partial(scene_rows, context, name), timed=True)
        for name in every
        if not extent.scenes or name in extent.scenes
    ]
    left_out = len(every) - len(made)
    if left_out:
        reason = Reason(f"left out: {left_out} scenes", "`--profile full`")
        made.append(Task(f"{NAME}: others", lambda: [Row(NAME, "auto", "others", context.variant, reason=reason)]))
    return made


# Scenes --------------------------------------------------------------------------------------------------------


def other_scene(name: str, bsdf: str, resolution: int) -> dict[str, Any]:
    """Return a scene of OTHERS, for `mi.load_dict`, with `path` and `independent`."""
    flat = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(6)
    gray = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    floor = {"type": "rectangle", "to_world": flat, "bsdf": gray}
    parts: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": 12}, "floor": floor}
    if name == "materials":
        balls = {"roughplastic": -2.1, "roughconductor": 0.0, bsdf: 2.1}
        parts |= {f"ball_{i}": _ball([x, 1, 0], 1.0, {"type": kind}) for i, (kind, x) in enumerate(balls.items())}
        sky = {"type": "envmap", "filename": str(SCENES / "lamps.exr")}
        return parts | {"sky": sky, "sensor": sensor(resolution, 40, [0, 3, 8], (0, 0.7, 0))}
    if name.startswith("cornell"):
        parts = mi.cornell_box()
        parts["sensor"]["film"] = sensor(resolution, 40, [0, 0, 1])["film"]
        parts["sensor"]["sampler"] = {"type": "independent"}
        if name.endswith("glass"):
            del parts["small-box"], parts["large-box"]
            parts["glass"] = _ball([0.35, -0.65, 0.3], 0.35, {"type": bsdf})
            parts["mirror"] = _ball([-0.4, -0.6, -0.3], 0.4, {"type": "conductor", "material": "Al"})
        return parts
    body, lamp = name.split(", ")
    parts |= caustic_scenes.BODIES[body](bsdf) | {"lamp": caustic_scenes.lamp_of(lamp)}
    return parts | {"sensor": sensor(resolution, 24, caustic_scenes.CAMERA, (0.0, 0.4, 0.0))}


def _ball(center: list[float], radius: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "sphere", "center": center, "radius": radius, "bsdf": bsdf}


def scene_file(name: str, bsdf: str, resolution: int, folder: Path) -> tuple[Path, dict[str, str]]:
    """Return a scene's file and the values of its defaults. A scene of OTHERS is written to the folder."""
    if name not in OTHERS:
        return SCENES / f"{name}.xml", {"bsdf": bsdf, "res": str(resolution)}
    path = folder / f"{name} {bsdf}.xml"
    state = mi.parser.parse_dict(mi.parser.ParserConfig("scalar_rgb"), other_scene(name, bsdf, resolution))
    mi.parser.write_file(state, str(path))
    return path, {}


# Costs ---------------------------------------------------------------------------------------------------------


def full(settings: Settings) -> Settings:
    """Return settings with all defaults filled in."""
    with_defaults = {"sampler": "independent", "integrator": "path"} | settings
    return (DEFAULTS if with_defaults["integrator"] == OURS else {}) | with_defaults


def by_hand(extent: Extent, figures: dict[str, Any]) -> list[Settings]:
    """Return all settings by hand of a scene; with splitting and lamps if the pilot has tried them (`figures`)."""
    tried = "".join(figures["costs"])
    depths = extent.depths if "split_depth" in tried else (0,)
    lamps = ("path", "lamp") if "lamp" in tried else ("path",)
    integrators: list[Settings] = [{"integrator": "path"}]
    for depth, caustics in itertools.product(depths, lamps):
        integrators.append({"integrator": OURS, "split_depth": str(depth), "caustics": caustics})
    return [{"sampler": sampler, **integrator} for sampler in extent.samplers for integrator in integrators]


def costs(cameras: dict[str, Camera], spp: int, rounds: int, first_seed: int = 0) -> dict[str, list[float]]:
    """Return squared error × seconds by round; the error is the deviation from the mean of all rounds."""
    seeds, cost = itertools.count(first_seed), {}
    renders = kernel_timing.rounds(cameras, lambda camera: camera(spp, next(seeds)), rounds)
    for name, warm in renders.items():
        images = np.stack([image for image, _ in warm])
        squares = np.square(images - images.mean(0)).reshape(rounds, -1).mean(1) * rounds / (rounds - 1)
        seconds = statistics.median(seconds for _, seconds in warm)
        cost[name] = [float(square) * seconds for square in squares]
    return cost


def scene_rows(context: Context, name: str) -> list[Row]:
    """Return the row of a scene."""
    extent, folder = EXTENTS[context.profile.name], context.out / "scenes"
    folder.mkdir(parents=True, exist_ok=True)
    row = functools.partial(Row, NAME, "auto", name, context.variant)
    (path, defines), default = (scene_file(name, bsdf, extent.resolution, folder) for bsdf in (PLUGIN, DIELECTRIC))
    render = resume(Job(path, defines, settings=AUTO), folder / "auto.exr", Limits(spp=extent.spp), restart=True)
    chosen, figures = full(parse_settings(render.progress.identity[SETTINGS])), render.progress.identity[PILOT]
    del render
    by_text = {settings_text(settings): settings for settings in (*by_hand(extent, figures), chosen)}
    cameras = {
        text: Camera(load_parsed(with_settings(parse_scene(path, defines), settings)))
        for text, settings in by_text.items()
    }
    cameras[BUILTIN.name] = Camera(load_parsed(parse_scene(*default)))
    if reason := why_no_error(cameras[BUILTIN.name]):
        return [row(reason=reason)]
    cost_of = costs(cameras, extent.spp, extent.rounds)
    best = min(by_text, key=lambda text: statistics.fmean(cost_of[text]))
    compared = {text: cameras[text] for text in (best, settings_text(chosen), BUILTIN.name)}
    cost_of = costs(compared, extent.spp, extent.rounds, first_seed=(extent.rounds + 1) * len(cameras))
    auto = [cost * (1 + figures["share"]) for cost in cost_of[settings_text(chosen)]]
    values = kernel_timing.ratio(EQUAL_TIME_HAND, auto, cost_of[best])
    values |= kernel_timing.ratio(EQUAL_TIME_DEFAULTS, auto, cost_of[BUILTIN.name])
    values |= {SHARE: figures["share"]}
    replay: dict[str, Any] = {"scene": name, "chosen": settings_text(chosen), "best by hand": best}
    replay |= {"resolution": extent.resolution, "spp": extent.spp, "rounds": extent.rounds}
    return [row(values, {}, limits.CHOSEN | {SHARE: limits.PILOT_SHARE}, f"chosen: {settings_text(chosen)}", replay)]


def summarise(rows: list[Row]) -> list[Row]:
    """Return all rows, with one added that holds the medians over the scenes."""
    measured = [row for row in rows if row.study == NAME and EQUAL_TIME_DEFAULTS in row.values]
    if len(measured) < 2:
        return rows
    values = {metric: statistics.median(row.values[metric] for row in measured) for metric in limits.CHOSEN}
    return [*rows, Row(NAME, "auto", EVERY, measured[0].setting, values, {}, limits.CHOSEN_MEDIAN)]


STUDY = Study(NAME, "Settings that a pilot chooses", about(__doc__), TERMS, tasks, summarise=summarise)
