"""Images whose noise is known: variances from files and channels, films of `moment`, the method that is chosen."""

from __future__ import annotations

import html
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.diff_images import of

from mi_refract.image_diff import (
    accept,
    channels,
    folders,
    html_report,
    pairing,
    results_file,
    self_test,
    text_reports,
)
from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import METHODS, choice, compare
from mi_refract.image_diff.results import Category, Status
from mi_refract.image_diff.settings import Entry, Settings, load
from mi_refract.image_diff.variances import FREEDOM, SPP
from mi_refract.io.image_file import read, write_exr

EQUAL, DIFFERENT, INCONCLUSIVE = Verdict.EQUAL, Verdict.DIFFERENT, Verdict.INCONCLUSIVE
RGB, XYZ = channels.RGB, channels.XYZ
BESIDE = {"variance": "{stem}_var.exr", "spp_reference": 64, "spp_test": 16}
SHAPE = (32, 48, 3)
MEAN = np.linspace(0.2, 1.0, 48)[None, :, None] * (0.4, 1.0, 0.7) * np.ones(SHAPE)
SINGLE = [name for name, method in METHODS.items() if not method.takes_renders]


def settings(**values):
    return Settings(rules=(Entry("*", values),))


def samples(seed, spp, gain=1.0, shape=25.0):
    """Samples of a colour that is the same for all channels but for its strength, as light of one lamp is.

    Their variance is 1/`shape` of the squared mean.
    """
    light = np.random.default_rng(seed).gamma(shape, 1 / shape, (spp, *SHAPE[:2], 1))
    return gain * MEAN * light


def film(seed, passes=8, per_pass=4, names=RGB, gain=1.0, shape=100.0):
    """As `mi-refract render` writes it: with the variance of a sample, estimated from the spread between passes."""
    drawn = samples(seed, passes, gain, shape)[..., : len(names)]
    pixels = np.concatenate([drawn.mean(0), drawn.var(0, ddof=1) * per_pass], -1)
    header = {SPP: passes * per_pass, FREEDOM: passes - 1}
    return of(pixels, (*names, *(f"{name}.variance" for name in names)), metadata=header)


def bare(image):
    return replace(image, pixels=image.select(RGB), channels=RGB)


def written(path, image, **header):
    path.parent.mkdir(exist_ok=True)
    known = {key: value for key, value in image.metadata.items() if key in (SPP, FREEDOM)}
    write_exr(path, image.pixels, image.channels, known | header)
    return path


@pytest.fixture
def pair(tmp_path):
    """A reference of 64 samples with its variance in a file beside it, and a new image of 16 without."""
    (tmp_path / "old").mkdir()
    (tmp_path / "new").mkdir()
    drawn = samples(1, 64)
    write_exr(tmp_path / "old/a.exr", drawn.mean(0))
    write_exr(tmp_path / "old/a_var.exr", drawn.var(0, ddof=1))
    write_exr(tmp_path / "new/a.exr", samples(2, 16).mean(0))
    return tmp_path / "old", tmp_path / "new"


@pytest.fixture
def films(tmp_path):
    """A folder of references and one of new images: "same.exr" of other seeds, "off.exr" brighter by a half."""
    for seed, (name, gain) in enumerate((("same.exr", 1.0), ("off.exr", 1.5))):
        written(tmp_path / "old" / name, film(seed))
        written(tmp_path / "new" / name, film(10 + seed, gain=gain))
    return tmp_path / "old", tmp_path / "new"


def one(results):
    (found,) = results.results
    return found


def statuses(results):
    return {found.name: found.status for found in results.results}


# Files ------------------------------------------------------------------------------------------------------------


