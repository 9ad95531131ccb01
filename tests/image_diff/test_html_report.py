"""The page of `mi-refract diff`: failures first, true to the pixels, nothing executable, nothing fetched."""

import base64
import math
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.browser import browse, needs_chromium, seen

from mi_refract.image_diff import flip, folders, html_report, panes
from mi_refract.image_diff.comparison import Comparison, Metric, Verdict
from mi_refract.image_diff.results import Result, Results, Status
from mi_refract.image_diff.settings import ComparisonSpec, Settings
from mi_refract.io import image_file
from mi_refract.io.image_file import write_exr
from mi_refract.report.embedded_images import ROUNDED, EmbeddedImages, encoded, strongest

EVIL = "glass/<script>alert(1)</script>.exr"
EQUAL = Comparison("tolerance", Verdict.EQUAL, "Within <b>bounds</b>.", (Metric("mean", 1e-5, 1e-3),))


def image(path, value, shape=(4, 6, 3), channels=("R", "G", "B")):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_exr(path, np.full(shape, value, np.float32) if np.isscalar(value) else value, channels)
    return path


def results(folder):
    """A pair that differs, one that cannot be compared, a removed image, one that is equal."""
    reference = image(folder / "reference" / "a.exr", 0.25)
    test = image(folder / "test" / "a.exr", 0.5)
    p = np.linspace(0, 1, 24, dtype=np.float32).reshape(4, 6)
    metrics = (Metric("tiles that differ", 12.0, 0.0), Metric("odd", math.nan, 1.0), Metric("smallest p", 1e-9))
    maps = {"t": 8 * p - 4, "p": p, "q": p, "flags": 0 * p}
    found = Comparison("welch", Verdict.DIFFERENT, "12 tiles differ.", metrics, 0.013, maps)
    return Results(
        folder / "reference",
        folder / "test",
        (
            Result("gone.exr", Status.ERROR, folder / "gone.exr", test, error="gone.exr: <i>corrupt</i>"),
            Result(EVIL, Status.DIFFERENT, reference, test, comparison=found),
            Result("old.exr", Status.DIFFERENT, reference, None),
            Result("same.exr", Status.EQUAL, reference, test, comparison=EQUAL),
        ),
    )


def several(found, count):
    """The results of a pair that differs, under that many names."""
    each = found.results[1]
    return Results(found.reference, found.test, tuple(replace(each, name=f"{i}.exr") for i in range(count)))


def html(folder, found=None):
    html_report.write(folder / "report.html", found or results(folder), {"version": "1 & 2"}, "mi-refract diff a b")
    return (folder / "report.html").read_text("utf-8")


def roles(text):
    return re.findall('data-role="([^"]*)" data-paint="([^"]*)"', text)


def test_an_image_that_cannot_be_shown_keeps_no_other_from_being_shown(tmp_path, monkeypatch):
    made = panes._all

    def fail(result, most):
        if result.name == EVIL:
            raise MemoryError("Unable to allocate 9 GiB")
        return made(result, most)

    monkeypatch.setattr(panes, "_all", fail)
    text = html(tmp_path)
    assert "Cannot be shown: out of memory: Unable to allocate 9 GiB" in text
    assert dict(roles(text)).keys() == {"test", "reference"}  # of the one that cannot be compared, and of the removed


def test_an_image_that_is_larger_than_allowed_is_not_read_for_the_page(tmp_path):
    image(tmp_path / "old" / "same.exr", 0.5)
    for side in ("old", "new"):
        image(tmp_path / side / "added.exr", 0.5)
    (tmp_path / "old" / "added.exr").unlink()
    found = folders.diff(tmp_path / "old", tmp_path / "new", Settings(ComparisonSpec(max_values=71)))
    assert "expected up to 71 values (max-values)" in html(tmp_path, found)


# The text


def test_failures_come_first_with_numbers_thresholds_and_commands(tmp_path):
    text = html(tmp_path)
    places = ("<h1>4 images: ", 'id="pair-1"', 'id="pair-3"', 'id="equal"', "same.exr")
    order = [text.index(place) for place in places]
    assert order == sorted(order)
    numbers = ('<td class="fail">12</td><td class="limit">&gt; 0', "≰ 1", "1e-9", "0.013", "≤ 1e-3")
    for words in (*numbers, "1 &amp; 2", "12 tiles differ.", "removed", "No such file", "p-value"):
        assert words in text, words
    assert "mi-refract diff a b" in text
    found = results(tmp_path)
    for result in found.results[:2]:
        for command in (found.reproduce(result), found.accept(result)):
            assert f"<dd><code>{command}</code></dd>" in text
    assert "mi-refract accept" not in text[text.index('id="equal"') : text.index("</main>")]


