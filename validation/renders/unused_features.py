"""What a scene does not use: the cost of each feature in a kernel, of many glasses, and of an edit of the index.

A feature that is not used must not be in the kernel: the plugin's `sample` is traced alone, with and without it, and
Dr.Jit's operations are counted. Renders show glass balls side by side under a sky with spots, each with its own index.
For a first image the scene gets a `max_depth` that was never used before; it is a literal in the kernel, so no cache
holds that kernel. Dr.Jit compiles the code of every plugin that is alive, so each scene is measured alone.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.formulas import FORMULAS
from mi_refract.plugins import PLUGIN
from mi_refract.plugins.refract import LOBES, followed_context
from mi_refract.report.row import Row
from validation import limits
from validation.run import kernel_timing
from validation.run.context import SCENES, Context
from validation.run.glass_balls import RESOLUTION, Balls, alone, compiled, seconds_of, size_of
from validation.run.kernel_timing import kernels
from validation.run.render_methods import opened, under
from validation.study import Study, Task, about

from .cases import flat

TERMS = {
    "operations": "Dr.Jit's count for the whole kernel; of `sample` alone, or of a render",
    "added": "operations in addition to those of the plain plugin, in radiance mode, with both lobes",
    "compiled": "kernels compiled (in no cache) in all images after the first",
    "first image": "seconds from a loaded scene to its image, kernels compiled; over the built-in's, median of "
    "alternating pairs; low, high: its 95 % interval, or the extremes of a few pairs",
    "edit": "the same for one index edited, to the next image",
    "boundaries": "surfaces that a path from the camera meets on average, without roulette",
    "call": "seconds of one call of `sample`, over the built-in's",
    "frozen": "time of an image under `dr.freeze`, over that of the same image traced again; warm",
    "off after an edit": "largest difference of the two after an edit of an index: 0 unless the frozen one is stale",
}
NAME = "features"
BUILTIN = "dielectric"
RAYS = 1024
SEED = 2026
GLASSES = (1, 16, 64, 1000)
PAIRS = 5
CALLS = 2000
STEPS = 4  # of an optimisation
SPECTRAL, DISPERSIVE = "llvm_ad_spectral", "cauchy(1.5, 4000)"
SCALAR = "scalar variants have no kernels"


_row = functools.partial(Row, NAME, PLUGIN)


def tasks(context: Context) -> list[Task]:
    """One per feature; in the profile `quick` those without scenes of many glasses."""
    calls = Task("features: scalar calls", scalar_rows, timed=True)
    if context.variant.startswith("scalar"):
        return [Task("features", lambda: [_row("kernels", context.variant, reason=SCALAR)]), calls]
    operations_only = Task("features: operations", lambda: operation_rows(context) + wavelength_rows(context))
    if context.profile.quick:
        return [operations_only, calls]
    work = functools.partial
    first = {f"first image, {count} glasses": work(first_image_rows, context, count) for count in limits.FIRST_IMAGE}
    timed = first | {"edit": work(edit_rows, context), "frozen": work(frozen_rows, context)}
    return [
        operations_only,
        Task("features: glasses", work(glass_rows, context)),
        Task("features: optimisation", work(optimisation_rows, context)),
        *(Task(f"features: {name}", rows, timed=True) for name, rows in timed.items()),
        Task("features: boundaries", work(boundary_rows, context)),
        calls,
    ]


# `sample` alone ------------------------------------------------------------------------------------------------


def operations(
    plugin: str,
    parameters: dict[str, Any] | None = None,
    component: int | None = None,
    importance: bool = False,
    differentiate: bool = False,
    followed: bool = False,
) -> float:
    """Of a kernel that computes all of what `sample` returns, of directions and samples in memory.

    `followed`: asked by `refract_path`, which follows wavelengths and media.
    """
    import mitsuba as mi

    bsdf = mi.load_dict({"type": plugin, "int_ior": 1.5, "ext_ior": 1.0} | (parameters or {}))
    if differentiate:
        params = mi.traverse(bsdf)
        dr.enable_grad(params["eta"])
        params.update()
    asked = followed_context() if followed else mi.BSDFContext()
    asked.mode = mi.TransportMode.Importance if importance else mi.TransportMode.Radiance
    if component is not None:
        asked.component = component
    si: Any = dr.zeros(mi.SurfaceInteraction3f)
    x, y = (dr.linspace(mi.Float, low, 0.6, RAYS) for low in (-0.6, -0.1))
    si.wi, si.uv = dr.normalize(mi.Vector3f(x, y, 0.5 * x + y)), mi.Point2f(dr.abs(x), dr.abs(y))
    sample = dr.linspace(mi.Float, 0, 1, RAYS)
    if mi.is_spectral:
        si.wavelengths = type(si.wavelengths)(
            *(dr.linspace(mi.Float, low, low + 90, RAYS) for low in range(400, 760, 90))
        )
    dr.eval(si.wi, si.uv, si.wavelengths, sample)
    return float(max(entry["operation_count"] for entry in kernels(lambda: bsdf.sample(asked, si, sample, [0, 0]))))


def wavelength_rows(context: Context) -> list[Row]:
    """What glass pays for dispersion and absorption that it has not, and dispersive glass where nobody follows it."""
    if reason := context.variants.get(SPECTRAL, "not in this wheel"):
        return [_row("dispersion", SPECTRAL, reason=reason)]
    with under(SPECTRAL):
        plain = operations(PLUGIN)
        counts = {
            "no dispersion": operations(PLUGIN, followed=True),
            "dispersion, by `path`": operations(PLUGIN, {"int_ior": DISPERSIVE}),
            "dispersion": operations(PLUGIN, {"int_ior": DISPERSIVE}, followed=True),
            "absorption": operations(PLUGIN, {"int_absorption": 0.5}, followed=True),
        }
    replay = {"rays": RAYS, "int_ior": DISPERSIVE}
    rows = []
    for case, count in counts.items():
        budgets = {} if case == "dispersion" else {"added": 0.0}
        rows.append(_row(case, SPECTRAL, {"operations": count, "added": count - plain}, budgets, replay=replay))
    return rows


def scalar_rows() -> list[Row]:
    """Time of a call of `sample` in a scalar variant: a plugin in Python, against the built-in's C++."""
    import mitsuba as mi

    with under("scalar_rgb"):
        si: Any = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = mi.Vector3f(0.6, 0, 0.8)
        asked = mi.BSDFContext()
        bsdfs = {name: mi.load_dict({"type": name, "int_ior": 1.5, "ext_ior": 1.0}) for name in (PLUGIN, BUILTIN)}

        def clock(name: str) -> float:
            bsdf, start = bsdfs[name], time.process_time()
            for _ in range(CALLS):
                bsdf.sample(asked, si, 0.5, [0, 0])
            return time.process_time() - start

        seconds = kernel_timing.rounds({name: name for name in bsdfs}, clock, PAIRS)
    values = kernel_timing.ratio(f"call / {BUILTIN}", seconds[PLUGIN], seconds[BUILTIN])
    return [_row("a call of sample", "scalar_rgb", values, replay={"calls": CALLS})]


