"""Samples: `refract` against `dielectric`, one `bsdf.sample` at a time, in every variant of Mitsuba's wheel.

Rays come from outside and from inside, with both lobes and with each alone, for radiance and for importance. If both
plugins chose the same lobe, their directions, densities, weights and relative indices are compared entry by entry.
"""

from __future__ import annotations

import functools
from typing import Any

import drjit as dr
import numpy as np
from scipy import stats

from mi_refract.formulas import ROUNDING, cancelling
from mi_refract.report.row import Row
from validation import limits, repeated
from validation.run import seeds
from validation.run.bsdf_sampling import sample_all
from validation.run.context import Context
from validation.run.render_methods import under
from validation.study import Study, Task, about

NAME = "samples"
TERMS = {
    "lobe flips": "rays for which the two plugins chose different lobes; chance exceeds the budget once in 10⁶ runs",
    "wo / bound, pdf / bound, weight / bound": "the largest difference on a ray, divided by the bound for that ray, "
    "which the cancelling radicand of the built-in determines: it is wide near the critical angle, elsewhere a few "
    "roundings",
    "wo, pdf, eta, weight": "differences of the sample's entries: the largest, and the 99th percentile. Differences of "
    "Mueller matrices are multiplied by the smaller cos²θ, because the built-in recomputes the cosine of wi from wo by "
    "Snell's law, and divides the rounding error of this by the square of the cosine",
}
SEED = 2027
INT_IOR, EXT_IOR = 1.5, 1.0
LOBES = {"both lobes": 0xFFFFFFFF, "reflection": 0, "transmission": 1}
U = 2.0**-24
QUANTITIES = ("wo", "pdf", "eta", "weight")


def tasks(context: Context) -> list[Task]:
    """Return one task per variant of Mitsuba's wheel; `quick` has the run's variant only."""
    variants = {context.variant: None} if context.profile.quick else context.variants
    return [
        Task(f"samples: {variant}", functools.partial(_variant_rows, context, variant, reason))
        for variant, reason in variants.items()
    ]


def _variant_rows(context: Context, variant: str, reason: str | None) -> list[Row]:
    import mitsuba as mi

    if reason is not None:
        return [Row(NAME, "refract − dielectric", "all", variant, reason=reason)]
    with under(variant):
        count = context.profile.rays if dr.is_jit_v(mi.Float) else context.profile.scalar_rays
        return [_mode_row(getattr(mi.TransportMode, name), count, variant) for name in ("Radiance", "Importance")]


def _mode_row(mode: Any, count: int, variant: str) -> Row:
    import mitsuba as mi

    description = {"int_ior": INT_IOR, "ext_ior": EXT_IOR, "specular_reflectance": 0.9, "specular_transmittance": 0.8}
    ours, theirs = (mi.load_dict({"type": name, **description}) for name in ("refract", "dielectric"))
    rng = np.random.default_rng(seeds.current(SEED))
    wi = rng.normal(size=(count, 3))
    wi, sample1 = wi / np.linalg.norm(wi, axis=1, keepdims=True), rng.random(count)
    allowed, polarised = bounds(wi), bool(mi.is_polarized)
    differences: dict[str, list[np.ndarray]] = {name: [] for name in QUANTITIES}
    shares: dict[str, list[np.ndarray]] = {name: [] for name in allowed}
    flips = 0
    for component in LOBES.values():
        context = mi.BSDFContext(mode)
        context.component = component
        x, y = (sample_all(bsdf, context, wi, sample1) for bsdf in (ours, theirs))
        same = x["type"] == y["type"]
        flips += int((~same).sum())
        for name in QUANTITIES:
            # An impossible lobe (transmission under total internal reflection) has weight 0 and no direction. On CUDA
            # the built-in's weight may be a rounding error there.
            possible = np.minimum(*(np.abs(sample["weight"]).max(1) for sample in (x, y))) > 0
            used = same & possible if name == "wo" else same
            difference = np.nan_to_num(np.abs(x[name] - y[name]).max(1), nan=np.inf)
            if name in allowed:
                shares[name].append((difference / allowed[name])[used])
            if name == "weight" and polarised:
                difference *= np.minimum(wi[:, 2] ** 2, y["wo"][:, 2] ** 2)
            differences[name].append(difference[used])
    values = {"lobe flips": float(flips)}
    for name, parts in differences.items():
        d = np.concatenate(parts)
        values |= {f"{name} worst": float(d.max()), f"{name} p99": float(np.quantile(d, 0.99))}
    bounded = [name for name in allowed if name != "weight" or not polarised]
    values |= {f"{name} / bound": float(np.concatenate(shares[name]).max()) for name in bounded}
    budgets = dict.fromkeys((f"{name} / bound" for name in bounded), 1.0)
    budgets |= {"eta worst": limits.SAMPLE_ETA, "lobe flips": most_flips(float(allowed["pdf"].sum()))}
    budgets |= {f"{name} p99": limits.SAMPLE_P99 for name in ("wo", "pdf", "weight")}
    if polarised:  # a radicand on either side of the boundary, and its error in three factors of the weight
        budgets["weight worst"] = limits.SAMPLE_MUELLER * float(cancelling(2).radicand_error_bound(U, INT_IOR))
    replay = {"count": 3 * count, "seed": seeds.current(SEED), **description}
    return Row(NAME, "refract − dielectric", mode.name.lower(), variant, values, budgets, replay=replay)


