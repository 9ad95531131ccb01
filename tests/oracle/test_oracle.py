"""The oracle against a second derivation in decimals, exact cases, decisions to the last bit, and invalid input."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import sys
from decimal import Decimal, localcontext
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from mi_refract import regimes

oracle = pytest.importorskip("mi_refract.oracle", reason="needs python-flint", exc_type=ImportError)

Z = np.array([[0.0, 0.0, 1.0]])
TINY, HUGE = 5e-324, 2.0**1023
EXACT = 2.0**-100  # relative error allowed for a pair of doubles


def rays(size=40):
    """Random a and n of random length, k on both sides of 1."""
    rng = np.random.default_rng(11)
    return rng.normal(size=(size, 3)), rng.normal(size=(size, 3)), rng.uniform(0.4, 2.5, size)


def skimming(rng, size):
    """Cosines of incidence down to 1e-100."""
    angle, cos_i = rng.uniform(0, 6.3, size), 10.0 ** rng.uniform(-100, -20, size)
    a = np.column_stack([np.cos(angle), np.sin(angle), rng.choice([-1, 1], size) * cos_i])
    return a, Z.repeat(size, 0), rng.uniform(0.5, 1, size)


def denormal_directions(rng, size):
    """Directions in multiples of the smallest number, normals near the largest."""
    a, n, k = rays(size)
    return np.round(a * 1000) * TINY, n / np.abs(n).max(1, keepdims=True) * 1e307, k


EXTREMES = {"skimming": skimming, "denormal directions": denormal_directions}
REGIMES = [*(name for name in regimes.REGIMES if name not in ("tangential", "exactly critical")), *EXTREMES]


def regime_rays(name, size):
    """Rays of a regime, half of them in float32, half in float64."""
    if name in EXTREMES:
        return EXTREMES[name](np.random.default_rng(7), size)
    parts = [regimes.make(name, size // 2, precision, seed=7) for precision in (np.float32, np.float64)]
    return tuple(np.concatenate([getattr(part, x).astype(float) for part in parts]) for x in ("a", "n", "k"))


def pairs(high, low):
    """The exact values of pairs of doubles."""
    return list(map(lambda h, m: Fraction(h) + Fraction(m), np.ravel(high).tolist(), np.ravel(low).tolist()))


def same(c, d):
    return all(np.array_equal(getattr(c, f.name), getattr(d, f.name), equal_nan=True) for f in dataclasses.fields(c))


# A second derivation: tangents of the angles, Newton's method, decimal arithmetic ------------------------------------


def dot(u, v):
    return sum(x * y for x, y in zip(u, v, strict=True))


def tangent_of_refraction(sine):
    """tan θt from sin θt = tan/√(1 + tan²), which is concave: Newton's method increases and never passes the root."""
    tan = sine
    for _ in range(400):
        step = (sine - tan / (1 + tan**2).sqrt()) * (1 + tan**2) * (1 + tan**2).sqrt()
        tan += step
        if abs(step) <= tan * Decimal("1e-80"):
            return tan
    raise ArithmeticError(f"Newton's method for the sine {sine} did not converge")


