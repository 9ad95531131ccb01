"""Each regime is what its text says, in exact arithmetic where the text is exact, and can be made again."""

from fractions import Fraction

import numpy as np
import pytest

from mi_refract.regimes import REGIMES, make, make_given, normalised, radicand, radicand_and_gradient

oracle = pytest.importorskip("mi_refract.oracle", reason="needs python-flint", exc_type=ImportError)

PRECISIONS = (np.float32, np.float64)
COUNT = 600


@pytest.fixture(params=PRECISIONS, ids=lambda p: p.__name__)
def precision(request):
    return request.param


def exactly(rays, i):
    """(n·a, D, |terms|) of ray i as fractions."""
    a, n = ([Fraction(float(x)) for x in v[i]] for v in (rays.a, rays.n))
    k2 = Fraction(float(rays.k[i])) ** 2
    c = sum(x * y for x, y in zip(a, n, strict=True))
    w2 = sum(x * x for x in a) * sum(x * x for x in n) - c * c
    return c, c * c - (k2 - 1) * w2, max(c * c, abs(k2 - 1) * w2)


def lengths(v):
    wide = v.astype(np.longdouble)
    return np.sqrt((wide * wide).sum(1))


def cosine(rays):
    a, n = rays.a.astype(np.longdouble), rays.n.astype(np.longdouble)
    return np.abs((a * n).sum(1)) / (lengths(a) * lengths(n))


def sine(rays):
    a, n = rays.a.astype(np.longdouble), rays.n.astype(np.longdouble)
    return lengths(np.cross(a, n)) / (lengths(a) * lengths(n))


def roundoff(precision):
    return float(np.finfo(precision).eps) / 2


@pytest.mark.parametrize("regime", REGIMES)
def test_rays_are_refractions_within_the_bounds_of_the_regime(regime, precision):
    rays, entry = make(regime, COUNT, precision, seed=1), REGIMES[regime]
    assert {x.dtype.type for x in (rays.a, rays.n, rays.k)} == {precision}
    assert (rays.a.shape, rays.n.shape, rays.k.shape) == ((COUNT, 3), (COUNT, 3), (COUNT,))
    assert np.isfinite(rays.a).all() and np.isfinite(rays.n).all() and np.isfinite(rays.k).all()
    assert rays.a.any(axis=1).all() and rays.n.any(axis=1).all()
    assert rays.k.min() >= 0.999e-6 and rays.k.max() <= entry.largest_k
    # √3/2 u by rounding, and what the last ulps of "to the ulp" add.
    off = max(np.abs(lengths(rays.a) - 1).max(), np.abs(lengths(rays.n) - 1).max()) / roundoff(precision)
    assert (off <= 1.5) == entry.unit


@pytest.mark.parametrize("regime", REGIMES)
def test_the_same_arguments_give_the_same_rays_and_another_seed_others(regime, precision):
    one, same, other = (make(regime, COUNT, precision, seed) for seed in (4, 4, 5))
    for name in ("a", "n", "k"):
        assert getattr(one, name).tobytes() == getattr(same, name).tobytes()
    assert (one.a != other.a).any() and (one.k != other.k).any()


def test_regimes_have_rays_of_their_own(precision):
    assert len({make(regime, 8, precision).a.tobytes() for regime in REGIMES}) == len(REGIMES)


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
def test_the_range_is_that_of_the_text_and_is_filled(regime, quantity, low, high, precision):
    values = quantity(make(regime, 4000, precision, seed=2)).astype(float)
    slack = 8 * roundoff(precision)
    assert (values >= low * (1 - slack)).all() and (values <= high * (1 + slack) + slack).all()
    assert values.max() > 0.8 * high / (1 if low == 0 else 2)
    assert values.min() <= (1e-3 * high if low == 0 else 2 * low)


def test_tangential_is_exactly_tangential(precision):
    rays = make("tangential", COUNT, precision, seed=3)
    assert all(exactly(rays, i)[0] == 0 for i in range(COUNT))
    assert np.count_nonzero(rays.a.all(axis=1)) > COUNT / 4  # and not for want of components


