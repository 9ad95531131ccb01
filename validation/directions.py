"""Directions: every formula against the certified answer, ray by ray, with the time it takes.

The error of a ray is the chord |b/|a| − exact| in units of roundoff u (2⁻²⁴, 2⁻⁵³), and the angle in radians.
Rays whose total internal reflection was decided wrongly are counted, and left out of the errors.
Times are those of streaming rays from memory, as a multiple of the time of copying the same bytes (a + k n).
"""

from __future__ import annotations

import functools
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract import oracle, regimes
from mi_refract.formulas import FORMULAS, ROUNDING, Budget, cancelling
from mi_refract.rows import Row

from .plan import Context, Task

FLOOR = "exact, rounded"
TITLE = "Directions"
TEXT = __doc__.partition("\n")[2].strip()
TERMS = (
    {name: f"{formula.equation} (source: {formula.source})" for name, formula in FORMULAS.items()}
    | {name: regime.text for name, regime in regimes.REGIMES.items()}
    | {
        "worst / u": "the largest chord error in units of roundoff; rounding the exact answer costs 0.87",
        "misjudged": "rays whose total internal reflection was decided wrongly",
        "misjudged far": "those of them that are farther from the critical angle than the formula's own error; at the "
        "rounding limit, those whose radicand exceeds 16u² of its terms: below, the decision moves b by 4u at most",
        FLOOR: "the certified direction times |a|, rounded: no form does better. At most √3/2 u where |a| = 1, and 1 u "
        "elsewhere, where all components may have just passed a power of two",
        "other side": "rays within 4u of the surface that a documented formula sends to the other side of it, because "
        "it knows n·a to no more; left out of the errors",
        "no budget": "the documented formulas demand unit vectors: where those are not, their rows are shown only",
        "length drift": "how far the length of b is from that of a, relative",
        "time / copy": "median time of a ray over that of copying its bytes, streaming; below 1 it is noise",
        "operations": "Dr.Jit's count for the whole kernel",
    }
)
SCATTER = [
    {"study": "directions", "x": "time / copy", "y": "worst / u", "title": "Worst error against time per ray"},
]
BUILTIN = "mi.fresnel + mi.refract"
SEED = 2026


@dataclass(frozen=True)
class Setting:
    """A backend in a precision: `vector` is its 3-vector type, `None` where it cannot run, for `reason`."""

    label: str
    precision: type
    vector: Any = None
    reason: str = ""

    @property
    def roundoff(self) -> float:
        return float(np.finfo(self.precision).eps) / 2

    @property
    def is_scalar(self) -> bool:
        return self.vector is not None and not dr.is_jit_v(self.vector)

    @functools.cached_property
    def flushes(self) -> bool:
        """Whether denormal numbers are taken for 0, which Dr.Jit's threads do. Asked of the array, not presumed."""
        if self.is_scalar:
            return False
        least = np.full(1 << 16, np.finfo(self.precision).smallest_subnormal)
        return not np.array(dr.value_t(self.vector)(least) > 0).all()


def tasks(context: Context) -> list[Task]:
    """One task per backend and precision."""
    return [
        Task(f"directions: {setting.label}", functools.partial(_setting_rows, context, setting))
        for setting in settings(context)
    ]


def settings(context: Context) -> list[Setting]:
    found = [
        Setting("scalar float64", np.float64, dr.scalar.Array3f64),
    ]
    for backend in ("llvm", "cuda"):
        entry = context.backends[backend]
        for precision, name in ((np.float32, "Array3f"), (np.float64, "Array3f64")):
            label = f"{backend} {np.dtype(precision).name}"
            if entry.usable:
                found.append(Setting(label, precision, getattr(getattr(dr, backend), name)))
            else:
                found.append(Setting(label, precision, reason=entry.reason))
    return found


@functools.cache
def certified(regime: str, count: int, precision: type) -> tuple[regimes.Rays, oracle.Certified]:
    rays = regimes.make(regime, count, precision, SEED)
    return rays, oracle.refract(rays.a, rays.n, rays.k, progress=False)


