"""Which defects `mi-refract diff` sees in real renders, and how often it reports a difference between equal ones.

Defects of a renderer are planted in the glass, defects of an image in its pixels. In the scene `sphere` the ball holds
a lamp, off its centre. Without it the factors η² and 1/η² on the way in and out would cancel on every path, and no path
would be totally reflected. Renders with another sampler are equal for a method that models noise, and different for the
others. Each null pair (two equal renders) has seeds of its own, so the number of false alarms is binomial.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.image_diff import self_test
from mi_refract.image_diff.defects import DEFECTS
from mi_refract.plugins import read_ior, refract
from mi_refract.rendering.scene_files import REPRODUCIBLE
from mi_refract.report.row import Row
from validation.run.context import SCENES, Context
from validation.run.render_methods import Camera
from validation.study import Study, Task, about

GLASS = "refract_spoilt"  # the plugin's name is followed by that of the defect
NAMES = ("sphere", "prism")
LAMP = """
    <shape type="sphere">
        <point name="center" value="14, 37, 0"/>
        <float name="radius" value="6"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.6, 0.4"/></bsdf>
        <emitter type="area"><rgb name="radiance" value="1, 1.5, 2"/></emitter>
    </shape>
</scene>"""
RESOLUTION, SPP, TRIALS, RENDERS = 64, 16, 8, 6  # of the detection: renders a side
QUICK_TRIALS = 2
NULL_RESOLUTION, NULL_SPP, NULL_RENDERS = 32, 4, 4
NULL_PAIRS = {"standard": 640, "full": 2000}  # with 640 two alarms may be: their bound is 0.98 %
SHEET = 80  # images of a render: it costs less than as many renders
PARTS = ("sensor", "film", "sampler")
SCALAR = "needs a compiled variant: thousands of renders"
OTHER_SAMPLER = "other sampler"
ONE_ALARM = 1 / TRIALS  # of pairs that are equal: one alarm by chance is one time in a hundred, two one in ten thousand


# Defects of a renderer -----------------------------------------------------------------------------------------


def _with_index(change: Callable[[float], float]) -> Callable[[Any, type], Any]:
    def make(props: Any, plugin: type) -> Any:
        props["int_ior"] = change(read_ior(props, "int_ior", "bk7"))
        return plugin(props)

    return make


def _turned(props: Any, plugin: type) -> Any:
    """Seen from the wrong side of its surface: the media trade places."""
    inner, outer = read_ior(props, "int_ior", "bk7"), read_ior(props, "ext_ior", "air")
    props["int_ior"], props["ext_ior"] = outer, inner
    return plugin(props)


def _sampling(change: Callable[..., tuple[Any, Any]]) -> Callable[[Any, type], Any]:
    """`change(sample, ctx, si, sample1, sample2, active)`, `sample` being the plugin's own."""

    def make(props: Any, plugin: type) -> Any:
        class Spoilt(plugin):
            def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
                return change(super().sample, ctx, si, sample1, sample2, active)

        return Spoilt(props)

    return make


def _unscaled(sample: Any, ctx: Any, si: Any, *rest: Any) -> tuple[Any, Any]:
    bs, weight = sample(ctx, si, *rest)
    return bs, weight * dr.square(bs.eta)  # 1 where it is reflected


def _black_inside(sample: Any, ctx: Any, si: Any, *rest: Any) -> tuple[Any, Any]:
    bs, weight = sample(ctx, si, *rest)
    return bs, dr.select((bs.sampled_component == 0) & (bs.pdf >= 1), 0, weight)  # no other reflection is certain


