"""Every formula against the certified answer in every regime, its edges, its bad inputs, and planted defects."""

import functools
import math

import drjit as dr
import numpy as np
import pytest

from mi_refract import oracle, reflect, reflect_sandwich, refract_2d
from mi_refract.accuracy import BUDGETS, evaluate, judge_formula
from mi_refract.formulas import FORMULAS
from mi_refract.regimes import REGIMES, Rays, make, radicand

COUNTS = {"scalar": 25, "llvm": 1000, "cuda": 1000}
EXACT = [name for name, formula in FORMULAS.items() if formula.budget.at_the_limit]
# Regimes whose normals are arbitrary, so that a test can choose them.
AROUND_A_NORMAL = [name for name, entry in REGIMES.items() if isinstance(entry.build, functools.partial)]
Z = [0.0, 0.0, 1.0]


@functools.cache
def certified(regime, count, precision, normal=None):
    rays = make(regime, count, precision, seed=7, normal=normal)
    return rays, oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)


def broken(subject, rays, exact, setting, budget):
    """The metrics of the judgement that exceed their budgets."""
    values = judge_formula(subject, rays, exact, setting.vector, budget).values()
    return {metric: values[metric] for metric, bound in BUDGETS.items() if not values[metric] <= bound}


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("name", FORMULAS)
def test_errors_are_within_the_budget_in_every_regime(name, regime, setting):
    if reason := setting.no_budget(FORMULAS[name].budget, regime):
        pytest.skip(reason)
    rays, exact = certified(regime, COUNTS[setting.backend], setting.precision)
    assert broken(FORMULAS[name], rays, exact, setting, FORMULAS[name].budget) == {}


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("name", EXACT)
def test_errors_are_within_the_budget_if_a_compiler_fuses_products_and_sums(name, regime, fused):
    if reason := fused.no_budget(FORMULAS[name].budget, regime):
        pytest.skip(reason)
    rays, exact = certified(regime, 1000, fused.precision)
    assert broken(FORMULAS[name], rays, exact, fused, FORMULAS[name].budget) == {}


def test_the_promoted_form_decides_right_beyond_2_to_the_minus_49_of_its_terms(float32):
    """Also at grazing incidence, where n·a is a sum of much larger products that cancel."""
    rays = make("critical, any k, to the ulp", 100_000, np.float32)
    _, exact, terms = radicand(*(x.T.astype(float) for x in (rays.a, rays.n, rays.k)))
    _, transmitted = evaluate(FORMULAS["promoted"], rays, float32.vector)
    assert (np.abs(exact[0]) / terms)[transmitted != (exact[0] >= 0)].max() < 2.0**-49


# Edges ---------------------------------------------------------------------------------------------------------


def single_ray(setting, formula, a, n, k, **kwargs):
    """(b, transmitted) of a single ray, as a numpy array and a bool."""
    vector = setting.vector
    k = dr.value_t(vector)(k)
    b, transmitted = formula(vector(*map(float, a)), vector(*map(float, n)), k, **kwargs)
    return np.array(b, dtype=float).ravel(), bool(np.array(transmitted).ravel()[0])


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("k", [0.5, 1.0, 1.5])
def test_rays_at_normal_incidence_and_along_the_surface_keep_their_direction(name, k, setting):
    for side in (-1.0, 1.0):
        b, transmitted = single_ray(setting, FORMULAS[name], (0, 0, side), Z, k)
        assert (b.tolist(), transmitted) == ([0, 0, side], True)
    b, transmitted = single_ray(setting, FORMULAS[name], (0.6, 0.8, 0), Z, k)
    assert (b.tolist(), transmitted) == ([setting.precision(0.6), setting.precision(0.8), 0], False)


