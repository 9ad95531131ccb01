"""The page of `mi-refract diff`: failures first, exact pixels, nothing from names executed, nothing fetched."""

import base64
import html
import math
import random
import re
import shlex
import tracemalloc
import zlib
from dataclasses import replace

import numpy as np
import pytest
from support.browser import assert_stands_alone, browse, needs_chromium, seen
from support.diff_images import image as smooth
from support.diff_images import tree

from mi_refract.image_diff import flip, folders, html_report
from mi_refract.image_diff.comparison import Comparison, Metric, Verdict
from mi_refract.image_diff.results import Result, Results, Status
from mi_refract.image_diff.settings import Entry, Settings
from mi_refract.io import image_file
from mi_refract.io.image_file import write_exr
from mi_refract.report.embedded_images import ROUNDED, encoded, strongest

EVIL = "glass/<script>alert(1)</script>.exr"
EQUAL = Comparison("tolerance", Verdict.EQUAL, "Within <b>bounds</b>.", (Metric("mean", 1e-5, 1e-3),))
RNG = np.random.default_rng(5)


def image(path, value, shape=(4, 6, 3), channels=("R", "G", "B")):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, np.full(shape, value, np.float32) if np.isscalar(value) else value, channels)
    return path


def results(folder):
    """Results of a pair that cannot be compared, one that differs, a removed image, and one that is equal."""
    reference = image(folder / "reference" / "a.exr", 0.25)
    test = image(folder / "test" / "a.exr", 0.5)
    one, two = {"reference": image_file.read(reference)}, {"test": image_file.read(test)}
    p = np.linspace(0, 1, 24, dtype=np.float32).reshape(4, 6)
    metrics = (Metric("tiles that differ", 12.0, 0.0), Metric("odd", math.nan, 1.0), Metric("smallest p", 1e-9))
    maps = {"t": 8 * p - 4, "p": p, "q": p, "flags": 0 * p}
    different = Comparison("welch", Verdict.DIFFERENT, "12 tiles differ.", metrics, 0.013, maps)
    gone = Result("gone.exr", Status.ERROR, folder / "gone.exr", test, error="gone.exr: <i>corrupt</i>", images=two)
    changed = Result(EVIL, Status.DIFFERENT, reference, test, comparison=different, images=one | two)
    removed = Result("old.exr", Status.DIFFERENT, reference, None, images=one)
    same = Result("same.exr", Status.EQUAL, reference, test, comparison=EQUAL)
    return Results(folder / "reference", folder / "test", (gone, changed, removed, same))


def written(folder, to_write=None):
    html_report.write(folder / "report.html", to_write or results(folder), {"version": "1 & 2"}, "mi-refract diff a b")
    return (folder / "report.html").read_text("utf-8")


def page_of(sides, path, source="", settings=folders.NO_SETTINGS):
    """The page as the command writes it, which views each pair while its images are in memory."""
    report = html_report.Page(path)
    report.write(folders.diff(*sides, settings, view=report.view), {}, "mi-refract diff old new", source)
    return path.read_text("utf-8")


def roles(text):
    return re.findall('data-role="([^"]*)" data-paint="([^"]*)"', text)


def decoded(data):
    high, low = np.frombuffer(zlib.decompress(base64.b64decode(data)), "u1").reshape(2, -1).astype("<u2")
    return (high << 8 | low).view("<f2")


# The text ---------------------------------------------------------------------------------------------------------


def test_failures_come_first_with_numbers_and_commands_and_markup_is_escaped(tmp_path):
    text = written(tmp_path)
    places = ("<h1>4 images: ", 'id="pair-1"', 'id="pair-3"', 'id="equal"', "same.exr")
    order = [text.index(place) for place in places]
    assert order == sorted(order)
    numbers = ('<td class="fail">12</td><td class="limit">&gt; 0', "≰ 1", "1e-9", "0.013", "≤ 1e-3")
    names = "could not be compared", "tiles that differ", "removed"
    causes = [f'data-filter="{cause}">{cause}: <b>1</b> image<' for cause in names]
    for words in (*numbers, *causes, "1 &amp; 2", "12 tiles differ.", "p-value", "mi-refract diff a b"):
        assert words in text, words
    all_results = results(tmp_path)
    for result in all_results.results[:2]:
        for command in (all_results.reproduce(result), all_results.accept(result)):
            assert f"<dd><code>{html.escape(command, quote=False)}</code></dd>" in text.replace("&#39;", "'")
    assert "mi-refract accept" not in text[text.index('id="equal"') : text.index("</main>")]
    assert_stands_alone(text)
    assert "default-src 'none'" in text
    assert "&lt;script&gt;alert(1)" in text and "&lt;i&gt;corrupt" in text and "Within &lt;b&gt;bounds" in text
    assert not re.findall("<script>alert|<i>corrupt|<b>bounds", text)


