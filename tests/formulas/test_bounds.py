"""Error bounds of single rays: the root and its inverse, extreme ratios, the side of the surface."""

import numpy as np
import pytest

from mi_refract import oracle, regimes
from mi_refract.accuracy import evaluate, judge_formula
from mi_refract.formulas import FORMULAS, LARGEST_RATIO, ROUNDING, SMALLEST_RATIO, Budget, radicand_for
from mi_refract.formulas.bounds import root

U = 2.0**-53


@pytest.mark.parametrize("cos_t", [0.0, 1e-12, 1e-9, 1e-3, 0.5, 1.0])
def test_the_bound_of_the_root_is_tight_and_has_an_inverse(cos_t):
    """Against the definition |√(D + e) − √D|, and `radicand_for` as the inverse."""
    for x in (1e-15, 1e-6, 1e-3, 0.3):
        e = np.linspace(-min(x, cos_t**2), x, 1001)
        with np.errstate(invalid="ignore"):
            change = np.abs(e / (np.sqrt(cos_t**2 + e) + cos_t))  # |√(D + e) − √D|
        assert 0.6 * root(x, cos_t) <= np.nanmax(change) <= root(x, cos_t) * (1 + 1e-12)
    for error in (0.0, 1e-12, 1e-3, 2.0):
        assert root(radicand_for(np.array(error), cos_t), cos_t) == pytest.approx(error, rel=1e-6)


def test_a_bound_grows_with_the_ratio_of_transmitted_rays_and_allows_either_side():
    budget = Budget(10, 14, 2)
    assert budget.chord(U, 0.5, 1.0) == pytest.approx((10 + 7) * U, rel=1e-6)
    assert budget.chord(U, 100.0, 1.0) == pytest.approx((1000 + 7e4) * U, rel=1e-6)
    assert budget.chord(U, 100.0, transmitted=False) == 10 * U
    assert budget.chord(U, 1.0) == pytest.approx(10 * U + np.sqrt(14 * U))
    assert (ROUNDING.chord(U, 1e6), ROUNDING.chord(U, 1e6, unit=False)) == (0.8724 * U, 1.005 * U)
    assert budget.chord(U, 1.0, 1.0, unit=False) == budget.chord(U, 1.0, 1.0)
    open_side, known = Budget(10, side=4), Budget(10)
    assert open_side.chord(U, 0.5, 0.8, cos_i=4 * U) == 10 * U + 1.6
    assert open_side.chord(U, 0.5, 0.8, cos_i=5 * U) == known.chord(U, 0.5, 0.8, cos_i=0.0) == 10 * U


@pytest.mark.parametrize("end", [SMALLEST_RATIO, LARGEST_RATIO])
@pytest.mark.parametrize("name", FORMULAS)
def test_bounds_hold_at_the_smallest_and_largest_ratio_and_other_ratios_give_nan(name, end, setting):
    """Ratios within a factor of two of either end, with a uniform sine of the refracted angle."""
    rng, count = np.random.default_rng(6), 40 if setting.is_scalar else 4000
    n, k = rng.normal(size=(count, 3)), end * rng.uniform(*((0.5, 1) if end > 1 else (1, 2)), count)
    k[0], n = end, n / np.linalg.norm(n, axis=1, keepdims=True)
    t = np.cross(n, rng.normal(size=(count, 3)))
    sine = rng.uniform(0, 1, (count, 1)) / np.maximum(k, 1)[:, None]
    a = sine * t / np.linalg.norm(t, axis=1, keepdims=True) - np.sqrt(1 - sine * sine) * n
    rays = regimes.Rays(*(x.astype(setting.precision) for x in (a, n, k)))
    exact, formula = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False), FORMULAS[name]
    judgement = judge_formula(formula, rays, exact, setting.vector, formula.budget)
    assert not judgement.wrong.any() and exact.transmitted.sum() > count / 2
    beyond = regimes.Rays(rays.a, rays.n, rays.k * setting.precision(2 if end > 1 else 0.5))
    b, transmitted = evaluate(formula, beyond, setting.vector)
    assert np.isnan(b[0]).all() and not transmitted[0]
