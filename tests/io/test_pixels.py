"""The sRGB curve and block sums, against what is worked out by hand or by loops."""

import numpy as np
import pytest

from mi_refract.io.pixels import any_channel, block_area, block_mean, block_sum, srgb_decode, srgb_encode


def test_the_srgb_curve_is_that_of_the_standard():
    linear = np.array([0.0, 0.001, 0.0031308, 0.214, 0.5, 1.0])
    assert srgb_encode(linear) == pytest.approx([0.0, 0.01292, 0.04045, 0.5, 0.735357, 1.0], abs=1e-4)
    assert srgb_decode(srgb_encode(linear)) == pytest.approx(linear, rel=1e-6)


def test_blocks_at_the_edge_are_of_what_is_left():
    pixels = np.random.default_rng(3).random((2, 7, 5, 3))
    sums, means = block_sum(pixels, 4), block_mean(pixels[0], 4)
    assert sums.shape == (2, 2, 2, 3)
    assert sums[1, 1, 0] == pytest.approx(pixels[1, 4:, :4].sum((0, 1)))
    assert means[1, 1] == pytest.approx(pixels[0, 4:, 4:].mean((0, 1)))
    assert block_area(7, 5, 4)[..., 0].tolist() == [[16, 4], [12, 3]]
    assert block_mean(pixels[0].astype(np.float32), 4).dtype == np.float32


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 8, 9, 40])
@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_any_channel(channels, share):
    flags = np.random.default_rng(channels).random((6, 7, channels)) < share
    assert np.array_equal(any_channel(flags), flags.any(-1))
    assert any_channel(flags.reshape(-1, channels)).shape == (42,)


def test_any_of_no_channel():
    assert not any_channel(np.ones((2, 3, 0), bool)).any()
