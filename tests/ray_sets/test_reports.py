"""Reports of a check: the sentence for every kind of result, JSON, JUnit XML and the HTML page."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from support.browser import assert_stands_alone, browse, needs_chromium
from support.media_rays import ALL, FLINT, answered
from support.ray_programs import glsl

from mi_refract.io.reference_pack import origin
from mi_refract.ray_sets import check_answers, ray_set, reports
from mi_refract.ray_sets.check_answers import Findings, Problem, RegimeErrors
from mi_refract.ray_sets.diagnosis import Explanation
from mi_refract.ray_sets.ray_set import Answers
from mi_refract.ray_sets.tir_signal import NONE, UNCLEAR

ERRORS = ("p99", "mean", "length_error", "error_over_bound")
ERRORS += ("backward_median", "backward_p99", "backward_worst", "backward_length")
MISSING = Problem("missing", 3, "ids 1, 5, 8")
CERTAIN = Explanation("eta inverted", "k was n_to / n_from", 0.97, 1e-3, True)
LIKELY, NEVER = (Explanation("handedness", f"text {share}", share, math.nan, False) for share in (0.25, 0.0))


def regime(name="generic", worst=2e-7, **changes):
    counts = {"rays": 10, "compared": 9, "judged": 9, "wrong": 0, "right": 8, "exact": 4, "undecidable": 0}
    counts |= {"tir_misclassified": 0, "tir_beyond_bound": 0} | changes
    return RegimeErrors(name, worst=worst, **dict.fromkeys(ERRORS, 0.0), **counts, replay={})


def findings(*regimes, problems=(), explanations=(), tir="zero", tir_given=False):
    return Findings("f32", 2.0**-23, "decomposed", tir, tir_given, regimes, problems, explanations, {})


LARGEST = "the largest error is 3e-7 rad (critical)"
SOME_RIGHT = f"16 of 20 answers are right, 4 only within the error bound of the formula decomposed; {LARGEST}"
TWO = regime(), regime("critical", 3e-7)
UNDECIDABLE = "2 rays are undecidable (error bound above 0.1 rad)"
MISMATCH, WRONG = "10 answers, but they do not match the rays", "2 of 10 answers are wrong"
MISMATCH_AND_WRONG = f"{MISMATCH}; 2 of them are wrong"
NONE_OF_THEM = "none of the common mistakes explains the answers"
LINE = "eta inverted: k was n_to / n_from (97.0% of the answers on which it has an effect)"
HANDEDNESS = "handedness: text 0.25 (25.0% of the answers on which it has an effect)"
NEAREST = f"nearest of the common mistakes, no explanation: {HANDEDNESS}"


@pytest.mark.parametrize(
    ("result", "code", "sentence", "lines"),
    [
        (findings(), 2, "no ray was answered", []),
        (findings(*TWO), 0, SOME_RIGHT, []),
        (findings(*TWO, regime("k", math.nan, rays=0, compared=0, judged=0, right=0)), 0, SOME_RIGHT, []),
        (findings(*(replace(x, right=10) for x in TWO)), 0, f"20 answers, all right; {LARGEST}", []),
        (findings(regime(undecidable=2), TWO[1]), 0, f"{SOME_RIGHT}; {UNDECIDABLE}", []),
        (findings(regime(exact=10)), 0, "10 answers, all exact up to rounding", []),
        (findings(regime(wrong=2), explanations=(NEVER,)), 1, WRONG, [NONE_OF_THEM]),
        (findings(regime(), tir=UNCLEAR), 1, "0 of 10 answers are wrong", []),
        (findings(regime(wrong=2), explanations=(LIKELY, CERTAIN)), 1, f"{WRONG}: eta inverted", [LINE]),
        (findings(regime(wrong=2), explanations=(CERTAIN, CERTAIN)), 1, WRONG, [LINE, LINE]),
        (findings(regime(wrong=2), explanations=(NEVER, LIKELY)), 1, WRONG, [NEAREST]),
        (findings(regime(), problems=(MISSING,)), 2, MISMATCH, []),
        (findings(regime(wrong=2), problems=(MISSING,), explanations=(LIKELY,)), 2, MISMATCH_AND_WRONG, []),
        (findings(regime(judged=0)), 1, "10 answers, none with a decidable direction", []),
        (findings(regime(compared=0, judged=0)), 1, "10 answers, none with a direction", []),
    ],
)
def test_sentence_and_explanations(result, code, sentence, lines, tmp_path):
    assert (result.exit_code, reports.sentence(result), reports.explained(result)) == (code, sentence, lines)
    reports.write_junit(tmp_path / "out.xml", {"answers": result})
    failed = [x.tag for x in ElementTree.parse(tmp_path / "out.xml").iter() if x.tag in ("failure", "error")]
    assert ("error" in failed, bool(failed)) == (code == 2, code > 0)


def test_texts_of_problems_signals_and_grades():
    assert reports.problem_text(MISSING) == "3 without an answer: ids 1, 5, 8"
    cases = [(tir, declared) for tir in ("zero", NONE, UNCLEAR) for declared in (False, True)]
    signals = [reports.signal(findings(tir=tir, tir_given=declared)) for tir, declared in cases]
    assert [text.endswith(" (detected)") for text in signals] == [True] + [False] * 5
    assert signals[1] == "total internal reflection is signalled by the zero vector"
    cases = {}, {"right": 10}, {"right": 10, "exact": 10}, {"wrong": 1, "right": 10}
    assert [reports.grade(regime(**x)) for x in cases] == ["within bound", "right", "exact", "wrong"]
    shares = [reports.cells(regime(rays=10_000, right=x, exact=x - 1), 1.0) for x in (10_000, 9_999, 9_990)]
    assert [(x["right"], x["exact"]) for x in shares] == [("100.0%", "99.9%"), ("99.9%", "99.9%"), ("99.9%", "99.8%")]


def test_json_junit_and_html(tmp_path):
    """Of right answers, and of answers that are wrong and incomplete. The page needs no other file."""
    hostile = "<script>alert(1)</script> & \x1b"
    rays = ray_set.make(("generic", "k ≫ 1", "critical"), 60)
    right = check_answers.check(rays, Answers(rays.ids, glsl(rays.rays.a, rays.rays.n, rays.rays.k)))
    b = glsl(rays.rays.a, rays.rays.n, 1 / rays.rays.k)
    b[:5] = np.nan
    wrong = check_answers.check(rays, Answers(rays.ids[:-2], b[:-2]))
    for result, code, diagnosis, failures, errors in ((right, 0, None, 0, 0), (wrong, 2, "eta inverted", 3, 1)):
        title = "a & b \x1b[31m <program>"
        reports.write_json(tmp_path / "out.json", {title: result}, origin(["rays"], None))
        text = (tmp_path / "out.json").read_text()
        document = json.loads(text, parse_constant=pytest.fail)
        (data,) = document["functions"]
        assert (document["schema"], document["exit_code"], data["title"]) == (1, result.exit_code, title)
        assert (data["exit_code"], data["diagnosis"]) == (result.exit_code, diagnosis)
        assert result.exit_code == code and data["wrong"] == sum(x["wrong"] for x in data["regimes"])
        assert data["rays"]["checksum"] == result.header["checksum"] and "n_ratio" not in data
        assert data["regimes"][0]["worst_ulps"] == result.regimes[0].worst * 2**23
        assert data["total_internal_reflection"] == {"signal": result.tir, "detected": True}

        reports.write_junit(tmp_path / "out.xml", {title: result})
        root = ElementTree.parse(tmp_path / "out.xml").getroot()
        for element in (root, root[0]):
            assert [int(element.get(key)) for key in ("tests", "failures", "errors")] == [4, failures, errors]
        assert root[0].get("name") == "a & b \ufffd[31m <program>"
        assert [case.get("name") for case in root[0]][1:] == ["generic", "k ≫ 1", "critical"]
        assert ["eta inverted" in failure.text for failure in root.findall(".//failure")] == [True] * failures

        reports.write_html(tmp_path / "out.html", {hostile: result}, replay=f"mi-refract rays run -- {hostile}")
        text = (tmp_path / "out.html").read_text()
        assert_stands_alone(text)
        assert "<script>alert" not in text and reports.sentence(result) in text
        assert text.count('<tr class="replay">') == 3 and "m up to 8, also for the length;" in text
        for words in ("Diagnosis", "2 without an answer", "eta inverted"):
            assert (words in text) == (result is wrong)


def test_every_report_contains_the_ratio_difference(tmp_path):
    rays = ray_set.make(["generic"], 12, **ALL)
    k = rays.rays.k.copy()
    k[4] *= np.float32(1.001)
    result = check_answers.check(rays, answered(rays, k))
    data = reports.as_data(result)
    ray = f"{FLINT} to air at 587.561829 nm"
    assert data["n_ratio"] == {"largest": pytest.approx(1e-3, rel=1e-3), "id": 4, "ray": ray, "tolerance": 1e-5}
    assert data["problems"] == [{"kind": "index", "count": 1, "text": "id 4"}]
    reports.write_junit(tmp_path / "a.xml", {"answers": result})
    (failure,) = ElementTree.parse(tmp_path / "a.xml").getroot().iter("failure")
    assert "1 answers used a different ratio of indices" in failure.get("message")
    reports.write_html(tmp_path / "a.html", {"answers": result})
    text = "<dt>ratio of indices</dt><dd>n_ratio: the largest relative difference"
    assert text in (tmp_path / "a.html").read_text()


@needs_chromium
def test_a_browser_reports_no_error(tmp_path):
    rays = ray_set.make(("generic",), 60)
    result = check_answers.check(rays, Answers(rays.ids, glsl(rays.rays.a, rays.rays.n, 1 / rays.rays.k)))
    reports.write_html(tmp_path / "out.html", {"answers": result})
    dom, messages = browse(tmp_path / "out.html", tmp_path / "profile")
    assert messages == [] and reports.sentence(result) in dom
