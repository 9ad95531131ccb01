"""Planted defects are what they are called, and leave the image that they are given as it is."""

import numpy as np
import pytest

from mi_refract.image_diff.defects import DEFECTS, through_a_file
from mi_refract.io.pixels import srgb_encode

IMAGE = np.random.default_rng(3).gamma(0.5, 1.0, (6, 9, 3)).astype(np.float32)


def planted(name):
    image = IMAGE.copy()
    spoilt = np.asarray(DEFECTS[name].plant(image))
    np.testing.assert_array_equal(image, IMAGE)
    return spoilt


def test_gain_shift_and_swapped_channels():
    np.testing.assert_allclose(planted("gain") / IMAGE, 1.01, rtol=1e-6)
    shifted = planted("shift")
    np.testing.assert_array_equal(shifted[:, 1:], IMAGE[:, :-1])
    np.testing.assert_array_equal(shifted[:, 0], IMAGE[:, -1])
    np.testing.assert_array_equal(planted("swapped channels"), np.stack([IMAGE[..., i] for i in (2, 1, 0)], -1))


def test_blur_is_the_mean_of_nine_pixels():
    blurred = planted("blur")
    assert blurred.shape == IMAGE.shape
    np.testing.assert_allclose(blurred[2, 5], IMAGE[1:4, 4:7].mean((0, 1)), rtol=1e-5)
    corner = 4 * IMAGE[0, 0] + 2 * IMAGE[0, 1] + 2 * IMAGE[1, 0] + IMAGE[1, 1]
    np.testing.assert_allclose(blurred[0, 0], corner / 9, rtol=1e-5)
    corner = 4 * IMAGE[-1, -1] + 2 * IMAGE[-1, -2] + 2 * IMAGE[-2, -1] + IMAGE[-2, -2]
    np.testing.assert_allclose(blurred[-1, -1], corner / 9, rtol=1e-5)


def test_8_bits_are_256_values_up_to_white():
    found = 255 * srgb_encode(planted("8 bits"))
    np.testing.assert_allclose(found, np.rint(found), atol=2e-4)
    wanted = 255 * srgb_encode(np.minimum(IMAGE, 1))
    assert (IMAGE > 1).any() and (np.abs(found - wanted) <= 0.501).all()
    assert (np.rint(found)[IMAGE > 1] == 255).all()


@pytest.mark.parametrize(("name", "value"), [("firefly", 1e3 * IMAGE.mean()), ("NaN", np.nan), ("Inf", np.inf)])
def test_one_pixel(name, value):
    spoilt = planted(name)
    np.testing.assert_allclose(spoilt[3, 4], [value] * 3, rtol=1e-6)
    changed = (spoilt != IMAGE).any(-1)
    assert changed.sum() == 1


def test_one_column_less_and_half_a_file():
    np.testing.assert_array_equal(planted("wrong size"), IMAGE[:, 1:])
    np.testing.assert_array_equal(through_a_file(IMAGE), IMAGE)
    with pytest.raises(ValueError):
        planted("truncated")


@pytest.mark.parametrize("name", DEFECTS)
def test_some_defects_spoil_the_first_render_only(name):
    defect, renders = DEFECTS[name], np.stack([IMAGE, IMAGE + 1, IMAGE + 2])
    once = name in ("NaN", "Inf", "wrong size", "truncated")
    assert (defect.once, defect.always_due) == (once, once)
    if name == "truncated":
        return
    spoilt = defect.spoil(renders)
    assert len(spoilt) == 3
    for i, (found, whole) in enumerate(zip(spoilt, renders, strict=True)):
        np.testing.assert_array_equal(found, whole if once and i else np.asarray(defect.plant(whole)))