def test_exactly_critical_has_the_radicand_0_in_many_directions(precision):
    rays = make("exactly critical", COUNT, precision, seed=3)
    assert {exactly(rays, i)[1] for i in range(COUNT)} == {0}
    assert len(np.unique(rays.k)) >= 8
    assert np.count_nonzero(rays.a.all(axis=1) & rays.n.all(axis=1)) > COUNT / 2
    assert len({(*a, *n) for a, n in zip(rays.a.tolist(), rays.n.tolist(), strict=True)}) > 0.99 * COUNT


@pytest.mark.parametrize("regime", ["critical, to the ulp", "critical, any k, to the ulp"])
def test_to_the_ulp_lies_on_both_sides_as_near_as_the_numbers_permit(regime, precision):
    rays, u = make(regime, 4000, precision, seed=3), roundoff(precision)
    margin = np.array([float(d / terms) for _, d, terms in (exactly(rays, i) for i in range(len(rays)))])
    assert 0.4 < np.mean(margin < 0) < 0.6
    near = np.abs(margin)
    # A ray that is merely rounded is off by u: half are far nearer, and some are past u², below any double-word sum.
    assert np.quantile(near, 0.5) < (16 * u if "any" in regime else u / 64)
    assert near.min() < 4 * u * u


def test_neighbouring_ratios_enclose_the_critical_one(precision):
    """For the rays that k brings to the boundary, some k of those next to it decides otherwise."""
    rays = make("critical, to the ulp", 300, precision, seed=6)
    ulps = np.arange(-4, 5)[:, None] * np.spacing(rays.k)
    signs = [np.sign(oracle.relative_radicand(rays.a, rays.n, rays.k + step)) for step in ulps.astype(precision)]
    assert (np.ptp(signs, axis=0) == 2).mean() > 0.95


def test_axes_have_zeros_of_either_sign_and_are_not_tangential(precision):
    rays = make("axes, signed zeros", COUNT, precision, seed=3)
    for v in (rays.a, rays.n):
        zeros = v[v == 0]
        assert np.signbit(zeros).any() and not np.signbit(zeros).all()
    assert (rays.n == 0).any(axis=1).all()
    assert ((rays.n == 0).sum(axis=1) == 2).any()
    assert (np.abs(rays.n[(rays.n == 0).sum(axis=1) == 2]).max(axis=1) == 1).all()
    assert all(exactly(rays, i)[0] != 0 for i in range(COUNT))


def test_denormal_components_are_denormal_and_do_not_decide(precision):
    rays, least = make("denormal", COUNT, precision, seed=3), np.finfo(precision).smallest_normal
    tiny = [(v != 0) & (np.abs(v) < least) for v in (rays.a, rays.n)]
    assert all(t.any(axis=1).mean() > 0.3 for t in tiny)
    assert cosine(rays).min() > 1e-8


def test_on_a_denormal_it_decides(precision):
    rays, least = make("on a denormal", COUNT, precision, seed=3), float(np.finfo(precision).smallest_normal)
    cosines = [abs(exactly(rays, i)[0]) for i in range(COUNT)]
    assert all(0 < c < least for c in cosines)
    exact = oracle.refract(rays.a, rays.n, rays.k, fresnel=False, progress=False)
    assert 0.2 < exact.transmitted.mean() < 0.8


def test_off_unit_is_off_by_a_few_ulps_only(precision):
    rays, u = make("off unit", 4000, precision, seed=3), roundoff(precision)
    for v in (rays.a, rays.n):
        off = np.abs(lengths(v) - 1) / u
        assert 1.5 < off.max() < 12


def test_a_given_normal_takes_the_place_of_the_random_ones(precision):
    rays = make("critical, to the ulp", 50, precision, normal=(0, -1, 0))
    assert (rays.n == (0, -1, 0)).all()
    assert np.abs(oracle.relative_radicand(rays.a, rays.n, rays.k)).max() < 200 * roundoff(precision)


def test_an_unknown_regime_is_refused():
    with pytest.raises(KeyError):
        make("nowhere", 1, np.float32)


# Sums of floats ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("regime", [name for name, entry in REGIMES.items() if not entry.rests_on_denormals])
def test_the_radicand_in_sums_of_floats_is_right_to_its_bound(regime, precision):
    rays = make(regime, 150, precision, seed=9)
    c, d, terms = radicand(rays.a.T.astype(float), rays.n.T.astype(float), rays.k.astype(float))
    for i in range(len(rays)):
        exact_c, exact_d, larger = exactly(rays, i)
        bound = Fraction(2) ** -140
        assert abs(sum(Fraction(float(x[i])) for x in d) - exact_d) <= bound * larger
        assert abs(sum(Fraction(float(x[i])) for x in c) - exact_c) <= bound * abs(exact_c)
        assert larger * Fraction(1, 2) <= Fraction(float(terms[i])) <= larger * Fraction(5, 2)
        assert [abs(x[i]) for x in d] == sorted((abs(x[i]) for x in d), reverse=True)


