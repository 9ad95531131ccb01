"""Passes: how a render is cut into them, their seeds, and their sums, with bits that do not depend on who adds."""

from __future__ import annotations

import numpy as np
import pytest

from mi_refract.rendering.pass_plan import LANES, PassPlan, next_stop, plan_passes, scalar_seed_of, seed_of, usual_spp
from mi_refract.rendering.pass_sums import ARITY, PassSums, PassTree, aligned_nodes

RNG = np.random.default_rng(16)

# Plans and seeds ------------------------------------------------------------------------------------------------------


def exact(spp):
    """A sampler that takes any number of samples."""
    return spp


def square(spp):
    """A sampler that rounds up to a square, as Mitsuba's `stratified`."""
    return next(n * n for n in range(1, 10**6) if n * n >= spp)


def four(spp):
    """A sampler that takes no fewer than 4."""
    return max(4, spp)


def test_the_seeds_of_a_render_differ_and_so_do_those_of_seeds_that_follow_each_other():
    assert [seed_of(seed, 0) for seed in (0, 1, 7, 2**32 - 1)] == [0, 1, 7, 2**32 - 1]
    # Of MurmurHash3's own test: fmix32(1) = 0x514E28B7.
    assert [seed_of(0, 1), seed_of(5, 1)] == [0x514E28B7, 0x514E28B7 ^ 5]
    seeds = [{seed_of(seed, number) for number in range(20000)} for seed in (0, 1, 2)]
    assert [len(each) for each in seeds] == [20000] * 3
    # Of two sets of n random numbers below 2³² n²/2³² = 0.09 are common: more than 3 of them have probability 3e-6.
    assert all(len(a & b) <= 3 for a, b in ((seeds[0], seeds[1]), (seeds[0], seeds[2]), (seeds[1], seeds[2])))
    assert all(0 <= seed < 2**32 for seed in seeds[1])


def test_the_seeds_of_scalar_variants_are_in_a_row():
    most = 2**32 // 3000
    assert [scalar_seed_of(0, p, 3000) for p in (0, 1, most - 1)] == [0, 1, most - 1]
    assert scalar_seed_of(1, 5, 3000) == (0x514E28B7 + 5) % most
    with pytest.raises(ValueError, match="scalar variants support up to"):
        scalar_seed_of(0, most, 3000)


@pytest.mark.parametrize("pixels", [1, 48, 64 * 64, 512 * 512, 1920 * 1080, 3840 * 2160, 2**24, 2**26])
def test_a_pass_is_bounded_and_a_power_of_two(pixels):
    spp = usual_spp(pixels)
    assert spp & (spp - 1) == 0
    assert spp == 1 or spp * pixels <= LANES
    assert 2 * spp * pixels > LANES or spp >= 4


def test_a_render_of_many_samples_has_larger_passes_but_at_least_sixteen():
    assert [usual_spp(2**18, total) for total in (None, 64, 128, 256, 512, 4096)] == [8, 8, 8, 16, 32, 32]
    assert usual_spp(1920 * 1080, 65536) == 4


@pytest.mark.parametrize(
    ("pixels", "total", "asked", "sampler", "moments", "plan"),
    [
        (64, 100, 8, exact, True, (8, 100, 12, 4, 13)),
        (64, 96, 8, exact, True, (8, 96, 12, 0, 12)),
        (64, 64, None, exact, False, (8, 64, 8, 0, 8)),  # without moments a short render has eight passes
        (64, 5, None, exact, False, (1, 5, 5, 0, 5)),
        (64, 5, None, exact, True, (2**15, 5, 0, 5, 1)),
        (64, 10, 2**26, exact, True, (2**26, 10, 0, 10, 1)),
        (64, None, 8, exact, True, (8, None, None, 0, None)),
        (2**18, 100, None, square, True, (4, 100, 25, 0, 25)),  # 8 would become 9
        (2**18, 102, 9, square, True, (9, 103, 11, 4, 12)),  # 11 × 9, and 3 become 4
        (64, 16, None, four, False, (4, 16, 4, 0, 4)),  # eight passes would have 2
        (2**23, 3, None, four, True, (4, 4, 1, 0, 1)),
    ],
)
def test_plans(pixels, total, asked, sampler, moments, plan):
    found = plan_passes(pixels, total, asked, sampler, moments=moments)
    assert found == PassPlan(*plan[:2]) and (found.full_passes, found.rest, found.passes) == plan[2:]


