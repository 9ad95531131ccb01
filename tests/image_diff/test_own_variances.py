"""Renders that hold the variance of their own channels, as `mi-refract render` writes them, by every method.

The variance is estimated from the spread between a few passes: the header names its degrees of freedom.
"""

from __future__ import annotations

import html
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from mi_refract.image_diff import accept, folders, panes, report_folder, self_test, settings_file, text_reports
from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import METHODS, choice, compare
from mi_refract.image_diff.results import Status
from mi_refract.image_diff.settings import Settings
from mi_refract.image_diff.variances import FREEDOM
from mi_refract.image_diff.welch import compare_renders
from mi_refract.io.image_file import Image, read, write_exr

RGB = ("R", "G", "B")
SHAPE = (32, 32, 3)
PASSES, PER_PASS = 8, 4
SPP = "mi_refract:spp"
BOTH = "welch (the variance of both is known)"
# Of σ = 0.5 pixels, as Mitsuba's default filter, along one axis.
FILTER = np.exp(-2.0 * np.arange(-2, 3) ** 2) / np.exp(-2.0 * np.arange(-2, 3) ** 2).sum()


def film(passes, names=RGB, per_pass=PER_PASS):
    """The image of passes, number × H × W × C, with its variance of a sample."""
    variance = passes.var(0, ddof=1) * per_pass
    header = {SPP: len(passes) * per_pass, FREEDOM: len(passes) - 1}
    pixels = np.concatenate([passes.mean(0), variance], -1).astype(np.float32)
    return Image(Path("a.exr"), pixels, (*names, *(f"{name}.variance" for name in names)), metadata=header)


def render(rng, kind="exponential", gain=1.0, shape=SHAPE, passes=PASSES, noise=0.5):
    """Passes of noisy samples: normal with σ = `noise` of the mean, exponential, or the same behind a wide filter."""
    drawn = (passes, *shape)
    if kind == "normal":
        light = 1 + noise * rng.standard_normal(drawn) / PER_PASS**0.5
    else:
        light = rng.gamma(PER_PASS, 1 / PER_PASS, drawn)
    if kind == "filtered":
        for axis in (1, 2):
            light = sum(w * np.roll(light, step, axis) for step, w in zip(range(-2, 3), FILTER, strict=True))
    return film(gain * light)


def bare(image):
    return replace(image, pixels=image.pixels[..., :3], channels=RGB)


def written(path, image, **header):
    path.parent.mkdir(exist_ok=True)
    ours = {key: value for key, value in image.metadata.items() if key in (SPP, FREEDOM)}
    write_exr(path, image.pixels, image.channels, ours | header)
    return path


@pytest.fixture
def pair(tmp_path):
    """A folder of references and one of new images: "same.exr" of other seeds, "off.exr" brighter by a half."""
    rng = np.random.default_rng(1)
    for name, gain in (("same.exr", 1.0), ("off.exr", 1.5)):
        written(tmp_path / "old" / name, render(rng, "normal", noise=0.1))
        written(tmp_path / "new" / name, render(rng, "normal", gain, noise=0.1))
    return tmp_path / "old", tmp_path / "new"


def statuses(results):
    return {each.name: each.status for each in results.results}


# Degrees of freedom -----------------------------------------------------------------------------------------------


def one_pixel(value, variance=None, **header):
    header = {SPP: 1000} | {f"mi_refract:{name}": each for name, each in header.items()}
    pixels = [value] if variance is None else [value, variance]
    names = ("Y", "Y.variance")[: len(pixels)]
    return Image(Path("a.exr"), np.array([[pixels]], np.float32), names, metadata=header)


@pytest.mark.parametrize("named", [0, -1, 2.5, "many", "7\n8", float("nan"), 10**16])
def test_what_is_no_number_of_them_is_one_line(pair, named):
    old, new = pair
    path = written(old / "same.exr", read(old / "same.exr"), **{FREEDOM: named})
    results = folders.diff(old, new)
    (error,) = (each.error for each in results.results if each.name == "same.exr")
    assert error.startswith(f"{path}: {FREEDOM} = ")
    assert error.endswith("; expected a whole number, 1 to 10¹⁵")
    assert "\n" not in error
    assert statuses(results)["off.exr"] is Status.DIFFERENT


@pytest.mark.parametrize(("named", "freedom"), [({"variance_freedom": 5}, 5), ({}, 7)])
def test_of_a_variance_in_a_file_its_own_header_says_them(tmp_path, named, freedom):
    for side, value in (("old", 1.0), ("new", 3.0)):
        written(tmp_path / side / "a.exr", one_pixel(value, variance_freedom=7))
        written(tmp_path / side / "a_var.exr", one_pixel(250.0, **named))
    settings = Settings.for_all(variance="{stem}_var.exr", equivalence_margin=0.0)
    (found,) = folders.diff(tmp_path / "old", tmp_path / "new", settings, maps=True).results
    p = 2 * stats.t.sf(2 / np.sqrt(0.5), 2 * freedom)
    assert found.comparison.maps["p"].item() == pytest.approx(p, rel=1e-5)


