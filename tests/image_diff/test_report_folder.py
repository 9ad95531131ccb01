"""The report of `mi-refract diff` as a folder: its index, a page a pair, what it replaces and what it leaves alone."""

from __future__ import annotations

import re
import shlex
from html.parser import HTMLParser

import numpy as np
import OpenImageIO as oiio
import pytest
from support.browser import needs_chromium, seen
from support.diff_images import BROKEN, image, tree

from mi_refract.image_diff import folders, html_report, report_folder
from mi_refract.image_diff.results import Result, Status
from mi_refract.image_diff.settings import Entry, Settings

EVIL = 'a"b<script>alert(1)<∕script>.exr'
SKIPPED = Entry("skipped.exr", {"skip": True, "reason": "needs <i>a</i> GPU"})


class Page(HTMLParser):
    """A page's elements, each as its tag and attributes, and its text."""

    def __init__(self, path):
        super().__init__()
        self.elements, self.said = [], []
        self.feed(path.read_text("utf-8"))
        self.text = " ".join(" ".join(self.said).split())

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.said.append(data)

    def of(self, tag, name=""):
        return [found for each, found in self.elements if each == tag and name in (found.get("class") or "").split(" ")]

    def links(self):
        """Whatever the page refers to, but for places in it."""
        named = [found.get(key) for _, found in self.elements for key in ("href", "src")]
        return [each for each in named if each and not each.startswith("#")]


@pytest.fixture
def sides(tmp_path):
    """Every kind of result: errors, changes of several sizes, added, removed, equal, skipped, with odd names."""
    old, new = tmp_path / "old", tmp_path / "new"
    gains = {"glass/a b.exr": 1.5, "glass/deep/c.exr": 1.1, "-dash.exr": 3.0, "equal.exr": 1.0, "skipped.exr": 2.0}
    for name, gain in {**gains, EVIL: 1.2, "bad.exr": 1.0}.items():
        image(old / name)
        image(new / name, gain=gain)
    BROKEN["truncated"](new / "bad.exr")
    image(old / "removed.exr")
    image(new / "glass" / "added.exr")
    return old, new


def written(sides, place, **how):
    settings = Settings((Entry("", {"method": "tolerance"}), SKIPPED), flags=("--method", "tolerance"))
    with report_folder.writing(place) as report:
        found = folders.diff(*sides, settings, view=report.view)
        report.write(found, {"version": "1 & 2"}, "mi-refract diff old new", **how)
    return found


FAILED = ["bad.exr", "-dash.exr", EVIL, "glass/a b.exr", "glass/added.exr", "glass/deep/c.exr", "removed.exr"]


def test_every_failure_has_a_row_and_a_page_with_its_images(sides, tmp_path):
    place = tmp_path / "report"
    written(sides, place)
    index = Page(place / "index.html")
    rows = index.of("article", "item")
    assert [each["data-name"] for each in rows] == FAILED
    pages = [each["href"] for each in index.of("a", "open")]
    assert len(set(pages)) == len(FAILED) == len(list((place / "pairs").iterdir()))
    for name, page in zip(FAILED, pages, strict=True):
        pair = Page(place / page)
        assert name in pair.text and pair.of("canvas"), name
    roles = [each["data-role"] for each in Page(place / pages[3]).of("div", "pane")]
    assert roles == ["reference", "test", "difference", "flip"]
    assert [each["data-role"] for each in Page(place / pages[0]).of("div", "pane")] == ["reference"]
    for words in ("1 & 2", "mi-refract diff old new", "9 images: 1 could not be compared", "needs <i>a</i> GPU"):
        assert words in index.text
    assert "equal.exr" in index.text[index.text.index("Equal") :]


def test_images_of_alike_names_have_pages_of_their_own(tmp_path):
    names = ["a/b.exr", "a-b.exr", "A/b.exr", "a/\udcff.exr", "a/\u202e.exr", "x" * 300 + "b.exr", "y" * 300 + "b.exr"]
    pages = {html_report.page_of(Result(name, Status.DIFFERENT, None, None)) for name in names}
    assert len({page.lower() for page in pages}) == len(names)
    assert all(re.fullmatch(r"pairs/\w[\w.-]{0,90}\.html", page, re.ASCII) for page in pages)


