"""The oracle against a second derivation, against the law itself, and against planted defects."""

from __future__ import annotations

import dataclasses
from decimal import Decimal, localcontext
from fractions import Fraction

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


def skimming(rng, size):
    angle, cos_i = rng.uniform(0, 6.3, size), 10.0 ** rng.uniform(-100, -20, size)
    a = np.column_stack([np.cos(angle), np.sin(angle), rng.choice([-1, 1], size) * cos_i])
    return a, Z.repeat(size, 0), rng.uniform(0.5, 1, size)


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


REGIMES = [generic, grazing, skimming, critical, matched, far, near_normal, lengths, denormal, single]
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


def assert_is_decimal_snell(c, i, a, n, k):
    """Ray i of `c` is the decimal answer: b within its radius and high part nearest, R and 1 − R relative."""
    answer = decimal_snell(decimals(a[i]), decimals(n[i]), k)
    assert c.transmitted[i] == (answer is not None)
    if answer is None:
        return
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
            assert_is_decimal_snell(c, i, a, n, *decimals(k[i]))


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


# Exact values and symmetries. -------------------------------------------------------------------------------


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


@pytest.mark.parametrize("make", REGIMES)
def test_k_one_changes_nothing(make):
    a, n, _ = regime(make, 40)
    c = oracle.refract(a, n, 1)
    assert c.transmitted.all() and (c.reflectance == 0).all() and (c.transmittance == 1).all()
    for i in range(len(a)):
        x = [Fraction(v) for v in a[i].tolist()]
        for j, b in enumerate(pairs(c.direction[i], c.direction_low[i])):
            assert abs(b * b - x[j] ** 2 / dot(x, x)) <= 3 * Fraction(float(c.radius[i])) and b * x[j] >= 0


def same(c, d):
    return all(np.array_equal(getattr(c, f.name), getattr(d, f.name), equal_nan=True) for f in dataclasses.fields(c))


@pytest.mark.parametrize("make", REGIMES)
def test_the_side_of_n_and_powers_of_two_do_not_matter(make):
    a, n, k = regime(make, 40)
    c = oracle.refract(a, n, k)
    assert same(c, oracle.refract(a, -n, k))
    assert same(c, oracle.refract(a * 8, n / 4, k))
    assert not same(c, oracle.refract(-a, n, k))


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
            assert_is_decimal_snell(c, i, a, n, exact_k)


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