# The method that is chosen -----------------------------------------------------------------------------------------


def test_it_is_welch_and_the_reports_say_why(pair, tmp_path):
    with report_folder.writing(tmp_path / "report") as folder:
        results = folders.diff(*pair, view=folder.view)
        folder.write(results, {}, "")
    assert statuses(results) == {"off.exr": Status.DIFFERENT, "same.exr": Status.EQUAL}
    assert str(text_reports.table(results)).count(BOTH) == 2
    assert "the variance of both is known" in html.unescape(text_reports.markdown(results))
    entries = text_reports.as_data(results)["results"]
    assert {(each["method"], each["method_why"]) for each in entries} == {("welch", "the variance of both is known")}
    assert BOTH in (tmp_path / "report/index.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("side", "why"), [(0, "the variance of the reference is known"), (1, "the variance of the new image is known")]
)
def test_one_side_that_knows_it_is_enough(pair, side, why):
    path = pair[1 - side] / "same.exr"
    written(path, bare(read(path)))
    found = next(each for each in folders.diff(*pair).results if each.name == "same.exr")
    assert (found.status, found.comparison.method_in_words) == (Status.EQUAL, f"welch ({why})")


def test_several_renders_are_a_reason_too():
    rng = np.random.default_rng(40)
    sides = [[bare(render(rng)) for _ in range(2)] for _ in range(2)]
    assert compare("auto", *sides).method_in_words == "welch (several renders)"


def test_without_variances_it_is_tolerance_as_ever():
    rng = np.random.default_rng(41)
    assert compare("auto", bare(render(rng)), bare(render(rng))).method_in_words == "tolerance"


def test_a_method_that_was_asked_for_is_used(pair, tmp_path):
    """By the command line for all, by a settings file for one; nothing explains it."""
    flip = Settings.for_all(method="flip")
    assert {each.comparison.method_in_words for each in folders.diff(*pair, flip).results} == {"flip"}
    path = tmp_path / "a.toml"
    path.write_text('[[image]]\nname = "off.exr"\nmethod = "exact"\nreason = "r"\n')
    found = {each.name: each.comparison for each in folders.diff(*pair, settings_file.load(path)).results}
    assert {name: each.method_in_words for name, each in found.items()} == {"off.exr": "exact", "same.exr": BOTH}


# Identical files --------------------------------------------------------------------------------------------------


def test_the_same_image_is_equal_however_noisy():
    noisy = render(np.random.default_rng(50), shape=(16, 16, 3), passes=2)
    found = compare("auto", noisy, noisy)
    assert (found.verdict, found.reason) == (Verdict.EQUAL, "the same in every value, noise and all")
    assert all(each.holds for each in found.metrics)
    order = [3, 4, 5, 2, 1, 0]
    mixed = replace(noisy, pixels=noisy.pixels[..., order], channels=tuple(noisy.channels[i] for i in order))
    assert compare("auto", noisy, mixed).verdict is Verdict.EQUAL


def test_the_same_image_without_variances_of_its_own_is_no_such_case():
    """A variance in a file beside it may be of any other render, and renders have others beside the first."""
    rng = np.random.default_rng(53)
    noisy, low, high = (render(rng, shape=(16, 16, 3), passes=2, gain=gain) for gain in (1.0, 1.0, 9.0))
    given = dict(zip(RGB, np.moveaxis(noisy.pixels[..., 3:], -1, 0), strict=True))
    beside = replace(bare(noisy), variances=given)
    assert compare("auto", beside, beside).verdict is Verdict.INCONCLUSIVE
    assert compare_renders([noisy, low], [noisy, high]).verdict is not Verdict.EQUAL


@pytest.mark.parametrize("channel", range(6))
def test_one_value_less_and_the_noise_counts(channel):
    noisy = render(np.random.default_rng(51), shape=(16, 16, 3), passes=2)
    other = replace(noisy, pixels=noisy.pixels.copy())
    other.pixels[3, 4, channel] *= 1.0001
    assert compare("auto", noisy, other).verdict is Verdict.INCONCLUSIVE


def test_nan_is_no_more_equal_to_itself_than_elsewhere():
    noisy = render(np.random.default_rng(52))
    noisy.pixels[3, 4, 0] = np.nan
    assert compare("auto", noisy, noisy).verdict is Verdict.DIFFERENT
    found = compare("auto", noisy, noisy, allow_nonfinite=True)
    assert found.reason == "the same in every value, noise and all; not compared: 1 of 3072 values, not finite"


