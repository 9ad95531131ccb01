"""Refracted directions at the index of a wavelength, ray by ray, against the certified oracle.

Each material is evaluated at random wavelengths of its range. In float32 the BSDF is sampled as by `refract_path`; in
float64 a formula is called with the ratio of indices. The certified answer is for the same ratio in float64. Rounding
errors of the index are reported separately: the dispersion formula is evaluated again in ball arithmetic. In float32,
the ratio that scales the ray's tangential component is rounded, which changes the direction by up to u.
"""

from __future__ import annotations

import functools
from typing import Any

import drjit as dr
import numpy as np

from mi_refract import media, oracle
from mi_refract.accuracy import BUDGETS, RayBounds, evaluate, judge
from mi_refract.formulas import AUTOMATIC, FORMULAS
from mi_refract.media import Medium
from mi_refract.plugins.refract import followed_context
from mi_refract.regimes import Rays
from mi_refract.report.row import Row
from validation import repeated
from validation.limits import INDEX_ROUNDING
from validation.run import seeds
from validation.run.array_settings import running
from validation.run.context import Context
from validation.run.render_methods import under
from validation.study import Study, Task, about

NAME = "directions by wavelength"
SPECTRAL = "llvm_ad_spectral"
SEED = 1717
N_SF11 = "sellmeier(1.73759695, 0.313747346, 1.89878101, 13188.707, 62306.8142, 155236290)"
MATERIALS = (
    "cauchy(1.5046, 4200)",
    N_SF11,
    "abbe(1.5168, 64.17)",
    "table(380: 1.54, 480: 1.52, 600: 1.51, 780: 1.50)",
    "MATERIAL:water",
    "MATERIAL:diamond",
    "SCHOTT:N-BK7",
)
TERMS = {
    "worst / u": "the largest distance of a direction from the certified one, in units of the roundoff u",
    "with the ratio in float32": "the same, including the rounding of the ratio, which the other metrics exclude",
    "error / bound": "the largest ratio of a direction's error to the formula's a-priori bound for that ray",
    "TIR misclassified, beyond its bound": "number of rays",
    "index error / u": "relative error of the index in u = 2⁻⁵³, without the rounding of its coefficients",
}


SUBJECTS = {N_SF11: "sellmeier(…), N-SF11", MATERIALS[3]: "table(…)"}  # short names of long texts


def tasks(context: Context) -> list[Task]:
    """Return one task per material."""
    return [Task(f"{NAME}: {spec}", functools.partial(rows, context, spec)) for spec in MATERIALS]


def rows(context: Context, spec: str) -> list[Row]:
    """Of the index, of the BSDF, and of a formula in each setting with float64."""
    row = functools.partial(Row, NAME, SUBJECTS.get(spec, spec))
    medium, count = media.parse(spec), context.profile.rays
    missing = context.variants.get(SPECTRAL, "not in this wheel")
    table = [index_row(medium, spec)]
    table.append(row("refract", SPECTRAL, reason=missing) if missing else sampled_row(medium, spec, count))
    setting: Any
    for setting in running(context):
        if setting.precision is np.float64:
            rays = Drawn(medium, 100 if setting.is_scalar else count)
            name, formula = "compensated", FORMULAS["compensated"]
            values = judged(*evaluate(formula, rays.rays, setting.vector), rays.rays, name, 2.0**-53)
            table.append(row(name, setting.label, values, dict(BUDGETS), replay=rays.replay | {"medium": spec}))
    return table


class Drawn:
    """Random rays of a medium: unit wi (count, 3) from both sides, and wavelengths in nm; both are exact in float32.

    `rays`: the same rays with k = n_from/n_to in float64.
    """

    def __init__(self, medium: Medium, count: int) -> None:
        """Draw `count` rays."""
        rng = np.random.default_rng(seeds.current(SEED))
        wi = rng.normal(size=(count, 3))
        self.wi = (wi / np.linalg.norm(wi, axis=1, keepdims=True)).astype(np.float32).astype(float)
        low, high = max(medium.valid[0], 360.0), min(medium.valid[1], 830.0)
        self.wavelengths = rng.uniform(low + 0.01, high - 0.01, count).astype(np.float32).astype(float)
        eta = medium.index(self.wavelengths)
        k = np.where(self.wi[:, 2] >= 0, 1 / eta, eta)
        self.rays = Rays(-self.wi, np.tile([0.0, 0.0, 1.0], (count, 1)), k)
        self.replay = {"seed": seeds.current(SEED), "rays": count}