@pytest.mark.parametrize(
    ("asked", "sampler", "message"),
    [
        (8, square, "8 samples per pixel in a pass; the sampler supports 9"),
        (2**26, exact, r"expected up to 2³² − 1 samples in all"),
    ],
)
def test_a_pass_that_cannot_be(asked, sampler, message):
    with pytest.raises(ValueError, match=message):
        plan_passes(64, None, asked, sampler, moments=True)


def test_looks_are_few():
    stops = [8]
    while len(stops) < 8:
        stops.append(next_stop(stops[-1]))
    assert stops == [8, 12, 16, 24, 32, 48, 64, 96]
    assert [next_stop(passes) for passes in (0, 7, 8, 9, 95)] == [8, 8, 12, 12, 96]


# Sums -----------------------------------------------------------------------------------------------------------------


def leaf(image, spp=4, within=None):
    image = np.asarray(image, np.float32).astype(np.float64)
    return PassSums(spp, 1, image * spp, np.zeros_like(image), within, colours=min(3, image.shape[-1]))


def fold(nodes):
    found = nodes[0].copy()
    for node in nodes[1:]:
        found.add(node)
    return found


def tree_of(images):
    tree = PassTree()
    for image in images:
        tree.add(leaf(image))
    return tree


def test_mean_variance_and_contrasts_are_those_of_the_passes():
    images = RNG.normal(1, 0.1, (29, 5, 3, 4)).astype(np.float32)
    sums, exact = tree_of(images).sums(), images.astype(np.float64)
    np.testing.assert_allclose(sums.mean, exact.mean(0), rtol=1e-14)
    np.testing.assert_allclose(sums.variance, 4 * exact.var(0, ddof=1), rtol=1e-12)
    assert (sums.freedom, sums.spp, sums.passes, len(sums.contrasts)) == (28, 116, 29, 28)
    np.testing.assert_allclose(np.mean(sums.contrasts), sums.variance[..., :3].mean(), rtol=1e-12)


def test_passes_of_different_sizes_are_weighted():
    """Σ nᵢ(xᵢ − x)²/(k − 1) is the variance of a sample, and so is each contrast, where that of xᵢ is σ²/nᵢ."""
    found = []
    for _ in range(4000):
        sums = fold([leaf(RNG.normal(0, spp**-0.5, (1, 1, 1)), spp) for spp in (8, 8, 8, 3)])
        found.append([sums.variance.item(), *sums.contrasts])
    # Of 4000 values with standard deviation √2 at most the mean is within 4.5 standard errors; else 4 times in 1e5.
    assert np.all(np.abs(np.mean(found, 0) - 1) < 4.5 * np.sqrt(2 / 4000))


def weighted(shape, spp=4):
    """Totals and weights of samples that reach a pixel with weights from 0 to 2, whose values depend on them."""
    w = RNG.uniform(0, 2, (*shape, spp))
    v = RNG.normal(1, 0.3, (*shape, spp)) + w
    return (w * v).sum(-1), w.sum(-1)


def weighted_sums(totals, weights, spp=4):
    leaves = zip(totals, weights, strict=True)
    return fold([PassSums(spp, 1, total.copy(), np.zeros_like(total), weights=w.copy()) for total, w in leaves])