# Other methods ----------------------------------------------------------------------------------------------------

SINGLE = [name for name, method in METHODS.items() if not method.takes_renders]


@pytest.mark.parametrize("method", SINGLE)
def test_a_variance_is_no_image(method):
    """Neither another one, nor one on one side alone, nor NaN."""
    one = render(np.random.default_rng(60))
    other = replace(one, pixels=one.pixels.copy())
    other.pixels[..., 3:] *= 7
    other.pixels[1, 1, 4] = np.nan
    for sides in ((one, other), (one, bare(one)), (bare(one), one)):
        assert compare(method, *sides).verdict is Verdict.EQUAL


@pytest.mark.parametrize("method", ["exact", "tolerance"])
def test_one_that_is_named_is_compared(pair, method):
    old, new = pair
    other = read(old / "off.exr")
    other.pixels[..., other.channels.index("R.variance")] *= 2
    written(new / "off.exr", other)
    for names, status in ((("R", "G"), Status.EQUAL), (("R", "R.variance"), Status.DIFFERENT)):
        settings = Settings.for_all(method=method, channels=tuple((name, name) for name in names))
        (found,) = folders.diff(old / "off.exr", new / "off.exr", settings).results
        assert found.status is status
        left = {"R", "G", "B"} - set(names)
        assert found.reason.endswith(f"; not compared: {', '.join(sorted(left, key='RGB'.index))}")


def test_one_without_its_channel_is_an_image():
    one = Image(Path("a.exr"), np.ones((4, 4, 1), np.float32), ("B.variance",))
    assert compare("exact", one, replace(one, pixels=2 * one.pixels)).verdict is Verdict.DIFFERENT


def test_several_renders_are_compared_without_theirs():
    """Their spread is the noise. A variance that is seven times as large is no other image."""
    rng = np.random.default_rng(61)
    one, two = ([render(rng) for _ in range(3)] for _ in range(2))
    for each in two:
        each.pixels[..., 3:] *= 7
    how = {"tile": 32, "resolution": 1.0}
    assert compare("auto", one, two, **how).verdict is Verdict.EQUAL


# What else is done with such files ---------------------------------------------------------------------------------


def test_they_are_accepted_whole(pair):
    old, new = pair
    copies = list(accept.changes(folders.diff(old, new, to_accept=True)))
    assert [each.reference.name for each in copies] == ["off.exr"]
    accept.accept(copies)
    assert (old / "off.exr").read_bytes() == (new / "off.exr").read_bytes()
    assert statuses(folders.diff(old, new)) == {"off.exr": Status.EQUAL, "same.exr": Status.EQUAL}


@pytest.mark.parametrize("names", [RGB, ("Y",), ("dd.y.T", "nn.X")])
def test_panes_show_the_image(tmp_path, names):
    rng = np.random.default_rng(70)
    for side, gain in (("old", 1.0), ("new", 1.5)):
        light = gain * rng.gamma(PER_PASS, 1 / PER_PASS, (PASSES, 32, 32, len(names)))
        written(tmp_path / side / "a.exr", film(light, names))
    (found,) = folders.diff(tmp_path / "old", tmp_path / "new", maps=True).results
    shown = panes.of_result(found, 1e6, 1e6, thumbs=True)
    assert [pane["role"] for pane in shown.panes][:4] == ["reference", "test", "difference", "flip"]
    assert (shown.note, set(shown.thumbnails)) == ("", {"test", "difference"})
    assert "variance" not in json.dumps(shown.panes)


def test_the_self_test_plants_defects_in_the_image(pair):
    renders = self_test.read_images(pair[0] / "same.exr")
    np.testing.assert_array_equal(renders[0], read(pair[0] / "same.exr").select(RGB))
    assert self_test.read_images(pair[0]).shape == (2, *SHAPE)


def test_a_render_beside_an_image_of_which_nothing_is_known(tmp_path):
    """It holds its variance unasked: then the other one decides. Where samples per pixel are known, so is enough."""
    names = (*RGB, *(f"{name}.variance" for name in RGB))
    render = Image(tmp_path / "a", np.ones((16, 16, 6), np.float32), names, metadata={SPP: 64})
    other = Image(tmp_path / "b", np.ones((16, 16, 3), np.float32), RGB)
    why = "of the reference neither variance nor samples per pixel are known"
    assert choice([other], [render]) == ("tolerance", why)
    assert choice([render], [other])[0] == "tolerance"
    assert choice([other], [render], spp=True)[0] == "welch"
    assert choice([replace(other, metadata={SPP: 9})], [render])[0] == "welch"