def operation_rows(context: Context) -> list[Row]:
    """One row a feature, with the built-in's own where it has it."""
    plain = {plugin: operations(plugin) for plugin in (PLUGIN, BUILTIN)}

    def row(case: str, shared: bool = True, less: bool = False, variant: str = context.variant, **asked: Any) -> Row:
        """`less`: with fewer features, the plugin must drop at least as many operations as the built-in."""
        values: dict[str, float] = {}
        for plugin, name in ((PLUGIN, ""), (BUILTIN, f", {BUILTIN}"))[: 2 if shared else 1]:
            with under(variant):
                count = operations(plugin, **asked)
            values |= {f"operations{name}": count, f"added{name}": count - plain[plugin]}
        budgets = {"added": values[f"added, {BUILTIN}"]} if less else {}
        goals = {"operations": plain[BUILTIN]} if case == "plain" else {}
        replay = {"rays": RAYS} | {key: str(value) for key, value in asked.items()}
        return _row(case, variant, values, budgets, goals, replay=replay)

    rows = [
        row("plain"),
        row("reflection only", less=True, component=0),
        row("transmission only", less=True, component=1),
        row("importance mode", less=True, importance=True),
    ]
    rows += [row(f"{lobe}, a number", parameters={lobe: 0.5}) for lobe in LOBES]
    rows += [row(f"{lobe}, a bitmap", parameters={lobe: flat(0.5, 2)}) for lobe in LOBES]
    rows.append(row("derivative in eta", shared=False, differentiate=True))
    polarised = context.variant.replace("rgb", "mono_polarized")
    if reason := context.variants[polarised]:
        rows.append(_row("polarised", polarised, reason=reason))
    else:
        rows.append(row("polarised", variant=polarised))
    rows += [row(f"formula {name}", shared=False, parameters={"formula": name}) for name in FORMULAS]
    return rows


# Renders -------------------------------------------------------------------------------------------------------


def glass_rows(context: Context) -> list[Row]:
    """The kernel of a render for growing numbers of glasses, and what an edit compiles; also of the built-in.

    Compared to two: a plugin that is the only one is called directly, which saves the six operations of a choice.
    """
    return [row for plugin in (PLUGIN, BUILTIN) for row in rows_of_glasses(context, plugin)]


def rows_of_glasses(context: Context, plugin: str) -> list[Row]:
    """The rows of one of them."""
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
    """Gradient steps on an index. The first compiles, with a derivative for the first time; then nothing does."""
    with alone(PLUGIN, 1, integrator="volpath", max_depth=3) as balls:
        before = float(balls.params[balls.eta][0])
        first, *later = (compiled(functools.partial(step, balls)) for _ in range(STEPS))
        values = {"compiled": sum(later), "compiled, first step": first}
        values |= {"eta moved": abs(float(balls.params[balls.eta][0]) - before)}
    return [_row("optimisation of eta", context.variant, values, {"compiled": 0.0}, replay={"steps": STEPS})]


