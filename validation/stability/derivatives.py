"""Derivatives by automatic differentiation, of directions and of the reflectance, against certified ones.

Measured are ∂b/∂a along two unit vectors perpendicular to `a`, in the plane of incidence and across it; k ∂b/∂k; and
η ∂R/∂η, which is −k ∂R/∂k. The error is relative, or absolute where the derivative is below 1 (below R). At the
critical angle the derivatives diverge as 1/cosθt. The condition of ∂b, 1 + k² sinθi (sinθi + 2 cosθi)/cos²θt, is the
change of the derivative, in u and to first order, that inputs off by u may cause; the étendue's has 1/12 cosθi more.
That of ∂R/∂η is the sum of the magnitudes of its terms, over the larger of their sum and R, which rounds to u of it.
`condition_of` derives the limits.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from mi_refract import oracle, regimes
from mi_refract.accuracy import arrays, lengths
from mi_refract.formulas import FORMULAS, fresnel
from mi_refract.numerics import from_numpy
from mi_refract.oracle import derivatives
from mi_refract.report.row import Row
from validation import limits
from validation.run import seeds
from validation.run.array_settings import DOCUMENTED, Setting, settings
from validation.run.context import Context
from validation.study import Study, Task, about

NAME = "derivatives"
AXES = {"x": "cos²θt, transmitted", "y": "largest error of k ∂b/∂k", "x_scale": "log", "y_scale": "log"}
TERMS = {
    "∂b/∂k": "times k: the change of the direction with the relative index",
    "∂b/∂a in the plane": "along the unit vector at right angles to `a` in the plane of incidence",
    "∂b/∂a across it": "along the unit vector at right angles to that plane",
    "étendue": "|∂b/∂a × ∂b/∂a'| cosθt, which is k² cosθi: n² cosθ dΩ is the same on both sides; relative",
    "∂R/∂η": "times η, of `fresnel.powers` with the cosine of `fresnel.refracted_cosine`",
    "error": "the largest",
    "error / condition": "the largest, in units of condition · u",
    "not finite": "rays whose derivative is computed as NaN or infinite, though it exists",
}
SEED = 2029
BINS = np.geomspace(1e-9, 1, 19)
Array = np.ndarray


@dataclass(frozen=True)
class Inputs:
    """Rays, two directions at right angles to each, and the certified answers."""

    rays: regimes.Rays
    along: dict[str, Array]  # by derivative: (N, 3), in the precision of the rays
    exact: dict[str, Array]
    certified: oracle.Certified
    condition: Array
    regime: Array


def tasks(context: Context) -> list[Task]:
    """One task per backend and precision."""
    return [Task(f"derivatives: {s.label}", functools.partial(setting_rows, context, s)) for s in settings(context)]


def setting_rows(context: Context, setting: Setting) -> list[Row]:
    """Every formula and the reflectance in a setting."""
    reason = "Dr.Jit differentiates compiled arrays only" if setting.is_scalar else setting.reason
    if reason:
        return [Row(NAME, name, "all", setting.label, reason=reason) for name in (*FORMULAS, "powers")]
    given = inputs(context.profile.rays // 40, setting.precision)
    rows, curves = [], {}
    for name, formula in FORMULAS.items():
        found, curves[name] = formula_rows(name, formula, given, setting)
        rows += found
    curves["condition · u"] = binned(given, given.condition * setting.roundoff)
    values = {"condition · u": float(given.condition.max()) * setting.roundoff}
    problem = Row(NAME, "the problem", "∂b/∂k", setting.label, values, curves=curves)
    return [*rows, problem, reflectance_row(given, setting)]


def drawn_rows(context: Context) -> list[Row]:
    """The rows with budgets, and those that are not run."""
    every = [row for setting in settings(context) for row in setting_rows(context, setting)]
    return [row for row in every if row.budgets or not row.values]


@seeds.cached
def inputs(count: int, precision: type) -> Inputs:
    """Unit rays of all regimes that have derivatives: neither tangential nor exactly critical."""
    names = [name for name, regime in regimes.REGIMES.items() if regime.unit and not regime.rests_on_denormals]
    parts = [regimes.make(name, count, precision, seeds.current(SEED)) for name in names]
    a, n, k = (np.concatenate([getattr(part, x) for part in parts]) for x in ("a", "n", "k"))
    certified = oracle.refract(a, n, k, progress=False, fresnel=False)
    wide = regimes.normalised(a)
    across = np.cross(n.astype(np.longdouble), wide)
    normal = (np.abs(across).max(1) == 0)[:, None]
    across = np.where(normal, np.cross(wide, np.roll(wide, 1, axis=1)), across)
    for _ in range(2):  # near the normal rounding has left some of `a` in it
        across /= lengths(across)[:, None]
        across -= (across * wide).sum(1, keepdims=True) * wide
    within: Any = np.cross(across, wide)
    along = {"∂b/∂a in the plane": within.astype(precision), "∂b/∂a across it": across.astype(precision)}
    exact = {name: derivatives.derivative(a, n, k, e, 0.0) for name, e in along.items()}
    exact["∂b/∂k"] = derivatives.derivative(a, n, k, np.zeros_like(a), k)
    every = Inputs(regimes.Rays(a, n, k), along, exact, certified, condition_of(certified, k), np.repeat(names, count))
    measured: Inputs = only(every, np.isfinite(exact["∂b/∂k"]).all(1))
    return measured


def only(given: Any, kept: np.ndarray) -> Any:
    """Rays, certified answers or all of `Inputs`, of a mask (N,)."""
    if isinstance(given, dict):
        return {name: only(x, kept) for name, x in given.items()}
    return type(given)(**only(vars(given), kept)) if hasattr(given, "__dict__") else given[kept]


def forward(function: Callable[[Any], Any], x: Any, direction: Any) -> tuple[Any, Any]:
    """`function(x)` and its derivative along `direction`."""
    dr.enable_grad(x)
    y = function(x)
    dr.set_grad(x, direction)
    found = dr.forward_to(y)
    return dr.detach(y), found


def differentiate(formula: Any, given: Inputs, setting: Setting) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The derivatives of b, (N, 3) in extended precision, and which rays were transmitted."""
    vector: Any = dr.diff_array_t(setting.vector)
    rays = given.rays
    number = dr.value_t(vector)
    (a, n, k), found = arrays(rays, vector), {}
    for name, e in given.along.items():
        found[name] = forward(lambda a: formula(a, n, k)[0], vector(a), from_numpy(vector, e))[1]
    found["∂b/∂k"] = forward(lambda k: formula(a, n, k)[0], number(k), k)[1]
    transmitted = np.array(formula(a, n, k)[1])
    return {name: np.array(x).T.astype(np.longdouble) for name, x in found.items()}, transmitted


