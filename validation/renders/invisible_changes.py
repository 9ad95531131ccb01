"""Changes that must not change an image: a part that is not seen, a wrapper that does nothing, another way to render.

A part of a scene is left out where it is not needed. So an image may not depend on what else is in the scene, on how
its numbers are written, or on what calls the integrator. Each change is made in scenes of glass only and of glass and
matt surfaces, with and without splitting. Where the same random numbers are drawn the images are the same bits;
otherwise both are compared by Welch's test of the whole image and of its tiles, and where the change keeps the
stratification, by their noise.

`python -m validation renders`
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refract.image_diff import tile_statistics
from mi_refract.report.row import Row
from validation import limits
from validation.repeated import by_tasks
from validation.run.context import Context
from validation.run.seeds import current
from validation.study import Study, Task, about

TERMS = {
    "alarms": "tiles, and the whole image, that Welch's test calls different",
    "same bits": "1 where both images have the same bits, so that no test was needed",
    "detectable": "relative difference of the whole image's mean that the test finds with probability 1/2",
    "noise": "variance between renders over that of the unchanged scene",
}
NAME = "invisible changes"
SIZE, RENDERS = 16, 8
SPP = {"matt": 256, "dispersive": 64}  # caustics and colours are noise; 16 for the others
TILE = 8
Nodes = dict[str, Any]
Change = Callable[[Nodes], None]


def sky() -> Nodes:
    """An environment with stripes, so that directions matter."""
    around = 0.6 + 0.4 * np.sin(np.arange(32) * 2 * np.pi / 32 * 5 + 0.3)
    down = np.linspace(0, 0.7, 16)
    image = (around[None, :, None] + down[:, None, None]) * np.ones(3)
    return {"type": "envmap", "bitmap": mi.Bitmap(image.astype(np.float32))}


def texture(value: Any, size: int = 1) -> Nodes:
    """A bitmap of one value."""
    image = np.ones((size, size, 3), np.float32) * np.asarray(value, np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True}


GLASS = {"type": "refract", "int_ior": 1.5, "ext_ior": 1.0}


def scenes(spectral: bool) -> dict[str, Nodes]:
    """Scenes by name, for `mi.load_dict`; each has a `ball`, which the changes are made to."""
    place = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 30, "film": film, "sampler": {"type": "independent"}}
    sensor["to_world"] = place().look_at([0.3, 0.5, 5], [0, 0, 0], [0, 1, 0])
    ball = {"type": "sphere", "bsdf": dict(GLASS)}
    pane = {"type": "cube", "to_world": place().translate([0.8, 0, -2]).scale([0.7, 1, 0.2]), "bsdf": dict(GLASS)}
    bars = np.kron(np.eye(2, dtype=np.float32), np.ones((1, 1), np.float32))[..., None]
    grille = {"type": "bitmap", "bitmap": mi.Bitmap(bars), "raw": True, "filter_type": "nearest"}
    grille["to_uv"] = place().scale([8, 8, 1])
    down = place().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(4)
    lamp = {"type": "rectangle", "to_world": place().translate([0, 0.2, 0]) @ down}
    matt = {
        "floor": {"type": "rectangle", "to_world": place().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(6)},
        "grille": {"type": "rectangle", "to_world": down},
        "lamp": lamp | {"emitter": {"type": "area", "radiance": 1.0}},
    }
    matt["floor"]["bsdf"] = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    matt["grille"]["bsdf"] = {"type": "mask", "opacity": grille, "b": {"type": "diffuse", "reflectance": 0.0}}
    tinted = ball | {"bsdf": GLASS | {"int_absorption": 0.5}}
    turned = texture([0.5 + 0.5 * np.sin(0.35), 0.5, 0.5 + 0.5 * np.cos(0.35)])
    mapped = {"type": "disk", "bsdf": {"type": "normalmap", "normalmap": turned, "b": dict(GLASS)}}
    found = {
        "glass": {"ball": ball, "pane": pane, "sky": sky()},
        "matt": {"ball": ball, **matt},
        "absorbing": {"ball": tinted, "sky": sky()},
        "normal map": {"ball": mapped, "pane": pane, "sky": sky()},
    }
    if spectral:
        found["dispersive"] = {"ball": ball | {"bsdf": GLASS | {"int_ior": "cauchy(1.7, 13000)"}}, "sky": sky()}
    return {name: {"type": "scene", "sensor": sensor} | parts for name, parts in found.items()}


def _wrap(wrapper: Nodes) -> Change:
    def change(scene: Nodes) -> None:
        scene["ball"]["bsdf"] = wrapper | {"b": scene["ball"]["bsdf"]}

    return change


def _add(**parts: Nodes) -> Change:
    return lambda scene: scene.update(parts)


def _blend(scene: Nodes) -> None:
    inner = scene["ball"]["bsdf"]
    scene["ball"]["bsdf"] = {"type": "blendbsdf", "weight": 0.3, "a": inner, "b": inner}


def _instance(scene: Nodes) -> None:
    scene["group"] = {"type": "shapegroup", "part": scene.pop("ball")}
    scene["ball"] = {"type": "instance", "group": {"type": "ref", "id": "group"}}


def _order(scene: Nodes) -> None:
    scene["ball"] = scene.pop("ball")


def _parameter(name: str, value: Any) -> Change:
    def change(scene: Nodes) -> None:
        scene["ball"]["bsdf"][name] = value() if callable(value) else value

    return change


BEHIND = [0, 0, 90]
# Changes of the scene. `refract` itself must be the BSDF of the ball for those of its parameters and for absorption.
CHANGES: dict[str, Change] = {
    "matt ball far away": _add(far={"type": "sphere", "center": BEHIND}),
    "dark lamp": _add(
        far={
            "type": "sphere",
            "center": BEHIND,
            "bsdf": {"type": "null"},
            "emitter": {"type": "area", "radiance": 1e-20},
        }
    ),
    "dark point lamp": _add(far={"type": "point", "position": BEHIND, "intensity": 1e-20}),
    "instance": _instance,
    "other order": _order,
    "mask of opacity 1": _wrap({"type": "mask", "opacity": 1.0}),
    "blend of itself": _blend,
    "flat normal map": lambda scene: _wrap({"type": "normalmap", "normalmap": texture([0.5, 0.5, 1.0])})(scene),
    "flat bump map": lambda scene: _wrap({"type": "bumpmap", "arbitrary": texture(0.5, 4)})(scene),
    "texture as tint": _parameter("specular_reflectance", lambda: texture(1.0)),
    "texture as index": _parameter("int_ior", lambda: texture(1.5)),
    "absorption 1e-30": _parameter("int_absorption", 1e-30),
}
# Other ways to render the same scene: what is around the integrator, its parameters, parameters of `mi.render`.
WAYS: dict[str, tuple[Nodes | None, Nodes]] = {
    "moment": ({"type": "moment"}, {}),
    "aov": ({"type": "aov", "aovs": "d:depth"}, {}),
    "passes": (None, {"samples_per_pass": 4}),
}
WRAPPED = {"mask of opacity 1", "blend of itself", "flat normal map", "flat bump map"}


def changed(scene: str, name: str) -> bool:
    """Whether a change can be made to a scene: absorption is not within a wrapper, a table not beside a texture.

    A bump map around a normal map turns the tangent that the normals refer to, by `path` as well.
    """
    if scene == "absorbing" and (name in WRAPPED or name == "absorption 1e-30"):
        return False
    if scene == "normal map" and name in ("texture as tint", "texture as index", "absorption 1e-30", "flat bump map"):
        return False
    if mi.is_spectral and name == "texture as tint":  # a raw bitmap has no spectrum
        return False
    return not (scene == "dispersive" and name == "texture as index")


def tasks(context: Context) -> list[Task]:
    """One per variant and scene; the profile `quick` renders in the variant of the run only."""
    if context.scalar:
        reason = "scalar variants would render for hours"
        return [Task(NAME, lambda: [Row(NAME, "refract_path", "every change", context.variant, reason=reason)])]
    family = context.variant.removesuffix("rgb")
    others = [] if context.profile.quick else [f"{family}spectral", f"{family}spectral_polarized"]
    usable = [v for v in (context.variant, *others) if context.variants.get(v) is None]
    return [
        Task(f"{NAME}: {variant} {scene}, split {depth}", functools.partial(rows, variant, scene, depth))
        for variant in usable
        for scene in ("glass", "matt", "absorbing", "normal map", *(["dispersive"] if "spectral" in variant else []))
        for depth in ((0, 2) if scene in ("glass", "matt") or not context.profile.quick else (2,))
    ]


def images(scene: Any, around: Nodes | None, depth: int, spp: int, seed: int, **parameters: Any) -> Any:
    """Independent renders, one a seed."""
    inner = {"type": "refract_path", "max_depth": 8, "rr_depth": 100, "split_depth": depth} | parameters
    method = mi.load_dict(inner if around is None else around | {"inner": inner})
    found = [mi.render(scene, integrator=method, spp=spp, seed=seed + i) for i in range(RENDERS)]
    return np.array([np.array(image)[..., :3] for image in found], dtype=float)


def rows(variant: str, name: str, depth: int) -> list[Row]:
    """One row a change of one scene."""
    before: Any = mi.variant()
    mi.set_variant(variant)
    try:
        seed, parts = current(SEED), scenes("spectral" in variant)[name]
        unchanged = mi.load_dict(parts, parallel=False, optimize=False)
        spp = SPP.get(name, 16)
        expected = images(unchanged, None, depth, spp, seed)
        found = []
        for change in (*CHANGES, *WAYS):
            if not changed(name, change):
                continue
            scene, around, parameters = unchanged, None, dict[str, Any]()
            if change in CHANGES:
                other = scenes("spectral" in variant)[name]
                CHANGES[change](other)
                scene = mi.load_dict(other, parallel=False, optimize=False)
            else:
                around, parameters = WAYS[change]
            values = compared(expected, functools.partial(images, scene, around, depth, spp, **parameters), seed)
            budgets = {"alarms": 0.0, "detectable": limits.INVISIBLE}
            budgets |= {"noise": limits.INVISIBLE_NOISE} if change in WAYS and not values["same bits"] else {}
            case, replay = f"{name}, split {depth}: {change}", {"seed": seed, "spp": spp}
            found.append(Row(NAME, "refract_path", case, variant, values, budgets, replay=replay))
            del scene
            gc.collect()
        return found
    finally:
        mi.set_variant(before)


def compared(expected: Any, render: Callable[[int], Any], seed: int) -> dict[str, float]:
    """The values of a row: of the same seeds, or of other ones where the bits differ."""
    same = render(seed)
    bits = bool((same == expected).all())
    other = same if bits else render(seed + 1000)
    alarms, means = 0.0, [x.mean(axis=(1, 2)) for x in (expected, other)]
    for tile in (SIZE, TILE) if not bits else ():
        alarms += tile_statistics.compare_stacks(expected, other, tile, limits.INVISIBLE_ALARM, 1e-5).alarms
    alarms += float(not np.isfinite(other).all())
    error = np.sqrt(sum(x.var(axis=0, ddof=1) / RENDERS for x in means))
    detectable = 0.0 if bits else float((4.5 * error / expected.mean()).max())
    noise = [np.var(x, axis=0, ddof=1).mean() for x in (expected, other)]
    ratio = float(noise[1] / noise[0]) if noise[0] else 1.0
    return {"alarms": alarms, "same bits": float(bits), "detectable": detectable, "noise": ratio}


SEED = 2031
STUDY = Study(NAME, "Changes that must not be seen", about(__doc__), TERMS, tasks, again=by_tasks(tasks))
