"""Sums over the samples of a box filter, against those of NumPy: samples are read in rows of 1, 2, 4 or 8."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from mi_refract.rendering.sample_sums import Film, image_sums

WIDTH, HEIGHT = 5, 3


def sums_of(samples, *, squares=True):
    """`samples`: H × W × spp × C."""
    values = [mi.Float(samples[..., c].ravel()) for c in range(samples.shape[3])]
    return image_sums(values, None, Film(WIDTH, HEIGHT, samples.shape[2], None), squares=squares)


@pytest.mark.parametrize("spp", [1, 2, 3, 4, 6, 7, 8, 12, 16])
@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("first", [0.5, 1e4])
def test_sums_and_squares(llvm, spp, channels, first):
    """Within n roundings of the terms, also where the first sample, from which differences are taken, lies far off."""
    samples = np.random.default_rng(spp).random((HEIGHT, WIDTH, spp, channels), np.float32)
    samples[:, :, 0] = first
    total, weights, within = sums_of(samples)
    samples = samples.astype(np.float64)
    np.testing.assert_allclose(total, samples.sum(2), rtol=spp * 2**-52)
    mean = samples.mean(2, keepdims=True)
    bound = 4 * (spp + 2) * 2**-52 * ((samples - samples[:, :, :1]) ** 2).sum(2)
    assert np.all(np.abs(within - ((samples - mean) ** 2).sum(2)) <= bound)
    assert weights is None and total.shape == within.shape == (HEIGHT, WIDTH, channels)


def test_without_squares(llvm):
    samples = np.random.default_rng(0).random((HEIGHT, WIDTH, 8, 3), np.float32)
    total, _, within = sums_of(samples, squares=False)
    np.testing.assert_array_equal(total, sums_of(samples)[0])
    assert within is None


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("place", [0, 3])
def test_what_is_not_finite_stays_in_its_pixel_and_channel(llvm, value, place):
    samples = np.ones((HEIGHT, WIDTH, 8, 3), np.float32)
    samples[1, 2, place, 1] = value
    total, _, within = sums_of(samples)
    assert np.argwhere(~np.isfinite(total)).tolist() == [[1, 2, 1]]
    assert not within[np.isfinite(total)].any()
