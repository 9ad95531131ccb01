"""Images in which a comparison sees little: fireflies, values past float32, black, and noise it cannot count on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import compare
from mi_refract.io.image_file import Image

RNG = np.random.default_rng(11)
SMOOTH = RNG.uniform(0.1, 0.9, (48, 40, 3))
EQUAL, DIFFERENT, INCONCLUSIVE = Verdict.EQUAL, Verdict.DIFFERENT, Verdict.INCONCLUSIVE


def image(pixels, dtype=np.float32):
    pixels = np.asarray(pixels, dtype)
    return Image(Path("a.exr"), pixels, tuple("RGB"[: pixels.shape[2]]))


def flat(value, dtype=np.float32):
    return image(np.full((16, 16, 3), value), dtype)


def with_pixel(pixels, value):
    spoilt = pixels.copy()
    spoilt[7, 5] = value
    return image(spoilt)


@pytest.mark.parametrize("method", ["tolerance", "paired", "flip"])
@pytest.mark.parametrize("brightness", [1e3, 1e5, 1e7, 1e9])
def test_one_firefly_in_both_hides_nothing_of_the_rest(method, brightness):
    reference = with_pixel(SMOOTH, brightness)
    for rest in (0 * SMOOTH, 1 - SMOOTH):
        assert compare(method, reference, with_pixel(rest, brightness)).verdict is DIFFERENT
    assert compare(method, reference, reference).verdict is EQUAL


@pytest.mark.parametrize("method", ["exact", "tolerance", "paired"])
@pytest.mark.parametrize("a, b", [(3e38, 2e38), (3e38, -3e38), (1e-40, 5e-40)])
def test_the_ends_of_float32(method, a, b):
    options = {"fail": 0.0} if method == "tolerance" else {}
    assert compare(method, flat(a), flat(b), **options).verdict is DIFFERENT


def test_what_float32_does_not_hold_is_compared_or_refused():
    for a, b in ((1 + 1e-12, 1.0), (1e39, 2e39), (1e39, 0.0), (1e9 + 1, 1e9)):
        found = compare("tolerance", flat(a, float), flat(b, float), fail=0.0, fail_relative=0.0)
        assert found.verdict is DIFFERENT
        assert found.metrics[1].value == abs(a - b)
    with pytest.raises(ValueError, match=r"beyond those of float32"):
        compare("flip", flat(1e39, float), flat(0, float))


@pytest.mark.parametrize("fail, relative", [(0.05, 0.5), (0.0, 0.1), (0.3, 0.0), (0.1, 3.0)])
def test_tolerance_counts_what_openimageio_counts(fail, relative):
    a = RNG.standard_normal((50, 50, 3)).astype(np.float32)
    b = (a + 0.3 * RNG.standard_normal(a.shape)).astype(np.float32)
    b[::5] *= -1
    result = oiio.ImageBufAlgo.compare(oiio.ImageBuf(a), oiio.ImageBuf(b), fail, 0.2, relative, 0.3)
    options = {"fail": fail, "fail_relative": relative, "warn": 0.2, "warn_relative": 0.3}
    metrics = [m.value for m in compare("tolerance", image(a), image(b), **options).metrics]
    expected = [result.nfail, result.maxerror, result.meanerror, result.rms_error, result.nwarn]
    np.testing.assert_allclose(metrics, expected, rtol=1e-6)


@pytest.mark.parametrize(
    "method, options", [("tolerance", {}), ("paired", {"threshold": 2.0}), ("flip", {"local": 9.0, "patch": 1.0})]
)
def test_a_method_that_black_would_pass_knows_nothing(method, options):
    dark = 0.004 * SMOOTH
    found = compare(method, image(dark), image(0.9 * dark), **options)
    assert found.verdict is INCONCLUSIVE
    assert found.reason.startswith("an all-black image would pass, too")
    assert compare(method, image(dark), image(dark), **options).verdict is EQUAL
    assert compare(method, image(0 * dark), image(0 * dark), **options).verdict is EQUAL


@pytest.mark.parametrize("method", ["tolerance", "paired", "flip"])
def test_one_bright_pixel_is_all_there_is(method):
    black = np.zeros((128, 128, 3))
    assert compare(method, with_pixel(black, 10.0), image(black)).verdict is not EQUAL


def test_a_change_against_black_is_a_change_at_any_brightness():
    for value in (1e-9, 5e-5, 1.0):
        assert compare("paired", flat(0), flat(value)).verdict is DIFFERENT


@pytest.mark.parametrize("ppd", [0.0, 1e-9, np.inf])
def test_flip_is_not_asked_from_where_nothing_is_seen(ppd):
    with pytest.raises(ValueError, match="expected 1 to 1000"):
        compare("flip", image(SMOOTH), image(1 - SMOOTH), ppd=ppd)


# Samples -------------------------------------------------------------------------------------------------------


def renders(count, shape=(32, 32, 3), deviation=0.1, blur=0):
    """Independent renders; with `blur`, of pixels that a filter of 2 · blur + 1 correlates."""
    found = 1 + deviation * (RNG.gamma(2.0, 1.0, (count, *shape)) - 2) / np.sqrt(2)
    steps = range(-blur, blur + 1)
    return [image(np.mean([np.roll(x, (i, j), (0, 1)) for i in steps for j in steps], 0)) for x in found]


@pytest.mark.parametrize("count", [2, 8])
@pytest.mark.parametrize("shape", [(64, 64, 1), (32, 32, 3), (16, 16, 3)])
def test_a_wide_filter_makes_no_false_alarms_in_small_images(shape, count):
    """20 null pairs at 0.1 %: more than 2 has probability 1e-6. Taken for independent, half or more of them alarm."""
    pairs = (compare("welch", *(renders(count, shape, blur=1) for _ in range(2))) for _ in range(20))
    assert sum(found.verdict is DIFFERENT for found in pairs) <= 2


def test_a_lamp_in_the_image_makes_no_tile_dark():
    reference, test = renders(8, (64, 64, 3)), renders(8, (64, 64, 3))
    for each in (*reference, *test):
        each.pixels[:16, :16] *= 1e7
    assert compare("welch", reference, test).verdict is EQUAL
    for each in test:
        each.pixels[32:48, 32:48] *= 1.2
    assert compare("welch", reference, test).verdict is DIFFERENT


def test_without_noise_what_moves_within_a_tile_is_seen():
    board = np.where(np.indices((32, 32)).sum(0) % 2, 1.0, 0.5)[..., None] * np.ones(3)
    one, other = [image(board)] * 3, [image(np.roll(board, 1, 1))] * 3
    assert compare("welch", one, one).verdict is EQUAL
    assert compare("welch", one, other).verdict is DIFFERENT


def test_a_tile_larger_than_the_image_is_the_image():
    reference, test = renders(8), renders(8)
    found = compare("welch", reference, test, tile=10**30)
    assert found.verdict is compare("welch", reference, test, tile=32).verdict
    assert found.maps["t"].shape == (32, 32, 3)
