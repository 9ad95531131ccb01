"""The oracle against a second derivation, against the law itself, and against planted defects."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import itertools
import sys
from decimal import Decimal, localcontext
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

oracle = pytest.importorskip("mi_refract.oracle", reason="needs python-flint", exc_type=ImportError)

Z = np.array([[0.0, 0.0, 1.0]])
EXACT = 2.0**-100  # what a pair of doubles is trusted with here, relative


# Rays. ------------------------------------------------------------------------------------------------------


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def at_angle(rng, sin_i):
    """Random unit n, and a at the given sine from n or −n, to rounding."""
    n = unit(rng.normal(size=(len(sin_i), 3)))
    tangent = unit(np.cross(n, rng.normal(size=n.shape)))
    cos_i = rng.choice([-1.0, 1.0], len(sin_i)) * np.sqrt((1 - sin_i) * (1 + sin_i))
    return sin_i[:, None] * tangent + cos_i[:, None] * n, n


def generic(rng, size):
    return *at_angle(rng, rng.uniform(0, 1, size)), rng.uniform(0.4, 2.5, size)


def grazing(rng, size):
    n = unit(rng.normal(size=(size, 3)))
    cos_i = 10.0 ** rng.uniform(-12, -2, (size, 1))
    return unit(np.cross(n, rng.normal(size=n.shape))) + cos_i * n, n, rng.uniform(0.5, 1, size)


def critical(rng, size):
    a, n = at_angle(rng, rng.uniform(0.3, 0.999, size))
    k = np.linalg.norm(n, axis=1) * np.linalg.norm(a, axis=1) / np.linalg.norm(np.cross(n, a), axis=1)
    return a, n, np.choose(rng.integers(0, 3, size), [np.nextafter(k, 0), k, np.nextafter(k, 9)])


def matched(rng, size):
    a, n, _ = grazing(rng, size)
    return a, n, 1 + rng.choice([-1e-7, 1e-7, 2.0**-52, -(2.0**-53)], size)


def far(rng, size):
    k = 10.0 ** rng.uniform(-6, 6, size)
    return *at_angle(rng, (rng.uniform(0, 1.5, size) * np.minimum(1, 1 / k)).clip(0, 1)), k


def near_normal(rng, size):
    tangent = rng.normal(size=(size, 2)) * 10.0 ** rng.uniform(-30, -20, (size, 1))
    return np.column_stack([tangent, rng.choice([-1.0, 1.0], size)]), Z.repeat(size, 0), far(rng, size)[2]


def lengths(rng, size):
    a, n, k = generic(rng, size)
    return a * 10.0 ** rng.uniform(-18, 18, (size, 1)), n * 10.0 ** rng.uniform(-18, 18, (size, 1)), k


def denormal(rng, size):
    a, n, k = generic(rng, size)
    return np.round(a * 1000) * 5e-324, n * 1e307, k


def single(rng, size):
    return tuple(x.astype(np.float32) for x in generic(rng, size))


REGIMES = [generic, grazing, critical, matched, far, near_normal, lengths, denormal, single]
BOTH_OUTCOMES = [generic, critical, matched, far, lengths, denormal, single]


def regime(make, size=150):
    return make(np.random.default_rng(7), size)


def pairs(high, low):
    """The exact values of pairs of doubles."""
    return list(map(lambda h, m: Fraction(h) + Fraction(m), np.ravel(high).tolist(), np.ravel(low).tolist()))


# A second derivation: tangents of the angles, Newton's method, decimal arithmetic. --------------------------


def dot(u, v):
    return sum(x * y for x, y in zip(u, v, strict=True))


def tangent_of_refraction(sine):
    """tan θt from sin θt = tan/√(1 + tan²), which is concave: Newton climbs and never passes the root."""
    tan = sine
    for _ in range(400):
        step = (sine - tan / (1 + tan**2).sqrt()) * (1 + tan**2) * (1 + tan**2).sqrt()
        tan += step
        if abs(step) <= tan * Decimal("1e-80"):
            return tan
    raise ArithmeticError(f"Newton's method for the sine {sine} did not converge")


def decimal_snell(a, n, k):
    """Unit b, R, 1 − R, or None under total internal reflection.

    R = (sin²(θi−θt)/sin²(θi+θt) + tan²(θi−θt)/tan²(θi+θt)) / 2
    """
    n = [x / dot(n, n).sqrt() for x in n]
    n = n if dot(n, a) > 0 else [-x for x in n]
    cosine = dot(n, a)
    tangent = [x - cosine * y for x, y in zip(a, n, strict=True)]
    tan_i = dot(tangent, tangent).sqrt() / cosine
    cos_i = 1 / (1 + tan_i**2).sqrt()
    sin_i = tan_i * cos_i
    if k * sin_i >= 1:
        return None
    tan_t = tangent_of_refraction(k * sin_i)
    cos_t = 1 / (1 + tan_t**2).sqrt()
    sin_t = tan_t * cos_t
    b = [sin_t * x / (tan_i * cosine) + cos_t * y for x, y in zip(tangent, n, strict=True)]
    minus, plus = sin_i * cos_t - cos_i * sin_t, sin_i * cos_t + cos_i * sin_t
    tan_minus, tan_plus = minus / (cos_i * cos_t + sin_i * sin_t), plus / (cos_i * cos_t - sin_i * sin_t)
    r = ((minus / plus) ** 2 + (tan_minus / tan_plus) ** 2) / 2
    return b, r, 1 - r


def decimals(x):
    return [Decimal(v) for v in np.ravel(x).tolist()]


def assert_is(answer, c, i):
    """Ray i of `c` is the decimal answer: b within its radius and high part nearest, R and 1 − R relative."""
    b, r, t = answer
    for x, high, low in zip(b, c.direction[i].tolist(), c.direction_low[i].tolist(), strict=True):
        assert abs(Decimal(high) + Decimal(low) - x) <= Decimal(float(c.radius[i]))
        assert float(x) == high
    for x, high, low in ((r, c.reflectance, c.reflectance_low), (t, c.transmittance, c.transmittance_low)):
        assert abs(Decimal(float(high[i])) + Decimal(float(low[i])) - x) <= x * Decimal(EXACT)


@pytest.mark.parametrize("make", REGIMES)
def test_agrees_with_newtons_method(make):
    a, n, k = regime(make, 60)
    c = oracle.refract(a, n, k)
    with localcontext() as context:
        context.prec = 250
        for i in range(len(a)):
            answer = decimal_snell(decimals(a[i]), decimals(n[i]), *decimals(k[i]))
            assert c.transmitted[i] == (answer is not None)
            if answer is not None:
                assert_is(answer, c, i)


@pytest.mark.parametrize("make", REGIMES)
def test_total_reflection_is_the_sandwich(make):
    """b = −n a n/|n|², multiplied out in fractions."""
    a, n, _ = regime(make, 40)
    c = oracle.refract(a, n, 1e40)
    assert not c.transmitted.any()
    for i in range(len(a)):
        x, u = [Fraction(v) for v in a[i].tolist()], [Fraction(v) for v in n[i].tolist()]
        for j, b in enumerate(pairs(c.direction[i], c.direction_low[i])):
            mirror = x[j] - 2 * dot(x, u) * u[j] / dot(u, u)
            # Squares, so that |a| needs no root: |b² − m²| ≤ (|b| + |m|) radius ≤ 3 radius.
            assert abs(b * b - mirror**2 / dot(x, x)) <= 3 * Fraction(float(c.radius[i]))
            assert b * mirror >= 0


# The law, put back. -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", REGIMES)
def test_the_law_holds(make):
    a, n, k = regime(make)
    c = oracle.refract(a, n, k)
    law = oracle.residual(a, n, k, c)
    assert law.holds.all() and law.width.max() < 1e-28
    assert c.radius.max() <= 1e-30 and not c.undecided.any()


@pytest.mark.parametrize("make", BOTH_OUTCOMES)
def test_regime_reaches_both_outcomes(make):
    transmitted = oracle.refract(*regime(make), fresnel=False).transmitted
    assert 0 < transmitted.sum() < len(transmitted)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("make", REGIMES)
def test_residual_flags_a_direction_off_by_1e25th(make, axis):
    a, n, k = regime(make, 60)
    c = oracle.refract(a, n, k, fresnel=False)
    low = c.direction_low + 1e-25 * np.eye(3)[axis]
    assert not oracle.residual(a, n, k, dataclasses.replace(c, direction_low=low)).holds.any()


@pytest.mark.parametrize("k", [0.75, 1.9])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_residual_flags_each_component_alone(axis, k):
    """n and the error along the axes, so that only one of the residual's balls can see each error."""
    a, n = np.array([[2.0, -3, 4]]).repeat(3, 0), np.eye(3)[[axis]].repeat(3, 0)
    c = oracle.refract(a, n, k)
    bad = dataclasses.replace(c, direction_low=c.direction_low + 1e-25 * np.eye(3))
    assert not oracle.residual(a, n, k, bad).holds.any()


