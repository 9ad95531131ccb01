"""Conversion from numpy, division by 0 and scaling by powers of two, on every backend and in both precisions."""

import drjit as dr
import numpy as np
import pytest

from mi_refract.numerics import aligned, from_numpy, ieee_divide, scale_to_unit
from mi_refract.numerics.drjit_arrays import ALIGNMENT


@pytest.mark.parametrize("offset", range(0, 64, 8))
def test_numbers_start_where_they_can_be_read_at_once(offset):
    values = np.arange(100.0)[offset // 8 :]
    copy = aligned(values, np.dtype(np.float32))
    assert copy.ctypes.data % ALIGNMENT == 0
    assert copy.dtype == np.float32
    assert (copy == values).all()


def test_a_kernel_serves_vectors_of_any_number_and_place(vectorised):
    number, seen = dr.value_t(vectorised.vector), set()
    for count in (30, 31, 100):
        v = np.random.default_rng(count).normal(size=(count + 1, 3)).astype(vectorised.precision)[1:]
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            found = 2 * from_numpy(vectorised.vector, v) + from_numpy(number, v[:, 0])
            dr.eval(found)
            seen.add(dr.kernel_history([dr.KernelType.JIT])[0]["hash"])
        assert (2 * v + v[:, :1] == np.array(found).T).all()
    assert len(seen) == 1


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
