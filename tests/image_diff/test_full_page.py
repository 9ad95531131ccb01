"""The one page of `mi-refract diff` where there is much to show: what it leaves out, its filter, and its tick boxes."""

from __future__ import annotations

import html
import random
import re

import pytest
from support.browser import needs_chromium, seen
from support.diff_images import image

from mi_refract.image_diff import folders, html_report, panes
from mi_refract.image_diff.results import Result, Results, Status


@pytest.fixture
def many(tmp_path):
    """Six pairs that differ, one that is equal, one that cannot be compared."""
    old, new = tmp_path / "old", tmp_path / "new"
    for i in range(6):
        image(old / f"{'ab'[i % 2]}/{i}.exr", noise=0.1)
        image(new / f"{'ab'[i % 2]}/{i}.exr", seed=1, noise=0.1)
    for side in (old, new):
        image(side / "equal.exr")
    image(old / "z.exr")
    (new / "z.exr").write_bytes(b"no image")
    return old, new


def page(sides, place, replay="mi-refract diff old new", source=""):
    report = html_report.Page(place)
    found = folders.diff(*sides, view=report.view)
    report.write(found, {}, replay, source)
    return place.read_text("utf-8")


def shown(text):
    """The names of the pairs with images, in order."""
    articles = re.findall(r"<article.*?<h3>([^ ]*) .*?</article>", text, re.DOTALL)
    return [name for name in articles if 'data-role="test"' in text.split(f"<h3>{name} ")[1].split("</article>")[0]]


def test_what_is_left_out_is_said_with_the_command_that_shows_it(many, tmp_path, monkeypatch):
    size = panes.of_result(folders.diff(*many, maps=True).results[1], html_report.MOST).size
    monkeypatch.setattr(html_report, "PAGE", 3.5 * size)
    text = page(many, tmp_path / "out.html")
    assert shown(text) == ["a/0.exr", "a/2.exr", "a/4.exr"]
    words = "Left out, as a page has 15 MB at most: images of 3 of 7 failures. A folder has them all: "
    assert words + "<code>mi-refract diff old new --report report/</code>" in text
    monkeypatch.setattr(html_report, "PAGE", 10 * size)
    assert "Left out" not in page(many, tmp_path / "out.html")


@pytest.mark.parametrize("seed", range(3))
def test_the_page_is_the_same_in_whatever_order_results_come(many, tmp_path, monkeypatch, seed):
    found = folders.diff(*many, maps=True)
    size = panes.of_result(found.results[1], html_report.MOST).size
    monkeypatch.setattr(html_report, "PAGE", 3.5 * size)
    failed = found.of(Status.ERROR, Status.DIFFERENT)
    random.Random(seed).shuffle(failed)
    report = html_report.Page(tmp_path / "shuffled.html")
    for result in failed:
        report.view(result, found)
    held = sum(each.size for each in report._shown.values())
    assert held <= 4.7 * size  # memory does not grow with the number of failures
    report.write(found, {}, "")
    html_report.write(tmp_path / "ordered.html", found)
    assert (tmp_path / "shuffled.html").read_bytes() == (tmp_path / "ordered.html").read_bytes()


def test_a_page_of_thousands_is_no_larger_than_its_limit(tmp_path, monkeypatch):
    long = "a long name/" * 20
    results = [Result(f"{long}{i}.exr", Status.ERROR, None, tmp_path / "b", error="bad " * 100) for i in range(900)]
    results += [Result(f"{long}{i}.exr", Status.EQUAL, tmp_path / "a", tmp_path / "b") for i in range(900, 1200)]
    monkeypatch.setattr(html_report, "LIMIT", 600_000)
    found = Results(tmp_path / "a", tmp_path, tuple(results))
    monkeypatch.setattr(Result, "reason", property(lambda self: self.error))
    html_report.write(tmp_path / "out.html", found, replay="mi-refract diff a b")
    text = (tmp_path / "out.html").read_text()
    assert len(text.encode()) <= 600_000
    said = html.unescape(re.search("at most: (.*?)\\.", text)[1])
    articles, lines = text.count("<article"), len(re.findall("<tr data-text", text))
    more = [int(each) for each in re.findall(r"… and (\d+) more", text)]
    assert articles >= 20 and lines >= articles and articles + lines + sum(more) == 1200
    assert said == f"all but a line of {900 - articles - more[0]} failures, {more[0]} failures, {more[1]} equal images"


@pytest.mark.parametrize("source, flags", [("", ""), ("out.json", " --from out.json")])
def test_names_that_mean_something_can_be_ticked(many, tmp_path, source, flags):
    text = page(many, tmp_path / "out.html", source=source)
    assert f'data-command="mi-refract accept {many[0]} {many[1]}{flags}"' in text
    assert re.findall('data-word="([^"]*)"', text) == [
        "z.exr",
        *(f"{d}/{i}.exr" for d in "ab" for i in range("ab".index(d), 6, 2)),
    ]
    one = [side / "a" / "0.exr" for side in many]
    assert 'class="tick"' not in page(one, tmp_path / "out.html")


def test_a_name_that_cannot_be_shown_as_it_is_cannot_be_ticked(tmp_path):
    odd = Result("a\u202eb.exr", Status.DIFFERENT, None, tmp_path / "x")
    fine = Result("it's.exr", Status.DIFFERENT, None, tmp_path / "x")
    html_report.write(tmp_path / "out.html", Results(tmp_path / "old", tmp_path, (odd, fine)))
    words = re.findall('data-word="([^"]*)"', (tmp_path / "out.html").read_text())
    assert list(map(html.unescape, words)) == ["'it'\"'\"'s.exr'"]


SCRIPT = """<script>
const wait = setInterval(() => {
  if (!root.dataset.ready) return;
  clearInterval(wait);
  const $ = (selector) => document.querySelector(selector);
  const active = () => document.activeElement ?? document.body;
  const press = (key) => active().dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  const visible = (selector) => all(selector).filter((each) => !each.hidden).map((each) => each.id || each.textContent);
  const seen = {};
  press("/");
  active().value = "b/";
  active().dispatchEvent(new Event("input", { bubbles: true }));
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
  press("Escape");
  $(".tick-shown").click();
  seen.all = $(".ticked").textContent;
  root.dataset.seen = JSON.stringify(seen);
}, 20);
</script></body>"""


@needs_chromium
def test_the_strip_of_names_is_searched_and_the_page_builds_the_command(many, tmp_path):
    place = tmp_path / "out.html"
    place.write_text(page(many, place).replace("</body>", SCRIPT), "utf-8")
    assert seen(place, tmp_path / "profile") == {
        "strip": ["b/1.exr", "b/3.exr", "b/5.exr"],
        "articles": ["pair-5", "pair-6", "pair-7"],
        "count": "3 of 8",
        "typed": ["side", True],
        "ticked": ["b/1.exr"],
        "mode": "flicker",
        "all": "7 ticked",
    }