def formula_rows(
    name: str, formula: Any, given: Inputs, setting: Setting
) -> tuple[list[Row], list[tuple[float, float]]]:
    """A row per derivative of a formula, and the curve of ∂b/∂k against cos²θt."""
    found, transmitted = differentiate(formula, given, setting)
    right, rows = transmitted == given.certified.transmitted, []
    curve: list[tuple[float, float]] = []
    rounded_once = name == "promoted" and setting.precision is np.float32
    most = (limits.ROUNDED_DERIVATIVE, limits.ROUNDED_ETENDUE) if rounded_once else (limits.DERIVATIVE, limits.ETENDUE)
    at_limit = FORMULAS[name].budget.at_the_limit
    budgets, of_area = ({"error / condition": x, "not finite": 0.0} if at_limit else {} for x in most)
    for case, exact in given.exact.items():
        error = lengths(found[case] - exact) / np.maximum(1, lengths(exact))
        rows.append(row(name, case, error, given, setting, right, budgets))
        curve = binned(given, np.where(right, error, 0)) if case == "∂b/∂k" else curve
    area = np.cross(found["∂b/∂a in the plane"], found["∂b/∂a across it"])
    cos_t, k = given.certified.cos_t, given.rays.k.astype(np.longdouble)
    # Rounded, the two directions are off right angles to `a` by u, and the derivatives by u b: the part along b is not.
    through, along_b = right & given.certified.transmitted, (area * given.certified.direction).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.abs(np.abs(along_b) * cos_t / (k * k * given.certified.cos_i) - 1)
    # At grazing incidence what crosses the surface is known to u/cosθi.
    steep = dataclasses.replace(given, condition=given.condition + 1 / (12 * given.certified.cos_i))
    rows.append(row(name, "étendue", error, steep, setting, through, of_area))
    return rows, curve


def row(
    subject: str, case: str, error: Array, given: Inputs, setting: Setting, right: Array, budgets: dict[str, float]
) -> Row:
    """The worst error of a derivative, relative and over the condition of its ray."""
    finite = np.isfinite(error)
    used = right & finite
    over = np.where(used, error, 0) / (given.condition * setting.roundoff)
    worst = int(np.argmax(over))
    values = {
        "error / condition": float(over[worst]),
        "error": float(error[used].max(initial=0)),
        "not finite": float((right & ~finite).sum()),
    }
    a, n = ([float(x).hex() for x in v[worst]] for v in (given.rays.a, given.rays.n))
    ray = {"regime": str(given.regime[worst]), "a": a, "n": n, "k": float(given.rays.k[worst]).hex()}
    replay = {"seed": seeds.current(SEED), "rays": len(error), "worst": ray}
    return Row(NAME, subject, case, setting.label, values, budgets, replay=replay)


