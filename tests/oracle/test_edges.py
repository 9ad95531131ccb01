"""The oracle where it must decide: critical and tangential rays, the last bit, wrong inputs, its doubts."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

oracle = pytest.importorskip("mi_refract.oracle", reason="needs python-flint", exc_type=ImportError)

Z = np.array([[0.0, 0.0, 1.0]])
TINY, HUGE = 5e-324, 2.0**1023


def rays(size=40):
    """Random a and n of random length, k on both sides of 1."""
    rng = np.random.default_rng(11)
    return rng.normal(size=(size, 3)), rng.normal(size=(size, 3)), rng.uniform(0.4, 2.5, size)


def same(c, d):
    return all(np.array_equal(getattr(c, f.name), getattr(d, f.name), equal_nan=True) for f in dataclasses.fields(c))


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
    assert (c.reflectance[1], c.reflectance_low[1], c.transmittance[1]) == (1, 0, 0)
    assert c.amplitude_s[1] == 1 and c.amplitude_p[1] == 1


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
    through = dataclasses.replace(c, transmitted=np.ones(4, bool))
    assert oracle.residual(a, n, k, through).holds.tolist() == [True, False, False, False]


@pytest.mark.parametrize("k", [-1.5, -1e-300])
def test_negative_k_is_invalid(k):
    c = oracle.refract(-Z, Z, k)
    assert np.isnan(c.direction).all() and not c.transmitted.any()


def test_single_is_its_exact_double_and_k_broadcasts():
    a, n = (x.astype(np.float32) for x in rays()[:2])
    c = oracle.refract(a, n, 1.5)
    assert same(c, oracle.refract(a.astype(float), n.astype(float), np.full(len(a), 1.5, np.float32)))
    assert not same(c, oracle.refract(a, n, np.nextafter(np.float32(1.5), np.float32(2))))


def test_many_rays_are_each_ray():
    a, n, k = rays(2500)
    c = oracle.refract(a, n, k)
    a[1::2] = 0  # invalid neighbours must not shift the rest
    d = oracle.refract(a, n, k)
    assert np.array_equal(c.direction[::2], d.direction[::2]) and np.isnan(d.direction[1::2]).all()
    assert len(oracle.refract(a[:0], n[:0], k[:0])) == 0


def test_contrast_decides_where_k_is_blind():
    a = np.array([[1, 0, -1e-11]])
    outcomes = [oracle.refract(a, Z, 1, contrast=e).transmitted[0] for e in (9e-23, 1.1e-22)]
    assert outcomes == [True, False]
    assert same(oracle.refract(a, Z, 1.25), oracle.refract(a, Z, 1.0, contrast=0.5625))
    assert np.isnan(oracle.refract(a, Z, 1, contrast=-1.0).direction).all()
    blind = oracle.refract(a, Z, 1)
    assert not oracle.residual(a, Z, 1, blind, contrast=9e-23).holds.any()


def test_without_fresnel_only_fresnel_is_missing():
    a, n, k = rays()
    c, d = oracle.refract(a, n, k), oracle.refract(a, n, k, fresnel=False)
    assert np.array_equal(c.direction_low, d.direction_low) and np.array_equal(c.cos_t, d.cos_t)
    assert np.isnan(d.reflectance).all() and np.isnan(d.amplitude_s).all()
    assert not np.isnan(c.reflectance).any() and not np.isnan(c.amplitude_s).any()


# Derivatives. -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [0.7, 1.0, 1.4, 30.0])
def test_derivatives_are_quotients_of_differences(k):
    """Of transmitted and of totally reflected rays of any length, along a and along k; of R, which is even in k."""
    (a, n, _), h = rays(30), 1e-6
    along, along_k = np.random.default_rng(5).normal(size=a.shape), 0.3

    def b(step):
        moved = a + step * along
        return oracle.refract(moved, n, k + step * along_k).direction * np.linalg.norm(moved, axis=1)[:, None]

    certified = oracle.refract(a, n, k)
    assert (~certified.transmitted).any() == (k > 1) and certified.transmitted.any() == (k < 30)
    # Where the answer bends little within h.
    far = (np.abs(oracle.relative_radicand(a, n, np.full(len(a), k))) > 0.01) & (certified.cos_i > 0.05)
    exact = oracle.derivatives.derivative(a, n, k, along, along_k)
    assert far.sum() > 20
    np.testing.assert_allclose(exact[far], ((b(h) - b(-h)) / (2 * h))[far], rtol=1e-5, atol=1e-6)
    cos_i = certified.cos_i[far]
    slope = oracle.derivatives.derivative_of_powers(cos_i, k, np.full(len(cos_i), 0.2), along_k)
    above, below = (oracle.fresnel(cos_i + step * 0.2, k + step * along_k).reflectance for step in (h, -h))
    np.testing.assert_allclose(slope, (above - below) / (2 * h), rtol=1e-5, atol=1e-8)


# Precision, progress, errors. -------------------------------------------------------------------------------


def test_the_working_precision_of_others_is_left_alone():
    from flint import ctx

    before = ctx.prec
    oracle.residual(-Z, Z, 1.5, oracle.refract(-Z, Z, 1.5))
    assert ctx.prec == before


@pytest.mark.parametrize(
    ("count", "progress", "terminal"), [(10**5, 1, 1), (10**5, 1, 0), (10**5, 0, 1), (10**4, 1, 1)]
)
def test_a_bar_is_shown_on_a_terminal_for_many_rays(count, progress, terminal, monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")  # a dumb terminal shows no bar
    monkeypatch.setattr(sys.stderr, "isatty", lambda: bool(terminal))
    nothing = np.zeros((count, 3))  # invalid rays, which take no time
    assert len(oracle.refract(nothing, nothing, 1.5, progress=bool(progress))) == count
    shown = capsys.readouterr()
    assert ("oracle" in shown.err) == (count == 10**5 and bool(progress and terminal)) and not shown.out


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
    with pytest.raises(ValueError, match=rf"^oracle: {name} .*; expected [^\n]*$"):
        oracle.refract(a, n, k)


def test_residual_wants_as_many_answers_as_rays():
    with pytest.raises(ValueError, match="certified holds 1 rays; expected 5"):
        oracle.residual(V, V, 1.5, oracle.refract(V[:1], V[:1], 1.5))


def test_missing_flint_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "flint", None)
    spec = importlib.util.spec_from_file_location("oracle_without_flint", oracle.__file__)
    with pytest.raises(ImportError, match=r"python-flint: pip install 'mi-refract\[validation\]'$"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


def test_imports_nothing_of_ours():
    for file in Path(oracle.__file__).parent.glob("*.py"):
        tree = ast.parse(file.read_text())
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
        names = {getattr(node, "module", None) or alias.name for node in imports for alias in node.names}
        assert not any(name.startswith(("mi_refract", "drjit", "mitsuba")) for name in names), file
        assert all(getattr(node, "level", 0) <= 1 for node in imports), file  # 1: its own room