# Errors --------------------------------------------------------------------------------------------------------

Subject = Callable[[Any, Any, Any], tuple[Any, Any]]


def _setting_rows(context: Context, setting: Setting) -> list[Row]:
    if setting.vector is None:
        return [Row("directions", name, "all regimes", setting.label, reason=setting.reason) for name in FORMULAS]
    count = context.profile.scalar_rays if setting.is_scalar else context.profile.rays
    times = _times(context, setting)
    rows = [floor_row(regime, setting, count) for regime in regimes.REGIMES]
    for name, subject in _subjects(context, setting).items():
        parts = [_regime_row(name, subject, regime, setting, count) for regime in regimes.REGIMES]
        rows += [*parts, _summary(name, parts, setting, times)]
    return rows


def _subjects(context: Context, setting: Setting) -> dict[str, Subject]:
    """Every formula, and Mitsuba's functions where they exist in this precision."""
    subjects: dict[str, Subject] = dict(FORMULAS)
    if setting.label.startswith(context.variant.partition("_")[0]) and setting.precision is np.float32:
        subjects[BUILTIN] = builtin
    return subjects


def builtin(a: Any, n: Any, k: Any) -> tuple[Any, Any]:
    """Mitsuba's own functions, with the normal turned so that they need no reciprocal of k."""
    import mitsuba as mi

    wi, n, k = mi.Vector3f(-a), mi.Vector3f(n), mi.Float(k)
    n = n * dr.sign(dr.dot(-wi, n))
    _, cos_t, _, eta_ti = mi.fresnel(dr.dot(wi, n), k)
    transmitted = cos_t != 0
    m = mi.Normal3f(n)
    return dr.select(transmitted, mi.refract(wi, m, cos_t, eta_ti), mi.reflect(wi, m)), transmitted


def evaluate(subject: Subject, rays: regimes.Rays, vector: Any) -> tuple[np.ndarray, np.ndarray]:
    """`subject` on all rays, as numpy arrays (N, 3) and (N,), in extended precision."""
    if dr.is_jit_v(vector):
        b, transmitted = subject(vector(rays.a.T), vector(rays.n.T), dr.value_t(vector)(rays.k))
        return np.array(b).T.astype(np.longdouble), np.array(transmitted)
    pairs = [subject(vector(a), vector(n), float(k)) for a, n, k in zip(rays.a, rays.n, rays.k, strict=True)]
    return np.array([list(b) for b, _ in pairs], np.longdouble), np.array([t for _, t in pairs], bool)