def test_a_file_says_what_channels_would(pair):
    """Of both sides: the same numbers as channels "R.variance" in the images themselves."""
    drawn = samples(2, 16)
    write_exr(pair[1] / "a_var.exr", drawn.var(0, ddof=1))
    found = one(folders.diff(*pair, settings(**BESIDE), maps=True))
    names = (*RGB, *(f"{name}.variance" for name in RGB))
    whole = [of(np.dstack([x.mean(0), x.var(0, ddof=1)]), names) for x in (samples(1, 64), drawn)]
    expected = compare("welch", *whole, spp_reference=64, spp_test=16)
    assert (found.comparison.method, found.status, found.reason) == ("welch", Status.EQUAL, expected.reason)
    assert [metric.value for metric in found.comparison.metrics] == [metric.value for metric in expected.metrics]


def test_one_side_is_enough_and_its_file_is_no_image_of_its_own(pair):
    found = one(folders.diff(*pair, settings(**BESIDE)))
    assert (found.name, found.comparison.method, found.status) == ("a.exr", "welch", Status.EQUAL)
    write_exr(pair[1] / "a.exr", samples(3, 16, gain=1.1).mean(0))
    assert one(folders.diff(*pair, settings(**BESIDE))).status is Status.DIFFERENT
    files = pair[0] / "a.exr", pair[1] / "a.exr"
    assert one(folders.diff(*files, settings(**BESIDE))).status is Status.DIFFERENT
    categories = {found.name: found.category for found in folders.diff(*pair).results}
    assert categories["a_var.exr"] is Category.REMOVED  # without the setting the file is an image


def test_variants_have_variances_of_their_own(pair):
    """And a file of these is no variant."""
    old, new = pair
    for end in ("", "_var"):
        (old / f"a{end}.exr").rename(old / f"a-2{end}.exr")
    off = samples(4, 64, gain=1.5)
    write_exr(old / "a.exr", off.mean(0))
    write_exr(old / "a_var.exr", off.var(0, ddof=1))
    found = one(folders.diff(old, new, settings(accept=("{stem}-*.exr",), **BESIDE)))
    assert (found.status, found.matched) == (Status.EQUAL, old / "a-2.exr")
    assert found.variants == (old / "a-2.exr",)


def test_files_elsewhere(pair):
    old, new = pair
    (old / "noise").mkdir()
    (old / "a_var.exr").rename(old / "noise/a.exr")
    assert one(folders.diff(old, new, settings(**BESIDE | {"variance": "{root}/noise/{name}"}))).status is Status.EQUAL


def test_a_variance_counts_for_welch_alone(pair):
    """`tolerance` neither reads nor compares it."""
    (pair[0] / "a_var.exr").unlink()
    found = one(folders.diff(*pair, settings(variance="{stem}_var.exr", method="tolerance", fail=1.0)))
    assert found.comparison.method == "tolerance"


def test_a_mask_hides_its_pixels_in_the_variance(pair):
    pixels = read(pair[0] / "a_var.exr").pixels.copy()
    pixels[:8, :8] = 1e9
    write_exr(pair[0] / "a_var.exr", pixels)
    noisy, clear = (one(folders.diff(*pair, settings(**BESIDE, ignore=x))) for x in ((), ((0, 0, 8, 8),)))
    assert (noisy.status, clear.status) == (Status.INCONCLUSIVE, Status.EQUAL)


@pytest.mark.parametrize(("named", "freedom"), [({FREEDOM: 5}, 5), ({}, 7)])
def test_a_file_of_one_channel_is_for_an_image_of_one_and_its_header_says_how_well_it_is_known(
    tmp_path, named, freedom
):
    for side, value in (("old", 1.0), ("new", 3.0)):
        (tmp_path / side).mkdir()
        write_exr(tmp_path / side / "a.exr", [[[value]]], ("Y",), {SPP: 1000, FREEDOM: 7})
        write_exr(tmp_path / side / "a_var.exr", [[[250.0]]], ("V",), named)
    how = settings(variance="{stem}_var.exr", equivalence_margin=0.0)
    found = one(folders.diff(tmp_path / "old", tmp_path / "new", how, maps=True))
    p = 2 * stats.t.sf(2 / np.sqrt(0.5), 2 * freedom)
    assert found.comparison.maps["p"].item() == pytest.approx(p, rel=1e-5)


