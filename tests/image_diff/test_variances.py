"""Images with known noise: variances from files and channels, films of `moment`, and the choice of the method."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.diff_images import DIFFERENT, EQUAL, INCONCLUSIVE, of

from mi_refract.image_diff import accept, channels, folders, html_report, pairing, results_file, self_test, text_reports
from mi_refract.image_diff.channels import AREA, FILTER, FREEDOM, SPP
from mi_refract.image_diff.methods import METHODS, choice, compare
from mi_refract.image_diff.results import Category, Status
from mi_refract.image_diff.settings import Entry, Settings, load
from mi_refract.io.image_file import read, write_exr
from mi_refract.io.reference_pack import origin

RGB, XYZ = channels.RGB, channels.XYZ
BESIDE = {"variance": "{stem}_var.exr", "spp_reference": 64, "spp_test": 16}
SHAPE = (32, 48, 3)
MEAN = np.linspace(0.2, 1.0, 48)[None, :, None] * (0.4, 1.0, 0.7) * np.ones(SHAPE)
BOTH = "the variance of both is known"


def samples(seed, spp, gain=1.0, shape=25.0):
    """Samples whose channels are proportional to each other, like light of one lamp.

    Their variance is 1/`shape` of the squared mean.
    """
    return gain * MEAN * np.random.default_rng(seed).gamma(shape, 1 / shape, (spp, *SHAPE[:2], 1))


def film(seed, passes=8, per_pass=4, names=RGB, gain=1.0, shape=100.0):
    """A film as of `mi-refract render`, with the variance of a sample, estimated from the spread between passes."""
    means = samples(seed, passes, gain, shape)[..., : len(names)]
    pixels = np.concatenate([means.mean(0), means.var(0, ddof=1) * per_pass], -1)
    header = {SPP: passes * per_pass, FREEDOM: passes - 1}
    return of(pixels, (*names, *(f"{name}.variance" for name in names)), metadata=header)


def bare(image):
    return replace(image, pixels=image.select(RGB), channels=RGB)


def beside(drawn):
    """The mean of samples, with their variance as from a separate file."""
    return replace(of(drawn.mean(0)), variances=dict(zip(RGB, np.moveaxis(drawn.var(0, ddof=1), -1, 0), strict=True)))


def written(path, image):
    path.parent.mkdir(exist_ok=True)
    header = {key: value for key, value in image.metadata.items() if key in (SPP, FREEDOM)}
    write_exr(path, image.pixels, image.channels, header)
    if image.variances:
        write_exr(path.with_stem(f"{path.stem}_var"), np.stack([*image.variances.values()], -1), [*image.variances])


@pytest.fixture
def pair(tmp_path):
    """A reference of 64 samples with its variance in a file beside it, and a new image of 16 without."""
    written(tmp_path / "old/a.exr", beside(samples(1, 64)))
    written(tmp_path / "new/a.exr", of(samples(2, 16).mean(0)))
    return tmp_path / "old", tmp_path / "new"


@pytest.fixture
def films(tmp_path):
    """Folders of references and new images: "same.exr" with other seeds, "off.exr" 1.5 times as bright."""
    for seed, (name, gain) in enumerate((("same.exr", 1.0), ("off.exr", 1.5))):
        written(tmp_path / "old" / name, film(seed))
        written(tmp_path / "new" / name, film(10 + seed, gain=gain))
    return tmp_path / "old", tmp_path / "new"


def one(*sides, maps=False, **values):
    """The only result of a comparison with these settings."""
    (result,) = folders.diff(*sides, Settings(rules=(Entry("*", values),)), maps=maps).results
    return result


# Files ------------------------------------------------------------------------------------------------------------


def test_a_file_with_variances_is_equivalent_to_channels(pair):
    """On one side or on both. The file is compared as an image only if the settings do not name it."""
    old, new = pair
    result = one(old, new, **BESIDE)
    assert (result.name, result.comparison.method, result.status) == ("a.exr", "welch", Status.EQUAL)
    assert {x.name: x.category for x in folders.diff(old, new).results}["a_var.exr"] is Category.REMOVED
    written(new / "a.exr", beside(samples(2, 16)))
    result, names = one(old, new, **BESIDE), (*RGB, *(f"{name}.variance" for name in RGB))
    whole = [of(np.dstack([x.mean(0), x.var(0, ddof=1)]), names) for x in (samples(1, 64), samples(2, 16))]
    expected = compare("welch", *whole, spp_reference=64, spp_test=16)
    assert (result.status, result.reason) == (Status.EQUAL, expected.reason)
    assert [metric.value for metric in result.comparison.metrics] == [metric.value for metric in expected.metrics]
    written(new / "a.exr", of(samples(3, 16, gain=1.1).mean(0)))
    (new / "a_var.exr").unlink()
    for sides in (pair, (old / "a.exr", new / "a.exr")):
        assert one(*sides, **BESIDE).status is Status.DIFFERENT


def test_variances_in_other_folders_of_xyz_and_with_masks(pair):
    """`tolerance` neither reads nor compares them."""
    old, new = pair
    assert one(*pair, variance="{stem}_var.exr", method="tolerance", fail=1.0).comparison.method == "tolerance"
    (old / "noise").mkdir()
    (old / "a_var.exr").rename(old / "noise/a.exr")
    assert one(*pair, **BESIDE | {"variance": "{root}/noise/{name}"}).status is Status.EQUAL
    result = one(old / "a.exr", new / "a.exr", variance="{stem}_var.exr", method="tolerance", fail=1.0)
    assert result.comparison.method == "tolerance"
    variance = (samples(1, 64) @ channels.TO_XYZ.T).var(0, ddof=1)
    write_exr(old / "a_var.exr", variance, XYZ)
    assert one(old / "a.exr", new / "a.exr", **BESIDE).status is Status.EQUAL
    variance[:8, :8] = 1e9
    write_exr(old / "a_var.exr", variance, XYZ)
    sides = old / "a.exr", new / "a.exr"
    hidden = [one(*sides, **BESIDE, ignore=ignore).status for ignore in ((), ((0, 0, 8, 8),))]
    assert hidden == [Status.INCONCLUSIVE, Status.EQUAL]


def test_two_renders_need_no_variance_beside_them(tmp_path):
    """It is no error, though two tell too little of their noise."""
    for seed, side in enumerate(("old", "new")):
        (tmp_path / side).mkdir()
        for i in range(2):
            write_exr(tmp_path / side / f"{i}.exr", samples(2 * seed + i, 16).mean(0), RGB)
    sides = tmp_path / "old", tmp_path / "new"
    settings = Settings(rules=(Entry("*", BESIDE),))
    (result,) = folders.diff(*sides, settings, renders=True).results
    assert result.status is Status.INCONCLUSIVE


@pytest.mark.parametrize("count", [1, 3])
def test_variances_and_masks_in_folders_of_renders_are_no_renders(tmp_path, count):
    for side, gain, first in (("old", 1.0, 0), ("new", 1.2, 10)):
        for i in range(count):
            written(tmp_path / side / f"{i}.exr", beside(samples(first + i, 64, gain)))
    write_exr(tmp_path / "old/mask.exr", np.ones(SHAPE))
    values = {"variance": "{stem}_var.exr", "mask": "{root}/mask.exr", "spp": 64}
    (result,) = folders.diff(
        tmp_path / "old", tmp_path / "new", Settings.for_all(**values), renders=True, maps=True
    ).results
    assert result.reason.startswith("20 % brighter")
    assert result.images["reference"].pixels.mean() == pytest.approx(MEAN.mean(), rel=0.01)


def test_variants_have_separate_variances(pair):
    """And the files of variances and masks are not variants, also if their settings are those of one image."""
    old, new = pair
    for end in ("", "_var"):
        (old / f"a{end}.exr").rename(old / f"a-2{end}.exr")
    written(old / "a.exr", beside(samples(4, 64, gain=1.5)))
    (old / "a_var.exr").rename(old / "a-var.exr")
    (old / "a-2_var.exr").rename(old / "a-2-var.exr")
    write_exr(old / "a-mask.exr", np.ones(SHAPE))
    how = BESIDE | {"variance": "{stem}-var.exr", "mask": "{stem}-mask.exr", "accept": ("{stem}-*.exr",)}
    for pattern, *sides in (("*", old, new), ("a.exr", old, new), ("a.exr", old / "a.exr", new / "a.exr")):
        (result,) = folders.diff(*sides, Settings(rules=(Entry(pattern, how),))).results
        assert (result.status, result.matched, result.variants) == (Status.EQUAL, old / "a-2.exr", (old / "a-2.exr",))


@pytest.mark.parametrize(("named", "freedom"), [({FREEDOM: 5}, 5), ({}, 7)])
def test_a_variance_of_one_channel_and_its_degrees_of_freedom(tmp_path, named, freedom):
    for side, value in (("old", 1.0), ("new", 3.0)):
        (tmp_path / side).mkdir()
        write_exr(tmp_path / side / "a.exr", [[[value]]], ("Y",), {SPP: 1000, FREEDOM: 7})
        write_exr(tmp_path / side / "a_var.exr", [[[250.0]]], ("V",), named)
    how = {"variance": "{stem}_var.exr", "equivalence_margin": 0.0, "maps": True}
    p = 2 * stats.t.sf(2 / np.sqrt(0.5), 2 * freedom)
    assert one(tmp_path / "old", tmp_path / "new", **how).comparison.maps["p"].item() == pytest.approx(p, rel=1e-5)


@pytest.mark.parametrize(
    ("of_image", "of_file", "shared"),
    [
        ({FILTER: 2.0}, {FREEDOM: 5, FILTER: 0.5}, 1.0),
        ({AREA: 9.0}, {FREEDOM: 5, AREA: 4.0}, 4.0),
        ({FILTER: 0.5}, {FREEDOM: 5}, None),
        ({FILTER: 0.5}, {FILTER: 4.0}, 1.0),
    ],
)
def test_degrees_of_freedom_in_a_file_replace_the_filter_of_its_image_as_well(of_image, of_file, shared):
    image, variance = (of(np.ones((4, 4, 1)), metadata=header) for header in (of_image, of_file))
    estimate, _ = channels.estimates(channels.with_file(image, variance), image, (64, 64))
    assert estimate.shared == shared


@pytest.mark.parametrize("values", [BESIDE, {"variance": BESIDE["variance"], "method": "tolerance"}])
def test_a_variance_is_accepted_with_its_image(pair, values):
    """Otherwise the reference would have the variance of another render from then on."""
    old, new = pair
    how = Settings(rules=(Entry("*", values),))
    drawn = samples(3, 16, gain=1.2)
    written(new / "a.exr", of(drawn.mean(0)))
    compared = folders.diff(old, new, how, to_accept=True)
    with pytest.raises(ValueError, match=r"new/a_var.exr: no such file, and .*belongs to a different render"):
        list(accept.changes(compared))
    before = (new / "a.exr").read_bytes()
    written(new / "a.exr", beside(drawn))
    (new / "a.exr").write_bytes(before)  # because the header contains the time
    with pytest.raises(OSError, match=r"new/a_var\.exr: changed since it was compared"):  # it did not exist then
        accept.Acceptance(list(accept.changes(compared))).run()
    accept.Acceptance(list(accept.changes(folders.diff(old, new, how, to_accept=True)))).run()
    for name in ("a.exr", "a_var.exr"):
        assert (old / name).read_bytes() == (new / name).read_bytes()


@pytest.mark.parametrize("method", ["auto", "welch", "tolerance"])
def test_images_with_variance_files_cannot_be_accepted_by_json(pair, method):
    """The JSON has no digest of the variance."""
    values = {"method": method, "variance": "{stem}_var.exr"} | ({} if method == "tolerance" else {"spp": 16})
    written(pair[1] / "a.exr", of(samples(3, 16, gain=1.5).mean(0)))
    how, file = Settings(rules=(Entry("*", values),)), pair[0].parent / "out.json"
    results_file.write(folders.diff(*pair, how, to_accept=True), origin([], None), data=file)
    for now in (how, Settings.for_all(method="tolerance")):
        with pytest.raises(ValueError, match="JSON has no digest of such files; accept it without --from"):
            results_file.with_settings(results_file.read(file), now)


# Bad input --------------------------------------------------------------------------------------------------------


def _write(end, pixels, names=RGB, **header):
    return lambda old: write_exr(old / f"a{end}.exr", pixels, names, header)


HOLE = np.where(np.arange(SHAPE[1])[None, :, None] == 7, np.nan, np.ones(SHAPE))
NEGATIVE = _write("_var", -np.ones(SHAPE))
BAD = [  # a change, settings, and part of the error
    (lambda old: (old / "a_var.exr").unlink(), {}, "a_var.exr: no such file"),
    (NEGATIVE, {}, "negative in 1536 pixels, the first at x = 0, y = 0"),
    (NEGATIVE, {}, "channels = ['X', 'Y', 'Z']"),
    (_write("_var", np.ones((8, 9, 3))), {}, "9 × 8; expected a variance image of 48 × 32"),
    (_write("_var", HOLE), {}, "its variance of R is not finite at x = 7, y = 0"),
    (_write("_var", np.ones(SHAPE), "UVW"), {}, "variances of channels U, V, W; expected chann"),
    (lambda old: (old / "a_var.exr").write_bytes(b"xy"), {}, "a_var.exr: corrupt EXR file"),
    (lambda old: None, {"variance": "{name}"}, "itself; expected another image"),
    (lambda old: None, {"spp_test": 1}, "samples per pixel: 1; expected `spp` or `spp_test`, 2 to 10¹⁵"),
    (lambda old: None, {"spp_reference": -3}, "spp_reference = -3; expected a number of at least 0"),
    (lambda old: None, {"spp_test": 0}, "samples per pixel in its header: none; expected `spp` or `spp_test`"),
    (lambda old: None, {"channels": (("Q", "Q"),)}, "no channel 'Q'; in `channels` expected R, G"),
    (lambda old: None, {"channels": (("R", "R"), ("Z", "Z"))}, "no channel 'Z'; in `channels` expected R, G"),
    *(
        (_write("", MEAN, **{FREEDOM: named}), {}, "; expected a whole number, 1 to 10¹⁵")
        for named in (0, -1, 2.5, "many", "7\n8", float("nan"), 10**16)
    ),
]


@pytest.mark.parametrize(("change", "values", "message"), BAD)
def test_invalid_variances_are_errors_in_one_line_of_their_image(pair, change, values, message):
    old, new = pair
    for folder, end in ((old, ""), (old, "_var"), (new, "")):
        (folder / f"b{end}.exr").write_bytes((folder / f"a{end}.exr").read_bytes())
    change(old)
    results = folders.diff(old, new, Settings(rules=(Entry("*", BESIDE), Entry("a.exr", values))))
    by_name = {result.name: result for result in results.results}
    assert results.exit_code == 2
    assert message in by_name["a.exr"].error and "\n" not in by_name["a.exr"].error
    assert by_name["b.exr"].status is Status.EQUAL


# Mitsuba's films --------------------------------------------------------------------------------------------------


def moments(seed, colours=RGB, layer="nested", extra=(), spp=16):
    """A film as of Mitsuba's `moment` integrator: its colours, and the moments of X, Y and Z.

    `extra`: names of other channels that the nested integrator writes.
    """
    rgb = samples(seed, spp)
    xyz = rgb @ channels.TO_XYZ.T
    films = {RGB: rgb, XYZ: xyz, ("Y",): xyz[..., 1:2], (*RGB, "A"): np.concatenate([rgb, rgb[..., :1] > 0], -1)}
    planes = {name: films[colours][..., i].mean(0) for i, name in enumerate(colours)}
    for name, x in (*zip(XYZ, np.moveaxis(xyz, -1, 0), strict=True), *((name, rgb[..., 0]) for name in extra)):
        planes |= {f"{layer}.{name}": x.mean(0), f"m2_{layer}.{name}": np.square(x).mean(0)}
    return of(np.stack(list(planes.values()), -1), tuple(planes))


RGBA = (*RGB, "A")
FILMS = {
    "the same": (moments(1), moments(2)),
    "an integrator without a name": (moments(1), moments(2, layer="_arg_0")),
    "film of X, Y, Z": (moments(1), moments(2, XYZ)),
    "film of Y": (moments(1, ("Y",)), moments(2, ("Y",))),
    "with alpha": (moments(1, RGBA), moments(2, RGBA, "_arg_0")),
    "with others": (moments(1, extra=["dd.y.T"]), moments(2, layer="b", extra=["dd.y.T"])),
    "R, G, B": (moments(1), bare(moments(2))),
    "R, G, B first": (bare(moments(1)), moments(2, layer="_arg_0")),
    "X, Y, Z": (moments(1), of(samples(2, 16).mean(0) @ channels.TO_XYZ.T, XYZ)),
    "in halves": (moments(1), replace(x := moments(2, layer="b"), pixels=x.pixels.astype(np.float16).astype("f4"))),
}


@pytest.mark.parametrize(("reference", "test"), FILMS.values(), ids=FILMS)
def test_films_of_moments_are_recognised(reference, test):
    """Equal films are equal without untested channels, in any order of channels; brighter films are different.

    Values that are not finite are reported.
    """
    result = compare("auto", reference, test, spp=16)
    assert (result.method, result.verdict) == ("welch", EQUAL), result.reason
    mixed = replace(test, pixels=test.pixels[..., ::-1], channels=test.channels[::-1])
    assert compare("auto", reference, mixed, spp=16).metrics == result.metrics
    squared = {name for name in (*reference.channels, *test.channels) if "m2" in name}
    gains = [1.1**2 if name in squared else 1.0 if name == "A" else 1.1 for name in test.channels]
    brighter = replace(test, pixels=test.pixels * np.float32(gains))
    assert compare("auto", reference, brighter, spp=16).verdict is DIFFERENT
    brighter.pixels[5, 6] = np.nan
    result = compare("auto", reference, brighter, spp=16)
    assert result.verdict is DIFFERENT and "x = 6, y = 5" in result.reason


def test_films_of_moments_that_cannot_be_compared():
    """Infinite squares, and colours that do not repeat the moments; an output that the new image lacks is different."""
    infinite, broken, test = moments(1), moments(3), moments(2)
    infinite.pixels[2, 3, infinite.channels.index("m2_nested.Y")] = np.inf
    for allowed in (False, True):  # an unknown noise is not one of 0
        with pytest.raises(ValueError, match=r"variance of Y is not finite at x = 3, y = 2"):
            compare("auto", infinite, test, spp=16, allow_nonfinite=allowed)
    broken.pixels[..., 2] *= 1.01  # a wrong conversion to R, G, B beside right moments
    result = compare("auto", test, broken, spp=16)
    assert (result.verdict, result.reason[:30]) == (INCONCLUSIVE, "not tested, without variance: ")
    more = moments(1, extra=["depth"])
    result = compare("auto", more, test, spp=16)
    assert result.verdict is DIFFERENT
    assert result.reason.startswith("channels missing: depth; the other channels: no difference")
    names = {f"nested.{name}": f"nested.{name}" for name in XYZ}
    sides = (channels.selected(image, names) for image in (more, test))
    assert compare("auto", *sides, spp=16).verdict is EQUAL


def test_alpha_has_the_variance_of_a_binary_variable():
    """An alpha of one half is equal to another one with as many samples, and differs from 0.4."""
    reference, test, other = (moments(seed, RGBA, spp=64) for seed in (1, 2, 3))
    for image, share, seed in ((reference, 0.5, 4), (test, 0.5, 5), (other, 0.4, 6)):
        image.pixels[..., 3] = np.random.default_rng(seed).binomial(64, share, SHAPE[:2]) / 64
    how = {"spp": 64, "resolution": 0.2}
    assert compare("auto", reference, test, **how).verdict is EQUAL
    assert compare("auto", reference, other, **how).verdict is DIFFERENT
    reference.pixels[..., 3], other.pixels[..., 3] = 2.0, 2.5  # above 1 the variance is not bounded
    assert "without variance: A" in compare("auto", reference, other, **how).reason


def test_channels_without_variance_are_compared_as_by_auto():
    """One firefly among 6144 pixels, or a small difference; metadata count by the options of the whole comparison."""

    def side(drawn, view):
        pixels = np.dstack([drawn.mean(0)[..., :1], drawn.var(0, ddof=1)[..., :1], MEAN[..., :1]])
        header = {SPP: len(drawn), "view": view}
        return of(np.tile(pixels, (2, 2, 1)), ("R", "R.variance", "albedo"), metadata=header, stored="float")

    reference, test = side(samples(1, 64, shape=100.0), "left"), side(samples(2, 64, shape=100.0), "right")
    assert compare("auto", reference, test, ignore_metadata=["view"]).verdict is EQUAL
    assert compare("auto", reference, test).verdict is DIFFERENT
    test.pixels[5, 6, 2] = 1e6
    result = compare("auto", reference, test, ignore_metadata=["view"])
    assert result.verdict is INCONCLUSIVE and "albedo: one pixel is far too bright" in result.reason
    test.pixels[..., 2] = reference.pixels[..., 2] + np.float32(0.003)
    for options, verdict in (({}, EQUAL), ({"fail": 0.001}, INCONCLUSIVE)):
        assert compare("auto", reference, test, ignore_metadata=["view"], **options).verdict is verdict


def test_differences_in_channels_without_variance_are_inconclusive():
    """The variance is known for R only; G is black and B tripled."""

    def side(seed, *gains):
        drawn = samples(seed, 16)
        pixels = np.dstack([drawn.mean(0) * gains, drawn[..., 0].var(0, ddof=1)])
        return of(pixels, (*RGB, "R.variance"), metadata={SPP: 16})

    reference, test = side(1, 1, 1, 1), side(2, 1, 0, 3)
    result = compare("auto", reference, test)
    assert (result.method, result.verdict) == ("welch", INCONCLUSIVE)
    assert result.reason.startswith("not tested, without variance: G, B")
    test.pixels[..., 1:3] = reference.pixels[..., 1:3]
    assert compare("auto", reference, test).verdict is EQUAL
    reference.pixels[..., 1:3] *= 0.003  # dim, and black in the other image, which `fail` alone would accept
    test.pixels[..., 1:3] = 0
    assert compare("auto", reference, test).verdict is INCONCLUSIVE


@pytest.mark.parametrize("form", ["m2_{}", "{}.m2", "variance.{}", "img.m2_{}"])
def test_names_of_channels_of_variances_and_moments(form):
    name = "img.nested.X" if form.startswith("img") else "nested.X"
    spread = form.format("nested.X")
    assert channels.spreads([name, spread]) == {name: (spread, "m2" in form)}
    assert channels.means([name, spread, "A"]) == [name, "A"]


def test_mitsuba_writes_the_expected_channel_names(tmp_path):
    """The films above imitate these of the installed Mitsuba."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    path = {"type": "path"}
    aov = {"type": "aov", "aovs": "dd.y:depth", "img": path}
    film = {"type": "hdrfilm", "width": 4, "height": 3, "component_format": "float32"}
    for integrator, layer, more in (
        ({"type": "moment", "_arg_0": path}, "_arg_0", set()),
        ({"type": "moment", "nested": aov}, "nested", {"nested.dd.y.T", "m2_nested.dd.y.T"}),
        ({"type": "aov", "aovs": "dd.y:depth", "img": {"type": "moment", "nested": path}}, "img.nested", {"dd.y.T"}),
    ):
        sensor = {"type": "perspective", "film": film}
        scene = mi.load_dict({"type": "scene", "i": integrator, "s": sensor, "e": {"type": "constant"}})
        mi.render(scene, spp=2)
        scene.sensors()[0].film().bitmap().write(str(tmp_path / "a.exr"))
        image = read(tmp_path / "a.exr")
        assert channels.moment_layer(image) == layer
        assert {*RGB, *(f"{layer}.{name}" for name in XYZ), *more} <= set(image.channels)


