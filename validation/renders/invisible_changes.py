"""Changes that must not change an image: a part that is out of view, a wrapper without effect, another way to render.

`refract_path` leaves out features that a scene does not need. An image must not depend on what else is in the scene, on
how its numbers are written, or on what calls the integrator. Each change is made in scenes of glass only and of glass
and matt surfaces, with and without splitting. If both images have the same random numbers, they are equal bit for bit.
Otherwise they are compared by Welch's test of the whole image and of its tiles, and by their noise if the change keeps
the stratification.
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable, Iterator
from typing import Any

import mitsuba as mi
import numpy as np
from scipy import special

from mi_refract.image_diff import tile_statistics
from mi_refract.report.row import Row
from validation import limits
from validation.run.context import Context
from validation.run.render_methods import OURS, sensor
from validation.run.seeds import current

from .cases import BLACK, GLASS, TURNED, Case, Nodes, bitmap, environment, flat, study, variants

TERMS = {
    "alarms": "tiles, and the whole image, that Welch's test calls different",
    "same bits": "1 if both images are equal bit for bit, so that no test was needed",
    "detectable": "relative difference of the whole image's mean that the test detects with probability 1/2",
    "noise": "variance between renders over that of the unchanged scene",
}
NAME, SEED = "invisible changes", 2031
SIZE, TILE, RENDERS = 16, 8, 8
SPP = {"matt": 256, "dispersive": 64}  # caustics and colours have more noise; 16 for the others


def scenes(spectral: bool) -> dict[str, Nodes]:
    """Return the scenes by name, for `mi.load_dict`; each has a `ball`, to which the changes are made."""
    place = mi.ScalarTransform4f
    stripes = 0.6 + 0.4 * np.sin(np.arange(32) * 2 * np.pi / 32 * 5 + 0.3)  # makes directions matter
    sky = environment((stripes[None, :, None] + np.linspace(0, 0.7, 16)[:, None, None]) * np.ones(3))
    ball = {"type": "sphere", "bsdf": dict(GLASS)}
    pane = {"type": "cube", "to_world": place().translate([0.8, 0, -2]).scale([0.7, 1, 0.2]), "bsdf": dict(GLASS)}
    grille = bitmap(np.eye(2), filter_type="nearest", to_uv=place().scale([8, 8, 1]))
    down = place().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(4)
    floor = {"type": "rectangle", "to_world": place().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(6)}
    lamp = {"type": "rectangle", "to_world": place().translate([0, 0.2, 0]) @ down}
    matt = {
        "floor": floor | {"bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}},
        "grille": {"type": "rectangle", "to_world": down, "bsdf": {"type": "mask", "opacity": grille, "b": BLACK}},
        "lamp": lamp | {"emitter": {"type": "area", "radiance": 1.0}},
    }
    mapped = {"type": "disk", "bsdf": {"type": "normalmap", "normalmap": flat(TURNED), "b": dict(GLASS)}}
    parts = {
        "glass": {"ball": ball, "pane": pane, "sky": sky},
        "matt": {"ball": ball, **matt},
        "absorbing": {"ball": ball | {"bsdf": GLASS | {"int_absorption": 0.5}}, "sky": sky},
        "normal map": {"ball": mapped, "pane": pane, "sky": sky},
    }
    if spectral:
        parts["dispersive"] = {"ball": ball | {"bsdf": GLASS | {"int_ior": "cauchy(1.7, 13000)"}}, "sky": sky}
    view = sensor(SIZE, 30, [0.3, 0.5, 5])
    return {name: {"type": "scene", "sensor": view} | nodes for name, nodes in parts.items()}


BEHIND, DARK = [0, 0, 90], {"type": "area", "radiance": 1e-20}


def changed(scene: Nodes, change: str) -> Nodes:
    """Return the scene with a change of `changes`."""
    ball = scene["ball"]
    added, wrapper, parameter = changes()[change]
    if added:
        return scene | {"far": added}
    if change == "instance":
        group = {"type": "shapegroup", "part": scene.pop("ball")}
        return scene | {"group": group, "ball": {"type": "instance", "group": {"type": "ref", "id": "group"}}}
    if change == "other order":
        return {name: scene[name] for name in scene if name != "ball"} | {"ball": ball}
    inner = ball["bsdf"]
    if wrapper:
        nested = {"a": inner, "b": inner} if change == "blend of itself" else {"b": inner}
        return scene | {"ball": ball | {"bsdf": wrapper | nested}}
    return scene | {"ball": ball | {"bsdf": inner | parameter}}


def changes() -> dict[str, tuple[Nodes, Nodes, Nodes]]:
    """Return by name: an object far away, a wrapper of the ball's BSDF, or parameters of its `refract`."""
    return {
        "matt ball far away": ({"type": "sphere", "center": BEHIND}, {}, {}),
        "dark lamp": ({"type": "sphere", "center": BEHIND, "bsdf": {"type": "null"}, "emitter": DARK}, {}, {}),
        "dark point lamp": ({"type": "point", "position": BEHIND, "intensity": 1e-20}, {}, {}),
        "instance": ({}, {}, {}),
        "other order": ({}, {}, {}),
        "mask of opacity 1": ({}, {"type": "mask", "opacity": 1.0}, {}),
        "blend of itself": ({}, {"type": "blendbsdf", "weight": 0.3}, {}),
        "flat normal map": ({}, {"type": "normalmap", "normalmap": flat([0.5, 0.5, 1.0])}, {}),
        "flat bump map": ({}, {"type": "bumpmap", "arbitrary": flat(0.5, 4)}, {}),
        "texture as tint": ({}, {}, {"specular_reflectance": flat(1.0)}),
        "texture as index": ({}, {}, {"int_ior": flat(1.5)}),
        "absorption 1e-30": ({}, {}, {"int_absorption": 1e-30}),
    }


