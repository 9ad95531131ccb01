"""`welch`: its formulas, the rate of false alarms, the power, and when it is inconclusive."""

from __future__ import annotations

import itertools
import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import gaussian_filter
from support.diff_images import DIFFERENT, EQUAL, INCONCLUSIVE, metric, of

from mi_refract.image_diff import pixel_statistics
from mi_refract.image_diff.methods import compare
from mi_refract.image_diff.pixel_statistics import Inflation, inflation
from mi_refract.image_diff.tile_statistics import (
    Side,
    TileTests,
    compare_stacks,
    from_renders,
    from_variances,
    relative_mse,
)

SHAPE = (64, 64, 3)
PASSES, PER_PASS = 8, 4
welch, auto = partial(compare, "welch"), partial(compare, "auto")


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def skewed(rng, shape, deviation=0.3):
    """Noise around 1 with a skewed distribution, like that of light."""
    return 1 + deviation * (rng.gamma(2.0, 1.0, shape) - 2) / np.sqrt(2)


def blurred(x, deviation):
    return gaussian_filter(x, (0, deviation, deviation, 0), mode="wrap") if deviation else x


def renders(rng, count, gain=1.0, shape=SHAPE, deviation=0.1, blur=0.0):
    """Independent renders of a gray image."""
    return [of(gain * x) for x in blurred(skewed(rng, (count, *shape), deviation), blur)]


def partly_denoised(rng, count, gain=1.0):
    """Renders of 8 × 8 tiles, one of which has a single value, as if denoised; another has a gain."""
    light = skewed(rng, (count, 64, 64, 1), 0.1)
    light[:, :8, :8] = light[:, :1, :1]
    light[:, 48:56, 48:56] *= gain
    return [of(x) for x in light]


def film(mean, variance, **header):
    """An image with the variance of a sample in additional channels."""
    names = tuple("RGB") if mean.shape[-1] == 3 else ("Y",)
    metadata = {f"mi_refract:{key}": value for key, value in header.items()}
    return of(np.dstack([mean, variance]), (*names, *(f"{name}.variance" for name in names)), metadata=metadata)


def passes(rng, deviation=0.0, gain=1.0, shape=(32, 32, 3), **header):
    """Exponential samples in a few passes, under a Gaussian filter."""
    light = gain * blurred(rng.gamma(PER_PASS, 1 / PER_PASS, (PASSES, *shape)), deviation)
    header = {"spp": PASSES * PER_PASS, "variance_freedom": PASSES - 1} | header
    return film(light.mean(0), light.var(0, ddof=1) * PER_PASS, **header)


def bare(image):
    """The image without its channels of variance."""
    names = [name for name in image.channels if "." not in name]
    return replace(image, pixels=image.select(names), channels=tuple(names))


def full(*values, shape=(1, 1, 1)):
    return [np.full(shape, x) for x in values]


# The formulas ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "one, two, v1, f1, v2, f2",
    [
        # A variance of n samples has n − 1 degrees of freedom; the same if the other side uses it, too.
        ((0.08, 2), (0.08, 2), 0.08 / 2, 1, 0.08 / 2, 1),
        ((0.08, 5), (0.04, 9), 0.08 / 5, 4, 0.04 / 9, 8),
        ((0.08, 10), (None, 3), 0.08 * (1 / 10 + 1 / 3), 9, 0, 1),
        ((None, 5), (0.08, 1000), 0, 1, 0.08 * (1 / 5 + 1 / 1000), 999),
        # The header can give them, in any type; ignored for a side without variance.
        ((0.4, 1000, 7), (0.2, 1000), 0.4 / 1000, 7, 0.2 / 1000, 999),
        ((0.4, 1000, 7.0), (0.2, 1000, "11"), 0.4 / 1000, 7, 0.2 / 1000, 11),
        ((0.4, 1000, "7"), (None, 1000, "nonsense"), 0.8 / 1000, 7, 0, 1),
        # The larger of s₁²/n₁ + s₂²/n₂ and s₁²/n₂ + s₂²/n₁, with its own degrees of freedom.
        ((0.4, 50), (0.1, 5), 0.4 / 5, 49, 0.1 / 50, 4),
    ],
)
def test_t_and_p_of_one_pixel(one, two, v1, f1, v2, f2):
    def pixel(value, variance, spp, freedom=None):
        header = {"spp": spp} | ({} if freedom is None else {"variance_freedom": freedom})
        image = film(*full(value, variance or 0.0), **header)
        return bare(image) if variance is None else image

    sides = pixel(1.0, *one), pixel(1.1, *two)
    result = welch(*sides, equivalence_margin=0.0)
    t, freedom = 0.1 / np.sqrt(v1 + v2), (v1 + v2) ** 2 / (v1**2 / f1 + v2**2 / f2)  # Welch, Satterthwaite
    assert result.maps["t"].item() == pytest.approx(t, rel=1e-5)
    assert result.maps["p"].item() == pytest.approx(2 * stats.t.sf(t, freedom), rel=1e-5)
    # At Šidák's level of the tests of the mean and of the pixels; relative to the brighter side.
    reach = stats.t.isf((1 - 0.999**0.5) / 2, freedom) + stats.t.isf(0.01, freedom)
    assert result.minimum_detectable == pytest.approx(reach * np.sqrt(v1 + v2) / 1.1, rel=1e-4)
    if len(one) == len(two) == 2:  # options override the header, and those of a side override `spp`
        other = [replace(side, metadata={"mi_refract:spp": 77}) for side in sides]
        again = welch(*other, spp=7, spp_reference=one[1], spp_test=two[1], equivalence_margin=0.0)
        assert again.maps["t"].item() == result.maps["t"].item()


