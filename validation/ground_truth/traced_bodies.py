"""Ground truth: rays and a render in Mitsuba, against closed forms and CODE V's printed results.

Rays are intersected with Mitsuba's shapes and refracted by the plugin's own samples, boundary by boundary, through
bodies whose answers are known. Their errors are divided by a worst-case bound on the rounding errors of float32
(`validation/ground_truth/bench.py`). The double Gauss comes from `validation/reference/double_gauss_codev.json`: CODE
V's listing in ray-optics (BSD-3-Clause). The rainbow is measured on an image (`validation/ground_truth/rainbow.py`);
its error is divided by a bound that chance exceeds once in ten thousand runs. The built-in `dielectric` is shown for
comparison, without budgets.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from mi_refract.plugins import PLUGIN
from mi_refract.report.row import Row
from validation import limits
from validation.reference.optical_systems import Array
from validation.run.context import Context
from validation.run.metrics import ERROR_OVER_BOUND
from validation.run.render_methods import save_image, under
from validation.study import Study, Task, about

from . import rainbow
from .bench import Bench, benches, glass

BUILTIN = "dielectric"
PLUGINS = PLUGIN, BUILTIN
TERMS = {
    "slab": "a block of BK7, 50 mm thick, with rays at 1 … 85°: it shifts them by 50 mm × sin(i − r)/cos r and keeps "
    "their directions",
    "prism, least deviation": "the prism of scenes/prism.xml, 2 asin(n sin(A/2)) − A, A = 60°, anywhere on its side",
    "prism, 32 … 85°": "the same at these incidences: i + asin(n sin(A − r)) − A",
    "aplanatic ball": "R = 50 mm: all rays aimed at the point n R behind its centre meet at R/n behind it",
    "ellipsoid lens": "an ellipsoid of eccentricity 1/n, half axis 50 mm, and a sphere around its far focus, where all "
    "rays along the axis meet, up to 80° of eccentric anomaly",
    "drop, one reflection": "index 1.333, R = 50 mm, rays at 2 … 80°, one inner reflection: deflected by π + 2i − 4r",
    "drop, two reflections": "the same with two reflections: 2π + 2i − 6r",
    "double Gauss": "CODE V's printed positions and tangents of nine rays at its eleven surfaces",
    "shift, place, miss / mm": "largest distance from the right position; for a miss, of the ray's line from the focus",
    "direction / °": "largest |d − exact|, as an angle",
    "tangent": "largest deviation of (dx/dz, dy/dz)",
    ERROR_OVER_BOUND: "largest of these errors over its own bound: the sum of the effects of every rounding on the "
    "way and, for the double Gauss, the rounding of its printed numbers; for the rainbow, the standard errors that "
    "Student's t exceeds once in ten thousand runs, plus the blur of pixels",
    "index seen": "the smallest relative error of all indices that moves a ray to its bound; if it is large, the bound "
    "tests nothing",
    "…, spawned": "the same with Mitsuba's ray offset along the normal, as in a render: equal for any plugin",
    "rainbow": "D₀ = π + 2i − 4r, cos i = √((n² − 1)/3), sin r = sin i / n: 137.92° for n = 1.333",
    "standard error / °": "standard error of the mean over renders with different seeds",
}
AXES = {"x": "surface", "y": "mm, or tangent", "x_scale": "linear", "y_scale": "log", "slope": None}
NAME = "ground_truth"
VARIANTS = "scalar_rgb", "llvm_ad_rgb", "cuda_ad_rgb"
RENDERS = {"standard": 10, "full": 40}
LABELS = {"direction": "direction / °", "tangent": "tangent"}
LABELS |= {name: f"{name} / mm" for name in ("shift", "place", "miss")}
UNITS = {"direction": math.degrees(1)}


def tasks(context: Context) -> list[Task]:
    """Return one task per variant, and one for the rainbow; `quick` has the run's variant only."""
    variants = (context.variant,) if context.profile.quick else VARIANTS
    rays = [Task(f"ground truth: {name}", functools.partial(variant_rows, context, name)) for name in variants]
    if context.profile.quick:
        return rays
    reason = "Mitsuba's wheel has no variant in double precision; for formulas in float64 see Stability"
    double = Row(NAME, PLUGIN, "every body", "double precision", reason=reason)
    bow = Task("ground truth: rainbow", functools.partial(bow_rows, context))
    return [*rays, Task("ground truth: double precision", lambda: [double]), bow]


# Rays ----------------------------------------------------------------------------------------------------------