def test_a_variance_is_accepted_with_its_image(pair):
    """A reference with the variance of another render would be judged wrongly for good."""
    old, new = pair
    drawn = samples(3, 16, gain=1.2)
    write_exr(new / "a.exr", drawn.mean(0))
    found = folders.diff(old, new, settings(**BESIDE), to_accept=True)
    with pytest.raises(
        ValueError, match=r"new/a_var.exr: no such file, and .*old/a_var.exr belongs to a different render"
    ):
        list(accept.changes(found))
    write_exr(new / "a_var.exr", drawn.var(0, ddof=1))
    with pytest.raises(OSError, match=r"new/a_var\.exr: changed since it was compared"):  # nobody has compared it
        accept.accept(list(accept.changes(found)))
    accept.accept(list(accept.changes(folders.diff(old, new, settings(**BESIDE), to_accept=True))))
    for name in ("a.exr", "a_var.exr"):
        assert (old / name).read_bytes() == (new / name).read_bytes()


# Bad input --------------------------------------------------------------------------------------------------------


def _write(end, pixels, names=RGB, **header):
    return lambda old: write_exr(old / f"a{end}.exr", pixels, names, header)


def _freedom(named):
    return _write("", MEAN, **{FREEDOM: named}), {}, f"{FREEDOM} = "


HOLE = np.where(np.arange(SHAPE[1])[None, :, None] == 7, np.nan, np.ones(SHAPE))
BAD = {
    "missing": (lambda old: (old / "a_var.exr").unlink(), {}, "a_var.exr: no such file"),
    "negative": (_write("_var", -np.ones(SHAPE)), {}, "negative in 1536 pixels, the first at x = 0, y = 0"),
    "negative, as a colour": (_write("_var", -np.ones(SHAPE)), {}, "channels = ['X', 'Y', 'Z']"),
    "other size": (_write("_var", np.ones((8, 9, 3))), {}, "9 × 8; expected a variance image of 48 × 32"),
    "NaN": (_write("_var", HOLE), {}, "its variance of R is not finite at x = 7, y = 0"),
    "other channels": (
        _write("_var", np.ones(SHAPE), ("U", "V", "W")),
        {},
        "variances of channels U, V, W; expected chann",
    ),
    "no image": (lambda old: (old / "a_var.exr").write_bytes(b"xy"), {}, "a_var.exr: corrupt EXR file"),
    "itself": (lambda old: None, {"variance": "{name}"}, "itself; expected another image"),
    "1 sample": (lambda old: None, {"spp_test": 1}, "samples per pixel: 1; expected `spp` or `spp_test`, 2 to 10¹⁵"),
    "-3": (lambda old: None, {"spp_reference": -3}, "samples per pixel: -3; expected `spp` or `spp_reference`"),
    "no samples": (lambda old: None, {"spp_test": 0}, "names 'no samples per pixel'; expected `spp` or `spp_test`"),
    "no such channel": (lambda old: None, {"channels": (("Q", "Q"),)}, "no channel 'Q'; in `channels` expected R, G"),
    **{f"freedom {named!r}": _freedom(named) for named in (0, -1, 2.5, "many", "7\n8", float("nan"), 10**16)},
}


@pytest.mark.parametrize(("change", "values", "message"), BAD.values(), ids=BAD)
def test_what_cannot_be_used_is_one_line_and_the_others_are_compared(pair, change, values, message):
    old, new = pair
    for folder, end in ((old, ""), (old, "_var"), (new, "")):
        (folder / f"b{end}.exr").write_bytes((folder / f"a{end}.exr").read_bytes())
    change(old)
    results = folders.diff(old, new, Settings(rules=(Entry("*", BESIDE), Entry("a.exr", values))))
    found = {result.name: result for result in results.results}
    assert results.exit_code == 2
    assert message in found["a.exr"].error
    assert FREEDOM not in message or found["a.exr"].error.endswith("; expected a whole number, 1 to 10¹⁵")
    assert "\n" not in found["a.exr"].error
    assert found["b.exr"].status is Status.EQUAL