def judged(b: np.ndarray, transmitted: np.ndarray, rays: Rays, formula: str, u: float) -> dict[str, float]:
    """Return the values of a row."""
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    verdict = judge(b, transmitted, RayBounds(rays, exact, FORMULAS[formula].budget, u), exact.transmitted)
    compared = verdict.compared & exact.transmitted
    return {"worst / u": float(verdict.chord[compared].max() / u)} | verdict.values()


def sampled_row(medium: Medium, spec: str, count: int) -> Row:
    """Return the row of `refract`, sampled as by `refract_path`, in float32."""
    import mitsuba as mi

    drawn = Drawn(medium, count)
    with under(SPECTRAL):
        bsdf = mi.load_dict({"type": "refract", "int_ior": spec, "ext_ior": 1.0})
        bsdf_context = followed_context()
        bsdf_context.component = 1
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = mi.Vector3f(drawn.wi.T.astype(np.float32))
        si.wavelengths = type(si.wavelengths)(mi.Float(drawn.wavelengths.astype(np.float32)))
        bs, weight = bsdf.sample(bsdf_context, si, 0.5, [0.5, 0.5])
        b, transmitted = np.array(bs.wo, float).T.astype(np.longdouble), np.array(weight, float)[0] > 0
    k = drawn.rays.k
    rounding = (k.astype(np.float32).astype(float) - k)[:, None] * drawn.rays.a * [1, 1, 0]
    values = judged(b - rounding, transmitted, drawn.rays, AUTOMATIC, 2.0**-24)
    values["with the ratio in float32"] = judged(b, transmitted, drawn.rays, AUTOMATIC, 2.0**-24)["worst / u"]
    replay = drawn.replay | {"int_ior": spec}
    return Row(NAME, SUBJECTS.get(spec, spec), "refract", SPECTRAL, values, dict(BUDGETS), replay=replay)


def index_row(medium: Medium, spec: str) -> Row:
    """Return the row of the dispersion formula against the same formula in ball arithmetic."""
    from flint import arb

    wavelengths = Drawn(medium, 200).wavelengths.tolist()
    errors = [abs(float(exact_index(medium, w) / arb(medium.index(w)) - 1)) for w in wavelengths]
    values = {"index error / u": float(np.max(errors)) / 2.0**-53}
    return Row(NAME, SUBJECTS.get(spec, spec), "index", "float64", values, {"index error / u": INDEX_ROUNDING})


def exact_index(medium: Medium, wavelength: float) -> Any:
    """Return the index in ball arithmetic, from the float64 coefficients."""
    from flint import arb, ctx

    ctx.prec = 200
    c = {name: arb(x) for name, x in medium.coefficients.items()}
    form: Any = medium.dispersion
    w = arb(wavelength)
    if hasattr(form, "knots"):
        i = next(i for i in range(1, len(form.knots)) if wavelength <= form.knots[i])
        (a, b), (one, two) = ((arb(x) for x in form.knots[i - 1 : i + 1]), (c[x] for x in form.names[i - 1 : i + 1]))
        return one + (two - one) * (w - a) / (b - a)
    if "V_d" in c:
        d, f, r = (arb(media.LINES[line]) ** -2 for line in "dFC")
        return c["n_d"] + (c["n_d"] - 1) / c["V_d"] * (w**-2 - d) / (f - r)
    total = arb(form.constant) + sum((c[name] * w**p for name, p in form.powers), arb(0))
    for b_name, r_name in form.resonances:
        pole = c[r_name] ** 2 if form.squared else c[r_name]
        total += c[b_name] * w**2 / (w**2 - pole)
    return total if form.power == 1 else total.sqrt()


STUDY = Study(NAME, "Directions by wavelength", about(__doc__), TERMS, tasks, again=repeated.by_tasks(tasks))