# Channels ---------------------------------------------------------------------------------------------------------


def test_variances_of_mitsubas_test_data_are_compared_as_xyz(tmp_path):
    """Variances of X, Y, Z that were converted to R, G, B can be negative; converted back to X, Y, Z they are right."""
    red, other = (samples(seed, spp, shape=4.0) * (1.0, 0.05, 0.02) for seed, spp in ((1, 64), (2, 16)))
    # Mean and variance of X, Y and Z, both converted to R, G, B, as in Mitsuba's test_renders.py.
    xyz, to_rgb = red @ channels.TO_XYZ.T, np.linalg.inv(channels.TO_XYZ).T
    variance = dict(zip(RGB, np.moveaxis(xyz.var(0) @ to_rgb, -1, 0), strict=True))
    written(tmp_path / "old/a.exr", of(xyz.mean(0) @ to_rgb, variances=variance))
    written(tmp_path / "new/a.exr", of(other.mean(0)))
    sides = tmp_path / "old", tmp_path / "new"
    assert "negative" in one(*sides, **BESIDE).error
    result = one(*sides, **BESIDE, resolution=0.2, channels=tuple(zip(XYZ, XYZ, strict=True)))
    assert result.status is Status.EQUAL
    direct = [of(read(side / "a.exr").pixels @ channels.TO_XYZ.T, XYZ) for side in sides]
    direct[0] = replace(direct[0], variances=dict(zip(XYZ, np.moveaxis(xyz.var(0), -1, 0), strict=True)))
    expected = compare("welch", *direct, spp_reference=64, spp_test=16)
    assert result.comparison.minimum_detectable == pytest.approx(expected.minimum_detectable, rel=1e-4)


