"""What every method has in common; `exact` and `paired`; no image is equal where a method could not have known."""

from __future__ import annotations

import itertools

import numpy as np
import OpenImageIO as oiio
import pytest
from support.diff_images import of

from mi_refract.image_diff.comparison import Verdict, preconditions
from mi_refract.image_diff.methods import METHODS, choice, compare, groups
from mi_refract.image_diff.pixelwise import changes
from mi_refract.io import image_file
from mi_refract.io.image_file import Image

SMOOTH = np.dstack([np.linspace(0.1, 0.9, 48 * 40).reshape(40, 48) ** k for k in (1, 2, 3)]).astype(np.float32)
EQUAL, DIFFERENT, INCONCLUSIVE = Verdict.EQUAL, Verdict.DIFFERENT, Verdict.INCONCLUSIVE
SINGLE = [name for name, method in METHODS.items() if not method.takes_renders]


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def judge(method, reference, test, **options):
    if method == "welch":
        reference, test = [reference] * 2, [test] * 2
    return compare(method, reference, test, **options)


def altered(value, pixels=SMOOTH, at=(3, 5, 1)):
    pixels = pixels.copy()
    pixels[at] = value
    return of(pixels)


# Preconditions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_equals_nothing_not_even_itself(method, bad):
    broken, whole = altered(bad), of(SMOOTH)
    for reference, test in ((whole, broken), (broken, whole), (broken, broken)):
        found = judge(method, reference, test)
        assert found.verdict is DIFFERENT
        assert ("1 NaN" if np.isnan(bad) else "1 Inf") in found.reason
        assert "x = 5, y = 3, channel G" in found.reason
        assert found.maps["nonfinite"].sum() == 1


def test_what_is_not_finite_is_marked_in_the_channels_of_the_first_render():
    whole, first = of(SMOOTH), altered(np.nan, at=(3, 5, 0))
    turned, broken = (of(x.pixels[..., ::-1], ("B", "G", "R")) for x in (whole, first))
    for sides in (([whole, turned], [turned, broken]), ([whole, broken], [turned] * 2), ([first, whole], [whole] * 2)):
        found = compare("welch", *sides)
        assert found.reason == "a.exr: 1 NaN, the first at x = 5, y = 3, channel R"
        assert np.argwhere(found.maps["nonfinite"]).tolist() == [[3, 5, 0]]


@pytest.mark.parametrize("method", METHODS)
def test_allowed_values_must_be_the_same_ones(method):
    values = (np.nan, np.inf, -np.inf, 0.5)
    for one, two in itertools.product(values[:3], values):
        verdict = EQUAL if one is two else DIFFERENT
        assert judge(method, altered(one), altered(two), allow_nonfinite=True).verdict is verdict


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_channel_without_a_value_is_not_compared(method, bad):
    """Allowed or not: a channel of NaN on both sides says nothing."""
    every, green = np.full_like(SMOOTH, bad), SMOOTH.copy()
    green[..., 1] = bad
    for pixels, names in ((every, "R, G, B"), (green, "G")):
        found = judge(method, of(pixels), of(pixels), allow_nonfinite=True)
        assert found.verdict is INCONCLUSIVE
        assert found.reason.startswith(f"no value is finite, and nothing was compared, in {names}; ")
    few = judge(method, altered(bad), altered(bad), allow_nonfinite=True)
    assert (few.verdict, few.reason.endswith("; not compared: 1 of 5760 values, not finite")) == (EQUAL, True)
    green[0, 0, 1] = 0.5
    assert judge(method, of(green), of(green), allow_nonfinite=True).verdict is EQUAL
    other = of(green + np.float32(0.1) * (np.arange(3) == 2))
    assert method == "welch" or judge(method, of(green), other, allow_nonfinite=True).verdict is DIFFERENT


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "other, what",
    [
        (of(SMOOTH[:20]), "size"),
        (of(SMOOTH[..., :2], ("R", "A")), "channels"),
        (of(SMOOTH, ("R", "G", "Z")), "channels"),
        (of(SMOOTH, origin=(0, 1)), "data window"),
        (of(SMOOTH, display=(0, 0, 48, 41)), "display window"),
        (of(SMOOTH, display=(-1, 0, 48, 40)), "display window"),
        (of(SMOOTH, metadata={"PixelAspectRatio": 2.0}), "pixel aspect ratio"),
        (of(SMOOTH, metadata={"Orientation": 3}), "orientation"),
    ],
)
def test_what_cannot_be_compared_is_an_error(method, other, what):
    for pair in ((of(SMOOTH), other), (other, of(SMOOTH))):
        with pytest.raises(ValueError, match=f"{what} .*; expected ") as error:
            judge(method, *pair)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("method", METHODS)