@pytest.mark.parametrize("spp", [2, 5])
def test_second_moments_give_unbiased_variances(spp, rng):
    """`m2` is the mean of the squares: the variance of the samples is (m2 − mean²) · spp / (spp − 1)."""
    sides, results = rng.random((2, spp, 16, 16)), []
    for form, spread in (("Y.variance", lambda x: x.var(0, ddof=1)), ("m2_Y", lambda x: np.square(x).mean(0))):
        results.append(welch(*(of(np.dstack([x.mean(0), spread(x)]), ("Y", form)) for x in sides), spp=spp))
    variances, moments = results
    np.testing.assert_allclose(moments.maps["t"], variances.maps["t"], rtol=1e-5)
    assert moments.minimum_detectable == pytest.approx(variances.minimum_detectable, rel=1e-5)


def test_degrees_of_freedom_of_a_tile():
    """16² pixels, each with 7 degrees of freedom; fewer if pixels correlate, and if the inflation is uncertain."""
    variance, squares = from_variances(*full(1.0, 3.0, shape=(16, 16, 1)), 7.0, 16).spread(Inflation())
    assert (variance.item(), (variance**2 / squares).item()) == pytest.approx((3 / 256, 7 * 256))
    variance, squares = Side(*full(1.0, 5.0, 2.0, 4.0), freedom=6.0).spread(Inflation(3.0, 10.0))
    assert (variance.item(), squares.item()) == pytest.approx((6, 6**2 / (6 / 3) + 6**2 / 10))


def test_from_renders_agrees_with_from_variances(rng):
    """For an image that is not square, and whose last tiles are not full."""
    one, two = rng.random((5, 20, 40, 2)), rng.random((3, 20, 40, 2))
    evidence = from_renders([*one], [*two], 16)
    assert evidence.one.area[..., 0].tolist() == [[256, 256, 128], [64, 64, 32]]
    for side, x in ((evidence.one, one), (evidence.two, two)):
        expected = from_variances(x.mean(0), x.var(0, ddof=1) / len(x), len(x) - 1.0, 16, len(x))
        for name in ("area", "mean", "variance", "squares", "freedom", "count"):
            np.testing.assert_allclose(getattr(expected, name), getattr(side, name))
        assert expected.renders is None and expected.inflation() == Inflation(1.0, np.inf)
    v1, v2, d = one.var(0, ddof=1), two.var(0, ddof=1), one.mean(0) - two.mean(0)
    for i, u in enumerate((d**2 - v1 / 5 - v2 / 3, d**2 - v1 / 3 - v2 / 5)):  # the second with exchanged variances
        np.testing.assert_allclose(evidence.pixels.total[i, 0, 2], u[:16, 32:].sum((0, 1)))
        np.testing.assert_allclose(evidence.pixels.squares[i, 1, 0], np.square(u[16:, :16]).sum((0, 1)))


def test_correlation_is_estimated_again_from_coarser_tiles(rng):
    """Noise in blocks of 8² pixels, tiles of 4²: tiles of 16² vary 4 times as much as follows from those of 4²."""
    blocks = rng.standard_normal((2, 16, 32, 32, 1)).repeat(8, 2).repeat(8, 3)
    fine, coarse = itertools.islice(from_renders(*map(list, blocks), 4).levels(0.0), 2)
    per_block = 1 / 16 + 1 / 16  # the variance of a block's difference
    assert np.square(fine.error).mean() == pytest.approx(per_block, rel=0.1)
    assert np.square(coarse.error).mean() == pytest.approx(per_block / 4, rel=0.1)


def test_rounding_of_a_plain_sky_does_not_affect_the_inflation(rng):
    """A sum of equal samples has the same rounding in all pixels of a render: noise of 1e-7, fully correlated."""

    def side(sky):
        pixels = 0.6 + 0.05 * rng.normal(size=(4, 64, 64, 1))
        pixels[:, :16] = 0.6 + sky * (rng.normal(size=(4, 1, 1, 1)) + 0.1 * rng.normal(size=(4, 16, 64, 1)))
        return from_renders([*pixels], [*pixels], 16).one

    quiet = side(1e-7)
    assert quiet.inflation().factor > 10
    assert quiet.inflation(1e-3).factor == pytest.approx(1, abs=0.6)
    assert side(1e-3).inflation(1e-3).factor > 10  # larger correlated noise is not ignored


# Pixels ------------------------------------------------------------------------------------------------------------


def test_the_p_value_of_pixels_is_the_derived_bound():
    sums = pixel_statistics.sums(*full(1.0, 0.75, 4.0, 0.25, shape=(1, 4, 1)), 4)
    assert (sums.total.item(), sums.squares.item()) == pytest.approx((4 * 8, 4 * 64))
    for least, correlated, p in (
        (0, Inflation(), np.exp(-(32**2 / 256) / 2)),
        (0, Inflation(2.0), np.exp(-(32**2 / 512) / 2)),
        (0, Inflation(2.0, 6.0), (1 + 2 / 6) ** -3),
        (4, Inflation(), np.exp(-(16**2 / 64) / 2)),
        (9, Inflation(), 1),  # 9 − 1 is less than 9
    ):
        assert sums.p(*full(4.0, float(least)), correlated).item() == pytest.approx(p)