@pytest.mark.parametrize("method", ["exact", "tolerance"])
def test_selected_channels_are_compared_by_every_method(pair, films, method):
    """By their names on both sides; variances and second moments only if they are selected."""
    image = read(pair[0] / "a.exr")
    write_exr(pair[1] / "a.exr", image.pixels * (1, 1, 3))
    off = read(films[0] / "off.exr")
    off.pixels[..., off.channels.index("R.variance")] *= 2
    written(films[1] / "off.exr", off)
    write_exr(pair[1] / "turned.exr", image.pixels, ("B", "G", "a.R"))
    write_exr(pair[0] / "turned.exr", image.pixels[..., ::-1], ("R", "G", "b.B"))
    for root, squares in zip(pair, (2, 3), strict=True):
        write_exr(root / "moment.exr", image.pixels * (1, 1, squares), ("G", "R", "m2_R"))
    for path, names, status, end in (
        ("moment.exr", {"R": "R"}, Status.EQUAL, "; not compared: G, m2_R"),
        ("moment.exr", {"R": "R", "m2_R": "m2_R"}, Status.DIFFERENT, "; not compared: G"),
        ("a.exr", {name: name for name in RGB}, Status.DIFFERENT, ""),
        ("a.exr", {"R": "R", "G": "G"}, Status.EQUAL, "; not compared: B"),
        ("off.exr", {"R": "R", "G": "G"}, Status.EQUAL, "; not compared: B"),
        ("off.exr", {"R": "R", "R.variance": "R.variance"}, Status.DIFFERENT, "; not compared: G, B"),
        ("turned.exr", {"R": "a.R", "b.B": "B"}, Status.EQUAL, "; not compared: G"),
    ):
        result = one(pair[0] / path, pair[1] / path, method=method, channels=tuple(names.items()))
        assert result.status is status and result.reason.endswith(end), path


