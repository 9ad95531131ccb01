"""Energy: reflected and transmitted power against certified values, and the laws that they obey.

Errors of R, of 1 − R and of both amplitudes are relative, in units of roundoff u (2⁻²⁴ or 2⁻⁵³). A phase is a point on
the unit circle; its error is a distance. The exact values are for exactly the cosine and the ratio that a function
gets. Mitsuba's `mi.fresnel` is shown for comparison.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_refract import oracle, regimes
from mi_refract.accuracy import lengths
from mi_refract.formulas import AUTOMATIC, FORMULAS, fresnel
from mi_refract.report.row import Row
from validation import limits
from validation.reference.closed_forms import GRADE, hemispherical, nodes
from validation.run import seeds
from validation.run.array_settings import Setting, running, settings
from validation.run.bsdf_sampling import sample_all
from validation.run.context import Context
from validation.run.metrics import MISCLASSIFIED
from validation.study import Study, Task, about

NAME = "energy"
AXES = {"x": "|k − 1|", "y": "error of R, in u", "x_scale": "log", "y_scale": "log", "slope": -1}
BUILTIN = "mi.fresnel"
TERMS = {
    "powers": "R and T of `fresnel.powers`, with the cosine of `fresnel.refracted_cosine`",
    "pipeline": "R and T as the plugin computes them from `a`, with the decision of the default formula",
    "amplitudes": "`fresnel.amplitudes`",
    BUILTIN: "Mitsuba's function of the same cosine and k, from the inside; T is 1 − R, by subtraction",
    "R / u, 1 − R / u, r_s / u, r_p / u": "the largest relative errors, in units of roundoff",
    "phase / u": "the largest distance from the exact point on the unit circle, for total internal reflection",
    "R + T − 1 / u": "the largest deviation from 1",
    "nearer than rounding": "rays whose radicand is below 0.32u of its larger term; its rounding error may change T by "
    "more than u/2, so the errors exclude them",
    "T there and back / u": "T(θi, k)/T(θt, 1/k) − 1: T is the same in both directions",
    "weights in and out / u": "the product of the plugin's weights for radiance that enters and leaves, minus 1",
    "outside, inside": "relative error of the reflected and of the transmitted share of diffuse light, against the "
    "closed form; inside, total internal reflection is included",
    "white furnace": "the sum of weight times density of both lobes, which must be 1",
}
SEED = 2028
INDICES = (1.0003, 1.1, 1.33, 1.5, 2.42)
POWERS = {"R / u": limits.POWER, "1 − R / u": limits.POWER}
SUMMED = POWERS | {"R + T − 1 / u": limits.POWER_SUM}
AMPLITUDES = dict.fromkeys(("r_s / u", "r_p / u", "phase / u"), limits.AMPLITUDE)


# Regimes without denormal numbers: a backend that flushes these to 0 would get other rays.
CASES = [name for name, regime in regimes.REGIMES.items() if not regime.rests_on_denormals]


def tasks(context: Context) -> list[Task]:
    """Return one task per backend and precision, and one for the plugins."""
    by_setting = [Task(f"energy: {s.label}", functools.partial(setting_rows, context, s)) for s in settings(context)]
    plugins = functools.partial(plugin_rows, context)
    return [*by_setting, Task(f"energy: plugins, {context.variant}", plugins)]


def setting_rows(context: Context, setting: Setting) -> list[Row]:
    """Return rows of the powers and amplitudes in every regime, and of the laws."""
    if setting.vector is None:
        return [Row(NAME, name, "all", setting.label, reason=setting.reason) for name in ("powers", "amplitudes")]
    count = context.profile.scalar_rays // 3 if setting.is_scalar else context.profile.rays // 8
    rows = [row for regime in CASES for row in regime_rows(regime, setting, count)]
    rows += [diffuse_row(setting, index) for index in INDICES]
    return [*rows, reciprocity_row(setting, count), matched_row(setting)]


def drawn_rows(context: Context) -> list[Row]:
    """Return the rows that depend on the seed: in two regimes the cosine and k do not."""
    rows = [row for setting in running(context) for row in setting_rows(context, setting)]
    rows = [row for row in rows if "seed" in row.replay and row.case not in ("tangential", "exactly critical")]
    return [*rows, furnace_row(context, "refract")]


# Against certified values --------------------------------------------------------------------------------------


@seeds.cached
def regime_rays(regime: str, count: int, precision: type) -> tuple[np.ndarray, np.ndarray, oracle.Certified]:
    """Return the rounded (cos_i, k) of a regime's rays, and the certified answers for them."""
    rays = regimes.make(regime, count, precision, seeds.current(SEED))
    a, n = (v.astype(np.longdouble) for v in (rays.a, rays.n))
    cos_i = np.abs((a * n).sum(1)) / (lengths(a) * lengths(n))
    cos_i = np.minimum(cos_i, 1).astype(precision)
    return cos_i, rays.k, oracle.fresnel(cos_i, rays.k)