def test_residual_sees_along_n_at_the_critical_angle():
    a = np.array([[4.0, 0, -3]])
    c = oracle.refract(a, Z, 1.25)
    bad = dataclasses.replace(c, direction=c.direction + 1e-17 * Z)  # |b|² moves by 1e-34, inside the ball
    assert oracle.residual(a, Z, 1.25, c).holds.all()
    assert not oracle.residual(a, Z, 1.25, bad).holds.any()


@pytest.mark.parametrize("make", [generic, grazing, matched, far, lengths])
def test_residual_flags_a_swapped_k(make):
    a, n, k = regime(make)
    c = oracle.refract(a, n, k, fresnel=False)
    assert not oracle.residual(a, n, 1 / k, c).holds[c.transmitted].any()


DEFECTS = {
    "flag": lambda c: {"transmitted": ~c.transmitted},
    "side": lambda c: {"direction": -c.direction, "direction_low": -c.direction_low},
    "wide": lambda c: {"radius": c.radius + 1e-20},
    "double only": lambda c: {"direction_low": 0 * c.direction_low},
    "nan": lambda c: {"direction": c.direction * np.nan},
    "radius nan": lambda c: {"radius": c.radius * np.nan},
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_residual_flags(defect):
    a, n, k = regime(generic)
    c = oracle.refract(a, n, k, fresnel=False)
    assert not oracle.residual(a, n, k, dataclasses.replace(c, **DEFECTS[defect](c))).holds.any()


# Exact cases. -----------------------------------------------------------------------------------------------

# a = p u + q n, u ⊥ n of the same length: sin²θi = p²/(p² + q²) = 1/k² in dyadic numbers.
CRITICAL = {
    "3-4-5": ([4, 0, -3], [0, 0, 1], 1.25),
    "from behind": ([4, 0, 3], [0, 0, 1], 1.25),
    "8-15-17": ([15, 8, 0], [1, 0, 0], 2.125),
    "16-63-65": ([0, 63, -16], [0, -3, 0], 4.0625),
    "irrational length": ([1, -7, 0], [1, 1, 0], 1.25),
    "oblique": ([-2, 5, 14], [2, 1, -2], 1.25),
    "long and short": ([4e18, 0, -3e18], [0, 0, 7e-18], 1.25),
    "denormal": ([4 * 5e-324, 0, -3 * 5e-324], [0, 0, 2.0**1000], 1.25),
    "overflowing": ([2.0**1023, 0, -3 * 2.0**1021], [0, 0, -1e308], 1.25),
}


@pytest.mark.parametrize("case", CRITICAL)
def test_the_critical_angle_is_decided_exactly(case):
    a, n, k = CRITICAL[case]
    a, n = np.array([a], float), np.array([n], float)
    c = oracle.refract(a.repeat(3, 0), n.repeat(3, 0), np.array([np.nextafter(k, 0), k, np.nextafter(k, 9)]))
    assert c.transmitted.tolist() == [True, True, False]
    assert c.cos_t[0] > 0 and c.cos_t[1] == 0
    u, b = n[0] / np.abs(n).max(), c.direction[1]
    assert abs(b @ u) < 1e-15 and b @ (a[0] / np.abs(a).max()) > 0
    assert c.reflectance[1] == 1 and c.transmittance[1] == 0
    assert c.amplitude_s[1] == 1 and c.amplitude_p[1] == 1


def test_brewster_in_fractions():
    """sin θi = 4/5, k = 3/4: sin θt = 3/5, θi + θt = 90°, a_p = 0, a_s = −7/25."""
    a = np.array([[4.0, 0, -3], [-4e9, 0, 3e9]])
    c = oracle.refract(a, Z.repeat(2, 0), 0.75)
    expected = [Fraction(3, 5), Fraction(0), Fraction(-4, 5)]
    for sign, row in ((1, 0), (-1, 1)):
        for b, x in zip(pairs(c.direction[row], c.direction_low[row]), expected, strict=True):
            assert abs(b - sign * x) <= Fraction(float(c.radius[row]))
    assert (c.amplitude_p == 0).all() and (c.amplitude_s == -7 / 25).all()
    for high, low, x in (
        (c.reflectance, c.reflectance_low, Fraction(49, 1250)),
        (c.transmittance, c.transmittance_low, Fraction(1201, 1250)),
    ):
        assert all(abs(value - x) <= x * Fraction(EXACT) for value in pairs(high, low))
    assert c.cos_i.tolist() == [0.6, 0.6] and c.cos_t.tolist() == [0.8, 0.8]


TANGENTIAL = [([3, 4, 0], 5, [0, 0, 7]), ([1, 2, 2], 3, [2, 1, -2]), ([1e300, 0, 0], 1e300, [0, 1e300, 0])]


@pytest.mark.parametrize("k", [0.5, 1.0, 2.0])
@pytest.mark.parametrize(("a", "length", "n"), TANGENTIAL)
def test_tangential_ray_goes_on(a, length, n, k):
    a, n = np.array([a], float), np.array([n], float)
    c = oracle.refract(a, n, k)
    assert not c.transmitted[0] and np.array_equal(c.direction, a / length)
    assert (c.cos_i[0], c.cos_t[0], c.reflectance[0], c.transmittance[0]) == (0, 0, 1, 0)
    assert c.amplitude_s[0] == c.amplitude_p[0] == -1
    assert oracle.residual(a, n, k, c).holds.all()


def test_the_smallest_cosine_is_not_tangential():
    a, n = np.array([[1, 0, 5e-324], [1, 0, -5e-324]]), Z.repeat(2, 0)
    c = oracle.refract(a, n, 0.5)
    assert c.transmitted.all()
    assert np.allclose(c.direction[:, 2], [0.75**0.5, -(0.75**0.5)], rtol=1e-15, atol=0)
    assert not oracle.refract(a, n, np.nextafter(1, 2)).transmitted.any()


TINY, HUGE = 5e-324, 2.0**1023


@pytest.mark.parametrize(
    ("a", "n", "k", "transmitted", "side"),
    [
        ([HUGE, TINY, HUGE], [HUGE, TINY, -HUGE], 0.5, True, 1),  # n·a = +TINY²
        ([HUGE, TINY, HUGE], [HUGE, -TINY, -HUGE], 0.5, True, -1),  # n·a = −TINY²
        ([HUGE, 0, HUGE], [HUGE, TINY, -HUGE], 0.5, False, 0),  # tangential
        ([4, TINY, -3], [0, 0, 1], 1.25, False, 0),  # the radicand is −(9/16) TINY²
        ([4, 0, -3], [0, TINY, 1], 1.25, False, 0),
        ([4, TINY, -3], [0, -TINY, 1], 1.25, False, 0),
        ([4, 0, -3 - 2.0**-51], [0, TINY, 1], 1.25, True, -1),
    ],
)
def test_the_last_bit_decides(a, n, k, transmitted, side):
    """The signs of n·a and of the radicand where 2^±2000 meet: `side` is the side of n on which b leaves."""
    a, n = np.array([a], float), np.array([n], float)
    c = oracle.refract(a, n, k)
    assert not c.undecided[0] and c.transmitted[0] == transmitted
    assert not transmitted or np.sign(c.direction[0] @ (n[0] / np.abs(n).max())) == side
    assert oracle.residual(a, n, k, c).holds.all()


@pytest.mark.parametrize("make", REGIMES)
def test_k_one_changes_nothing(make):
    a, n, _ = regime(make, 40)
    c = oracle.refract(a, n, 1)
    assert c.transmitted.all() and (c.reflectance == 0).all() and (c.transmittance == 1).all()
    for i in range(len(a)):
        x = [Fraction(v) for v in a[i].tolist()]
        for j, b in enumerate(pairs(c.direction[i], c.direction_low[i])):
            assert abs(b * b - x[j] ** 2 / dot(x, x)) <= 3 * Fraction(float(c.radius[i])) and b * x[j] >= 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("bad", [0, np.nan, np.inf, -np.inf])
def test_invalid_rays_are_nan(bad, dtype):
    a, n = np.tile(np.array([0.6, 0, -0.8], dtype), (4, 1)), Z.repeat(4, 0).astype(dtype)
    k = np.full(4, 1.5, dtype)
    a[1, ::2], n[2, 2], k[3] = bad, bad, bad
    c = oracle.refract(a, n, k)
    assert c.transmitted.tolist() == [True, False, False, False]
    assert np.isnan(c.direction).all(axis=1).tolist() == [False, True, True, True]
    assert np.isnan(c.reflectance).tolist() == [False, True, True, True]
    assert not c.undecided.any()
    assert oracle.residual(a, n, k, c).holds.all()
    plausible = dataclasses.replace(c, direction=np.tile(c.direction[0], (4, 1)))
    assert oracle.residual(a, n, k, plausible).holds.tolist() == [True, False, False, False]


@pytest.mark.parametrize("k", [-1.5, -1e-300])
def test_negative_k_is_invalid(k):
    c = oracle.refract(-Z, Z, k)
    assert np.isnan(c.direction).all() and not c.transmitted.any()


# Symmetries and forms of input. -----------------------------------------------------------------------------


def same(c, d):
    return all(
        np.array_equal(getattr(c, f.name), getattr(d, f.name), equal_nan=True) for f in dataclasses.fields(c)
    )


@pytest.mark.parametrize("make", REGIMES)
def test_the_side_of_n_and_powers_of_two_do_not_matter(make):
    a, n, k = regime(make, 40)
    c = oracle.refract(a, n, k)
    assert same(c, oracle.refract(a, -n, k))
    assert same(c, oracle.refract(a * 8, n / 4, k))
    assert not same(c, oracle.refract(-a, n, k))


def test_single_is_its_exact_double_and_k_broadcasts():
    a, n, _ = regime(single)
    c = oracle.refract(a, n, 1.5)
    assert same(c, oracle.refract(a.astype(float), n.astype(float), np.full(len(a), 1.5, np.float32)))
    assert not same(c, oracle.refract(a, n, np.nextafter(np.float32(1.5), np.float32(2))))


def test_many_rays_are_each_ray():
    a, n, k = regime(generic, 2500)
    c = oracle.refract(a, n, k)
    a[1::2] = 0  # invalid neighbours must not shift the rest
    d = oracle.refract(a, n, k)
    assert np.array_equal(c.direction[::2], d.direction[::2]) and np.isnan(d.direction[1::2]).all()
    assert len(oracle.refract(a[:0], n[:0], k[:0])) == 0


@pytest.mark.parametrize("contrast", [0.5625, 1e-20, -1e-20, 1e-100, -0.999, 1e12])
def test_contrast_is_the_exact_k2_minus_1(contrast):
    a, n, _ = regime(generic, 40)
    k = (1 + contrast) ** 0.5
    c = oracle.refract(a, n, k, contrast=contrast)
    assert oracle.residual(a, n, k, c, contrast=contrast).holds.all()
    with localcontext() as context:
        context.prec = 400
        exact_k = (1 + Decimal(contrast)).sqrt()
        for i in range(len(a)):
            answer = decimal_snell(decimals(a[i]), decimals(n[i]), exact_k)
            assert c.transmitted[i] == (answer is not None)
            if answer is not None:
                assert_is(answer, c, i)


def test_contrast_decides_where_k_is_blind():
    a = np.array([[1, 0, -1e-11]])
    outcomes = [oracle.refract(a, Z, 1, contrast=e).transmitted[0] for e in (9e-23, 1.1e-22)]
    assert outcomes == [True, False]
    assert same(oracle.refract(a, Z, 1.25), oracle.refract(a, Z, 1.0, contrast=0.5625))
    assert np.isnan(oracle.refract(a, Z, 1, contrast=-1.0).direction).all()
    blind = oracle.refract(a, Z, 1)
    assert not oracle.residual(a, Z, 1, blind, contrast=9e-23).holds.any()


# Fresnel. ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", REGIMES)
def test_energy_is_conserved(make):
    c = oracle.refract(*regime(make))
    r, t = pairs(c.reflectance, c.reflectance_low), pairs(c.transmittance, c.transmittance_low)
    assert max(abs(total - 1) for total in map(Fraction.__add__, r, t)) <= EXACT
    mean = (abs(c.amplitude_s) ** 2 + abs(c.amplitude_p) ** 2) / 2
    assert np.allclose(mean, c.reflectance, rtol=1e-14, atol=0)
    assert np.array_equal(c.transmittance > 0, c.transmitted & (c.cos_t > 0))


@pytest.mark.parametrize("make", [generic, far, lengths, single])
def test_amplitudes_are_their_definition(make):
    a, n, k = (x.astype(float) for x in regime(make))
    c, eta = oracle.refract(a, n, k), 1 / k
    total = ~c.transmitted
    assert np.allclose(abs(c.amplitude_s[total]), 1, rtol=0, atol=4e-16)
    assert np.allclose(abs(c.amplitude_p[total]), 1, rtol=0, atol=4e-16)
    sin_i = np.linalg.norm(np.cross(unit(n), unit(a)), axis=1)
    cos2 = 1 - (k * sin_i) ** 2
    # Near the critical angle double precision does not know cos_t; it is tested exactly elsewhere.
    keep = abs(cos2) > 1e-3
    cos_t = np.where(cos2 > 0, 1 + 0j, -1j) * np.sqrt(abs(cos2))
    s = (c.cos_i - eta * cos_t) / (c.cos_i + eta * cos_t)
    p = (eta * c.cos_i - cos_t) / (eta * c.cos_i + cos_t)
    assert keep.any() and np.array_equal(cos2[keep] > 0, c.transmitted[keep])
    assert np.allclose(c.amplitude_s[keep], s[keep], rtol=0, atol=1e-11)
    assert np.allclose(c.amplitude_p[keep], p[keep], rtol=0, atol=1e-11)


def test_amplitudes_are_mitsubas():
    mi = pytest.importorskip("mitsuba.scalar_rgb")
    a, n, k = regime(generic, 100)
    c = oracle.refract(a, n, k)
    assert 0 < c.transmitted.sum() < len(c)
    for i in range(len(c)):
        s, p, *_ = mi.fresnel_polarized(float(c.cos_i[i]), float(1 / k[i]))
        for ours, theirs in ((c.amplitude_s[i], s), (c.amplitude_p[i], p)):
            assert abs(ours - complex(theirs.real, theirs.imag)) < 1e-3


def test_without_fresnel_only_fresnel_is_missing():
    a, n, k = regime(generic, 20)
    c, d = oracle.refract(a, n, k), oracle.refract(a, n, k, fresnel=False)
    assert np.array_equal(c.direction_low, d.direction_low) and np.array_equal(c.cos_t, d.cos_t)
    assert np.isnan(d.reflectance).all() and np.isnan(d.amplitude_s).all()
    assert not np.isnan(c.reflectance).any() and not np.isnan(c.amplitude_s).any()


# Precision, progress, errors. -------------------------------------------------------------------------------


def test_precision_climbs_until_the_radius_is_met(monkeypatch):
    a, n, k = regime(far, 40)
    c = oracle.refract(a, n, k)
    monkeypatch.setattr(oracle, "PRECISIONS", (40, 320))
    assert np.array_equal(oracle.refract(a, n, k).direction, c.direction)
    monkeypatch.setattr(oracle, "PRECISIONS", (40,))
    lost = oracle.refract(a, n, k)
    assert lost.undecided.all() and np.isnan(lost.direction).all() and not lost.transmitted.any()
    monkeypatch.undo()
    assert not oracle.residual(a, n, k, lost).holds.any()


def test_a_ball_around_the_critical_angle_is_undecided(monkeypatch):
    odd = 2.0**50 + 1  # AN has 210 bits
    a, n = np.array([[4 * odd, 0, -3 * odd], [0.1, 0, -3]]), Z.repeat(2, 0) / 3
    assert not oracle.refract(a, n, 1.25).undecided.any()
    monkeypatch.setattr(oracle, "EXACT_BITS", 160)
    c = oracle.refract(a, n, 1.25)
    assert c.undecided.tolist() == [True, False] and c.transmitted.tolist() == [False, True]


def test_the_working_precision_of_others_is_left_alone():
    from flint import ctx

    before = ctx.prec
    oracle.residual(-Z, Z, 1.5, oracle.refract(-Z, Z, 1.5))
    assert ctx.prec == before


class Bar:
    def __init__(self):
        self.completed, self.stopped = [], 0

    def update(self, task, completed):
        self.completed.append(completed)

    def stop(self):
        self.stopped += 1


@pytest.mark.parametrize(("seconds", "shown"), [(0.5, False), (3.0, True)])
def test_progress_shows_past_two_seconds(monkeypatch, seconds, shown):
    bar, clock = Bar(), itertools.count(0, seconds)
    monkeypatch.setattr(oracle, "_progress_bar", lambda count: (bar, count))
    monkeypatch.setattr(oracle.time, "monotonic", lambda: next(clock))
    a, n, k = regime(generic, 2500)
    oracle.refract(a, n, k, fresnel=False)
    assert bar.completed == ([1024, 2048, 2500] if shown else []) and bar.stopped == shown
    oracle.refract(a, n, k, fresnel=False, progress=False)
    assert bar.stopped == shown


V = np.ones((5, 3))


@pytest.mark.parametrize(
    ("name", "a", "n", "k"),
    [
        ("a is", 1.0, V, 1.5),
        ("a is", V[:, :2], V, 1.5),
        ("a is", V.astype(int), V, 1.5),
        ("a is", V.astype(np.longdouble), V, 1.5),
        ("n is", V, V[:4], 1.5),
        ("n is", V, V[0], 1.5),
        ("k is", V, V, np.ones(4)),
        ("k is", V, V, V),
        ("k is", V, V, "1.5"),
        ("k is", V, V, 1j),
    ],
)
def test_wrong_shapes_and_dtypes_are_one_line(name, a, n, k):
    with pytest.raises(ValueError, match=rf"^oracle: {name} .*; accepted: [^\n]*$"):
        oracle.refract(a, n, k)


def test_residual_wants_as_many_answers_as_rays():
    with pytest.raises(ValueError, match="certified holds 1 rays; accepted: 5"):
        oracle.residual(V, V, 1.5, oracle.refract(V[:1], V[:1], 1.5))


def test_missing_flint_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flint", None)
    spec = importlib.util.spec_from_file_location("oracle_without_flint", oracle.__file__)
    with pytest.raises(ImportError, match=r"python-flint: pip install 'mi-refract\[validation\]'$"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


def test_imports_nothing_of_ours():
    tree = ast.parse(Path(oracle.__file__).read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = {getattr(node, "module", None) or alias.name for node in imports for alias in node.names}
    assert "flint" in names and not any(name.startswith("mi_refract") for name in names)
    assert all(getattr(node, "level", 0) == 0 for node in imports)
