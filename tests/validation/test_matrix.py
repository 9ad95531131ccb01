"""The matrix of systems and checks, from the rows of other studies; as a table, a page and JSON."""

from __future__ import annotations

import json
import math

import pytest

from mi_refract.ray_sets.renderer_file import ImagesCommand, RaysCommand
from mi_refract.report.row import Row
from validation import __main__ as command
from validation import limits
from validation.suite import matrix, per_ray, rendered_images
from validation.suite.per_ray import CRITICAL, LARGE
from validation.suite.renderers import System

REPLAY = {"version": "A 1.0", "total internal reflection": "zero", "remark": "known"}
ONE = {"worst rad": 1e-6}


def ray(subject="A", case="random", precision="f32", values=ONE, wrong=0.0, goals=()):
    values, reason = values | {"wrong": wrong}, "A 1.2; zero"
    return Row(per_ray.NAME, subject, case, precision, values, {"wrong": 0.0}, dict(goals), reason, REPLAY)


def image(subject="B", verdict="equal", differing=0.0, budgets=(("tests that differ", 0.0),), case="prism"):
    values, replay = {"mean difference": -0.02, "tests that differ": differing}, {"verdict": verdict, "renderer": "B 3"}
    return Row(rendered_images.NAME, subject, case, "64²", values, dict(budgets), reason="why", replay=replay)


def test_the_summary_has_the_numbers_and_verdicts_of_its_rows_and_precedes_them():
    other = Row("directions", "x", "y", "z", {"v": 1.0})
    summarised = [ray(), ray(case="near-critical", wrong=3.0), image(), image(verdict="different", differing=2.0)]
    summarised.append(image(verdict="different", differing=2.0, budgets=()))
    rows = matrix.with_summary([other, *summarised])
    assert rows[0] == other and rows[6:] == summarised and matrix.with_summary([other]) == [other]
    right, wrong, equal, different, known = rows[1:6]
    assert (right.study, right.subject, right.case, right.values[matrix.OFF]) == ("matrix", "A, f32", "random", 1e-6)
    assert [row.verdict for row in rows[1:6]] == ["pass", "fail", "pass", "fail", "pass"]
    assert wrong.values[matrix.FAILED] == 1.0
    assert (wrong.reason, equal.reason) == ("wrong 3 > 0 allowed; A 1.2; zero", "B 3; why")
    assert (equal.subject, equal.values[matrix.OFF]) == ("B", 0.02)
    assert [row.values["differs"] for row in (equal, different, known)] == [0, 1, 1]
    assert known.missed == {"differs": 0.0}


def test_a_missed_goal_is_shown_but_does_not_fail():
    goals = {per_ray.OFF_RECORDED: limits.RECORDED}
    rows = [ray(values=ONE | {"off the recorded": 3.67}, goals=goals)]
    rows += [ray("B", values=ONE | {"off the recorded": 2.9}, goals=goals)]
    rows += [ray("C", precision="f64", values=ONE | {"recorded": 4.5e-6, "off the recorded": 4.5}, goals=goals)]
    cells = matrix.summary(rows)
    assert [(cell.verdict, bool(cell.missed)) for cell in cells] == [("pass", True), ("pass", False), ("pass", True)]
    text, head, lines = matrix.table(cells)
    shown = {line[0]: line[1 + list(per_ray.SETS).index("random")] for line in lines}
    assert shown == {"A, f32": "1e-6 (3.67 × recorded)", "B, f32": "1e-6", "C, f64": "1e-6 (recorded / 4.5)"}
    assert head[1] == "random" and "a goal" in text and "fails nothing" in text
    with pytest.raises(ValueError, match="no other renderer was run"):
        matrix.table([])
    for study, checks in matrix.CHECKS.items():
        absent = matrix.summary([Row(study, "A", "every set", "f32", reason="pip install it")])
        assert [(cell.case, cell.verdict) for cell in absent] == [(case, "not run") for case in checks]


def test_other_seeds_are_no_systems_and_fail_the_checks_that_they_break():
    every = Row(per_ray.NAME, "every subject", "other seed 12", "", {"broken": 1.0}, {"broken": 0.0})
    skipped = Row(per_ray.NAME, "every subject", "other seed 2", "", reason="pip install it")
    rows = [ray(), ray(case=CRITICAL), every, skipped, ray(case=f"{CRITICAL}, other seed 12", wrong=3.0)]
    (line,) = matrix.table(matrix.summary(rows))[2]
    broken = [name for name, cell in zip(per_ray.SETS, line[1:], strict=False) if "✗" in cell]
    assert line[0] == "A, f32" and broken == [CRITICAL]
    stored = matrix.of_rows(row.as_dict() for row in rows)
    (system,) = stored["rays"]
    assert {name for name, x in system["sets"].items() if x["verdict"] == "wrong"} == {CRITICAL}
    assert len(system["sets"]) == 2 and not stored["not_run"]


