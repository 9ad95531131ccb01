"""Unused features: what each feature costs in a kernel, and what many glasses and edits of an index cost.

A feature that is not used must not be in the kernel: the plugin's `sample` is traced alone, with and without the
feature, and Dr.Jit's operations are counted. Renders show glass balls side by side under a sky with spots, each with
its own index. Dr.Jit compiles the code of every plugin in memory, so each scene is measured alone. The times of a first
image and of an edit are in the study `scaling`.
"""

from __future__ import annotations

import functools
import time
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.formulas import FORMULAS
from mi_refract.plugins import PLUGIN
from mi_refract.plugins.refract import LOBES, followed_context
from mi_refract.report.row import Row
from validation import limits
from validation.run import kernel_timing
from validation.run.context import Context
from validation.run.glass_balls import Balls, alone, compiled, seconds_of, size_of
from validation.run.kernel_timing import kernels
from validation.run.render_methods import DIELECTRIC as BUILTIN
from validation.run.render_methods import under
from validation.study import Study, Task, about

from .cases import flat

TERMS = {
    "operations": "Dr.Jit's count for the whole kernel of `sample` alone, or of a render",
    "added": "operations in addition to those of the plain plugin, in radiance mode, with both lobes",
    "compiled": "kernels compiled (not from a cache) for all images after the first",
    "call": "seconds of one call of `sample`, over the built-in's",
    "frozen": "time of an image under `dr.freeze`, over that of the same image traced again; warm",
    "off after an edit": "largest difference of the two after an edit of an index; large if the frozen image is stale",
}
NAME = "features"
RAYS = 1024
GLASSES = (1, 16, 64, 1000)
PAIRS = 6
CALLS = 2000
STEPS = 4  # of an optimisation
SPECTRAL, DISPERSIVE = "llvm_ad_spectral", "cauchy(1.5, 4000)"
SCALAR = "scalar variants have no kernels"
RECORDED = "recorded: the cost of a feature that is used"
BOTH = ((PLUGIN, ""), (BUILTIN, f", {BUILTIN}"))  # plugins, and the suffix of the names of their values

_row = functools.partial(Row, NAME, PLUGIN)


def tasks(context: Context) -> list[Task]:
    """Return one task per kind of measurement; in the profile `quick`, those without scenes of many glasses."""
    calls = Task("features: scalar calls", scalar_rows, timed=True)
    if context.variant.startswith("scalar"):
        return [Task("features", lambda: [_row("kernels", context.variant, reason=SCALAR)]), calls]
    every = {"operations": functools.partial(operation_rows, context)}
    if not context.profile.quick:
        kinds = {"glasses": glass_rows, "optimisation": optimisation_rows, "frozen": frozen_rows}
        every |= {name: functools.partial(rows, context) for name, rows in kinds.items()}
    return [*(Task(f"features: {name}", rows, timed=name == "frozen") for name, rows in every.items()), calls]


# `sample` alone ------------------------------------------------------------------------------------------------


def operations(
    plugin: str, parameters: dict[str, Any] | None = None, differentiate: bool = False, bsdf_context: Any = None
) -> float:
    """Return the operations of a kernel that computes all results of `sample` from directions and samples in memory.

    `bsdf_context`: by default both lobes, in radiance mode, by an integrator that does not follow wavelengths.
    """
    import mitsuba as mi

    bsdf = mi.load_dict({"type": plugin, "int_ior": 1.5, "ext_ior": 1.0} | (parameters or {}))
    if differentiate:
        params = mi.traverse(bsdf)
        dr.enable_grad(params["eta"])
        params.update()
    si: Any = dr.zeros(mi.SurfaceInteraction3f)
    x, y = (dr.linspace(mi.Float, low, 0.6, RAYS) for low in (-0.6, -0.1))
    si.wi, si.uv = dr.normalize(mi.Vector3f(x, y, 0.5 * x + y)), mi.Point2f(dr.abs(x), dr.abs(y))
    sample = dr.linspace(mi.Float, 0, 1, RAYS)
    if mi.is_spectral:
        waves = [dr.linspace(mi.Float, low, low + 90, RAYS) for low in range(400, 760, 90)]
        si.wavelengths = type(si.wavelengths)(*waves)
    dr.eval(si.wi, si.uv, si.wavelengths, sample)
    work = functools.partial(bsdf.sample, bsdf_context or mi.BSDFContext(), si, sample, [0, 0])
    return float(max(entry["operation_count"] for entry in kernels(work)))