# Other ways to render the same scene: an integrator around ours, and parameters of ours.
WAYS: dict[str, tuple[Nodes | None, Nodes]] = {
    "moment": ({"type": "moment"}, {}),
    "aov": ({"type": "aov", "aovs": "d:depth"}, {}),
    "passes": (None, {"samples_per_pass": 4}),
}
WRAPPED = {"mask of opacity 1", "blend of itself", "flat normal map", "flat bump map"}
# Changes that a scene cannot have. Wrappers do not support absorption, a table excludes a texture, and a raw bitmap has
# no spectrum. A bump map around a normal map rotates the tangent that the normals refer to, in `path` too.
IMPOSSIBLE = {
    "absorbing": {*WRAPPED, "absorption 1e-30"},
    "normal map": {"texture as tint", "texture as index", "absorption 1e-30", "flat bump map"},
    "dispersive": {"texture as index"},
    "spectral": {"texture as tint"},
}


def cases(context: Context) -> Iterator[Case]:
    """Yield one case per variant, scene and split depth; in the profile `quick`, in the variant of the run only."""
    quick = context.profile.quick
    for variant in variants(context)[: 1 if quick else 3]:
        names = ["glass", "matt", "absorbing", "normal map", *(["dispersive"] if "spectral" in variant else [])]
        for name in names:
            for depth in (2,) if quick and name not in ("glass", "matt") else (0, 2):
                work = functools.partial(rows, variant, name, depth)
                yield Case(f"{variant} {name}, split {depth}", variant, work)


def rows(variant: str, name: str, depth: int) -> list[Row]:
    """Return one row per change of one scene."""

    def images(scene: Any, around: Nodes | None, first: int, **parameters: Any) -> Any:
        """Return independent renders with the seeds `first`, `first` + 1, …"""
        inner = {"type": OURS, "max_depth": 8, "rr_depth": 100, "split_depth": depth} | parameters
        method = mi.load_dict(around | {"inner": inner} if around else inner)
        renders = [mi.render(scene, integrator=method, spp=spp, seed=first + i) for i in range(RENDERS)]
        return np.array([np.array(image)[..., :3] for image in renders], dtype=float)

    spectral, seed, spp, table = "spectral" in variant, current(SEED), SPP.get(name, 16), []
    left_out = IMPOSSIBLE.get(name, set()) | (IMPOSSIBLE["spectral"] if spectral else set())
    unchanged = mi.load_dict(scenes(spectral)[name], parallel=False, optimize=False)
    expected = images(unchanged, None, seed)
    for change in (*changes(), *WAYS):
        if change in left_out:
            continue
        scene, (around, parameters) = unchanged, WAYS.get(change, (None, {}))
        if change not in WAYS:
            scene = mi.load_dict(changed(scenes(spectral)[name], change), parallel=False, optimize=False)
        values = compared(expected, functools.partial(images, scene, around, **parameters), seed)
        budgets = {"alarms": 0.0, "detectable": limits.INVISIBLE}
        budgets |= {"noise": limits.INVISIBLE_NOISE} if change in WAYS and not values["same bits"] else {}
        case, replay = f"{name}, split {depth}: {change}", {"seed": seed, "spp": spp}
        table.append(Row(NAME, OURS, case, variant, values, budgets, replay=replay))
        del scene
        gc.collect()
    return table


def compared(expected: Any, render: Callable[[int], Any], seed: int) -> dict[str, float]:
    """Return the values of a row: with the same seeds, or with other seeds if these images differ."""
    same_seeds = render(seed)
    same_bits = bool((same_seeds == expected).all())
    test = same_seeds if same_bits else render(seed + 1000)
    alarms, detectable = float(not np.isfinite(test).all()), 0.0
    for tile in (TILE, SIZE) if not same_bits else ():
        tests = tile_statistics.compare_stacks(expected, test, tile, limits.INVISIBLE_ALARM, 1e-5)
        alarms, whole = alarms + tests.alarms, tests.levels[0]
        reach = -special.stdtrit(whole.freedom, tests.threshold / 2) * whole.error
        detectable = float((whole.allowed + reach).max() / expected.mean())  # that of SIZE, the last, remains
    noise = [np.var(x, axis=0, ddof=1).mean() for x in (expected, test)]
    ratio = float(noise[1] / noise[0]) if noise[0] else 1.0
    return {"alarms": alarms, "same bits": float(same_bits), "detectable": detectable, "noise": ratio}


STUDY = study(NAME, "Changes that must not be visible", __doc__, TERMS, cases)