@pytest.mark.parametrize("name", EXACT)
def test_the_critical_angle_is_transmitted_and_the_next_larger_ratio_is_reflected(name, setting):
    # sin θ = 4/5 and k = 5/4: the radicand is exactly 0.
    b, transmitted = single_ray(setting, FORMULAS[name], (4, 0, -3), Z, 1.25)
    assert (b.tolist(), transmitted) == ([5, 0, 0], True)
    b, transmitted = single_ray(setting, FORMULAS[name], (4, 0, -3), Z, np.nextafter(setting.precision(1.25), 2))
    assert (b.tolist(), transmitted) == ([4, 0, 3], False)


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, -1, 0)])
@pytest.mark.parametrize("regime", AROUND_A_NORMAL)
@pytest.mark.parametrize("name", EXACT)
def test_errors_are_within_the_budget_for_a_literal_normal(name, regime, axis, setting):
    """As in a local frame: for a literal normal both formulas take fewer steps."""
    rays, exact = certified(regime, COUNTS[setting.backend], setting.precision, axis)
    assert (rays.n == axis).all()
    literal = setting.vector(*map(float, axis))
    assert broken(lambda a, _, k: FORMULAS[name](a, literal, k), rays, exact, setting, FORMULAS[name].budget) == {}


@pytest.mark.parametrize("name", EXACT)
def test_a_matched_boundary_returns_the_same_bits(name, setting):
    """Also for a literal normal at any angle: in float32 the square of the cosine loses its low part below 1e-12, and
    underflows below 1e-19."""
    rays, count = make("generic", COUNTS[setting.backend], setting.precision, seed=3), COUNTS[setting.backend]
    cosine, axis = np.geomspace(1e-30, 1, count), setting.vector(*Z)
    low = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, -cosine], 1).astype(setting.precision)
    for a, formula in ((rays.a, FORMULAS[name]), (low, lambda x, _, k: FORMULAS[name].unchecked(x, axis, k))):
        b, transmitted = evaluate(formula, Rays(a, rays.n, np.ones_like(rays.k)), setting.vector)
        assert transmitted.all() and (b.astype(setting.precision) == a).all()