def _swapped_lobes(sample: Any, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> tuple[Any, Any]:
    """Each lobe as often as the other should be, but where total reflection leaves one only."""
    reflected, r = sample(ctx, si, 0 * sample1, sample2, active)
    transmitted, t = sample(ctx, si, 0 * sample1 + (1 - 2.0**-24), sample2, active)
    choice = sample1 < reflected.pdf
    return dr.select(choice, transmitted, reflected), dr.select(choice, t, r)


GLASSES: dict[str, tuple[str, Callable[[Any, type], Any]]] = {
    "IOR + 0.5 %": ("the glass's index", _with_index(lambda ior: 1.005 * ior)),
    "IOR + 1e-3": ("the glass's index", _with_index(lambda ior: ior + 1e-3)),
    "flipped normal": ("the media trade places", _turned),
    "missing η²": ("radiance is not scaled at a boundary", _sampling(_unscaled)),
    "black TIR": ("total internal reflection gives nothing back", _sampling(_black_inside)),
    "swapped lobes": ("reflection as often as transmission should be", _sampling(_swapped_lobes)),
}
NAME = self_test.STUDY
TERMS = (
    self_test.TERMS
    | {name: text for name, (text, _) in GLASSES.items()}
    | {name: defect.text for name, defect in DEFECTS.items()}
    | {OTHER_SAMPLER: "multijitter: other random numbers, the same image"}
)


def register(variant: Any) -> None:
    """Register the glasses with a defect, for the variant of this module (`mitsuba.llvm_ad_rgb`, say)."""
    plugin = refract.plugin_class(variant)
    for name, (_, make) in GLASSES.items():
        variant.register_bsdf(f"{GLASS} {name}", lambda props, make=make: make(props, plugin))


# Renders -------------------------------------------------------------------------------------------------------


def opened(name: str, glass: str = refract.PLUGIN, resolution: int = RESOLUTION, count: int = 1, **more: Any) -> Camera:
    """A scene of `scenes/`, `count` times side by side; the ball with its lamp."""
    import mitsuba as mi

    text = (SCENES / f"{name}.xml").read_text().replace('value="meshes/', f'value="{SCENES}/meshes/')
    text = text.replace("</scene>", LAMP) if name == "sphere" else text
    text = _side_by_side(text, count, resolution)
    return Camera(mi.load_string(text, **REPRODUCIBLE, bsdf=glass, res=resolution, **more))


def _side_by_side(text: str, count: int, resolution: int) -> str:
    """The scene with `count` of its cameras on one film: pixels are independent, so these are as many renders."""
    sensor, film, sampler = (re.findall(rf"<{tag} .*?</{tag}>", text, re.DOTALL)[0] for tag in PARTS)
    wide = film.replace('name="width" value="$res"', f'name="width" value="{count * resolution}"')
    return text.replace(sensor, f'<sensor type="batch">{count * sensor}{wide}{sampler}</sensor>')


def _renders(camera: Camera, first: int, count: int = RENDERS, spp: int = SPP) -> np.ndarray:
    return np.stack([camera(spp, seed)[0] for seed in range(first, first + count)])


def _later(camera: Camera, first: int) -> Callable[[], np.ndarray]:
    return lambda: _renders(camera, first)


def trials(name: str, count: int, resolution: int = RESOLUTION, spp: int = SPP) -> list[self_test.Trial]:
    """Clean renders, nothing planted: no seed is used twice."""
    camera = opened(name, resolution=resolution)
    seeds = [2 * RENDERS * trial for trial in range(count)]
    return [
        self_test.Trial(
            _renders(camera, seed, spp=spp), _renders(camera, seed + RENDERS, spp=spp), _later(camera, seed)
        )
        for seed in seeds
    ]


# Judged --------------------------------------------------------------------------------------------------------


def tasks(context: Context) -> list[Task]:
    """Two tasks per scene; in the profile `quick` the defects of images in one."""
    if context.profile.quick:
        return [Task(f"diff: {NAMES[0]}, image defects", functools.partial(image_defect_rows, context, NAMES[0]))]
    return [
        Task(f"diff: {name}, {what}", functools.partial(run, context, name))
        for name in NAMES
        for what, run in (("defects", defect_rows), ("null pairs", null_rows))
    ]


def defect_rows(context: Context, name: str) -> list[Row]:
    """A row per defect of the glass and of finished images, and one of the noise of the clean renders."""
    if context.variant.startswith("scalar"):
        return [Row(NAME, "every defect", name, context.variant, reason=SCALAR)]
    import mitsuba as mi

    register(getattr(mi, context.variant))
    clean = trials(name, TRIALS)
    cameras = {defect: opened(name, f"{GLASS} {defect}") for defect in GLASSES}
    rows = [_row(defect, clean, name, context, camera) for defect, camera in cameras.items()]
    rows += _image_defects(clean, name, context)
    rows.append(_row(OTHER_SAMPLER, clean, name, context, opened(name, sampler="multijitter")))
    every = np.concatenate([t.clean for t in clean])
    about = {"resolution": RESOLUTION, "spp": SPP, "renders": len(every)}
    return [
        *rows,
        Row(NAME, "renders", name, context.variant, {"noise": self_test.noise(every)}, replay=about),
    ]


def image_defect_rows(context: Context, name: str) -> list[Row]:
    """The defects that are planted in finished images, in a few trials: no other glass is compiled."""
    size = (32, 4) if context.scalar else (RESOLUTION, SPP)
    return _image_defects(trials(name, QUICK_TRIALS, *size), name, context)


def _image_defects(clean: list[self_test.Trial], name: str, context: Context) -> list[Row]:
    rows = []
    for defect, planted in DEFECTS.items():
        spoilt = [self_test.Trial(t.clean, t.other, functools.partial(planted.spoil, t.clean)) for t in clean]
        rows.append(self_test.detection(defect, planted.always_due, spoilt, name, context.variant))
    return rows


def _row(defect: str, clean: list[self_test.Trial], name: str, context: Context, camera: Camera) -> Row:
    seeds = [2 * RENDERS * trial for trial in range(len(clean))]
    spoilt = [self_test.Trial(t.clean, t.other, _later(camera, seed)) for t, seed in zip(clean, seeds, strict=True)]
    row = self_test.detection(defect, False, spoilt, name, context.variant)
    if defect != OTHER_SAMPLER or not row.values:
        return row
    return Row(
        row.study,
        row.subject,
        row.case,
        row.setting,
        row.values,
        row.budgets | {"welch": ONE_ALARM},
        reason="no defect: `welch` must not see it",
        replay=row.replay,
    )


def null_rows(context: Context, name: str) -> list[Row]:
    """Pairs of independent renders, and about as many of the same seed by a scene loaded twice."""
    if context.variant.startswith("scalar"):
        return [Row(NAME, "null pairs", name, context.variant, reason=SCALAR)]
    count = NULL_PAIRS[context.profile.name]
    first, second = (opened(name, resolution=NULL_RESOLUTION, count=SHEET) for _ in range(2))
    sides = (_sheet(first, seed) for seed in range(count * 2 * NULL_RENDERS // SHEET))
    parts = (part for sheet in sides for part in np.split(sheet, SHEET // (2 * NULL_RENDERS)))
    pairs = ((part[:NULL_RENDERS], part[NULL_RENDERS:]) for part in parts)
    again = ((_sheet(first, seed), _sheet(second, seed)) for seed in range(count // SHEET))
    repeats = ((x[None], y[None]) for sheets in again for x, y in zip(*sheets, strict=True))
    return self_test.false_alarms(pairs, repeats, name, context.variant)


def _sheet(camera: Camera, seed: int) -> np.ndarray:
    """One render, cut into its independent images."""
    return np.stack(np.split(camera(NULL_SPP, seed)[0], SHEET, axis=1))


STUDY = Study(NAME, "Image comparison, planted defects", f"{about(__doc__)} {about(self_test.__doc__)}", TERMS, tasks)
