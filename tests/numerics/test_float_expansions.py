"""Float expansions against rational arithmetic."""

from fractions import Fraction

import numpy as np

from mi_refract.numerics import float_expansions


def test_products_are_exact_and_quotients_are_long_divisions():
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 200)) * np.exp2(rng.integers(-30, 30, (2, 200)))
    p, e = float_expansions.two_prod(x, y)
    q = float_expansions.quotient([x], [y], 3)
    for i in range(200):
        fx, fy = Fraction(float(x[i])), Fraction(float(y[i]))
        assert Fraction(float(p[i])) + Fraction(float(e[i])) == fx * fy
        assert abs(sum(Fraction(float(digit[i])) for digit in q) - fx / fy) <= 2**-150 * abs(fx / fy)


def test_what_cancels_is_regained_and_the_largest_part_leads():
    terms = [1.0, 2.0**-60, -1.0, 2.0**-80, -(2.0**-60), 2.0**-140]
    assert float_expansions.distil(terms) == [2.0**-80, 2.0**-140, 0]
    assert float_expansions.distil([0.5, -0.5, 0.0]) == [0, 0, 0]
