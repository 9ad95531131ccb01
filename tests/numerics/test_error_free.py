"""Error-free transforms against rational arithmetic."""

from fractions import Fraction

import drjit as dr
import numpy as np
import pytest

from mi_refract.numerics import DoubleWord, TripleWord, error_free

RNG = np.random.default_rng(11)


def exact(x):
    return Fraction(float(np.array(x).ravel()[0]))


def value(x):
    if isinstance(x, TripleWord):
        return sum(map(exact, (x.hi, *x.first, x.second)))
    hi, lo = (x.hi, x.lo) if isinstance(x, DoubleWord) else x
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
    assert value(error_free.two_sum(number(x), number(y))) == Fraction(x) + Fraction(y)
    assert value(error_free.two_prod(number(x), number(y))) == Fraction(x) * Fraction(y)
    big, small = sorted((x, y), key=abs, reverse=True)
    assert value(error_free.fast_two_sum(number(big), number(small))) == Fraction(x) + Fraction(y)


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
    assert abs(value(error_free.dot(u, v)) - sum(terms)) <= 8 * Fraction(setting.roundoff) ** 3 * sum(map(abs, terms))
    for i, component in enumerate(error_free.cross(u, v)):
        j, k = (i + 1) % 3, (i + 2) % 3
        expected = fx[j] * fy[k] - fx[k] * fy[j]
        assert abs(value(component) - expected) <= 6 * Fraction(setting.roundoff) ** 3 * abs(expected)


def test_a_dot_product_that_is_zero_is_zero_and_one_that_is_not_is_not(setting, number):
    tiny = float(setting.precision(setting.roundoff**2))
    ones = [number(x) for x in (1.0, 1.0, 1.0)]
    assert exact(error_free.dot(ones, [number(x) for x in (1.0, -1.0, 0.0)]).hi) == 0
    assert exact(error_free.dot(ones, [number(x) for x in (1.0, -1.0, tiny)]).hi) == Fraction(tiny)


@pytest.mark.parametrize("trial", range(10))
def test_double_words_keep_five_units_of_the_second_order(trial, setting, number):
    bound = 5 * Fraction(setting.roundoff) ** 2
    a, b, c = draw(setting)
    x, y = DoubleWord.product(number(a), number(b)), DoubleWord.product(number(c), number(a))
    fx, fy = Fraction(a) * Fraction(b), Fraction(c) * Fraction(a)
    for found, expected in ((x + y, fx + fy), (x - y, fx - fy), (x * y, fx * fy), (x * number(c), fx * Fraction(c))):
        assert abs(value(found) - expected) <= bound * abs(expected)
    square = x * x
    assert abs(value(square.sqrt()) ** 2 - value(square)) <= 4 * bound * value(square)


@pytest.mark.parametrize("trial", range(10))
def test_expansions_keep_the_third_order(trial, setting, number):
    u, v = ([number(float(setting.precision(x))) for x in RNG.normal(size=3)] for _ in range(2))
    x, y, *_ = error_free.cross(u, v)
    k = DoubleWord.product(u[0], u[0]) - 1
    fx, fy, fk = value(x), value(y), value(k)
    bound = 100 * Fraction(setting.roundoff) ** 3
    x2, y2 = x.squared(), y.squared()
    for found, expected in (
        (x2, fx * fx),
        (x2 + y2, fx * fx + fy * fy),
        (x2.collected(), fx * fx),
        (x2.times(k), fx * fx * fk),
        (x2.times(DoubleWord(u[1])), fx * fx * value((u[1], 0))),
    ):
        assert abs(value(found) - expected) <= bound * abs(expected)
    difference = (x2 - y2).double()
    larger, left = max(fx * fx, fy * fy), abs(fx * fx - fy * fy)
    assert abs(value(difference) - (fx * fx - fy * fy)) <= bound * larger + Fraction(setting.roundoff) ** 2 * left
    assert value(TripleWord(u[0]).squared()) == value((u[0], 0)) ** 2


@pytest.mark.parametrize("trial", range(10))
def test_a_defect_that_is_small_keeps_its_digits(trial, setting, number):
    x, y, u, v = cancelling(setting, number)
    target = error_free.dot(u, v).pair
    left = error_free.defect(target, *zip(u, v, strict=True))
    scale = sum(abs(Fraction(a) * Fraction(b)) for a, b in zip(x, y, strict=True))
    assert abs(exact(left)) <= 20 * Fraction(setting.roundoff) ** 2 * scale
    halved = DoubleWord(target.hi * 0.5, target.lo * 0.5)
    missing = exact(error_free.defect(halved, *zip(u, v, strict=True)))
    expected = -value(target) / 2
    u1 = Fraction(setting.roundoff)
    assert abs(missing - expected) <= 2 * u1 * abs(expected) + 20 * u1**2 * scale


def test_root_of_zero_is_zero(setting, number):
    root = DoubleWord(number(0.0), number(0.0)).sqrt()
    assert exact(root.hi) == 0
    assert exact(root.lo) == 0
