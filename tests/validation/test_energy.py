"""The studies of energy and of derivatives hold what they measure to its budget, and see planted defects."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from flint import acb, arb, ctx

from mi_refract import FORMULAS, oracle, regimes
from mi_refract.formulas import fresnel
from mi_refract.oracle import derivatives as oracle_derivative
from mi_refract.plugins import refract as bsdf
from validation import limits
from validation.reference import diffuse_fresnel
from validation.run import seeds
from validation.run.array_settings import settings
from validation.stability import derivative_conditions, derivatives, energy


@pytest.fixture
def context(scalar_context):
    return scalar_context(rays=800, scalar_rays=60)


def compiled(context):
    found = [s for s in settings(context) if s.vector is not None and not s.is_scalar]
    if not found:
        pytest.skip("no LLVM or CUDA here")
    return found


@pytest.fixture
def mitsuba_setting(context):
    setting = next((s for s in compiled(context) if s.mitsuba), None)
    return setting or pytest.skip("no variant of Mitsuba runs on compiled arrays here")


def by_case(rows):
    return {(row.subject, row.case): row for row in rows}


# The oracle's derivatives ----------------------------------------------------------------------------------------


def along(rays):
    rng = np.random.default_rng(4)
    return rng.normal(size=rays.a.shape), rng.normal(size=len(rays.k))


@pytest.mark.parametrize("name", ["generic", "grazing", "critical", "k ≫ 1", "matched, grazing"])
def test_certified_derivatives_obey_the_derivative_of_snells_law(name):
    """With n × b = k n × a and |b| = |a|: n × b' = k' n × a + k n × a', b·b' = a·a'; mirrored, k = 1."""
    rays = regimes.make(name, 60, np.float64, seed=6)
    a, n, k = rays.a, rays.n, rays.k
    e, e_k = along(rays)
    exact = oracle.refract(a, n, k, progress=False)
    found = oracle_derivative.derivative(a, n, k, e, e_k)
    ratio, change = (np.where(exact.transmitted, x, y)[:, None] for x, y in ((k, 1), (e_k, 0)))
    b = exact.direction * np.linalg.norm(a, axis=1, keepdims=True)
    size = np.maximum(1, np.linalg.norm(found, axis=1) * np.maximum(1, k))
    across = np.cross(n, found) - change * np.cross(n, a) - ratio * np.cross(n, e)
    assert (np.linalg.norm(across, axis=1) <= 1e-13 * size).all()
    assert (np.abs((b * found).sum(1) - (a * e).sum(1)) <= 1e-13 * size).all()


def test_certified_derivatives_are_what_differences_tend_to():
    rays = regimes.make("generic", 40, np.float64, seed=7)
    e, e_k = along(rays)
    found, h = oracle_derivative.derivative(rays.a, rays.n, rays.k, e, e_k), 1e-6
    inside = oracle.refract(rays.a, rays.n, rays.k, progress=False).cos_t > 0.05
    sides = []
    for step in (h, -h):
        a = rays.a + step * e
        moved = oracle.refract(a, rays.n, rays.k + step * e_k, progress=False)
        sides.append(moved.direction * np.linalg.norm(a, axis=1, keepdims=True))
    difference = (sides[0] - sides[1]) / (2 * h)
    assert difference[inside] == pytest.approx(found[inside], abs=2e-7 * np.abs(found[inside]).max())


def test_the_derivative_of_the_reflectance_is_what_differences_tend_to():
    cos_i, k, h = np.array([0.9, 0.3, 0.8, 0.6, 0.3]), np.array([1.5, 0.7, 1.2, 0.4, 1.5]), 1e-6
    for e_c, e_k in ((1.0, 0.0), (0.0, 1.0)):
        found = oracle_derivative.derivative_of_powers(cos_i, k, e_c, e_k)
        r = [oracle.fresnel(cos_i + s * e_c, k + s * e_k).reflectance for s in (h, -h)]
        assert (r[0] - r[1]) / (2 * h) == pytest.approx(found, rel=1e-7, abs=1e-9)
    assert found[4] == 0  # totally reflected


def test_there_is_no_derivative_at_the_critical_angle_and_none_of_a_tangential_ray():
    a, n = np.array([[0.6, 0, -0.8], [1.0, 0, 0]]), np.array([[0, 0, 1.0]] * 2)
    assert np.isnan(oracle_derivative.derivative(a[1:], n[1:], 1.5, a[1:], 0.0)).all()
    a = np.array([[4.0, 0, 3.0]])  # k² sin² = 1 for k = 5/4
    assert np.isnan(oracle_derivative.derivative(a, n[:1], 1.25, a, 0.0)).all()
    assert np.isfinite(oracle_derivative.derivative(a, n[:1], 1.25 + 1e-9, a, 0.0)).all()


# Energy ----------------------------------------------------------------------------------------------------------