def binned(given: Inputs, y: np.ndarray) -> list[tuple[float, float]]:
    """The largest y of the transmitted rays in each bin of cos²θt."""
    cos2 = given.certified.cos_t**2
    bins = [
        given.certified.transmitted & (cos2 >= low) & (cos2 < 2 * high) & np.isfinite(y) & (y > 0)
        for low, high in itertools.pairwise(BINS)
    ]
    centres = np.sqrt(BINS[:-1] * BINS[1:])
    return [(float(x), float(y[inside].max())) for x, inside in zip(centres, bins, strict=True) if inside.any()]


def reflectance_row(given: Inputs, setting: Setting) -> Row:
    """The row of exact cosines: those of the rays, rounded."""
    number = dr.value_t(dr.diff_array_t(setting.vector))
    k: Any = given.rays.k
    cos_i: Any = given.certified.cos_i.astype(setting.precision)
    exact = derivatives.derivative_of_powers(cos_i, k, 0.0, k)
    cosine, certified = number(cos_i), oracle.fresnel(cos_i, k)

    def reflectance(k: Any) -> Any:
        cos_t, transmitted = fresnel.refracted_cosine(cosine, k)
        return fresnel.powers(cosine, cos_t, transmitted, k)[0]

    r, found = (np.array(x).astype(np.longdouble) for x in forward(reflectance, number(k), number(k)))
    size = np.maximum(np.maximum(np.abs(exact), r), np.finfo(setting.precision).tiny)
    # Where every term is 0, so must be their sum: any error is infinitely many conditions, and "not finite" stays 0.
    condition = np.maximum(size_of_powers(certified, cos_i, k) / size, np.finfo(float).tiny)
    with np.errstate(invalid="ignore"):
        error = np.abs(found - exact) / size
    exists = np.isfinite(exact)
    budgets = {"error / condition": limits.REFLECTANCE[setting.name], "not finite": 0.0}
    given = dataclasses.replace(given, condition=condition)  # that of the rounded cosines
    return row("powers", "∂R/∂η", error, given, setting, exists, budgets)


# Conditions -------------------------------------------------------------------------------------------------------


