"""Fresnel's equations against certified answers: within 4u for powers, 8u for amplitudes."""

import functools
import zlib

import drjit as dr
import numpy as np
import pytest
from flint import acb, arb, ctx

from mi_refract import oracle
from mi_refract.formulas import FORMULAS, fresnel
from mi_refract.numerics import from_numpy
from validation.stability import energy
from validation.stability.energy import evaluated, to_numpy, worst

# Cosines of incidence and ratios k, near every edge ------------------------------------------------------------------


def log_uniform(rng, low, high, count):
    return np.exp(rng.uniform(np.log(low), np.log(high), count))


def displaced(rng, x, precision, most=4):
    """`x` moved by a few ulps, or by many."""
    count, x = len(x), x.astype(precision)
    many = log_uniform(rng, 1, 1e5, count) * rng.choice([-1, 1], count)
    ulps = np.where(rng.random(count) < 0.6, rng.integers(-most, most + 1, count), many)
    return x.astype(np.longdouble) + np.rint(ulps) * np.spacing(x).astype(np.longdouble)


def critical(rng, count, precision):
    k = log_uniform(rng, 1.0001, 1e6, count).astype(precision).astype(np.longdouble)
    return displaced(rng, np.sqrt((k - 1) * (k + 1)) / k, precision), k


def brewster(rng, count, precision):
    k = log_uniform(rng, 1e-3, 1e3, count).astype(precision).astype(np.longdouble)
    return displaced(rng, k / np.sqrt(1 + k * k), precision, most=1), k


def matched(rng, count, precision):
    cosines = np.where(rng.random(count) < 0.5, rng.random(count), log_uniform(rng, 1e-8, 1, count))
    return cosines, 1 + log_uniform(rng, np.finfo(precision).eps, 0.1, count) * rng.choice([-1, 1], count)


def steep(rng, count, precision):
    k = log_uniform(rng, 3, 1e6, count)
    return np.sqrt(np.maximum(0, 1 - (rng.uniform(0, 1.05, count) / k) ** 2)), k


DRAWS = {
    "generic": lambda rng, count, _: (rng.random(count), log_uniform(rng, 0.3, 3, count)),
    "near_normal": lambda rng, count, _: (np.cos(log_uniform(rng, 1e-12, 0.1, count)), rng.uniform(0.4, 2.5, count)),
    "grazing": lambda rng, count, _: (log_uniform(rng, 1e-30, 1e-2, count), rng.uniform(0.1, 1, count)),
    "dense": lambda rng, count, _: (rng.random(count), log_uniform(rng, 1e-6, 0.3, count)),
    **{f.__name__: f for f in (critical, brewster, matched, steep)},
}
# Local maxima of the errors of R, R, T and r_p: found by hill climbing on the bits of (cos_i, k), from the worst of 10⁶
# rays in each of eleven regimes.
WORST = {
    "float32": [
        ("0x1.66e34ep-3", "0x1.f71f70p-1"),
        ("0x1.c81bbap-3", "0x1.fc2786p-1"),
        ("0x1.011ddap-18", "0x1.ffeff8p-1"),
        ("0x1.80031cp-7", "0x1.818ad6p-7"),
    ],
    "float64": [
        ("0x1.e898ee75f23cfp-3", "0x1.c844d6fedd815p-1"),
        ("0x1.044677cde968cp-3", "0x1.fffffffde5f77p-1"),
        ("0x1.064d256c22f3ep-25", "0x1.b7d121d98bfe6p-1"),
        ("0x1.528f43a801557p-26", "0x1.ffffffffffbfbp-1"),
    ],
}


@functools.cache
def certified(name, setting):
    """Rays of a kind and their exact answers."""
    count = 60 if setting.is_scalar else 2000
    drawn = DRAWS[name](np.random.default_rng(zlib.crc32(name.encode())), count, setting.precision)
    cos_i, k = (x.astype(setting.precision) for x in (np.clip(drawn[0], 0, 1), drawn[1]))
    return cos_i, k, oracle.fresnel(cos_i, k)


def number_of(setting):
    return float if setting.is_scalar else dr.value_t(setting.vector)


def evaluate(setting, cos_i, k):
    """R, T, r_s, r_p, and whether each ray is transmitted."""

    def all_results(c, k):
        cos_t, transmitted = fresnel.refracted_cosine(c, k)
        return *fresnel.powers(c, cos_t, transmitted, k), *fresnel.amplitudes(c, k), transmitted

    return evaluated(all_results, setting, cos_i, k)