def step(balls: Balls) -> Any:
    """One step of gradient descent on the mean of an image."""
    import mitsuba as mi

    params, key = balls.params, balls.eta
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.mean(mi.render(balls.scene, params, spp=4), axis=None))
    params[key] = dr.detach(params[key]) - 0.1 * dr.grad(params[key])
    params.update()
    return params[key]


def first_image_rows(context: Context, count: int) -> list[Row]:
    """Seconds to an image whose kernels no cache has, over the built-in's."""

    def clock(plugin: str) -> float:
        with alone(plugin, count) as balls:
            return seconds_of(balls.image)

    return [ratio_row(context, f"first image, {count} glasses", "first image", clock, limits.FIRST_IMAGE[count])]


def edit_rows(context: Context) -> list[Row]:
    """The built-in's literal is one that no cache has seen."""
    indices = np.random.default_rng()

    def clock(plugin: str) -> float:
        with alone(plugin, 16) as balls:
            dr.eval(balls.image())

            def edited() -> Any:
                balls.edit(float(indices.uniform(1.2, 1.9)))
                return balls.image()

            return seconds_of(edited)

    return [ratio_row(context, "edit of one of 16 glasses", "edit", clock, limits.EDIT)]


def ratio_row(context: Context, case: str, metric: str, clock: Callable[[str], float], goal: float) -> Row:
    """A goal for the ratio of two times, measured in turn."""
    seconds = kernel_timing.rounds({PLUGIN: PLUGIN, BUILTIN: BUILTIN}, clock, PAIRS)
    values = kernel_timing.ratio(f"{metric} / {BUILTIN}", seconds[PLUGIN], seconds[BUILTIN])
    values |= {f"{metric}, {plugin}": float(np.median(x)) for plugin, x in seconds.items()}
    goals = {f"{metric} / {BUILTIN}": goal}
    return _row(case, context.variant, values, goals=goals, replay={"pairs": PAIRS})


def frozen_rows(context: Context) -> list[Row]:
    """The steady state of many glasses is tracing each anew; a frozen function replays what was traced."""
    import mitsuba as mi

    count = GLASSES[-1]
    values: dict[str, float] = {}
    for plugin, name in ((PLUGIN, ""), (BUILTIN, f", {BUILTIN}")):
        with alone(plugin, count) as balls:
            replay, seed = functools.partial(balls.frozen(), balls.params), dr.opaque(mi.UInt32, 0)
            subjects = {"frozen": functools.partial(replay, seed), "traced": balls.image}
            for _ in range(2):  # from two calls Dr.Jit knows what varies
                dr.eval(replay(seed))
            seconds = kernel_timing.rounds(subjects, seconds_of, PAIRS)
            values |= kernel_timing.ratio(f"frozen / traced{name}", seconds["frozen"], seconds["traced"])
            values |= {f"seconds, {x}{name}": float(np.median(seconds[x])) for x in seconds}
            balls.edit(1.77)
            values[f"off after an edit{name}"] = float(np.abs(np.array(replay(seed) - balls.image())).max())
            del replay, subjects
    case, budgets = f"frozen, {count} glasses", {"off after an edit": limits.FROZEN}
    return [_row(case, context.variant, values, budgets, replay={"glasses": count})]


def boundary_rows(context: Context) -> list[Row]:
    """Where the built-in's directions are wrong its paths may be shorter, and a render of them cheaper."""
    rows = []
    for name in ("furnace", "mirage"):
        values = {
            plugin: boundaries(opened(SCENES / f"{name}.xml", plugin, RESOLUTION)) for plugin in (PLUGIN, BUILTIN)
        }
        values[f"boundaries / {BUILTIN}"] = values[PLUGIN] / values[BUILTIN]
        rows.append(_row(f"{name}: boundaries", context.variant, values, replay={"seed": SEED}))
    return rows


def boundaries(scene: Any, spp: int = 64, most: int = 192) -> float:
    """How many surfaces a path from the camera meets, on average, without roulette."""
    import mitsuba as mi

    count = RESOLUTION**2 * spp
    sampler: Any = mi.load_dict({"type": "independent"})
    sampler.seed(SEED, count)
    pixel = dr.arange(mi.UInt32, count) // spp
    corner = mi.Point2f(pixel % RESOLUTION, pixel // RESOLUTION)
    ray, _ = scene.sensors()[0].sample_ray(0, 0, (corner + sampler.next_2d()) / RESOLUTION, mi.Point2f(0.5))

    def bounce(met: Any, active: Any, ray: Any, sampler: Any) -> Any:
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid() & (met < most)
        bs, _ = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(active), sampler.next_2d(active), active)
        return met + dr.select(active, 1, 0), active, si.spawn_ray(si.to_world(bs.wo)), sampler

    state = (mi.UInt32(0), mi.Bool(True), ray, sampler)
    met, *_ = dr.while_loop(state, lambda met, active, ray, sampler: active, bounce)
    return float(np.array(met).mean())


STUDY = Study(NAME, "What a scene does not use", about(__doc__), TERMS, tasks)
