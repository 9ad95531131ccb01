"""Reports of rows are complete, execute nothing from names, and fetch nothing."""

import base64
import dataclasses
import io
import itertools
import json
import math
import re
import xml.etree.ElementTree as xml
import zlib

import numpy as np
import pytest
from support.browser import assert_stands_alone, needs_chromium, seen
from support.diff_images import save

from mi_refract.io.text import compact, distinguishable, printable
from mi_refract.report import documents, run_report
from mi_refract.report.plots import Axes, Scatter, curves_svg, pareto, scatter_svg
from mi_refract.report.row import Row
from mi_refract.report.study_page import NOT_RUN

NAN, INF = math.nan, math.inf
GOOD = Row("directions", "promoted", "generic", "llvm float32", {"worst": 5e-8, "time": 1.2}, {"worst": 6e-8})
BAD = Row(
    "directions",
    "cross",
    "generic",
    "llvm float32",
    {"worst": NAN, "misjudged": 3.0},
    {"worst": 1e-3, "misjudged": 0.0},
    replay={"k": "0x1.8p+0"},
)
ABSENT = Row("directions", "cross", "generic", "cuda float32", reason="no CUDA device \x1b[0m")
INFO = Row(
    "speed",
    "<script>alert(1)</script>",
    "$k$ & co",
    "",
    {"time": INF, "low": -INF},
    curves={"a": [(0.1, 1e-2), (1.0, 1e-3)], "b": [(1.0, 0.0), (2.0, NAN)]},
)
ROWS = [GOOD, BAD, ABSENT, INFO]
CONTEXT = {
    "title": "validation",
    "versions": {"mitsuba": "3.9.1"},
    "studies": {"speed": {"title": "Speed", "text": "Not <b>bold</b>."}},
    "scatter": [{"study": "directions", "x": "time", "y": "worst"}],
}


def html(folder, rows=ROWS, context=CONTEXT):
    run_report.write_html(folder / "report.html", rows, context, folder)
    return (folder / "report.html").read_text("utf-8")


def write_exr(path, pixels, names=("R", "G", "B")):
    save(path, np.ascontiguousarray(pixels, np.float32), channelnames=names)


# JSON


def test_json_keeps_every_row_and_is_strict(tmp_path):
    odd = {"a": np.arange(2), "nan": NAN}
    numpy = dataclasses.replace(GOOD, values={"worst": np.float32(0.5)}, replay=odd)
    run_report.write_json(tmp_path / "rows.json", [*ROWS, numpy], CONTEXT)
    document = json.loads((tmp_path / "rows.json").read_text(), parse_constant=pytest.fail)
    rows = [Row.from_dict(data) for data in document["rows"]]
    assert repr(rows[:-1]) == repr(ROWS)  # by repr: NaN is not equal to itself
    assert rows[-1].values == {"worst": 0.5}
    assert rows[-1].replay == {"a": [0, 1], "nan": "nan"}
    assert [data["verdict"] for data in document["rows"]] == ["pass", "fail", "not run", "info", "fail"]
    assert (document["schema"], document["context"]) == (1, CONTEXT)


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"Case": "x"}, "missing required field `case`"),
        ({"case": "x", "values": {"worst": "small"}}, "Expected `float`, got `str` - at `$.values"),
        ({"case": "x", "values": {}, "reason": ""}, "neither values nor the reason why it was not run"),
        ({"case": "x", "values": {"y": 1.0}, "budgets": {"worst": 1.0}}, "a bound without a value: ['worst']"),
    ],
)
def test_invalid_rows_are_errors_in_one_line(fields, complaint):
    with pytest.raises(ValueError, match=re.escape(complaint)) as caught:
        Row.from_dict({"study": "s", "subject": "x", "setting": "", **fields})
    assert "\n" not in str(caught.value)


# JUnit and terminal

EVIL = "a\nb\x1b[31m\udcff\uffff\u2028\u202e<>&\x85"