def test_channels_are_matched_by_name(method):
    assert judge(method, of(SMOOTH), of(SMOOTH[..., ::-1], ("B", "G", "R"))).verdict is EQUAL
    assert method == "welch" or judge(method, of(SMOOTH), of(SMOOTH[..., ::-1])).verdict is DIFFERENT


def test_headers_that_say_the_same_in_other_words_are_equal():
    said = {"PixelAspectRatio": 1.0, "Orientation": 1}
    assert not preconditions(of(SMOOTH), of(SMOOTH, display=(0, 0, 48, 40), metadata=said))
    moved = [of(SMOOTH, origin=(3, 4), display=display) for display in (None, (3, 4, 48, 40))]
    assert not preconditions(*moved)
    assert not preconditions(of(SMOOTH), of(0 * SMOOTH))


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.tif"])
def test_the_header_of_a_file_counts(tmp_path, name):
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
    assert not preconditions(one, same)
    with pytest.raises(ValueError, match=r"pixel aspect ratio 2\.0; expected 1\.0"):
        preconditions(one, aspect)
    if name != "a.png":  # which holds none
        with pytest.raises(ValueError, match="display window 99 × 40 from x = 0, y = 0; expected 48 × 40"):
            preconditions(one, display)


# Channels that one image has besides -----------------------------------------------------------------------------

RAMP = np.arange(40 * 48.0).reshape(40, 48)


@pytest.mark.parametrize("method", ["auto", *SINGLE])
@pytest.mark.parametrize(
    "name, values, words",
    [
        ("A", 1, "A (opaque: 1 everywhere)"),
        ("Z", RAMP, "Z"),
        ("Z", 0, "Z (0 everywhere)"),
        ("l.A", 0.5, "l.A (0.5 everywhere)"),
    ],
)
def test_a_channel_that_one_image_has_besides_is_a_difference_with_a_name(method, name, values, words):
    plain, more = of(SMOOTH), of(np.dstack([SMOOTH, np.broadcast_to(values, (40, 48))]), (*"RGB", name))
    for sides, word in (((plain, more), "added"), ((more, plain), "missing")):
        found = compare(method, *sides)
        assert found.verdict is DIFFERENT
        assert found.reason.startswith(f"channels {word}: {words}; the other channels: ")
    assert "the other channels: 1 of 1920 pixels" in compare("exact", more, altered(0.9)).reason


# Methods of pixels -------------------------------------------------------------------------------------------------


def test_exact_sees_the_last_bit():
    same = judge("exact", of(SMOOTH), of(SMOOTH))
    assert (same.verdict, same.reason) == (EQUAL, "every value is the same")
    found = judge("exact", of(SMOOTH), altered(np.nextafter(SMOOTH[3, 5, 1], np.float32(1))))
    assert (found.verdict, found.metrics[0].value) == (DIFFERENT, 1)
    assert found.reason.startswith("1 of ")
    assert np.count_nonzero(found.maps["difference"]) == 1


def test_paired_sees_many_small_changes_at_any_brightness():
    for scale in (1e-6, 1.0, 1e6):
        reference = of(scale * SMOOTH)
        assert judge("paired", reference, of(scale * SMOOTH * (1 + 1e-6))).verdict is EQUAL
        found = judge("paired", reference, of(scale * SMOOTH * 1.001))
        assert found.verdict is DIFFERENT
        assert 0.3 < found.metrics[0].value <= 1
    few = altered(0.9)
    assert judge("paired", of(SMOOTH), few).verdict is EQUAL
    assert judge("paired", of(SMOOTH), few, largest=0.5).verdict is DIFFERENT


def test_a_channel_of_another_scale_hides_nothing_of_paired(rng):
    pixels, depth = rng.random((64, 64, 1)) + 0.5, np.full((64, 64, 1), 1e6)
    one, two = (of(np.dstack([x, depth]), ("Y", "Z")) for x in (pixels, 1.001 * pixels))
    assert compare("paired", one, two).verdict is DIFFERENT
    assert compare("paired", one, one).verdict is EQUAL