# Films with their own variance -------------------------------------------------------------------------------------


def test_welch_is_chosen_and_reported_for_images_with_variance(films, tmp_path):
    """A method that the settings name is used and reported without a reason. Accepted images keep all channels."""
    results = folders.diff(*films, to_accept=True)
    assert {x.name: x.status for x in results.results} == {"off.exr": Status.DIFFERENT, "same.exr": Status.EQUAL}
    assert {result.method_in_words for result in results.results} == {f"welch ({BOTH})"}
    results_file.write(results, origin([], None), data=tmp_path / "out.json")
    entries = json.loads((tmp_path / "out.json").read_text())["results"]
    assert {(x["method"], x["method_why"]) for x in entries} == {("welch", BOTH)}
    how = Settings(rules=(Entry("*", BESIDE | {"channels": (("X", "a.X"), ("Y", "Y"))}),))
    shown = text_reports.settings_table(pairing.pairs(*films, how))[1][1]
    assert shown.endswith("spp_reference=64, spp_test=16, variance {stem}_var.exr, channels X=a.X,Y")
    path = tmp_path / "a.toml"
    path.write_text('[[image]]\nname = "off.exr"\nmethod = "exact"\nreason = "r"\n')
    named = {x.name: x.comparison.method_in_words for x in folders.diff(*films, load(path)).results}
    assert named == {"off.exr": "exact", "same.exr": f"welch ({BOTH})"}
    copies = list(accept.changes(results))
    assert [copy.reference.name for copy in copies] == ["off.exr"]
    accept.Acceptance(copies).run()
    assert {x.status for x in folders.diff(*films).results} == {Status.EQUAL}


