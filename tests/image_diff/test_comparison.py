"""Preconditions and methods: each sees a planted defect, and none calls images equal where it cannot know."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from mi_refract.image_diff import methods, tile_statistics
from mi_refract.image_diff.comparison import Verdict, preconditions
from mi_refract.image_diff.methods import METHODS
from mi_refract.io import image_file
from mi_refract.io.image_file import Image

SMOOTH = np.dstack([np.linspace(0.1, 0.9, 48 * 40).reshape(40, 48) ** k for k in (1, 2, 3)]).astype(np.float32)
SHAPE = (64, 64, 3)
EQUAL, DIFFERENT, INCONCLUSIVE = Verdict.EQUAL, Verdict.DIFFERENT, Verdict.INCONCLUSIVE
RNG = np.random.default_rng(7)


@pytest.fixture(autouse=True)
def seed(monkeypatch):
    """Every test draws the same numbers, alone or among others."""
    monkeypatch.setitem(globals(), "RNG", np.random.default_rng(7))


def image(pixels, channels=("R", "G", "B"), **rest):
    return Image(Path("a.exr"), np.asarray(pixels, np.float32), channels, **rest)


def renders(count, gain=1.0, deviation=0.3, shape=SHAPE, mean=1.0):
    """Independent noisy renders with a skewed distribution, as light has."""
    noise = (RNG.gamma(2.0, 1.0, (count, *shape)) - 2) / np.sqrt(2)
    return [image(gain * (mean + deviation * each)) for each in noise]


def judge(method, reference, test, **options):
    if method == "welch" and isinstance(reference, Image):
        reference, test = [reference] * 2, [test] * 2
    return methods.compare(method, reference, test, **options)


def altered(value, y=3, x=5, c=1):
    pixels = SMOOTH.copy()
    pixels[y, x, c] = value
    return image(pixels)


# Preconditions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_equals_nothing_not_even_itself(method, bad):
    broken, whole = altered(bad), image(SMOOTH)
    for reference, test in ((whole, broken), (broken, whole), (broken, broken)):
        found = judge(method, reference, test)
        assert found.verdict is DIFFERENT
        assert ("1 NaN" if np.isnan(bad) else "1 Inf") in found.reason
        assert "x = 5, y = 3, channel G" in found.reason
        assert found.maps["nonfinite"].sum() == 1


def test_what_is_not_finite_is_marked_in_the_channels_of_the_first_render():
    turned = image(SMOOTH[..., ::-1], ("B", "G", "R"))
    broken = image(altered(np.nan, c=0).pixels[..., ::-1], ("B", "G", "R"))
    whole, first = image(SMOOTH), altered(np.nan, c=0)
    for reference, test in (
        ([whole, turned], [turned, broken]),
        ([whole, broken], [turned] * 2),
        ([first, whole], [whole] * 2),
    ):
        found = methods.compare("welch", reference, test)
        assert found.reason == "a.exr: 1 NaN, the first at x = 5, y = 3, channel R"
        assert np.argwhere(found.maps["nonfinite"]).tolist() == [[3, 5, 0]]


@pytest.mark.parametrize("method", METHODS)
def test_allowed_values_must_be_the_same_ones(method):
    assert judge(method, altered(np.nan), altered(np.nan), allow_nonfinite=True).verdict is EQUAL
    for other in (np.inf, 0.5):
        assert judge(method, altered(np.nan), altered(other), allow_nonfinite=True).verdict is DIFFERENT
    assert judge(method, altered(np.inf), altered(-np.inf), allow_nonfinite=True).verdict is DIFFERENT


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "other, what",
    [
        (image(SMOOTH[:20]), "size"),
        (image(SMOOTH[..., :2], ("R", "A")), "channels"),
        (image(SMOOTH, ("R", "G", "Z")), "channels"),
        (image(SMOOTH, origin=(0, 1)), "data window"),
        (image(SMOOTH, display=(0, 0, 48, 41)), "display window"),
        (image(SMOOTH, display=(-1, 0, 48, 40)), "display window"),
        (image(SMOOTH, metadata={"PixelAspectRatio": 2.0}), "pixel aspect ratio"),
        (image(SMOOTH, metadata={"Orientation": 3}), "orientation"),
    ],
    ids=["size", "count", "name", "window", "display", "place", "aspect", "orientation"],
)
def test_what_cannot_be_compared_is_an_error(method, other, what):
    for pair in ((image(SMOOTH), other), (other, image(SMOOTH))):
        with pytest.raises(ValueError, match=f"{what} .*; expected ") as error:
            judge(method, *pair)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("method", METHODS)
def test_channels_are_matched_by_name(method):
    assert judge(method, image(SMOOTH), image(SMOOTH[..., ::-1], ("B", "G", "R"))).verdict is EQUAL
    if method != "welch":
        assert judge(method, image(SMOOTH), image(SMOOTH[..., ::-1])).verdict is DIFFERENT


def test_headers_that_say_the_same_in_other_words_are_equal():
    said = {"PixelAspectRatio": 1.0, "Orientation": 1}
    assert preconditions(image(SMOOTH), image(SMOOTH, display=(0, 0, 48, 40), metadata=said)) is None
    moved = [image(SMOOTH, origin=(3, 4), display=display) for display in (None, (3, 4, 48, 40))]
    assert preconditions(*moved) is None


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.tif"])
def test_the_header_of_a_file_is_asked(tmp_path, name):
    """Exit code 2 of `diff`, not 0, where the same pixels are shown in another place, or in another shape."""
    for number, attributes in enumerate(({}, {}, {"PixelAspectRatio": 2.0}, {"full_width": 99})):
        spec = oiio.ImageSpec(48, 40, 3, "uint8" if name == "a.png" else "float")
        for key, value in attributes.items():
            setattr(spec, key, value) if key == "full_width" else spec.attribute(key, value)
        path = tmp_path / str(number) / name
        path.parent.mkdir()
        output = oiio.ImageOutput.create(str(path))
        assert output.open(str(path), spec) and output.write_image(SMOOTH) and output.close()
    one, same, aspect, display = (image_file.read(tmp_path / str(i) / name) for i in range(4))
    assert preconditions(one, same) is None
    with pytest.raises(ValueError, match=r"pixel aspect ratio 2\.0; expected 1\.0"):
        preconditions(one, aspect)
    if name != "a.png":  # which holds none
        with pytest.raises(ValueError, match="display window 99 × 40 from x = 0, y = 0; expected 48 × 40"):
            preconditions(one, display)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_channel_without_a_value_is_not_compared(method, bad):
    """Allowed or not: a channel of NaN on both sides says nothing."""
    every, green = np.full_like(SMOOTH, bad), SMOOTH.copy()
    green[..., 1] = bad
    for pixels, names in ((every, "R, G, B"), (green, "G")):
        found = judge(method, image(pixels), image(pixels), allow_nonfinite=True)
        assert found.verdict is INCONCLUSIVE
        assert found.reason.startswith(f"no value is finite, and nothing was compared, in {names}; ")
    few = judge(method, altered(bad), altered(bad), allow_nonfinite=True)
    assert (few.verdict, few.reason.endswith("; not compared: 1 of 5760 values, not finite")) == (EQUAL, True)
    green[0, 0, 1] = 0.5
    assert judge(method, image(green), image(green), allow_nonfinite=True).verdict is EQUAL
    other = image(green + np.float32(0.1) * (np.arange(3) == 2))
    if method != "welch":
        assert judge(method, image(green), other, allow_nonfinite=True).verdict is DIFFERENT


def test_preconditions_pass_what_is_whole():
    assert preconditions(image(SMOOTH), image(0 * SMOOTH)) is None


# Images ------------------------------------------------------------------------------------------------------


def test_exact_sees_the_last_bit():
    same = judge("exact", image(SMOOTH), image(SMOOTH))
    assert (same.verdict, same.reason) == (EQUAL, "every value is the same")
    found = judge("exact", image(SMOOTH), altered(np.nextafter(SMOOTH[3, 5, 1], np.float32(1))))
    assert (found.verdict, found.metrics[0].value) == (DIFFERENT, 1)
    assert found.reason.startswith("1 of ")
    assert np.count_nonzero(found.maps["difference"]) == 1


@pytest.mark.parametrize(
    "by, options, verdict",
    [
        (0.01, {}, EQUAL),
        (0.01, {"fail": 0.02}, EQUAL),
        (0.01, {"fail": 0.005}, DIFFERENT),
        (0.01, {"fail": 0.005, "fail_relative": 0.5}, EQUAL),
        (0.01, {"fail": 0.005, "fail_relative": 0.001}, DIFFERENT),
        (0.01, {"fail": 0.005, "fail_percent": 0.051}, DIFFERENT),
        (0.01, {"fail": 0.005, "fail_percent": 0.053}, EQUAL),
        (0.01, {"fail": 0.005, "fail_percent": 0.053, "hard_fail": 0.005}, DIFFERENT),
        (0.01, {"fail": 0.02, "hard_fail": 0.005}, EQUAL),  # not asked where no pixel fails
        (0.01, {"fail": 0.005, "hard_fail": 0.005, "allow_failures": 1}, EQUAL),
        (0.01, {"fail": 0.005, "allow_failures": 0}, DIFFERENT),
    ],
)
def test_tolerance_means_what_idiff_means(by, options, verdict):
    """One pixel of 1920 is 0.052 %."""
    options = {"fail": 0.02, "fail_relative": 0.0, "fail_percent": 0.0} | options
    assert judge("tolerance", image(SMOOTH), altered(SMOOTH[3, 5, 1] + by), **options).verdict is verdict


@pytest.mark.parametrize("by, pixels, verdict", [(0.0039, 9, EQUAL), (0.0041, 1, EQUAL), (0.0041, 2, DIFFERENT)])
def test_tolerance_allows_a_change_of_0_004_and_more_in_0_02_percent_of_the_pixels(by, pixels, verdict):
    """Of 6000 pixels 1 is 0.017 %, 2 are 0.033 %."""
    reference = np.full((60, 100, 3), 0.5)
    test = reference.copy()
    test[0, :pixels, 1] += by
    assert judge("tolerance", image(reference), image(test)).verdict is verdict


def test_paired_sees_many_small_changes_at_any_brightness():
    for scale in (1e-6, 1.0, 1e6):
        reference = image(scale * SMOOTH)
        assert judge("paired", reference, image(scale * SMOOTH * (1 + 1e-6))).verdict is EQUAL
        found = judge("paired", reference, image(scale * SMOOTH * 1.001))
        assert found.verdict is DIFFERENT
        assert 0.3 < found.metrics[0].value <= 1
    few = altered(0.9)
    assert judge("paired", image(SMOOTH), few).verdict is EQUAL
    assert judge("paired", image(SMOOTH), few, largest=0.5).verdict is DIFFERENT


@pytest.mark.parametrize("method", ["paired", "welch"])
def test_a_channel_of_another_scale_hides_nothing(method):
    reference, test = renders(8, deviation=0.1, shape=(64, 64, 1)), renders(8, deviation=0.1, shape=(64, 64, 1))
    if method == "paired":
        reference, test = reference[:1], [image(reference[0].pixels * 1.001, ("Y",))]
    for each in test:
        each.pixels[:] *= 1.3 if method == "welch" else 1
    depth = np.full((64, 64, 1), 1e6)
    two = [[image(np.dstack([each.pixels, depth]), ("Y", "Z")) for each in side] for side in (reference, test)]
    assert methods.compare(method, *two).verdict is DIFFERENT
    assert methods.compare(method, two[0], two[0]).verdict is EQUAL


# Samples -------------------------------------------------------------------------------------------------------


def test_equal_renders_are_called_different_no_more_often_than_stated():
    """300 null pairs at a family error of 5 %: 15 expected; more than 34 has probability below 1e-5."""
    pairs = (
        judge(
            "welch",
            renders(4, shape=(32, 32, 3)),
            renders(4, shape=(32, 32, 3)),
            tile=8,
            family_error=0.05,
            equivalence_margin=0.0,
        )
        for _ in range(300)
    )
    assert sum(found.verdict is DIFFERENT for found in pairs) <= 34


def test_pixels_that_a_filter_correlates_make_no_false_alarms():
    """40 null pairs at 5 %: more than 10 has probability below 1e-5. Without the correction nearly all alarm."""

    def filtered(count):
        found = (each.pixels for each in renders(count, shape=(64, 64, 1)))
        return [image(sum(np.roll(x, (i, j), (0, 1)) for i in range(3) for j in range(3)), ("Y",)) for x in found]

    pairs = [
        judge("welch", filtered(8), filtered(8), tile=8, family_error=0.05, equivalence_margin=0.0) for _ in range(40)
    ]
    assert sum(found.verdict is DIFFERENT for found in pairs) <= 10


@pytest.mark.parametrize("correction", ["sidak", "holm"])
def test_a_tile_off_by_more_than_the_detectable_difference_is_seen(correction):
    reference, test = renders(8, deviation=0.1), renders(8, deviation=0.1)
    found = judge("welch", reference, test, correction=correction)
    assert found.verdict is EQUAL
    assert 0 < found.minimum_detectable < 0.05
    for pixels in (each.pixels for each in test):
        pixels[16:32, 32:48, 2] *= 1 + 1.5 * found.minimum_detectable
    seen = judge("welch", reference, test, correction=correction)
    assert seen.verdict is DIFFERENT
    strongest = np.unravel_index(np.abs(seen.maps["t"]).argmax(), SHAPE)
    assert (strongest[0] // 16, strongest[1] // 16, strongest[2]) == (1, 2, 2)
    assert seen.maps["q"][20, 40] < 0.01 < seen.maps["q"][0, 0]


def test_a_gain_too_small_for_a_tile_is_seen_in_the_whole_image():
    found = judge("welch", renders(8), renders(8, gain=1.02), tile=4)
    assert found.minimum_detectable > 0.1
    assert np.abs(found.maps["t"]).max() < 5
    assert found.verdict is DIFFERENT


def test_noise_that_hides_too_much_is_inconclusive_and_a_margin_hides_on_purpose():
    found = judge("welch", renders(2, deviation=2.0), renders(2, deviation=2.0))
    assert found.verdict is INCONCLUSIVE
    assert found.minimum_detectable > 0.05
    assert judge("welch", renders(8), renders(8, gain=1.02), equivalence_margin=0.05).verdict is not DIFFERENT


def test_tiles_without_noise_are_never_certain():
    reference, test = renders(8, deviation=0.1), renders(8, deviation=0.1)
    for each in (*reference, *test):
        each.pixels[:16, :16] = 0.5
    assert judge("welch", reference, test).verdict is EQUAL
    for each in test:
        each.pixels[:16, :16] = 0.6
    found = judge("welch", reference, test)
    flagged = found.maps["flags"][:16, :16]
    assert (flagged == 2).all()
    assert {metric.name: metric.value for metric in found.metrics}["tiles without noise that differ"] == 3


@pytest.mark.parametrize("value, verdict", [(1.0005, EQUAL), (1.005, INCONCLUSIVE), (1.1, DIFFERENT)])
def test_an_image_without_noise_is_not_called_equal_when_it_differs(value, verdict):
    flat = [image(np.ones(SHAPE))] * 3
    assert judge("welch", flat, [image(np.full(SHAPE, value))] * 3).verdict is verdict


def test_a_tile_with_the_noise_of_one_pixel_is_flagged():
    reference, test = renders(8, deviation=0.0), renders(8, deviation=0.0)
    for each in (*reference, *test):
        each.pixels[5, 5] = RNG.random(3)
    found = judge("welch", reference, test)
    assert (found.maps["flags"][:16, :16] == 1).all()
    for each in test:
        each.pixels[5, 5] += 100
    assert judge("welch", reference, test).verdict is INCONCLUSIVE


def test_the_same_seed_twice_is_an_error():
    side = renders(3)
    with pytest.raises(ValueError, match="expected independent renders"):
        judge("welch", [*side, replace(side[0], path=Path("b.exr"))], renders(4))


def test_corrections_are_those_of_the_papers():
    """Holm on an example worked by hand: 0.05/4, /3, /2, /1."""
    assert tile_statistics.holm(np.array([0.03, 0.01, 0.016, 0.9]), 0.05) == 0.016
    assert tile_statistics.holm(np.array([0.013, 0.02, 0.9, 0.04]), 0.05) == 0.0125
    assert tile_statistics.sidak(0.05, 2) == pytest.approx(1 - np.sqrt(0.95))


@pytest.mark.parametrize(("correction", "threshold"), [("holm", 0.016), ("sidak", 1 - 0.95**0.25)])
def test_the_correction_is_the_one_that_is_asked_for(correction, threshold):
    tests = tile_statistics.TileTests([], 0.05, correction)
    vars(tests)["p"] = np.array([0.03, 0.01, 0.016, 0.9])
    assert tests.threshold == pytest.approx(threshold)


def with_spread(count, kind, gain=1.0):
    """One image of `count` samples a pixel, with channels of their second moments or variance, and of nothing."""
    samples = gain * np.stack([each.pixels for each in renders(count, shape=(64, 64, 1))]).astype(np.float64)
    spread = np.square(samples).mean(0) if kind == "m2_Y" else samples.var(0, ddof=1)
    return image(np.dstack([samples.mean(0), spread, np.ones_like(spread)]), ("Y", kind, "Z"))


@pytest.mark.parametrize("kind", ["m2_Y", "Y.variance"])
def test_variance_channels_take_the_place_of_several_renders(kind):
    one, two, off = with_spread(16, kind), with_spread(16, kind), with_spread(16, kind, gain=1.1)
    found = methods.compare("auto", one, two, spp=16)
    assert (found.method, found.verdict) == ("welch", EQUAL)
    noisy = replace(two, pixels=two.pixels[..., [0, 1, 0]])
    assert methods.compare("auto", one, noisy, spp=16).verdict is INCONCLUSIVE
    assert methods.compare("welch", one, off, spp=16).verdict is DIFFERENT
    with pytest.raises(ValueError, match="spp"):
        methods.compare("welch", one, two)
    told = [replace(each, metadata={"mi_refract:spp": 16}) for each in (one, two)]
    assert methods.compare("welch", *told).minimum_detectable == pytest.approx(found.minimum_detectable)


def test_a_variance_from_n_samples_has_n_less_one_degrees_of_freedom():
    """In one pixel, where both sides have the same variance, Welch's test has 2 (n − 1) of them."""
    from scipy import stats

    one, two = (image([[[mean, 0.08]]], ("Y", "Y.variance")) for mean in (1.0, 1.5))
    for count in (2, 5):
        t = 0.5 / np.sqrt(2 * 0.08 / count)
        found = methods.compare("welch", one, two, spp=count).maps["p"]
        assert found.item() == pytest.approx(2 * stats.t.sf(t, 2 * (count - 1)), rel=1e-5)