def evaluated(function: Callable[..., tuple[Any, ...]], setting: Setting, *numbers: np.ndarray) -> list[np.ndarray]:
    """Evaluate `function` for every lane; return numpy arrays: real or complex in extended precision, or masks."""
    if setting.is_scalar:
        lanes = [[to_numpy(x) for x in function(*map(float, lane))] for lane in zip(*numbers, strict=True)]
        return [np.array(x) for x in zip(*lanes, strict=True)]
    number = dr.value_t(setting.vector)
    results = function(*(number(x) for x in numbers))
    dr.eval(results)
    return [np.broadcast_to(to_numpy(x), len(numbers[0])) for x in results]


def to_numpy(x: Any) -> Any:
    """Convert a number of Dr.Jit to numpy, in extended precision."""
    if dr.is_complex_v(x):
        return np.array(x.real, np.longdouble) + 1j * np.array(x.imag, np.longdouble)
    array = np.array(x)
    return array if array.dtype == bool else array.astype(np.longdouble)


def formula_powers(cos_i: Any, k: Any) -> tuple[Any, ...]:
    """Return R, T and whether light is transmitted, by `mi_refract.formulas`, for a cosine and k."""
    cos_t, transmitted = fresnel.refracted_cosine(cos_i, k)
    return *fresnel.powers(cos_i, cos_t, transmitted, k), transmitted


def mitsuba_powers(variant: str | None) -> Callable[[Any, Any], tuple[Any, ...]]:
    """Return the same function of (cos_i, k) with Mitsuba's `fresnel` in a variant."""
    import mitsuba

    mi: Any = getattr(mitsuba, variant) if variant else mitsuba

    def powers(cos_i: Any, k: Any) -> tuple[Any, ...]:
        # From the inside: the index is k itself, without a reciprocal.
        r, cos_t, _, _ = mi.fresnel(-mi.Float(cos_i), mi.Float(k))
        return r, 1 - r, cos_t != 0

    return powers


def regime_rows(regime: str, setting: Setting, count: int) -> list[Row]:
    """Return rows of the powers, the amplitudes and, if Mitsuba runs here, its own function in a regime."""
    cos_i, k, exact = regime_rays(regime, count, setting.precision)
    replay = {"regime": regime, "text": regimes.REGIMES[regime].text, "count": count, "seed": seeds.current(SEED)}
    errors = power_errors(evaluated(formula_powers, setting, cos_i, k), exact, setting)
    budgets = SUMMED | {MISCLASSIFIED: 0.0}
    rows = [Row(NAME, "powers", regime, setting.label, errors, budgets, replay=replay)]
    # The certified amplitudes are doubles with relative errors of 2⁻⁵³ per part: float64 is allowed this much more.
    slack, u = float(setting.precision is np.float64), setting.roundoff
    values: dict[str, float] = {}
    computed = evaluated(fresnel.amplitudes, setting, cos_i, k)
    for name, r, certified in zip("sp", computed, (exact.amplitude_s, exact.amplitude_p), strict=True):
        size, error = np.maximum(np.abs(certified), np.finfo(setting.precision).tiny), np.abs(r - certified)
        values[f"r_{name} / u"] = worst((error / size)[exact.transmitted]) / u
        values["phase / u"] = max(values.get("phase / u", 0.0), worst(error[~exact.transmitted]) / u)
    budgets = {name: budget + slack for name, budget in AMPLITUDES.items()}
    rows.append(Row(NAME, "amplitudes", regime, setting.label, values, budgets, replay=replay))
    if setting.mitsuba:
        rows.append(pipeline_row(regime, setting, cos_i, k, replay))
        errors = power_errors(evaluated(mitsuba_powers(setting.mitsuba), setting, cos_i, k), exact, setting)
        rows.append(Row(NAME, BUILTIN, regime, setting.label, errors, replay=replay))
    return rows