def wavelength_rows(context: Context) -> list[Row]:
    """Return rows of dispersion and absorption: no cost for glass without them, or if the integrator ignores them."""
    if reason := context.variants.get(SPECTRAL, "not in this wheel"):
        return [_row("dispersion", SPECTRAL, reason=reason)]
    dispersive, follow = {"int_ior": DISPERSIVE}, followed_context()
    with under(SPECTRAL):
        plain = operations(PLUGIN)
        counts = {
            "no dispersion": operations(PLUGIN, bsdf_context=follow),
            "dispersion, by `path`": operations(PLUGIN, dispersive),
            "dispersion": operations(PLUGIN, dispersive, bsdf_context=follow),
            "absorption": operations(PLUGIN, {"int_absorption": 0.5}, bsdf_context=follow),
        }
    return [
        _row(
            case,
            SPECTRAL,
            {"operations": count, "added": count - plain},
            {} if case == "dispersion" else {"added": 0.0},
            reason=RECORDED if case == "dispersion" else "",
            replay={"rays": RAYS} | dispersive,
        )
        for case, count in counts.items()
    ]


def scalar_rows() -> list[Row]:
    """Return one row: the time of a call of `sample` in a scalar variant, in Python, over the built-in's in C++."""
    import mitsuba as mi

    with under("scalar_rgb"):
        si: Any = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = mi.Vector3f(0.6, 0, 0.8)
        bsdf_context = mi.BSDFContext()
        bsdfs = {name: mi.load_dict({"type": name, "int_ior": 1.5, "ext_ior": 1.0}) for name in (PLUGIN, BUILTIN)}

        def clock(name: str) -> float:
            bsdf, start = bsdfs[name], time.process_time()
            for _ in range(CALLS):
                bsdf.sample(bsdf_context, si, 0.5, [0, 0])
            return time.process_time() - start

        seconds = kernel_timing.rounds({name: name for name in bsdfs}, clock, PAIRS)
    values = kernel_timing.ratio(f"call / {BUILTIN}", seconds[PLUGIN], seconds[BUILTIN])
    return [_row("a call of sample", "scalar_rgb", values, replay={"calls": CALLS})]


def operation_rows(context: Context) -> list[Row]:
    """Return one row per feature, with the built-in's operations if it has the feature; then `wavelength_rows`."""
    import mitsuba as mi

    plain = {plugin: operations(plugin) for plugin in (PLUGIN, BUILTIN)}

    def row(
        case: str, less: Any = None, ours_only: bool = False, variant: str = context.variant, **options: Any
    ) -> Row:
        """`less`: a context with fewer lobes; the plugin must save at least as many operations as the built-in."""
        values: dict[str, float] = {}
        for plugin, name in BOTH[: 1 if ours_only else 2]:
            with under(variant):
                count = operations(plugin, bsdf_context=less, **options)
            values |= {f"operations{name}": count, f"added{name}": count - plain[plugin]}
        budgets = {"added": values[f"added, {BUILTIN}"]} if less else {}
        goals = {"operations": plain[BUILTIN]} if case == "plain" else {}
        replay = {"rays": RAYS} | {key: str(value) for key, value in options.items()}
        remark = "" if budgets or goals else RECORDED
        return _row(case, variant, values, budgets, goals, remark, replay)

    contexts = {name: mi.BSDFContext() for name in ("reflection only", "transmission only", "importance mode")}
    contexts["reflection only"].component, contexts["transmission only"].component = 0, 1
    contexts["importance mode"].mode = mi.TransportMode.Importance
    rows = [row("plain"), *(row(name, less) for name, less in contexts.items())]
    tints = {"a number": 0.5, "a bitmap": flat(0.5, 2)}
    rows += [row(f"{lobe}, {what}", parameters={lobe: tint}) for what, tint in tints.items() for lobe in LOBES]
    rows.append(row("derivative in eta", ours_only=True, differentiate=True))
    polarised = context.variant.replace("rgb", "mono_polarized")
    reason = context.variants[polarised]
    rows.append(_row("polarised", polarised, reason=reason) if reason else row("polarised", variant=polarised))
    rows += [row(f"formula {name}", ours_only=True, parameters={"formula": name}) for name in FORMULAS]
    return rows + wavelength_rows(context)