def bounds(wi: np.ndarray) -> dict[str, np.ndarray]:
    """Return bounds of the differences of wo, pdf and weight between the two plugins, for each ray `wi` (N, 3).

    wo: the a-priori bound of a form with a cancelling radicand, plus that of `refract`. Let ρ be the error of
    y = cosθt in that form, y' = max(y − ρ, 0), and c = |cosθi|. T_s = 4kcy/(kc + y)² and T_p = 4kcy/(c + ky)², so

        |δR| ≤ 2kcρ [1/(kc + y')² + 1/(c + ky')²] + 16u,

    because |∂T_s/∂y| ≤ 4kc/(kc + y)², and likewise T_p. The 16u: each built-in amplitude is a quotient of two sums, 5u,
    its square 11u, their mean 12u; the error of `refract`'s R is u; |wi| is 1 up to u, with |∂R/∂ log c| ≤ 1; 1 − R is
    rounded. A weight is R, 1 − R or a constant, times at most 1 or k², where either plugin rounds 2.5 factors: 5u.
    """
    z = wi[:, 2].astype(np.float32).astype(float)
    c, k = np.abs(z), np.where(z > 0, EXT_IOR / INT_IOR, INT_IOR / EXT_IOR)
    radicand = 1 - k * k * (1 - c * c)
    y, transmitted = np.sqrt(np.maximum(radicand, 0)), radicand > 0
    form = cancelling(2)
    # If the radicand's error may change the decision, the error of y is its root, even for total internal reflection.
    near = transmitted | (-radicand <= form.radicand_error_bound(U, k))
    rho = np.where(near, form.of_root(U, k, y, near), 0)
    low = np.maximum(y - rho, 0)
    chord = form.of_terms(U, k, transmitted) + rho + ROUNDING.chord(U, k, y, transmitted)
    with np.errstate(divide="ignore"):
        power = 2 * k * c * rho * (1 / (k * c + low) ** 2 + 1 / (c + k * low) ** 2)
    pdf = np.minimum(power, 1) + 16 * U
    return {"wo": chord, "pdf": pdf, "weight": np.maximum(1, k * k) * (pdf + 5 * U)}


def most_flips(expected: float) -> float:
    """Return the number of lobe flips that chance exceeds with probability `limits.SAMPLE_FLIPS` at most.

    A ray flips if its random number is between the two densities: with probability |δR|, in total `expected`. The
    number of independent rare events exceeds a value at most as often as a Poisson variable of the same mean does
    (Hoeffding 1956).
    """
    return float(stats.poisson.isf(limits.SAMPLE_FLIPS, expected))


STUDY = Study(NAME, "Samples", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))