def test_the_closed_form_of_diffuse_light():
    """Against its integral in balls, by Arb's own rigorous quadrature; and the number everybody prints."""
    assert diffuse_fresnel.hemispherical(1.5)["outside"] == pytest.approx(0.0918, abs=5e-5)
    for index in (1.1, 1.5, 2.42):
        with ctx.workprec(100):
            n = arb(index)

            def integrand(x, _, n=n):
                y = (x * x + n * n - 1).sqrt()
                s, p = (x - y) / (x + y), (y - n * n * x) / (y + n * n * x)
                return x * (s * s + p * p)

            exact = acb.integral(integrand, 0, 1).real
            found = diffuse_fresnel.hemispherical(index)["outside"]
            assert abs(float(exact - arb(float(found)) - arb(float(found - np.longdouble(float(found)))))) < 1e-18
            assert diffuse_fresnel.hemispherical(index)["inside"] == pytest.approx(
                1 - (1 - float(exact)) / index**2, rel=1e-15
            )


def test_energy_holds_on_scalars_and_absent_backends_say_so(context):
    rows = [row for task in energy.tasks(context) if "scalar" in task.name for row in task.run()]
    assert {row.verdict for row in rows} == {"pass", "info"}
    assert {row.subject for row in rows if row.verdict == "info"} == {"dielectric"}
    assert {"powers", "amplitudes", "refract"} <= {row.subject for row in rows}
    for setting in settings(context):
        if setting.vector is None:
            assert all(row.verdict == "not run" and row.reason for row in energy.setting_rows(context, setting))


def test_mitsubas_function_loses_its_digits_near_k_of_1(mitsuba_setting, context):
    found = by_case(energy.setting_rows(context, mitsuba_setting))
    assert found[energy.BUILTIN, "matched, grazing"].values["R / u"] > 1000
    assert set(found["powers", "k → 1"].curves) == {"powers", energy.BUILTIN}


POWERS = fresnel._powers


def differences(c, y, mirror, sin2, k, kappa):
    """As printed, with T by subtraction."""
    c, y, k = (getattr(x, "hi", x) for x in (c, y, k))
    s, p = (k * c - y) / (k * c + y), (c - k * y) / (c + k * y)
    r = dr.select(mirror == 1, 1, (s * s + p * p) / 2)
    return r, 1 - r


def inverted(c, y, mirror, sin2, k, kappa):
    return POWERS(c, y, mirror, sin2 * k, k, kappa)


def scaled_powers(factor):
    def powers(*arguments):
        r, t = POWERS(*arguments)
        return r, t * factor

    return powers


ODDS = fresnel.local_odds


def uneven(*arguments):
    r, t = ODDS(*arguments)
    return r, t * (1 + 3e-6)


@pytest.mark.parametrize(
    ("function", "defect", "seen"),
    [
        ("_powers", differences, {("powers", "matched, grazing"), ("powers", "k → 1")}),
        ("_powers", inverted, {("powers", "generic"), ("powers", "diffuse light, n = 1.5"), ("powers", "k → 1")}),
        ("_powers", scaled_powers(1 + 3e-6), {("powers", "generic"), ("powers", "diffuse light, n = 1.5")}),
        ("_powers", scaled_powers(math.nan), {("powers", "generic"), ("powers", "diffuse light, n = 1.5")}),
        ("local_odds", uneven, {("pipeline", "generic")}),
    ],
)
def test_defects_in_the_powers_are_seen(function, defect, seen, mitsuba_setting, context, monkeypatch):
    monkeypatch.setattr(fresnel, function, defect)
    rows = by_case(energy.setting_rows(context, mitsuba_setting))
    failed = {key for key, row in rows.items() if row.verdict == "fail"}
    assert seen <= failed


def test_light_that_does_not_come_back_the_same_way_is_seen(context, monkeypatch):
    setting = settings(context)[0]

    def one_way(c, *rest):
        r, t = POWERS(c, *rest)
        return r, t * (1 + 1e-14 * c.hi)

    monkeypatch.setattr(fresnel, "_powers", one_way)
    assert energy.reciprocity_row(setting, 20).verdict == "fail"


@pytest.mark.parametrize(("case", "weight"), [("white furnace", 1.000001), ("basic radiance", 1.00001)])
def test_a_plugin_that_gives_too_much_is_seen(case, weight, context, monkeypatch):
    """A `refract` whose weights are a millionth too large."""
    rows = {"white furnace": energy.furnace_row, "basic radiance": energy.radiance_row}
    assert rows[case](context, "refract").verdict == "pass"
    plugin = bsdf.plugin_class(mi.scalar_rgb)

    class Brighter(plugin):
        def sample(self, *arguments):
            bs, value = super().sample(*arguments)
            return bs, value * weight

    mi.register_bsdf("refract_brighter", Brighter)
    monkeypatch.setattr(mi, "load_dict", lambda d, load=mi.load_dict: load(d | {"type": "refract_brighter"}))
    assert rows[case](context, "refract").verdict == "fail"


# Derivatives -----------------------------------------------------------------------------------------------------


def test_forms_at_the_limit_keep_the_digits_that_the_common_form_loses(context):
    for setting in compiled(context):
        rows = by_case(derivatives.setting_rows(context, setting))
        limit = {name for name, formula in FORMULAS.items() if formula.budget.at_the_limit}
        for (subject, _), row in rows.items():
            assert row.verdict == ("pass" if subject in limit | {"powers"} else "info"), (row.name, row.values)
        curves = rows["the problem", "∂b/∂k"].curves
        assert set(curves) == {*FORMULAS, "condition · u"}
        assert curves["decomposed"][0][1] > 100 * curves["promoted"][0][1]  # near the critical angle


