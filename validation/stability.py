"""Stability: formulas at work, boundary after boundary, against closed answers.

A formula is fed with inputs rounded to its precision, and its output is carried on; all geometry in between is in
extended precision. Each error stands next to itself over condition · u, which is what the answer may be off by if
every input a formula is given and every direction it returns were off by u, the roundoff, to first order: up to 1 the
problem is to blame (rounding the exact answers does no better), above 1 the formula. In a mirage the ratios of
neighbouring layers are given as such (ratios), or as quotients of rounded indices (indices, as Mitsuba's scenes give
them), or with k² − 1 from double precision (contrasts). Mitsuba has no variant in float64.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.formulas import FORMULAS, ROUNDING
from mi_refract import regimes
from mi_refract.rows import Row

from . import directions, systems
from .chains import Array, Layers, Rays, Subject, air, carry, cosine, enter, exact_ratios, frame, pipe
from .directions import BUILTIN, Setting
from .plan import Context, Task

TITLE = "Stability"
TEXT = __doc__.partition("\n")[2].strip()
AXES = {
    "x": "layers passed",
    "y": "relative error of the cosine",
    "x_scale": "log",
    "y_scale": "log",
    "slope": None,
}
SEEN_AT = 89.4  # degrees: the ray of the curves
PASSING, TURNING = (88.0, 89.0, 89.4, 89.55), (89.6, 89.8, 89.95)
# A normal, and the direction along the layers.
UPRIGHT, ASKEW = np.array([[0, 0, 1], [1, 0, 0]]), np.array([[0.36, 0.48, 0.8], [0.8, -0.6, 0]])
STOPS = np.unique(np.geomspace(1, 1000, 25).astype(int))
CORE = 1.5  # the index of the light pipe
PIPE_RAYS = 8
PROBLEM = "the problem"

TERMS = {
    "error / condition": "the worst error over condition · u of its ray",
    "error": "the worst error; of a mirage, relative, of the cosine where the ray ends; of directions, in radians",
    **{f"{angle}°": f"the same of the ray that enters at {angle}°" for angle in PASSING},
    "misjudged": "rays that turned where they should have passed or the reverse; reflections that were none",
    "turning height": "how far the layer in which a ray turned is from the right one, over all layers",
    "length drift": "how far the length of the direction is from what it was, relative",
    "over print": "the largest deviation from CODE V's print, over what printing rounds to",
    "mirage": "1.0003 − 3e-5 from the top to the bottom, in layers; entered at 88 … 89.95°, the last three turn",
    "askew": "the same with a normal that is no axis",
    "exact ratios": "1000 layers of ratio 1 + 2⁻²³, which float32 holds; askew",
    "light pipe": f"total internal reflections in a square pipe of index {CORE}, askew; only signs may change",
} | {name: " ".join((trace.__doc__ or "").split()) for name, trace in systems.SYSTEMS.items()}  # fmt: skip


@dataclass(frozen=True)
class Plan:
    """How much a backend does: scalar arrays cost a Python call per operation."""

    layers: tuple[int, ...]
    reflections: int
    angles: tuple[float, ...]
    curves: bool
    remark: str = ""


def plan(context: Context, setting: Setting) -> Plan:
    if not setting.is_scalar:
        return Plan((1000, 100_000), 10_000, PASSING + TURNING, True)
    if context.profile.name == "full":
        return Plan((1000, 100_000), 10_000, (88.0, 89.55, 89.95), False, "three rays: scalar arrays are slow")
    remark = "two rays, no more than 1000 boundaries: scalar arrays are slow"
    return Plan((1000,), 1000, (89.4, 89.8), False, remark)


def settings(context: Context) -> list[Setting]:
    """Those of the directions, and scalar float32 for Mitsuba alone: Dr.Jit's own scalars compute in double."""
    return [Setting("scalar float32", np.float32, dr.scalar.Array3f), *directions.settings(context)]


def tasks(context: Context) -> list[Task]:
    return [
        Task(f"stability: {setting.label}, {name}", functools.partial(rows, context, setting))
        for setting in settings(context)
        for name, rows in (("chains", chain_rows), ("systems", system_rows))
        if setting.vector is not None or name == "chains"
    ]


@contextmanager
def subjects(context: Context, setting: Setting) -> Iterator[dict[str, Subject]]:
    """Every formula, and Mitsuba's functions in its own precision and a variant that has the setting's arrays."""
    import mitsuba as mi

    backend = setting.label.partition(" ")[0]
    own = setting.precision is np.float32 and (setting.is_scalar or context.variant.startswith(backend))
    if own and setting.is_scalar:
        mi.set_variant("scalar_rgb")
    try:
        formulas = {} if own and setting.is_scalar else FORMULAS
        yield {**formulas, **({BUILTIN: directions.builtin} if own else {})}
    finally:
        mi.set_variant(context.variant)