def test_junit_counts_budgets_and_leaves_out_rows_that_cannot_fail(tmp_path):
    rows = [*ROWS, dataclasses.replace(GOOD, study="goals", goals={"time": 1.1})]
    assert rows[-1].missed
    run_report.write_junit(tmp_path / "junit.xml", rows, CONTEXT)
    root = xml.parse(tmp_path / "junit.xml").getroot()
    assert [root.get(key) for key in ("tests", "failures", "skipped", "errors")] == ["5", "2", "1", "0"]
    directions, speed, goals = root
    assert (directions.get("name"), len(directions), len(speed)) == ("directions", 4, 0)
    cases = {case.get("name"): case for case in directions}
    assert len(cases["promoted / generic / llvm float32: worst"]) == 0
    assert cases["cross / generic / llvm float32: worst"][0].get("message") == "worst nan, budget 1e-3"
    assert "0x1.8p+0" in cases["cross / generic / llvm float32: misjudged"][0].text
    assert cases["cross / generic / cuda float32"][0].get("message") == "no CUDA device \ufffd[0m"
    assert [case.get("name") for case in goals] == ["promoted / generic / llvm float32: worst"]  # not the goal


def test_junit_counts_outcomes_per_suite_and_in_total(tmp_path):
    cases = [
        documents.Case("g", "passed"),
        documents.Case("g", "failed", "failure", "why", ["one", "two"], "different"),
        documents.Case("g", "broken", "error", EVIL, [EVIL]),
        documents.Case("g", "left out", "skipped", "no device"),
    ]
    documents.write_junit(tmp_path / "out.xml", EVIL, {"first": cases, "empty": [], "last": cases[:2]})
    root = xml.parse(tmp_path / "out.xml").getroot()
    counts = [" ".join(suite.get(key) for key in ("tests", "failures", "errors", "skipped")) for suite in (root, *root)]
    assert counts == ["6 2 1 1", "4 1 1 1", "0 0 0 0", "2 1 0 0"]
    failure, error, skipped = (case[0] for case in root[0] if len(case))
    expected = "failure", {"type": "different", "message": "why"}, "one\ntwo"
    assert (failure.tag, failure.attrib, failure.text) == expected
    assert error.get("message") == error.text == root.get("name") == printable(EVIL)
    assert (skipped.tag, skipped.get("type"), skipped.text) == ("skipped", None, None)


def printed(table):
    console = pytest.importorskip("rich.console").Console(width=120, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


def test_the_terminal_shows_answers_then_broken_budgets_with_literal_names():
    page = {"answers": [{"question": "Is it [red]right?", "text": "`No`.", "state": "no", "study": "speed"}]}
    rows = [*ROWS, dataclasses.replace(BAD, subject="[red]x")]
    text = printed(run_report.summary(rows, {"first_page": page}))
    words = "Is it [red]right?", "No.", "cross / generic / llvm float32", "[red]x / generic", "4 of 5 checks failed"
    order = [text.index(word) for word in words]
    assert order == sorted(order)
    goals = [dataclasses.replace(GOOD, subject=f"goal {limit}", goals={"time": limit}) for limit in (2.0, 1.1)]
    text = printed(run_report.goals_table(goals))
    assert text.index("goal 1.1 / generic") < text.index("goal 2.0 / generic")  # the missed one
    assert printed(run_report.goals_table(ROWS)) == "No goal was measured\n"
    assert run_report.verdict(goals) == "All 2 checks passed"


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        ([GOOD, GOOD], "All 2 checks passed"),
        ([GOOD], "The one check passed"),
        ([BAD, GOOD], "2 of 3 checks failed"),
        ([GOOD, GOOD, ABSENT], "All 2 checks passed, 1 measurement not run"),
        ([INFO], "Nothing was checked"),
        ([], "Nothing was checked"),
    ],
)
def test_the_verdict_of_all_rows(rows, sentence, tmp_path):
    assert run_report.verdict(rows) == sentence
    assert f"<h1>{sentence}</h1>" in html(tmp_path, rows)


