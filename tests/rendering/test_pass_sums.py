"""Sums over passes: their statistics against NumPy's, and bits that do not depend on who adds."""

from __future__ import annotations

import numpy as np
import pytest

from mi_refract.rendering.pass_sums import ARITY, PassSums, PassTree, aligned_nodes

RNG = np.random.default_rng(16)


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


def test_mean_and_variance_are_those_of_the_passes():
    images = RNG.normal(1, 0.1, (29, 5, 3, 4)).astype(np.float32)
    sums = tree_of(images).sums()
    exact = images.astype(np.float64)
    np.testing.assert_allclose(sums.mean, exact.mean(0), rtol=1e-14)
    np.testing.assert_allclose(sums.variance, 4 * exact.var(0, ddof=1), rtol=1e-12)
    assert (sums.freedom, sums.spp, sums.passes) == (28, 116, 29)


def test_contrasts_average_to_the_variance():
    images = RNG.normal(1, 0.1, (29, 5, 3, 4)).astype(np.float32)
    sums = tree_of(images).sums()
    assert len(sums.contrasts) == 28
    np.testing.assert_allclose(np.mean(sums.contrasts), sums.variance[..., :3].mean(), rtol=1e-12)


def test_passes_of_different_sizes_are_weighted():
    """Σ nᵢ(xᵢ − x)²/(k − 1) is the variance of a sample, and so is each contrast, where that of xᵢ is σ²/nᵢ."""
    found = []
    for _ in range(4000):
        nodes = [leaf(RNG.normal(0, spp**-0.5, (1, 1, 1)), spp) for spp in (8, 8, 8, 3)]
        sums = fold(nodes)
        found.append([sums.variance.item(), *sums.contrasts])
    # Of 4000 values with standard deviation √2 at most the mean is within 4.5 standard errors; else 4 times in 1e5.
    assert np.all(np.abs(np.mean(found, 0) - 1) < 4.5 * np.sqrt(2 / 4000))


def weighted_passes(shape, spp=4):
    """Of samples that reach a pixel with weights from 0 to 2, whose values depend on them."""
    w = RNG.uniform(0, 2, (*shape, spp))
    v = RNG.normal(1, 0.3, (*shape, spp)) + w
    return (w * v).sum(-1), w.sum(-1)


def weighted_leaf(total, weights, spp=4):
    return PassSums(spp, 1, total.copy(), np.zeros_like(total), weights=weights.copy())


def test_a_weighted_mean_is_one_quotient():
    totals, weights = weighted_passes((29, 5, 3, 1))
    sums = fold([weighted_leaf(*each) for each in zip(totals, weights, strict=True)])
    np.testing.assert_allclose(sums.mean, totals.sum(0) / weights.sum(0), rtol=1e-14)
    quotients = (totals / weights).mean(0)
    assert np.abs(quotients / sums.mean - 1).min() > 1e-6


def test_the_variance_of_a_weighted_mean_is_that_over_many_renders():
    """Of 4000 renders of 16 passes: their mean's variance is known to 2.2 % (one σ), its estimate better."""
    totals, weights = weighted_passes((16, 4000, 1, 1))
    sums = fold([weighted_leaf(*each) for each in zip(totals, weights, strict=True)])
    true = sums.spp * sums.mean.var(ddof=1)
    np.testing.assert_allclose(sums.variance.mean(), true, rtol=4.5 * 0.022)
    np.testing.assert_allclose(np.mean(sums.contrasts), true, rtol=4.5 * 0.022)
    unexplained = 4 * (totals / 4).var(0, ddof=1).mean()  # what weights cause is left in
    assert unexplained > 2 * true


def test_weights_may_be_unknown_of_what_comes_from_an_image():
    totals, weights = weighted_passes((2, 5, 3, 1))
    base = PassSums(400, 100, 400 * np.ones((5, 3, 1)), np.zeros((5, 3, 1)))
    base.add(weighted_leaf(totals[0], weights[0]))
    np.testing.assert_allclose(base.mean, (400 + totals[0]) / (400 + weights[0]), rtol=1e-14)


def test_a_pixel_that_no_sample_reaches_is_black():
    sums = fold([weighted_leaf(np.zeros((1, 1, 3)), np.zeros((1, 1, 1))) for _ in range(9)])
    assert not sums.mean.any() and not sums.variance.any() and not np.any(sums.contrasts)


def test_equal_samples_have_no_variance():
    image = RNG.uniform(0, 1, (4, 4, 3)).astype(np.float32)
    sums = tree_of([image] * 70).sums()
    assert not sums.variance.any()
    np.testing.assert_array_equal(sums.mean, image)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 63, 64, 65, 100, 130])
@pytest.mark.parametrize("largest", [0, 1, 2])
def test_nodes_of_any_level_give_the_same_bits(count, largest):
    images = (RNG.normal(0, 1, (count, 2, 3, 3)) * 10.0 ** RNG.integers(-6, 6, (count, 1, 1, 1))).astype(np.float32)
    expected = tree_of(images).sums()
    tree = PassTree()
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


def test_a_node_must_follow_the_last_one():
    tree = tree_of([np.ones((1, 1, 1))] * 3)
    with pytest.raises(ValueError, match="8 passes after 3"):
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
    images[3, 0, 0, 0] = np.nan
    images[5, 1, 1, 1] = np.inf
    sums = tree_of(images).sums()
    assert np.isnan(sums.mean[0, 0, 0]) and not np.isfinite(sums.mean[1, 1, 1])
    assert np.isfinite(sums.mean).sum() == 46
    assert np.isfinite(sums.contrasts).all()