# Chains --------------------------------------------------------------------------------------------------------


def chain_rows(context: Context, setting: Setting) -> list[Row]:
    if setting.vector is None:
        return [Row("stability", name, "all", setting.label, reason=setting.reason) for name in FORMULAS]
    how = plan(context, setting)
    rows = []
    with subjects(context, setting) as found:
        for case, layers, plane in mirages(how):
            rows += mirage_rows(found, case, layers, plane, setting, how)
        rows += [pipe_row(name, subject, setting, how) for name, subject in found.items()]
    return rows


def mirages(how: Plan) -> list[tuple[str, Layers, Array]]:
    """(case, layers, normal and direction along them)."""
    cases = [(f"mirage, {count} layers", air(count), UPRIGHT) for count in how.layers]
    cases += [("mirage askew, 1000 layers", air(1000), ASKEW), ("exact ratios, 250 layers", exact_ratios(250), ASKEW)]
    return cases


def mirage_rows(
    found: dict[str, Subject], case: str, layers: Layers, plane: Array, setting: Setting, how: Plan
) -> list[Row]:
    """A row per formula and per way to feed it, and one of the problem with the curves of all of them."""
    seen = STOPS[(layers.count >= STOPS) & how.curves & (plane is ASKEW)]
    degrees = np.array([*how.angles, *np.full(len(seen), SEEN_AT)])
    stop = np.array([*np.full(len(how.angles), layers.count), *seen])
    rays = enter(layers, degrees, stop, plane, setting.precision)
    rows = []
    for feed in feeds(layers, setting):
        curves = {}
        for name, subject in found.items():
            if feed == "contrasts" and not (name in FORMULAS and FORMULAS[name].takes_contrast):
                continue
            row, error = mirage_row(name, subject, f"{case}, {feed}", rays, feed, setting, how)
            rows.append(row)
            curves[name] = error[len(how.angles) :]
        if len(seen):
            rows.append(problem_row(f"{case}, {feed}", rays, feed, setting, curves))
    return rows


def feeds(layers: Layers, setting: Setting) -> list[str]:
    """Rounded indices make a difference in float32 only, where neighbours may be the same number."""
    told = [] if layers.exact or setting.precision is not np.float32 else ["indices"]
    return ["ratios", *told, "contrasts"]


def conditions(rays: Rays, feed: str) -> Array:
    """Of ln cos θ at the end: contrasts from double precision leave nothing to the ratios."""
    return rays.by_directions + (0 if feed == "contrasts" else rays.by_ratios)