def test_rows_say_how_far_and_in_which_folder(sides, tmp_path):
    written(sides, tmp_path / "report")
    rows = {each["data-name"]: each for each in Page(tmp_path / "report" / "index.html").of("article", "item")}
    assert rows["glass/deep/c.exr"]["data-folder"] == "glass/deep" and rows["-dash.exr"]["data-folder"] == ""
    assert rows["-dash.exr"]["data-excess"] == "Infinity"  # no pixel of so few may differ
    assert rows["removed.exr"]["data-excess"] == ""
    assert "removed" in rows["removed.exr"]["data-text"] and "could not be" in rows["bad.exr"]["data-text"]


def test_nothing_on_its_pages_leads_out_of_it_and_nothing_is_missing(sides, tmp_path):
    place = tmp_path / "report"
    written(sides, place)
    for path in place.rglob("*.html"):
        for link in Page(path).links():
            assert (path.parent / link).resolve().is_relative_to(place) and (path.parent / link).is_file(), link
        assert "<script>alert" not in path.read_text("utf-8")
        assert not re.findall(r"https?:|@import", path.read_text("utf-8"))


def test_thumbnails_are_small_and_show_the_new_image_and_the_difference(sides, tmp_path):
    big = np.full((300, 500, 3), 0.25, np.float32)
    for side, value in zip(sides, (0.25, 0.5), strict=True):
        big[100:200, 250:, 1] = value
        image(side / "big.exr", value=None)
        oiio.ImageBuf(big).write(str(side / "big.exr"))
    written(sides, tmp_path / "report")
    thumbs = {path.name.split(".")[-2]: path for path in (tmp_path / "report" / "thumbs").glob("big*")}
    assert thumbs.keys() == {"test", "difference"}
    pixels = {role: np.rint(255 * oiio.ImageBuf(str(path)).get_pixels()) for role, path in thumbs.items()}
    assert max(pixels["test"].shape) <= 160 and abs(pixels["test"][37, 93] - [137, 188, 137]).max() <= 1
    assert list(pixels["difference"][17, 40]) == [178, 24, 43] and list(pixels["difference"][5, 5]) == [247] * 3
    assert sum(path.stat().st_size for path in thumbs.values()) < 20_000


def test_warnings_variants_and_masks_are_shown(tmp_path):
    old, new = tmp_path / "old", tmp_path / "new"
    for name in ("a", "b"):
        image(old / f"{name}.exr")
        image(new / f"{name}.exr", gain=1.5)
        image(old / f"{name}-macos.exr", gain=1.5 if name == "a" else 3)
    settings = Settings(rules=(Entry("*", {"accept": ("{stem}-*.exr",), "ignore": ((0, 0, 40, 32),)}),))
    with report_folder.writing(tmp_path / "report") as report:
        found = folders.diff(old, new, settings, view=report.view)
        report.write(found, {})
    index = Page(tmp_path / "report" / "index.html")
    assert (
        "matches a-macos.exr" in index.text and index.text.count("warning: the mask leaves out 83% of the pixels") == 2
    )
    assert index.of("details")[0].keys() == {"open"}  # an equal image with a warning is not folded away
    assert "its variant differs, too" in index.text
    (page,) = (tmp_path / "report" / "pairs").iterdir()
    assert "left out" in [each["data-role"] for each in Page(page).of("div", "pane")]


# The folder -------------------------------------------------------------------------------------------------------


def test_a_report_replaces_the_one_before(sides, tmp_path):
    place = tmp_path / "report"
    written(sides, place)
    before = set(tree(place))
    (sides[1] / "glass" / "added.exr").unlink()
    written(sides, place)
    assert len(before - set(tree(place))) == 2 and not set(tree(place)) - before  # its page and its thumbnail
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("when", ["view", "write", "rename"])
def test_a_report_that_fails_leaves_the_one_before(sides, tmp_path, monkeypatch, when):
    place = tmp_path / "report"
    written(sides, place)
    before, replace = tree(place), type(place).replace

    def full(*arguments):
        if when != "rename" or arguments[0].is_dir():
            raise OSError(28, "No space left")
        return replace(*arguments)

    target = (type(place), "replace") if when == "rename" else (report_folder.Folder, when)
    monkeypatch.setattr(*target, full)
    with pytest.raises(OSError, match="No space"):
        written(sides, place)
    assert tree(place) == before and not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("name", ["notes.txt", "index.html", ".git/config", "pairs/image.exr", "thumbs/a/b.png"])