def test_changes_are_of_pixels_not_of_channels():
    reference = np.ones((32, 32, 3))
    test = reference.copy()
    test[0, 0] += 1e-3
    test[1, 1, 2] += 2e-6
    found = changes(reference, test, 1e-5)
    assert (found.share, found.largest) == (1 / 1024, pytest.approx(1e-3))
    assert found.mean_ratio == pytest.approx(1 + (3e-3 + 2e-6) / reference.size)
    for bad in (np.nan, np.inf):  # equals nothing, not even itself
        test[3, 4, 0] = bad
        found = changes(test, test, 1e-5)
        assert (found.share, found.largest, found.rms) == (1 / 1024, np.inf, np.inf)
    with pytest.raises(ValueError, match="different shapes"):
        changes(reference, reference[:, :2], 1e-5)


@pytest.mark.parametrize(("one", "two", "ratio"), [(2, 3, 1.5), (4, 1, 0.25), (0, 3, 4), (0, 0, 1), (-2, 1, -0.5)])
def test_the_ratio_of_the_means(one, two, ratio):
    """Against black, where there is no ratio, it is 1 and as much as is added."""
    found = changes(*(np.full((4, 4, 3), float(x)) for x in (one, two)), 1e-5)
    assert found.mean_ratio == pytest.approx(ratio)
    assert found.rms == found.largest == abs(one - two)


@pytest.mark.parametrize("method", ["tolerance", "paired", "flip"])
@pytest.mark.parametrize("brightness", [1e3, 1e5, 1e7, 1e9])
def test_one_firefly_in_both_hides_nothing_of_the_rest(method, brightness, rng):
    pixels = rng.uniform(0.1, 0.9, (48, 40, 3))
    reference, *others = (altered(brightness, x, (7, 5)) for x in (pixels, 0 * pixels, 1 - pixels))
    assert [compare(method, reference, x).verdict for x in others] == [DIFFERENT] * 2
    assert compare(method, reference, reference).verdict is EQUAL


@pytest.mark.parametrize("method", ["exact", "tolerance", "paired"])
@pytest.mark.parametrize("a, b", [(3e38, 2e38), (3e38, -3e38), (1e-40, 5e-40), (0, 1e-9), (0, 5e-5)])
def test_the_ends_of_float32_and_a_change_against_black(method, a, b):
    options = {"fail": 0.0} if method == "tolerance" else {}
    sides = (of(np.full((16, 16, 3), x)) for x in (a, b))
    assert compare(method, *sides, **options).verdict is DIFFERENT


def test_what_float32_does_not_hold_is_compared_or_refused():
    for a, b in ((1 + 1e-12, 1.0), (1e39, 2e39), (1e39, 0.0), (1e9 + 1, 1e9)):
        one, two = (Image(of(SMOOTH).path, np.full((16, 16, 3), x), ("R", "G", "B")) for x in (a, b))
        found = compare("tolerance", one, two, fail=0.0, fail_relative=0.0)
        assert (found.verdict, found.metrics[1].value) == (DIFFERENT, abs(a - b))
    with pytest.raises(ValueError, match=r"exceed the range of float32"):
        compare("flip", Image(one.path, one.pixels * 1e30, one.channels), two)


# Would black pass? -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "method, options", [("tolerance", {}), ("paired", {"threshold": 2.0}), ("flip", {"local": 9.0, "patch": 1.0})]
)
def test_a_method_that_black_would_pass_knows_nothing(method, options):
    dark = 0.004 * SMOOTH
    found = compare(method, of(dark), of(0.9 * dark), **options)
    assert found.verdict is INCONCLUSIVE
    assert found.reason.startswith("an all-black image would pass, too")
    for same in (of(dark), of(0 * dark)):
        assert compare(method, same, same, **options).verdict is EQUAL


@pytest.mark.parametrize("method", ["tolerance", "paired", "flip"])
def test_one_bright_pixel_is_all_there_is(method):
    black = np.zeros((128, 128, 3))
    assert compare(method, altered(10.0, black, (7, 5)), of(black)).verdict is not EQUAL


@pytest.mark.parametrize("method", ["auto", "tolerance"])
@pytest.mark.parametrize("name, value", [("A", 1.0), ("Z", 30.0), ("layer.A", 1.0), ("depth.Z", 30.0)])
def test_a_dim_image_against_black_beside_alpha_or_depth(method, name, value, rng):
    dim, other = 0.0039 * rng.random((64, 64, 3)), np.full((64, 64, 1), value)
    same, black = (of(np.dstack([x, other]), (*"RGB", name)) for x in (dim, 0 * dim))
    found = compare(method, same, black)
    assert found.verdict is INCONCLUSIVE
    assert found.reason.startswith("an all-black image would pass, too, in R, G, B, with")
    assert compare(method, same, same).verdict is EQUAL