def test_warnings_variants_masks_and_skipped_images_are_shown(tmp_path):
    old, new = tmp_path / "old", tmp_path / "new"
    for name, variant in (("a", 1.5), ("b", 3), ("c", 1)):
        smooth(old / f"{name}.exr")
        smooth(new / f"{name}.exr", gain=1.5)
        smooth(old / f"{name}-macos.exr", gain=variant)
    rules = Entry("*", {"accept": ("{stem}-*.exr",), "ignore": ((0, 0, 40, 32),)}), Entry("c.exr", {"skip": True})
    text = page_of((old, new), tmp_path / "out.html", settings=Settings(rules))
    assert "matches a-macos.exr" in text and text.count("warning: the mask leaves out 83% of the pixels") == 2
    assert '<section id="equal"><details open>' in text  # the list is unfolded because of the warning
    assert "its variant differs, too" in text and "left out" in dict(roles(text))
    assert '<section id="skipped"><details>' in text and "skipped by the settings" in text


@pytest.mark.parametrize(("source", "flags"), [("", ""), ("out.json", " --from out.json")])
def test_images_of_folders_have_tick_boxes(many, tmp_path, source, flags):
    text = page_of(many, tmp_path / "out.html", source=source)
    assert f'data-command="mi-refract accept {many[0]} {many[1]}{flags}"' in text
    names = [f"{d}/{i}.exr" for d in "ab" for i in range("ab".index(d), 6, 2)]
    assert re.findall('data-word="([^"]*)"', text) == ["z.exr", *names]
    one = [side / "a" / "0.exr" for side in many]
    assert 'class="tick"' not in page_of(one, tmp_path / "out.html")


def test_names_with_invisible_characters_have_no_tick_box(tmp_path):
    bad = [Result(name, Status.DIFFERENT, None, tmp_path / "x") for name in ("a\u202eb.exr", "\u3164.exr", "it's.exr")]
    text = written(tmp_path, Results(tmp_path / "old", tmp_path, tuple(bad)))
    assert list(map(html.unescape, re.findall('data-word="([^"]*)"', text))) == ["'it'\"'\"'s.exr'"]


# The images -------------------------------------------------------------------------------------------------------


def test_panes_of_a_pair_are_in_order_and_equal_pairs_have_none(tmp_path):
    all_results = results(tmp_path)
    text = written(tmp_path, replace(all_results, results=all_results.results[1:2]))
    names = [("reference", "light"), ("test", "light"), ("difference", "signed"), ("flip", "heat"), ("t", "signed")]
    assert roles(text) == [*names, ("−log₁₀ q", "heat")]  # no map of flags, as none is set
    assert "compare pair paired" in text
    scale, data = re.findall(r'data-scale="([^"]*)">([^<]*)<', text)[2]
    difference = float(scale) * decoded(data).astype(float)
    assert difference == pytest.approx(0.5 - 0.25)  # positive where the test is brighter
    text = written(tmp_path, replace(all_results, results=all_results.results[3:]))
    assert roles(text) == [] and "Image viewer" not in text


@pytest.mark.parametrize("method", ["tolerance", "flip"])
def test_every_file_is_read_once_and_flip_runs_once_for_verdict_and_page(tmp_path, monkeypatch, method):
    """Also files of images that only one side has, and of pairs that cannot be compared."""
    sides = tmp_path / "old", tmp_path / "new"
    for side, value in zip(sides, (0.25, 0.5), strict=True):
        image(side / "a.exr", value)
        image(side / f"{side.name}.exr", value)
        image(side / "sizes.exr", value, (4, 5 + len(str(value)), 3))
    (sides[0] / "z.exr").write_text("broken")
    image(sides[1] / "z.exr", 0.5)
    reads, runs = [], []
    read, flip_map = image_file.read_parts, flip.flip_map
    monkeypatch.setattr(image_file, "read_parts", lambda path, *most: reads.append(path) or read(path, *most))
    monkeypatch.setattr(flip, "flip_map", lambda *images: runs.append(images) or flip_map(*images))
    text = page_of(sides, tmp_path / "out.html", settings=Settings.for_all(method=method))
    assert sorted(reads) == sorted(path for side in sides for path in side.iterdir())
    assert len(runs) == 1 and "flip" in dict(roles(text))
    shown = [role for role, _ in roles(text)]
    assert (shown.count("reference"), shown.count("test")) == (3, 4)  # all except the broken one
    assert text.count("compare pair paired") == 1  # images of different sizes are not paired
    viewed = []
    after = folders.diff(sides[0] / "a.exr", sides[1] / "a.exr", view=lambda x, _: viewed.append(len(x.images)))
    assert viewed == [2] and not after.results[0].images and not after.results[0].comparison.maps