def test_the_page_asks_for_nothing_and_runs_no_name(tmp_path):
    text = html(tmp_path)
    assert not re.findall(r"https?:|@import|url\((?!#)|\bsrc=|<link|<iframe", text)
    assert "default-src 'none'" in text
    assert "&lt;script&gt;alert(1)" in text and "&lt;i&gt;corrupt" in text and "Within &lt;b&gt;bounds" in text
    assert not re.findall("<script>alert|<i>corrupt|<b>bounds", text)
    ids = re.findall(r'\bid="([^"]*)"', text)
    assert len(ids) == len(set(ids))


def test_panes_of_a_pair_are_in_order_and_an_equal_one_has_none(tmp_path):
    found = results(tmp_path)
    text = html(tmp_path, Results(found.reference, found.test, found.results[1:2]))
    names = [("reference", "light"), ("test", "light"), ("difference", "signed"), ("flip", "heat"), ("t", "signed")]
    assert roles(text) == [*names, ("−log₁₀ q", "heat")]  # no flags: none is up
    assert "compare pair paired" in text
    scale, data = re.findall(r'data-scale="([^"]*)">([^<]*)<', text)[2]
    difference = float(scale) * decoded(data).astype(float)
    assert difference == pytest.approx(0.5 - 0.25)  # positive where the test is brighter
    text = html(tmp_path, Results(found.reference, found.test, found.results[3:]))
    assert roles(text) == [] and "Image viewer" not in text


def test_images_of_different_sizes_stand_side_by_side_and_are_not_laid_over_each_other(tmp_path):
    sides = image(tmp_path / "r" / "a.exr", 1.0), image(tmp_path / "t" / "a.exr", 1.0, (4, 5, 3))
    text = html(tmp_path, folders.diff(*sides))
    assert roles(text) == [("reference", "light"), ("test", "light")]
    assert "compare pair paired" not in text


def test_renders_in_a_folder_are_shown_as_their_mean(tmp_path):
    for side in "rt":
        for i in range(4):
            noise = np.random.default_rng([i, ord(side)]).normal(1 + (side == "t"), 0.01, (8, 8, 3))
            image(tmp_path / side / f"{i}.exr", noise.astype(np.float32))
    found = folders.diff(tmp_path / "r", tmp_path / "t", renders=True, maps=True)
    assert found.exit_code == 1
    images = re.findall(r'data-channels="3" data-scale="1.0">([^<]*)<', html(tmp_path, found))
    means = [decoded(data).astype(float).mean() for data in images]
    assert means == pytest.approx([1, 2], abs=0.01)


@pytest.mark.parametrize("method", ["tolerance", "flip"])
def test_every_file_is_read_once_and_flip_runs_once_for_verdict_and_page(tmp_path, monkeypatch, method):
    sides = [image(tmp_path / side / "a.exr", value) for side, value in (("r", 0.25), ("t", 0.5))]
    reads, runs = [], []
    read, flip_map = image_file.read_parts, flip.flip_map
    monkeypatch.setattr(image_file, "read_parts", lambda path, *most: reads.append(path) or read(path, *most))
    monkeypatch.setattr(flip, "flip_map", lambda *sides: runs.append(sides) or flip_map(*sides))
    settings = Settings(ComparisonSpec(method))
    whole = html(tmp_path, folders.diff(*sides, settings, maps=True))
    assert sorted(reads) == sorted(sides) and len(runs) == 1 and "flip" in dict(roles(whole))
    page = html_report.Page(tmp_path / "viewed.html")
    found = folders.diff(*sides, settings, view=page.view)
    page.write(found, {})
    assert len(reads) == 4 and roles((tmp_path / "viewed.html").read_text()) == roles(whole)
    assert not found.results[0].images and not found.results[0].comparison.maps
    again = html(tmp_path, found)
    assert len(reads) == 6 and roles(again) == [each for each in roles(whole) if each[0] != "local"]