@pytest.mark.parametrize("j", range(7))
def test_the_derivatives_of_the_radicand_are_its_differences(j):
    rays = make("critical", 40, np.float64, seed=5)
    numbers = np.column_stack([rays.a, rays.n, rays.k])
    d, along = radicand_and_gradient(rays.a, rays.n, rays.k)
    numbers[:, j] += 1e-7
    moved, _ = radicand_and_gradient(numbers[:, :3], numbers[:, 3:6], numbers[:, 6])
    assert (moved - d) / 1e-7 == pytest.approx(along[:, j], rel=1e-4, abs=1e-5)


def test_normalised_is_unit_to_the_rounding_of_its_components():
    v = normalised(np.random.default_rng(1).normal(size=(1000, 3))).astype(np.float64)
    assert np.abs(lengths(v) - 1).max() <= 0.5 * 3**0.5 * 2.0**-53


def test_the_margin_is_exact_where_it_matters():
    """A near tie, an exact tie, a tangential ray, a ray that is none."""
    a = np.array([[4, 0, -3], [4, 0, -3], [4, 0, -3], [1, 0, 0], [np.nan, 0, 1]], np.float64)
    n = np.tile([0.0, 0.0, 1.0], (5, 1))
    k = np.array([1.25, np.nextafter(1.25, 2), np.nextafter(1.25, 1), 1.25, 1.25])
    margin = oracle.relative_radicand(a, n, k)
    # D = 9 − 16 (k² − 1), terms 9.
    expected = [float((9 - 16 * (Fraction(float(x)) ** 2 - 1)) / 9) for x in k[:3]]
    assert margin[:3] == pytest.approx(expected, rel=1e-9, abs=0)
    assert margin[3] == -1
    assert np.isnan(margin[4])


# Ratios that are given

GIVEN = [name for name, regime in REGIMES.items() if regime.takes_k]


@pytest.mark.parametrize("name", GIVEN)
def test_ratios_that_are_given_take_the_place_of_the_regimes_own(name, precision):
    ratios = np.linspace(1.2, 2.0, COUNT)
    rays, own = make_given(name, ratios, precision, 3), make(name, COUNT, precision, 3)
    np.testing.assert_array_equal(rays.k, ratios.astype(precision))
    assert rays.a.dtype == rays.n.dtype == rays.k.dtype == precision
    same = [np.array_equal(getattr(rays, vector), getattr(own, vector)) for vector in "an"]
    assert same == [REGIMES[name].any_k, True]


def given_angles(name, precision, ratios):
    rays = make_given(name, ratios, precision)
    a, n, k = (x.astype(float) for x in (rays.a, rays.n, rays.k))
    return np.arctan2(np.sqrt((np.cross(a, n) ** 2).sum(1)), np.abs((a * n).sum(1))), k


@pytest.mark.parametrize(("name", "angle"), [("critical", np.arcsin), ("Brewster", np.arctan)])
def test_angles_follow_from_ratios_that_are_given(name, angle, precision):
    found, k = given_angles(name, precision, np.linspace(1.1, 2.4, COUNT))
    off = found - angle(1 / k)
    assert np.abs(off).max() < 1e-2 + 1e-6
    assert min((off > 0).mean(), (off < 0).mean()) > 0.3
    assert (np.abs(off) > 1e-4).any() and (np.abs(off) < 1e-5).any()


def test_ratios_that_no_regime_takes():
    for name in set(REGIMES) - set(GIVEN):
        with pytest.raises(
            ValueError, match=r"it defines its own ratios of indices; expected one of 'generic', .*'tangential'$"
        ):
            make_given(name, [1.5], np.float32)
    with pytest.raises(ValueError, match=r"regime 'critical': k = 0\.9; expected 1 or more"):
        make_given("critical", [1.5, 0.9], np.float64)
    assert make_given("critical", [1.0], np.float64).k == 1