def test_the_minimum_detectable_difference_is_missed_with_the_probability_stated():
    """Where the noise is known, the test statistic is normal."""
    from scipy import stats

    one = np.ones((1, 1, 1))
    none = one < 0
    level = tile_statistics.Level(0 * one, one, one, none, none, none, 2 * one, 0 * one, 0.1 * one, 1e9 * one)
    found = level.detectable(threshold := 1e-4).item()
    assert stats.norm.sf(stats.norm.isf(threshold / 2) - 2 * found / 0.1) == pytest.approx(0.99)


# The table -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_a_method_runs_once(method, monkeypatch):
    calls = []
    real = METHODS[method]

    def counted(*sides, **options):
        calls.append(sides)
        return real.function(*sides, **options)

    monkeypatch.setitem(METHODS, method, replace(real, function=functools.wraps(real.function)(counted)))
    assert judge(method, image(SMOOTH), image(SMOOTH * (1 + 1e-7))).verdict in (EQUAL, DIFFERENT)
    assert len(calls) == 1


@pytest.mark.parametrize(
    "method, options, match",
    [
        ("psnr", {}, "expected auto, exact"),
        ("exact", {"fail": 1.0}, "has no option 'fail'"),
        ("tolerance", {"fail": "1"}, "type float"),
        ("tolerance", {"fail": float("nan")}, "at least 0"),
        ("paired", {"threshold": -1}, "at least 0"),
        ("flip", {"hdr": "perhaps"}, "auto, yes, no"),
        ("welch", {"tile": 0}, "positive"),
        ("welch", {"tile": True}, "type int"),
        ("welch", {"family_error": 1.0}, "less than 1"),
        ("welch", {"correction": "none"}, "sidak, holm"),
        ("welch", {"equivalence_margin": float("nan")}, "at least 0"),
        ("welch", {"hidden": float("nan")}, "0 to 1"),
        ("welch", {"pixels": "perhaps"}, "yes, no"),
    ],
)
def test_options_that_do_not_fit(method, options, match):
    with pytest.raises(ValueError, match=match):
        judge(method, image(SMOOTH), image(SMOOTH), **options)


def test_the_number_of_images_must_fit_the_method():
    one, two = image(SMOOTH), [image(SMOOTH)] * 2
    assert methods.automatic(one, one) == "tolerance"
    assert methods.automatic(two, two) == "welch"
    for sides in ((one, one), (two, one), (one, two)):
        with pytest.raises(ValueError, match="at least 2 a side"):
            methods.compare("welch", *sides)
    with pytest.raises(ValueError, match="one a side"):
        methods.compare("exact", two, two)
    with pytest.raises(ValueError, match="no image"):
        methods.compare("exact", [], one)


def test_every_option_says_what_it_means():
    for method in METHODS.values():
        assert method.summary.endswith((".", ":", "`."))
        assert all(option.help for option in method.options.values())