# Renders -------------------------------------------------------------------------------------------------------


def glass_rows(context: Context) -> list[Row]:
    """Return rows of the kernel of a render for growing numbers of glasses, and of what an edit compiles.

    Of both plugins. Counts are relative to two glasses: a single plugin is called directly, which saves the six
    operations of a choice.
    """
    return [row for plugin in (PLUGIN, BUILTIN) for row in rows_of_glasses(context, plugin)]


def rows_of_glasses(context: Context, plugin: str) -> list[Row]:
    """Return the rows of one plugin."""
    rows = []
    with alone(plugin, 2) as balls:
        two = size_of(balls)
    for count in GLASSES:
        with alone(plugin, count) as balls:
            size = size_of(balls)
            balls.edit(1.77)
            values = {"operations": size, "operations, over two glasses": size - two, "compiled": compiled(balls.image)}
        budgets = {"operations, over two glasses": 0.0, "compiled": 0.0} if plugin == PLUGIN else {}
        rows.append(Row(NAME, plugin, f"{count} glasses", context.variant, values, budgets, replay={"glasses": count}))
    return rows


def optimisation_rows(context: Context) -> list[Row]:
    """Return one row of gradient steps on an index: the first compiles its derivative, later ones must not compile."""
    with alone(PLUGIN, 1, integrator="volpath", max_depth=3) as balls:
        before = float(balls.params[balls.eta][0])
        first, *later = (compiled(functools.partial(step, balls)) for _ in range(STEPS))
        values = {"compiled": sum(later), "compiled, first step": first}
        moved = abs(float(balls.params[balls.eta][0]) - before)
        values |= {"eta moved": moved, "eta did not move": float(not moved > 0)}
    budgets = {"compiled": 0.0, "eta did not move": 0.0}
    return [_row("optimisation of eta", context.variant, values, budgets, replay={"steps": STEPS})]


def step(balls: Balls) -> Any:
    """Take one step of gradient descent on the mean of an image."""
    import mitsuba as mi

    params, key = balls.params, balls.eta
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.mean(mi.render(balls.scene, params, spp=4), axis=None))
    params[key] = dr.detach(params[key]) - 0.1 * dr.grad(params[key])
    params.update()
    return params[key]


def frozen_rows(context: Context) -> list[Row]:
    """Return one row: the time of a frozen function, which replays what was traced, over tracing many glasses again."""
    import mitsuba as mi

    count = GLASSES[-1]
    values: dict[str, float] = {}
    for plugin, name in BOTH:
        with alone(plugin, count) as balls:
            replay, seed = functools.partial(balls.frozen(), balls.params), dr.opaque(mi.UInt32, 0)
            subjects = {"frozen": functools.partial(replay, seed), "traced": balls.image}
            for _ in range(2):  # Dr.Jit needs two calls to learn what varies
                dr.eval(replay(seed))
            seconds = kernel_timing.rounds(subjects, seconds_of, PAIRS)
            values |= kernel_timing.ratio(f"frozen / traced{name}", seconds["frozen"], seconds["traced"])
            values |= {f"seconds, {x}{name}": float(np.median(seconds[x])) for x in seconds}
            balls.edit(1.77)
            values[f"off after an edit{name}"] = float(np.abs(np.array(replay(seed) - balls.image())).max())
            del replay, subjects
    case, budgets = f"frozen, {count} glasses", {"off after an edit": limits.FROZEN}
    return [_row(case, context.variant, values, budgets, replay={"glasses": count})]


STUDY = Study(NAME, "Unused features", about(__doc__), TERMS, tasks, records=(BUILTIN,))