def errors(b: np.ndarray, rays: regimes.Rays, exact: oracle.Certified) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(chord, angle, drift of the length) of every ray, relative to |a|; NaN counts as infinite."""
    length = np.sqrt((rays.a.astype(np.longdouble) ** 2).sum(1))[:, None]
    unit, low = b / length, exact.direction_low.astype(np.longdouble)
    with np.errstate(invalid="ignore", over="ignore"):  # a formula may return anything
        difference = (unit - exact.direction) - low
        chord = np.sqrt((difference**2).sum(1))
        norm = np.sqrt((unit**2).sum(1))
        across = np.sqrt((np.cross(unit, difference) ** 2).sum(1)) / norm
        angle = np.arctan2(across, norm - (unit * difference).sum(1) / norm)
        chord, angle, drift = (np.nan_to_num(x.astype(float), nan=np.inf) for x in (chord, angle, np.abs(norm - 1)))
    return chord, angle, drift


def floor_row(regime: str, setting: Setting, count: int) -> Row:
    """The certified answers themselves, rounded."""
    rays, exact = certified(regime, count, setting.precision)
    length = np.sqrt((rays.a.astype(np.longdouble) ** 2).sum(1))[:, None]
    b = ((exact.direction + exact.direction_low.astype(np.longdouble)) * length).astype(setting.precision)
    return _judged(FLOOR, regime, setting, rays, exact, b.astype(np.longdouble), exact.transmitted)


def _regime_row(name: str, subject: Subject, regime: str, setting: Setting, count: int) -> Row:
    rays, exact = certified(regime, count, setting.precision)
    return _judged(name, regime, setting, rays, exact, *evaluate(subject, rays, setting.vector))


def _judged(
    name: str, regime: str, setting: Setting, rays: regimes.Rays, exact: oracle.Certified, b: Any, transmitted: Any
) -> Row:
    wrong = (transmitted != exact.transmitted) & ~exact.undecided
    chord, angle, drift = errors(b, rays, exact)
    side = held(name, exact.cos_i, setting.roundoff)
    right = ~wrong & ~exact.undecided & side
    u, largest_k = setting.roundoff, regimes.REGIMES[regime].largest_k
    worst = int(np.argmax(np.where(right, chord, -1)))
    crossed = ~side & ~wrong & (chord > exact.cos_t)
    chord, angle, drift = (x[right] if right.any() else np.zeros(1) for x in (chord, angle, drift))
    values = {
        "worst / u": float(chord.max()) / u,
        "worst chord": float(chord.max()),
        "p99 / u": _p99(chord) / u,
        "mean / u": float(chord.mean()) / u,
        "worst rad": float(angle.max()),
        "p99 rad": _p99(angle),
        "mean rad": float(angle.mean()),
        "length drift": float(drift.max()),
        "misjudged": float(wrong.sum()),
        "other side": float(crossed.sum()),
        "misjudged far": float(decisive(name, rays[wrong], u, largest_k).sum()),
    }
    replay = {
        "regime": regime, "text": regimes.REGIMES[regime].text, "count": len(rays), "seed": SEED,
        "worst ray": rays.hexed(worst),
    }  # fmt: skip
    limit, reason = bound(name, regime, setting, largest_k)
    budgets = {} if limit is None else {"worst / u": limit, "misjudged far": 0.0}
    return Row("directions", name, regime, setting.label, values, budgets, reason=reason, replay=replay)


def _budget(name: str) -> Budget:
    """That of the formula; the built-in's radicand cancels as that of the decomposed form does."""
    return FORMULAS[name].budget if name in FORMULAS else cancelling(2)


def _p99(x: np.ndarray) -> float:
    """What 99 of 100 stay below; one of the values, which may be infinite."""
    return float(np.quantile(x, 0.99, method="higher"))


def at_the_limit(name: str) -> bool:
    """Whether `name` is held to the rounding of the exact answer, for vectors of any length."""
    return name == FLOOR or (name in FORMULAS and FORMULAS[name].takes_contrast)


# 16u² of the radicand's terms: below it, the decision moves the direction by less than its root, 4u.
NEGLIGIBLE = 16.0


# The documented formulas know n·a, and with it the side that b goes to, to 4u: three products and two sums.
SIDE = 4.0


def held(name: str, cos_i: np.ndarray, u: float) -> np.ndarray:
    """(N,) the rays for which `name` has a bound: all, or those that are not within 4u of the surface."""
    return np.full(cos_i.shape, True) if at_the_limit(name) else cos_i > SIDE * u


def decisive(name: str, rays: regimes.Rays, u: float, largest_k: float) -> np.ndarray:
    """(N,) whether the ray is far enough from the critical angle that `name` must decide it rightly."""
    if at_the_limit(name):
        return np.abs(oracle.margin(rays.a, rays.n, rays.k)) > NEGLIGIBLE * u * u
    return _radicand(rays) > _budget(name).margin(u, largest_k)


