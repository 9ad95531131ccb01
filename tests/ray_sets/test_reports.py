"""The reports of a check: JSON, JUnit and the HTML page."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from support.browser import browse, needs_chromium
from support.ray_programs import glsl

from mi_refract.ray_sets import check_answers, ray_set, reports
from mi_refract.ray_sets.ray_set import Answers


@pytest.fixture(scope="module")
def findings():
    """One set that is right, one that is wrong and incomplete."""
    to = ray_set.make(("generic", "k ≫ 1", "critical"), 60)
    right = check_answers.check(to, Answers(to.ids, glsl(to.rays.a, to.rays.n, to.rays.k)))
    wrong = glsl(to.rays.a, to.rays.n, 1 / to.rays.k)
    wrong[:5] = np.nan
    return {"right": right, "wrong": check_answers.check(to, Answers(to.ids[:-2], wrong[:-2]))}


@pytest.mark.parametrize("name", ["right", "wrong"])
def test_json(tmp_path, findings, name):
    found = findings[name]
    reports.write_json(tmp_path / "out.json", found)

    def refuse(word):
        raise AssertionError(word)

    data = json.loads((tmp_path / "out.json").read_text(), parse_constant=refuse)
    assert data["schema"] == 1  # which its readers ask for
    assert data["exit_code"] == found.exit_code == {"right": 0, "wrong": 2}[name]
    assert data["diagnosis"] == {"right": None, "wrong": "eta inverted"}[name]
    assert data["rays"]["checksum"] == found.header["checksum"]
    assert data["wrong"] == sum(each["wrong"] for each in data["regimes"])
    assert data["regimes"][0]["worst_ulps"] == found.regimes[0].worst * 2**23
    assert data["total_internal_reflection"] == {"signal": found.tir, "detected": True}


@pytest.mark.parametrize("name, failures, errors", [("right", 0, 0), ("wrong", 3, 1)])
def test_junit(tmp_path, findings, name, failures, errors):
    reports.write_junit(tmp_path / "out.xml", findings[name], "a & b \x1b[31m <program>")
    root = ElementTree.parse(tmp_path / "out.xml").getroot()
    for element in (root, root[0]):
        assert {key: int(element.get(key)) for key in ("tests", "failures", "errors")} == {
            "tests": 4,
            "failures": failures,
            "errors": errors,
        }
    assert root[0].get("name") == "a & b \ufffd[31m <program>"
    assert [case.get("name") for case in root[0]][1:] == ["generic", "k ≫ 1", "critical"]
    assert len(root.findall(".//failure")) == failures
    for failure in root.findall(".//failure"):
        assert "eta inverted" in failure.text


class Page(HTMLParser):
    """Its tags that are opened and closed, and what it would fetch."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        if tag not in ("meta", "br", "link", "img", "input"):
            self.open.append(tag)
        self.links += [value for key, value in attributes if key in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.mark.parametrize("name", ["right", "wrong"])
def test_the_page_stands_alone(tmp_path, findings, name):
    found = findings[name]
    told = "<script>alert(1)</script> & \x1b"
    reports.write_html(tmp_path / "out.html", found, {"answers": told}, f"mi-refract rays run -- {told}")
    text = (tmp_path / "out.html").read_text()
    page = Page(text)
    assert not page.open
    assert all(link.startswith("#") for link in page.links)
    assert "<script>alert" not in text
    assert reports.sentence(found) in text
    assert text.count('<tr class="replay">') == 3
    assert ("Diagnosis" in text) == ("2 without an answer" in text) == (name == "wrong")
    assert ("eta inverted" in text) == (name == "wrong")


@needs_chromium
@pytest.mark.parametrize("name", ["right", "wrong"])
def test_a_browser_reports_no_error(tmp_path, findings, name):
    reports.write_html(tmp_path / "out.html", findings[name], {})
    dom, said = browse(tmp_path / "out.html", tmp_path / "profile")
    assert said == []
    assert reports.sentence(findings[name]) in dom