def test_rounding_below_zero_is_none():
    """m2 − m² of a constant in single precision."""
    known = {name: np.full(SHAPE[:2], -1e-7) for name in RGB}
    assert compare("auto", *[of(MEAN, variances=known)] * 2, spp=16).verdict is EQUAL


# Mitsuba's films --------------------------------------------------------------------------------------------------


def moments(drawn, colours=RGB, layer="nested", extra=()):
    """A film as Mitsuba's `moment` integrator writes it: its colours, and the moments of X, Y and Z.

    `extra`: names of other channels that the nested integrator writes, which hold a mask.
    """
    xyz = drawn @ channels.TO_XYZ.T
    film = {RGB: drawn, XYZ: xyz, ("Y",): xyz[..., 1:2], (*RGB, "A"): np.concatenate([drawn, drawn[..., :1] > 0], -1)}
    parts = {name: film[colours][..., i].mean(0) for i, name in enumerate(colours)}
    for name, x in (*zip(XYZ, np.moveaxis(xyz, -1, 0), strict=True), *((name, drawn[..., 0]) for name in extra)):
        parts |= {f"{layer}.{name}": x.mean(0), f"m2_{layer}.{name}": np.square(x).mean(0)}
    return of(np.stack(list(parts.values()), -1), tuple(parts))


FILMS = {
    "the same": (moments(samples(1, 16)), moments(samples(2, 16))),
    "an integrator without a name": (moments(samples(1, 16)), moments(samples(2, 16), layer="_arg_0")),
    "film of X, Y, Z": (moments(samples(1, 16)), moments(samples(2, 16), XYZ)),
    "film of Y": (moments(samples(1, 16), ("Y",)), moments(samples(2, 16), ("Y",))),
    "with alpha": (moments(samples(1, 16), (*RGB, "A")), moments(samples(2, 16), (*RGB, "A"), "_arg_0")),
    "with others": (moments(samples(1, 16), extra=["dd.y.T"]), moments(samples(2, 16), layer="b", extra=["dd.y.T"])),
    "R, G, B": (moments(samples(1, 16)), of(samples(2, 16).mean(0))),
    "R, G, B first": (of(samples(1, 16).mean(0)), moments(samples(2, 16), layer="_arg_0")),
    "X, Y, Z": (moments(samples(1, 16)), of(samples(2, 16).mean(0) @ channels.TO_XYZ.T, XYZ)),
    "in halves": (
        moments(samples(1, 16)),
        replace(x := moments(samples(2, 16), layer="b"), pixels=x.pixels.astype(np.float16).astype(np.float32)),
    ),
}


@pytest.mark.parametrize(("reference", "test"), FILMS.values(), ids=FILMS)
def test_films_are_recognised(reference, test):
    """An equal one is equal, nothing of it untested; one that is brighter is different, in whatever order of channels.

    What is not finite is found.
    """
    found = compare("auto", reference, test, spp=16)
    assert (found.method, found.verdict) == ("welch", EQUAL), found.reason
    mixed = replace(test, pixels=test.pixels[..., ::-1], channels=test.channels[::-1])
    assert compare("auto", reference, mixed, spp=16).metrics == found.metrics
    squared = {name for name in (*reference.channels, *test.channels) if "m2" in name}
    gains = [1.1**2 if name in squared else 1.0 if name == "A" else 1.1 for name in test.channels]
    brighter = replace(test, pixels=test.pixels * np.float32(gains))
    assert compare("auto", reference, brighter, spp=16).verdict is DIFFERENT
    brighter.pixels[5, 6] = np.nan
    found = compare("auto", reference, brighter, spp=16)
    assert (found.verdict, "x = 6, y = 5" in found.reason) == (DIFFERENT, True)


