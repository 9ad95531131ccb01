"""The tables of a study."""

import re

from mi_refract.report import run_report
from mi_refract.report.row import Row


def test_rows_that_share_no_metric_have_tables_of_their_own(tmp_path):
    """`c` shares one with `a` and one with `d`; nobody does with `b`; `e` was not run."""
    values = {"a": {"x": 1.0}, "b": {"y": 2.0}, "c": {"x": 3.0, "z": 4.0}, "d": {"z": 5.0}, "e": {}}
    rows = [Row("study", name, "case", "here", each, reason="" if each else "lost") for name, each in values.items()]
    rows.append(Row("study", "e", "other case", "here", {"y": 6.0}))
    run_report.write_html(tmp_path / "report.html", rows, {}, tmp_path)
    tables = re.findall(r'<table class="rows">.*?</table>', (tmp_path / "report.html").read_text("utf-8"), re.S)
    found = [("".join(re.findall(r">(\w)<", each.partition("<tbody>")[2]))) for each in tables]
    headings = [re.findall(r">\s*([xyz])\s*<", each.partition("<tbody>")[0]) for each in tables]
    assert headings == [["x", "z"], ["y"]]
    assert [re.sub("[^a-e]", "", each) for each in found] == ["acd", "be"]