# HTML


def test_html_fetches_nothing_and_escapes_names(tmp_path):
    write_exr(tmp_path / "a.exr", np.zeros((2, 2, 3)))
    text = html(tmp_path, [*ROWS, dataclasses.replace(INFO, case="again", images={'"><script>': "a.exr"})])
    assert_stands_alone(text)
    assert {target.partition("#")[0] for target in re.findall(r'href="([^"]*)"', text)} == {"", "rows.json"}
    assert "&lt;script&gt;alert(1)" in text and "Not &lt;b&gt;bold" in text
    assert "<script>alert" not in text and '"><script>' not in text


def test_html_is_complete_reproducible_and_contains_the_rows_of_each_section(tmp_path):
    text = html(tmp_path)
    assert text == html(tmp_path)
    order = [text.index(f'id="{section}"') for section in ("failures", "study-1", "missing")]
    assert order == sorted(order)
    numbers = "≰ 1e-3", "&gt; 0", "≤ 6e-8", "-inf", "0x1.8p+0"
    for words in (*numbers, "no CUDA device", "mitsuba 3.9.1", "$k$ &amp;"):
        assert words in text, words
    assert "Not drawn: 2 points" in text  # of curve b
    run_report.write_json(tmp_path / "rows.json", ROWS, CONTEXT)
    written = json.loads((tmp_path / "rows.json").read_text())["rows"]
    for key, rows in (("study-1", written[:3]), ("study-2", written[3:])):
        assert f'href="rows.json" download="{key}.json" data-rows="{key}-rows">{len(rows)} row' in text
        data = re.search(f'id="{key}-rows">([^<]*)<', text)[1]
        assert json.loads(zlib.decompress(base64.b64decode(data))) == rows


def test_rows_that_share_no_metric_have_separate_tables(tmp_path):
    """`c` shares a metric with `a` and one with `d`; `b` shares none with them; `e` was not run."""
    values = {"a": {"x": 1.0}, "b": {"y": 2.0}, "c": {"x": 3.0, "z": 4.0}, "d": {"z": 5.0}, "e": {}}
    rows = [Row("study", name, "case", "here", x, reason="" if x else "lost") for name, x in values.items()]
    text = html(tmp_path, [*rows, Row("study", "e", "other case", "here", {"y": 6.0})], {})
    tables = [table.partition("<tbody>") for table in re.findall(r'<table class="rows">.*?</table>', text, re.S)]
    assert [re.findall(r">\s*([xyz])\s*<", head) for head, _, _ in tables] == [["x", "z"], ["y"]]
    assert ["".join(re.findall(r">([a-e])<", body)) for _, _, body in tables] == ["acd", "be"]


def test_the_matrix_marks_rows_whose_other_metric_broke(tmp_path):
    pairs = itertools.product("abc", "xyz")
    rows = [Row("directions", s, c, "llvm", {"worst": 1e-8, "misjudged": 0.0}, {"misjudged": 0.0}) for s, c in pairs]
    assert '<table class="matrix"' in html(tmp_path, rows)
    assert '<table class="matrix"' not in html(tmp_path, rows[:6])
    rows[4] = dataclasses.replace(rows[4], values={"worst": 1e-8, "misjudged": 7.0})
    rows[5] = dataclasses.replace(rows[5], values={"misjudged": 8.0})
    rows[6] = dataclasses.replace(rows[6], values={"worst": NAN}, budgets={})
    rows[7] = dataclasses.replace(rows[7], values={}, reason="lost")
    text = html(tmp_path, rows)
    assert re.search(r'<td class="fail" [^>]*>1e-8<small>misjudged 7 &gt; 0</small>', text)
    assert re.search(r'<td class="fail" [^>]*>·<small>misjudged 8 &gt; 0</small>', text)
    assert re.search(r'<td class="info beyond" style="--depth:1" [^>]*>nan<', text)
    assert re.search(r'<td class="not-run" [^>]*title="lost">not run<', text)