@pytest.mark.parametrize("lit, verdict", [(0.02, INCONCLUSIVE), (0.5, INCONCLUSIVE), (0.95, EQUAL)])
def test_a_bright_part_says_nothing_of_a_dim_one(lit, verdict, rng):
    """Black is seen in the bright part, so all black would be; the dim part could be anything."""
    reference = 0.0039 * rng.random((100, 64, 3))
    rows = int(lit * 100)
    reference[:rows] += 0.5
    test = reference.copy()
    test[rows:] = 0
    found = compare("tolerance", of(reference), of(test))
    assert found.verdict is verdict
    assert verdict is EQUAL or f"in {1 - lit:.0%} of the pixels that are not black" in found.reason
    assert compare("tolerance", of(reference), of(reference * (1 + 1e-6))).verdict is EQUAL  # the same but for rounding


def test_paired_sees_nothing_where_all_is_far_below_the_median(rng):
    reference = rng.random((64, 64, 3)) + 0.5
    reference[:24] *= 1e-5
    test = reference.copy()
    test[:24] = 0
    found = compare("paired", of(reference), of(test))
    assert found.verdict is INCONCLUSIVE
    assert "in 38% of the pixels that are not black" in found.reason


def test_light_between_the_rows_that_are_looked_at_first_counts(rng):
    """Black would pass in every sixteenth row."""
    reference = rng.random((64, 32, 3))
    reference[::16] = 0.001
    assert compare("tolerance", of(reference), of(reference + 1e-5)).verdict is EQUAL


def test_channels_are_grouped_by_what_they_are_part_of():
    names = ("R", "G", "B", "A", "Z", "n.X", "n.Y", "n.Z", "s.R", "s.G", "s.B", "s.A")
    expected = [["R", "G", "B"], ["A"], ["Z"], ["n.X", "n.Y", "n.Z"], ["s.R", "s.G", "s.B"], ["s.A"]]
    assert list(groups(names).values()) == expected


# The table -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "method, options, match",
    [
        ("psnr", {}, "expected auto, exact"),
        ("exact", {"fail": 1.0}, "has no option 'fail'"),
        ("tolerance", {"fail": "1"}, "type float"),
        ("tolerance", {"fail": float("nan")}, "at least 0"),
        ("tolerance", {"allow_failures": -1}, "at least 0"),
        ("tolerance", {"fail_percent": -1.0}, "at least 0"),
        ("paired", {"threshold": -1}, "at least 0"),
        ("flip", {"hdr": "perhaps"}, "auto, yes, no"),
        ("flip", {"ppd": 0.0}, "expected 1 to 1000"),
        ("flip", {"ppd": np.inf}, "expected 1 to 1000"),
        ("welch", {"tile": 0}, "positive"),
        ("welch", {"tile": True}, "type int"),
        ("welch", {"family_error": 1.0}, "less than 1"),
        ("welch", {"equivalence_margin": float("nan")}, "at least 0"),
        ("welch", {"resolution": 0.0}, "more than 0"),
        ("welch", {"hidden": float("nan")}, "0 to 1"),
        ("welch", {"pixels": "perhaps"}, "yes, no"),
    ],
)
def test_options_that_do_not_fit(method, options, match):
    with pytest.raises(ValueError, match=match):
        judge(method, of(SMOOTH), of(SMOOTH), **options)


def test_the_number_of_images_must_fit_the_method():
    one, two = of(SMOOTH), [of(SMOOTH)] * 2
    assert [choice(*sides)[0] for sides in (([one], [one]), (two, two))] == ["tolerance", "welch"]
    for sides in ((one, one), (two, one), (one, two)):
        with pytest.raises(ValueError, match="at least 2 per side"):
            compare("welch", *sides)
    with pytest.raises(ValueError, match="one per side"):
        compare("exact", two, two)
    with pytest.raises(ValueError, match="no image"):
        compare("exact", [], one)


def test_every_option_says_what_it_means():
    for method in METHODS.values():
        assert method.summary.endswith((".", ":", "`."))
        assert all(option.help for option in method.options.values())
