"""JUnit's XML: how many cases ended how, and no character that XML or a terminal would take for more than text."""

from xml.etree import ElementTree

from mi_refract.io.sanitise import printable
from mi_refract.report.junit import Case, write_junit

EVIL = "a\nb\x1b[31m\udcff\uffff\u2028\u202e<>&\x85"


def test_every_ending_is_counted_in_its_suite_and_in_all(tmp_path):
    cases = [
        Case("g", "passed"),
        Case("g", "failed", "failure", "why", ["one", "two"], "different"),
        Case("g", "broken", "error", EVIL, [EVIL]),
        Case("g", "left out", "skipped", "no device"),
    ]
    write_junit(tmp_path / "out.xml", EVIL, {"first": cases, "empty": [], "last": cases[:2]})
    root = ElementTree.parse(tmp_path / "out.xml").getroot()
    keys = ("tests", "failures", "errors", "skipped")
    assert [[each.get(key) for key in keys] for each in (root, *root)] == [
        ["6", "2", "1", "1"],
        ["4", "1", "1", "1"],
        ["0", "0", "0", "0"],
        ["2", "1", "0", "0"],
    ]
    failure, error, skipped = (case[0] for case in root[0] if len(case))
    assert (failure.tag, failure.get("type"), failure.get("message"), failure.text) == (
        "failure",
        "different",
        "why",
        "one\ntwo",
    )
    assert error.get("message") == error.text == root.get("name") == printable(EVIL)
    assert (skipped.tag, skipped.get("type"), skipped.text) == ("skipped", None, None)