def relative(x, exact, low, setting):
    return worst(energy.relative(x, exact, low, setting)) / setting.roundoff


def errors(setting, cos_i, k, exact):
    """The worst errors in u of R, of T and of the amplitudes."""
    r, t, s, p, transmitted = evaluate(setting, cos_i, k)
    assert (transmitted == exact.transmitted).all()
    return (
        relative(r, exact.reflectance, exact.reflectance_low, setting),
        relative(t, exact.transmittance, exact.transmittance_low, setting),
        max(relative(x, y, 0, setting) for x, y in ((s, exact.amplitude_s), (p, exact.amplitude_p))),
    )


@pytest.mark.parametrize("name", DRAWS)
def test_powers_are_within_4u_and_amplitudes_within_8u(name, setting):
    r, t, amplitude = errors(setting, *certified(name, setting))
    assert r <= 4 and t <= 4 and amplitude <= 8


@pytest.mark.parametrize("name", DRAWS)
def test_powers_and_amplitudes_if_a_compiler_fuses_products_and_sums(name, fused):
    r, t, amplitude = errors(fused, *certified(name, fused))
    assert r <= 4 and t <= 4 and amplitude <= 8


def test_the_worst_known_rays(setting):
    columns = zip(*WORST[setting.name], strict=True)
    cos_i, k = (np.array([float.fromhex(x) for x in column], setting.precision) for column in columns)
    r, t, amplitude = errors(setting, cos_i, k, oracle.fresnel(cos_i, k))
    assert 2.9 < r <= 4 and 1.9 < t <= 4 and amplitude <= 8


def textbook(cos_i, k):
    """(r_s, r_p) as printed in books, with the square root on the branch of a decaying wave, at 400 bits."""
    with ctx.workprec(400):
        c, k = acb(arb(float(cos_i))), acb(arb(float(k)))
        radicand = 1 - k**2 * (1 - c**2)
        cos_t = radicand.sqrt() if radicand.real >= 0 else -acb(0, 1) * (-radicand).sqrt()
        return (k * c - cos_t) / (k * c + cos_t), (c - k * cos_t) / (c + k * cos_t)


@pytest.mark.parametrize("name", DRAWS)
def test_the_oracle_for_cosines_agrees_with_the_textbook(name):
    cos_i, k = DRAWS[name](np.random.default_rng(3), 50, np.float64)
    cos_i, k = np.clip(cos_i, 0, 1).astype(float), k.astype(float)
    exact = oracle.fresnel(cos_i, k)
    for i in range(len(k)):
        s, p = textbook(cos_i[i], k[i])
        with ctx.workprec(400):
            r = (abs(s) ** 2 + abs(p) ** 2) / 2
            for high, low, expected in (
                (exact.reflectance[i], exact.reflectance_low[i], r),
                (exact.transmittance[i], exact.transmittance_low[i], 1 - r),
            ):
                assert abs(arb(high) + arb(low) - expected) <= 2.0**-95 * abs(expected) + 2.0**-390
            for a, expected in ((exact.amplitude_s[i], s), (exact.amplitude_p[i], p)):
                assert abs(acb(a.real, a.imag) - expected) <= 3e-16 * abs(expected)


def test_the_oracle_for_cosines_gives_nan_for_invalid_input():
    exact = oracle.fresnel(np.array([-0.1, 1.1, np.nan, 0.5, 0.0]), np.array([1.5, 1.5, 1.5, -1.0, 1.5]))
    assert np.isnan(exact.reflectance).tolist() == [True] * 4 + [False]
    assert (exact.reflectance[4], exact.transmittance[4]) == (1, 0)


# Edges ---------------------------------------------------------------------------------------------------------------