def test_infinite_squares_cannot_be_compared():
    test = moments(samples(1, 8))
    test.pixels[2, 3, test.channels.index("m2_nested.Y")] = np.inf
    with pytest.raises(ValueError, match=r"variance of Y is not finite at x = 3, y = 2"):
        compare("auto", test, moments(samples(2, 8)), spp=8)


def test_an_alpha_has_at_most_the_variance_of_a_coin():
    """One of a half is equal to another of as many samples, and not to one of 0.4."""
    reference, test, other = (moments(samples(seed, 64), (*RGB, "A")) for seed in (1, 2, 3))
    for image, share, seed in ((reference, 0.5, 4), (test, 0.5, 5), (other, 0.4, 6)):
        image.pixels[..., 3] = np.random.default_rng(seed).binomial(64, share, SHAPE[:2]) / 64
    how = {"spp": 64, "resolution": 0.2}
    assert compare("auto", reference, test, **how).verdict is EQUAL
    assert compare("auto", reference, other, **how).verdict is DIFFERENT
    reference.pixels[..., 3], other.pixels[..., 3] = 2.0, 2.5  # no alpha: nothing bounds the variance
    assert "without variance: A" in compare("auto", reference, other, **how).reason


def test_colours_that_do_not_repeat_the_moments_are_compared_themselves():
    """A film whose conversion to R, G, B is broken, beside moments that are right."""
    reference, test = moments(samples(1, 16)), moments(samples(2, 16))
    test.pixels[..., 2] *= 1.01
    found = compare("auto", reference, test, spp=16)
    assert (found.verdict, found.reason[:30]) == (INCONCLUSIVE, "not tested, without variance: ")


def test_channels_without_variance_are_not_equal_unseen():
    """`variance` for R only: G is black and B tripled."""

    def side(seed, *gains):
        drawn = samples(seed, 16)
        pixels = np.dstack([drawn.mean(0) * gains, drawn[..., 0].var(0, ddof=1)])
        return of(pixels, ("R", "G", "B", "R.variance"), metadata={SPP: 16})

    reference, test = side(1, 1, 1, 1), side(2, 1, 0, 3)
    found = compare("auto", reference, test)
    assert (found.method, found.verdict) == ("welch", INCONCLUSIVE)
    assert found.reason.startswith("not tested, without variance: G, B")
    test.pixels[..., 1:3] = reference.pixels[..., 1:3]
    assert compare("auto", reference, test).verdict is EQUAL
    reference.pixels[..., 1:3] *= 0.003  # dim, and black in the other: `tolerance` alone would pass that
    test.pixels[..., 1:3] = 0
    assert compare("auto", reference, test).verdict is INCONCLUSIVE


def test_what_one_side_alone_has_is_no_silence():
    """An output that the new image lost is not left out unasked; the message says what to set."""
    reference, test = moments(samples(1, 16), extra=["depth"]), moments(samples(2, 16))
    with pytest.raises(ValueError, match="or `channels`: those to compare"):
        compare("auto", reference, test, spp=16)
    names = tuple((name, name) for name in ("nested.X", "nested.Y", "nested.Z"))
    sides = (channels.chosen([image], names, side)[0] for side, image in enumerate((reference, test)))
    assert compare("auto", *sides, spp=16).verdict is EQUAL


@pytest.mark.parametrize("form", ["m2_{}", "{}.m2", "variance.{}", "img.m2_{}"])
def test_names_of_channels_of_spread(form):
    name = "img.nested.X" if form.startswith("img") else "nested.X"
    spread = form.format("nested.X")
    assert channels.spreads([name, spread]) == {name: (spread, "m2" in form)}
    assert channels.means([name, spread, "A"]) == [name, "A"]


