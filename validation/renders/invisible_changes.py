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
from collections.abc import Callable, Iterator
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refract.image_diff import tile_statistics
from mi_refract.report.row import Row
from validation import limits
from validation.run.context import Context
from validation.run.render_methods import OURS
from validation.run.seeds import current

from .cases import BLACK, GLASS, TURNED, Case, Nodes, bitmap, camera, environment, flat, study, variants

TERMS = {
    "alarms": "tiles, and the whole image, that Welch's test calls different",
    "same bits": "1 where both images have the same bits, so that no test was needed",
    "detectable": "relative difference of the whole image's mean that the test finds with probability 1/2",
    "noise": "variance between renders over that of the unchanged scene",
}
NAME, SEED = "invisible changes", 2031
SIZE, TILE, RENDERS = 16, 8, 8
SPP = {"matt": 256, "dispersive": 64}  # caustics and colours are noise; 16 for the others
Change = Callable[[Nodes], None]


def scenes(spectral: bool) -> dict[str, Nodes]:
    """Scenes by name, for `mi.load_dict`; each has a `ball`, which the changes are made to."""
    place = mi.ScalarTransform4f
    stripes = 0.6 + 0.4 * np.sin(np.arange(32) * 2 * np.pi / 32 * 5 + 0.3)  # so that directions matter
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
    sensor = camera(SIZE, 30, [0.3, 0.5, 5])
    return {name: {"type": "scene", "sensor": sensor} | nodes for name, nodes in parts.items()}


def _wrap(wrapper: Callable[[], Nodes]) -> Change:
    def change(scene: Nodes) -> None:
        scene["ball"]["bsdf"] = wrapper() | {"b": scene["ball"]["bsdf"]}

    return change


def _set(name: str, value: Callable[[], Any]) -> Change:
    return lambda scene: scene["ball"]["bsdf"].update({name: value()})


def _add(**far: Any) -> Change:
    return lambda scene: scene.update(far=far)


def _blend(scene: Nodes) -> None:
    inner = scene["ball"]["bsdf"]
    scene["ball"]["bsdf"] = {"type": "blendbsdf", "weight": 0.3, "a": inner, "b": inner}


def _instance(scene: Nodes) -> None:
    scene["group"] = {"type": "shapegroup", "part": scene.pop("ball")}
    scene["ball"] = {"type": "instance", "group": {"type": "ref", "id": "group"}}


BEHIND, DARK = [0, 0, 90], {"type": "area", "radiance": 1e-20}
# Changes of the scene. `refract` itself must be the BSDF of the ball for those of its parameters and for absorption.
CHANGES: dict[str, Change] = {
    "matt ball far away": _add(type="sphere", center=BEHIND),
    "dark lamp": _add(type="sphere", center=BEHIND, bsdf={"type": "null"}, emitter=DARK),
    "dark point lamp": _add(type="point", position=BEHIND, intensity=1e-20),
    "instance": _instance,
    "other order": lambda scene: scene.update(ball=scene.pop("ball")),
    "mask of opacity 1": _wrap(lambda: {"type": "mask", "opacity": 1.0}),
    "blend of itself": _blend,
    "flat normal map": _wrap(lambda: {"type": "normalmap", "normalmap": flat([0.5, 0.5, 1.0])}),
    "flat bump map": _wrap(lambda: {"type": "bumpmap", "arbitrary": flat(0.5, 4)}),
    "texture as tint": _set("specular_reflectance", lambda: flat(1.0)),
    "texture as index": _set("int_ior", lambda: flat(1.5)),
    "absorption 1e-30": _set("int_absorption", lambda: 1e-30),
}
# Other ways to render the same scene: what is around the integrator, and its parameters.
WAYS: dict[str, tuple[Nodes | None, Nodes]] = {
    "moment": ({"type": "moment"}, {}),
    "aov": ({"type": "aov", "aovs": "d:depth"}, {}),
    "passes": (None, {"samples_per_pass": 4}),
}
WRAPPED = {"mask of opacity 1", "blend of itself", "flat normal map", "flat bump map"}
# Absorption is not within a wrapper, a table not beside a texture, a raw bitmap has no spectrum. A bump map around a
# normal map turns the tangent that the normals refer to, by `path` as well.
IMPOSSIBLE = {
    "absorbing": {*WRAPPED, "absorption 1e-30"},
    "normal map": {"texture as tint", "texture as index", "absorption 1e-30", "flat bump map"},
    "dispersive": {"texture as index"},
    "spectral": {"texture as tint"},
}


