"""Arithmetic on every backend in both precisions, against rational arithmetic, and helpers for Dr.Jit arrays."""

from fractions import Fraction

import drjit as dr
import numpy as np
import pytest

from mi_refract.numerics import (
    DoubleWord,
    TripleWord,
    aligned,
    error_free,
    float_expansions,
    from_numpy,
    ieee_divide,
    ieee_quotients,
    rounded_product,
    scale_to_unit,
)

TRIALS = 10


def exact(x):
    return Fraction(float(np.array(x).ravel()[0]))


def value(x):
    if isinstance(x, TripleWord):
        return sum(map(exact, (x.hi, *x.first, x.second)))
    hi, lo = (x.hi, x.lo) if isinstance(x, DoubleWord) else x
    return exact(hi) + exact(lo)


@pytest.fixture
def number(setting):
    return float if setting.is_scalar else dr.value_t(setting.vector)


@pytest.fixture
def drawn(setting):
    """Pairs of vectors over many magnitudes, representable in the precision, whose dot products cancel."""
    rng, vectors = np.random.default_rng(11), []
    for _ in range(TRIALS):
        x, y = ((rng.normal(size=3) * 2.0 ** rng.integers(-20, 20, 3)).astype(setting.precision) for _ in range(2))
        x, y = x.tolist(), y.tolist()
        y[2] = float(setting.precision(-(x[0] * y[0] + x[1] * y[1]) / x[2]))
        vectors.append((x, y))
    return vectors


# Error-free transforms -----------------------------------------------------------------------------------------------


def test_sums_and_products_are_exact_and_dot_and_cross_survive_cancellation(setting, number, drawn):
    third = Fraction(setting.roundoff) ** 3
    for x, y in drawn:
        (a, b), u, v = x[:2], list(map(number, x)), list(map(number, y))
        assert value(error_free.two_sum(u[0], u[1])) == Fraction(a) + Fraction(b)
        assert value(error_free.two_prod(u[0], u[1])) == Fraction(a) * Fraction(b)
        big, small = sorted((a, b), key=abs, reverse=True)
        assert value(error_free.fast_two_sum(number(big), number(small))) == Fraction(a) + Fraction(b)
        fx, fy = list(map(Fraction, x)), list(map(Fraction, y))
        terms = [p * q for p, q in zip(fx, fy, strict=True)]
        assert abs(value(error_free.dot(u, v)) - sum(terms)) <= 8 * third * sum(map(abs, terms))
        for i, component in enumerate(error_free.cross(u, v)):
            j, k = (i + 1) % 3, (i + 2) % 3
            expected = fx[j] * fy[k] - fx[k] * fy[j]
            assert abs(value(component) - expected) <= 6 * third * abs(expected)
    tiny = float(setting.precision(setting.roundoff**2))
    for last in (0.0, tiny):
        ones, signs = ([number(x) for x in v] for v in ((1.0, 1.0, 1.0), (1.0, -1.0, last)))
        assert exact(error_free.dot(ones, signs).hi) == Fraction(last)


def test_errors_of_double_and_triple_words(setting, number, drawn):
    second, third = 5 * Fraction(setting.roundoff) ** 2, 100 * Fraction(setting.roundoff) ** 3
    for (a, b, c), _ in drawn:
        x, y = DoubleWord.product(number(a), number(b)), DoubleWord.product(number(c), number(a))
        fx, fy = Fraction(a) * Fraction(b), Fraction(c) * Fraction(a)
        results = (x + y, fx + fy), (x - y, fx - fy), (x * y, fx * fy), (x * number(c), fx * Fraction(c))
        assert all(abs(value(result) - expected) <= second * abs(expected) for result, expected in results)
        square = x * x
        assert abs(value(square.sqrt()) ** 2 - value(square)) <= 4 * second * value(square)
    rng = np.random.default_rng(12)
    for _ in range(TRIALS):
        u, v = ([number(float(setting.precision(x))) for x in rng.normal(size=3)] for _ in range(2))
        x, y, *_ = error_free.cross(u, v)
        k, x2, y2, fx, fy = DoubleWord.product(u[0], u[0]) - 1, x.squared(), y.squared(), value(x), value(y)
        results = (x2, fx * fx), (x2 + y2, fx * fx + fy * fy), (x2.collected(), fx * fx)
        results += (x2.times(k), fx * fx * value(k)), (x2.times(DoubleWord(u[1])), fx * fx * value((u[1], 0)))
        assert all(abs(value(result) - expected) <= third * abs(expected) for result, expected in results)
        larger, difference = max(fx * fx, fy * fy), fx * fx - fy * fy
        error = abs(value((x2 - y2).double()) - difference)
        assert error <= third * larger + Fraction(setting.roundoff) ** 2 * abs(difference)
        assert value(TripleWord(u[0]).squared()) == value((u[0], 0)) ** 2
    root = DoubleWord(number(0.0), number(0.0)).sqrt()
    assert exact(root.hi) == exact(root.lo) == 0


