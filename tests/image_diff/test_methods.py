"""Comparison of images: what must be seen, what must not, and how often equal images alarm."""

import numpy as np
import pytest

from mi_refract.image_diff.pixelwise import changes
from mi_refract.image_diff.tile_statistics import compare_stacks, relative_mse

RNG = np.random.default_rng(1)
SHAPE = (32, 32, 3)


def renders(count, mean=1.0, deviation=0.3, shape=SHAPE):
    """Independent noisy renders with a skewed distribution, as light has."""
    return mean + deviation * (RNG.gamma(2.0, 1.0, (count, *shape)) - 2) / np.sqrt(2)


def test_paired_counts_pixels_not_channels():
    reference = np.ones(SHAPE)
    test = reference.copy()
    test[0, 0] += 1e-3
    test[1, 1, 2] += 2e-6
    found = changes(reference, test, 1e-5)
    assert found.share == 1 / 1024
    assert found.largest == pytest.approx(1e-3)
    assert found.mean_ratio == pytest.approx(1 + (3e-3 + 2e-6) / reference.size)


@pytest.mark.parametrize(("one", "two", "ratio"), [(2, 3, 1.5), (4, 1, 0.25), (0, 3, 4), (0, 0, 1), (-2, 1, -0.5)])
def test_the_ratio_of_the_means(one, two, ratio):
    """Against black, where there is no ratio, it is 1 and as much as is added."""
    found = changes(np.full(SHAPE, float(one)), np.full(SHAPE, float(two)), 1e-5)
    assert found.mean_ratio == pytest.approx(ratio)
    assert found.rms == found.largest == abs(one - two)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_pixel_that_is_not_finite_equals_nothing_not_even_itself(bad):
    image = np.ones(SHAPE)
    image[3, 4, 0] = bad
    found = changes(image, image, 1e-5)
    assert found.share == 1 / 1024
    assert not found.largest <= 1e30
    stack = np.stack([image] * 3)
    assert compare_stacks(stack, stack, 16, 1e-3).alarms > 0


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="different shapes"):
        changes(np.ones((4, 4, 3)), np.ones((4, 2, 3)), 1e-5)
    with pytest.raises(ValueError, match="different shapes"):
        compare_stacks(np.ones((3, 16, 16, 3)), np.ones((3, 16, 8, 3)), 8, 1e-3)
    with pytest.raises(ValueError, match="at least 2"):
        compare_stacks(np.ones((1, 16, 16, 3)), np.ones((3, 16, 16, 3)), 8, 1e-3)
    with pytest.raises(ValueError, match="3 and 1 renders: at least 2"):
        compare_stacks(np.ones((3, 16, 16, 3)), np.ones((1, 16, 16, 3)), 8, 1e-3)


def test_equal_images_alarm_no_more_often_than_stated():
    """400 null pairs at a family error of 5 %: 20 expected; more than 40 has probability below 2e-5."""
    alarms = sum(compare_stacks(renders(5), renders(5), 16, 0.05).alarms > 0 for _ in range(400))
    assert alarms <= 40


def test_a_difference_twice_the_detectable_one_is_seen():
    reference, test = renders(6), renders(6)
    detectable = compare_stacks(reference, test, 16, 1e-3).minimum_detectable()
    assert 0 < detectable < 0.1
    assert compare_stacks(reference, test * (1 + 2 * detectable), 16, 1e-3).alarms > 0
    local = test.copy()
    local[:, :16, 16:, 1] *= 1 + 2 * detectable
    assert compare_stacks(reference, local, 16, 1e-3).alarms == 1


def test_the_edge_that_fills_no_tile_is_tested_too():
    reference, test = renders(6, shape=(20, 20, 3)), renders(6, shape=(20, 20, 3))
    test[:, 17:, 17:] *= 2
    assert compare_stacks(reference, test, 16, 1e-3).alarms == 3


def test_black_equals_black_and_a_dark_tile_has_a_floor():
    black = np.zeros(SHAPE)
    assert changes(black, black, 1e-5).mean_ratio == 1
    stack = np.ones((4, *SHAPE))
    stack[:, :16, :16] = 0
    other = stack.copy()
    other[:, :16, :16] = 1e-9
    assert compare_stacks(stack, other, 16, 1e-3, equivalence_margin=1e-5).alarms == 0
    other[:, :16, :16] = 1e-6
    assert compare_stacks(stack, other, 16, 1e-3, equivalence_margin=1e-5).alarms == 3


def test_tiles_without_noise_are_counted_and_compared_within_the_margin():
    reference = np.ones((4, *SHAPE))
    last_bits, off = reference * (1 + 1e-7), reference * (1 + 1e-4)
    assert compare_stacks(reference, last_bits, 16, 1e-3, equivalence_margin=1e-5).alarms == 0
    assert compare_stacks(reference, last_bits, 16, 1e-3).alarms == 12
    found = compare_stacks(reference, off, 16, 1e-3, equivalence_margin=1e-5)
    assert (found.alarms, found.silent_differing) == (12, 12)


def test_relative_mse_leaves_out_the_references_own_noise():
    references = renders(32)
    image = renders(1)[0]
    expected = 0.3**2 / 1.01
    assert relative_mse(image, references) == pytest.approx(expected, rel=0.15)
    assert relative_mse(image + 0.5, references) == pytest.approx(expected + 0.25 / 1.01, rel=0.15)
    assert relative_mse(np.ones(SHAPE), references) == pytest.approx(0, abs=0.1 * expected)
