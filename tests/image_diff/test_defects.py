"""Planted defects are what they are called, and leave the image that they are given as it is."""

import numpy as np
import pytest

from mi_refract.image_diff.self_test import DEFECTS, through_a_file
from mi_refract.io.pixels import srgb_encode

IMAGE = np.random.default_rng(3).gamma(0.5, 1.0, (6, 9, 3)).astype(np.float32)
PADDED = np.pad(IMAGE, ((1, 1), (1, 1), (0, 0)), mode="edge")


def one_pixel(value):
    image = IMAGE.copy()
    image[3, 4] = value
    return image


EXPECTED = {
    "gain": 1.01 * IMAGE,
    "shift": np.concatenate([IMAGE[:, -1:], IMAGE[:, :-1]], 1),
    "swapped channels": np.stack([IMAGE[..., i] for i in (2, 1, 0)], -1),
    "blur": sum(PADDED[y : y + 6, x : x + 9] for y in range(3) for x in range(3)) / 9,
    "firefly": one_pixel(1e3 * IMAGE.mean()),
    "NaN": one_pixel(np.nan),
    "Inf": one_pixel(np.inf),
    "wrong size": IMAGE[:, 1:],
}


@pytest.mark.parametrize("name", EXPECTED)
def test_a_defect_is_what_it_is_called(name):
    renders = np.stack([IMAGE, IMAGE + 1, IMAGE + 2])
    spoilt = DEFECTS[name].spoil(renders)
    np.testing.assert_allclose(spoilt[0], EXPECTED[name], rtol=1e-5, atol=1e-7)
    once = name in ("NaN", "Inf", "wrong size")  # every method must see these, in one of several renders
    assert (DEFECTS[name].always_due, np.array_equal(spoilt[2], renders[2])) == (once, once)
    np.testing.assert_array_equal(renders[0], IMAGE)


def test_8_bits_are_256_values_up_to_white():
    codes = 255 * srgb_encode(DEFECTS["8 bits"].plant(IMAGE))
    np.testing.assert_allclose(codes, np.rint(codes), atol=2e-4)
    assert (np.abs(codes - 255 * srgb_encode(np.minimum(IMAGE, 1))) <= 0.501).all()
    assert (np.rint(codes)[IMAGE > 1] == 255).all() and (IMAGE > 1).any()


def test_half_a_file():
    np.testing.assert_array_equal(through_a_file(IMAGE), IMAGE)
    assert DEFECTS["truncated"].always_due
    with pytest.raises(ValueError):
        DEFECTS["truncated"].spoil(IMAGE[None])