def test_an_image_that_cannot_be_shown_does_not_affect_others(tmp_path):
    gone, changed, *others = results(tmp_path).results
    flat = replace(changed.images["test"], pixels=np.float32(3))
    broken = replace(changed, images={"reference": gone.images["test"], "test": flat})
    text = written(tmp_path, replace(results(tmp_path), results=(broken, *others)))
    assert "Cannot be shown: internal error: " in text
    assert dict(roles(text)).keys() == {"reference"}  # of the removed image
    for side, names in (("old", ["same"]), ("new", ["same", "added"])):  # images that are too large are not read
        for name in names:
            image(tmp_path / side / f"{name}.exr", 0.5)
    text = page_of((tmp_path / "old", tmp_path / "new"), tmp_path / "out.html", settings=Settings(max_values=71))
    assert text.count("expected up to 71 values (max-values)") == 4 and roles(text) == []


def test_renders_in_a_folder_are_shown_as_their_mean(tmp_path):
    for side in "rt":
        for i in range(4):
            noise = np.random.default_rng([i, ord(side)]).normal(1 + (side == "t"), 0.01, (8, 8, 3))
            image(tmp_path / side / f"{i}.exr", noise.astype(np.float32))
    compared = folders.diff(tmp_path / "r", tmp_path / "t", renders=True, maps=True)
    assert compared.exit_code == 1
    images = re.findall(r'data-channels="3" data-scale="1.0">([^<]*)<', written(tmp_path, compared))
    assert [decoded(data).astype(float).mean() for data in images] == pytest.approx([1, 2], abs=0.01)


def test_the_first_channel_is_shown_of_images_without_colours(tmp_path):
    pixels = RNG.random((3, 4, 2)).astype(np.float32)
    sides = [image(tmp_path / f"{x}.exr", pixels + x, channels=("depth.Z", "id")) for x in (0, 1)]
    (result,) = folders.diff(*sides, maps=True).results
    first, channel = html_report.shown_of(result, np.inf, np.inf).panes[0], result.images["reference"].channels[0]
    assert first["note"] == f"channel {channel}" and first["channels"] == 1
    shown = decoded(first["data"]).reshape(3, 4)
    np.testing.assert_allclose(shown, image_file.read(sides[0]).select([channel])[..., 0], rtol=1e-3)


@pytest.mark.parametrize(
    ("channels", "shown"),
    [
        ((("a", "m", "n"), ("b", "m", "n")), ["channel m", "channel m", "difference"]),
        ((("a",), ("b",)), ["channel a", "channel b"]),
        ((("a", "z"), ("z",)), ["channel z", "channel z", "difference"]),
    ],
)
def test_the_difference_is_that_of_a_channel_of_both_sides(tmp_path, channels, shown):
    sides = [
        image(tmp_path / side / "a.exr", np.stack([np.full((4, 6), ord(x) / 128 + bias) for x in names], -1), (), names)
        for side, names, bias in zip(("old", "new"), channels, (0, 0.25), strict=True)
    ]
    (result,) = folders.diff(*sides, maps=True).results
    panes = [pane for pane in html_report.shown_of(result, np.inf, np.inf).panes if pane["role"] != "flip"]
    assert [pane["note"] or pane["role"] for pane in panes] == shown
    for change in panes[2:]:
        np.testing.assert_allclose(decoded(change["data"]) * change["scale"], 0.25, rtol=1e-3)


