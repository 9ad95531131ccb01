"""Derivatives of directions and of the reflectance by automatic differentiation, against certified derivatives.

The study measures ∂b/∂a along two unit vectors perpendicular to `a`, in the plane of incidence and across it; k ∂b/∂k;
and η ∂R/∂η, which is −k ∂R/∂k. The error is relative, or absolute if the derivative is below 1 (below R for ∂R/∂η). At
the critical angle the derivatives diverge as 1/cosθt. The condition of ∂b, 1 + k² sinθi (sinθi + 2 cosθi)/cos²θt, is
the change of the derivative, in u and to first order, that input errors of u can cause; the condition of the étendue is
larger by 1/12 cosθi. The condition of ∂R/∂η is the sum of the magnitudes of its terms, divided by the larger of
|∂R/∂η| and R, because R itself has a rounding error of u R. `condition_of` derives the limits.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import drjit as dr
import numpy as np

from mi_refract import oracle, regimes
from mi_refract.accuracy import RayBounds, arrays, lengths
from mi_refract.formulas import FORMULAS, fresnel
from mi_refract.numerics import from_numpy
from mi_refract.oracle import derivatives
from mi_refract.report.row import Row
from validation import limits
from validation.run import seeds
from validation.run.array_settings import DOCUMENTED, Setting, settings
from validation.run.context import Context
from validation.run.metrics import MISCLASSIFIED_FAR
from validation.study import Study, Task, about

NAME = "derivatives"
AXES = {"x": "cos²θt, transmitted", "y": "largest error of k ∂b/∂k", "x_scale": "log", "y_scale": "log"}
TERMS = {
    "∂b/∂k": "times k: the change of the direction with the relative index",
    "∂b/∂a in the plane": "along the unit vector perpendicular to `a` in the plane of incidence",
    "∂b/∂a across it": "along the unit vector perpendicular to that plane",
    "étendue": "relative error of |∂b/∂a × ∂b/∂a'| cosθt, which is k² cosθi: n² cosθ dΩ is the same on both sides",
    "∂R/∂η": "times η, of `fresnel.powers` with the cosine of `fresnel.refracted_cosine`",
    "error": "the largest error",
    "error / condition": "the largest error, in units of condition · u",
    "not finite": "rays whose derivative exists but is computed as NaN or infinite",
    MISCLASSIFIED_FAR: "rays that are not compared, although the formula must classify them correctly",
}
SEED = 2029
BINS = np.geomspace(1e-9, 1, 19)
Array = np.ndarray


@dataclass(frozen=True)
class Inputs:
    """Rays, two directions perpendicular to each ray, and the certified answers."""

    rays: regimes.Rays
    along: dict[str, Array]  # directions of ∂b/∂a by name: (N, 3), in the precision of the rays
    exact: dict[str, Array]
    certified: oracle.Certified
    condition: Array
    regime: Array


def tasks(context: Context) -> list[Task]:
    """Return one task per backend and precision."""
    return [Task(f"derivatives: {s.label}", functools.partial(setting_rows, context, s)) for s in settings(context)]


def setting_rows(context: Context, setting: Setting) -> list[Row]:
    """Return the rows of all formulas and of the reflectance in a setting."""
    reason = "Dr.Jit differentiates compiled arrays only" if setting.is_scalar else setting.reason
    if reason:
        return [Row(NAME, name, "all", setting.label, reason=reason) for name in (*FORMULAS, "powers")]
    samples = inputs(context.profile.rays // 40, setting.precision)
    rows, curves = [], {}
    for name, formula in FORMULAS.items():
        measured, curves[name] = formula_rows(name, formula, samples, setting)
        rows += measured
    curves["condition · u"] = binned(samples, samples.condition * setting.roundoff)
    values = {"condition · u": float(samples.condition.max()) * setting.roundoff}
    problem = Row(NAME, "the problem", "∂b/∂k", setting.label, values, curves=curves)
    return [*rows, problem, reflectance_row(samples, setting)]


def drawn_rows(context: Context) -> list[Row]:
    """Return the rows with budgets and the rows that are not run."""
    rows = [row for setting in settings(context) for row in setting_rows(context, setting)]
    return [row for row in rows if row.budgets or not row.values]


@seeds.cached
def inputs(count: int, precision: type) -> Inputs:
    """Return unit rays of all regimes, without rays that have no derivatives (tangential or exactly critical)."""
    names = [name for name, regime in regimes.REGIMES.items() if regime.unit and not regime.rests_on_denormals]
    parts = [regimes.make(name, count, precision, seeds.current(SEED)) for name in names]
    a, n, k = (np.concatenate([getattr(part, x) for part in parts]) for x in ("a", "n", "k"))
    certified = oracle.refract(a, n, k, progress=False, fresnel=False)
    wide = regimes.normalised(a)
    across = np.cross(n.astype(np.longdouble), wide)
    normal = (np.abs(across).max(1) == 0)[:, None]
    across = np.where(normal, np.cross(wide, np.roll(wide, 1, axis=1)), across)
    for _ in range(2):  # near the normal, rounding leaves a component along `a`
        across /= lengths(across)[:, None]
        across -= (across * wide).sum(1, keepdims=True) * wide
    within: Any = np.cross(across, wide)
    along = {"∂b/∂a in the plane": within.astype(precision), "∂b/∂a across it": across.astype(precision)}
    exact = {name: derivatives.derivative(a, n, k, e, 0.0) for name, e in along.items()}
    exact["∂b/∂k"] = derivatives.derivative(a, n, k, np.zeros_like(a), k)
    samples = Inputs(
        regimes.Rays(a, n, k), along, exact, certified, condition_of(certified, k), np.repeat(names, count)
    )
    measured: Inputs = only(samples, np.isfinite(exact["∂b/∂k"]).all(1))
    return measured


def only(data: Any, mask: np.ndarray) -> Any:
    """Return the entries of a mask (N,), for an array, a dict, rays, certified answers or `Inputs`."""
    if isinstance(data, dict):
        return {name: only(x, mask) for name, x in data.items()}
    return type(data)(**only(vars(data), mask)) if hasattr(data, "__dict__") else data[mask]


def forward(function: Callable[[Any], Any], x: Any, direction: Any) -> tuple[Any, Any]:
    """Return `function(x)` and its derivative along `direction`."""
    dr.enable_grad(x)
    y = function(x)
    dr.set_grad(x, direction)
    derivative = dr.forward_to(y)
    return dr.detach(y), derivative


def differentiate(formula: Any, samples: Inputs, setting: Setting) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the derivatives of b, (N, 3) in extended precision, and which rays were transmitted, (N,)."""
    vector: Any = dr.diff_array_t(setting.vector)
    rays = samples.rays
    number = dr.value_t(vector)
    (a, n, k), results = arrays(rays, vector), {}
    for name, e in samples.along.items():
        results[name] = forward(lambda a: formula(a, n, k)[0], vector(a), from_numpy(vector, e))[1]
    results["∂b/∂k"] = forward(lambda k: formula(a, n, k)[0], number(k), k)[1]
    transmitted = np.array(formula(a, n, k)[1])
    return {name: np.array(x).T.astype(np.longdouble) for name, x in results.items()}, transmitted