def test_the_colour_scale_and_numbers_beyond_it(tmp_path):
    values = itertools.cycle([1e-12, 1.0, 1e4, 1e8, 2e69, INF])
    rows = [Row("s", s, c, "", {"error": next(values)}) for s, c in itertools.product("abc", "xyz")]
    shown = html(tmp_path, rows, {"studies": {"s": {"scale": (1.0, 1e8)}}})
    cells = dict(re.findall(r'<td class="([^"]*" style="--depth:[^"]*)" [^>]*>([^<]*)<', shown))
    assert cells == {
        'info" style="--depth:0': "1",
        'info" style="--depth:0.5': "10000",
        'info" style="--depth:1.0': "1e8",
        'info beyond" style="--depth:1': "inf",
    }
    assert '<span>1</span><i></i><span>1e8</span><i class="beyond">' in shown


def test_wide_matrices_are_transposed_and_wide_tables_split(tmp_path):
    """Too many cases for the columns become the lines of a matrix; too many metrics get a second table."""
    rows = [Row("s", s, f"case {i}", "", {"x": 1.0 + i}) for s in "abc" for i in range(20)]
    head = re.search(r'class="matrix".*?<thead>(.*?)</thead>', html(tmp_path, rows, {}), re.S)[1]
    assert re.findall("<th>(.*?)</th>", head) == ["a", "b", "c"]
    values = {f"measurement{i}": 1.0 for i in range(20)}
    text = html(tmp_path, [Row("s", x, "", "", values, replay={"seed": 1}) for x in "ab"], {})
    heads = [re.findall("<th>(.+?)</th>", head) for head in re.findall("<thead>(.*?)</thead>", text, re.S)]
    assert len(heads) > 1 and list(itertools.chain(*heads)) == list(values)
    assert text.count("<summary>replay</summary>") == 2


def test_images_are_embedded_exactly_and_once(tmp_path):
    pixels = np.random.default_rng(3).normal(size=(3, 5, 3)) * 10.0 ** np.arange(-3, 2)[:, None]
    pixels[0, 0] = NAN, 1e9, -0.0
    write_exr(tmp_path / "a.exr", pixels)
    write_exr(tmp_path / "gray.exr", pixels[..., :1], names=("Y",))
    row = dataclasses.replace(GOOD, images={"reference": "a.exr", "test": "gray.exr"})
    text = html(tmp_path, [row, row])
    data = re.findall(r'<script type="text/plain" id="p\d" data-channels="(\d)" data-scale="1.0">([^<]*)<', text)
    assert [channels for channels, _ in data] == ["3", "1"]
    planes = [np.frombuffer(zlib.decompress(base64.b64decode(d)), "u1").reshape(2, -1) for _, d in data]
    halves = [(high.astype("u2") << 8 | low).view("f2").reshape(3, 5, -1) for high, low in planes]
    expected = np.clip(pixels.astype(np.float32), -65504, 65504).astype(np.float16)
    assert re.findall(r'data-pixels="([^"]*)"', text) == ["p0", "p1"] * 2
    np.testing.assert_array_equal(halves[0], expected)
    np.testing.assert_array_equal(halves[1], expected[..., :1])


def test_an_image_that_cannot_be_shown_is_an_error_and_keeps_the_old_page(tmp_path):
    before = html(tmp_path)
    (tmp_path / "text.exr").write_text("no image")
    write_exr(tmp_path / "two.exr", np.zeros((2, 2, 2)), names=("R", "G"))
    for name, error in (("gone.exr", FileNotFoundError), ("text.exr", ValueError), ("two.exr", ValueError)):
        with pytest.raises(error, match=re.escape(str(tmp_path / name))):
            html(tmp_path, [dataclasses.replace(GOOD, images={"test": name})])
    assert (tmp_path / "report.html").read_text("utf-8") == before