def test_the_method_that_auto_chooses():
    """A render of ours always has its variance; with an image of unknown noise it is compared by `tolerance`."""
    ours, plain = film(1), bare(film(1))
    unknown, theirs = replace(plain, metadata={}), replace(ours, metadata={})
    for sides, how, expected in (
        (([ours], [ours]), {}, ("welch", BOTH)),
        (([ours], [plain]), {}, ("welch", "the variance of the reference is known")),
        (([plain], [ours]), {}, ("welch", "the variance of the new image is known")),
        (([plain] * 2, [plain] * 2), {}, ("welch", "several renders")),
        (([plain], [plain]), {}, ("tolerance", "")),
        (([unknown], [ours]), {}, ("tolerance", "the reference has neither a variance nor samples per pixel")),
        (([ours], [unknown]), {}, ("tolerance", "the new image has neither a variance nor samples per pixel")),
        (([unknown], [ours]), {"spp": True}, ("welch", "the variance of the new image is known")),
        (([unknown], [theirs]), {}, ("welch", "the variance of the new image is known")),
    ):
        assert choice(*sides, **how) == expected
    assert compare("auto", [plain, bare(film(2))], [bare(film(3)), bare(film(4))]).method_in_words.endswith("renders)")


def test_identical_noisy_images_with_variance_are_equal():
    noisy = film(50, passes=2, shape=4.0)
    result = compare("auto", noisy, noisy)
    assert (result.verdict, result.reason) == (EQUAL, "identical in every value, variances included")
    assert all(metric.holds for metric in result.metrics)
    order = [3, 4, 5, 2, 1, 0]
    mixed = replace(noisy, pixels=noisy.pixels[..., order], channels=tuple(noisy.channels[i] for i in order))
    assert compare("auto", noisy, mixed).verdict is EQUAL
    for channel in range(6):  # if one value differs, the noise decides
        other = replace(noisy, pixels=noisy.pixels.copy())
        other.pixels[3, 4, channel] *= 1.0001
        assert compare("auto", noisy, other).verdict is INCONCLUSIVE
    # A variance in a separate file may be that of another render, and for several renders the first is not enough.
    in_files = replace(bare(noisy), variances=dict(zip(RGB, np.moveaxis(noisy.pixels[..., 3:], -1, 0), strict=True)))
    assert compare("auto", in_files, in_files).verdict is INCONCLUSIVE
    low, high = (film(seed, passes=2, gain=gain, shape=4.0) for seed, gain in ((2, 1.0), (3, 9.0)))
    assert compare("welch", [noisy, low], [noisy, high]).verdict is not EQUAL
    noisy.pixels[3, 4, 0] = np.nan  # not equal, even to itself
    assert compare("auto", noisy, noisy).verdict is DIFFERENT
    result = compare("auto", noisy, noisy, allow_nonfinite=True)
    assert result.reason == "identical in every value, variances included; not compared: 1 of 4608 values, not finite"


