"""Passes: their sizes and seeds, and their sums, whose bits do not depend on who adds them."""

from __future__ import annotations

import numpy as np
import pytest
from support.renders import leaf, tree_of

from mi_refract.rendering.pass_plan import LANES, PassPlan, next_stop, plan_passes, scalar_seed_of, seed_of, usual_spp
from mi_refract.rendering.pass_sums import ARITY, PassSums, PassTree, aligned_nodes

RNG = np.random.default_rng(16)

# Plans and seeds ------------------------------------------------------------------------------------------------------


def exact(spp):
    """Round as a sampler that supports any number of samples."""
    return spp


def square(spp):
    """Round up to a square, as Mitsuba's `stratified`."""
    return next(n * n for n in range(1, 10**6) if n * n >= spp)


def at_least_four(spp):
    """Round as a sampler that supports no fewer than 4 samples."""
    return max(4, spp)


def test_the_seeds_of_passes_differ_within_a_render_and_between_consecutive_seeds():
    assert [seed_of(seed, 0) for seed in (0, 1, 7, 2**32 - 1)] == [0, 1, 7, 2**32 - 1]
    # From MurmurHash3's own test: fmix32(1) = 0x514E28B7.
    assert [seed_of(0, 1), seed_of(5, 1)] == [0x514E28B7, 0x514E28B7 ^ 5]
    seeds = [{seed_of(seed, number) for number in range(20000)} for seed in (0, 1, 2)]
    assert [len(of_render) for of_render in seeds] == [20000] * 3
    # Two sets of n random numbers below 2³² share n²/2³² = 0.09 on average, and more than 3 with probability 3e-6.
    assert all(len(a & b) <= 3 for a, b in ((seeds[0], seeds[1]), (seeds[0], seeds[2]), (seeds[1], seeds[2])))
    assert all(0 <= seed < 2**32 for seed in seeds[1])