def decimal_snell(a, n, k):
    """(unit b, R, 1 − R), or None under total internal reflection.

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
    if not tan_i:
        r = ((k - 1) / (k + 1)) ** 2
        return n, r, 1 - r
    tan_t = tangent_of_refraction(k * sin_i)
    cos_t = 1 / (1 + tan_t**2).sqrt()
    sin_t = tan_t * cos_t
    b = [sin_t * x / (tan_i * cosine) + cos_t * y for x, y in zip(tangent, n, strict=True)]
    minus, plus = sin_i * cos_t - cos_i * sin_t, sin_i * cos_t + cos_i * sin_t
    tan_minus, tan_plus = minus / (cos_i * cos_t + sin_i * sin_t), plus / (cos_i * cos_t - sin_i * sin_t)
    r = ((minus / plus) ** 2 + (tan_minus / tan_plus) ** 2) / 2
    return b, r, 1 - r


def assert_is_decimal_snell(c, a, n, ratios):
    """Check every ray of `c`: b is within its radius and its high part nearest, R and 1 − R are within EXACT."""
    for i, k in enumerate(ratios):
        answer = decimal_snell(*([Decimal(v) for v in x[i].tolist()] for x in (a, n)), k)
        assert c.transmitted[i] == (answer is not None)
        b, r, t = answer or ((), None, None)
        for x, high, low in zip(b, c.direction[i].tolist(), c.direction_low[i].tolist(), strict=answer is not None):
            assert abs(Decimal(high) + Decimal(low) - x) <= Decimal(float(c.radius[i]))
            assert float(x) == high or abs(x) < 2.3e-308  # a denormal number
        for x, high, low in ((r, c.reflectance, c.reflectance_low), (t, c.transmittance, c.transmittance_low)):
            off = abs(Decimal(float(high[i])) + Decimal(float(low[i])) - (x or 0)) if answer else 0
            assert off <= (x or 0) * Decimal(EXACT) + Decimal(2.0**-1070)


@pytest.mark.parametrize("name", REGIMES)
def test_the_oracle_agrees_with_newtons_method(name):
    a, n, k = regime_rays(name, 60)
    c = oracle.refract(a, n, k)
    assert c.radius.max() <= 1e-30 and not c.undecided.any()
    with localcontext() as context:
        context.prec = 1500 if "denormal" in name else 250
        assert_is_decimal_snell(c, a, n, map(Decimal, k.tolist()))


@pytest.mark.parametrize("contrast", [0.5625, 1e-20, -1e-20, 1e-100, -0.999, 1e12])
def test_contrast_is_exactly_k2_minus_1(contrast):
    a, n, _ = rays()
    c = oracle.refract(a, n, (1 + contrast) ** 0.5, contrast=contrast)
    with localcontext() as context:
        context.prec = 400
        assert_is_decimal_snell(c, a, n, [(1 + Decimal(contrast)).sqrt()] * len(a))


@pytest.mark.parametrize("name", REGIMES)
def test_total_reflection_is_the_sandwich_product_and_k_1_changes_nothing(name):
    """b = −n a n/|n|², computed in fractions."""
    a, n, _ = regime_rays(name, 40)
    mirrored, through = oracle.refract(a, n, 1e300), oracle.refract(a, n, 1)
    assert (~mirrored.transmitted).sum() > len(a) / 4
    assert through.transmitted.all() and (through.reflectance == 0).all() and (through.transmittance == 1).all()
    for i in range(len(a)):
        x, u = [Fraction(v) for v in a[i].tolist()], [Fraction(v) for v in n[i].tolist()]
        for c, factor in ((mirrored, 2), (through, 0))[bool(mirrored.transmitted[i]) :]:
            for j, b in enumerate(pairs(c.direction[i], c.direction_low[i])):
                expected = x[j] - factor * dot(x, u) * u[j] / dot(u, u)
                # Compare squares, to avoid the root in |a|: |b² − m²| ≤ (|b| + |m|) radius ≤ 3 radius.
                assert abs(b * b - expected**2 / dot(x, x)) <= 3 * Fraction(float(c.radius[i]))
                assert b * expected >= 0


@pytest.mark.parametrize("name", REGIMES)
def test_the_side_of_n_and_powers_of_two_change_nothing(name):
    a, n, k = regime_rays(name, 40)
    c = oracle.refract(a, n, k)
    assert same(c, oracle.refract(a, -n, k))
    assert name == "denormal" or same(c, oracle.refract(a * 8, n / 4, k))
    assert not same(c, oracle.refract(-a, n, k))


# Exact cases ---------------------------------------------------------------------------------------------------------


def test_brewster_in_fractions():
    """sin θi = 4/5, k = 3/4: sin θt = 3/5, θi + θt = 90°, a_p = 0, a_s = −7/25."""
    a = np.array([[4.0, 0, -3], [-4e9, 0, 3e9]])
    c = oracle.refract(a, Z.repeat(2, 0), 0.75)
    for sign, row in ((1, 0), (-1, 1)):
        for b, x in zip(pairs(c.direction[row], c.direction_low[row]), (3, 0, -4), strict=True):
            assert abs(b - sign * Fraction(x, 5)) <= Fraction(float(c.radius[row]))
    assert (c.amplitude_p == 0).all() and (c.amplitude_s == -7 / 25).all()
    assert all(abs(r - Fraction(49, 1250)) <= r * Fraction(EXACT) for r in pairs(c.reflectance, c.reflectance_low))
    assert c.cos_i.tolist() == [0.6, 0.6] and c.cos_t.tolist() == [0.8, 0.8]


# a = p u + q n, u ⊥ n of the same length: sin²θi = p²/(p² + q²) = 1/k² in dyadic numbers.
CRITICAL = {
    "3-4-5": ([4, 0, -3], [0, 0, 1], 1.25),
    "from behind": ([4, 0, 3], [0, 0, 1], 1.25),
    "8-15-17": ([15, 8, 0], [1, 0, 0], 2.125),
    "16-63-65": ([0, 63, -16], [0, -3, 0], 4.0625),
    "irrational length": ([1, -7, 0], [1, 1, 0], 1.25),
    "oblique": ([-2, 5, 14], [2, 1, -2], 1.25),
    "long and short": ([4e18, 0, -3e18], [0, 0, 7e-18], 1.25),
    "denormal": ([4 * TINY, 0, -3 * TINY], [0, 0, 2.0**1000], 1.25),
    "overflowing": ([HUGE, 0, -3 * 2.0**1021], [0, 0, -1e308], 1.25),
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
    assert (c.reflectance[1], c.reflectance_low[1], c.transmittance[1]) == (1, 0, 0)
    assert c.amplitude_s[1] == 1 and c.amplitude_p[1] == 1


@pytest.mark.parametrize("k", [0.5, 1.0, 2.0])
@pytest.mark.parametrize(
    ("a", "length", "n"), [([3, 4, 0], 5, [0, 0, 7]), ([1, 2, 2], 3, [2, 1, -2]), ([1e300, 0, 0], 1e300, [0, 1e300, 0])]
)
def test_tangential_rays_keep_their_direction(a, length, n, k):
    a, n = np.array([a], float), np.array([n], float)
    c = oracle.refract(a, n, k)
    assert not c.transmitted[0] and np.array_equal(c.direction, a / length)
    assert (c.cos_i[0], c.cos_t[0], c.reflectance[0], c.transmittance[0]) == (0, 0, 1, 0)
    assert c.amplitude_s[0] == c.amplitude_p[0] == -1


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
        ([1, 0, TINY], [0, 0, 1], 0.5, True, 1),  # the smallest cosine
        ([1, 0, -TINY], [0, 0, 1], 0.5, True, -1),
        ([1, 0, TINY], [0, 0, 1], 1 + 2.0**-52, False, 0),
    ],
)
def test_decisions_are_right_to_the_last_bit(a, n, k, transmitted, side):
    """The signs of n·a and of the radicand for numbers of 2^±2000. `side`: the side of n on which b leaves."""
    a, n = np.array([a], float), np.array([n], float)
    c = oracle.refract(a, n, k)
    assert not c.undecided[0] and c.transmitted[0] == transmitted
    assert not transmitted or np.sign(c.direction[0] @ (n[0] / np.abs(n).max())) == side


def test_contrast_decides_if_k_rounds_to_1():
    a = np.array([[1, 0, -1e-11]])
    outcomes = [oracle.refract(a, Z, 1, contrast=e).transmitted[0] for e in (9e-23, 1.1e-22)]
    assert outcomes == [True, False]
    assert same(oracle.refract(a, Z, 1.25), oracle.refract(a, Z, 1.0, contrast=0.5625))
    assert np.isnan(oracle.refract(a, Z, 1, contrast=-1.0).direction).all()


def test_the_relative_radicand_near_and_at_the_critical_angle():
    """An exactly critical ray, its neighbours, a tangential ray and an invalid ray."""
    a = np.array([[4, 0, -3], [4, 0, -3], [4, 0, -3], [1, 0, 0], [np.nan, 0, 1]], np.float64)
    k = np.array([1.25, np.nextafter(1.25, 2), np.nextafter(1.25, 1), 1.25, 1.25])
    margin = oracle.relative_radicand(a, Z.repeat(5, 0), k)
    # D = 9 − 16 (k² − 1), terms 9.
    expected = [float((9 - 16 * (Fraction(float(x)) ** 2 - 1)) / 9) for x in k[:3]]
    assert margin[:3] == pytest.approx(expected, rel=1e-9, abs=0)
    assert margin[3] == -1 and np.isnan(margin[4])


# Derivatives ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [0.7, 1.0, 1.4, 30.0])
def test_derivatives_agree_with_finite_differences(k):
    """For transmitted and totally reflected rays of any length, along a and along k; also for R."""
    (a, n, _), h = rays(30), 1e-6
    along, along_k = np.random.default_rng(5).normal(size=a.shape), 0.3

    def b(step):
        moved = a + step * along
        return oracle.refract(moved, n, k + step * along_k).direction * np.linalg.norm(moved, axis=1)[:, None]

    certified = oracle.refract(a, n, k)
    assert (~certified.transmitted).any() == (k > 1) and certified.transmitted.any() == (k < 30)
    # Only rays whose answer is nearly linear within h.
    far = (np.abs(oracle.relative_radicand(a, n, np.full(len(a), k))) > 0.01) & (certified.cos_i > 0.05)
    exact = oracle.derivatives.derivative(a, n, k, along, along_k)
    assert far.sum() > 20
    np.testing.assert_allclose(exact[far], ((b(h) - b(-h)) / (2 * h))[far], rtol=1e-5, atol=1e-6)
    cos_i = certified.cos_i[far]
    slope = oracle.derivatives.derivative_of_powers(cos_i, k, np.full(len(cos_i), 0.2), along_k)
    above, below = (oracle.fresnel(cos_i + step * 0.2, k + step * along_k).reflectance for step in (h, -h))
    np.testing.assert_allclose(slope, (above - below) / (2 * h), rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("name", ["grazing", "critical", "k ≫ 1", "matched, grazing"])
def test_derivatives_obey_the_derivative_of_snells_law(name):
    """From n × b = k n × a and |b| = |a|: n × b' = k' n × a + k n × a', b·b' = a·a'; mirrored, k = 1."""
    rng, sample = np.random.default_rng(4), regimes.make(name, 60, np.float64, seed=6)
    a, n, k, e, e_k = sample.a, sample.n, sample.k, rng.normal(size=(60, 3)), rng.normal(size=60)
    exact, b_prime = oracle.refract(a, n, k), oracle.derivatives.derivative(a, n, k, e, e_k)
    ratio, change = (np.where(exact.transmitted, x, y)[:, None] for x, y in ((k, 1), (e_k, 0)))
    b = exact.direction * np.linalg.norm(a, axis=1, keepdims=True)
    size = np.maximum(1, np.linalg.norm(b_prime, axis=1) * np.maximum(1, k))
    across = np.cross(n, b_prime) - change * np.cross(n, a) - ratio * np.cross(n, e)
    assert (np.linalg.norm(across, axis=1) <= 1e-13 * size).all()
    assert (np.abs((b * b_prime).sum(1) - (a * e).sum(1)) <= 1e-13 * size).all()