def test_light_that_only_one_render_found_is_no_difference():
    """u = (h/n)² less its variance is 0. Its rounding, the same in all 256 pixels, must not add up to S = 16."""
    for value, count in itertools.product((1.0, 0.7, 1e-5), range(2, 10)):
        black, lit = (x.astype(np.float32) for x in full(0.0, value, shape=(16, 16, 1)))
        dark, one = [black] * count, [lit, *[black] * (count - 1)]
        for sides in ((dark, one), (one[::-1], dark)):  # equal counts, so variances are not exchanged
            assert from_renders(*sides, 16).pixels.p(*full(256.0, 0.0), Inflation()).item() == 1


@pytest.mark.parametrize(("lag", "factor"), [((2, 0), 2), ((0, 2), 2), ((1, -2), 2), ((3, 0), 1), ((0, 3), 1)])
def test_pixels_correlate_up_to_a_distance_of_two(lag, factor, rng):
    """w(x) + w(x + h) has ρ = ½ at ±h, so that F = 2."""
    noise = rng.standard_normal((512, 512, 1))
    estimate = inflation(noise + np.roll(noise, lag, (0, 1)), np.full(noise.shape, 2.0), 16)
    assert estimate.factor == pytest.approx(factor, abs=0.15)
    assert estimate.freedom == 512**2 / 25  # squares of 5 pixels


def test_inflation_of_a_filter_is_estimated_beside_a_smooth_difference(rng):
    """F is (Σ w)²/Σ w² along each axis, and 1 for independent pixels."""
    noise, variance = rng.standard_normal((256, 256, 3)), np.ones((256, 256, 3))
    expected = 1 / np.square(gaussian_filter(np.eye(1, 101, 50)[0], 0.5)).sum() ** 2
    wide = blurred(noise[None], 0.5)[0]
    for offset in (0.0, 0.5 * np.sin(np.arange(256) / 40)[:, None, None]):
        assert inflation(noise + offset, variance, 16).factor == pytest.approx(1.0, abs=0.1)
        assert inflation(wide + offset, variance / expected, 16).factor == pytest.approx(expected, rel=0.1)
    half = (np.arange(256) < 128)[None, :, None]  # independent and a hundred times as bright, but weighted equally
    mixed = inflation(np.where(half, 100 * noise, wide), np.where(half, 1e4, variance / expected), 16)
    assert mixed.factor == pytest.approx((1 + expected) / 2, rel=0.1)
    assert inflation(0 * noise, variance, 16).factor == inflation(noise[:11], variance[:11], 16).factor == 1


# False alarms and power --------------------------------------------------------------------------------------------


def exponential(rng, share, n, m, known):
    """A pair of n and m samples of light that a `share` of samples finds, with the true variance of side `known`."""
    mean = 0.2 + np.linspace(0, 1, 32)[None, :, None] * np.ones((32, 32, 3))
    hits = [rng.binomial(spp, share, mean.shape) for spp in (n, m)]
    pairs = zip(hits, (n, m), strict=True)
    sides = [of(rng.gamma(np.maximum(k, 1e-9), mean / (x * share)), metadata={"mi_refract:spp": x}) for k, x in pairs]
    variance = np.moveaxis(np.square(mean) * (2 / share - 1), -1, 0)
    sides[known] = replace(sides[known], variances=dict(zip("RGB", variance, strict=True)))
    return sides


def pair_of(draw, *first, **how):
    """A function that draws both sides, with arguments for each side, or the same ones for both."""
    return lambda rng: [draw(rng, *arguments, **how) for arguments in (first if len(first) == 2 else first * 2)]


STACK = {"shape": (32, 32, 3), "deviation": 0.3}
NULLS = {
    "renders": (100, pair_of(renders, (4,), **STACK)),
    "two against four": (100, pair_of(renders, (2,), (4,), **STACK)),
    "filtered renders": (40, pair_of(renders, (8,), **STACK, blur=1.0)),
    "few filtered renders": (40, pair_of(renders, (2,), shape=(16, 16, 3), deviation=0.3, blur=1.0)),
    "partly denoised renders": (100, pair_of(partly_denoised, (4,))),
    "more of them": (40, pair_of(partly_denoised, (8,))),
    "passes": (100, pair_of(passes, ())),
    "filtered passes": (100, pair_of(passes, (0.5,))),
    "one variance": (100, lambda rng: exponential(rng, 1.0, 1000, 300, 0)),
    "the other": (100, lambda rng: exponential(rng, 1.0, 300, 1000, 1)),
    "one variance, rare light": (100, lambda rng: exponential(rng, 0.01, 1000, 300, 0)),
    "the other, rare light": (100, lambda rng: exponential(rng, 0.01, 300, 1000, 1)),
}


@pytest.mark.parametrize("name", NULLS)
def test_the_rate_of_false_alarms_is_at_most_the_family_error(name):
    """At a family error of 5 %. More alarms than allowed have a probability of 1e-4 in a case, 1e-3 in any case."""
    count, draw = NULLS[name]
    options = {"tile": 8, "family_error": 0.05, "equivalence_margin": 0.0, "resolution": 9.0}
    seeds = np.random.SeedSequence([90, *name.encode()]).spawn(count)
    alarms = sum(welch(*draw(np.random.default_rng(seed)), **options).verdict is DIFFERENT for seed in seeds)
    assert alarms <= stats.binom.isf(1e-4, count, 0.05)