def test_the_seeds_of_scalar_variants_are_consecutive():
    most = 2**32 // (96 * 32)
    assert [scalar_seed_of(0, p, 96, 32) for p in (0, 1, most - 1)] == [0, 1, most - 1]
    assert scalar_seed_of(1, 5, 96, 32) == (0x514E28B7 + 5) % most
    assert scalar_seed_of(1, 5, 40, 24) == (0x514E28B7 + 5 * 3) % (2**32 // 960)  # 2 blocks have 2048 pixels
    for size, passes in (((96, 32), most), ((40, 24), 2**32 // 960 // 3)):
        scalar_seed_of(0, passes - 1, *size)
        with pytest.raises(ValueError, match=f"scalar variants support up to {passes}"):
            scalar_seed_of(0, passes, *size)


@pytest.mark.parametrize("pixels", [1, 48, 64 * 64, 512 * 512, 1920 * 1080, 3840 * 2160, 2**24, 2**26])
def test_the_samples_of_a_pass_are_bounded_and_a_power_of_two(pixels):
    spp = usual_spp(pixels)
    assert spp & (spp - 1) == 0
    assert spp == 1 or spp * pixels <= LANES
    assert 2 * spp * pixels > LANES or spp >= 4


def test_a_render_of_many_samples_has_larger_passes_but_at_least_sixteen():
    assert [usual_spp(2**18, total) for total in (None, 64, 128, 256, 512, 4096)] == [8, 8, 8, 16, 32, 32]
    assert usual_spp(1920 * 1080, 65536) == 4


@pytest.mark.parametrize(
    ("pixels", "total", "pass_spp", "rounded", "moments", "plan"),
    [
        (64, 100, 8, exact, True, (8, 100, 12, 4, 13)),
        (64, 96, 8, exact, True, (8, 96, 12, 0, 12)),
        (64, 64, None, exact, False, (8, 64, 8, 0, 8)),  # without moments a short render has eight passes
        (64, 5, None, exact, False, (1, 5, 5, 0, 5)),
        (64, 5, None, exact, True, (2**15, 5, 0, 5, 1)),
        (64, 10, 2**26, exact, True, (2**26, 10, 0, 10, 1)),
        (64, None, 8, exact, True, (8, None, None, 0, None)),
        (2**18, 100, None, square, True, (4, 100, 25, 0, 25)),  # 8 would become 9
        (2**18, 102, 9, square, True, (9, 103, 11, 4, 12)),  # 11 × 9, and the last 3 become 4
        (64, 16, None, at_least_four, False, (4, 16, 4, 0, 4)),  # eight passes would have 2 samples each
        (2**23, 3, None, at_least_four, True, (4, 4, 1, 0, 1)),
    ],
)
def test_a_plan_has_the_expected_passes(pixels, total, pass_spp, rounded, moments, plan):
    expected_spp, expected_total, *counts = plan
    result = plan_passes(pixels, total, pass_spp, rounded, moments=moments)
    assert result == PassPlan(expected_spp, expected_total)
    assert [result.full_passes, result.rest, result.passes] == counts


@pytest.mark.parametrize(
    ("pass_spp", "rounded", "message"),
    [(8, square, "8 samples per pixel in a pass; the sampler supports 9"), (2**26, exact, r"up to 2³² − 1 samples")],
)
def test_an_impossible_size_of_passes_is_refused(pass_spp, rounded, message):
    with pytest.raises(ValueError, match=message):
        plan_passes(64, None, pass_spp, rounded, moments=True)


def test_stops_grow_in_steps_of_a_third_to_a_half():
    stops = [8]
    while len(stops) < 8:
        stops.append(next_stop(stops[-1]))
    assert stops == [8, 12, 16, 24, 32, 48, 64, 96]
    assert [next_stop(passes) for passes in (0, 7, 8, 9, 95)] == [8, 8, 12, 12, 96]


# Sums -----------------------------------------------------------------------------------------------------------------


def fold(nodes):
    sums = nodes[0].copy()
    for node in nodes[1:]:
        sums.add(node)
    return sums


def test_a_tree_has_the_mean_variance_and_contrasts_of_its_passes():
    images = RNG.normal(1, 0.1, (29, 5, 3, 4)).astype(np.float32)
    sums, exact = tree_of(images).sums(), images.astype(np.float64)
    np.testing.assert_allclose(sums.mean, exact.mean(0), rtol=1e-14)
    np.testing.assert_allclose(sums.variance, 4 * exact.var(0, ddof=1), rtol=1e-12)
    assert (sums.freedom, sums.spp, sums.passes, len(sums.contrasts)) == (28, 116, 29, 28)
    np.testing.assert_allclose(np.mean(sums.contrasts), sums.variance[..., :3].mean(), rtol=1e-12)


def test_passes_of_different_sizes_are_weighted():
    """Σ nᵢ(xᵢ − x)²/(k − 1) and each contrast estimate the variance σ² of a sample if that of xᵢ is σ²/nᵢ."""
    estimates = []
    for _ in range(4000):
        sums = fold([leaf(RNG.normal(0, spp**-0.5, (1, 1, 1)), spp) for spp in (8, 8, 8, 3)])
        estimates.append([sums.variance.item(), *sums.contrasts])
    # Their standard deviation is √2 at most. The mean of 4000 is beyond 4.5 standard errors 4 times in 1e5.
    assert np.all(np.abs(np.mean(estimates, 0) - 1) < 4.5 * np.sqrt(2 / 4000))


def weighted(shape, spp=4):
    """Return totals and weights of samples with weights from 0 to 2, and values that depend on the weights."""
    w = RNG.uniform(0, 2, (*shape, spp))
    v = RNG.normal(1, 0.3, (*shape, spp)) + w
    return (w * v).sum(-1), w.sum(-1)


def weighted_sums(totals, weights, spp=4):
    leaves = zip(totals, weights, strict=True)
    return fold([PassSums(spp, 1, total.copy(), np.zeros_like(total), weights=w.copy()) for total, w in leaves])


def test_a_weighted_mean_is_the_quotient_of_both_sums():
    totals, weights = weighted((29, 5, 3, 1))
    sums = weighted_sums(totals, weights)
    np.testing.assert_allclose(sums.mean, totals.sum(0) / weights.sum(0), rtol=1e-14)
    assert np.abs((totals / weights).mean(0) / sums.mean - 1).min() > 1e-6
    base = PassSums(400, 100, 400 * np.ones((5, 3, 1)), np.zeros((5, 3, 1)))  # of an image, without weights
    base.add(weighted_sums(totals[:1], weights[:1]))
    np.testing.assert_allclose(base.mean, (400 + totals[0]) / (400 + weights[0]), rtol=1e-14)
    sums = weighted_sums(np.zeros((9, 1, 1, 3)), np.zeros((9, 1, 1, 1)))  # a pixel that no sample reaches
    assert not sums.mean.any() and not sums.variance.any() and not np.any(sums.contrasts)


def test_the_estimated_variance_of_a_weighted_mean_is_that_of_many_renders():
    """The variance over 4000 renders of 16 passes has a standard error of 2.2 %, the estimates have less."""
    totals, weights = weighted((16, 4000, 1, 1))
    sums = weighted_sums(totals, weights)
    true = sums.spp * sums.mean.var(ddof=1)
    np.testing.assert_allclose(sums.variance.mean(), true, rtol=4.5 * 0.022)
    np.testing.assert_allclose(np.mean(sums.contrasts), true, rtol=4.5 * 0.022)
    without_weights = 4 * (totals / 4).var(0, ddof=1).mean()  # includes the variance that weights cause
    assert without_weights > 2 * true


def test_equal_passes_have_no_variance():
    image = RNG.uniform(0, 1, (4, 4, 3)).astype(np.float32)
    sums = tree_of([image] * 70).sums()
    assert not sums.variance.any()
    np.testing.assert_array_equal(sums.mean, image)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 63, 64, 65, 100, 130])
@pytest.mark.parametrize("largest", [0, 1, 2])
def test_nodes_of_any_level_give_the_same_bits(count, largest):
    images = (RNG.normal(0, 1, (count, 2, 3, 3)) * 10.0 ** RNG.integers(-6, 6, (count, 1, 1, 1))).astype(np.float32)
    expected, tree = tree_of(images).sums(), PassTree()
    for level, first in aligned_nodes(0, count, largest):
        nodes = [leaf(image) for image in images[first : first + ARITY**level]]
        for _ in range(level):
            nodes = [fold(nodes[i : i + ARITY]) for i in range(0, len(nodes), ARITY)]
        tree.add(nodes[0], level)
    sums = tree.sums()
    np.testing.assert_array_equal(sums.total, expected.total)
    np.testing.assert_array_equal(sums.between, expected.between)
    assert sums.contrasts == expected.contrasts
    sequential = fold([leaf(image) for image in images])
    assert count < 64 or not np.array_equal(sequential.total, expected.total)  # the order matters for these images
    if count == 7:
        with pytest.raises(ValueError, match="8 passes after 7"):
            tree.add(fold([leaf(np.ones((1, 1, 1)))] * 8), 1)


def test_second_moments_are_used_only_for_few_passes():
    samples = RNG.normal(3, 1, (7, 4, 2, 2, 3)).astype(np.float32).astype(np.float64)
    means = samples.mean(1).astype(np.float32).astype(np.float64)
    nodes = [leaf(m, 4, ((v - m) ** 2).sum(0)) for v, m in zip(samples, means, strict=True)]
    few = fold(nodes)
    assert few.freedom == 27
    np.testing.assert_allclose(few.variance, samples.reshape(28, 2, 2, 3).var(0, ddof=1), rtol=1e-6)
    more = fold([*nodes, nodes[0]])
    assert more.within is None and more.freedom == 7


def test_non_finite_pixels_remain_and_are_left_out_of_contrasts():
    images = RNG.normal(1, 0.1, (9, 4, 4, 3)).astype(np.float32)
    images[3, 0, 0, 0], images[5, 1, 1, 1] = np.nan, np.inf
    sums = tree_of(images).sums()
    assert np.isnan(sums.mean[0, 0, 0]) and not np.isfinite(sums.mean[1, 1, 1])
    assert np.isfinite(sums.mean).sum() == 46 and np.isfinite(sums.contrasts).all()


ONES = np.ones((2, 3, 3))
INVALID = [
    {"spp": 8},
    {"spp": -64},
    {"passes": 2},
    {"contrasts": [1.0]},
    {"total": np.ones((1, 1, 3))},
    {"total": np.ones((2, 3, 4)), "between": np.ones((2, 3, 4))},
    {"between": -ONES},
    {"within": np.nan * ONES},
    {"weights": ONES},
    {"weights": np.inf * np.ones((2, 3, 1))},
]


@pytest.mark.parametrize("invalid", INVALID, ids=lambda invalid: next(iter(invalid)))
def test_sums_of_another_image_are_refused(invalid):
    valid = {"spp": 4, "passes": 1, "total": ONES, "between": 0 * ONES}
    PassSums(**valid).check((2, 3, 3), 1, 4)
    PassSums(**valid | {"total": np.nan * ONES, "between": np.nan * ONES}).check((2, 3, 3), 1, 4)  # a scene with NaN
    with pytest.raises(ValueError, match=r"^(sums of|weights that)"):
        PassSums(**valid | invalid).check((2, 3, 3), 1, 4)