def test_the_gain_of_a_map_follows_its_99th_percentile_and_the_strongest_pixels_remain():
    """One pixel of 2500 is `peak` times as large as the others; the gain is the exponent of a power of ten."""
    for peak, gain in ((1.0, 0), (10.0, 1), (31.7, 1.5), (100.0, 2), (1e9, 6), (0.0, 0)):
        values = np.full((50, 50, 1), float(peak > 0), np.float32)
        values[7, 9] = -peak
        assert html_report.map_pane("difference", values, np.inf)["gain"] == pytest.approx(gain)
    for shape, note in (((3, 961), "strongest of 2 × 2 pixels"), ((1, 960), ""), ((1025, 960), "")):
        assert html_report.map_pane("difference", np.ones((*shape, 1), np.float32), np.inf)["note"] == note
    values = np.zeros((100, 1000, 3), np.float32)
    values[10, 501, 1], values[10, 500, 0], values[99, 999, 2] = -3, 2, np.nan
    small = strongest(values, 100)
    assert small.shape == (10, 100, 1) and small[1, 50] == -3 and np.isnan(small[9, 99]) and (small != 0).sum() == 2


@pytest.mark.parametrize(("rows", "kept"), [(1, 1), (512, 512), (513, 257), (1300, 434)])
def test_a_histogram_uses_at_most_512_rows(rows, kept):
    p = np.linspace(0, 1, 2 * rows, dtype=np.float32).reshape(rows, 2)
    p[0, 1] = np.nan
    comparison = Comparison("welch", Verdict.DIFFERENT, "", maps={"p": p})
    result = Result("x", Status.DIFFERENT, None, None, comparison=comparison)
    counts = np.array(html_report.shown_of(result, np.inf, np.inf).histogram) * (2 * kept - 1)
    assert counts.size == html_report.BINS and counts.sum() == pytest.approx(2 * kept - 1)
    assert counts == pytest.approx(counts.round(), abs=1e-9)


def test_the_bars_of_a_histogram_are_the_shares_of_the_p_values(tmp_path):
    heights = np.array(re.findall(r'<rect [^>]* height="(.*?)"', written(tmp_path)), float)
    counts = np.histogram(np.linspace(0, 1, 24, dtype=np.float32), html_report.BINS, (0, 1))[0]
    assert heights / heights.max() == pytest.approx(counts / counts.max(), abs=1e-3)


@pytest.mark.parametrize(
    ("metrics", "cause"),
    [
        ([("a", 3, 2), ("b", 4, 3), ("c", 9, 9)], "a"),
        ([("a", 9, 1), ("b", 1, 0)], "b"),
        ([("a", 9, 1), ("b", math.nan, 1)], "b"),
        ([("a", 1, 1), ("b", 9, None)], "different"),
    ],
)
def test_the_cause_is_the_metric_with_the_largest_ratio_to_its_bound(tmp_path, metrics, cause):
    comparison = Comparison("x", Verdict.DIFFERENT, "", tuple(Metric(*metric) for metric in metrics))
    result = Result("x", Status.DIFFERENT, tmp_path, tmp_path, comparison=comparison)
    assert html_report.cause(result) == cause


@pytest.mark.parametrize("share", [2, 0.75])
def test_encoding_keeps_finite_values_finite_and_nan(share):
    pixels = RNG.gamma(2, 1, (64, 64, 3)).astype(np.float32)
    pixels[0, :3] = [np.nan, np.inf, -np.inf], [1e9, -1e9, 65504], [1.0, -0.0, 65503]
    image = encoded(pixels, share * len(encoded(pixels)["data"]))
    assert ("within" in image["note"]) == (share < 1)
    values = decoded(image["data"])[:9].reshape(3, 3)
    assert np.isnan(values[0, 0]) and list(values[0, 1:]) == [np.inf, -np.inf]
    assert np.isfinite(values[1:]).all() and abs(values[1]).min() > 6e4 and values[2, 0] == 1


def test_large_images_are_rounded_then_averaged_with_a_note():
    noise = RNG.gamma(2, 1, (256, 256, 3)).astype(np.float32)
    whole = encoded(noise)
    assert whole["note"] == "" and np.array_equal(decoded(whole["data"]), noise.astype(np.float16).ravel())
    rounded = encoded(noise, 0.75 * len(whole["data"]))
    assert len(rounded["data"]) <= 0.77 * len(whole["data"])
    share = float(re.search("within (.*) %", rounded["note"])[1]) / 100
    assert np.allclose(decoded(rounded["data"]), noise.ravel(), rtol=share, atol=1e-7)
    assert not np.allclose(decoded(rounded["data"]), noise.ravel(), rtol=share / 4, atol=1e-7)
    small = encoded(noise, 0.2 * len(whole["data"]))
    assert (small["width"], small["height"]) == (128, 128) and small["note"].startswith("means of 2 × 2 pixels")
    means = noise.reshape(128, 2, 128, 2, 3).mean((1, 3))
    assert np.allclose(decoded(small["data"]).reshape(128, 128, 3), means, rtol=2.0 ** (max(ROUNDED) - 11), atol=1e-7)


