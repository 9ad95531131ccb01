"""Stability: formulas applied at one boundary after another, against closed-form answers.

A formula gets inputs rounded to its precision, and its output is the input at the next boundary; the geometry between
them is in extended precision. Each error is also shown divided by condition · u, the first-order error of the answer if
every input and every direction erred by the roundoff u. Up to 1, rounding the exact values at each boundary could cause
the error. Above 1, the formula causes it. Mitsuba's functions exist in float32 only.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract import regimes
from mi_refract.accuracy import Subject, evaluate
from mi_refract.formulas import FORMULAS
from mi_refract.report.row import Row
from validation import limits
from validation.reference import optical_systems
from validation.run import array_settings as backends
from validation.run import seeds
from validation.run.array_settings import Setting
from validation.run.context import Context
from validation.run.metrics import MISCLASSIFIED, MISCLASSIFIED_FAR
from validation.study import Study, Task, about

from .energy import worst
from .layer_chains import FEEDS, SEED, Array, Fed, Layers, air, carry, cosine, enter, exact_ratios, frame, pipe

NAME = "stability"
AXES = {"x": "layers passed", "y": "relative error of the cosine", "x_scale": "log", "y_scale": "log"}
SEEN_AT = 89.4  # degrees: the ray of the curves
PASSING, TURNING = (88.0, 89.0, 89.4, 89.55), (89.6, 89.8, 89.95)
# A normal, and the direction along the layers.
PLANES = {"upright": np.array([[0, 0, 1], [1, 0, 0]]), "askew": np.array([[0.36, 0.48, 0.8], [0.8, -0.6, 0]])}
CORE = 1.5  # the index of the light pipe
PIPE_RAYS = 8
PROBLEM = "the problem"


def definition(make: Callable[[], optical_systems.System]) -> str:
    """Return the description of an optical system."""
    return " ".join((getattr(make, "func", make).__doc__ or "").split())


TERMS = {
    "error / condition": "the worst error, divided by condition · u of its ray",
    "error": "the worst error: in a mirage, the relative error of the final cosine; for directions, in radians",
    **{f"{angle}°": f"the same for the ray that enters at {angle}°" for angle in PASSING},
    MISCLASSIFIED: "rays that turned back but must pass, or the reverse, and missed total internal reflections",
    MISCLASSIFIED_FAR: "such rays whose error bound does not include the decision",
    "turning height": "distance between the layer in which a ray turned and the right one, over the number of layers",
    "length drift": "relative change of the length of the direction",
    "over print": "the largest deviation from CODE V's printed numbers, divided by their rounding",
    "mirage": "layers of air, of index 1.0003 at the top and 3e-5 less at the bottom; rays enter at 88 … 89.95°, and "
    "the last three turn. Upright: the normal is an axis; askew: it is not",
    "exact ratios": "250 layers of ratio 1 + 2⁻²³, which is exact in float32: the inputs have no error",
    **FEEDS,
    PROBLEM: f"condition · u of the ray that enters at {SEEN_AT}°, with the error of every formula layer by layer",
    "light pipe": f"total internal reflections in an askew square pipe of index {CORE}; only signs should change",
} | {name: definition(make) for name, make in optical_systems.SYSTEMS.items()}


@dataclass(frozen=True)
class Extent:
    """The amount of work for a backend: scalar arrays need a Python call per operation."""

    layers: tuple[int, ...]
    planes: tuple[str, ...]
    reflections: int
    angles: tuple[float, ...]
    curves: bool
    remark: str = ""


def extent(context: Context, setting: Setting) -> Extent:
    """Return the amount of work in a setting."""
    if not setting.is_scalar and context.profile.quick:
        return Extent((1000,), ("askew",), 1000, PASSING + TURNING, True)
    if not setting.is_scalar:
        return Extent((1000, 100_000), tuple(PLANES), 10_000, PASSING + TURNING, True)
    if context.profile.name == "full":
        return Extent((1000, 100_000), ("askew",), 10_000, (89.55, 89.95), False, "two rays: scalar arrays are slow")
    remark = "two rays, at most 1000 boundaries: scalar arrays are slow"
    return Extent((1000,), ("askew",), 1000, (89.4, 89.8), False, remark)


def settings(context: Context) -> list[Setting]:
    """Return the settings of the directions, and scalar float32 for Mitsuba only: Dr.Jit's scalars are doubles."""
    return [Setting("scalar", np.float32, dr.scalar.Array3f, mitsuba="scalar_rgb"), *backends.settings(context)]


