"""Which defects `mi-refract diff` detects in real renders, and how often it reports a difference between equal ones.

Defects of a renderer are planted in the glass, defects of an image in its pixels. In the scene `sphere` the ball
contains a lamp, off its centre. Without it the factors η² and 1/η² on the way in and out would cancel on every path,
and no path would be totally reflected. Renders with another sampler are equal for a method that models noise, and
different for the others. Each null pair (two equal renders) has its own seeds, so the number of false alarms is
binomial.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.image_diff import self_test
from mi_refract.plugins import PLUGIN, read_ior, refract
from mi_refract.rendering.scene_files import REPRODUCIBLE
from mi_refract.report.row import Row
from validation.run.context import SCENES, Context
from validation.run.render_methods import Camera
from validation.study import Study, Task, about

GLASS = "refract_spoilt"  # prefix of the plugin's name, before the name of the defect
NAMES = ("sphere", "prism")
LAMP = """
    <shape type="sphere">
        <point name="center" value="14, 37, 0"/>
        <float name="radius" value="6"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.6, 0.4"/></bsdf>
        <emitter type="area"><rgb name="radiance" value="1, 1.5, 2"/></emitter>
    </shape>
</scene>"""
RESOLUTION, SPP, TRIALS, RENDERS = 64, 16, 8, 6  # of the detection; RENDERS per side
QUICK_TRIALS = 2
NULL_RESOLUTION, NULL_SPP, NULL_RENDERS = 32, 4, 4
NULL_PAIRS = {"standard": 640, "full": 2000}  # 640 pairs may have two alarms: their bound is 0.98 %
SHEET = 80  # images in one render: faster than as many renders
PARTS = ("sensor", "film", "sampler")
SCALAR = "needs a compiled variant: thousands of renders"
OTHER_SAMPLER = "other sampler"
ONE_ALARM = 1 / TRIALS  # by chance equal pairs have one alarm in a hundred runs, two in ten thousand


# Defects of a renderer -----------------------------------------------------------------------------------------

Make = Callable[[Any, type], Any]  # (properties, plugin class) → glass with a defect


def _with_indices(change: Callable[[float, float], tuple[float, float]]) -> Make:
    """Return a defect that changes the indices inside and outside."""

    def make(props: Any, plugin: type) -> Any:
        indices = change(read_ior(props, "int_ior", "bk7"), read_ior(props, "ext_ior", "air"))
        props["int_ior"], props["ext_ior"] = indices
        return plugin(props)

    return make


def _sampling(change: Callable[..., tuple[Any, Any]]) -> Make:
    """Return a defect of sampling, `change(sample, ctx, si, sample1, sample2, active)` with the plugin's `sample`."""

    def make(props: Any, plugin: type) -> Any:
        class Spoilt(plugin):  # type: ignore[misc]
            def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
                return change(super().sample, ctx, si, sample1, sample2, active)

        return Spoilt(props)

    return make


def _unscaled(sample: Any, *args: Any) -> tuple[Any, Any]:
    bs, weight = sample(*args)
    return bs, weight * dr.square(bs.eta)  # 1 for reflection


def _black_inside(sample: Any, *args: Any) -> tuple[Any, Any]:
    bs, weight = sample(*args)
    return bs, dr.select((bs.sampled_component == 0) & (bs.pdf >= 1), 0, weight)  # only total reflection has density 1


def _swapped_lobes(sample: Any, ctx: Any, si: Any, sample1: Any, *args: Any) -> tuple[Any, Any]:
    """Sample each lobe with the probability of the other one, except for total reflection."""
    reflected, r = sample(ctx, si, 0 * sample1, *args)
    transmitted, t = sample(ctx, si, 0 * sample1 + (1 - 2.0**-24), *args)
    swap = sample1 < reflected.pdf
    return dr.select(swap, transmitted, reflected), dr.select(swap, t, r)


GLASSES: dict[str, tuple[str, Make]] = {
    "IOR + 0.5 %": ("a glass with another index", _with_indices(lambda inner, outer: (1.005 * inner, outer))),
    "IOR + 1e-3": ("a glass with another index", _with_indices(lambda inner, outer: (inner + 1e-3, outer))),
    "flipped normal": ("the two media are exchanged", _with_indices(lambda inner, outer: (outer, inner))),
    "missing η²": ("radiance is not scaled at a boundary", _sampling(_unscaled)),
    "black TIR": ("total internal reflection is black", _sampling(_black_inside)),
    "swapped lobes": ("reflection with the probability of transmission, and the reverse", _sampling(_swapped_lobes)),
}
NAME = self_test.STUDY
TERMS = (
    self_test.TERMS
    | {name: text for name, (text, _) in GLASSES.items()}
    | {name: defect.text for name, defect in self_test.DEFECTS.items()}
    | {OTHER_SAMPLER: "multijitter: other random numbers, the same expected image"}
)


def register(variant: Any) -> None:
    """Register the glasses with a defect for a variant's module, such as `mitsuba.llvm_ad_rgb`."""
    plugin = refract.plugin_class(variant)
    for name, (_, make) in GLASSES.items():
        variant.register_bsdf(f"{GLASS} {name}", lambda props, make=make: make(props, plugin))


# Renders -------------------------------------------------------------------------------------------------------