def variant_rows(context: Context, variant: str) -> list[Row]:
    """Return a row per body and plugin in a variant of Mitsuba."""
    reason = context.variants.get(variant, f"this Mitsuba has no variant {variant}")
    if reason is not None:
        return [Row(NAME, PLUGIN, "every body", variant, reason=reason)]
    with under(variant):
        return [bench_row(name, bench, plugin, variant) for name, bench in benches().items() for plugin in PLUGINS]


def bench_row(name: str, bench: Bench, plugin: str, setting: str) -> Row:
    """Return the row of a plugin in a body: deviations of each answer, over their bounds."""
    off, spawned = (bench.deviations(bench.traced(plugin, spawned=spawned)) for spawned in (False, True))
    values = {LABELS[answer]: float(x.max()) * UNITS.get(answer, 1) for answer, x in off.items()}
    values[ERROR_OVER_BOUND] = max(float((x / bench.bounds[answer]).max()) for answer, x in off.items())
    values["index seen"] = bench.index_seen
    values |= {f"{LABELS[answer]}, spawned": float(x.max()) * UNITS.get(answer, 1) for answer, x in spawned.items()}
    budgets = {ERROR_OVER_BOUND: limits.BODY, "index seen": limits.INDEX_SEEN} if plugin == PLUGIN else {}
    replay = {"definition": name, "rays": len(bench.system.origins), "boundaries": len(bench.system.boundaries)}
    curves = {}
    if bench.system.printed:  # the worst ray's deviation and the least bound, surface by surface
        lines = {LABELS[answer]: x.max(0) for answer, x in off.items()}
        lines |= {f"{LABELS[answer]}, bound": x.min(0) for answer, x in bench.bounds.items()}
        curves = {name: [(j + 1.0, float(y)) for j, y in enumerate(line)] for name, line in lines.items()}
    return Row(NAME, plugin, name, setting, values, budgets, replay=replay, curves=curves)


# The rainbow ---------------------------------------------------------------------------------------------------


def bow_rows(context: Context) -> list[Row]:
    """Return the rows of the rainbow of either plugin."""
    if context.variant.startswith("scalar"):
        reason = "takes millions of light paths: needs a compiled variant"
        return [Row(NAME, PLUGIN, "rainbow", context.variant, reason=reason)]
    seeds = RENDERS[context.profile.name]
    about, size = {"index": float(rainbow.INDEX), "seeds": seeds, "resolution": rainbow.SIZE}, rainbow.SIZE // 4
    images = {plugin: rainbow.images(glass(plugin, rainbow.INDEX), seeds) for plugin in PLUGINS}
    shown = {}  # the mean image in squares of 4 pixels, with a maximum of 1
    for plugin in PLUGINS:
        mean = np.mean(images[plugin], axis=0).reshape(size, 4, size, 4).mean((1, 3))
        grey = np.repeat(mean[..., None] / mean.max(), 3, axis=2)
        shown[plugin] = save_image(context.out, f"rainbow {plugin}", grey, about)
    roles = {PLUGIN: {"reference": shown[BUILTIN], "test": shown[PLUGIN]}, BUILTIN: {}}
    return [bow_row(plugin, context.variant, images[plugin], about, roles[plugin]) for plugin in PLUGINS]


def bow_row(
    plugin: str, setting: str, images: list[Array], replay: dict[str, Any], shown: dict[str, str] | None = None
) -> Row:
    """Return the row of the mean of the edges, with a bound by Student's t plus the blur of pixels."""
    from scipy import stats

    edges = np.array([rainbow.edge(image) for image in images])
    error, chance = edges.mean() - rainbow.angle(), edges.std(ddof=1) / math.sqrt(len(edges))
    bound = stats.t.isf(limits.FALSE_ALARM / 2, len(edges) - 1) * chance + limits.RAINBOW_BLUR
    values = {
        "rainbow / °": float(edges.mean()),
        "exact / °": rainbow.angle(),
        "error / °": float(abs(error)),
        "standard error / °": float(chance),
        ERROR_OVER_BOUND: float(abs(error) / bound),
    }
    budgets = {ERROR_OVER_BOUND: limits.BODY, "standard error / °": limits.RAINBOW_RESOLVED} if plugin == PLUGIN else {}
    return Row(NAME, plugin, "rainbow", setting, values, budgets, replay=replay, images=shown or {})


STUDY = Study(NAME, "Ground truth", about(__doc__), TERMS, tasks, axes=AXES, records=(BUILTIN,))
