"""The first screen: answers with their state, one image, one plot, and what is broken before anything else."""

import dataclasses
import re

import numpy as np
import pytest

from mi_refract.io.image_file import write_exr
from mi_refract.report import first_page, run_report
from mi_refract.report.row import Row

GOOD = Row("directions", "promoted", "generic", "llvm", {"worst": 5e-8}, {"worst": 6e-8})
BAD = dataclasses.replace(GOOD, subject="cross", values={"worst": 1.0})
CURVES = Row("speed", "all", "balls", "llvm", {"time": 1.0}, curves={"a": [(1.0, 0.1), (2.0, 0.05)], "b": [(1.0, 1.0)]})
IMAGES = Row("renders", "refract", "mirage", "llvm", {"changed": 0.1}, images={"reference": "a.exr", "test": "a.exr"})
ROWS = [GOOD, CURVES, IMAGES]
ANSWER = {"question": "Is `it` right?", "text": "Up to <2> `ulp`.", "state": "yes", "study": "directions"}
PAGE = {
    "lead": "`refract` is glass.",
    "answers": [ANSWER, {**ANSWER, "state": "not measured", "study": first_page.NOT_RUN}],
    "image": {"row": IMAGES.name, "labels": {"test": "ours"}, "caption": "The `mirage`."},
    "plot": {
        "row": CURVES.name,
        "labels": {"a": "first"},
        "axes": {"x": "seconds", "slope": -0.5},
        "caption": "Speed.",
    },
}


def html(folder, rows, page):
    write_exr(folder / "a.exr", np.full((4, 4, 3), 0.5, np.float32))
    run_report.write_html(folder / "report.html", rows, {"first_page": page}, folder)
    return (folder / "report.html").read_text("utf-8")


def test_answers_stand_before_the_studies_and_lead_to_them(tmp_path):
    text = html(tmp_path, ROWS, PAGE)
    assert "Is <code>it</code> right?" in text and "Up to &lt;2&gt; <code>ulp</code>." in text
    assert '<a href="#study-1">More</a>' in text and '<a href="#missing">More</a>' in text
    assert text.index('class="answers"') < text.index('id="study-1"')
    assert re.findall(r'class="(yes|not-measured)"', text) == ["yes", "not-measured"]
    first = text[: text.index("<nav")]
    assert first.count("<canvas") == 1 and ">first</text>" in first and ">b</text>" not in first
    assert "first_page" not in text


def test_what_is_broken_comes_before_the_answers(tmp_path):
    text = html(tmp_path, [*ROWS, *[dataclasses.replace(BAD, case=str(i)) for i in range(5)]], PAGE)
    order = [text.index(words) for words in ("5 of 6 checks failed", 'class="broken"', "and 2 more", 'class="answers"')]
    assert order == sorted(order)


@pytest.mark.parametrize(
    ("page", "complaint"),
    [
        ({"answers": [{**ANSWER, "state": "maybe"}]}, "state 'maybe'; expected yes, no, plain, not measured"),
        ({"answers": [], "plot": {**PAGE["plot"], "row": "none"}}, "there is no row 'none'"),
    ],
)
def test_a_page_that_cannot_be_shown_is_an_error(tmp_path, page, complaint):
    with pytest.raises(ValueError, match=complaint):
        html(tmp_path, ROWS, page)


def test_rows_not_run_are_one_line_per_reason(tmp_path):
    absent = [Row("speed", name, "", "cuda", reason="no GPU") for name in "abc"]
    absent.append(Row("speed", "d", "", "llvm", reason="no time"))
    groups = first_page.not_run([*absent[3:], *absent[:3]])
    assert {reason: len(found) for reason, found in groups.items()} == {"no GPU": 3, "no time": 1}
    text = html(tmp_path, [*ROWS, *absent], PAGE)
    section = text[text.index('id="missing"') :]
    assert section.count("<summary>") == 2 and "<b>3</b> not run: no GPU" in section