def test_derivatives_are_nan_at_the_critical_angle_and_for_tangential_rays():
    a = np.array([[4.0, 0, 3.0]] * 2 + [[1.0, 0, 0]])  # k² sin² = 1 for k = 5/4
    result = oracle.derivatives.derivative(a, Z.repeat(3, 0), np.array([1.25, 1.25 + 1e-9, 1.5]), a, 0.0)
    assert np.isnan(result).all(1).tolist() == np.isnan(result).any(1).tolist() == [True, False, True]


# Arguments -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("bad", [0, np.nan, np.inf, -np.inf])
def test_invalid_rays_are_nan(bad, dtype):
    a, n = np.tile(np.array([0.6, 0, -0.8], dtype), (5, 1)), Z.repeat(5, 0).astype(dtype)
    k = np.full(5, 1.5, dtype)
    a[1, ::2], n[2, 2], k[3], k[4] = bad, bad, bad, -1.5
    c = oracle.refract(a, n, k)
    assert c.transmitted.tolist() == [True, False, False, False, False]
    assert np.isnan(c.direction).all(axis=1).tolist() == [False, True, True, True, True]
    assert np.isnan(c.reflectance).tolist() == [False, True, True, True, True]
    assert not c.undecided.any()


def test_float32_is_exact_and_rays_do_not_affect_each_other():
    a, n = (x.astype(np.float32) for x in rays()[:2])
    c = oracle.refract(a, n, 1.5)
    assert same(c, oracle.refract(a.astype(float), n.astype(float), np.full(len(a), 1.5, np.float32)))
    assert not same(c, oracle.refract(a, n, np.nextafter(np.float32(1.5), np.float32(2))))
    a, n, k = rays(2500)
    c = oracle.refract(a, n, k)
    a[1::2] = 0  # invalid neighbours must not affect the others
    d = oracle.refract(a, n, k, fresnel=False)
    assert np.array_equal(c.direction_low[::2], d.direction_low[::2]) and np.isnan(d.direction[1::2]).all()
    assert np.array_equal(c.cos_t[::2], d.cos_t[::2])
    assert np.isnan(d.reflectance).all() and np.isnan(d.amplitude_s).all() and not np.isnan(c.reflectance).any()
    assert len(oracle.refract(a[:0], n[:0], k[:0])) == 0