def mirage_row(
    name: str, subject: Subject, case: str, rays: Rays, feed: str, setting: Setting, how: Plan
) -> tuple[Row, Array]:
    """The row, and the relative error of the cosine of every ray, 1 where it turned or passed wrongly."""
    count, u, final = rays.layers.count, setting.roundoff, slice(0, len(how.angles))
    carried = carry(subject, rays.layers.chain(rays.normal, feed, setting.precision), rays.a, rays.stop, setting)
    right = (carried.place >= rays.stop) == rays.passes
    error = np.where(right, np.abs(cosine(carried.b, rays.normal) / rays.end - 1), 1)
    error = np.nan_to_num(error.astype(float), nan=np.inf)
    turned = np.where(carried.place < 0, carried.passed // 2, rays.stop)
    height = np.where(rays.passes, 0, np.abs(turned - rays.last) / count)
    length = np.sqrt((carried.b**2).sum(1) / (rays.a.astype(np.longdouble) ** 2).sum(1))
    values = {
        "error / condition": worst(np.where(right, error / (conditions(rays, feed) * u), 0)[final]),
        "error": worst(error[final]),
        "misjudged": float((~right)[final].sum()),
        "turning height": worst(height[final]),
        "length drift": worst(np.abs(length - 1)[final]),
    } | {f"{angle}°": float(e) for angle, e in zip(how.angles, error, strict=False) if angle in PASSING}
    budgets = mirage_budgets(rays, feed, u, final) if name in FORMULAS and FORMULAS[name].takes_contrast else {}
    replay = {"top": 1.0003, "layers": count, "kappa": float(rays.layers.kappa[-1]), "angles": how.angles,
              "normal": [float(x).hex() for x in rays.normal]}  # fmt: skip
    return Row("stability", name, case, setting.label, values, budgets, reason=how.remark, replay=replay), error


def worst(x: Array) -> float:
    return float(np.nan_to_num(x.astype(float), nan=np.inf).max(initial=0))


# To first order cos²θ changes by 2x of itself where ln cos θ changes by x, and |1 − √(1 ± 2x)| ≤ 2x: so twice the
# condition bounds the error whatever its size. A form at the rounding limit is off by ROUNDING.linear u a step.
LIMIT = 2 * ROUNDING.linear


def mirage_budgets(rays: Rays, feed: str, u: float, final: slice) -> dict[str, float]:
    """Of a form at the rounding limit; rays whose bound reaches as far as the decision may be misjudged."""
    by_directions, by_ratios = rays.height
    height = LIMIT * u * (by_directions + (0 if feed == "contrasts" else by_ratios))
    open_ = np.where(
        rays.passes, LIMIT * u * conditions(rays, feed) >= 1, rays.last + height + 1 >= rays.layers.count
    )
    turning = np.where(rays.passes, 0, (height + 1) / rays.layers.count)
    return {
        "error / condition": LIMIT,
        "misjudged": float(open_[final].sum()),
        "turning height": min(1.0, worst(turning[final])),
    }


def problem_row(case: str, rays: Rays, feed: str, setting: Setting, curves: dict[str, Array]) -> Row:
    """What the problem itself makes of u, and the error of every formula against the number of layers."""
    seen = len(rays.stop) - len(next(iter(curves.values())))
    limit = (conditions(rays, feed) * setting.roundoff).astype(float)[seen:]
    lines = {name: list(zip(rays.stop[seen:].tolist(), error.tolist(), strict=True)) for name, error in curves.items()}
    lines["condition · u"] = list(zip(rays.stop[seen:].tolist(), limit.tolist(), strict=True))
    values = {"condition · u": float(limit[-1])}
    return Row("stability", PROBLEM, f"{case}, {SEEN_AT}°", setting.label, values, curves=lines)


def pipe_row(name: str, subject: Subject, setting: Setting, how: Plan) -> Row:
    rays = 2 if setting.is_scalar else PIPE_RAYS
    a, chain, exact = pipe(how.reflections, rays, CORE, setting.precision)
    carried = carry(subject, chain, a, np.full(rays, how.reflections), setting)
    lengths = [np.sqrt((x.astype(np.longdouble) ** 2).sum(1)) for x in (carried.b, a)]
    chord = np.sqrt((((carried.b - exact) ** 2).sum(1))) / lengths[1]
    # Every reflection passes on what is wrong with the direction, and adds its own: at most u each.
    condition = how.reflections
    values = {
        "error / condition": worst(chord / (condition * setting.roundoff)),
        "error": worst(chord),
        "misjudged": float(carried.passed.sum()),
        "length drift": worst(np.abs(lengths[0] / lengths[1] - 1)),
    }
    limits = {"error / condition": 1.0, "misjudged": 0.0}
    budgets = limits if name in FORMULAS and FORMULAS[name].takes_contrast else {}
    replay = {"reflections": how.reflections, "rays": rays, "axes": [float(x).hex() for x in frame(setting.precision)[0]]}
    case = f"light pipe, {how.reflections} reflections"
    return Row("stability", name, case, setting.label, values, budgets, reason=how.remark, replay=replay)


# Systems -------------------------------------------------------------------------------------------------------


class Refractor:
    """A formula as a system asks for it: inputs rounded to the setting's precision. Counts what it did not transmit."""

    def __init__(self, subject: Subject, setting: Setting) -> None:
        self.subject, self.setting, self.mirrored = subject, setting, 0

    def __call__(self, a: Array, n: Array, k: Any) -> Array:
        given = np.broadcast_arrays(a, n, np.reshape(k, (-1, 1)))
        a, n, k = (x.astype(self.setting.precision) for x in given)
        b, transmitted = directions.evaluate(self.subject, regimes.Rays(a, n, k[:, 0]), self.setting.vector)
        self.mirrored += int((~transmitted).sum())
        return b


def system_rows(context: Context, setting: Setting) -> list[Row]:
    with subjects(context, setting) as found:
        return [
            system_row(name, subject, case, setting) for case in systems.SYSTEMS for name, subject in found.items()
        ]


def system_row(name: str, subject: Subject, case: str, setting: Setting) -> Row:
    trace, refractor = systems.SYSTEMS[case], Refractor(subject, setting)
    error = np.sqrt((trace(refractor) ** 2).sum(1))
    values = {
        "error / condition": worst(error / (systems.condition(trace) * setting.roundoff)),
        "error": worst(error),
        "misjudged": float(refractor.mirrored),
    }
    # The condition counts u for every rounding, and they are at most ROUNDING.linear u.
    limit = name in FORMULAS and FORMULAS[name].takes_contrast
    budgets = {"error / condition": 1.0, "misjudged": 0.0} if limit else {}
    if case == "double Gauss":
        values["over print"] = systems.off_print(Refractor(subject, setting))
        # Any formula is off by less than 1e-12 here in float64, and the exact retrace is within the print.
        budgets |= {"over print": 1.0} if setting.precision is np.float64 else {}
    replay = {"definition": " ".join((trace.__doc__ or "").split()), "rays": len(error)}
    return Row("stability", name, case, setting.label, values, budgets, replay=replay)