def test_a_pair_that_does_not_fit_any_more_is_left_out(tmp_path, monkeypatch):
    found = results(tmp_path)
    alone = html(tmp_path, Results(found.reference, found.test, found.results[1:2]))
    size = panes.of_result(found.results[1], html_report.MOST).size
    assert sum(len(data) for data in re.findall(r'data-scale="[^"]*">([^<]*)<', alone)) < size
    for pairs, factor in ((1, 1.9), (2, 2.1)):
        monkeypatch.setattr(html_report, "PAGE", factor * size)
        text = html(tmp_path, several(found, 3))
        assert len(roles(text)) == 6 * pairs and text.count("the page is full") == 3 - pairs


def test_a_full_page_keeps_the_numbers_and_says_what_is_left_out(tmp_path, monkeypatch):
    found = results(tmp_path)
    monkeypatch.setattr(html_report, "PAGE", 1)
    text = html(tmp_path, several(found, 3))
    assert len(roles(text)) == 6 and text.count("the page is full") == 2 and text.count("12 tiles differ.") == 3


# The pixels


def decoded(data):
    high, low = np.frombuffer(zlib.decompress(base64.b64decode(data)), "u1").reshape(2, -1).astype("<u2")
    return (high << 8 | low).view("<f2")


@pytest.mark.parametrize("share", [2, 0.75])
def test_a_finite_value_never_becomes_infinite_and_nan_stays(share):
    pixels = np.random.default_rng(5).gamma(2, 1, (64, 64, 3)).astype(np.float32)
    pixels[0, :3] = [np.nan, np.inf, -np.inf], [1e9, -1e9, 65504], [1.0, -0.0, 65503]
    found = encoded(pixels, share * len(encoded(pixels)["data"]))
    assert ("within" in found["note"]) == (share < 1)
    read = decoded(found["data"])[:9].reshape(3, 3)
    assert np.isnan(read[0, 0]) and list(read[0, 1:]) == [np.inf, -np.inf]
    assert np.isfinite(read[1:]).all() and abs(read[1]).min() > 6e4 and read[2, 0] == 1


def test_what_does_not_fit_is_rounded_then_made_smaller_and_the_page_says_so():
    noise = np.random.default_rng(5).gamma(2, 1, (256, 256, 3)).astype(np.float32)
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


def test_one_pixel_and_one_nan_survive_a_smaller_map():
    values = np.zeros((100, 1000, 3), np.float32)
    values[10, 501, 1], values[10, 500, 0], values[99, 999, 2] = -3, 2, np.nan
    small = strongest(values, 100)
    assert small.shape == (10, 100, 1) and small[1, 50] == -3 and np.isnan(small[9, 99]) and (small != 0).sum() == 2


@pytest.mark.parametrize(("peak", "gain"), [(1.0, 0), (10.0, 1), (31.7, 1.5), (100.0, 2), (1e9, 6), (0.0, 0)])
def test_a_map_is_full_of_colour_where_its_upper_hundredth_is(peak, gain):
    """One pixel of 2500 is `peak` times as large as the others; the gain is in tenths of a power of ten."""
    values = np.full((50, 50, 1), float(peak > 0), np.float32)
    values[7, 9] = -peak
    assert panes._map("difference", values, html_report.MOST.map)["gain"] == pytest.approx(gain)


def test_the_first_channel_stands_for_those_that_are_no_colours():
    pixels = np.random.default_rng(2).random((3, 4, 2)).astype(np.float32)
    found = panes._in_shown_channels(image_file.Image(Path("a.exr"), pixels, ("depth.Z", "id")))
    np.testing.assert_array_equal(found.pixels, pixels[..., :1])
    assert found.channels == ("depth.Z",)


@pytest.mark.parametrize(("rows", "kept"), [(1, 1), (512, 512), (513, 257), (1300, 434)])
def test_a_histogram_is_of_512_rows_at_most(rows, kept, monkeypatch):
    seen = []
    monkeypatch.setattr(panes, "histogram_svg", lambda values, *words, salt: seen.append(values) or "")
    p_values = np.linspace(0, 1, 2 * rows, dtype=np.float32).reshape(rows, 2)
    p_values[0, 1] = np.nan
    panes._histogram(p_values, "x")
    assert len(seen[0]) == 2 * kept - 1