def formula_rows(
    name: str, formula: Any, samples: Inputs, setting: Setting
) -> tuple[list[Row], list[tuple[float, float]]]:
    """Return a row per derivative of a formula, and the curve of ∂b/∂k against cos²θt."""
    results, transmitted = differentiate(formula, samples, setting)
    certified = samples.certified
    right, rows = transmitted == certified.transmitted, []
    curve: list[tuple[float, float]] = []
    rounded_once = name == "promoted" and setting.precision is np.float32
    most = (limits.ROUNDED_DERIVATIVE, limits.ROUNDED_ETENDUE) if rounded_once else (limits.DERIVATIVE, limits.ETENDUE)
    at_limit = FORMULAS[name].budget.at_the_limit
    budgets, etendue_budgets = ({"error / condition": x, "not finite": 0.0} if at_limit else {} for x in most)
    # Rays with a wrong decision are not compared.
    far = RayBounds(samples.rays, certified, FORMULAS[name].budget, setting.roundoff).decided_of(~right)
    counts = {MISCLASSIFIED_FAR: float(far.sum())}
    budgets |= {MISCLASSIFIED_FAR: 0.0} if at_limit else {}
    for case, exact in samples.exact.items():
        error = lengths(results[case] - exact) / np.maximum(1, lengths(exact))
        rows.append(row(name, case, error, samples, setting, right, budgets, counts))
        curve = binned(samples, np.where(right, error, 0)) if case == "∂b/∂k" else curve
    area = np.cross(results["∂b/∂a in the plane"], results["∂b/∂a across it"])
    cos_t, k = certified.cos_t, samples.rays.k.astype(np.longdouble)
    # The two rounded directions are perpendicular to `a` only up to u, and the derivatives have errors of u b: only the
    # component of the area along b is free of these errors.
    through, along_b = right & certified.transmitted, (area * certified.direction).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.abs(np.abs(along_b) * cos_t / (k * k * certified.cos_i) - 1)
    # At grazing incidence the flux through the surface has a relative error of u/cosθi.
    steep = dataclasses.replace(samples, condition=samples.condition + 1 / (12 * certified.cos_i))
    rows.append(row(name, "étendue", error, steep, setting, through, etendue_budgets))
    return rows, curve