def test_variances_below_zero_by_rounding_are_accepted():
    """m2 − m² of a constant in single precision."""
    variances = {name: np.full(SHAPE[:2], -1e-7) for name in RGB}
    assert compare("auto", *[of(MEAN, variances=variances)] * 2, spp=16).verdict is EQUAL


@pytest.mark.parametrize("method", [*METHODS, "auto"])
def test_channels_of_variance_are_not_compared(method):
    """Neither different ones, nor those of one side, nor NaN; but NAME.variance without a channel NAME is compared."""
    images = [film(seed) for seed in range(60, 66)]
    other = [replace(image, pixels=image.pixels * ([1] * 3 + [7] * 3)) for image in images]
    if method in ("auto", "welch"):  # several renders, whose spread gives the noise
        assert compare(method, images[:3], other[3:], tile=32, resolution=1.0).verdict is EQUAL
        return
    other[0].pixels[1, 1, 4] = np.nan
    for sides in ((images[0], other[0]), (images[0], bare(images[0])), (bare(images[0]), images[0])):
        assert compare(method, *sides).verdict is EQUAL
    alone = of(np.ones((4, 4, 1)), ("B.variance",))
    assert compare(method, alone, replace(alone, pixels=2 * alone.pixels)).verdict is DIFFERENT


@pytest.mark.parametrize("names", [RGB, ("Y",), ("dd.y.T", "nn.X")])
def test_the_page_and_the_self_test_ignore_channels_of_variance(tmp_path, names):
    for side, gain in (("old", 1.0), ("new", 1.5)):
        written(tmp_path / side / "a.exr", film(70, names=names, gain=gain))
    shown = html_report.shown_of(one(tmp_path / "old", tmp_path / "new", maps=True), 1e6, 1e6)
    assert [pane["role"] for pane in shown.panes][:4] == ["reference", "test", "difference", "flip"]
    assert shown.note == ""
    assert "variance" not in json.dumps(shown.panes)
    image = read(tmp_path / "old/a.exr")
    np.testing.assert_array_equal(self_test.read_images(tmp_path / "old/a.exr")[0], image.select(names))
    assert self_test.read_images(tmp_path / "old").shape == (1, *SHAPE[:2], len(names))