def power_errors(
    results: list[np.ndarray], exact: oracle.Certified, setting: Setting, judged: Any = True
) -> dict[str, float]:
    """Return the errors of R, T and of the decision of `results` (R, T, transmitted), each (N,).

    `judged`: the rays whose errors of R and T count.
    """
    r, t, transmitted = results
    misclassified = transmitted != exact.transmitted
    right, u = judged & ~misclassified, setting.roundoff
    return {
        "R / u": worst(relative(r, exact.reflectance, exact.reflectance_low, setting)[right]) / u,
        "1 − R / u": worst(relative(t, exact.transmittance, exact.transmittance_low, setting)[right]) / u,
        "R + T − 1 / u": worst(np.abs(r + t - 1)) / u,
        MISCLASSIFIED: float(misclassified.sum()),
    }


def pipeline_row(regime: str, setting: Setting, cos_i: np.ndarray, k: np.ndarray, replay: dict[str, Any]) -> Row:
    """Return the row of R and T as the plugin computes them in the local frame, where `a` is unit up to rounding.

    The ratio is a double, as in the plugin.
    """
    azimuth = np.random.default_rng(seeds.current(SEED)).uniform(0, 2 * np.pi, len(k))
    sine = np.sqrt((1 - cos_i.astype(float)) * (1 + cos_i.astype(float)))
    a: Any = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cos_i], axis=1).astype(setting.precision)
    n: Any = np.tile(np.array([[0, 0, 1]], setting.precision), (len(k), 1))
    exact = oracle.refract(a, n, k, progress=False)
    formula = FORMULAS[AUTOMATIC]

    widened: Any = dr.float64_array_t(dr.value_t(setting.vector))

    def powers(x: Any, y: Any, z: Any, ratio: Any) -> tuple[Any, ...]:
        ray, wide = setting.vector(x, y, z), widened(ratio)
        contrast = dr.fma(wide, wide, -1)
        _, transmitted = formula.unchecked(ray, setting.vector(0, 0, 1), wide, contrast)
        return *fresnel.local_powers(ray, transmitted, wide, contrast), transmitted

    # An error of RADICAND changes T by less than u/2: by ε/2ρ, where ρ is the radicand over its larger term.
    x, y, z = a.astype(np.longdouble).T
    terms = np.maximum(z * z, np.abs(k.astype(np.longdouble) ** 2 - 1) * (x * x + y * y))
    far = exact.cos_t**2 * lengths(a) ** 2 > limits.RADICAND / setting.roundoff * terms
    far |= ~exact.transmitted
    values = power_errors(evaluated(powers, setting, *a.T, k), exact, setting, far)
    values |= {"nearer than rounding": float((~far).sum())}
    return Row(NAME, "pipeline", regime, setting.label, values, POWERS | {MISCLASSIFIED: 0.0}, replay=replay)


def relative(x: np.ndarray, exact: np.ndarray, low: np.ndarray, setting: Setting) -> np.ndarray:
    """Return |x/exact − 1|; for `exact` below the smallest normal number, |x − exact| over that number."""
    error: np.ndarray = np.abs((x - exact) - low) / np.maximum(np.abs(exact), np.finfo(setting.precision).tiny)
    return error.astype(float)