def row(
    subject: str,
    case: str,
    error: Array,
    samples: Inputs,
    setting: Setting,
    right: Array,
    budgets: dict[str, float],
    counts: Mapping[str, float] = MappingProxyType({}),
) -> Row:
    """Return the row of a derivative: its worst relative error, and its worst error over the ray's condition.

    `right`: the rays that count. `counts`: further values.
    """
    finite = np.isfinite(error)
    used = right & finite
    over = np.where(used, error, 0) / (samples.condition * setting.roundoff)
    worst = int(np.argmax(over))
    values = {
        "error / condition": float(over[worst]),
        "error": float(error[used].max(initial=0)),
        "not finite": float((right & ~finite).sum()),
        **counts,
    }
    ray = {"regime": str(samples.regime[worst])} | samples.rays.hexed(worst)
    replay = {"seed": seeds.current(SEED), "rays": len(error), "worst": ray}
    return Row(NAME, subject, case, setting.label, values, budgets, replay=replay)


def binned(samples: Inputs, y: np.ndarray) -> list[tuple[float, float]]:
    """Return the largest y of the transmitted rays in each bin of cos²θt."""
    cos2 = samples.certified.cos_t**2
    bins = [
        samples.certified.transmitted & (cos2 >= low) & (cos2 < 2 * high) & np.isfinite(y) & (y > 0)
        for low, high in itertools.pairwise(BINS)
    ]
    centres = np.sqrt(BINS[:-1] * BINS[1:])
    return [(float(x), float(y[inside].max())) for x, inside in zip(centres, bins, strict=True) if inside.any()]


def reflectance_row(samples: Inputs, setting: Setting) -> Row:
    """Return the row of ∂R/∂η. The rays' cosines are rounded, and the exact derivatives are those at these cosines."""
    number = dr.value_t(dr.diff_array_t(setting.vector))
    k: Any = samples.rays.k
    cos_i: Any = samples.certified.cos_i.astype(setting.precision)
    exact = derivatives.derivative_of_powers(cos_i, k, 0.0, k)
    cosine, certified = number(cos_i), oracle.fresnel(cos_i, k)

    def reflectance(k: Any) -> Any:
        cos_t, transmitted = fresnel.refracted_cosine(cosine, k)
        return fresnel.powers(cosine, cos_t, transmitted, k)[0]

    r, derivative = (np.array(x).astype(np.longdouble) for x in forward(reflectance, number(k), number(k)))
    size = np.maximum(np.maximum(np.abs(exact), r), np.finfo(setting.precision).tiny)
    # If every term is 0, so is the derivative: the condition is tiny, and any error counts as very many conditions.
    condition = np.maximum(size_of_powers(certified, cos_i, k) / size, np.finfo(float).tiny)
    with np.errstate(invalid="ignore"):
        error = np.abs(derivative - exact) / size
    exists = np.isfinite(exact)
    budgets = {"error / condition": limits.REFLECTANCE[setting.name], "not finite": 0.0}
    samples = dataclasses.replace(samples, condition=condition)  # at the rounded cosines
    return row("powers", "∂R/∂η", error, samples, setting, exists, budgets)


