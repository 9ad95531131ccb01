"""Formulas of dispersion against the same ones for single numbers, and Dr.Jit's derivatives against differences."""

import math

import drjit as dr
import numpy as np
import pytest

from mi_refract import media
from mi_refract.media import LINES

# N-BK7 by Schott: coefficients printed for micrometres, n_d and V_d as printed.
B = 1.03961212, 0.231792344, 1.01046945
C = 0.00600069867, 0.0200179144, 103.560653
SELLMEIER = f"sellmeier({B[0]}, {B[1]}, {B[2]}, {C[0] * 1e6}, {C[1] * 1e6}, {C[2] * 1e6})"
RESONANCES = f"sellmeier_nm({B[0]}, {B[1]}, {B[2]}, {', '.join(repr(1e3 * math.sqrt(c)) for c in C)})"


def bk7(w):
    square = (w / 1000) ** 2
    return math.sqrt(1 + sum(b * square / (square - c) for b, c in zip(B, C, strict=True)))


def tabulated(w):
    return float(np.interp(w, [400, 500, 900], [1.53, 1.52, 1.5]))


CLOSED = {
    "1.5": lambda w: 1.5,
    "cauchy(1.458, 3540, 1e7)": lambda w: 1.458 + 3540 / w**2 + 1e7 / w**4,
    SELLMEIER: bk7,
    RESONANCES: bk7,
    "abbe(1.5168, 64.17)": lambda w: (
        1.5168 + (1.5168 - 1) / 64.17 * (w**-2 - LINES["d"] ** -2) / (LINES["F"] ** -2 - LINES["C"] ** -2)
    ),
    "table(400: 1.53, 500: 1.52, 900: 1.5)": tabulated,
}


def medium(spec):
    return media.parse(float(spec) if spec[0].isdigit() else spec)


@pytest.fixture(params=list(CLOSED), ids=lambda spec: spec.partition("(")[0])
def spec(request):
    return request.param


@pytest.mark.parametrize("wavelength", [400.0, 500.0, 587.5618, 899.0])
def test_the_index_is_that_of_the_formula(spec, wavelength):
    assert medium(spec).index(wavelength) == pytest.approx(CLOSED[spec](wavelength), rel=4e-16)
    assert type(medium(spec).index(wavelength)) is float


def test_arrays_of_numpy_keep_their_shape(spec):
    wavelengths = np.array([[410.0, 500.0, 505.0], [600.0, 700.0, 900.0]])
    expected = [[CLOSED[spec](w) for w in row] for row in wavelengths]
    np.testing.assert_allclose(medium(spec).index(wavelengths), expected, rtol=4e-16)


def test_arrays_of_drjit_are_evaluated_in_double_precision(spec, setting):
    number = dr.value_t(setting.vector)
    wavelengths = 410.0, 500.0, 700.0
    found = medium(spec).index(number(*wavelengths) if dr.is_jit_v(number) else number(wavelengths[0]))
    assert dr.type_v(found) == dr.VarType.Float64 or not dr.is_array_v(found)
    expected = [CLOSED[spec](w) for w in wavelengths]
    found = np.atleast_1d(np.array(found, dtype=float)).ravel()
    np.testing.assert_allclose(found, expected[: len(found)], rtol=4e-16)


def test_drjit_differentiates_in_the_wavelength_and_the_coefficients(spec, vectorised):
    """Against central differences, between the knots of the table."""
    found = medium(spec)
    wide = dr.float64_array_t(dr.diff_array_t(dr.value_t(vectorised.vector)))
    for at in (450.0, 620.0):
        w, c = wide(at), {name: wide(value) for name, value in found.coefficients.items()}
        dr.enable_grad(w, *c.values())
        dr.backward(found.index(w, c))
        slope = (CLOSED[spec](at + 1e-3) - CLOSED[spec](at - 1e-3)) / 2e-3
        assert dr.grad(w)[0] == pytest.approx(slope, rel=1e-6, abs=1e-12)
        for name, value in found.coefficients.items():
            step = 1e-5 * abs(value)
            ends = [found.index(at, {name: value + sign * step}) for sign in (1, -1)]
            assert dr.grad(c[name])[0] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5, abs=1e-10), name


def test_of_a_table_each_knot_is_its_own_value():
    found = media.parse("table(400: 1.53, 500: 1.52, 900: 1.5)")
    assert [found.index(w) for w in (400.0, 500.0, 900.0)] == [1.53, 1.52, 1.5]


def test_knots_that_agree_to_nine_digits_have_values_of_their_own():
    close = math.nextafter(500.0, 600)
    found = media.parse(f"table(400: 1.5, 500: 1.5, {close!r}: 1.6, 600: 1.7)")
    assert [found.index(w) for w in (400.0, 450.0, 500.0, close, 600.0)] == [1.5, 1.5, 1.5, 1.6, 1.7]
    assert len(found.coefficients) == 4


def test_abbe_goes_through_both_of_its_numbers():
    found = media.parse("abbe(1.5168, 64.17)")
    n_d, n_f, n_c = (found.index(LINES[line]) for line in "dFC")
    assert n_d == pytest.approx(1.5168, rel=1e-15)
    assert (n_d - 1) / (n_f - n_c) == pytest.approx(64.17, rel=1e-12)


def test_only_a_number_is_the_same_for_all_wavelengths(spec):
    assert medium(spec).dispersive == (spec != "1.5")