def worst(x: np.ndarray) -> float:
    """Return the largest value, with NaN as infinity; 0 for an empty array."""
    return float(np.nan_to_num(np.asarray(x, float), nan=np.inf).max(initial=0))


# Laws ----------------------------------------------------------------------------------------------------------


def reciprocity_row(setting: Setting, count: int) -> Row:
    """Return the row of reciprocity: exchanging cos_i with cos_t and k with 1/k changes no exact value of `powers`.

    The limit of 3u is two roundings of T and the rounding of 1/k, to which T is proportional at most.
    """
    back_error = 0.0

    def both(cos_i: Any, k: Any) -> tuple[Any, ...]:
        cos_t, transmitted = fresnel.refracted_cosine(cos_i, k)
        _, back = fresnel.powers(cos_t, cos_i, transmitted, 1 / k)
        return fresnel.powers(cos_i, cos_t, transmitted, k)[1], back, transmitted

    for regime in CASES:
        cos_i, k, exact = regime_rays(regime, count, setting.precision)
        forth, back, transmitted = evaluated(both, setting, cos_i, k)
        # A cosine of 0, or one whose square underflows in float32, has no way back.
        used = transmitted & (exact.transmittance > np.finfo(setting.precision).tiny)
        back_error = max(back_error, worst(np.abs(forth[used] / back[used] - 1)) / setting.roundoff)
    replay = {"regimes": CASES, "count": count, "seed": seeds.current(SEED)}
    values, budgets = {"T there and back / u": back_error}, {"T there and back / u": limits.RECIPROCITY}
    return Row(NAME, "powers", "reciprocity", setting.label, values, budgets, replay=replay)


def diffuse_row(setting: Setting, index: float) -> Row:
    """Return the row of the reflectance of diffuse light, by quadrature over the nodes of `closed_forms`.

    The two cosines of a node, k and κ are rounded: each changes R by at most 2.12u, beside the 4u of R itself. Inside,
    1/n² of the étendue belongs to transmitted light; the rest is reflected totally.
    """
    outside, inside, weight = nodes(index, setting.precision)
    values: dict[str, float] = {}
    budgets: dict[str, float] = {}
    contrast = (index - 1) * (index + 1)
    for side, cosines, k, kappa in (
        ("outside", (outside, inside), 1 / index, -contrast / index**2),
        ("inside", (inside, outside), index, contrast),
    ):
        r, t = evaluated(lambda c, y, k=k, kappa=kappa: fresnel.powers(c, y, y > 0, k, kappa), setting, *cosines)
        share = np.longdouble(1) if side == "outside" else 1 / np.longdouble(index) ** 2
        reflected, exact = share * (weight * r).sum() + (1 - share), hemispherical(index)[side]
        transmitted = share * (weight * t).sum()
        errors = {
            f"{side}: R / u": float(abs(reflected / exact - 1)) / setting.roundoff,
            f"{side}: 1 − R / u": float(abs(transmitted / (1 - exact) - 1)) / setting.roundoff,
        }
        values |= {f"{side}: R": float(reflected)} | errors
        budgets |= dict.fromkeys(errors, limits.DIFFUSE)
    case = f"diffuse light, n = {index}"
    return Row(NAME, "powers", case, setting.label, values, budgets, replay={"nodes": GRADE})


def matched_row(setting: Setting) -> Row:
    """Return the row of the error of R against |k − 1|, from one ulp on, at four cosines."""
    steps = np.geomspace(2 * setting.roundoff, 0.1, 40)
    cosines = (0.05, 0.3, 0.7, 1.0)
    grid: Any = np.meshgrid(1 - steps, cosines)
    k, cos_i = (x.ravel().astype(setting.precision) for x in grid)
    exact, curves = oracle.fresnel(cos_i, k), {}
    subjects = {"powers": formula_powers} | ({BUILTIN: mitsuba_powers(setting.mitsuba)} if setting.mitsuba else {})
    for name, subject in subjects.items():
        r = evaluated(subject, setting, cos_i, k)[0]
        error = relative(r, exact.reflectance, exact.reflectance_low, setting).reshape(len(cosines), -1).max(0)
        curves[name] = list(zip(steps.tolist(), (error / setting.roundoff).tolist(), strict=True))
    values = {"R / u": worst(np.array([y for _, y in curves["powers"]]))}
    replay = {"cosines": cosines}
    return Row(NAME, "powers", "k → 1", setting.label, values, {"R / u": limits.POWER}, replay=replay, curves=curves)