def test_curves_have_a_guide_and_literal_names():
    axes = Axes("seconds", "relMSE", slope=-1)
    svg = curves_svg({"$x$": [(1, 1e-2), (10, 1e-3)]}, axes, salt="s")
    assert "slope −1" in svg and ">$x$</text>" in svg and "var(--c0)" in svg
    assert ">seconds</text>" in svg and ">relMSE</text>" in svg
    assert not re.search(r"#[0-9a-f]{6}", svg)  # every colour is one of the page's, which may be dark
    assert curves_svg({"x": [(1, 0), (NAN, 1)]}, axes, salt="s") == ""
    svg = curves_svg({f"line {i}": [(1, i + 1), (2, i + 1)] for i in range(12)}, axes, salt="s")
    style = (documents.TEMPLATES / "report.css").read_text("utf-8")
    values = [re.findall(rf"{name}: (#\w+)", style) for name in set(re.findall(r"--c\d+", svg))]
    assert len({light for light, _ in values}) == len({dark for _, dark in values}) == 12
    svg = curves_svg({"n = 1.5168": [(1, 0.001), (2, 0.003)]}, Axes("x", "y", "linear", "linear"), salt="s")
    assert ">n = 1.5168</text>" in svg and re.search(r">0\.0010*</text>", svg)
    assert not re.search(r'"[^">]*\d\.\d{3}', svg)  # coordinates
    for wrong in ({"x_scale": "cubic"}, {"slope": 2, "y_scale": "linear"}):
        with pytest.raises(ValueError, match="axes: "):
            Axes(**wrong)


@pytest.mark.parametrize(
    ("scales", "left_out"),
    [({}, 2), ({"x_scale": "linear"}, 1), ({"y_scale": "linear"}, 1), ({"x_scale": "linear", "y_scale": "linear"}, 0)],
)
def test_points_that_cannot_be_drawn_depend_on_the_scales(scales, left_out, tmp_path):
    axes = {"x": "height", "y": "turn", **scales}
    row = dataclasses.replace(INFO, curves={"a": [(-1.0, 1.0), (1.0, -1.0), (1.0, 1.0), (2.0, 3.0)]})
    text = html(tmp_path, [row], {"studies": {"speed": {"axes": axes}}})
    assert ">height</text>" in text and ">turn</text>" in text
    assert [int(n) for n in re.findall(r"Not drawn: (\d+) point", text)] == [left_out] * bool(left_out)
    assert "slope" not in text


def test_a_scatter_shows_front_floor_and_intervals_on_request(tmp_path):
    def paths(**more):
        scatter = {"study": "s", "x": "time", "y": "worst", **more}
        text = html(tmp_path, rows, {"scatter": [scatter, {**scatter, "x": "absent"}]})
        assert text.count('class="plot wide"') == 1  # a metric that no row has is not drawn
        return text.count("<path"), text

    rows = [
        Row("s", name, "", "llvm", {"time": x, "low": x - 0.1, "high": x + 0.1, "worst": y})
        for name, x, y in (("a", 1.0, 1e-3), ("b", 2.0, 1e-6), ("c", 3.0, 1e-5))
    ]
    rows.append(Row("s", "copy", "", "llvm", {"time": 0.9}))
    plain, text = paths()
    assert ">copy</text>" not in text
    assert paths(front=True)[0] == plain + 1
    assert pareto([(2, 5), (1, 9), (3, 5), (1, 8), (4, 1), (5, 2)]) == [(1, 8), (2, 5), (4, 1)]
    floored, text = paths(floor="copy")
    assert floored == plain + 1 and ">copy</text>" in text
    wide = paths(interval=["low", "high"])[1]
    assert wide.count("<path") == plain and wide != text