def test_what_has_no_derivatives_says_so(context):
    for setting in settings(context):
        if setting.is_scalar or setting.vector is None:
            rows = derivatives.setting_rows(context, setting)
            assert {row.subject for row in rows} == {*FORMULAS, "powers"}
            assert all(row.verdict == "not run" and row.reason for row in rows)


def scaled(a, n, k):
    """The right direction with the derivative of another one."""
    b, transmitted = FORMULAS["promoted"](a, n, k)
    return dr.replace_grad(b, b * 1.00001), transmitted


def unsafe(a, n, k):
    """The right direction plus a root that is 0, where its derivative is infinite."""
    b, transmitted = FORMULAS["promoted"](a, n, k)
    return b + n * dr.sqrt(k - dr.detach(k)), transmitted


@pytest.mark.parametrize(("defect", "metric"), [(scaled, "error / condition"), (unsafe, "not finite")])
def test_wrong_derivatives_are_seen(defect, metric, context):
    setting = compiled(context)[0]
    given = derivatives.inputs(20, setting.precision)
    rows, _ = derivatives.formula_rows("promoted", defect, given, setting)
    assert all(metric in row.broken for row in rows if row.case == "∂b/∂k")


def test_a_contrast_that_is_detached_is_seen(context, monkeypatch):
    """∂R/∂η through the cosine and k alone."""
    setting = compiled(context)[0]
    given = derivatives.inputs(20, setting.precision)
    assert derivatives.reflectance_row(given, setting).verdict == "pass"
    monkeypatch.setattr(fresnel, "_powers", lambda *x: POWERS(*x[:-1], dr.detach(x[-1])))
    assert "error / condition" in derivatives.reflectance_row(given, setting).broken


@pytest.mark.parametrize("k", [882668.0, 30000.0])
def test_the_derivative_of_the_reflectance_keeps_its_digits_near_the_critical_angle(k, context):
    """1 − k² sin²θ between 1e-6 and 0.5 at sin θ = √(…)/k: 2k cos²θ − 2k would lose 1/sin²θ = k² times u."""
    setting = next((s for s in compiled(context) if s.precision is np.float64), None)
    if setting is None:
        pytest.skip("no compiled float64 here")
    sine = np.sqrt(1 - np.geomspace(1e-6, 0.5, 40)) / k
    cos_i, ratio = np.sqrt((1 - sine) * (1 + sine)), np.full(40, k)
    exact = oracle_derivative.derivative_of_powers(cos_i, ratio, 0.0, ratio)
    certified = oracle.fresnel(cos_i, ratio)
    number = dr.value_t(dr.diff_array_t(setting.vector))

    def reflectance(k):
        cos_t, transmitted = fresnel.refracted_cosine(number(cos_i), k)
        return fresnel.powers(number(cos_i), cos_t, transmitted, k)[0]

    found = np.array(derivatives.forward(reflectance, number(ratio), number(ratio))[1])
    size = derivative_conditions.size_of_powers(certified, cos_i, ratio)
    assert (np.abs(found - exact) <= limits.REFLECTANCE["float64"] * setting.roundoff * size).all()
    assert (np.abs(found - exact) <= 1e-9 * np.abs(exact)).sum() > 20


def test_derivatives_hold_for_other_seeds(context):
    compiled(context)  # the study draws rays for compiled settings only
    for shift in (1, 2, 3):
        with seeds.shifted(shift):
            rows = derivatives.drawn_rows(context)
        assert rows and [row.name for row in rows if row.verdict != "pass"] == []


@pytest.mark.parametrize(("case", "scale"), [("∂b/∂k", 0.0), ("étendue", 1e-5)])
def test_a_derivative_that_is_off_by_little_is_seen_at_every_length(case, scale, context):
    """Of the étendue also where k ≪ 1 and an absolute error would hide it."""
    setting = compiled(context)[0]
    given = derivatives.inputs(20, setting.precision)
    small = given.rays.k < 1e-3
    along, exact = ({name: x[small] for name, x in part.items()} for part in (given.along, given.exact))
    certified = derivatives.pick(given.certified, small)
    kept = derivatives.Inputs(given.rays[small], along, exact, certified, given.condition[small], given.regime[small])

    def spoilt(a, n, k):
        b, transmitted = FORMULAS["compensated"](a, n, k)
        return dr.replace_grad(b, b * (1 + scale)), transmitted

    rows, _ = derivatives.formula_rows("compensated", spoilt, kept, setting)
    assert next(r for r in rows if r.case == case).verdict == ("fail" if scale else "pass")
    unjudged = np.zeros(len(kept.rays.k), bool)  # misclassified rays are none of the derivative's
    values = derivatives.row("x", "y", np.full(len(unjudged), np.nan), kept, setting, unjudged, {}).values
    assert values == {"error / condition": 0, "error": 0, "not finite": 0}
