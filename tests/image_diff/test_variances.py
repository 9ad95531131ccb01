"""Variances from files and from channels, the channels that are compared, and the films that Mitsuba writes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refract.image_diff import accept, channels, folders, pairing, text_reports
from mi_refract.image_diff.comparison import Verdict
from mi_refract.image_diff.methods import choice, compare
from mi_refract.image_diff.results import Category, Status
from mi_refract.image_diff.settings import Entry, Settings
from mi_refract.io.image_file import Image, read, write_exr

RGB, XYZ = channels.RGB, channels.XYZ
BESIDE = {"variance": "{stem}_var.exr", "spp_reference": 64, "spp_test": 16}
SHAPE = (32, 48, 3)
MEAN = np.linspace(0.2, 1.0, 48)[None, :, None] * (0.4, 1.0, 0.7) * np.ones(SHAPE)


def image(pixels, names=RGB, **more):
    return Image(Path("a.exr"), np.asarray(pixels, np.float32), tuple(names), **more)


def settings(**values):
    return Settings(rules=(Entry("*", values),))


def samples(seed, spp, gain=1.0, shape=25.0):
    """Samples of a colour that is the same for all channels but for its strength, as light of one lamp is.

    Their variance is 1/`shape` of the squared mean.
    """
    light = np.random.default_rng(seed).gamma(shape, 1 / shape, (spp, *SHAPE[:2], 1))
    return gain * MEAN * light


def moments(drawn, colours=RGB, layer="nested", extra=()):
    """A film as Mitsuba's `moment` integrator writes it: its colours, and the moments of X, Y and Z.

    `extra`: names of other channels that the nested integrator writes, which hold a mask.
    """
    xyz = drawn @ channels.TO_XYZ.T
    film = {RGB: drawn, XYZ: xyz, ("Y",): xyz[..., 1:2], (*RGB, "A"): np.concatenate([drawn, drawn[..., :1] > 0], -1)}
    parts = {name: film[colours][..., i].mean(0) for i, name in enumerate(colours)}
    for i, name in enumerate(XYZ):
        parts |= {f"{layer}.{name}": xyz[..., i].mean(0), f"m2_{layer}.{name}": np.square(xyz[..., i]).mean(0)}
    for name in extra:
        parts |= {f"{layer}.{name}": drawn[..., 0].mean(0), f"m2_{layer}.{name}": np.square(drawn[..., 0]).mean(0)}
    return image(np.stack(list(parts.values()), -1), parts)


def as_mitsuba_writes(folder, drawn):
    """Mean and variance of X, Y and Z, both converted to R, G, B, as test_renders.py does. The variance."""
    xyz = drawn @ channels.TO_XYZ.T
    variance, to_rgb = xyz.var(0), np.linalg.inv(channels.TO_XYZ).T
    write_exr(folder / "a.exr", xyz.mean(0) @ to_rgb)
    write_exr(folder / "a_var.exr", variance @ to_rgb)
    return variance


@pytest.fixture
def pair(tmp_path):
    """A reference of 64 samples with its variance, and a new image of 16 without."""
    (tmp_path / "old").mkdir()
    (tmp_path / "new").mkdir()
    drawn = samples(1, 64)
    write_exr(tmp_path / "old/a.exr", drawn.mean(0))
    write_exr(tmp_path / "old/a_var.exr", drawn.var(0, ddof=1))
    write_exr(tmp_path / "new/a.exr", samples(2, 16).mean(0))
    return tmp_path / "old", tmp_path / "new"


def one(results):
    (found,) = results.results
    return found


# Files ------------------------------------------------------------------------------------------------------------


def test_a_file_says_what_channels_would(tmp_path, pair):
    """Of both sides: the same numbers as channels "R.variance" in the images themselves."""
    drawn = samples(2, 16)
    write_exr(pair[1] / "a_var.exr", drawn.var(0, ddof=1))
    found = one(folders.diff(*pair, settings(**BESIDE), maps=True))
    whole = [
        image(np.dstack([each.mean(0), each.var(0, ddof=1)]), (*RGB, *(f"{name}.variance" for name in RGB)))
        for each in (samples(1, 64), drawn)
    ]
    expected = compare("welch", *whole, spp_reference=64, spp_test=16)
    assert (found.comparison.method, found.status) == ("welch", Status.EQUAL)
    assert found.comparison.reason == expected.reason
    assert [each.value for each in found.comparison.metrics] == [each.value for each in expected.metrics]


def test_one_side_is_enough_and_its_file_is_no_image_of_its_own(pair):
    found = one(folders.diff(*pair, settings(**BESIDE)))
    assert (found.name, found.comparison.method, found.status) == ("a.exr", "welch", Status.EQUAL)
    write_exr(pair[1] / "a.exr", samples(3, 16, gain=1.1).mean(0))
    assert one(folders.diff(*pair, settings(**BESIDE))).status is Status.DIFFERENT
    file = pair[0] / "a.exr", pair[1] / "a.exr"
    assert one(folders.diff(*file, settings(**BESIDE))).status is Status.DIFFERENT


def test_without_the_setting_the_file_is_an_image(pair):
    found = {each.name: each for each in folders.diff(*pair).results}
    assert found["a_var.exr"].category is Category.REMOVED


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


def test_files_elsewhere_and_maps(tmp_path, pair):
    old, new = pair
    (old / "noise").mkdir()
    (old / "a_var.exr").rename(old / "noise/a.exr")
    given = BESIDE | {"variance": "{root}/noise/{name}"}
    assert one(folders.diff(old, new, settings(**given))).status is Status.EQUAL
    results = folders.diff(old, new, Settings.for_all(variance=given["variance"], spp=16))
    assert results.reproduce(one(results)) == f"mi-refract diff {old} {new} a.exr"  # of two files, {root} is another


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


def test_a_file_of_one_channel_is_for_an_image_of_one(tmp_path):
    for side, seed in (("old", 1), ("new", 2)):
        (tmp_path / side).mkdir()
        drawn = samples(seed, 16)[..., :1]
        write_exr(tmp_path / side / "a.exr", drawn.mean(0), ("Y",))
        write_exr(tmp_path / side / "a_var.exr", drawn.var(0, ddof=1), ("V",))
    found = one(folders.diff(tmp_path / "old", tmp_path / "new", settings(variance="{stem}_var.exr", spp=16)))
    assert (found.comparison.method, found.status) == ("welch", Status.EQUAL)


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


def _write(end, pixels, names=RGB):
    return lambda old: write_exr(old / f"a{end}.exr", pixels, names)


HOLE = np.where(np.arange(SHAPE[1])[None, :, None] == 7, np.nan, np.ones(SHAPE))
BAD = {
    "missing": (lambda old: (old / "a_var.exr").unlink(), {}, "a_var.exr: no such file"),
    "negative": (_write("_var", -np.ones(SHAPE)), {}, "negative in 1536 pixels, the first at x = 0, y = 0"),
    "negative, as a colour": (_write("_var", -np.ones(SHAPE)), {}, "channels = ['X', 'Y', 'Z']"),
    "other size": (_write("_var", np.ones((8, 9, 3))), {}, "9 × 8; expected a variance of 48 × 32"),
    "NaN": (_write("_var", HOLE), {}, "its variance of R is not finite at x = 7, y = 0"),
    "other channels": (_write("_var", np.ones(SHAPE), ("U", "V", "W")), {}, "variances of U, V, W; expected of chann"),
    "no image": (lambda old: (old / "a_var.exr").write_bytes(b"xy"), {}, "a_var.exr: corrupt EXR file"),
    "itself": (lambda old: None, {"variance": "{name}"}, "itself; expected the name of another image"),
    "1 sample": (lambda old: None, {"spp_test": 1}, "samples per pixel: 1; expected `spp` or `spp_test`, 2 to 10¹⁵"),
    "-3 samples": (
        lambda old: None,
        {"spp_reference": -3},
        "samples per pixel: -3; expected `spp` or `spp_reference`",
    ),
    "no samples": (lambda old: None, {"spp_test": 0}, "names 'no samples per pixel'; expected `spp` or `spp_test`"),
    "no such channel": (lambda old: None, {"channels": (("Q", "Q"),)}, "no channel 'Q'; in `channels` expected R, G"),
}


@pytest.mark.parametrize(("change", "values", "message"), BAD.values(), ids=BAD)
def test_what_cannot_be_used_is_one_line_and_the_others_are_compared(pair, change, values, message):
    old, new = pair
    for folder, end in ((old, ""), (old, "_var"), (new, "")):
        (folder / f"b{end}.exr").write_bytes((folder / f"a{end}.exr").read_bytes())
    change(old)
    rules = Entry("*", BESIDE), Entry("a.exr", values)
    results = folders.diff(old, new, Settings(rules=rules))
    found = {each.name: each for each in results.results}
    assert results.exit_code == 2
    assert message in found["a.exr"].error
    assert "\n" not in found["a.exr"].error
    assert found["b.exr"].status is Status.EQUAL


def test_rounding_below_zero_is_none():
    """m2 − m² of a constant in single precision."""
    known = {name: np.full(SHAPE[:2], -1e-7) for name in RGB}
    sides = image(MEAN, variances=known), image(MEAN, variances=known)
    assert compare("auto", *sides, spp=16).verdict is Verdict.EQUAL


def test_infinite_squares_cannot_be_compared():
    pixels = moments(samples(1, 8))
    pixels.pixels[2, 3, pixels.channels.index("m2_nested.Y")] = np.inf
    with pytest.raises(ValueError, match=r"variance of Y is not finite at x = 3, y = 2"):
        compare("auto", pixels, moments(samples(2, 8)), spp=8)


# Mitsuba's films --------------------------------------------------------------------------------------------------

FILMS = {
    "the same": (moments(samples(1, 16)), moments(samples(2, 16))),
    "an integrator without a name": (moments(samples(1, 16)), moments(samples(2, 16), layer="_arg_0")),
    "film of X, Y, Z": (moments(samples(1, 16)), moments(samples(2, 16), XYZ)),
    "film of Y": (moments(samples(1, 16), ("Y",)), moments(samples(2, 16), ("Y",))),
    "with alpha": (moments(samples(1, 16), (*RGB, "A")), moments(samples(2, 16), (*RGB, "A"), "_arg_0")),
    "with others": (moments(samples(1, 16), extra=["dd.y.T"]), moments(samples(2, 16), layer="b", extra=["dd.y.T"])),
    "R, G, B": (moments(samples(1, 16)), image(samples(2, 16).mean(0))),
    "R, G, B first": (image(samples(1, 16).mean(0)), moments(samples(2, 16), layer="_arg_0")),
    "X, Y, Z": (moments(samples(1, 16)), image(samples(2, 16).mean(0) @ channels.TO_XYZ.T, XYZ)),
    "in halves": (
        moments(samples(1, 16)),
        replace(x := moments(samples(2, 16), layer="b"), pixels=x.pixels.astype(np.float16).astype(np.float32)),
    ),
}


@pytest.mark.parametrize(("reference", "test"), FILMS.values(), ids=FILMS)
def test_films_are_recognised(reference, test):
    """An equal one is equal, nothing of it untested; and one that is brighter everywhere is different."""
    assert choice([reference], [test])[0] == "welch"
    found = compare("auto", reference, test, spp=16)
    assert found.verdict is Verdict.EQUAL, found.reason
    wanted = {name for name in (*reference.channels, *test.channels) if "m2" in name}
    squared = [1.1**2 if name in wanted else 1.0 if name == "A" else 1.1 for name in test.channels]
    brighter = replace(test, pixels=test.pixels * np.float32(squared))
    assert compare("auto", reference, brighter, spp=16).verdict is Verdict.DIFFERENT


def test_an_alpha_has_at_most_the_variance_of_a_coin():
    """One of a half is equal to another of as many samples, and not to one of 0.4."""
    reference, test, other = (moments(samples(seed, 64), (*RGB, "A")) for seed in (1, 2, 3))
    for each, share, seed in ((reference, 0.5, 4), (test, 0.5, 5), (other, 0.4, 6)):
        each.pixels[..., 3] = np.random.default_rng(seed).binomial(64, share, SHAPE[:2]) / 64
    how = {"spp": 64, "resolution": 0.2}
    assert compare("auto", reference, test, **how).verdict is Verdict.EQUAL
    assert compare("auto", reference, other, **how).verdict is Verdict.DIFFERENT
    reference.pixels[..., 3], other.pixels[..., 3] = 2.0, 2.5  # no alpha: nothing bounds the variance
    assert "without variance: A" in compare("auto", reference, other, **how).reason


def test_the_order_of_channels_does_not_matter():
    reference, test = moments(samples(1, 16)), moments(samples(2, 16), layer="b")
    mixed = replace(test, pixels=test.pixels[..., ::-1], channels=test.channels[::-1])
    assert compare("auto", reference, mixed, spp=16).metrics == compare("auto", reference, test, spp=16).metrics


def test_colours_that_do_not_repeat_the_moments_are_compared_themselves():
    """A film whose conversion to R, G, B is broken, beside moments that are right."""
    reference, test = moments(samples(1, 16)), moments(samples(2, 16))
    test.pixels[..., 2] *= 1.01
    found = compare("auto", reference, test, spp=16)
    assert (found.verdict, found.reason[:30]) == (Verdict.INCONCLUSIVE, "not tested, without variance: ")


def test_nan_is_found_in_films_that_are_not_the_same():
    reference = moments(samples(1, 16))
    for test in (image(samples(2, 16).mean(0)), moments(samples(2, 16), layer="b")):
        test.pixels[5, 6] = np.nan
        found = compare("auto", reference, test, spp=16)
        assert (found.verdict, "x = 6, y = 5" in found.reason) == (Verdict.DIFFERENT, True)


def test_what_one_side_alone_has_is_no_silence():
    """An output that the new image lost is not left out unasked; the message says what to set."""
    reference, test = moments(samples(1, 16), extra=["depth"]), moments(samples(2, 16))
    with pytest.raises(ValueError, match="or `channels`: those to compare"):
        compare("auto", reference, test, spp=16)
    names = tuple((name, name) for name in ("nested.X", "nested.Y", "nested.Z"))
    sides = (channels.chosen([each], names, side)[0] for side, each in enumerate((reference, test)))
    assert compare("auto", *sides, spp=16).verdict is Verdict.EQUAL


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
    variance = as_mitsuba_writes(old, red)
    write_exr(new / "a.exr", other.mean(0))
    assert "negative" in one(folders.diff(old, new, settings(**BESIDE))).error
    how = BESIDE | {"resolution": 0.2}
    found = one(folders.diff(old, new, settings(**how, channels=tuple(zip(XYZ, XYZ, strict=True))), maps=True))
    assert found.status is Status.EQUAL
    direct = [image(read(each / "a.exr").pixels @ channels.TO_XYZ.T, XYZ) for each in (old, new)]
    direct[0] = replace(direct[0], variances=dict(zip(XYZ, np.moveaxis(variance, -1, 0), strict=True)))
    expected = compare("welch", *direct, spp_reference=64, spp_test=16)
    assert found.comparison.minimum_detectable == pytest.approx(expected.minimum_detectable, rel=1e-4)


def test_a_variance_of_other_colours_than_the_image_is_one_of_x_y_z(pair):
    drawn = samples(1, 64)
    write_exr(pair[0] / "a_var.exr", (drawn @ channels.TO_XYZ.T).var(0, ddof=1), XYZ)
    assert one(folders.diff(*pair, settings(**BESIDE))).status is Status.EQUAL


def test_channels_by_their_names_on_both_sides(tmp_path):
    reference, test = samples(1, 16), samples(2, 16)
    sides = image(reference.mean(0), ("R", "G", "b.B")), image(test.mean(0), ("a.R", "G", "B"))
    names = (("R", "a.R"), ("b.B", "B"))
    found = [channels.chosen([each], names, side)[0] for side, each in enumerate(sides)]
    assert [each.channels for each in found] == [("R", "b.B")] * 2
    np.testing.assert_array_equal(found[1].pixels, sides[1].pixels[..., [0, 2]])


def test_channels_of_every_method(pair):
    old, new = pair
    (old / "a_var.exr").unlink()  # an image of its own where no variance is read
    for method in ("exact", "tolerance"):
        pixels = read(old / "a.exr").pixels.copy()
        pixels[..., 2] *= 3
        write_exr(new / "a.exr", pixels)
        how = {"method": method}
        assert one(folders.diff(old, new, settings(**how))).status is Status.DIFFERENT
        names = (("R", "R"), ("G", "G"))
        assert one(folders.diff(old, new, settings(**how, channels=names))).status is Status.EQUAL


# Settings ---------------------------------------------------------------------------------------------------------


def test_check_settings_shows_them(pair):
    from rich.console import Console

    pairs = pairing.pairs(*pair, settings(**BESIDE, channels=(("X", "a.X"), ("Y", "Y"))))
    console = Console(width=200)
    with console.capture() as shown:
        console.print(text_reports.settings_table(pairs))
    assert "spp_reference=64, spp_test=16, variance {stem}_var.exr, channels X=a.X,Y" in shown.get()


# Variances of some channels ----------------------------------------------------------------------------------------


def test_channels_without_variance_are_not_equal_unseen():
    """`variance` for R only: G is black and B tripled."""

    def side(seed, *gains):
        drawn = samples(seed, 16)
        pixels = np.dstack([drawn.mean(0) * gains, drawn[..., 0].var(0, ddof=1)])
        return image(pixels, ("R", "G", "B", "R.variance"), metadata={"mi_refract:spp": 16})

    reference, test = side(1, 1, 1, 1), side(2, 1, 0, 3)
    found = compare("auto", reference, test)
    assert (found.method, found.verdict) == ("welch", Verdict.INCONCLUSIVE)
    assert found.reason.startswith("not tested, without variance: G, B")
    test.pixels[..., 1:3] = reference.pixels[..., 1:3]
    assert compare("auto", reference, test).verdict is Verdict.EQUAL
    reference.pixels[..., 1:3] *= 0.003  # dim, and black in the other: `tolerance` alone would pass that
    test.pixels[..., 1:3] = 0
    assert compare("auto", reference, test).verdict is Verdict.INCONCLUSIVE