def bound(name: str, regime: str, setting: Setting, k: float) -> tuple[float | None, str]:
    """(the chord error in u that is allowed on a regime for ratios up to k, or None; why None)."""
    entry = regimes.REGIMES[regime]
    if entry.rests_on_denormals and setting.flushes:
        return None, "this backend takes denormal numbers for 0"
    if not at_the_limit(name):
        if not entry.unit:
            return None, "no budget: a and n are not unit"
        return _budget(name).chord(setting.roundoff, k) / setting.roundoff, ""
    # A component of b may be in a binade twice as coarse for its share of |a| as where |a| = 1.
    return ROUNDING.linear * (1 if entry.unit else 2 / 3**0.5), ""


def _radicand(rays: regimes.Rays) -> np.ndarray:
    """|1 − k² sin²θ_i| of every ray, in extended precision: how far the decision is from the critical angle."""
    a, n, k = (x.astype(np.longdouble) for x in (rays.a, rays.n, rays.k))
    sin2 = (np.cross(n, a) ** 2).sum(1) / ((a * a).sum(1) * (n * n).sum(1))
    return np.abs(1 - k * k * sin2)


def _summary(name: str, parts: list[Row], setting: Setting, times: dict[str, dict[str, float]]) -> Row:
    """The worst over all regimes with a budget and what it cost: a point in the plane of error and time."""
    parts = [row for row in parts if row.budgets]
    worst = {m: max(row.values[m] for row in parts) for m in ("worst / u", "worst chord", "worst rad", "length drift")}
    total = {"misjudged": sum(row.values["misjudged"] for row in parts)}
    replay = {"rays": sum(row.replay["count"] for row in parts), "seed": SEED}
    return Row("directions", name, "all regimes", setting.label, worst | total | times[name], replay=replay)


# Times ---------------------------------------------------------------------------------------------------------


def _copy(a: Any, n: Any, k: Any) -> tuple[Any, Any]:
    """Reads and writes what a formula does, and computes as little as can be."""
    return a + n * k, k > 0


def _times(context: Context, setting: Setting) -> dict[str, dict[str, float]]:
    """Per subject: median time over that of copying, in turn in one run, warm; and the kernel's operations."""
    subjects = {"copy": _copy, **_subjects(context, setting)}
    clock = _scalar_clock(context, setting) if setting.is_scalar else _streaming_clock(context, setting)
    for subject in subjects.values():
        clock(subject)
    seconds: dict[str, list[float]] = {name: [] for name in subjects}
    for _ in range(context.profile.repeats):
        for name, subject in subjects.items():
            seconds[name].append(clock(subject))
    ratios = {
        name: statistics.median(t / c for t, c in zip(seconds[name], seconds["copy"], strict=True)) for name in subjects
    }
    return {
        name: {"time / copy": ratios[name]} | ({} if setting.is_scalar else {"operations": _operations(clock, subject)})
        for name, subject in subjects.items()
    }


def _streaming_clock(context: Context, setting: Setting) -> Callable[[Subject], float]:
    rays = regimes.make("generic", context.profile.streamed_rays, setting.precision, SEED)
    a, n, k = setting.vector(rays.a.T), setting.vector(rays.n.T), dr.value_t(setting.vector)(rays.k)
    dr.eval(a, n, k)

    def clock(subject: Subject) -> float:
        outcome = subject(a, n, k)
        dr.sync_thread()
        start = time.perf_counter()
        dr.eval(outcome)
        dr.sync_thread()
        return time.perf_counter() - start

    return clock


def _scalar_clock(context: Context, setting: Setting) -> Callable[[Subject], float]:
    rays = regimes.make("generic", context.profile.scalar_rays, setting.precision, SEED)
    vectors = [(setting.vector(a), setting.vector(n), float(k)) for a, n, k in zip(rays.a, rays.n, rays.k, strict=True)]

    def clock(subject: Subject) -> float:
        start = time.perf_counter()
        for a, n, k in vectors:
            subject(a, n, k)
        return time.perf_counter() - start

    return clock


def _operations(clock: Callable[[Subject], float], subject: Subject) -> float:
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        clock(subject)
        return float(max(entry.get("operation_count", 0) for entry in dr.kernel_history()))