def tasks(context: Context) -> list[Task]:
    """Return tasks for chains and systems in every setting; `quick` has chains in the first setting that runs."""
    chosen, parts = settings(context), {"chains": chain_rows, "systems": system_rows}
    if context.profile.quick:
        chosen = [s for s in chosen if s.vector is not None and not (s.is_scalar and s.precision is np.float32)][:1]
        parts = {"chains": chain_rows}
    return [
        Task(f"stability: {setting.label}, {name}", functools.partial(rows, context, setting))
        for setting in chosen
        for name, rows in parts.items()
        if setting.vector is not None or name == "chains"
    ]


def drawn_rows(context: Context) -> list[Row]:
    """Return the rows of light pipes: only their rays are random."""
    return [
        pipe_row(name, subject, setting, extent(context, setting))
        for setting in backends.running(context)
        for name, subject in subjects(context, setting).items()
        if at_limit(name)
    ]


def subjects(context: Context, setting: Setting) -> dict[str, Subject]:
    """Return the setting's subjects that can run in it."""
    return {name: subject for name, subject in setting.subjects.items() if name not in absent(context, setting)}


def absent(context: Context, setting: Setting) -> dict[str, str]:
    """Return the reasons why formulas or Mitsuba's functions are not measured in a setting, by name."""
    if setting.vector is None:
        return dict.fromkeys([*FORMULAS, backends.BUILTIN], setting.reason)
    if setting.precision is np.float64:
        return {backends.BUILTIN: "Mitsuba's wheel has no variant in double precision"}
    if setting.is_scalar:
        return dict.fromkeys(FORMULAS, "Dr.Jit's scalar arrays compute in double precision")
    return {} if setting.mitsuba else {backends.BUILTIN: context.variants[f"{setting.backend}_ad_rgb"] or ""}


# Chains --------------------------------------------------------------------------------------------------------


def chain_rows(context: Context, setting: Setting) -> list[Row]:
    """Return the rows of mirages, exact ratios and the light pipe in a setting."""
    rows = [Row(NAME, name, "all", setting.label, reason=why) for name, why in absent(context, setting).items()]
    if setting.vector is None:
        return rows
    how, tested = extent(context, setting), subjects(context, setting)
    for count in how.layers:
        for plane in how.planes:
            case = f"mirage {plane}, {count} layers"
            rows += mirage_rows(tested, case, air(count), PLANES[plane], setting, how)
    rows += mirage_rows(tested, "exact ratios askew, 250 layers", exact_ratios(250), PLANES["askew"], setting, how)
    return [*rows, *(pipe_row(name, subject, setting, how) for name, subject in tested.items())]


def at_limit(name: str) -> bool:
    """Whether a subject is a form at the rounding limit: only these take a contrast and have budgets."""
    return name in FORMULAS and FORMULAS[name].takes_contrast


def mirage_rows(
    tested: dict[str, Subject], case: str, layers: Layers, plane: Array, setting: Setting, how: Extent
) -> list[Row]:
    """Return a row per formula and feed, and a row per feed of the problem with the curves of all formulas.

    Ratios that are exact in float32 have one feed; float64 has two, as the others agree.
    """
    has_curves = how.curves and plane is PLANES["askew"]
    stops = np.unique(np.geomspace(1, layers.count, 25).astype(int)) if has_curves else np.array([], int)
    degrees = np.concatenate([how.angles, np.full(len(stops), SEEN_AT)])
    stop = np.concatenate([np.full(len(how.angles), layers.count), stops])
    rays = enter(layers, degrees, stop, plane, setting.precision)
    rows = []
    feeds = ["ratios"] if layers.exact else [*FEEDS] if setting.precision is np.float32 else ["ratios", "contrasts"]
    for feed in feeds:
        fed, curves = rays.fed(feed, setting.precision), {}
        for name, subject in tested.items():
            if feed != "contrasts" or at_limit(name):
                row, error = mirage_row(name, subject, case, fed, setting, how)
                rows.append(row)
                curves[name] = error[len(how.angles) :]
        if has_curves:  # condition · u and the error of every formula, by the number of layers
            curves["condition · u"] = (fed.condition * setting.roundoff).astype(float)[len(how.angles) :]
            lines = {name: list(zip(stops.tolist(), y.tolist(), strict=True)) for name, y in curves.items()}
            values = {"condition · u": lines["condition · u"][-1][1]}
            rows.append(Row(NAME, PROBLEM, f"{case}, {fed.feed}", setting.label, values, curves=lines))
    return rows


