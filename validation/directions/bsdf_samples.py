"""Samples: `refract` against `dielectric`, one `bsdf.sample` at a time, in every variant that Mitsuba's wheel offers.

Rays come from outside and from inside, with both lobes and with each alone, for radiance and for importance. Where both
plugins chose the same lobe, their directions, densities, weights and relative indices are compared entry by entry.
"""

from __future__ import annotations

import functools
from typing import Any

import drjit as dr
import numpy as np

from mi_refract.formulas import cancelling
from mi_refract.report.row import Row
from validation import limits
from validation.run import seeds
from validation.run.bsdf_sampling import sample_all
from validation.run.context import Context
from validation.study import Study, Task, about

NAME = "samples"
TERMS = {
    "lobe flips": "rays for which the two plugins chose different lobes",
    "wo, pdf, eta, weight": "differences of the sample's entries: the largest, and that of the 99th percentile. "
    "Those of Mueller matrices are multiplied by the smaller cos²θ, because the built-in recomputes the cosine of wi "
    "from wo by Snell's law, and divides by its square the digits that are lost in this",
}
SEED = 2027
INT_IOR, EXT_IOR = 1.5, 1.0
LOBES = {"both lobes": 0xFFFFFFFF, "reflection": 0, "transmission": 1}
QUANTITIES = ("wo", "pdf", "eta", "weight")


def tasks(context: Context) -> list[Task]:
    """One per variant of Mitsuba's wheel; in the profile `quick` that of the run."""
    variants = {context.variant: None} if context.profile.quick else context.variants
    return [
        Task(f"samples: {variant}", functools.partial(_variant_rows, context, variant, reason))
        for variant, reason in variants.items()
    ]


def _variant_rows(context: Context, variant: str, reason: str | None) -> list[Row]:
    import mitsuba as mi

    if reason is not None:
        return [Row(NAME, "refract − dielectric", "all", variant, reason=reason)]
    mi.set_variant(variant)
    try:
        count = context.profile.rays if dr.is_jit_v(mi.Float) else context.profile.scalar_rays
        return [_mode_row(mode, name, count, variant) for mode, name in _modes()]
    finally:
        mi.set_variant(context.variant)


def _modes() -> list[tuple[Any, str]]:
    import mitsuba as mi

    return [(mi.TransportMode.Radiance, "radiance"), (mi.TransportMode.Importance, "importance")]


def _mode_row(mode: Any, mode_name: str, count: int, variant: str) -> Row:
    import mitsuba as mi

    description = {"int_ior": INT_IOR, "ext_ior": EXT_IOR, "specular_reflectance": 0.9, "specular_transmittance": 0.8}
    ours, theirs = (mi.load_dict({"type": name, **description}) for name in ("refract", "dielectric"))
    rng = np.random.default_rng(seeds.current(SEED))
    wi = rng.normal(size=(count, 3))
    wi, sample1 = wi / np.linalg.norm(wi, axis=1, keepdims=True), rng.random(count)
    differences: dict[str, list[np.ndarray]] = {name: [] for name in QUANTITIES}
    flips = 0
    for component in LOBES.values():
        context = mi.BSDFContext(mode)
        context.component = component
        x, y = (sample_all(bsdf, context, wi, sample1) for bsdf in (ours, theirs))
        same = x["type"] == y["type"]
        flips += int((~same).sum())
        for name in QUANTITIES:
            # A lobe that cannot be (transmission under total internal reflection) has weight 0 and no direction.
            used = same & (np.abs(y["weight"]).max(1) > 0) if name == "wo" else same
            difference = np.abs(x[name] - y[name]).max(1)
            if name == "weight" and mi.is_polarized:
                difference *= np.minimum(wi[:, 2] ** 2, y["wo"][:, 2] ** 2)
            differences[name].append(difference[used])
    values = {"lobe flips": float(flips)}
    for name, parts in differences.items():
        d = np.nan_to_num(np.concatenate(parts), nan=np.inf)
        values |= {f"{name} worst": float(d.max()), f"{name} p99": float(np.quantile(d, 0.99))}
    # The built-in's radicand cancels: the a-priori bound of such a form, and a few roundings for 99 rays of 100.
    bound = float(cancelling(2).chord(2.0**-24, INT_IOR))
    budgets = {f"{name} worst": bound for name in ("wo", "pdf", "weight")}
    budgets |= {"eta worst": limits.SAMPLE_ETA, "lobe flips": limits.SAMPLE_FLIPS * count}
    budgets |= {f"{name} p99": limits.SAMPLE_P99 for name in ("wo", "pdf", "weight")}
    if mi.is_polarized:  # a radicand on either side of the boundary, and its error in three factors of the weight
        budgets["weight worst"] = limits.SAMPLE_MUELLER * float(cancelling(2).radicand_error_bound(2.0**-24, INT_IOR))
    replay = {"count": 3 * count, "seed": seeds.current(SEED), **description}
    return Row(NAME, "refract − dielectric", mode_name, variant, values, budgets, replay=replay)


STUDY = Study(NAME, "Samples", about(__doc__), TERMS, tasks, again=seeds.by_tasks(tasks))