def test_a_difference_beside_a_denoised_part_is_detected(rng):
    """10 % are 11 standard errors of the tile."""
    assert welch(partly_denoised(rng, 8), partly_denoised(rng, 8, gain=1.1), tile=8).verdict is DIFFERENT


@pytest.mark.parametrize("deviation", [2.0, 3.0])
@pytest.mark.parametrize("named", ["filter_radius", "filter_area"])
def test_wide_filters_cause_no_false_alarms(deviation, named):
    """Two or more alarms of 15 at 0.1 % have the probability 1e-4; 1.05 × the minimum is missed in at most 1 %."""
    how = {"shape": SHAPE, named: 4 * deviation if named == "filter_radius" else 4 * np.pi * deviation**2}
    alarms = missed = 0
    for rng in map(np.random.default_rng, range(15)):
        reference = passes(rng, deviation, **how)
        result = auto(reference, passes(rng, deviation, **how))
        alarms += result.verdict is DIFFERENT
        brighter = passes(rng, deviation, 1 + 1.05 * result.minimum_detectable, **how)
        missed += auto(reference, brighter).verdict is not DIFFERENT
    assert max(alarms, missed) <= 1
    assert named == "filter_radius" or result.minimum_detectable < 0.25  # of 0.1 under a box


def test_the_filter_of_the_header_decides_whether_pixels_share_samples():
    """Variances of filtered pixels may be those of samples, and variances of passes may be without a filter.

    If the variance is one of samples and the header names no filter, pixels are independent.
    """
    rng = np.random.default_rng(32)
    sides = [passes(rng, 0.5) for _ in range(2)]
    of_samples = {"mi_refract:variance_freedom": PASSES * PER_PASS - 1}

    def detectable(sides=sides, **header):
        with_header = [replace(side, metadata=side.metadata | header) for side in sides]
        return auto(*with_header, resolution=9.0).minimum_detectable

    wide, box = ({"mi_refract:filter_radius": x} for x in (2.0, 0.5))
    assert detectable(**wide) == detectable() > 1.3 * detectable(**box)
    assert detectable(**wide, **of_samples) > 1.3 * detectable(**box, **of_samples)
    for known in (sides, [sides[0], bare(sides[1])], [bare(sides[0]), sides[1]]):
        assert detectable(known) > 1.3 * detectable(known, **of_samples)


# Sides of different numbers of samples --------------------------------------------------------------------------------


def lit(rng, samples, base, probability, gain=1.0):
    """A film with its variance, of samples of Γ(4) noise around `base`; a sample adds 200 with this `probability`."""
    shape = (64, 64, 1)
    hits = rng.binomial(samples, probability, shape)
    plain = base * rng.gamma(4 * samples, 1 / (4 * samples), shape)
    spread = base**2 / 4 * rng.chisquare(samples - 1, shape) / (samples - 1)
    spread += 200**2 * hits * (1 - hits / samples) / (samples - 1)
    return film(gain * (plain + 200 * hits / samples), gain**2 * spread, spp=samples)


def lit_renders(rng, count, samples, *light):
    # The gains differ slightly, because two renders with one hit each in the same pixel would be identical.
    return [bare(lit(rng, samples, *light, 1 + 1e-6 * i)) for i in range(count)]


FIREFLIES, LAMP, SMALLER_LAMP = (1.0, 3e-4), (0.0, 1e-3), (0.0, 1e-4)
RARE = {
    "films": lambda rng, light: (lit(rng, 1024, *light), lit(rng, 16, *light)),
    "renders": lambda rng, light: (lit_renders(rng, 64, 4, *light), lit_renders(rng, 4, 4, *light)),
    "renders of other counts": lambda rng, light: (lit_renders(rng, 8, 256, *light), lit_renders(rng, 8, 4, *light)),
    # The side without variance has 4096 samples; the other has found a few of the events.
    "one variance": lambda rng, light: (lit(rng, 16, 1.0, 1e-3), bare(lit(rng, 4096, 1.0, 1e-3))),
}


@pytest.mark.parametrize(
    "form, light", [*itertools.product([*RARE][:3], (FIREFLIES, LAMP, SMALLER_LAMP)), ("one variance", None)]
)
def test_rare_light_that_one_side_missed_causes_no_alarm(form, light):
    """At 0.1 % two or more alarms of 10 pairs have the probability 4.5e-5 in a case, below 1e-3 in any case."""
    alarms = 0
    for seed in range(10):
        sides = RARE[form](np.random.default_rng(seed), light)
        result = auto(*(sides if seed % 2 else sides[::-1]))
        alarms += result.verdict is DIFFERENT
        if light:
            assert result.verdict is DIFFERENT or result.reason.endswith("would decide")
    assert alarms <= 1


@pytest.mark.parametrize(
    "counts, whose", [((65536, 16), "of the new image"), ((64, 64), "a side"), ((32, 64), "a side")]
)
def test_the_suggested_number_of_samples_decides(counts, whose):
    """Twice the number detects 5 % in enough tiles; half of it does not."""
    rng, options = np.random.default_rng(4), {"tile": 4, "hidden": 0.0}
    result = auto(*(lit(rng, count, 1.0, 0.0) for count in counts), **options)
    words = re.search(r"about ([0-9,]+) samples per pixel (.*?)( \((.*) times as many\))? would decide$", result.reason)
    assert (result.verdict, words[2]) == (INCONCLUSIVE, whose)
    times = None if whose == "a side" and counts[0] != counts[1] else float(words[4])
    assert not times or times == pytest.approx(int(words[1].replace(",", "")) / min(counts), rel=0.06)
    for factor, verdict in ((0.5, INCONCLUSIVE), (2, EQUAL)):
        count = int(factor * int(words[1].replace(",", "")))
        sides = (lit(rng, n, 1.0, 0.0) for n in (counts[0] if whose != "a side" else count, count))
        assert auto(*sides, **options).verdict is verdict


