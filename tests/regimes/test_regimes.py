"""Each regime agrees with its text, in exact arithmetic if the text is exact, and is reproducible."""

from fractions import Fraction

import numpy as np
import pytest

from mi_refract.accuracy import lengths
from mi_refract.regimes import REGIMES, make, make_given, normalised, radicand, radicand_and_gradient

oracle = pytest.importorskip("mi_refract.oracle", reason="needs python-flint", exc_type=ImportError)

COUNT = 600
GIVEN = [name for name, regime in REGIMES.items() if regime.takes_k]


@pytest.fixture(params=[np.float32, np.float64], ids=lambda p: p.__name__)
def precision(request):
    return request.param


def exactly(rays):
    """(n·a, D, |terms|) of every ray as fractions."""
    for a, n, k in zip(rays.a.tolist(), rays.n.tolist(), rays.k.tolist(), strict=True):
        a, n, k2 = list(map(Fraction, a)), list(map(Fraction, n)), Fraction(k) ** 2
        c = sum(x * y for x, y in zip(a, n, strict=True))
        w2 = sum(x * x for x in a) * sum(x * x for x in n) - c * c
        yield c, c * c - (k2 - 1) * w2, max(c * c, abs(k2 - 1) * w2)


def cosine(rays):
    return np.abs((rays.a.astype(np.longdouble) * rays.n).sum(1)) / (lengths(rays.a) * lengths(rays.n))


def sine(rays):
    return lengths(np.cross(rays.a.astype(np.longdouble), rays.n)) / (lengths(rays.a) * lengths(rays.n))


def roundoff(precision):
    return float(np.finfo(precision).eps) / 2


@pytest.mark.parametrize("regime", REGIMES)
def test_rays_are_valid_within_the_bounds_of_their_regime_and_reproducible(regime, precision):
    rays, entry = make(regime, COUNT, precision, seed=1), REGIMES[regime]
    assert {x.dtype.type for x in (rays.a, rays.n, rays.k)} == {precision}
    assert (rays.a.shape, rays.n.shape, rays.k.shape) == ((COUNT, 3), (COUNT, 3), (COUNT,))
    assert all(np.isfinite(x).all() for x in (rays.a, rays.n, rays.k))
    assert rays.a.any(axis=1).all() and rays.n.any(axis=1).all()
    assert rays.k.min() >= 0.999e-6 and rays.k.max() <= entry.largest_k
    # √3/2 u from rounding, plus the last ulps of "to the ulp".
    length_error = max(np.abs(lengths(rays.a) - 1).max(), np.abs(lengths(rays.n) - 1).max()) / roundoff(precision)
    assert (length_error <= 1.5) == entry.unit
    same, other = make(regime, COUNT, precision, 1), make(regime, COUNT, precision, 2)
    assert all(getattr(rays, x).tobytes() == getattr(same, x).tobytes() for x in "ank")
    assert (rays.a != other.a).any() and (rays.k != other.k).any()


def test_regimes_differ_and_an_unknown_one_is_an_error(precision):
    assert len({make(regime, 8, precision).a.tobytes() for regime in REGIMES}) == len(REGIMES)
    with pytest.raises(KeyError):
        make("nowhere", 1, precision)


@pytest.mark.parametrize(
    ("regime", "quantity", "low", "high"),
    [
        ("near-normal", sine, 0, 1.01e-2),
        ("grazing", cosine, 0, 1.01e-2),
        ("matched, grazing", cosine, 0, 1.01e-1),
        ("matched", lambda rays: np.abs(rays.k.astype(np.float64) - 1), 0, 1.01e-2),
        ("Brewster", lambda rays: np.abs(cosine(rays) / sine(rays) - rays.k) / (1 + rays.k**2), 0, 1.05e-2),
        ("critical", lambda rays: np.abs(np.arcsin(np.minimum(1, sine(rays))) - np.arcsin(1 / rays.k)), 0, 1.05e-2),
        ("k ≫ 1", lambda rays: rays.k * sine(rays), 0, 1.21),
        ("k ≪ 1", lambda rays: rays.k, 0.99e-6, 0.1),
        ("lengths", lambda rays: lengths(rays.a), 1e-18, 1e18),
        ("lengths", lambda rays: lengths(rays.n), 1e-18, 1e18),
    ],
)
def test_quantities_fill_the_range_in_the_text(regime, quantity, low, high, precision):
    values = quantity(make(regime, 4000, precision, seed=2)).astype(float)
    slack = 8 * roundoff(precision)
    assert (values >= low * (1 - slack)).all() and (values <= high * (1 + slack) + slack).all()
    assert values.max() > 0.8 * high / (1 if low == 0 else 2)
    assert values.min() <= (1e-3 * high if low == 0 else 2 * low)


def test_exact_regimes_are_exact(precision):
    """Tangential rays, critical rays and denormal cosines of both signs, in many directions without zeros."""
    rays = make("tangential", COUNT, precision, seed=3)
    assert all(c == 0 for c, _, _ in exactly(rays)) and rays.a.all(axis=1).sum() > COUNT / 4
    rays = make("exactly critical", COUNT, precision, seed=3)
    assert {d for _, d, _ in exactly(rays)} == {0} and len(np.unique(rays.k)) >= 8
    assert (rays.a.all(axis=1) & rays.n.all(axis=1)).sum() > COUNT / 2
    assert len({(*a, *n) for a, n in zip(rays.a.tolist(), rays.n.tolist(), strict=True)}) > 0.99 * COUNT
    rays, least = make("on a denormal", COUNT, precision, seed=3), float(np.finfo(precision).smallest_normal)
    assert all(0 < abs(c) < least for c, _, _ in exactly(rays))
    assert 0.2 < oracle.refract(rays.a, rays.n, rays.k, fresnel=False).transmitted.mean() < 0.8


