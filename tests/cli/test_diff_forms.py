"""`mi-refract diff` for programs: JSON, JUnit XML and GitHub's annotations, with names that are anything but text."""

from __future__ import annotations

import json
import shlex
from xml.etree import ElementTree

import pytest
from support.diff_images import BROKEN, image

from mi_refract.image_diff import text_reports
from mi_refract.image_diff.results import Result, Results, Status

EVIL = 'a"b<script>alert(1)</script>|`*[x](y)*`,:%0A::error::.exr'


@pytest.fixture
def strange(pair):
    """The pair with a third whose name is anything but text, added."""
    name = EVIL.replace("/", "∕")
    image(pair[1] / "inner.exr")
    (pair[1] / "inner.exr").rename(pair[1] / name)
    return pair, name


def test_json(run, strange, tmp_path):
    (old, new), name = strange
    out = tmp_path / "out.json"
    assert run("diff", old, new, "--json", out)[0] == 1

    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    data = json.loads(out.read_text(), parse_constant=refuse)
    assert data["schema"] == 1
    assert data["exit_code"] == 1
    assert data["counts"] == {"error": 0, "different": 2, "inconclusive": 0, "equal": 1, "skipped": 0}
    by_name = {result["name"]: result for result in data["results"]}
    assert by_name[name]["category"] == "added"
    assert by_name[name]["reference"] is None
    changed = by_name["louder.exr"]
    assert (changed["status"], changed["category"]) == ("different", "changed")
    assert changed["test"] == str(new / "louder.exr")
    assert any(metric["bound"] is not None and metric["value"] > metric["bound"] for metric in changed["metrics"])
    assert changed["reproduce"] == shlex.join(["mi-refract", "diff", f"{old}/louder.exr", f"{new}/louder.exr"])
    assert run(*shlex.split(changed["reproduce"])[1:])[0] == 1


def test_junit(run, strange, tmp_path):
    (old, new), name = strange
    (new / "equal.exr").unlink()
    out = tmp_path / "out.xml"
    assert run("diff", old, new, "--junit", out)[0] == 1
    root = ElementTree.parse(out).getroot()
    assert [root.get(key) for key in ("tests", "failures", "errors", "skipped")] == ["3", "3", "0", "0"]
    failures = {case.get("name"): case.find("failure") for case in root.iter("testcase")}
    assert {name: failure.get("type") for name, failure in failures.items()} == {
        name: "added",
        "equal.exr": "removed",
        "louder.exr": "different",
    }
    assert "reproduce: mi-refract diff " in failures["louder.exr"].text


def test_github(run, strange, tmp_path, monkeypatch):
    (old, new), _ = strange
    BROKEN["empty"](new / "equal.exr")
    summary = tmp_path / "summary.md"
    summary.write_text("before\n")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    code, out, _ = run("diff", old, new, "--github")
    assert code == 2
    commands = [line for line in out.splitlines() if line.startswith("::")]
    assert len(commands) == 3
    assert all(line.startswith(f"::error file={new}/") for line in commands)
    assert sum("title=louder.exr%3A different::" in line for line in commands) == 1
    (evil,) = [line for line in commands if "script" in line]
    file, _, rest = evil.removeprefix("::error ").partition("::")
    assert rest == "only among the new images"
    assert file.count(",") == 1 and ":" not in file and "%250A" in file
    text = summary.read_text()
    assert text.startswith("before\n### mi-refract diff: 3 images: 1 could not be compared, 2 different\n")
    assert "<script>" not in text and "`" not in text
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 4
    assert all(row.count("|") == 5 for row in rows)


def test_github_without_a_summary(run, pair, monkeypatch):
    monkeypatch.delenv("GITHUB_STEP_SUMMARY", raising=False)
    code, out, err = run("diff", *pair, "--github")
    assert (code, err) == (1, "")
    assert sum(line.startswith("::error ") for line in out.splitlines()) == 1
    (pair[1] / "louder.exr").write_bytes((pair[0] / "louder.exr").read_bytes())
    code, out, err = run("diff", *pair, "--github")
    assert (code, out.splitlines()[-1]) == (0, "2 images: 2 equal")


def test_strangers_words_stay_text(tmp_path):
    """Line ends and terminal escapes in names, surrogates of names that are no UTF-8, characters XML lacks."""
    name = "a\n::error::b\x1b[31m\udcff\uffff\u2028\u202e.exr"
    result = Result(name, Status.ERROR, tmp_path, tmp_path, error=name)
    results = Results(tmp_path, tmp_path, (result,))
    forms = [*text_reports.workflow_commands(results), text_reports.markdown(results).partition("|---|\n")[2]]
    text_reports.write_junit(tmp_path / "out.xml", results)
    text_reports.write_json(tmp_path / "out.json", results)
    forms.append(ElementTree.parse(tmp_path / "out.xml").find(".//testcase").get("name"))
    for form in forms:
        form.encode()
        assert not {"\x1b", "\u202e", "\u2028", "\uffff"} & {*form}
        assert "\n" not in form.strip()
    assert json.loads((tmp_path / "out.json").read_text())["results"][0]["name"] == name


def test_many_equal_images_are_counted_and_not_listed(tmp_path, run):
    for i in range(text_reports.FEW + 2):
        for side in ("old", "new"):
            image(tmp_path / side / f"{i}.exr", shape=(4, 4, 3))
    code, out, _ = run("diff", tmp_path / "old", tmp_path / "new")
    lines = out.splitlines()
    assert code == 0
    assert len(lines) == text_reports.FEW + 3
    assert lines[-2:] == [
        "… and 2 more that are equal",
        f"{text_reports.FEW + 2} images: {text_reports.FEW + 2} equal",
    ]


def test_a_long_summary_is_cut(tmp_path):
    number = text_reports.SUMMARY_ROWS + 7
    results = tuple(Result(f"{i}.exr", Status.ERROR, tmp_path, tmp_path, error="bad") for i in range(number))
    text = text_reports.markdown(Results(tmp_path, tmp_path, results))
    assert text.count("| error |") == text_reports.SUMMARY_ROWS
    assert text.endswith("\n\n… and 7 more\n\n")