def opened(name: str, glass: str = PLUGIN, resolution: int = RESOLUTION, count: int = 1, **more: Any) -> Camera:
    """Load a scene of `scenes/`, with the lamp in the ball, and `count` cameras side by side on one film.

    Pixels are independent, so the images are independent renders.
    """
    import mitsuba as mi

    text = (SCENES / f"{name}.xml").read_text().replace('value="meshes/', f'value="{SCENES}/meshes/')
    text = text.replace("</scene>", LAMP) if name == "sphere" else text
    sensor, film, sampler = (re.findall(rf"<{tag} .*?</{tag}>", text, re.DOTALL)[0] for tag in PARTS)
    wide = film.replace('name="width" value="$res"', f'name="width" value="{count * resolution}"')
    text = text.replace(sensor, f'<sensor type="batch">{count * sensor}{wide}{sampler}</sensor>')
    return Camera(mi.load_string(text, **REPRODUCIBLE, bsdf=glass, res=resolution, **more))


def _renders(camera: Camera, first: int, spp: int = SPP) -> np.ndarray:
    return np.stack([camera(spp, seed)[0] for seed in range(first, first + RENDERS)])


def trials(name: str, count: int, resolution: int = RESOLUTION, spp: int = SPP) -> dict[int, self_test.Trial]:
    """Return trials of renders without a defect, by their first seed; no seed is used twice."""
    camera = opened(name, resolution=resolution)
    sides = {
        i: [_renders(camera, seed, spp) for seed in (i, i + RENDERS)]
        for i in range(0, 2 * RENDERS * count, 2 * RENDERS)
    }
    return {i: self_test.Trial(clean, other, functools.partial(np.copy, clean)) for i, (clean, other) in sides.items()}


# Judged --------------------------------------------------------------------------------------------------------


def tasks(context: Context) -> list[Task]:
    """Return two tasks per scene; `quick` has image defects in one scene only."""
    if context.profile.quick:
        return [Task(f"diff: {NAMES[0]}, image defects", functools.partial(image_defect_rows, context, NAMES[0]))]
    return [
        Task(f"diff: {name}, {what}", functools.partial(run, context, name))
        for name in NAMES
        for what, run in (("defects", defect_rows), ("null pairs", null_rows))
    ]


def defect_rows(context: Context, name: str) -> list[Row]:
    """Return a row per defect of the glass and of images, and a row of the noise of the clean renders."""
    if context.variant.startswith("scalar"):
        return [Row(NAME, "every defect", name, context.variant, reason=SCALAR)]
    import mitsuba as mi

    register(getattr(mi, context.variant))
    clean = trials(name, TRIALS)

    def row(defect: str, camera: Camera) -> Row:
        """Return the row of a defect, from renders with the seeds of the clean ones."""
        defective = [replace(x, spoil=functools.partial(_renders, camera, seed)) for seed, x in clean.items()]
        return self_test.detection(defect, False, defective, name, context.variant)

    rows = [row(defect, opened(name, f"{GLASS} {defect}")) for defect in GLASSES]
    rows += image_defect_rows(context, name, clean)
    other = row(OTHER_SAMPLER, opened(name, sampler="multijitter"))
    if other.values:
        budgets = other.budgets | {"welch": ONE_ALARM}
        other = replace(other, budgets=budgets, reason="no defect: `welch` must not report a difference")
    renders = np.concatenate([trial.clean for trial in clean.values()])
    replay = {"resolution": RESOLUTION, "spp": SPP, "renders": len(renders)}
    noise = Row(NAME, "renders", name, context.variant, {"noise": self_test.noise(renders)}, replay=replay)
    return [*rows, other, noise]


def image_defect_rows(context: Context, name: str, clean: dict[int, self_test.Trial] | None = None) -> list[Row]:
    """Return the rows of defects planted in finished images. Without `clean` renders, a few trials are rendered."""
    clean = clean or trials(name, QUICK_TRIALS, *((32, 4) if context.scalar else (RESOLUTION, SPP)))
    rows = []
    for defect, planted in self_test.DEFECTS.items():
        defective = [replace(trial, spoil=functools.partial(planted.spoil, trial.clean)) for trial in clean.values()]
        rows.append(self_test.detection(defect, planted.always_due, defective, name, context.variant))
    return rows


def null_rows(context: Context, name: str) -> list[Row]:
    """Return rows of pairs of independent renders, and of about as many pairs of equal seeds from two loaded scenes."""
    if context.variant.startswith("scalar"):
        return [Row(NAME, "null pairs", name, context.variant, reason=SCALAR)]
    count = NULL_PAIRS[context.profile.name]
    first, second = (opened(name, resolution=NULL_RESOLUTION, count=SHEET) for _ in range(2))

    def sheet(camera: Camera, seed: int) -> np.ndarray:
        """Return one render, cut into its independent images."""
        return np.stack(np.split(camera(NULL_SPP, seed)[0], SHEET, axis=1))

    sheets = (sheet(first, seed) for seed in range(count * 2 * NULL_RENDERS // SHEET))
    parts = (part for images in sheets for part in np.split(images, SHEET // (2 * NULL_RENDERS)))
    pairs = ((part[:NULL_RENDERS], part[NULL_RENDERS:]) for part in parts)
    again = ((sheet(first, seed), sheet(second, seed)) for seed in range(count // SHEET))
    repeats = ((x[None], y[None]) for both in again for x, y in zip(*both, strict=True))
    return self_test.false_alarms(pairs, repeats, name, context.variant)


TEXT = f"{about(__doc__)} {about(self_test.__doc__)}"
STUDY = Study(NAME, "Image comparison, planted defects", TEXT, TERMS, tasks, records=("renders",))