def mirage_row(name: str, subject: Subject, case: str, fed: Fed, setting: Setting, how: Extent) -> tuple[Row, Array]:
    """Return the row, and the relative error of every ray's cosine: 1 if it wrongly turned or passed."""
    rays, final = fed.rays, slice(0, len(how.angles))
    count = rays.layers.count
    carried = carry(subject, fed.chain, rays.a, rays.stop, setting)
    right = (carried.place >= rays.stop) == rays.passes
    error = np.where(right, np.abs(cosine(carried.b, rays.normal) / rays.end - 1), 1)
    error = np.where(np.isnan(error), np.inf, error.astype(float))
    turned = np.where(carried.place < 0, carried.passed // 2, rays.stop)
    length = np.sqrt((carried.b**2).sum(1) / (rays.a.astype(np.longdouble) ** 2).sum(1))
    over_condition = error / (fed.condition * setting.roundoff)
    values = {
        "error / condition": worst(over_condition[final][right[final]]),
        "error": worst(error[final]),
        MISCLASSIFIED: float((~right)[final].sum()),
        MISCLASSIFIED_FAR: float((~right & ~undecided(fed, setting.roundoff))[final].sum()),
        "turning height": worst((np.abs(turned - rays.last) / count)[final][~rays.passes[final]]),
        "length drift": worst(np.abs(length - 1)[final]),
    } | {f"{angle}°": float(e) for angle, e in zip(how.angles, error, strict=False) if angle in PASSING}
    budgets = mirage_budgets(fed, setting.roundoff, final) if at_limit(name) else {}
    remark = how.remark if budgets or not at_limit(name) else "; ".join(filter(None, (NOTHING, how.remark)))
    ends = {"n_0": float(rays.layers.index[0]), "n_last": float(rays.layers.index[-1])}
    replay = {"layers": count, **ends, "angles": how.angles, "normal": [float(x).hex() for x in rays.normal]}
    return Row(NAME, name, f"{case}, {fed.feed}", setting.label, values, budgets, reason=remark, replay=replay), error


NOTHING = "no budget: if every input and output errs by u, these rays may take any path"


def mirage_budgets(fed: Fed, u: float, final: slice) -> dict[str, float]:
    """Return the budgets of a form at the rounding limit, without budgets that the problem's condition makes void."""
    rays = fed.rays
    heights = (turning_error(fed, u) / rays.layers.count)[final][~rays.passes[final]]
    budgets = {}
    if (fed.condition[final] * u <= limits.FIRST_ORDER).any():
        budgets["error / condition"] = limits.MIRAGE
    if not undecided(fed, u)[final].all():
        budgets[MISCLASSIFIED_FAR] = 0.0
    if len(heights) and worst(heights) < 1:
        budgets["turning height"] = worst(heights)
    return budgets


def undecided(fed: Fed, u: float) -> Array:
    """Return the rays that may be misclassified, because their error bound includes the decision."""
    turned = fed.rays.last + turning_error(fed, u) >= fed.rays.layers.count
    return np.where(fed.rays.passes, fed.condition * u > limits.FIRST_ORDER, turned)


def turning_error(fed: Fed, u: float) -> Array:
    """Return the bound on the error of the layer in which a ray turns, in layers: e = x + 1 + growth e."""
    share = 1 - limits.MIRAGE * u * fed.growth  # at 0 or below, rounding may hide every layer
    return np.asarray((limits.MIRAGE * u * fed.height + 1) / share if share > 0 else np.full(len(fed.height), np.inf))


def pipe_row(name: str, subject: Subject, setting: Setting, how: Extent) -> Row:
    """Return the row of total internal reflections in a square pipe."""
    rays = 2 if setting.is_scalar else PIPE_RAYS
    a, chain, exact = pipe(how.reflections, rays, CORE, setting.precision)
    carried = carry(subject, chain, a, np.full(rays, how.reflections), setting)
    lengths = [np.sqrt((x.astype(np.longdouble) ** 2).sum(1)) for x in (carried.b, a)]
    chord = np.sqrt(((carried.b - exact) ** 2).sum(1)) / lengths[1]
    values = {  # every reflection keeps the error of the direction and adds at most u
        "error / condition": worst(chord / (how.reflections * setting.roundoff)),
        "error": worst(chord),
        MISCLASSIFIED: float(carried.passed.sum()),
        "length drift": worst(np.abs(lengths[0] / lengths[1] - 1)),
    }
    budgets = {"error / condition": limits.LIGHT_PIPE, MISCLASSIFIED: 0.0} if at_limit(name) else {}
    case, axis = f"light pipe, {how.reflections} reflections", [float(x).hex() for x in frame(setting.precision)[2]]
    replay = {"reflections": how.reflections, "rays": rays, "axis": axis, "seed": seeds.current(SEED)}
    return Row(NAME, name, case, setting.label, values, budgets, reason=how.remark, replay=replay)


# Systems -------------------------------------------------------------------------------------------------------


class Refractor:
    """A formula as a system calls it, with inputs rounded to the setting's precision; counts reflected rays."""

    def __init__(self, subject: Subject, setting: Setting) -> None:
        """`subject` is evaluated in the arrays of the setting."""
        self.subject, self.setting, self.mirrored = subject, setting, 0

    def __call__(self, a: Array, n: Array, k: Any) -> Array:
        """Return the directions behind a boundary: `a`, `n` N × 3, k a number or N."""
        arrays = np.broadcast_arrays(a, n, np.reshape(k, (-1, 1)))
        a, n, k = (x.astype(self.setting.precision) for x in arrays)
        b, transmitted = evaluate(self.subject, regimes.Rays(a, n, k[:, 0]), self.setting.vector)
        self.mirrored += int((~transmitted).sum())
        return b


def system_rows(context: Context, setting: Setting) -> list[Row]:
    """Return a row per optical system and subject of a setting."""
    tested = subjects(context, setting).items()
    return [system_row(name, subject, case, setting) for case in optical_systems.SYSTEMS for name, subject in tested]


def system_row(name: str, subject: Subject, case: str, setting: Setting) -> Row:
    """Return the row of a subject's errors at the end of a system."""
    system, refractor = optical_systems.SYSTEMS[case](), Refractor(subject, setting)
    error = np.sqrt((system.errors(refractor) ** 2).sum(1))
    values = {
        "error / condition": worst(error / (system.condition * setting.roundoff)),
        "error": worst(error),
        MISCLASSIFIED: float(refractor.mirrored),
    }
    # The condition counts u for every rounding. Inputs use √3/2 of it, a form at the rounding limit 0.8724, or 1.005
    # for directions that are not unit: the excess of 0.005 is not granted.
    budgets = {"error / condition": limits.SYSTEM, MISCLASSIFIED: 0.0} if at_limit(name) else {}
    if case == "double Gauss":
        values["over print"] = optical_systems.off_print(Refractor(subject, setting))
        # Below 45° any formula errs by at most 20u per surface, and 11 · 20 · 2⁻⁵³ is far below the printed rounding.
        budgets |= {"over print": limits.PRINT} if setting.precision is np.float64 else {}
    replay = {"definition": definition(optical_systems.SYSTEMS[case]), "rays": len(error)}
    return Row(NAME, name, case, setting.label, values, budgets, replay=replay)


RECORDS = (*backends.DOCUMENTED, backends.BUILTIN, PROBLEM)
STUDY = Study(NAME, "Stability", about(__doc__), TERMS, tasks, axes=AXES, again=drawn_rows, records=RECORDS)