def cases(context: Context) -> Iterator[Case]:
    """One per variant and scene; the profile `quick` renders in the variant of the run only."""
    quick = context.profile.quick
    for variant in variants(context)[: 1 if quick else 3]:
        names = ["glass", "matt", "absorbing", "normal map", *(["dispersive"] if "spectral" in variant else [])]
        for name in names:
            for depth in (2,) if quick and name not in ("glass", "matt") else (0, 2):
                work = functools.partial(rows, variant, name, depth)
                yield Case(f"{variant} {name}, split {depth}", variant, work)


def rows(variant: str, name: str, depth: int) -> list[Row]:
    """One row a change of one scene."""

    def images(scene: Any, around: Nodes | None, first: int, **parameters: Any) -> Any:
        """Independent renders, one a seed."""
        inner = {"type": OURS, "max_depth": 8, "rr_depth": 100, "split_depth": depth} | parameters
        method = mi.load_dict(around | {"inner": inner} if around else inner)
        renders = [mi.render(scene, integrator=method, spp=spp, seed=first + i) for i in range(RENDERS)]
        return np.array([np.array(image)[..., :3] for image in renders], dtype=float)

    spectral, seed, spp, table = "spectral" in variant, current(SEED), SPP.get(name, 16), []
    left_out = IMPOSSIBLE.get(name, set()) | (IMPOSSIBLE["spectral"] if spectral else set())
    unchanged = mi.load_dict(scenes(spectral)[name], parallel=False, optimize=False)
    expected = images(unchanged, None, seed)
    for change in (change for change in (*CHANGES, *WAYS) if change not in left_out):
        scene, (around, parameters) = unchanged, WAYS.get(change, (None, {}))
        if change in CHANGES:
            CHANGES[change](other := scenes(spectral)[name])
            scene = mi.load_dict(other, parallel=False, optimize=False)
        values = compared(expected, functools.partial(images, scene, around, **parameters), seed)
        budgets = {"alarms": 0.0, "detectable": limits.INVISIBLE}
        budgets |= {"noise": limits.INVISIBLE_NOISE} if change in WAYS and not values["same bits"] else {}
        case, replay = f"{name}, split {depth}: {change}", {"seed": seed, "spp": spp}
        table.append(Row(NAME, OURS, case, variant, values, budgets, replay=replay))
        del scene
        gc.collect()
    return table


def compared(expected: Any, render: Callable[[int], Any], seed: int) -> dict[str, float]:
    """The values of a row: of the same seeds, or of other ones where the bits differ."""
    same = render(seed)
    bits = bool((same == expected).all())
    other = same if bits else render(seed + 1000)
    alarms, means = float(not np.isfinite(other).all()), [x.mean(axis=(1, 2)) for x in (expected, other)]
    for tile in (SIZE, TILE) if not bits else ():
        alarms += tile_statistics.compare_stacks(expected, other, tile, limits.INVISIBLE_ALARM, 1e-5).alarms
    error = np.sqrt(sum(x.var(axis=0, ddof=1) / RENDERS for x in means))
    detectable = 0.0 if bits else float((4.5 * error / expected.mean()).max())
    noise = [np.var(x, axis=0, ddof=1).mean() for x in (expected, other)]
    ratio = float(noise[1] / noise[0]) if noise[0] else 1.0
    return {"alarms": alarms, "same bits": float(bits), "detectable": detectable, "noise": ratio}


STUDY = study(NAME, "Changes that must not be seen", __doc__, TERMS, cases)
