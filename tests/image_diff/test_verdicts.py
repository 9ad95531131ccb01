"""Images that are not equal and must not be called so: each once passed; and images beside them that are equal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refract.image_diff.black import groups
from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import compare
from mi_refract.io.image_file import Image

SHAPE = (64, 64, 3)
TILE = 16
EQUAL, DIFFERENT, INCONCLUSIVE = Verdict.EQUAL, Verdict.DIFFERENT, Verdict.INCONCLUSIVE
ALPHA_OR_DEPTH = [("A", 1.0), ("Z", 30.0), ("layer.A", 1.0), ("depth.Z", 30.0)]


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def image(pixels, channels=("R", "G", "B"), **rest):
    return Image(Path("a.exr"), np.asarray(pixels, np.float32), channels, **rest)


def beside(pixels, name, value):
    return image(np.dstack([pixels, np.full(pixels.shape[:2], value)]), ("R", "G", "B", name))


def metric(found, name):
    return next(each.value for each in found.metrics if each.name.startswith(name))


# Would black pass? -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["auto", "tolerance"])
@pytest.mark.parametrize("name, value", ALPHA_OR_DEPTH)
def test_a_dim_image_against_black_beside_alpha_or_depth(method, name, value, rng):
    dim = 0.0039 * rng.random(SHAPE)
    found = compare(method, beside(dim, name, value), beside(0 * dim, name, value))
    assert found.verdict is INCONCLUSIVE
    assert found.reason.startswith("an all-black image would pass, too, in R, G, B, with")
    same = beside(dim, name, value)
    assert compare(method, same, same).verdict is EQUAL


def test_paired_sees_nothing_where_all_is_far_below_the_median(rng):
    reference = rng.random(SHAPE) + 0.5
    reference[:24] *= 1e-5
    test = reference.copy()
    test[:24] = 0
    found = compare("paired", image(reference), image(test))
    assert found.verdict is INCONCLUSIVE
    assert "in 38% of the pixels that are not black" in found.reason


@pytest.mark.parametrize("lit, verdict", [(0.02, INCONCLUSIVE), (0.5, INCONCLUSIVE), (0.95, EQUAL)])
def test_a_bright_part_says_nothing_of_a_dim_one(lit, verdict, rng):
    """Black is seen in the bright part, so all black would be; the dim part could be anything."""
    reference = 0.0039 * rng.random((100, 64, 3))
    rows = int(lit * 100)
    reference[:rows] += 0.5
    test = reference.copy()
    test[rows:] = 0
    found = compare("tolerance", image(reference), image(test))
    assert found.verdict is verdict
    assert verdict is EQUAL or f"in {1 - lit:.0%} of the pixels that are not black" in found.reason


def test_a_dim_part_that_is_the_same_but_for_rounding_is_equal(rng):
    dim = 0.0039 * rng.random(SHAPE)
    dim[0] = 0.5
    assert compare("tolerance", image(dim), image(dim * (1 + 1e-6))).verdict is EQUAL


def test_light_between_the_rows_that_are_asked_first_counts(rng):
    """Black would pass in every sixteenth row."""
    reference = rng.random((64, 32, 3))
    reference[::16] = 0.001
    assert compare("tolerance", image(reference), image(reference + 1e-5)).verdict is EQUAL


def test_channels_are_grouped_by_what_they_are_part_of():
    channels = ("R", "G", "B", "A", "Z", "n.X", "n.Y", "n.Z", "s.R", "s.G", "s.B", "s.A")
    assert list(groups(channels).values()) == [
        ["R", "G", "B"],
        ["A"],
        ["Z"],
        ["n.X", "n.Y", "n.Z"],
        ["s.R", "s.G", "s.B"],
        ["s.A"],
    ]


# Renders and variances -------------------------------------------------------------------------------------------


def renders(rng, pixels, count=8, deviation=0.1):
    """Independent renders of an image, of a skewed distribution; `deviation` is relative."""
    noise = (rng.gamma(2.0, 1.0, (count, *pixels.shape)) - 2) / np.sqrt(2)
    return [image(pixels * (1 + each)) for each in deviation * noise]


def with_variance(rng, pixels, form, spp=16):
    """One image with a channel of variance, or of second moments, for each of its own."""
    samples = np.stack([each.pixels for each in renders(rng, pixels, spp)]).astype(np.float64)
    spread = np.square(samples).mean(0) if form.startswith("m2") else samples.var(0, ddof=1)
    channels = ("R", "G", "B", *(form.format(name) for name in "RGB"))
    return image(np.dstack([samples.mean(0), spread]), channels, metadata={"mi_refract:spp": spp})


def test_channels_without_variance_are_not_equal_unseen(rng):
    """`variance` for R only: G is black and B tripled."""
    pixels = rng.random(SHAPE) + 0.1

    def of(rng, gains):
        whole = with_variance(rng, pixels, "{}.variance")
        return replace(whole, pixels=whole.pixels[..., :4] * (*gains, 1), channels=("R", "G", "B", "R.variance"))

    one = of(rng, (1, 1, 1))
    two = of(rng, (1, 0, 3))
    found = compare("auto", one, two)
    assert (found.method, found.verdict) == ("welch", INCONCLUSIVE)
    assert found.reason.startswith("not tested, without variance: G, B")
    two.pixels[..., 1:3] = one.pixels[..., 1:3]
    assert compare("auto", one, two).verdict is EQUAL
    one.pixels[..., 1:3] *= 0.003  # dim, and black in the other: `tolerance` alone would pass that
    two.pixels[..., 1:3] = 0
    assert compare("auto", one, two).verdict is INCONCLUSIVE


def quarter(rng, size, gain=1.0, deviation=0.4):
    """Renders of a grey image of 16 × 16 tiles; the first `size`² pixels are noisy, and as bright as `gain`."""
    pixels = np.ones((128, 128, 1))
    noisy = renders(rng, pixels, 4, deviation)
    quiet = renders(rng, pixels, 4, 0.005)
    for one, other in zip(quiet, noisy, strict=True):
        one.pixels[:size, :size] = gain * other.pixels[:size, :size]
    return [replace(each, channels=("Y",)) for each in quiet]


def test_a_noisy_quarter_that_is_too_dark_is_not_equal(rng):
    """Its own noise hides 10 % in every tile, and the median tile would show 0.7 %."""
    options = {"tile": 8, "family_error": 1e-5}
    found = compare("welch", quarter(rng, 64, deviation=3.0), quarter(rng, 64, 0.9, deviation=3.0), **options)
    assert found.minimum_detectable < 0.01
    assert found.verdict is INCONCLUSIVE
    assert "0.05 in 0.25 of the tiles" in found.reason
    assert metric(found, "share of the tiles whose noise hides a difference of 0.05") == 0.25


def test_a_few_noisy_tiles_are_counted_and_allowed(rng):
    found = compare("welch", quarter(rng, 24, deviation=3.0), quarter(rng, 24, deviation=3.0), tile=8)
    assert found.verdict is EQUAL
    assert metric(found, "share of the tiles whose noise") == 9 / 256
    assert "hides one of 0.05 in 0.0352 of the tiles" in found.reason
    strict = compare("welch", quarter(rng, 24, deviation=3.0), quarter(rng, 24, deviation=3.0), tile=8, hidden=0.03)
    assert strict.verdict is INCONCLUSIVE


def stripes(axis):
    return np.where(np.indices(SHAPE)[axis] // 2 % 2, 0.8, 0.4)


def tiles_turned(pixels):
    turned = pixels.copy()
    for y in range(0, SHAPE[0], TILE):
        for x in range(0, SHAPE[1], TILE):
            turned[y : y + TILE, x : x + TILE] = pixels[y : y + TILE, x : x + TILE][::-1, ::-1]
    return turned


INSIDE = {
    "stripes inverted": (stripes(1), 1.2 - stripes(1)),
    "stripes turned": (stripes(0), stripes(1)),
    "tiles turned": (ramp := 0.3 + np.indices(SHAPE).sum(0) % 29 / 60, tiles_turned(ramp)),
}


@pytest.mark.parametrize("what", INSIDE)
@pytest.mark.parametrize("form", ["", "m2_{}", "{}.variance"])
def test_what_moves_within_the_tiles_is_seen_in_noise(what, form, rng):
    """The means of all tiles are the same."""
    one, two = INSIDE[what]
    assert np.allclose(*(x.reshape(4, TILE, 4, TILE, 3).mean((1, 3)) for x in (one, two)))
    drawn = (lambda x: with_variance(rng, x, form)) if form else (lambda x: renders(rng, x))
    found = compare("welch", drawn(one), drawn(two))
    assert found.verdict is DIFFERENT
    assert "of their pixels differ" in found.reason
    assert metric(found, "tests of tiles and channels that differ") == 0
    assert compare("welch", drawn(one), drawn(one)).verdict is EQUAL


def test_what_moves_within_one_tile_is_seen(rng):
    one = stripes(1)
    two = one.copy()
    two[16:32, 32:48, 1] = 1.2 - one[16:32, 32:48, 1]
    found = compare("welch", renders(rng, one), renders(rng, two))
    assert found.verdict is DIFFERENT
    assert np.abs(found.maps["t"]).max() < 5
    assert compare("welch", renders(rng, one), renders(rng, two), pixels="no").verdict is EQUAL


# Without noise -----------------------------------------------------------------------------------------------------


def with_alpha(rng, alpha):
    return [beside(each.pixels, "A", alpha) for each in renders(rng, np.ones(SHAPE))]


def test_a_noise_free_alpha_of_1_against_0_is_different(rng):
    found = compare("welch", with_alpha(rng, 1.0), with_alpha(rng, 0.0))
    assert found.verdict is DIFFERENT
    assert "16 of tiles without noise differ" in found.reason
    assert compare("welch", with_alpha(rng, 1.0), with_alpha(rng, 1.0)).verdict is EQUAL


@pytest.mark.parametrize("pixels, verdict", [(3, INCONCLUSIVE), (12, DIFFERENT)])
def test_a_few_pixels_without_noise_can_be_chance(pixels, verdict, rng):
    """7⁻³ is no alarm, 7⁻¹² = 7e-11 is one of 0.001 in some hundred tests."""
    one, two = with_alpha(rng, 1.0), with_alpha(rng, 1.0)
    for each in two:
        each.pixels[0, :pixels, 3] = 0
    assert compare("welch", one, two).verdict is verdict


@pytest.mark.parametrize("by, verdict", [(0.0005, EQUAL), (0.005, INCONCLUSIVE), (0.02, DIFFERENT)])
def test_a_tile_without_noise_is_different_where_it_is_far_beyond_the_margin(by, verdict, rng):
    assert compare("welch", with_alpha(rng, 1.0), with_alpha(rng, 1.0 + by)).verdict is verdict