def test_small_defects_are_accurate(setting, number, drawn):
    u1 = Fraction(setting.roundoff)
    for x, y in drawn:
        u, v = list(map(number, x)), list(map(number, y))
        target = error_free.dot(u, v).pair
        scale = sum(abs(Fraction(a) * Fraction(b)) for a, b in zip(x, y, strict=True))
        for share, expected in ((1.0, 0), (0.5, -value(target) / 2)):
            part = DoubleWord(target.hi * share, target.lo * share)
            defect = exact(error_free.defect(part, *zip(u, v, strict=True)))
            assert abs(defect - expected) <= 2 * u1 * abs(expected) + 20 * u1**2 * scale


def test_float_expansions_multiply_divide_and_survive_cancellation():
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 200)) * np.exp2(rng.integers(-30, 30, (2, 200)))
    p, e = float_expansions.two_prod(x, y)
    q = float_expansions.quotient([x], [y], 3)
    for i in range(200):
        fx, fy = Fraction(float(x[i])), Fraction(float(y[i]))
        assert Fraction(float(p[i])) + Fraction(float(e[i])) == fx * fy
        assert abs(sum(Fraction(float(digit[i])) for digit in q) - fx / fy) <= 2**-150 * abs(fx / fy)
    terms = [1.0, 2.0**-60, -1.0, 2.0**-80, -(2.0**-60), 2.0**-140]
    assert float_expansions.distil(terms) == [2.0**-80, 2.0**-140, 0]
    assert float_expansions.distil([0.5, -0.5, 0.0]) == [0, 0, 0]


# Dr.Jit arrays -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_cuda", [False, True])
def test_kernels_round_products_before_sums_and_compute_accurate_quotients(vectorised, as_cuda, monkeypatch):
    """Within one kernel, a compiler may fuse x·y + z, and choose instructions of 20 bits.

    as_cuda: the steps for CUDA do not change results on other backends.
    """
    if as_cuda:
        monkeypatch.setattr(dr, "backend_v", lambda x: dr.JitBackend.CUDA)
    number, rng = dr.value_t(vectorised.vector), np.random.default_rng(5)
    x, y = (number(rng.uniform(1, 2, 1000).astype(vectorised.precision)) for _ in range(2))
    root = DoubleWord(x).sqrt()
    products = [rounded_product(x, y), error_free.two_prod(x, y)[0], root.hi]
    if vectorised.name == "float64":
        p, e = float_expansions.two_prod(x, y)
        products.append(p)
        assert dr.all(e == error_free.two_prod(x, y)[1])
    for product in products:
        evaluated = number(product)
        dr.eval(evaluated)
        assert dr.all(product - evaluated == 0)
    assert dr.all(dr.abs(dr.fma(-root.hi, root.hi, x) - 2 * root.hi * root.lo) <= 64 * vectorised.roundoff**2)
    with ieee_quotients(number):
        assert dr.all(dr.abs(dr.fma(dr.rcp(x), x, -1)) <= 4 * vectorised.roundoff)
        assert dr.all(dr.abs(dr.rsqrt(x) ** 2 * x - 1) <= 16 * vectorised.roundoff)


@pytest.mark.parametrize("offset", range(0, 64, 8))
def test_aligned_copies_start_at_multiples_of_64_bytes(offset):
    values = np.arange(100.0)[offset // 8 :]
    copy = aligned(values, np.dtype(np.float32))
    assert copy.ctypes.data % 64 == 0 and copy.dtype == np.float32 and (copy == values).all()


def test_one_kernel_serves_arrays_of_any_size_and_address(vectorised):
    number, hashes = dr.value_t(vectorised.vector), set()
    for count in (30, 31, 100):
        v = np.random.default_rng(count).normal(size=(count + 1, 3)).astype(vectorised.precision)[1:]
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            result = 2 * from_numpy(vectorised.vector, v) + from_numpy(number, v[:, 0])
            dr.eval(result)
            hashes.add(dr.kernel_history([dr.KernelType.JIT])[0]["hash"])
        assert (2 * v + v[:, :1] == np.array(result).T).all()
    assert len(hashes) == 1


def test_division_by_zero_raises_on_no_backend(number):
    assert np.isinf(np.array(ieee_divide(number(1.0), number(0.0)))).all()
    assert np.isnan(np.array(ieee_divide(number(0.0), number(0.0)))).all()


@pytest.mark.parametrize("length", [1e-18, 3e-7, 1.0, 1.9999999, 2.0, 5e9, 1e18, 0.0, np.nan, np.inf, -np.inf])
def test_scaling_to_unit_length_by_a_power_of_two(length, vectorised):
    v = vectorised.vector(0.6 * length, -0.7 * length, 0.1 * length)
    dr.make_opaque(v)
    scaled, power = scale_to_unit(v)
    if not length or not np.isfinite(length):
        assert not np.array(scaled).any() if length == 0 else not np.isfinite(np.array(scaled)).all()
        return
    assert (np.array(scaled * power) == np.array(v)).all()
    if vectorised.name == "float32":
        assert 1 <= np.abs(np.array(scaled)).max() < 2
        assert np.frexp(float(np.array(power).ravel()[0]))[0] == 0.5
    else:
        assert power == 1