def test_a_matched_boundary_does_not_reflect_and_a_tangential_ray_is_reflected(setting):
    cos_i = np.array([1.0, 0.3, 1e-12, 1e-30, 1e-76, 1e-90, 1e-140], setting.precision)
    cos_i = cos_i[cos_i > 0]
    r, t, s, p, transmitted = evaluate(setting, cos_i, np.ones_like(cos_i))
    assert (t == 1).all() and (s == 0).all() and (p == 0).all() and transmitted.all()
    assert (r == 0).all() if setting.name == "float32" else (r <= 1e-170).all()
    k = np.array([0.5, 1.0, 1.5], setting.precision)
    r, t, s, p, transmitted = evaluate(setting, 0 * k, k)
    assert (r == 1).all() and (t == 0).all() and (s == -1).all() and (p == -1).all() and not transmitted.any()
    # A transmitted ray with k = 1 whose refracted cosine underflowed to 0: no 0/0.
    number = number_of(setting)
    for c in (0.02, 0.5):
        r, t = fresnel.powers(number(c), number(0.0), number(1.0) > 0, number(1.0))
        assert (to_numpy(r) == 1).all() and (to_numpy(t) == 0).all()


def test_cosines_next_to_the_critical_angle_are_decided_right(setting):
    """Of the rounded critical cosine and its two neighbours, those are transmitted that the exact numbers transmit."""
    k = np.array([5 / 3], setting.precision)
    exact = np.sqrt(1 - 1 / k.astype(np.longdouble) ** 2).astype(setting.precision)
    cosines = np.concatenate([np.nextafter(exact, 0), exact, np.nextafter(exact, 1)]).astype(setting.precision)
    certified = oracle.fresnel(cosines, np.repeat(k, 3))
    _, t, _, _, transmitted = evaluate(setting, cosines, np.repeat(k, 3))
    assert 0 < certified.transmitted.sum() < 3
    assert (transmitted == certified.transmitted).all() and ((t > 0) == certified.transmitted).all()


def test_the_contrast_is_used_if_k_has_lost_it(setting):
    """For Δn = 3e-8, k rounds to 1 in float32."""
    c, k, contrast = map(number_of(setting), (0.001, 1.0, 6e-8))
    cos_t, transmitted = fresnel.refracted_cosine(c, k, contrast)
    rounded = [np.array([float(to_numpy(x).ravel()[0])]) for x in (c, contrast)]
    exact = oracle.fresnel(rounded[0], np.ones(1), contrast=rounded[1])
    powers = fresnel.powers(c, cos_t, transmitted, k, contrast)
    for power, expected in zip(powers, (exact.reflectance, exact.transmittance), strict=True):
        assert float(to_numpy(power).ravel()[0]) == pytest.approx(expected[0], rel=1e-6)
    assert exact.reflectance[0] > 1e-5


def test_nan_gives_nan(setting):
    nan, half, k = map(number_of(setting), (float("nan"), 0.5, 1.5))
    for cos_i, cos_t, ratio in ((nan, half, k), (half, nan, k), (half, half, nan)):
        for transmitted in (False, True):
            for powers in (fresnel.powers, fresnel.transmitted_powers):
                assert all(np.isnan(np.array(x, float)).all() for x in powers(cos_i, cos_t, transmitted, ratio))
    for cos_i, ratio in ((nan, k), (half, nan)):
        assert all(np.isnan(to_numpy(x)).all() for x in fresnel.amplitudes(cos_i, ratio))


@pytest.mark.parametrize("cos_i", [0, 1])
def test_integers_are_float64(cos_i):
    for k in (2, 0.5):
        cosine = fresnel.refracted_cosine(cos_i, k)
        assert cosine == fresnel.refracted_cosine(float(cos_i), k)
        for powers in (fresnel.powers, fresnel.transmitted_powers):
            assert powers(cos_i, *cosine, k) == powers(float(cos_i), *cosine, k)
        for r, expected in zip(fresnel.amplitudes(cos_i, k), fresnel.amplitudes(float(cos_i), k), strict=True):
            assert dr.all(r == expected)
    assert fresnel.powers(1, 1, True, 1.5) == pytest.approx((0.04, 0.96))


def test_derivatives_are_finite_also_at_the_edges(vectorised):
    number = dr.diff_array_t(dr.value_t(vectorised.vector))
    x = number(np.array([1, 0.3, 0, 0, 0.5, 1e-30, 0.9], vectorised.precision))
    y = number(np.array([1, 1, 1, 1.5, 1.5, 0.5, 0.7], vectorised.precision))
    dr.enable_grad(x, y)
    cos_t, transmitted = fresnel.refracted_cosine(x, y)
    r, t = fresnel.powers(x, cos_t, transmitted, y)
    s, p = fresnel.amplitudes(x, y)
    dr.backward(r + t + dr.real(s) + dr.imag(p))
    assert np.isfinite(np.array([dr.grad(x), dr.grad(y)])).all()