def test_a_weighted_mean_is_one_quotient():
    totals, weights = weighted((29, 5, 3, 1))
    sums = weighted_sums(totals, weights)
    np.testing.assert_allclose(sums.mean, totals.sum(0) / weights.sum(0), rtol=1e-14)
    assert np.abs((totals / weights).mean(0) / sums.mean - 1).min() > 1e-6
    base = PassSums(400, 100, 400 * np.ones((5, 3, 1)), np.zeros((5, 3, 1)))  # of an image: weights are unknown
    base.add(weighted_sums(totals[:1], weights[:1]))
    np.testing.assert_allclose(base.mean, (400 + totals[0]) / (400 + weights[0]), rtol=1e-14)
    sums = weighted_sums(np.zeros((9, 1, 1, 3)), np.zeros((9, 1, 1, 1)))  # a pixel that no sample reaches
    assert not sums.mean.any() and not sums.variance.any() and not np.any(sums.contrasts)


def test_the_variance_of_a_weighted_mean_is_that_over_many_renders():
    """Of 4000 renders of 16 passes: their mean's variance is known to 2.2 % (one σ), its estimate better."""
    totals, weights = weighted((16, 4000, 1, 1))
    sums = weighted_sums(totals, weights)
    true = sums.spp * sums.mean.var(ddof=1)
    np.testing.assert_allclose(sums.variance.mean(), true, rtol=4.5 * 0.022)
    np.testing.assert_allclose(np.mean(sums.contrasts), true, rtol=4.5 * 0.022)
    unexplained = 4 * (totals / 4).var(0, ddof=1).mean()  # what weights cause is left in
    assert unexplained > 2 * true


def test_equal_samples_have_no_variance():
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
    found = tree.sums()
    np.testing.assert_array_equal(found.total, expected.total)
    np.testing.assert_array_equal(found.between, expected.between)
    assert found.contrasts == expected.contrasts
    in_a_row = fold([leaf(image) for image in images])
    assert count < 64 or not np.array_equal(in_a_row.total, expected.total)  # or the order would not matter here
    if count == 7:
        with pytest.raises(ValueError, match="8 passes after 7"):
            tree.add(fold([leaf(np.ones((1, 1, 1)))] * 8), 1)


def test_second_moments_count_as_long_as_passes_are_few():
    samples = RNG.normal(3, 1, (7, 4, 2, 2, 3)).astype(np.float32).astype(np.float64)
    means = samples.mean(1).astype(np.float32).astype(np.float64)
    nodes = [leaf(m, 4, ((v - m) ** 2).sum(0)) for v, m in zip(samples, means, strict=True)]
    few = fold(nodes)
    assert few.freedom == 27
    np.testing.assert_allclose(few.variance, samples.reshape(28, 2, 2, 3).var(0, ddof=1), rtol=1e-6)
    more = fold([*nodes, nodes[0]])
    assert more.within is None and more.freedom == 7


def test_what_is_not_finite_stays_so_and_spoils_no_estimate():
    images = RNG.normal(1, 0.1, (9, 4, 4, 3)).astype(np.float32)
    images[3, 0, 0, 0], images[5, 1, 1, 1] = np.nan, np.inf
    sums = tree_of(images).sums()
    assert np.isnan(sums.mean[0, 0, 0]) and not np.isfinite(sums.mean[1, 1, 1])
    assert np.isfinite(sums.mean).sum() == 46 and np.isfinite(sums.contrasts).all()


ONES = np.ones((2, 3, 3))
WRONG = [
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


@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: next(iter(wrong)))
def test_sums_of_another_image_are_refused(wrong):
    right = {"spp": 4, "passes": 1, "total": ONES, "between": 0 * ONES}
    PassSums(**right).check((2, 3, 3), 1, 4)
    PassSums(**right | {"total": np.nan * ONES, "between": np.nan * ONES}).check((2, 3, 3), 1, 4)  # of such a scene
    with pytest.raises(ValueError, match=r"^(sums of|weights that)"):
        PassSums(**right | wrong).check((2, 3, 3), 1, 4)