@pytest.mark.parametrize("regime", ["critical, to the ulp", "critical, any k, to the ulp"])
def test_rays_to_the_ulp_are_on_both_sides_as_near_as_numbers_permit(regime, precision):
    rays, u = make(regime, 4000, precision, seed=3), roundoff(precision)
    margin = np.array([float(d / terms) for _, d, terms in exactly(rays)])
    assert 0.4 < np.mean(margin < 0) < 0.6
    near = np.abs(margin)
    # The margin of rays that are only rounded is u. Half of these are far nearer, and some reach u², the limit of
    # double-word sums.
    assert np.quantile(near, 0.5) < (16 * u if "any" in regime else u / 64)
    assert near.min() < 4 * u * u
    # For rays whose k was adjusted, a neighbouring k changes the decision.
    rays = rays[np.arange(300)]
    ulps = (np.arange(-4, 5)[:, None] * np.spacing(rays.k)).astype(precision)
    signs = [np.sign(oracle.relative_radicand(rays.a, rays.n, rays.k + step)) for step in ulps]
    assert "any" in regime or (np.ptp(signs, axis=0) == 2).mean() > 0.95


def test_zeros_denormal_components_and_lengths_off_unit(precision):
    rays = make("axes, signed zeros", COUNT, precision, seed=3)
    for v in (rays.a, rays.n):
        assert np.signbit(v[v == 0]).any() and not np.signbit(v[v == 0]).all()
    zeros = (rays.n == 0).sum(axis=1)
    assert set(zeros) == {1, 2} and (np.abs(rays.n[zeros == 2]).max(axis=1) == 1).all()
    assert all(c != 0 for c, _, _ in exactly(rays))
    rays, least = make("denormal", COUNT, precision, seed=3), np.finfo(precision).smallest_normal
    assert all(((v != 0) & (np.abs(v) < least)).any(axis=1).mean() > 0.3 for v in (rays.a, rays.n))
    assert cosine(rays).min() > 1e-8
    rays = make("off unit", 4000, precision, seed=3)
    assert all(1.5 < np.abs(lengths(v) - 1).max() / roundoff(precision) < 12 for v in (rays.a, rays.n))


def test_a_given_normal_replaces_the_random_ones(precision):
    rays = make("critical, to the ulp", 50, precision, normal=(0, -1, 0))
    assert (rays.n == (0, -1, 0)).all()
    assert np.abs(oracle.relative_radicand(rays.a, rays.n, rays.k)).max() < 200 * roundoff(precision)


# Sums of floats ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("regime", [name for name, entry in REGIMES.items() if not entry.rests_on_denormals])
def test_the_radicand_in_sums_of_floats_is_within_its_bound(regime, precision):
    rays, bound = make(regime, 150, precision, seed=9), Fraction(2) ** -140
    c, d, terms = radicand(rays.a.T.astype(float), rays.n.T.astype(float), rays.k.astype(float))
    for i, (exact_c, exact_d, larger) in enumerate(exactly(rays)):
        assert abs(sum(Fraction(float(x[i])) for x in d) - exact_d) <= bound * larger
        assert abs(sum(Fraction(float(x[i])) for x in c) - exact_c) <= bound * abs(exact_c)
        assert larger * Fraction(1, 2) <= Fraction(float(terms[i])) <= larger * Fraction(5, 2)
        assert [abs(x[i]) for x in d] == sorted((abs(x[i]) for x in d), reverse=True)


def test_derivatives_of_the_radicand_and_normalised_vectors():
    rays = make("critical", 40, np.float64, seed=5)
    d, along = radicand_and_gradient(rays.a, rays.n, rays.k)
    for j in range(7):
        numbers = np.column_stack([rays.a, rays.n, rays.k])
        numbers[:, j] += 1e-7
        moved, _ = radicand_and_gradient(numbers[:, :3], numbers[:, 3:6], numbers[:, 6])
        assert (moved - d) / 1e-7 == pytest.approx(along[:, j], rel=1e-4, abs=1e-5)
    v = normalised(np.random.default_rng(1).normal(size=(1000, 3))).astype(np.float64)
    assert np.abs(lengths(v) - 1).max() <= 0.5 * 3**0.5 * 2.0**-53


# Given ratios -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GIVEN)
def test_given_ratios_replace_the_regimes_own(name, precision):
    ratios = np.linspace(1.1, 2.4, COUNT)
    rays, own = make_given(name, ratios, precision, 3), make(name, COUNT, precision, 3)
    np.testing.assert_array_equal(rays.k, ratios.astype(precision))
    assert rays.a.dtype == rays.n.dtype == rays.k.dtype == precision
    same = [np.array_equal(getattr(rays, vector), getattr(own, vector)) for vector in "an"]
    assert same == [REGIMES[name].any_k, True]
    if angle := {"critical": np.arcsin, "Brewster": np.arctan}.get(name):
        error = (np.arctan2(sine(rays), cosine(rays)) - angle(1 / rays.k.astype(float))).astype(float)
        assert np.abs(error).max() < 1e-2 + 1e-6
        assert min((error > 0).mean(), (error < 0).mean()) > 0.3
        assert (np.abs(error) > 1e-4).any() and (np.abs(error) < 1e-5).any()


def test_given_ratios_that_are_not_accepted():
    for name in set(REGIMES) - set(GIVEN):
        with pytest.raises(ValueError, match=r"own ratios of indices; expected one of 'generic', .*'tangential'$"):
            make_given(name, [1.5], np.float32)
    with pytest.raises(ValueError, match=r"regime 'critical': k = 0\.9; expected 1 or more"):
        make_given("critical", [1.5, 0.9], np.float64)
    assert make_given("critical", [1.0], np.float64).k == 1