# Polarised -----------------------------------------------------------------------------------------------------------


def matrices(c, ratio):
    cos_t, transmitted = fresnel.refracted_cosine(c, ratio)
    both = fresnel.mueller_reflection(c, ratio), fresnel.mueller_transmission(c, cos_t, transmitted, ratio)
    return [np.array([[to_numpy(x).ravel()[0] for x in row] for row in m], float) for m in both]


@pytest.mark.parametrize("name", ["generic", "critical", "matched"])
def test_mueller_matrices_agree_with_the_certified_amplitudes(name, setting):
    number, (cos_i, k, exact), u = number_of(setting), certified(name, setting), setting.roundoff
    for i in range(8):
        r, t = matrices(number(float(cos_i[i])), number(float(k[i])))
        s, p = exact.amplitude_s[i], exact.amplitude_p[i]
        powers, cross = (abs(s) ** 2, abs(p) ** 2), p * np.conj(s)
        # Two amplitudes with errors of 8u each, their product and the mean: 18u in total.
        assert r[0, 0] == pytest.approx(sum(powers) / 2, rel=18 * u)
        assert r[0, 1] == pytest.approx((powers[0] - powers[1]) / 2, abs=18 * u * sum(powers) / 2)
        assert r[2, 2] + 1j * r[3, 2] == pytest.approx(cross, abs=18 * u * abs(cross))
        assert t[0, 0] == pytest.approx(exact.transmittance[i], rel=18 * u)
        for m in (r, t):
            # Lossless boundaries keep a fully polarised beam fully polarised.
            assert m[0, 0] ** 2 - m[0, 1] ** 2 == pytest.approx(m[2, 2] ** 2 + m[3, 2] ** 2, abs=40 * u * m[0, 0] ** 2)


# In the plugin, whose precision is float32 ---------------------------------------------------------------------------


@pytest.mark.parametrize("formula", ["promoted", "compensated"])
@pytest.mark.parametrize("name", DRAWS)
def test_powers_of_rays_whose_lengths_are_rounded(name, formula, float32):
    """At random azimuths."""
    cos_i, k, _ = certified(name, float32)
    azimuth = np.random.default_rng(5).uniform(0, 2 * np.pi, len(k))
    sine = np.sqrt((1 - cos_i.astype(float)) * (1 + cos_i.astype(float)))
    a = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cos_i], axis=1).astype(np.float32)
    exact = oracle.refract(a, np.tile(np.array([0, 0, 1], a.dtype), (len(k), 1)), k)
    ray, wide = from_numpy(float32.vector, a), from_numpy(dr.float64_array_t(dr.value_t(float32.vector)), k)
    contrast = dr.fma(wide, wide, -1)
    _, transmitted = FORMULAS[formula].unchecked(ray, float32.vector(0, 0, 1), wide, contrast)
    powers = fresnel.local_powers(ray, transmitted, wide, contrast)
    dr.eval(powers, transmitted)
    r, t = map(to_numpy, powers)
    # An error ε ≤ 10·2⁻⁵³ of the radicand changes T by ε/2ρ, which exceeds u/2 only near the critical angle.
    scale = np.maximum(cos_i.astype(float) ** 2, np.abs(k.astype(float) ** 2 - 1) * sine**2)
    far = (exact.cos_t**2 > 10 * 2.0**-53 / float32.roundoff * scale) | ~exact.transmitted
    far &= np.array(transmitted) == exact.transmitted
    assert far.mean() > 0.99
    assert relative(r[far], exact.reflectance[far], exact.reflectance_low[far], float32) <= 2
    assert relative(t[far], exact.transmittance[far], exact.transmittance_low[far], float32) <= 2


def test_the_length_of_the_ray_cancels(float32):
    """An error of 1e-3 of the length changes nothing; the textbook's κ/(k cᵢ + cₜ)² would be wrong by twice that."""
    number = dr.value_t(float32.vector)
    k, contrast, powers = number(1.5), number(1.25), []
    for length in (1.0, 1.001):
        a = float32.vector(0.28 * length, 0, 0.96 * length)
        _, transmitted = FORMULAS["promoted"](a, float32.vector(0, 0, 1), k, contrast)
        powers.append([float(to_numpy(x).ravel()[0]) for x in fresnel.local_powers(a, transmitted, k, contrast)])
    assert powers[1] == pytest.approx(powers[0], rel=8 * float32.roundoff)