@pytest.mark.parametrize("shape", [(1, 2**18, 3), (2**18, 1, 3)])
def test_encoding_a_thin_image_needs_no_more_memory(shape):
    noise = RNG.random(shape).astype(np.float32)
    tracemalloc.start()
    small = strongest(noise, 960)
    data = encoded(noise, 100_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert small.shape[1] <= 960 and len(data["data"]) <= 105_000 and peak < 12 * noise.nbytes


# A full page ------------------------------------------------------------------------------------------------------


@pytest.fixture
def many(tmp_path):
    """Six pairs that differ, one that is equal, one that cannot be compared."""
    old, new = tmp_path / "old", tmp_path / "new"
    for i in range(6):
        smooth(old / f"{'ab'[i % 2]}/{i}.exr", noise=0.1)
        smooth(new / f"{'ab'[i % 2]}/{i}.exr", seed=1, noise=0.1)
    for side in (old, new):
        smooth(side / "equal.exr")
    smooth(old / "z.exr")
    (new / "z.exr").write_bytes(b"no image")
    return old, new


def size_of(result):
    return html_report.shown_of(result, html_report.IMAGE_BYTES, html_report.MAP_BYTES).size


@pytest.mark.parametrize(("share", "pairs"), [(0.1, 1), (1.9, 1), (2.1, 2)])
def test_pairs_that_do_not_fit_keep_their_numbers_and_are_named(tmp_path, monkeypatch, share, pairs):
    """The first pair is always shown; a command shows the rest."""
    template = results(tmp_path)
    changed = template.results[1]
    names = [f"-{i}.exr" for i in range(3)]
    four = tuple(replace(changed, name=name) for name in (names[0], "-0\u202e.exr", *names[1:]))
    monkeypatch.setattr(html_report, "PAGE", share * size_of(changed))
    monkeypatch.setattr(html_report, "NAMED", 1)
    text = written(tmp_path, replace(template, results=four, flags=("--method", "welch")))
    assert len(roles(text)) == 6 * pairs and text.count("12 tiles differ.") == 4
    assert text.count("the page is full") == 4 - pairs
    left_out = re.search("Left out, because a page is limited to 15 MB: (.*?) <code>(.*?)</code>", text)
    assert left_out[1] == f"images of {4 - pairs} of 4 failures. The first of them:"
    paths = [str(template.reference), str(template.test)]
    words = ["mi-refract", "diff", *paths, "--method", "welch", "--report", "rest.html"]
    assert shlex.split(left_out[2]) == [*words, "--", names[1]]


@pytest.mark.parametrize("seed", range(3))
def test_the_page_is_independent_of_the_order_of_results(many, tmp_path, monkeypatch, seed):
    compared = folders.diff(*many, maps=True)
    monkeypatch.setattr(html_report, "PAGE", 3.5 * size_of(compared.results[1]))
    failed = compared.of(Status.ERROR, Status.DIFFERENT)
    random.Random(seed).shuffle(failed)
    report = html_report.Page(tmp_path / "shuffled.html")
    for result in failed:
        report.view(result, compared)
    size = sum(shown.size for shown in report._shown.values())
    assert size <= 4.7 * size_of(compared.results[1])  # memory does not grow with the number of failures
    report.write(compared, {}, "")
    html_report.write(tmp_path / "ordered.html", compared)
    assert (tmp_path / "shuffled.html").read_bytes() == (tmp_path / "ordered.html").read_bytes()
    assert "images of 3 of 7 failures" in (tmp_path / "ordered.html").read_text("utf-8")


def test_a_page_of_thousands_of_images_respects_its_limit(tmp_path, monkeypatch):
    long = "a long name/" * 20
    sides = tmp_path / "a", tmp_path / "b"
    bad = [Result(f"{long}{i}.exr", Status.ERROR, None, tmp_path / "b", error="bad " * 100) for i in range(900)]
    equal = [Result(f"{long}{i}.exr", Status.EQUAL, *sides, comparison=EQUAL) for i in range(300)]
    monkeypatch.setattr(html_report, "LIMIT", 600_000)
    text = written(tmp_path, Results(tmp_path / "a", tmp_path, (*bad, *equal)))
    assert len(text.encode()) <= 600_000
    left_out = html.unescape(re.search("limited to 15 MB: (.*?)\\.", text)[1])
    articles, lines = text.count("<article"), len(re.findall("<tr data-text", text))
    more = [int(count) for count in re.findall(r"… and (\d+) more", text)]
    assert articles >= 20 and lines >= articles and articles + lines + sum(more) == 1200
    assert "rest.html" not in text  # no image has a pane
    in_lines = f"details of {900 - articles - more[0]} failures"
    assert left_out == f"{in_lines}, {more[0]} failures, {more[1]} equal images"


def test_a_noisy_pair_of_full_size_fits_on_the_page(tmp_path):
    noise = [RNG.standard_exponential((1080, 1920, 3), np.float32) for _ in "rt"]
    sides = [image(tmp_path / f"{side}.exr", pixels) for side, pixels in zip("rt", noise, strict=True)]
    text = page_of(sides, tmp_path / "out.html")
    assert len(roles(text)) >= 4 and len(text.encode()) <= 15e6


# In a browser -----------------------------------------------------------------------------------------------------

LIST = """
  const set = (control, value) => {
    control.value = value;
    control.dispatchEvent(new Event("input", { bubbles: true }));
  };
  const seen = { small: all("nav a[data-text] canvas").map((each) => each.height) };
  const visible = (selector) => all(selector).filter((each) => !each.hidden).map((each) => each.id || each.textContent);
  press("/");
  set(active(), "b/ DIFF");
  seen.strip = visible("nav [data-text]");
  seen.articles = visible("article");
  seen.count = $(".shown-count").value;
  press("f");
  press("x");
  seen.typed = [root.dataset.mode, $(".accepting").hidden];
  press("Enter");
  press("x");
  seen.ticked = $(".built").textContent.split(" ").slice(4);
  press("f");
  seen.mode = root.dataset.mode;
  $(".clear").click();
  press("/");
  set(active(), "equal.exr");
  seen.unfolded = [visible("article").length, $("#equal details").open];
  press("Escape");
  seen.folded = [visible("article").length, $("#equal details").open];
  $("[data-filter='could not be compared']").click();
  seen.cause = [visible("article"), $("[aria-pressed=true]").textContent];
  $("[aria-pressed=true]").click();
  $(".tick-shown").click();
  seen.all = $(".ticked").textContent;
  seen.built = $(".built").textContent;
  const clip = () => getComputedStyle($(".paired [data-role=test] canvas")).clipPath;
  press("s");
  seen.clip = [clip()];
  press("ArrowRight");
  seen.clip.push(clip());
  seen.requests = performance.getEntriesByType("resource").length;
"""


@needs_chromium
def test_the_browser_reports_planted_requests_and_errors(tmp_path):
    """So that the tests above can fail."""
    page = tmp_path / "report.html"
    planted = "<script>fetch('https://example.invalid/x'); undefinedName()</script></body>"
    page.write_text(written(tmp_path).replace("</body>", planted), "utf-8")
    _, console = browse(page, tmp_path / "profile")
    assert any("undefinedName" in line for line in console)
    assert any("Content Security Policy" in line for line in console)


@needs_chromium
def test_the_filter_works_and_the_page_builds_the_command(many, tmp_path, run):
    image(many[1] / "-dash it's.exr", 0.5)
    observed = seen(tmp_path, page_of(many, tmp_path / "out.html"), LIST)
    words = shlex.split(observed.pop("built"))
    assert observed == {
        "small": [32] * 7 + [4],
        "strip": ["b/1.exr", "b/3.exr", "b/5.exr"],
        "articles": ["pair-5", "pair-6", "pair-7"],
        "count": "3 of 9",
        "typed": ["side", True],
        "ticked": ["b/1.exr"],
        "mode": "flicker",
        "unfolded": [0, True],
        "folded": [8, False],
        "cause": [["pair-1"], "could not be compared: 1 image"],
        "all": "8 ticked",
        "clip": ["inset(0px 0px 0px 50%)", "inset(0px 0px 0px 52%)"],
        "requests": 0,
    }
    names = [name for name in words[words.index("--") + 1 :] if name != "z.exr"]  # z.exr cannot be compared
    before, new = tree(many[0]), tree(many[1])
    assert len(names) == 7 and run("accept", "--yes", *words[2 : -len(names) - 1], *names)[0] == 0
    assert tree(many[0]) == before | {name: new[name] for name in names}