@pytest.mark.parametrize(
    ("rows", "state"),
    [
        ([image()], "yes"),
        ([image(verdict="inconclusive")], "not measured"),
        ([image(verdict="inconclusive"), image(case="sphere")], "yes"),
        ([image(verdict="inconclusive", differing=2.0)], "no"),
        ([ray("B")], "yes"),
        ([ray("B"), ray("B", precision="f64", wrong=3.0), image("C", differing=2.0)], "yes"),  # of another system
        ([ray("B", wrong=3.0)], "no"),
        ([Row(rendered_images.NAME, "B", "every scene", "64²", reason="pip install it")], "not measured"),
    ],
)
def test_the_first_page_says_yes_of_a_users_renderer_only_if_a_check_was_conclusive(rows, state):
    own = System("b", "B", calls=(RaysCommand("B", "f32", ("b",)),), images=ImagesCommand("mitsuba", ("b",), {}))
    others = [System("c", "C", calls=(RaysCommand("D", "f32", ("c",)),))]
    (answer,) = matrix.answers([*rows, ray("another")], [own, *others])
    assert answer["state"] == state and answer["question"].startswith("Your renderer: B")


# The page ----------------------------------------------------------------------------------------------------------


def stored_rays(case, backward, title="A", verdict="pass", **more):
    values = {per_ray.BACKWARD: backward, "worst rad": 1e-7}
    row = {"study": per_ray.NAME, "subject": title, "case": case, "setting": "f32", "values": values}
    return row | {"verdict": verdict, "reason": "said", "replay": REPLAY} | more


def stored_image(title, verdict, row="pass"):
    cell = {"study": rendered_images.NAME, "subject": title, "case": "sphere", "setting": "64²"}
    cell |= {"values": {"mean difference": 1e-4}, "replay": {"verdict": verdict}}
    return cell | {"verdict": row, "reason": f"{verdict}: why"}


def test_systems_are_sorted_by_their_errors():
    rows = [stored_rays("random", 3.0, "far"), stored_rays("random", 1.0, "near"), stored_rays(LARGE, 900.0, "near")]
    rows += [stored_rays("random", 0.5, "wrong", "fail")]
    rows += [stored_rays("random", 1.0, "both"), stored_rays(LARGE, 2.0, "both")]
    flat = stored_rays("grazing", 9.0, "flat")
    flat["values"]["wrong"] = 3.0
    rows.append(flat | {"replay": REPLAY | {"known to deviate": "lies flat"}})
    systems = matrix.of_rows([*rows, stored_rays("random", "inf", "none")])["rays"]
    assert [system["system"] for system in systems] == ["both", "near", "far", "flat", "none", "wrong"]
    sentences = {system["system"]: system["sentence"] for system in systems}
    assert sentences["far"] == "right in every set; known" and sentences["wrong"] == "wrong: random; known"
    assert sentences["flat"] == "known to deviate: grazing (lies flat); known"
    assert sentences["near"] == f"exact only for inputs more than 8 roundings off: {LARGE} (up to 900); known"
    rows = [stored_image("A", "equal"), stored_image("B", "inconclusive"), stored_image("C", "different", "fail")]
    renderers = matrix.of_rows(rows)["images"]
    assert [(x["system"], x["wrong"]) for x in renderers] == [("A", False), ("B", False), ("C", True)]
    assert [x["sentence"].partition(":")[0] for x in renderers][1:] == ["inconclusive", "different"]


def test_the_command_writes_page_and_data_or_reports_missing_rows(tmp_path, capsys):
    html, data = tmp_path / "p.html", tmp_path / "p.json"
    words = ["renderers", "--page", str(html), "--json", str(data), "--out", str(tmp_path)]
    contents = (None, "no such file"), ("{", "no rows of a"), ('{"rows": [{"study": "x"}]}', "of other sys")
    for content, message in contents:
        if content:
            (tmp_path / "rows.json").write_text(content)
        assert command.main(words) == 2
        assert message in capsys.readouterr().err and not html.exists()
    rows = [stored_rays("random", 1.0), stored_rays("random", math.nan, "<b>", "fail")]
    rows += [stored_image("R", "equal"), stored_image("I", "inconclusive")]
    rows.append(stored_rays("every set", 0.0, "absent", "not run", values={}, reason="install it"))
    (tmp_path / "rows.json").write_text(json.dumps({"rows": rows}).replace("NaN", '"nan"'))
    assert command.main(words) == 0
    written = json.loads(data.read_text())
    assert [system["system"] for system in written["rays"]] == ["A", "<b>"] and written["schema"] == 1
    assert written["not_run"] == [{"system": "absent", "precision": "f32", "reason": "install it"}]
    page = html.read_text()
    assert "&lt;b&gt;" in page and "install it" in page and "src=" not in page
    assert '<td class="missed">inconclusive: +0.01%</td>' in page and '<td class="pass">equal: +0.01%</td>' in page