def test_a_folder_with_anything_else_is_left_alone(sides, tmp_path, name):
    place = tmp_path / "report"
    for written_before in (False, True):
        if written_before and name != "index.html":
            (place / name).unlink()
            for folder in sorted(place.rglob("*"), reverse=True):
                folder.rmdir()
            written(sides, place)
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text("mine")
        before = tree(place)
        with pytest.raises(
            ValueError, match=r"report: contains .*, not part of a report; expected a new or empty folder"
        ):
            written(sides, place)
        assert tree(place) == before


# In a browser -----------------------------------------------------------------------------------------------------

SCRIPT = """
const wait = setInterval(async () => {
  if (!root.dataset.ready) return;
  clearInterval(wait);
  const $ = (selector) => document.querySelector(selector);
  const set = (control, value) => {
    if (control.type === "checkbox") control.checked = value;
    else control.value = value;
    control.dispatchEvent(new Event("input", { bubbles: true }));
  };
  const active = () => document.activeElement ?? document.body;
  const press = (key) => active().dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  const names = () => all(".item").filter((each) => !each.hidden).map((each) => each.dataset.name);
  const seen = { thumbs: all(".thumbs img").slice(0, 3).map((each) => each.naturalWidth) };
  for (const order of ["name", "excess", "verdict"]) {
    set($("[name=sort]"), order);
    seen[order] = names();
  }
  set($("[name=group]"), true);
  seen.grouped = [...$("#list").children].map((each) => each.dataset.name ?? each.textContent);
  press("/");
  set(document.activeElement, "glass DIFFERENT");
  seen.filtered = [names(), $(".shown-count").value, all("h2.folder").map((each) => each.textContent)];
  press("f");
  press("Escape");
  seen.mode = root.dataset.mode;
  all("[data-filter]").find((each) => each.dataset.filter === "removed").click();
  seen.cause = [names(), document.querySelector("[aria-pressed=true]").textContent];
  press("/");
  set(document.activeElement, "equal.exr");
  seen.unfolded = [names().length, $("#equal details").open];
  press("Escape");
  seen.folded = [names().length, $("#equal details").open];
  seen.hidden = $(".accepting").hidden;
  press("j");
  press("j");
  seen.focus = document.activeElement.textContent;
  press("x");
  set($("[name=filter]"), "glass");
  $(".tick-shown").click();
  seen.ticked = $(".ticked").textContent;
  seen.built = $(".built").textContent;
  $(".clear").click();
  seen.cleared = $(".accepting").hidden;
  root.dataset.seen = JSON.stringify(seen);
}, 20);
"""


def browsed(place, page, script, profile):
    """What the script leaves of a page; as a file of its own, as the pages run no other."""
    (place / "seen.js").write_text(script, "utf-8")
    deep = "../" if page.parent != place else ""
    tag = f'<script src="{deep}seen.js"></script></body>'
    page.write_text(page.read_text("utf-8").replace("</body>", tag), "utf-8")
    return seen(page, profile)


