"""The numbers behind `welch`: each is what its docstring says."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from mi_refract.image_diff import pixel_statistics, tile_statistics
from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import compare
from mi_refract.image_diff.tile_statistics import Inflation, Level, Side, TileTests, from_renders, levels
from mi_refract.io.image_file import Image

SEEDS = range(10)


def image(pixels, channels=("Y",), **rest):
    return Image(Path("a.exr"), np.asarray(pixels, np.float32), channels, **rest)


# Tiles -----------------------------------------------------------------------------------------------------------


def test_correlated_pixels_cost_variance_and_degrees_of_freedom():
    """One pixel of variance 2 and 6 degrees of freedom; three times as much at 3 times fewer, known to 10 of them."""
    side = Side(*(np.full((1, 1, 1), x) for x in (1.0, 5.0, 2.0, 4.0)), freedom=6.0)
    variance, squares = side.spread(Inflation(3.0, 10.0))
    assert variance.item() == 6
    assert squares.item() == pytest.approx(6**2 / (6 / 3) + 6**2 / 10)
    assert side.spread(Inflation())[1].item() == pytest.approx(2**2 / 6)


def test_an_image_and_its_variance_give_the_same_tiles_as_its_renders():
    """Of an image that is not square, and fills its last tiles in part."""
    renders = np.random.default_rng(2).random((5, 20, 40, 2))
    one = from_renders([*renders], 16)
    two = tile_statistics.from_variances(renders.mean(0), renders.var(0, ddof=1) / 5, 4.0, 16)
    assert one.area[..., 0].tolist() == [[256, 256, 128], [64, 64, 32]]
    for name in ("area", "mean", "variance", "squares", "freedom"):
        np.testing.assert_allclose(getattr(two, name), getattr(one, name))
    assert two.renders is None and two.inflation() == Inflation(1.0, np.inf)


def test_correlation_that_only_coarser_tiles_show_is_estimated_again():
    """Noise in blocks of 8² in tiles of 4²: those of 16² vary 4 times as much as their own tiles let expect."""
    rng = np.random.default_rng(5)

    def renders(count):
        return [x.repeat(8, 0).repeat(8, 1) for x in rng.standard_normal((count, 32, 32, 1))]

    one, two = (from_renders(renders(16), 4) for _ in range(2))
    fine, coarse = itertools.islice(levels(one, two, 0.0), 2)
    per_block = 1 / 16 + 1 / 16  # the variance of a block's difference
    assert np.square(fine.error).mean() == pytest.approx(per_block, rel=0.1)
    assert np.square(coarse.error).mean() == pytest.approx(per_block / 4, rel=0.1)


def test_rounding_of_a_plain_sky_says_nothing_of_the_noise_elsewhere():
    """A sum of equal samples, rounded the same in all pixels of a render: fully correlated, and 1e-7."""
    rng = np.random.default_rng(6)
    renders = 0.6 + 0.05 * rng.normal(size=(4, 64, 64, 1))
    renders[:, :16] = 0.6 + 1e-7 * rng.normal(size=(4, 1, 1, 1)) + 1e-8 * rng.normal(size=(4, 16, 64, 1))
    side = from_renders(list(renders), 16)
    assert side.inflation().factor > 10
    assert side.inflation(1e-3).factor == pytest.approx(1, abs=0.6)
    # Noise that could matter counts, correlated as it is.
    renders[:, :16] = 0.6 + 1e-3 * rng.normal(size=(4, 1, 1, 1)) + 1e-4 * rng.normal(size=(4, 16, 64, 1))
    assert from_renders(list(renders), 16).inflation(1e-3).factor > 10


@pytest.mark.parametrize("spp", [2, 5])
def test_second_moments_are_those_of_so_many_samples(spp):
    """`m2` is the mean of the squares: the variance of the samples is (m2 − mean²) · spp / (spp − 1)."""
    rng = np.random.default_rng(6)
    sides = rng.random((2, spp, 16, 16))
    forms = {}
    for form, spread in (("Y.variance", lambda x: x.var(0, ddof=1)), ("m2_Y", lambda x: np.square(x).mean(0))):
        one, two = (image(np.dstack([x.mean(0), spread(x)]), ("Y", form)) for x in sides)
        forms[form] = compare("welch", one, two, spp=spp)
    moments, variances = (forms[form] for form in ("m2_Y", "Y.variance"))
    np.testing.assert_allclose(moments.maps["t"], variances.maps["t"], rtol=1e-5)
    assert moments.minimum_detectable == pytest.approx(variances.minimum_detectable, rel=1e-5)


def level(error, silent=False):
    """Three tiles of mean 1, known noise."""
    one = np.ones((1, 3, 1))
    none = one < 0
    return Level(0 * one, one, one, none | silent, none, none, one, 0 * one, error * one, 1e9 * one)


def test_the_minimum_detectable_difference_is_that_of_the_median_tile():
    from scipy import stats

    tests = TileTests([level(np.array([[[0.01], [0.04], [0.02]]]))], 0.001)
    reach = stats.norm.isf(tests.threshold / 2) + stats.norm.isf(0.01)
    assert tests.minimum_detectable() == pytest.approx(0.02 * reach, rel=1e-6)
    assert tests.hidden_share(0.03 * reach) == pytest.approx(1 / 3)
    assert tests.hidden_share(0.015 * reach) == pytest.approx(2 / 3)
    assert np.isnan(TileTests([level(0.1, silent=True)], 0.001).minimum_detectable())
    assert TileTests([level(0.1, silent=True)], 0.001).hidden_share(0.05) == 0


# Pixels ------------------------------------------------------------------------------------------------------------


def test_the_bound_of_the_pixels_is_the_one_derived():
    found = pixel_statistics.sums(*(np.full((1, 4, 1), x) for x in (1.0, 0.75, 4.0, 0.25)), 4)
    assert (found.total.item(), found.squares.item()) == pytest.approx((4 * 8, 4 * 64))
    area, none = np.full((1, 1, 1), 4.0), np.zeros((1, 1, 1))
    assert found.p(area, none, 1.0, np.inf).item() == pytest.approx(np.exp(-(32**2 / 256) / 2))
    assert found.p(area, none, 2.0, np.inf).item() == pytest.approx(np.exp(-(32**2 / 512) / 2))
    assert found.p(area, none, 2.0, 6.0).item() == pytest.approx((1 + 2 / 6) ** -3)
    assert found.p(area, none + 4.0, 1.0, np.inf).item() == pytest.approx(np.exp(-(16**2 / 64) / 2))
    assert found.p(area, none + 9.0, 1.0, np.inf).item() == 1  # 9 − 1 is less than 9


def skewed(rng, shape):
    return rng.gamma(0.3, 1.0, shape)


def rare(rng, shape):
    """Light that one sample in thirty finds."""
    return (rng.random(shape) < 1 / 30) * 1.0


def filtered(rng, shape):
    x = rng.gamma(2.0, 1.0, shape)
    return sum(np.roll(x, (i, j), (1, 2)) for i in range(3) for j in range(3))


@pytest.mark.parametrize("noise, inflation", [(skewed, 1.0), (rare, 1.0), (filtered, 9.0)])
@pytest.mark.parametrize("counts", [(2, 2), (2, 7)])
def test_equal_renders_scatter_no_more_than_the_bound_lets_them(noise, inflation, counts):
    """p ≤ 5 % in at most 5 % of 1000 tiles; more than 80 has probability below 2e-5 for each of ten seeds and cases.

    The tiles are not independent where they are filtered, but for their edges.
    """
    area = np.full((25, 40, 1), 64.0)
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        one, two = ([*noise(rng, (count, 200, 320, 1)).astype(np.float32)] for count in counts)
        p = pixel_statistics.sums_of_renders(one, two, 8).p(area, 0 * area, inflation, np.inf)
        assert (p <= 0.05).sum() <= 80


def test_the_sums_of_the_pixels_are_their_own():
    """Of renders, in bands; and of the mean and the variance of the same samples."""
    rng = np.random.default_rng(8)
    one, two = rng.random((3, 20, 24, 2)), rng.random((5, 20, 24, 2))
    found = pixel_statistics.sums_of_renders([*one], [*two], 8)
    v = one.var(0, ddof=1) / 3 + two.var(0, ddof=1) / 5
    u = np.square(one.mean(0) - two.mean(0)) - v
    exchanged = np.square(one.mean(0) - two.mean(0)) - one.var(0, ddof=1) / 5 - two.var(0, ddof=1) / 3
    assert found.total.shape == (2, 3, 3, 2)
    for i, each in enumerate((u, exchanged)):
        np.testing.assert_allclose(found.total[i, 1, 2], each[8:16, 16:24].sum((0, 1)))
        np.testing.assert_allclose(found.squares[i, 2, 0], np.square(each[16:20, :8]).sum((0, 1)))


@pytest.mark.parametrize("value", [1.0, 0.7, 1e-5])
def test_light_that_one_render_found_alone_is_no_difference(value):
    """(h/n)² less its variance is 0. Its rounding, the same in all 256 pixels, must not add up to S = 16."""
    area = np.full((1, 1, 1), 256.0)
    black = np.zeros((16, 16, 1), np.float32)
    for count in range(2, 10):
        found = [np.full_like(black, value), *[black] * (count - 1)]
        for one, two in (([black] * 2, found), (found[::-1], [black] * 3)):
            assert pixel_statistics.sums_of_renders(one, two, 16).p(area, 0 * area, 1.0, np.inf).item() == 1


def test_what_is_not_finite_is_an_alarm():
    broken = np.ones((16, 16, 1))
    broken[3, 3] = np.nan
    sides = [from_renders([broken, np.ones((16, 16, 1))], 16)] * 2
    pixels = pixel_statistics.sums(*[broken] * 4, 16)
    (found,) = levels(*sides, 0.0, pixels)
    assert TileTests([found], 0.001).pixels_differing == 1


# Sides of different numbers of samples --------------------------------------------------------------------------------


def lit(rng, samples, base, probability, gain=1.0):
    """A film of samples of Γ(4) noise around `base`, to which one in 1/`probability` adds 200; with its variance."""
    shape = (64, 64, 1)
    hits = rng.binomial(samples, probability, shape)
    plain = base * rng.gamma(4 * samples, 1 / (4 * samples), shape)
    spread = base**2 / 4 * rng.chisquare(samples - 1, shape) / (samples - 1)
    spread += 200**2 * hits * (1 - hits / samples) / (samples - 1)
    pixels = np.dstack([gain * (plain + 200 * hits / samples), gain**2 * spread])
    return image(pixels, ("Y", "Y.variance"), metadata={"mi_refract:spp": samples})


def lit_renders(rng, count, samples, base, probability):
    # Two that hold one hit each, in the same pixel, would be the same image, as no real ones are.
    found = [lit(rng, samples, base, probability, 1 + 1e-6 * i) for i in range(count)]
    return [image(each.pixels[..., :1], metadata=each.metadata) for each in found]


RARE = {"fireflies": (1.0, 3e-4), "a small lamp": (0.0, 1e-3), "a smaller one": (0.0, 1e-4)}
SIDES = {
    "films": (lambda rng, *light: (lit(rng, 1024, *light), lit(rng, 16, *light))),
    "renders": (lambda rng, *light: (lit_renders(rng, 64, 4, *light), lit_renders(rng, 4, 4, *light))),
    "renders of other counts": (lambda rng, *light: (lit_renders(rng, 8, 256, *light), lit_renders(rng, 8, 4, *light))),
}


@pytest.mark.parametrize("light", RARE)
@pytest.mark.parametrize("form", SIDES)
@pytest.mark.parametrize("first", [0, 1])
def test_rare_light_that_the_smaller_side_missed_is_no_difference(light, form, first):
    """At 0.1 % two or more alarms of 10 pairs have probability 4.5e-5, of any of these cases below 1e-3."""
    alarms = 0
    for seed in SEEDS:
        sides = SIDES[form](np.random.default_rng(seed), *RARE[light])
        found = compare("auto", sides[first], sides[1 - first])
        alarms += found.verdict is Verdict.DIFFERENT
        assert found.verdict is not Verdict.EQUAL
        assert found.verdict is Verdict.DIFFERENT or found.reason.endswith("would decide")
    assert alarms <= 1


def test_normal_noise_keeps_its_power_between_4096_and_64_samples():
    """3 % are more than what an equal pair says is missed in 1 % of the cases: more than 2 of 10 are below 2e-4."""
    missed = 0
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        reference = lit(rng, 4096, 1.0, 0.0)
        assert compare("auto", reference, lit(rng, 64, 1.0, 0.0)).minimum_detectable < 0.03
        missed += compare("auto", reference, lit(rng, 64, 1.0, 0.0, 1.03)).verdict is not Verdict.DIFFERENT
    assert missed <= 2


@pytest.mark.parametrize(
    "counts, whose", [((65536, 16), "of the new image"), ((64, 64), "a side"), ((32, 64), "a side")]
)
def test_as_many_samples_as_it_says_decide(counts, whose):
    """Twice the number shows 5 % in so many tiles; half of it does not."""
    rng, light = np.random.default_rng(4), (1.0, 0.0)
    options = {"tile": 4, "hidden": 0.0}
    found = compare("auto", *(lit(rng, count, *light) for count in counts), **options)
    words = re.search(r"; about ([0-9,]+) samples per pixel (.*) would decide$", found.reason)
    assert (found.verdict, words[2]) == (Verdict.INCONCLUSIVE, whose)
    said = int(words[1].replace(",", ""))
    for factor, verdict in ((0.5, Verdict.INCONCLUSIVE), (2, Verdict.EQUAL)):
        asked = [counts[0] if whose != "a side" else int(factor * said), int(factor * said)]
        assert compare("auto", *(lit(rng, count, *light) for count in asked), **options).verdict is verdict


# Without noise -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("values", [(0.5, 0.5), (0.9, 0.1), (0.4, 0.3, 0.3), (0.999, 0.001), (0.25,) * 4, (0.6, 0.4)])
def test_values_that_come_up_by_chance_are_no_rarer_than_the_bound(values):
    """Σ p⁴ + 7 ((Σ p²)² − Σ p⁴) ≤ 1, for two renders a side; more of them agree less often."""
    same = sum(p**4 for p in values)
    assert same + 7 * (sum(p**2 for p in values) ** 2 - same) <= 1


def test_tiles_without_noise_have_the_p_of_their_pixels():
    flat = np.ones((16, 16, 1))
    moved = flat.copy()
    moved[0, :3] = 0.5
    moved[1, :3] = 1.005  # beyond the margin, but not far
    side = from_renders([flat] * 2, 16)
    (found,) = levels(side, from_renders([moved] * 2, 16), 0.001)
    found = tile_statistics.with_silent_pixels(found, flat, moved, 0.001, 16)
    assert found.off.item() and found.of_silent.item() == pytest.approx(7.0**-3)
    assert (found.t.item(), found.p.item()) == (0, 1)  # without noise no t-test says anything
    assert TileTests([found], 0.001).silent_far == 0
    assert TileTests([found], 7.0**-3).silent_far == 1


def test_the_verdict_of_equal_renders_is_wrong_no_more_often_than_stated():
    """10 pairs for each of ten seeds at 5 %: 5 expected at most; more than 17 has probability below 1e-5."""
    alarms = 0
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        for _ in range(10):
            sides = [[image(1 + skewed(rng, (16, 16, 1))) for _ in range(count)] for count in (2, 4)]
            found = compare("welch", *sides, tile=8, family_error=0.05, equivalence_margin=0.0)
            alarms += found.verdict is Verdict.DIFFERENT
    assert alarms <= 17


def test_a_tile_has_the_freedom_of_all_of_its_pixels():
    """Of 16² pixels with one variance, each known with 7 degrees of freedom."""
    side = tile_statistics.from_variances(np.ones((16, 16, 1)), np.full((16, 16, 1), 3.0), 7.0, 16)
    variance, squares = side.spread(Inflation())
    assert variance.item() == pytest.approx(3 / 256)
    assert (variance**2 / squares).item() == pytest.approx(7 * 256)