# Conditions -------------------------------------------------------------------------------------------------------


def condition_of(certified: oracle.Certified, k: np.ndarray) -> np.ndarray:
    """Return C = 1 + k² sinθi (sinθi + 2 cosθi)/cos²θt, the change of log cosθt in u if k and both directions err by u.

    The following bounds the rounding errors of derivatives. It derives the constants in `limits` for this condition,
    for the condition of the étendue, C + 1/12 cosθi, and for `size_of_powers`.

    Notation: c = cosθi, s = sinθi, y = cosθt, D = y² = c² − κ s², e is the direction of the derivative, and a prime is
    d/dε. Forward differentiation evaluates a sum of products with rounded factors. Sums of two words have no errors,
    because their derivatives take the same steps; a product has an error of u times its size. In units of u, for a form
    at the rounding limit, whose values D, y and b have errors of at most u:

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

    **Étendue**, (v × w)·b = k²c/y with v = ∂b/∂a in the plane and |w| = k across it. Relative errors τ along the
    surface and errors ν along n, in units of u, change its logarithm by y²(τ_v + τ_w) + k²s²τ_w + (s y/c) ν_v; ν_w has
    no effect. With τ_v ≤ √2/c + 4 + 4/y, τ_w ≤ √2 + 8, ν_v ≤ δr′ + 4kc/y:

        (√2 y² + 1.42|κ|s²)/c + 4y² + 4y + 9.42 + s(1 + 6s) + 6|κ|s² + 8k²s² + 4ks

    y² + k²s² = 1 and |κ|s² ≤ 1, so at most 2.84/c + 8 + 4√2 + 9.42 + 7 + 6 = 2.84/c + 36.1. The length of either e errs
    by √3/2; cosines and b are doubles, 3 more: 40.8 + 2.84/c ≤ 41 (C + 1/12c). Here M does not hide a small k.

    **The promoted form in float32** computes all of this with 2⁻⁵³ and rounds v and w once: |δb′| ≤ u|b′|, 1.01 with
    the errors of float64; the étendue 2 + √3 of it.

    **∂R/∂η** with R = A/(A + B), A = κ²(p² + q²), B = 2kp(d_s² + d_p²), p = cy, q = ks². The derivative of log y with
    respect to log k is Y = −k²s²/y². k ∂R/∂k = RT(α − β), and the sum of its terms' magnitudes is

        S = RT [4k²/|κ| + (2p²|Y| + 2q²)/(p² + q²) + 1 + |Y| + 2(d_s(kc + y|Y|) + d_p ky(1 + |Y|))/(d_s² + d_p²)].

    In float64: Y by D′ (6 roundings) and √ (13); five steps of double words to A′ or B′, 13; T A′ − R B′ over A + B, 8;
    and the rounded y, which enters p, d_s, d_p, R, T with powers of 8.2 at most: 48.2 u S. In float32 everything but y,
    y′ and the result is exact to 2⁻²⁹: 8.2 + 1 + 1, and less than 0.3 for 2⁻⁵³ magnified by 1/T ≤ 1e6.
    """
    sin_i = np.sqrt((1 - certified.cos_i) * (1 + certified.cos_i))
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = k.astype(float) ** 2 * sin_i * (sin_i + 2 * certified.cos_i) / certified.cos_t**2
    return 1 + np.where(certified.transmitted, moved, 0)


def size_of_powers(certified: oracle.Certified, cos_i: np.ndarray, k: np.ndarray) -> np.ndarray:
    """Return S of `condition_of`, (N,); 0 for total internal reflection and at k = 1, where the derivative is 0."""
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