@needs_chromium
def test_the_index_filters_sorts_groups_and_builds_the_command(sides, tmp_path, run):
    place = tmp_path / "report"
    written(sides, place)
    found = browsed(place, place / "index.html", SCRIPT, tmp_path / "profile")
    built = found.pop("built")
    c, ab, added = "glass/deep/c.exr", "glass/a b.exr", "glass/added.exr"
    assert found.pop("thumbs") == [48, 48, 48]
    assert found.pop("excess")[-3:] == ["bad.exr", added, "removed.exr"]
    assert found == {
        "verdict": FAILED,
        "name": sorted(FAILED),
        "grouped": ["(no folder)4", "bad.exr", "-dash.exr", EVIL, "removed.exr", "glass2", ab, added, "glass/deep1", c],
        "filtered": [[ab, added, c], "3 of 9", ["glass2", "glass/deep1"]],
        "mode": "side",
        "cause": [["removed.exr"], "1 removed"],
        "unfolded": [0, True],
        "folded": [7, False],
        "hidden": True,
        "focus": "-dash.exr",
        "ticked": "4 ticked",
        "cleared": True,
    }
    words = shlex.split(built)
    assert words[4:] == ["--method", "tolerance", "--", "-dash.exr", ab, added, c]
    before, new = tree(sides[0]), tree(sides[1])
    assert run(*words[1:2], "--yes", *words[2:])[0] == 0
    assert tree(sides[0]) == before | {name: new[name] for name in ("-dash.exr", ab, added, c)}


PAIR = """
const wait = setInterval(() => {
  if (!root.dataset.ready) return;
  clearInterval(wait);
  const link = (rel) => document.querySelector(`[rel=${rel}]:not([hidden])`).textContent;
  const copy = document.createElement("canvas").getContext("2d");
  copy.drawImage(document.querySelector("[data-role=difference] canvas"), 0, 0);
  const painted = [...copy.getImageData(47, 3, 1, 1).data].slice(0, 3);
  const press = (key) => document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  press("f");
  const seen = { prev: link("prev"), next: link("next"), place: document.querySelector("nav .place").value, painted };
  root.dataset.seen = JSON.stringify({ ...seen, mode: root.dataset.mode, page: location.pathname.split("/").pop() });
}, 20);
"""


@needs_chromium
def test_the_page_of_a_pair_paints_it_and_leads_to_the_next(sides, tmp_path):
    place = tmp_path / "report"
    written(sides, place)
    page = place / Page(place / "index.html").of("a", "open")[1]["href"]
    found = browsed(place, page, PAIR, tmp_path / "profile")
    assert found == {
        "prev": "k bad.exr",
        "next": f"j {EVIL}",
        "place": "2 of 7",
        "painted": [178, 24, 43],
        "mode": "flicker",
        "page": page.name,
    }


# Memory, and what a job's summary says ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "url, run_id, words",
    [
        ("", "", "Report: report&#47;\n"),
        ("", "7", "[artefacts of this run](https://github.com/a/b/actions/runs/7#artifacts)"),
        ("https://x.io/r (1)/", "7", "[report&#47;](https://x.io/r%20%281%29/index.html)"),
        ("https://x.io/a.zip", "7", "[report&#47;](https://x.io/a.zip)"),
    ],
)
def test_the_summary_names_pages_and_links_what_can_be_linked(run, sides, tmp_path, monkeypatch, url, run_id, words):
    monkeypatch.chdir(tmp_path)
    summary = tmp_path / "summary.md"
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    for name, value in {"SERVER_URL": "https://github.com", "REPOSITORY": "a/b", "RUN_ID": run_id}.items():
        monkeypatch.setenv(f"GITHUB_{name}", value)
    monkeypatch.setenv("MI_REFRACT_REPORT_URL", url)
    run("diff", "old", "new", "--report", "report/", "--github")
    said = summary.read_text()
    assert words in said
    rows = [line for line in said.splitlines() if line.startswith("| ")]
    assert len(rows) == 9 and all(row.count("|") == 6 for row in rows)
    (page,) = (tmp_path / "report" / "pairs").glob("removed*")
    shown = f"pairs&#47;{page.name}"
    linked = f"[{shown}](https://x.io/r%20%281%29/pairs/{page.name})" if url.endswith("/") else shown
    assert f"| {linked} |" in said


def test_a_summary_without_pages_has_no_column_for_them(run, sides, tmp_path, monkeypatch):
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path / "summary.md"))
    run("diff", *sides, "--report", tmp_path / "one.html", "--github")
    said = (tmp_path / "summary.md").read_text()
    assert "one.html" in said and all(row.count("|") == 5 for row in said.splitlines() if row.startswith("| "))