def test_the_working_precision_of_flint_is_restored():
    from flint import ctx

    before = ctx.prec, ctx.cap
    oracle.refract(-Z, Z, 1.5)
    oracle.derivatives.derivative(-Z, Z, 1.5, Z, 0.0)
    assert (ctx.prec, ctx.cap) == before


@pytest.mark.parametrize(
    ("count", "progress", "terminal"), [(10**5, 1, 1), (10**5, 1, 0), (10**5, 0, 1), (10**4, 1, 1)]
)
def test_a_progress_bar_is_shown_on_a_terminal_for_many_rays(count, progress, terminal, monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")  # a dumb terminal shows no bar
    monkeypatch.setattr(sys.stderr, "isatty", lambda: bool(terminal))
    nothing = np.zeros((count, 3))  # invalid rays, which take no time
    assert len(oracle.refract(nothing, nothing, 1.5, progress=bool(progress))) == count
    output = capsys.readouterr()
    assert ("oracle" in output.err) == (count == 10**5 and bool(progress and terminal)) and not output.out


V = np.ones((5, 3))


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        *(("a is", (a, V, 1.5)) for a in (1.0, V[:, :2], V.astype(int), V.astype(np.longdouble))),
        *(("n is", (V, n, 1.5)) for n in (V[:4], V[0])),
        *(("k is", (V, V, k)) for k in (np.ones(4), V, "1.5", 1j)),
    ],
)
def test_errors_of_shapes_and_dtypes_are_one_line(name, arguments):
    with pytest.raises(ValueError, match=rf"^oracle: {name} .*; expected [^\n]*$"):
        oracle.refract(*arguments)


def test_the_error_without_flint_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flint", None)
    spec = importlib.util.spec_from_file_location("oracle_without_flint", oracle.__file__)
    with pytest.raises(ImportError, match=r"python-flint: pip install 'mi-refract\[validation\]'$"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


def test_the_oracle_imports_no_other_code_of_this_package():
    for file in Path(oracle.__file__).parent.glob("*.py"):
        tree = ast.parse(file.read_text())
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
        names = {getattr(node, "module", None) or alias.name for node in imports for alias in node.names}
        assert not any(name.startswith(("mi_refract", "drjit", "mitsuba")) for name in names), file
        assert all(getattr(node, "level", 0) <= 1 for node in imports), file  # 1: its own folder