# Plugins -------------------------------------------------------------------------------------------------------


def plugin_rows(context: Context) -> list[Row]:
    """Return the rows of the white furnace and of basic radiance, for either plugin."""
    return [row(context, plugin) for plugin in ("refract", "dielectric") for row in (furnace_row, radiance_row)]


def furnace_row(context: Context, plugin: str) -> Row:
    """Return the row of the white furnace: without tints both weights are 1, so the sum is R + T, 1 up to an ulp.

    Half of the directions are uniform, half graze the surface.
    """
    import mitsuba as mi

    rng, count = np.random.default_rng(seeds.current(SEED)), context.profile.rays // 4 if dr.is_jit_v(mi.Float) else 30
    wi = rng.normal(size=(2 * count, 3))
    wi[count:, 2] *= 10.0 ** rng.uniform(-6, 0, count)
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    deviation, bsdf_context = 0.0, mi.BSDFContext(mi.TransportMode.Importance)
    for index in INDICES:
        bsdf = mi.load_dict({"type": plugin, "int_ior": index, "ext_ior": 1.0})
        lobes = [sample_all(bsdf, bsdf_context, wi, np.full(len(wi), s)) for s in (0.0, 1 - 2.0**-24)]
        first, second = (x["pdf"] * x["weight"][:, :1] for x in lobes)
        # For total internal reflection both samples are of the only lobe.
        single = (lobes[0]["type"] == lobes[1]["type"])[:, None]
        deviation = max(deviation, worst(np.abs(first + np.where(single, 0, second) - 1)))
    budgets = {"white furnace": limits.WHITE_FURNACE} if plugin == "refract" else {}
    replay = {"indices": INDICES, "directions": len(wi), "seed": seeds.current(SEED)}
    return Row(NAME, plugin, "white furnace", context.variant, {"white furnace": deviation}, budgets, replay=replay)


def radiance_row(context: Context, plugin: str) -> Row:
    """Return the row of basic radiance, radiance/n², which is the same on both sides.

    The weights are k² and 1/k², each with k rounded and squared: 3u.
    """
    import mitsuba as mi

    both, single, mode = [0.0], [0.0], mi.BSDFContext(mi.TransportMode.Radiance)
    for index in INDICES:
        bsdf = mi.load_dict({"type": plugin, "int_ior": index, "ext_ior": 1.0})
        wi = np.array([[0.6, 0, 0.8], [0, 0, 1.0]])
        entering = sample_all(bsdf, mode, wi, np.full(2, 1 - 2.0**-24))
        leaving = sample_all(bsdf, mode, entering["wo"], np.full(2, 1 - 2.0**-24))
        both.append(worst(np.abs(entering["weight"] * leaving["weight"] - 1)) / 2.0**-24)
        single.append(worst(np.abs(entering["weight"][:, 0] * index**2 - 1)) / 2.0**-24)
    values = {"weights in and out / u": max(both), "weight against 1/n² / u": max(single)}
    allowed = {"weights in and out / u": limits.IN_AND_OUT, "weight against 1/n² / u": limits.INDEX_SQUARED}
    budgets = allowed if plugin == "refract" else {}
    return Row(NAME, plugin, "basic radiance", context.variant, values, budgets, replay={"indices": INDICES})


RECORDS = BUILTIN, "dielectric"
STUDY = Study(NAME, "Energy", about(__doc__), TERMS, tasks, axes=AXES, again=drawn_rows, records=RECORDS)
