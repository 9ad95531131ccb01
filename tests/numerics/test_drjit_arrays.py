"""Division by 0 and scaling by powers of two, on every backend and in both precisions."""

import drjit as dr
import numpy as np
import pytest

from mi_refract.numerics import ieee_divide, scale_to_unit


def test_quotient_by_zero_raises_on_no_backend(setting):
    number = float if setting.backend == "scalar" else dr.value_t(setting.vector)
    assert np.isinf(np.array(ieee_divide(number(1.0), number(0.0)))).all()
    assert np.isnan(np.array(ieee_divide(number(0.0), number(0.0)))).all()


LENGTHS = [1e-18, 3e-7, 1.0, 1.9999999, 2.0, 5e9, 1e18]


@pytest.mark.parametrize("length", LENGTHS)
def test_lengths_are_brought_near_one_by_a_power_of_two(length, vectorised):
    v = vectorised.vector(*(length * x for x in (0.6, -0.7, 0.1)))
    dr.make_opaque(v)
    scaled, power = scale_to_unit(v)
    assert (np.array(scaled * power) == np.array(v)).all()
    if vectorised.name == "float32":
        assert 1 <= np.abs(np.array(scaled)).max() < 2
        mantissa, _ = np.frexp(float(np.array(power).ravel()[0]))
        assert mantissa == 0.5
    else:
        assert power == 1


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf, -np.inf])
def test_what_has_no_length_is_not_given_one(bad, vectorised):
    v = vectorised.vector(bad, 0.0, 0.0)
    dr.make_opaque(v)
    scaled = np.array(scale_to_unit(v)[0]).ravel()
    assert scaled[0] == 0 if bad == 0 else not np.isfinite(scaled).all()