def test_no_line_of_a_scatter_crosses_a_label():
    """Points close to each other with the floor's line between them, and the front right of the last point."""
    points = {name: [(1 + 0.01 * i, 10.0**i)] for i, name in enumerate(["first", "second", "third"])}
    panel = Scatter(points | {"last": [(2.0, 0.1)]}, [("last", 1.9, 2.1, 0.1)], floor=1.03)
    svg = scatter_svg({"here": panel}, Axes("x", "y", "linear"), floor="floor", front=True, salt="s")
    places = re.findall(r'x="([\d.]+)" y="([\d.]+)"[^>]*>(\w+)</text>', svg)
    names = {name: (float(x), float(y)) for x, y, name in places if name in [*points, "last", "floor"]}
    assert len(names) == 5, svg
    for d in re.findall(r'<path d="(M[^"z]*)" clip-path="[^"]*" style="[^"]*stroke: var\(--(?!line)', svg):
        corners = [tuple(map(float, pair)) for pair in re.findall(r"([\d.]+) ([\d.]+)", d)]
        for (x0, y0), (x1, y1) in itertools.pairwise(corners):  # vertical or horizontal segments
            for name, (x, y) in names.items():
                across = max(min(x0, x1), x) < min(max(x0, x1), x + 5 * len(name))
                assert not (across or x <= x0 == x1 <= x + 5 * len(name)) or not (
                    min(y0, y1) < y - 1 and y - 6 < max(y0, y1)
                ), (name, d)


def test_a_scatter_has_a_panel_per_setting():
    """In rows of two: the last place of an odd number stays empty. An empty panel would have ticks from 0.0 to 1.0."""
    panels = {name: Scatter({"one": [(10.0, 20.0), (30.0, 40.0)]}, []) for name in ("llvm", "cuda", "scalar")}
    svg = scatter_svg(panels, Axes("x", "y", "linear"), floor="floor", front=False, salt="s")
    assert svg.count(">one</text>") == 3 and not re.search(r">0\.\d</text>", svg)


def test_images_of_a_row_have_a_fixed_order(tmp_path):
    write_exr(tmp_path / "a.exr", np.zeros((2, 2, 3)))
    images = dict.fromkeys(("overlay", "extra", "difference", "test", "reference"), "a.exr")
    text = html(tmp_path, [dataclasses.replace(GOOD, images=images)])
    assert re.findall('data-role="([^"]*)"', text) == ["reference", "test", "overlay", "difference", "extra"]
    assert 'class="compare paired"' in text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.234e-7, "1.23e-7"),
        (0.98, "0.98"),
        (8056.0, "8056"),
        (0.0, "0"),
        (1e-3, "1e-3"),
        (1234.56, "1235"),
        (999.7, "1000"),
        (-2.5e-9, "-2.5e-9"),
        (1e300, "1e300"),
        (99999.7, "100000"),
        (INF, "inf"),
        (NAN, "nan"),
        (0.01, "0.01"),
    ],
)
def test_compact(value, text):
    assert compact(value) == text


def test_a_value_beyond_its_budget_is_distinguishable_from_it():
    assert distinguishable(1.3001e-5, 1.3e-5) == ("1.3001e-5", "1.3e-5")
    value, budget = distinguishable(math.nextafter(1.0, 2), 1.0)
    assert value != budget


# The first screen

ANSWER = {"question": "Is `it` right?", "text": "Up to <2> `ulp`.", "state": "yes", "study": "directions"}
CURVES = Row("speed", "all", "balls", "llvm", {"time": 1.0}, curves={"a": [(1.0, 0.1), (2.0, 0.05)], "b": [(1.0, 1.0)]})
IMAGES = Row("renders", "refract", "mirage", "llvm", {"changed": 0.1}, images={"reference": "a.exr", "test": "a.exr"})
AXES = {"x": "seconds", "slope": -0.5}
PAGE = {
    "lead": "`refract` is glass.",
    "answers": [ANSWER, {**ANSWER, "state": "not measured", "study": NOT_RUN}],
    "image": {"row": IMAGES.name, "labels": {"test": "ours"}, "caption": "The `mirage`."},
    "plot": {"row": CURVES.name, "labels": {"a": "first"}, "axes": AXES, "caption": "Speed."},
}


