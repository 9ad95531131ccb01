"""Error-free transforms against rational arithmetic."""

from fractions import Fraction

import drjit as dr
import numpy as np
import pytest

from mi_refract import numerics
from mi_refract.numerics import Double

RNG = np.random.default_rng(11)


def exact(x):
    return Fraction(float(np.array(x).ravel()[0]))


def value(pair):
    hi, lo = (pair.hi, pair.lo) if isinstance(pair, Double) else pair
    return exact(hi) + exact(lo)


@pytest.fixture
def number(setting):
    return float if setting.backend == "scalar" else dr.value_t(setting.vector)


def draw(setting, count=3):
    """Numbers over many magnitudes, representable in the precision."""
    scale = 2.0 ** RNG.integers(-20, 20, count)
    return [float(setting.precision(x)) for x in RNG.normal(size=count) * scale]


@pytest.mark.parametrize("trial", range(10))
def test_sums_and_products_lose_nothing(trial, setting, number):
    x, y, _ = draw(setting)
    assert value(numerics.two_sum(number(x), number(y))) == Fraction(x) + Fraction(y)
    assert value(numerics.two_prod(number(x), number(y))) == Fraction(x) * Fraction(y)
    big, small = sorted((x, y), key=abs, reverse=True)
    assert value(numerics.fast_two_sum(number(big), number(small))) == Fraction(x) + Fraction(y)


def cancelling(setting, number):
    """Two vectors whose dot product is tiny beside its terms."""
    x, y = draw(setting), draw(setting)
    y[2] = float(setting.precision(-(x[0] * y[0] + x[1] * y[1]) / x[2]))
    return x, y, [number(v) for v in x], [number(v) for v in y]


@pytest.mark.parametrize("trial", range(10))
def test_dot_and_cross_survive_cancellation(trial, setting, number):
    x, y, u, v = cancelling(setting, number)
    fx, fy = [Fraction(c) for c in x], [Fraction(c) for c in y]
    terms = [a * b for a, b in zip(fx, fy, strict=True)]
    assert abs(value(numerics.dot(u, v)) - sum(terms)) <= 12 * Fraction(setting.roundoff) ** 2 * sum(map(abs, terms))
    for i, component in enumerate(numerics.cross(u, v)):
        j, k = (i + 1) % 3, (i + 2) % 3
        expected = fx[j] * fy[k] - fx[k] * fy[j]
        assert abs(value(component) - expected) <= 6 * Fraction(setting.roundoff) ** 2 * abs(expected)


def test_a_dot_product_that_is_zero_is_zero_and_one_that_is_not_is_not(setting, number):
    tiny = float(setting.precision(setting.roundoff**2))
    ones = [number(x) for x in (1.0, 1.0, 1.0)]
    assert exact(numerics.dot(ones, [number(x) for x in (1.0, -1.0, 0.0)]).hi) == 0
    assert exact(numerics.dot(ones, [number(x) for x in (1.0, -1.0, tiny)]).hi) == Fraction(tiny)


@pytest.mark.parametrize("trial", range(10))
def test_double_words_keep_five_units_of_the_second_order(trial, setting, number):
    bound = 5 * Fraction(setting.roundoff) ** 2
    a, b, c = draw(setting)
    x, y = Double.product(number(a), number(b)), Double.product(number(c), number(a))
    fx, fy = Fraction(a) * Fraction(b), Fraction(c) * Fraction(a)
    for found, expected in ((x + y, fx + fy), (x - y, fx - fy), (x * y, fx * fy), (x * number(c), fx * Fraction(c))):
        assert abs(value(found) - expected) <= bound * abs(expected)
    square = x * x
    assert abs(value(square.sqrt()) ** 2 - value(square)) <= 4 * bound * value(square)


def test_sum_of_squares_and_defect(setting, number):
    x, y, u, v = cancelling(setting, number)
    w = numerics.cross(u, v)
    expected = sum(value(c) ** 2 for c in w)
    assert abs(value(numerics.sum_of_squares(w)) - expected) <= 12 * Fraction(setting.roundoff) ** 2 * expected
    target = numerics.dot(u, v)
    left = numerics.defect(target, *zip(u, v, strict=True))
    scale = sum(abs(Fraction(a) * Fraction(b)) for a, b in zip(x, y, strict=True))
    assert abs(exact(left)) <= 20 * Fraction(setting.roundoff) ** 2 * scale


def test_quotient_by_zero_raises_on_no_backend(setting, number):
    assert np.isinf(np.array(numerics.quotient(number(1.0), number(0.0)))).all()
    assert np.isnan(np.array(numerics.quotient(number(0.0), number(0.0)))).all()


def test_root_of_zero_is_zero(setting, number):
    root = Double(number(0.0), number(0.0)).sqrt()
    assert exact(root.hi) == 0
    assert exact(root.lo) == 0