@pytest.mark.parametrize("shape, note", [((3, 1), "strongest of 2 × 2 pixels"), ((1, 0), ""), ((1025, 0), "")])
def test_a_map_says_how_many_of_its_pixels_became_one(shape, note):
    height, wider = shape
    pane = panes._map("difference", np.ones((height, panes.MAP_WIDTH + wider, 1), np.float32), html_report.MOST.map)
    assert pane["note"] == note


def test_images_of_a_page_have_keys_of_their_own():
    page = EmbeddedImages()
    keys = [page.add(encoded(np.ones((2, 2, 1))))["key"] for _ in range(3)]
    assert keys == ["p0", "p1", "p2"] and page.size == sum(len(each["data"]) for each in page.embedded)


def test_a_noisy_full_size_pair_stays_within_its_bytes(tmp_path):
    rng = np.random.default_rng(1)
    sides = [image(tmp_path / f"{side}.exr", rng.standard_exponential((1080, 1920, 3), np.float32)) for side in "rt"]
    text = html(tmp_path, folders.diff(*sides, maps=True))
    assert len(roles(text)) >= 4
    assert (tmp_path / "report.html").stat().st_size <= 15e6


# In a browser

SCRIPT = """<script>
const wait = setInterval(async () => {
  if (!root.dataset.ready) return;
  clearInterval(wait);
  const $ = (selector) => document.querySelector(selector);
  const pixel = (role) => {
    const copy = document.createElement("canvas").getContext("2d");
    copy.drawImage($(`[data-role=${role}] canvas`), 0, 0);
    return [...copy.getImageData(0, 0, 1, 1).data].slice(0, 3);
  };
  const press = (key) => document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  const clip = () => getComputedStyle($("[data-role=test] canvas")).clipPath;
  const seen = { test: pixel("test"), difference: pixel("difference") };
  press("]");
  press("]");
  seen.brighter = pixel("test");
  const gain = $("[data-role=difference] .gain");
  gain.value = 1;
  gain.dispatchEvent(new Event("input", { bubbles: true }));
  seen.full = gain.nextElementSibling.value;
  press("s");
  seen.clip = [clip()];
  press("ArrowRight");
  seen.clip.push(clip());
  const box = $("[data-role=reference] .frame").getBoundingClientRect();
  const at = { bubbles: true, clientX: box.left + box.width / 4, clientY: box.top + 1 };
  $("[data-role=reference] canvas").dispatchEvent(new PointerEvent("pointermove", at));
  seen.read = ["reference", "test", "difference"].map((role) => $(`[data-role=${role}] .pixel`).value);
  seen.place = $("[data-role=test] .place").value;
  press("f");
  seen.mode = root.dataset.mode;
  seen.requests = performance.getEntriesByType("resource").length;
  seen.scripts = [...document.scripts].filter((each) => each.textContent.startsWith("alert")).length;
  root.dataset.seen = JSON.stringify(seen);
}, 20);
</script></body>"""


@needs_chromium
def test_the_page_works_from_a_file(tmp_path):
    found = results(tmp_path)
    text = html(tmp_path, Results(found.reference, found.test, found.results[1:]))
    page = tmp_path / "report.html"
    page.write_text(text.replace("</body>", SCRIPT), "utf-8")
    assert seen(page, tmp_path / "profile") == {
        "test": [188, 188, 188],  # sRGB of 0.5
        "difference": [178, 24, 43],  # the test is brighter: red
        "brighter": [255, 255, 255],
        "full": "full at 0.025",
        "clip": ["inset(0px 0px 0px 50%)", "inset(0px 0px 0px 52%)"],
        "read": ["0.25  0.25  0.25", "0.5  0.5  0.5", "0.25"],
        "place": "1, 0",
        "mode": "flicker",
        "requests": 0,
        "scripts": 0,
    }


@needs_chromium
def test_the_browser_sees_a_request_and_an_error(tmp_path):
    """What the test above would miss if it could not fail."""
    page = tmp_path / "report.html"
    planted = "<script>fetch('https://example.invalid/x'); undefinedName()</script>" + SCRIPT
    page.write_text(html(tmp_path).replace("</body>", planted), "utf-8")
    _, console = browse(page, tmp_path / "profile")
    assert any("undefinedName" in line for line in console)
    assert any("Content Security Policy" in line for line in console)