def test_the_order_of_failures_answers_studies_and_missing_rows(tmp_path):
    write_exr(tmp_path / "a.exr", np.full((4, 4, 3), 0.5))
    both = {"worst": 1.0, "p99": 1.0}
    broken = [dataclasses.replace(GOOD, values=both, budgets=dict.fromkeys(both, 0.5), case=str(i)) for i in range(5)]
    absent = [Row("speed", name, "", "cuda", reason="no GPU" if name < "d" else "no time") for name in "dabc"]
    text = html(tmp_path, [GOOD, CURVES, IMAGES, *broken, *absent], {"first_page": PAGE})
    parts = "10 of 11 checks failed", 'class="broken"', "and 4 more", 'class="answers"', 'id="study-1"', 'id="missing"'
    order = [text.index(words) for words in parts]
    assert order == sorted(order)
    assert [len(re.findall(words, text)) for words in ("Failures <b>10</b>", '<b class="bad">10</b>')] == [1, 1]
    assert "p99 <b>1</b> &gt; 0.5 allowed</li>" in text
    assert "Is <code>it</code> right?" in text and "Up to &lt;2&gt; <code>ulp</code>." in text
    assert '<a href="#study-1">More</a>' in text and '<a href="#missing">More</a>' in text
    assert re.findall(r'class="(yes|not-measured)"', text) == ["yes", "not-measured"]
    first, missing = text[: text.index("<nav")], text[order[-1] :]
    assert first.count("<canvas") == 1 and ">first</text>" in first and ">b</text>" not in first
    assert "first_page" not in text
    assert re.findall(r"<b>(\d)</b> not run: (no \w+)", missing) == [("3", "no GPU"), ("1", "no time")]


@pytest.mark.parametrize(
    ("page", "complaint"),
    [
        ({"answers": [{**ANSWER, "state": "maybe"}]}, "state 'maybe'; expected yes, no, plain, not measured"),
        ({"answers": [], "plot": {**PAGE["plot"], "row": "none"}}, "there is no row 'none'"),
    ],
)
def test_invalid_first_pages_are_errors(tmp_path, page, complaint):
    with pytest.raises(ValueError, match=complaint):
        html(tmp_path, [CURVES], {"first_page": page})


# In a browser

PROBE = """
  const pixel = (role, x) => {
    const copy = document.createElement("canvas").getContext("2d");
    copy.drawImage($(`[data-role=${role}] canvas`), 0, 0);
    return [...copy.getImageData(x, 0, 1, 1).data].slice(0, 3);
  };
  const seen = { test: pixel("test", 0), nan: pixel("test", 1), difference: pixel("difference", 0) };
  press("x");
  press("]");
  press("]");
  seen.brighter = pixel("test", 0);
  press("f");
  seen.mode = root.dataset.mode;
  const box = $("[data-role=reference] .frame").getBoundingClientRect();
  const at = { bubbles: true, clientX: box.left + 1, clientY: box.top + 1 };
  $("[data-role=reference] canvas").dispatchEvent(new PointerEvent("pointermove", at));
  seen.read = $("[data-role=reference] .pixel").value;
"""


@needs_chromium
def test_the_page_works_in_a_browser_from_a_file(tmp_path):
    for role, value in (("reference", 0.25), ("test", 0.5), ("difference", -1.0)):
        pixels = np.full((2, 2, 3), value)
        pixels[0, 1, 1] = NAN
        write_exr(tmp_path / f"{role}.exr", pixels)
    images = {role: f"{role}.exr" for role in ("reference", "test", "difference")}
    text = html(tmp_path, [*ROWS, dataclasses.replace(GOOD, images=images)])
    assert seen(tmp_path, text, PROBE) == {
        "test": [188, 188, 188],  # sRGB of 0.5
        "nan": [255, 0, 255],
        "difference": [33, 102, 172],  # negative: blue
        "brighter": [255, 255, 255],  # one stop up
        "mode": "flicker",
        "read": "0.25  0.25  0.25",
    }