@pytest.mark.parametrize("name", FORMULAS)
def test_flipped_normals_and_powers_of_two_of_lengths_change_no_bit(name, setting):
    unit_regimes = [regime for regime, entry in REGIMES.items() if entry.unit and "denormal" not in regime]
    rays = Rays.joined([make(x, COUNTS[setting.backend] // 4, setting.precision, seed=21) for x in unit_regimes])
    b, transmitted = evaluate(FORMULAS[name], rays, setting.vector)
    i, j = np.random.default_rng(22).integers(-12, 12, (2, len(rays), 1), endpoint=True)
    cases = [(0, Rays(rays.a, -rays.n, rays.k))]
    cases += [(i, Rays(np.ldexp(rays.a, i), np.ldexp(rays.n, j), rays.k))] if name in EXACT else []
    for scale, changed in cases:
        b2, transmitted2 = evaluate(FORMULAS[name], changed, setting.vector)
        assert np.count_nonzero(transmitted != transmitted2) == np.count_nonzero(np.ldexp(b, scale) != b2) == 0


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize(("i", "j"), [(-59, -59), (-59, 59), (59, -59), (59, 59)])
def test_lengths_of_1e_18_to_1e18_change_no_bit(name, i, j, setting):
    cases = [(setting.vector, setting.precision), *([(dr.scalar.Array3f, np.float32)] if setting.is_scalar else [])]
    for vector, precision in cases:
        rays = make("generic", COUNTS[setting.backend], precision, seed=23)
        b, transmitted = evaluate(FORMULAS[name], rays, vector)
        stretched = Rays(np.ldexp(rays.a, i), np.ldexp(rays.n, j), rays.k)
        b2, transmitted2 = evaluate(FORMULAS[name], stretched, vector)
        assert (transmitted == transmitted2).all() and (np.ldexp(b, i) == b2).all()


@pytest.mark.parametrize("name", EXACT)
def test_the_contrast_is_used_if_the_ratio_has_lost_it(name, setting):
    contrast = 1e-9 if setting.precision is np.float32 else 1e-17
    a = np.array([[1.0, 0.0, -1e-3]], dtype=setting.precision)
    n = np.array([Z], dtype=setting.precision)
    k = np.ones(1, dtype=setting.precision)
    exact = oracle.refract(a, n, k, contrast=np.array([contrast]), progress=False)
    b, transmitted = single_ray(setting, FORMULAS[name], a[0], Z, 1, contrast=contrast)
    assert transmitted == exact.transmitted[0]
    length = math.sqrt(sum(float(x) ** 2 for x in a[0]))
    error = np.linalg.norm(b / length - exact.direction[0]) / setting.roundoff
    assert error <= 1.5
    moved = np.abs(exact.direction[0] * length - a[0]).max() / setting.roundoff
    assert moved > 1e-3  # the contrast does move the exact direction


RAY, NAN, INF = (0.6, 0, -0.8), math.nan, math.inf


@pytest.mark.parametrize("name", FORMULAS)
def test_invalid_input_gives_nan_and_false(name, setting):
    bad = [(a, Z, 1.5, {}) for a in ((NAN, 0, -1), (0, 0, INF), (0, -INF, -1), (0, 0, 0))]
    bad += [(RAY, n, 1.5, {}) for n in ((0, 0, 0), (0, NAN, 1), (0, 0, INF))]
    bad += [(RAY, Z, k, {}) for k in (0.0, -1.5, NAN, INF, 1e300, 1e-300)]
    bad += [(RAY, Z, 0.7, {"contrast": x}) for x in (NAN, INF, -1.0, -2.0) if name in EXACT]
    for a, n, k, contrast in bad:
        b, transmitted = single_ray(setting, FORMULAS[name], a, n, k, **contrast)
        assert np.isnan(b).all() and not transmitted, (a, n, k, contrast)


@pytest.mark.parametrize("name", FORMULAS)
def test_numpy_numbers_and_vectors_of_another_precision_are_accepted(name, setting):
    other = getattr(getattr(dr, setting.backend), "Array3f64" if setting.precision is np.float32 else "Array3f")
    a = setting.vector(0.6, 0, -0.8)
    b, transmitted = FORMULAS[name](a, other(0, 0, 1), np.float32(0.75))
    assert type(b) is setting.vector
    assert np.array(transmitted).all()
    assert np.array(b).ravel()[0] == pytest.approx(0.45)


# Reflection, the plane, derivatives ----------------------------------------------------------------------------


def test_reflection_reverses_the_normal_component(setting):
    rng, vector = np.random.default_rng(5), setting.vector
    for form in (reflect, reflect_sandwich) * 10:
        n, a = rng.normal(size=(2, 3))
        n /= np.linalg.norm(n)
        b = np.array(form(vector(*map(float, a)), vector(*map(float, n))), dtype=float).ravel()
        assert b == pytest.approx(a - 2 * n * (n @ a), abs=12 * setting.roundoff * np.linalg.norm(a))


@pytest.mark.parametrize("form", [reflect, reflect_sandwich])
@pytest.mark.parametrize("normal", [(0, 0, 1), [0, 0, 1], np.array([0.0, 0.0, 1.0])])
def test_the_normal_may_be_a_sequence(form, normal, vectorised):
    """Three rays, one normal: its components are not those of the rays."""
    a = vectorised.vector([0.5, 0.25, 0], [0, 0.5, 0.25], [-0.75, -0.5, 0.25])
    b = form(a, normal)
    assert type(b) is type(a) and dr.all(b == type(a)(a.x, a.y, -a.z), axis=None)


def test_refract_2d_obeys_snells_law_on_both_sides_of_a_slanted_boundary(setting):
    number = dr.value_t(setting.vector)
    for degrees in (10.0, 100.0, 190.0, 280.0):
        t = math.radians(degrees)
        line = math.cos(t), math.sin(t)
        for incidence in (20.0, 50.0, 160.0, 200.0, 330.0):
            s = t + math.radians(incidence)
            i = math.cos(s), math.sin(s)
            (x, y), transmitted = refract_2d((number(i[0]), number(i[1])), line, number(0.75))
            b = np.array([x, y], dtype=float).ravel()
            along, across = b @ line, line[0] * b[1] - line[1] * b[0]
            expected = 0.75 * (i[0] * line[0] + i[1] * line[1])
            assert bool(np.array(transmitted).ravel()[0])
            assert along == pytest.approx(expected, abs=8 * setting.roundoff)
            assert across * (line[0] * i[1] - line[1] * i[0]) > 0
            assert np.linalg.norm(b) == pytest.approx(1, abs=8 * setting.roundoff)


def derivative_in_the_ratio(name, setting, a, k, opaque=False):
    """db/dk at n = z, and whether the ray is transmitted."""
    vector = dr.diff_array_t(setting.vector)
    n, k = vector(0, 0, 1), dr.value_t(vector)(k)
    if opaque:
        dr.make_opaque(n)
    dr.enable_grad(k)
    b, transmitted = FORMULAS[name](vector(*a), n, k)
    dr.forward(k)
    return np.array(dr.grad(b)).ravel(), np.array(transmitted).any()


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("opaque", [False, True])
def test_derivatives_equal_those_of_the_closed_form(name, opaque, vectorised):
    """b = (k sin, 0, −√(1 − k² sin²)) at n = z; also at normal incidence, and for a literal normal."""
    u, vector = vectorised.roundoff, dr.diff_array_t(vectorised.vector)
    # Also at a matched boundary, where b is `a` bit for bit.
    for k in (0.7, *([1.0] if name in EXACT else [])):
        gradient, _ = derivative_in_the_ratio(name, vectorised, RAY, k, opaque)
        assert gradient == pytest.approx([0.6, 0, k * 0.36 / math.sqrt(1 - (k * 0.6) ** 2)], rel=0, abs=40 * u)
    gradient, transmitted = derivative_in_the_ratio(name, vectorised, (0.8, 0, -0.6), 1.5, opaque)
    assert (gradient.tolist(), transmitted) == ([0, 0, 0], False)
    # ∂b_x/∂n_x = −(k cos θ_i − cos θ_t), by the formula b = k a + n (…) at n = z
    expected = {"a": [0.75, 0, 0], "n": [0.75 * 0.8 - math.sqrt(1 - 0.45**2)]}
    for moved, ray in (("a", (0, 0, -1)), ("n", RAY)):
        vectors = {"a": vector(*ray), "n": vector(0, 0, 1)}
        if opaque:
            dr.make_opaque(vectors["n"])
        dr.enable_grad(vectors[moved])
        dr.backward(FORMULAS[name](**vectors, k=0.75)[0].x)
        gradient = np.array(dr.grad(vectors[moved])).ravel().tolist()
        assert gradient[: len(expected[moved])] == pytest.approx(expected[moved], abs=40 * u)


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("opaque", [False, True])
@pytest.mark.parametrize("length", [1e-17, 1e-9, 1e-6, 1e17])
def test_derivatives_are_right_for_any_length_of_the_ray(name, opaque, length, vectorised):
    """∂b/∂k grows like the length."""
    gradient, transmitted = derivative_in_the_ratio(name, vectorised, np.multiply(RAY, length).tolist(), 0.7, opaque)
    expected = [0.6, 0, 0.7 * 0.36 / math.sqrt(1 - 0.42**2)]
    assert transmitted and gradient / length == pytest.approx(expected, rel=0, abs=40 * vectorised.roundoff)


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("differentiated", ["n", "k"])
def test_rays_of_a_type_without_derivatives_have_those_of_the_others(name, differentiated, vectorised):
    vector = dr.diff_array_t(vectorised.vector)
    arguments = {"n": vector(0, 0, 1), "k": dr.value_t(vector)(0.75)}
    dr.enable_grad(arguments[differentiated])
    b = [FORMULAS[name](kind(0.6, 0, -0.8), **arguments)[0].x for kind in (vector, vectorised.vector)]
    gradients = []
    for x in b:
        dr.backward(x)
        gradients.append(np.array(dr.grad(arguments[differentiated])))
        dr.clear_grad(arguments[differentiated])
    assert gradients[0].any()
    np.testing.assert_array_equal(*gradients)