def condition_of(certified: oracle.Certified, k: np.ndarray) -> np.ndarray:
    """C = 1 + k² sinθi (sinθi + 2 cosθi)/cos²θt: what k and both directions, off by u, change log cosθt by.

    How far rounding may move a derivative, and so the constants in `limits` that go with this condition, with that of
    the étendue, C + 1/12 cosθi, and with `size_of_powers`:

    Notation: c = cosθi, s = sinθi, y = cosθt, D = y² = c² − κ s², e the input's direction, a prime d/dε. Forward
    differentiation evaluates a sum of products with rounded factors. Sums of two words stay free of errors, as their
    derivatives pass the same steps; a product costs u of its size. In units of u, for a form at the rounding limit,
    whose values D, y and b are right to u:

        c′ = n·e                  δc′ ≤ 1 + 4|c′|                       Σ|nᵢeᵢ| ≤ 1
        w′ = n × e                δw′ ≤ √2 + 2|w′|                      Σ(|nⱼeₖ| + |nₖeⱼ|)² ≤ 2
        D′ = 2cc′ − 2κ w·w′       δD′ ≤ 2c δc′ + 4c|c′| + |κ|(2s δw′ + 8s|w′|) + 2|D′|
        r′ = D′/2y                δr′ ≤ (δD′ + 6|D′|)/2y                rsqrt, its derivative, one correction
        b′ along the surface      k δw′ + 2k|w′|
        b′, corrected and rounded 4|b′|                                  three products a component, and the last sum

    **∂b/∂a in the plane**: c′ = −s, |w′| = c, D′ = −2k²sc, |b′| = kc/y.

        δb′ ≤ [c(1 + 6s) + |κ|s(1.42 + 6c) + 8k²sc]/y + k(√2 + 4c) + 4|b′|

    With C = 1 + k²s(s + 2c)/y² ≥ 1/y² + 2k²sc/y² ≥ 1 and M = max(1, |b′|): k ≥ 1: kc/y ≤ M; |κ|s ≤ k as ks ≤ 1, so
    |κ|s/y ≤ 2M for c ≥ 1/2, and k ≤ 1.155, |κ| ≤ 1/3 else; k²sc/y ≤ C/2; so 7 + 2.83 + 3 + 4 + (2.83 + 4) + 4 = 27.7.
    k < 1: c ≤ y, s/y ≤ C: 7 + 1.42 + 6 + 4 + 5.42 + 4 = 27.9. **Across it**: c′ = w·w′ = D′ = 0, |w′| = 1:
    (c + 7.4|κ|s)/y + 5.42k + 4k ≤ 17.9 CM. **∂b/∂k**: no δc′, no δw′, less. The certified derivative is a double, 1
    more: DERIVATIVE = 29 ≥ error/(C M u).

    **Étendue**, (v × w)·b = k²c/y of v = ∂b/∂a in the plane and w = k across it. Errors along the surface, τ relative,
    and ν along n, in units of u, move its logarithm by y²(τ_v + τ_w) + k²s²τ_w + (s y/c) ν_v; ν_w moves it by none.
    With τ_v ≤ √2/c + 4 + 4/y, τ_w ≤ √2 + 8, ν_v ≤ δr′ + 4kc/y:

        (√2 y² + 1.42|κ|s²)/c + 4y² + 4y + 9.42 + s(1 + 6s) + 6|κ|s² + 8k²s² + 4ks

    y² + k²s² = 1 and |κ|s² ≤ 1, so at most 2.84/c + 8 + 4√2 + 9.42 + 7 + 6 = 2.84/c + 36.1. Both e are off unit by √3/2
    each; cosines and b are doubles, 3 more: 40.8 + 2.84/c ≤ 41 (C + 1/12c). Here a small k does not hide in M.

    **The promoted form in float32** computes all of this with 2⁻⁵³ and rounds v and w once: |δb′| ≤ u|b′|, 1.01 with
    what is left of float64; the étendue 2 + √3 of it.

    **∂R/∂η** of R = A/(A + B), A = κ²(p² + q²), B = 2kp(d_s² + d_p²), p = cy, q = ks², where log y changes with log k
    by Y = −k²s²/y². k ∂R/∂k = RT(α − β), and the sum of its terms' magnitudes is

        S = RT [4k²/|κ| + (2p²|Y| + 2q²)/(p² + q²) + 1 + |Y| + 2(d_s(kc + y|Y|) + d_p ky(1 + |Y|))/(d_s² + d_p²)].

    In float64: Y by D′ (6 roundings) and √ (13); five steps of double words to A′ or B′, 13; T A′ − R B′ over A + B, 8;
    and the rounded y, which enters p, d_s, d_p, R, T with powers of 8.2 at most: 48.2 u S. In float32 all but y, y′ and
    the result is exact to 2⁻²⁹: 8.2 + 1 + 1, and less than 0.3 for what 1/T ≤ 1e6 makes of 2⁻⁵³.
    """
    sin_i = np.sqrt((1 - certified.cos_i) * (1 + certified.cos_i))
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = k.astype(float) ** 2 * sin_i * (sin_i + 2 * certified.cos_i) / certified.cos_t**2
    return 1 + np.where(certified.transmitted, moved, 0)


def size_of_powers(certified: oracle.Certified, cos_i: np.ndarray, k: np.ndarray) -> np.ndarray:
    """S of `condition_of`, (N,); 0 under total internal reflection and at k = 1, where the derivative is exactly 0."""
    wide: Any = np.longdouble
    c, k, y = cos_i.astype(wide), k.astype(wide), certified.cos_t.astype(wide)
    r, t = (getattr(certified, name).astype(wide) for name in ("reflectance", "transmittance"))
    s2, kappa = (1 - c) * (1 + c), (k - 1) * (k + 1)
    p, q, d_s, d_p = c * y, k * s2, k * c + y, c + k * y
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = k * k * s2 / (y * y)
        reflected = 4 * k * k / np.abs(kappa) + 2 * (p * p * turn + q * q) / (p * p + q * q)
        through = 1 + turn + 2 * (d_s * (k * c + y * turn) + d_p * k * y * (1 + turn)) / (d_s * d_s + d_p * d_p)
        return np.where(certified.transmitted & (kappa != 0), r * t * (reflected + through), 0)


RECORDS = (*DOCUMENTED, "the problem")
STUDY = Study(NAME, "Derivatives", about(__doc__), TERMS, tasks, axes=AXES, again=drawn_rows, records=RECORDS)