POWER = {  # standard deviation of the difference of the means of a tile of 64 pixels; a filter multiplies it by √2.4
    "renders": (0.3 * np.sqrt(2 / 6) / 8, pair_of(renders, (6,), **STACK)),
    "passes": (np.sqrt(2 / 32) / 8, pair_of(passes, ())),
    "filtered passes": (np.sqrt(2.4 * 2 / 32) / 8, pair_of(passes, (0.5,))),
    "4096 samples and 64": (np.sqrt(1 / 64 + 1 / 4096) / 2 / 8, pair_of(lit, (4096, 1.0, 0.0), (64, 1.0, 0.0))),
}


@pytest.mark.parametrize(("deviation", "draw"), POWER.values(), ids=POWER)
def test_differences_above_the_minimum_detectable_one_are_detected(deviation, draw):
    """One tile is brighter by 1.05 times the minimum of an equal image, which is missed in 1 %; 4 of 40: in 7e-4.

    The minimum is 2.3 σ (1 % missed) above the alarm level of 4.4 σ, which is that of 0.001 in some 80 tests.
    """
    rng, how, missed = np.random.default_rng(20), {"tile": 8, "resolution": 9.0, "pixels": "no"}, 0
    for _ in range(40):
        reference, test = draw(rng)
        minimum = welch(reference, test, **how).minimum_detectable
        for image in test if isinstance(test, list) else [test]:
            image.pixels[8:16, 8:16, 0] *= 1 + 1.05 * minimum
        result = welch(reference, test, **how)
        missed += result.verdict is not DIFFERENT
    assert missed <= 3 and minimum < 7.5 * deviation
    strongest = np.unravel_index(np.abs(result.maps["t"]).argmax(), result.maps["t"].shape)
    assert (strongest[0] // 8, strongest[1] // 8, strongest[2]) == (1, 1, 0)
    assert result.maps["q"][10, 10] < 0.01 < result.maps["q"][0, 0]


# Verdicts ----------------------------------------------------------------------------------------------------------


def test_a_gain_too_small_for_a_tile_is_detected_in_the_whole_image(rng):
    sides = renders(rng, 8, deviation=0.3), renders(rng, 8, 1.02, deviation=0.3)
    result = welch(*sides, tile=4)
    assert result.minimum_detectable > 0.1 and np.abs(result.maps["t"]).max() < 5
    assert result.verdict is DIFFERENT
    assert welch(*sides, equivalence_margin=0.05).verdict is not DIFFERENT  # within the margin
    large = welch(*sides, tile=10**30)  # the whole image
    assert large.maps["t"].shape == SHAPE and large.metrics == welch(*sides, tile=64).metrics
    noisy = welch(renders(rng, 2, deviation=2.0), renders(rng, 2, deviation=2.0))
    assert noisy.verdict is INCONCLUSIVE and noisy.minimum_detectable > 0.05


@pytest.mark.parametrize("noise", [0.05, 0.0])
@pytest.mark.parametrize(
    ("part", "gain", "words"),
    [
        (np.s_[16:32, 32:48], 0.9, r"(9\.\d|10) % darker in R, 0.9\d* .*, in the 16 × 16 pixels around \(140, 29\)"),
        (np.s_[:], 1.02, r"[12]\.?\d? % brighter in R, 1.02\d* instead of .*, in the whole image"),
        (np.s_[64:70, 64:80], 2.0, r".* % brighter in R, .*, in the 16 × 6 pixels around \(172, 72\)"),
    ],
    ids=["a tile", "everywhere", "in the corner"],
)
def test_the_reason_names_the_worst_tile_and_its_change(rng, part, gain, words, noise):
    sides = [renders(rng, 6, shape=(70, 80, 3), deviation=noise) for _ in range(2)]
    for image in sides[1]:
        image.pixels[part][..., 0] *= gain
    result = welch(*([replace(image, origin=(100, 5)) for image in side] for side in sides))
    if not noise:  # only single tiles are tested
        words = words.replace("the whole image", "the 16 × 16 pixels around .*")
    assert result.verdict is DIFFERENT and re.match(words, result.reason), result.reason
    assert re.search(r"; \d+ of \d+ tests differ: ", result.reason)


def test_the_reason_for_changes_within_a_tile_and_for_black_references(rng):
    sides = [renders(rng, 6, deviation=0.05) for _ in range(2)]
    for image in sides[1]:
        image.pixels[:16:2, :16, 1] *= 1.2
        image.pixels[1:16:2, :16, 1] *= 0.8
    words = "different pixels of G in the 16 × 16 pixels around (8, 8), with the same mean within the noise; "
    assert welch(*sides).reason.startswith(words)
    for image in sides[0]:
        image.pixels[16:32, :16, 2] = 0
    assert welch(*sides).reason.startswith("brighter in B, 1")


@pytest.mark.parametrize(
    "size, gain, options, verdict, share",
    [
        (64, 1.0, {"family_error": 1e-5}, INCONCLUSIVE, 0.25),
        (64, 0.9, {"family_error": 1e-5}, INCONCLUSIVE, 0.25),  # darker, hidden by the noise
        (24, 1.0, {}, EQUAL, 9 / 256),
        (24, 1.0, {"hidden": 0.03}, INCONCLUSIVE, 9 / 256),
        (0, 1.0, {}, EQUAL, 0),
    ],
)
def test_the_share_of_noisy_tiles_is_reported_if_the_median_tile_is_quiet(size, gain, options, verdict, share):
    """In a gray image of 16 × 16 tiles, the first `size`² pixels are noisy, with the brightness `gain`."""
    rng = np.random.default_rng(3)

    def side(gain):
        pixels = skewed(rng, (4, 128, 128, 1), 0.005)
        pixels[:, :size, :size] = gain * skewed(rng, (4, size, size, 1), 3.0)
        return [of(x) for x in pixels]

    result = welch(side(1.0), side(gain), tile=8, **options)
    assert result.minimum_detectable < 0.01
    assert result.verdict is verdict
    assert metric(result, "share of the tiles whose noise hides a difference of 0.05") == share
    assert (f"of 5 % in {100 * share:.2g} % of the tiles" if share else "in a tile of median noise") in result.reason
    assert share or "of the tiles" not in result.reason


@pytest.mark.parametrize(("deviation", "verdict"), [(6.0, INCONCLUSIVE), (0.005, EQUAL)])
def test_other_channels_do_not_change_how_much_noise_hides(deviation, verdict, rng):
    """The light of Y is in 4 of 64 tiles; the channels beside it are lit everywhere and quiet, plain, or black."""

    def side(quiet):
        pixels = np.zeros((4, 64, 64, 4))
        pixels[:, :16, :16, :1] = skewed(rng, (4, 16, 16, 1), deviation)
        pixels[..., 1:3] = skewed(rng, (4, 64, 64, 2), 0.005) if quiet else 1.0
        return [of(x, ("Y", "albedo.X", "albedo.Y", "alpha.Y")) for x in pixels]

    def measured(images):
        result = welch(*images, tile=8)
        share = metric(result, "share of the tiles whose noise hides a difference of 0.05")
        samples = re.search(r"about ([0-9,]+) renders", result.reason)
        return result.verdict, share, result.minimum_detectable, samples and float(samples[1].replace(",", ""))

    for quiet in (True, False):
        sides = [side(quiet) for _ in "ab"]
        beside = measured(sides)
        alone = measured([[of(x.pixels[..., :1], ("Y",)) for x in images] for images in sides])
        assert beside[:2] == alone[:2] == (verdict, float(verdict is INCONCLUSIVE))
        assert beside[2] == pytest.approx(alone[2], rel=0.3)  # there are more tests
        assert beside[3] == (pytest.approx(alone[3], rel=0.5) if alone[3] else None)


def test_a_tile_with_the_noise_of_one_pixel_is_flagged(rng):
    sides = [renders(rng, 8, deviation=0.0) for _ in range(2)]
    for image in itertools.chain(*sides):
        image.pixels[5, 5] = rng.random(3)
    assert (welch(*sides).maps["flags"][:16, :16] == 1).all()
    for image in sides[1]:
        image.pixels[5, 5] += 100
    assert welch(*sides).verdict is INCONCLUSIVE


def test_a_program_that_raises_errors_of_numpy_may_compare(rng):
    with np.errstate(all="raise"):
        assert welch(renders(rng, 4), renders(rng, 4, gain=2.0)).verdict is DIFFERENT
        assert np.geterr() == dict.fromkeys(np.geterr(), "raise")


def test_two_renders_with_one_seed_are_an_error(rng):
    """They share samples, also if their numbers of samples or their variants differ."""

    def drawn(**identity):
        return {"mi_refract:identity": json.dumps({"scene": "a", "defines": {}, "seed": 0} | identity)}

    side = [replace(x, metadata=drawn(seed=i)) for i, x in enumerate(renders(rng, 3))]
    assert welch(side, renders(rng, 4)).verdict is not DIFFERENT
    for other in (drawn(seed=1), drawn(seed=1, variant="cuda_ad_rgb")):
        with pytest.raises(ValueError, match=r"b\.exr: the scene and the seed of a\.exr; expected independent renders"):
            welch(renders(rng, 4), [*side, replace(renders(rng, 1)[0], metadata=other, path=Path("b.exr"))])
    welch([*side, replace(renders(rng, 1)[0], metadata=drawn(seed=1, scene="b"))], renders(rng, 4))
    for foreign in ("null", "5", '["scene"]', "{", 2.5, '{"scene": "a", "defines": {}}'):
        welch([replace(x, metadata={"mi_refract:identity": foreign}) for x in side], renders(rng, 4))


def test_the_same_render_twice_is_an_error(rng):
    side = renders(rng, 3)
    for mask in (None, np.ones(side[0].pixels.shape[:2], bool)):
        with pytest.raises(ValueError, match=r"b\.exr: the same image as a\.exr; expected independent renders"):
            welch([replace(x, mask=mask) for x in (*side, replace(side[0], path=Path("b.exr")))], renders(rng, 4))
    one, two, three, four, five = (of(np.where(np.arange(3) == 0, np.nan, x.pixels)) for x in renders(rng, 5))
    with pytest.raises(ValueError, match=r"the same image as a\.exr; expected independent renders"):
        welch([one, two, one], [three, four, five], allow_nonfinite=True)
    black = [of(0 * side[0].pixels)] * 2  # renders that find no light may be identical
    assert welch([*black, *side], renders(rng, 4)).verdict is not EQUAL
    remark = "; all 3 renders of the {} are identical: no noise, or the seeds have no effect"
    assert welch(side[:1] * 3, renders(rng, 4)).reason.endswith(remark.format("reference"))
    assert welch(renders(rng, 4), side[:1] * 3).reason.endswith(remark.format("new image"))
    for plain in (black, renders(rng, 3, deviation=0.0), side):
        assert "identical" not in welch(plain, renders(rng, 4)).reason


@pytest.mark.parametrize("scale", ["a lamp", "a channel"])
def test_a_much_brighter_tile_or_channel_hides_no_difference(scale, rng):
    sides = [[of(np.dstack([x.pixels, 1e6 * x.pixels[..., 0]]), tuple("RGBZ")) for x in renders(rng, 8)] for _ in "ab"]
    if scale == "a lamp":
        for image in itertools.chain(*sides):
            image.pixels[:16, :16] *= 1e7
    assert welch(*sides).verdict is EQUAL
    for image in sides[1]:
        image.pixels[32:48, 32:48, 1] *= 1.2
    assert welch(*sides).verdict is DIFFERENT


STRIPES = np.where(np.indices(SHAPE)[1] // 2 % 2, 0.8, 0.4)
RAMP = 0.3 + np.indices(SHAPE).sum(0) % 29 / 60
TURNED = np.concatenate([x[::-1, ::-1] for x in np.split(RAMP, 4)])[:, ::-1]
INSIDE = {"stripes inverted": (STRIPES, 1.2 - STRIPES), "a ramp turned": (RAMP, TURNED)}


@pytest.mark.parametrize("what", INSIDE)
@pytest.mark.parametrize("variance", [False, True])
def test_changes_within_tiles_are_detected_in_noise(what, variance, rng):
    """The means of all tiles are about the same."""

    def side(pixels):
        samples = pixels * skewed(rng, (16 if variance else 8, *SHAPE), 0.1)
        return film(samples.mean(0), samples.var(0, ddof=1), spp=16) if variance else [of(x) for x in samples]

    one, two = INSIDE[what]
    result = welch(side(one), side(two))
    assert result.verdict is DIFFERENT and "of their pixels" in result.reason
    assert welch(side(one), side(one)).verdict is EQUAL
    if what == "stripes inverted":
        assert metric(result, "tests of tiles and channels that differ") == 0
        in_one_tile = one.copy()
        in_one_tile[16:32, 32:48, 1] = two[16:32, 32:48, 1]
        assert welch(side(one), side(in_one_tile)).verdict is DIFFERENT
        assert welch(side(one), side(in_one_tile), pixels="no").verdict is EQUAL


# Without noise -------------------------------------------------------------------------------------------------------


def with_pixels(pixels, value):
    """An alpha of 1, except for so many pixels."""
    alpha = np.ones(SHAPE[:2])
    alpha[0, :pixels] = value
    return alpha


@pytest.mark.parametrize(
    "alpha, verdict",
    [
        (1.0, EQUAL),
        (0.0, DIFFERENT),
        (1.0005, EQUAL),  # within the margin
        (1.005, INCONCLUSIVE),  # within ten times the margin
        (1.02, DIFFERENT),
        (with_pixels(5, 0), INCONCLUSIVE),  # 7⁻⁵ = 6e-5 is no alarm
        (with_pixels(7, 0), DIFFERENT),  # 7⁻⁷ = 1e-6 is an alarm at 0.001 in some hundred tests
    ],
)
def test_changes_of_channels_and_images_without_noise(alpha, verdict, rng):
    alphas = [np.broadcast_to(x, SHAPE[:2]) for x in (1.0, alpha)]
    sides = [[of(np.dstack([x.pixels, values])) for x in renders(rng, 8)] for values in alphas]
    result = welch(*sides)
    assert result.verdict is verdict
    flat = [[of(np.dstack([values] * 3))] * 3 for values in alphas]
    assert welch(*flat).verdict is verdict
    if not np.any(alpha):
        assert "16 of tiles without noise" in result.reason
        assert (result.maps["flags"] == 2).all()
        assert metric(result, "tiles without noise that differ") == 16


def test_changes_within_tiles_are_detected_without_noise():
    board = np.where(np.indices((32, 32)).sum(0) % 2, 1.0, 0.5)[..., None] * np.ones(3)
    for pixels, verdict in ((board, EQUAL), (np.roll(board, 1, 1), DIFFERENT)):
        assert welch([of(board)] * 3, [of(pixels)] * 3).verdict is verdict


# The variance of one side only -------------------------------------------------------------------------------------


def beside(pixels, variance=None):
    """An image whose variances are in a separate file."""
    image = of(pixels)
    variances = {} if variance is None else dict(zip(image.channels, np.moveaxis(variance, -1, 0), strict=True))
    return replace(image, variances=variances)


def test_values_that_no_reference_sample_has_are_evidence_by_its_samples():
    """All n samples have one value, and not all m others: k such pixels have the probability (1 + (n − 1)/m)⁻ᵏ."""
    pixels = np.ones((16, 16, 1))
    for k, verdict in ((1, INCONCLUSIVE), (2, INCONCLUSIVE), (3, DIFFERENT)):  # 11⁻² > 0.001 > 11⁻³
        wrong = pixels.copy()
        wrong.flat[:k] = 1.5
        sides = beside(pixels, 0 * pixels), beside(wrong)
        assert welch(*sides, spp_reference=1001, spp_test=100).verdict is verdict


@pytest.mark.parametrize(
    ("count", "verdict"), [(1, INCONCLUSIVE), (8, INCONCLUSIVE), (64, DIFFERENT), (256, DIFFERENT)]
)
def test_rare_events_of_a_side_without_variance_are_no_evidence(count, verdict):
    """A tile differs by 5.5 σ, with σ a quarter of the mean. A few paths that find a lamp can explain it, 64 cannot.

    The other side is brighter only in `count` pixels, by 5.5/`count` σ of the tile each.
    """
    mean, variance = full(1.0, 256 * 1000 * 0.25**2, shape=(16, 16, 1))
    far = mean.copy()
    far.flat[:: 256 // count] += 1.375 * 256 / count
    how = {"spp_reference": 10**9, "spp_test": 1000}
    result = welch(beside(mean, variance), beside(far), **how)
    assert result.verdict is verdict
    assert ("heavy-tailed" in result.reason) == (verdict is INCONCLUSIVE)
    assert welch(beside(far, np.full_like(mean, 1e-9)), beside(mean, variance), **how).verdict is DIFFERENT


@pytest.mark.parametrize("spp_reference", [1000, 16_000])
@pytest.mark.parametrize(("count", "verdict"), [(1, INCONCLUSIVE), (3, INCONCLUSIVE), (4, DIFFERENT), (16, DIFFERENT)])
def test_tiles_whose_noise_comes_from_fewer_than_four_pixels_are_no_evidence(count, verdict, spp_reference):
    """`count` pixels have nearly all the variance of a tile, on one side, and differ by 30 standard errors."""
    mean, variance = full(1.0, 1e-9, shape=(16, 16, 1))
    variance.flat[:count] = 1.0
    other = mean.copy()
    other.flat[:count] += 30 / 1000**0.5
    sides = beside(other, variance), beside(mean, 1e-3 * variance)
    result = welch(*sides, spp_reference=spp_reference, spp_test=1000)
    assert result.verdict is verdict
    assert ("heavy-tailed" in result.reason) == (verdict is INCONCLUSIVE)


@pytest.mark.parametrize(("samples", "verdict"), [(15_000, INCONCLUSIVE), (16_000, DIFFERENT)])
def test_noise_is_well_known_with_16_times_the_samples_of_the_other_side(samples, verdict):
    """16 pixels are brighter by 0.7 σ of the tile each."""
    mean, variance = full(1.0, 256 * 1000 * 0.25**2, shape=(16, 16, 1))
    far = mean.copy()
    far.flat[::16] += 2.75 * 16
    assert welch(beside(mean, variance), beside(far), spp_reference=samples, spp_test=1000).verdict is verdict


# Stacks ------------------------------------------------------------------------------------------------------------


def test_stacks_of_renders(rng):
    reference, test = (skewed(rng, (6, 32, 32, 3)) for _ in range(2))
    detectable = compare_stacks(reference, test, 16, 1e-3).minimum_detectable()
    assert 0 < detectable < 0.1
    assert compare_stacks(reference, test * (1 + 2 * detectable), 16, 1e-3).alarms > 0
    local = test.copy()
    local[:, :16, 16:, 1] *= 1 + 2 * detectable
    assert compare_stacks(reference, local, 16, 1e-3).alarms == 1
    edge = test[:, :20, :20].copy()
    edge[:, 17:, 17:] *= 2  # in a tile that is not full
    assert compare_stacks(reference[:, :20, :20], edge, 16, 1e-3).alarms == 3
    test[0, 3, 4, 0] = np.nan
    assert compare_stacks(test, test, 16, 1e-3).alarms > 0
    for sides, message in (((test, test[:, :9]), "different shapes"), ((test[:1], test), "at least 2 per side")):
        with pytest.raises(ValueError, match=message):
            compare_stacks(*sides, 8, 1e-3)
    broken = np.full((2, 16, 16, 1), np.nan)
    (level,) = from_renders([*broken], [*broken], 16).levels(0.0)
    assert TileTests([level], 0.001).differing.pixels == 1
    flat = np.ones((4, 32, 32, 3))  # without noise
    for margin, by, alarms in ((1e-5, 1e-7, 0), (0.0, 1e-7, 12), (1e-5, 1e-4, 12)):
        assert compare_stacks(flat, flat * (1 + by), 16, 1e-3, margin).alarms == alarms
    stacks = np.ones((2, 4, 32, 32, 3))
    for value, alarms in ((1e-9, 0), (1e-6, 3)):  # a dark tile
        stacks[:, :, :16, :16] = np.array([0, value])[:, None, None, None, None]
        assert compare_stacks(*stacks, 16, 1e-3, 1e-5).alarms == alarms


def test_relative_mse_subtracts_the_noise_of_the_references(rng):
    references, image = skewed(rng, (32, 32, 32, 3)), skewed(rng, (32, 32, 3))
    expected = 0.3**2 / 1.01
    assert relative_mse(image, references) == pytest.approx(expected, rel=0.15)
    assert relative_mse(image + 0.5, references) == pytest.approx(expected + 0.25 / 1.01, rel=0.15)
    assert relative_mse(np.ones((32, 32, 3)), references) == pytest.approx(0, abs=0.1 * expected)