def test_mitsuba_names_its_channels_so(tmp_path):
    """What the films above are made after, in the Mitsuba that is installed."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    path = {"type": "path"}
    aov = {"type": "aov", "aovs": "dd.y:depth", "img": path}
    for integrator, layer, more in (
        ({"type": "moment", "_arg_0": path}, "_arg_0", set()),
        ({"type": "moment", "nested": aov}, "nested", {"nested.dd.y.T", "m2_nested.dd.y.T"}),
        ({"type": "aov", "aovs": "dd.y:depth", "img": {"type": "moment", "nested": path}}, "img.nested", {"dd.y.T"}),
    ):
        film = {"type": "hdrfilm", "width": 4, "height": 3, "component_format": "float32"}
        sensor = {"type": "perspective", "film": film}
        scene = mi.load_dict({"type": "scene", "i": integrator, "s": sensor, "e": {"type": "constant"}})
        mi.render(scene, spp=2)
        scene.sensors()[0].film().bitmap().write(str(tmp_path / "a.exr"))
        found = read(tmp_path / "a.exr")
        assert channels.moment_layer(found) == layer
        assert {*RGB, *(f"{layer}.{name}" for name in XYZ), *more} <= set(found.channels)


# Channels ---------------------------------------------------------------------------------------------------------


def test_mitsubas_own_test_data(tmp_path):
    """Variances of X, Y, Z that were written as R, G, B are negative for coloured light; as X, Y, Z they are right."""
    old, new = tmp_path / "old", tmp_path / "new"
    old.mkdir()
    new.mkdir()
    red, other = (samples(seed, spp, shape=4.0) * (1.0, 0.05, 0.02) for seed, spp in ((1, 64), (2, 16)))
    # Mean and variance of X, Y and Z, both converted to R, G, B, as test_renders.py does.
    xyz, to_rgb = red @ channels.TO_XYZ.T, np.linalg.inv(channels.TO_XYZ).T
    write_exr(old / "a.exr", xyz.mean(0) @ to_rgb)
    write_exr(old / "a_var.exr", xyz.var(0) @ to_rgb)
    write_exr(new / "a.exr", other.mean(0))
    assert "negative" in one(folders.diff(old, new, settings(**BESIDE))).error
    how = BESIDE | {"resolution": 0.2, "channels": tuple(zip(XYZ, XYZ, strict=True))}
    found = one(folders.diff(old, new, settings(**how), maps=True))
    assert found.status is Status.EQUAL
    direct = [of(read(folder / "a.exr").pixels @ channels.TO_XYZ.T, XYZ) for folder in (old, new)]
    direct[0] = replace(direct[0], variances=dict(zip(XYZ, np.moveaxis(xyz.var(0), -1, 0), strict=True)))
    expected = compare("welch", *direct, spp_reference=64, spp_test=16)
    assert found.comparison.minimum_detectable == pytest.approx(expected.minimum_detectable, rel=1e-4)


def test_a_variance_of_other_colours_than_the_image_is_one_of_x_y_z(pair):
    write_exr(pair[0] / "a_var.exr", (samples(1, 64) @ channels.TO_XYZ.T).var(0, ddof=1), XYZ)
    assert one(folders.diff(*pair, settings(**BESIDE))).status is Status.EQUAL


def test_channels_by_their_names_on_both_sides():
    sides = of(MEAN, ("R", "G", "b.B")), of(2 * MEAN, ("a.R", "G", "B"))
    names = (("R", "a.R"), ("b.B", "B"))
    found = [channels.chosen([image], names, side)[0] for side, image in enumerate(sides)]
    assert [image.channels for image in found] == [("R", "b.B")] * 2
    np.testing.assert_array_equal(found[1].pixels, sides[1].pixels[..., [0, 2]])


@pytest.mark.parametrize("method", ["exact", "tolerance"])
def test_channels_of_every_method(pair, films, method):
    """NAME.variance among them, if it is named."""
    image = read(pair[0] / "a.exr")
    write_exr(pair[1] / "a.exr", image.pixels * (1, 1, 3))
    off = read(films[0] / "off.exr")
    off.pixels[..., off.channels.index("R.variance")] *= 2
    written(films[1] / "off.exr", off)
    for path, names, verdict, left in (
        ("a.exr", RGB, Status.DIFFERENT, ""),
        ("a.exr", ("R", "G"), Status.EQUAL, "; not compared: B"),
        ("off.exr", ("R", "G"), Status.EQUAL, "; not compared: B"),
        ("off.exr", ("R", "R.variance"), Status.DIFFERENT, "; not compared: G, B"),
    ):
        how = settings(method=method, channels=tuple((name, name) for name in names))
        found = one(folders.diff(pair[0] / path, pair[1] / path, how))
        assert found.status is verdict
        assert found.reason.endswith(left)


# Films with their own variance -------------------------------------------------------------------------------------

BOTH = "welch (the variance of both is known)"


def test_welch_is_chosen_and_the_reports_say_why(films, tmp_path):
    results = folders.diff(*films, maps=True)
    html_report.write(tmp_path / "report.html", results)
    assert statuses(results) == {"off.exr": Status.DIFFERENT, "same.exr": Status.EQUAL}
    assert {result.method_in_words for result in results.results} == {BOTH}
    assert "the variance of both is known" in html.unescape(text_reports.markdown(results))
    entries = results_file.as_data(results)["results"]
    assert {(x["method"], x["method_why"]) for x in entries} == {("welch", "the variance of both is known")}
    assert BOTH in (tmp_path / "report.html").read_text("utf-8")


def test_check_settings_shows_them(pair):
    pairs = pairing.pairs(*pair, settings(**BESIDE, channels=(("X", "a.X"), ("Y", "Y"))))
    shown = text_reports.settings_table(pairs)[1][1]
    assert shown.endswith("spp_reference=64, spp_test=16, variance {stem}_var.exr, channels X=a.X,Y")


def test_a_method_that_is_named_is_used(films, tmp_path):
    """By the settings for all or for one image; nothing explains it."""
    found = folders.diff(*films, settings(method="flip")).results
    assert {result.comparison.method_in_words for result in found} == {"flip"}
    path = tmp_path / "a.toml"
    path.write_text('[[image]]\nname = "off.exr"\nmethod = "exact"\nreason = "r"\n')
    found = {result.name: result.comparison for result in folders.diff(*films, load(path)).results}
    assert {name: x.method_in_words for name, x in found.items()} == {"off.exr": "exact", "same.exr": BOTH}


def test_the_method_that_auto_chooses():
    """A render holds its variance always: beside an image of which nothing is known, that one decides."""
    ours, plain = film(1), bare(film(1))
    unknown, theirs = replace(plain, metadata={}), replace(ours, metadata={})
    for sides, how, expected in (
        (([ours], [ours]), {}, ("welch", "the variance of both is known")),
        (([ours], [plain]), {}, ("welch", "the variance of the reference is known")),
        (([plain], [ours]), {}, ("welch", "the variance of the new image is known")),
        (([plain] * 2, [plain] * 2), {}, ("welch", "several renders")),
        (([plain], [plain]), {}, ("tolerance", "")),
        (([unknown], [ours]), {}, ("tolerance", "of the reference neither variance nor samples per pixel are known")),
        (([ours], [unknown]), {}, ("tolerance", "of the new image neither variance nor samples per pixel are known")),
        (([unknown], [ours]), {"spp": True}, ("welch", "the variance of the new image is known")),
        (([unknown], [theirs]), {}, ("welch", "the variance of the new image is known")),
    ):
        assert choice(*sides, **how) == expected
    assert compare("auto", [plain, bare(film(2))], [bare(film(3)), bare(film(4))]).method_in_words.endswith("renders)")


def test_the_same_image_is_equal_however_noisy():
    noisy = film(50, passes=2, shape=4.0)
    found = compare("auto", noisy, noisy)
    assert (found.verdict, found.reason) == (EQUAL, "identical in every value, variances included")
    assert all(metric.holds for metric in found.metrics)
    order = [3, 4, 5, 2, 1, 0]
    mixed = replace(noisy, pixels=noisy.pixels[..., order], channels=tuple(noisy.channels[i] for i in order))
    assert compare("auto", noisy, mixed).verdict is EQUAL
    for channel in range(6):  # one value less, and the noise counts
        other = replace(noisy, pixels=noisy.pixels.copy())
        other.pixels[3, 4, channel] *= 1.0001
        assert compare("auto", noisy, other).verdict is INCONCLUSIVE
    noisy.pixels[3, 4, 0] = np.nan  # is no more equal to itself than elsewhere
    assert compare("auto", noisy, noisy).verdict is DIFFERENT
    found = compare("auto", noisy, noisy, allow_nonfinite=True)
    assert found.reason == "identical in every value, variances included; not compared: 1 of 4608 values, not finite"


def test_the_same_image_without_variances_of_its_own_is_no_such_case():
    """A variance in a file beside it may be of any other render, and renders have others beside the first."""
    noisy, low, high = (film(seed, passes=2, gain=gain, shape=4.0) for seed, gain in ((1, 1.0), (2, 1.0), (3, 9.0)))
    beside = replace(bare(noisy), variances=dict(zip(RGB, np.moveaxis(noisy.pixels[..., 3:], -1, 0), strict=True)))
    assert compare("auto", beside, beside).verdict is INCONCLUSIVE
    assert compare("welch", [noisy, low], [noisy, high]).verdict is not EQUAL


@pytest.mark.parametrize("method", SINGLE)
def test_a_variance_is_no_image(method):
    """Neither another one, nor one on one side alone, nor NaN; but one without its channel is."""
    image = film(60)
    other = replace(image, pixels=image.pixels.copy())
    other.pixels[..., 3:] *= 7
    other.pixels[1, 1, 4] = np.nan
    for sides in ((image, other), (image, bare(image)), (bare(image), image)):
        assert compare(method, *sides).verdict is EQUAL
    alone = of(np.ones((4, 4, 1)), ("B.variance",))
    assert compare(method, alone, replace(alone, pixels=2 * alone.pixels)).verdict is DIFFERENT


def test_several_renders_are_compared_without_theirs():
    """Their spread is the noise. A variance that is seven times as large is no other image."""
    one, two = ([film(seed) for seed in seeds] for seeds in ((1, 2, 3), (4, 5, 6)))
    for image in two:
        image.pixels[..., 3:] *= 7
    assert compare("auto", one, two, tile=32, resolution=1.0).verdict is EQUAL


def test_they_are_accepted_whole(films):
    old, new = films
    copies = list(accept.changes(folders.diff(old, new, to_accept=True)))
    assert [copy.reference.name for copy in copies] == ["off.exr"]
    accept.accept(copies)
    assert (old / "off.exr").read_bytes() == (new / "off.exr").read_bytes()
    assert set(statuses(folders.diff(old, new)).values()) == {Status.EQUAL}


@pytest.mark.parametrize("names", [RGB, ("Y",), ("dd.y.T", "nn.X")])
def test_panes_show_the_image(tmp_path, names):
    for side, gain in (("old", 1.0), ("new", 1.5)):
        written(tmp_path / side / "a.exr", film(70, names=names, gain=gain))
    found = one(folders.diff(tmp_path / "old", tmp_path / "new", maps=True))
    shown = html_report.shown_of(found, 1e6, 1e6)
    assert [pane["role"] for pane in shown.panes][:4] == ["reference", "test", "difference", "flip"]
    assert shown.note == ""
    assert "variance" not in json.dumps(shown.panes)


def test_the_self_test_plants_defects_in_the_image(films):
    renders = self_test.read_images(films[0] / "same.exr")
    np.testing.assert_array_equal(renders[0], read(films[0] / "same.exr").select(RGB))
    assert self_test.read_images(films[0]).shape == (2, *SHAPE)
