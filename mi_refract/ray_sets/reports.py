"""What `rays_check` found, laid out for a terminal, scripts (JSON), test runners (JUnit) and people (one HTML page).

Nothing is judged here.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refract.image_diff.text_reports import printable
from mi_refract.io.atomic import write_atomically
from mi_refract.regimes import REGIMES
from mi_refract.report.embedded_images import EmbeddedImages
from mi_refract.report.html_page import write_page
from mi_refract.report.number_text import compact
from mi_refract.report.row import strict

from .check_answers import Figures, Findings, Problem
from .diagnosis import Explanation
from .tir_signal import NONE, UNCLEAR

if TYPE_CHECKING:
    from rich.console import RenderableType

SCHEMA = 1
HEAD = (
    "rays",
    "worst / rad",
    "worst / ulp",
    "p99 / ulp",
    "mean / ulp",
    "misjudged",
    "beyond doubt",
    "length",
    "of the budget",
    "exact",
    "wrong",
)
STYLES = {"wrong": "bold red", "fair": "", "exact": "green"}
TERMS = {
    "ulp": "the spacing of numbers at 1: 2⁻²³ in f32, 2⁻⁵² in f64",
    "worst, p99, mean": "angles to the certified direction, of the rays whose total internal reflection was decided "
    "rightly; rounding the exact answer costs up to 0.43 ulp",
    "misjudged": "rays that were said to be transmitted and are totally reflected, or the reverse",
    "beyond doubt": "those of them that are farther from the critical angle than rounding can excuse",
    "length": "how far the length of an answer is from 1, or from that of a",
    "of the budget": "the largest share that an error takes of what the formula that is the measure may be off by, an "
    "a-priori bound for that very ray",
    "exact": "answers that are the certified ones but for rounding: no formula does better",
    "wrong": "answers beyond their budget, misjudged beyond doubt, or without a direction",
}
TELLING = {
    "zero": "total internal reflection is told by the zero vector",
    "nan": "total internal reflection is told by NaN",
    "reflected": "total internal reflection is told by the mirror direction",
    "tangent": "total internal reflection is told by a vector along the surface",
    "flag": "total internal reflection is told by transmitted = 0",
    NONE: "no ray is totally reflected",
    UNCLEAR: "total internal reflection is told in no known way; accepted: the zero vector, NaN, the mirror direction, "
    "a vector along the surface, or a column `transmitted`",
}
COUNTED = {
    "missing": "{} without an answer",
    "duplicate": "{} answered more than once",
    "unknown": "{} answers to rays that were not asked",
    "non-finite": "{} answers are NaN or infinite where that says nothing",
    "zero": "{} answers are the zero vector where that says nothing",
}


def sentence(found: Findings) -> str:
    """ "200 of 13000 answers are wrong: eta inverted"."""
    if not found.answered:
        return "no ray was answered"
    whole = f"{found.answered} answers"
    if found.diagnosis:
        return f"{found.wrong} of {whole} are wrong: {found.diagnosis.mistake}"
    if found.exit_code > 1:
        return f"{whole}, but not those to the rays" + (f"; {found.wrong} of them are wrong" if found.wrong else "")
    if found.wrong or found.tir == UNCLEAR:
        return f"{found.wrong} of {whole} are wrong"
    if found.exit_code:
        return f"{whole}, none of them a direction"
    if found.limit == found.answered:
        return f"{whole}, all exact but for rounding"
    worst = f"{compact(found.farthest.worst)} rad off at most ({found.farthest.regime})"
    return f"{whole}, all as good as the formula {found.budget} or better, {worst}"


def counted(problem: Problem) -> str:
    """ "3 without an answer: ids 1, 5, 8"."""
    return f"{COUNTED[problem.kind].format(problem.count)}: {problem.text}"


def telling(found: Findings) -> str:
    return TELLING[found.tir] + ("" if found.told or found.tir in (NONE, UNCLEAR) else " (detected)")


def explained(found: Findings) -> list[str]:
    """The diagnosis in words; of several the choice, and of none the nearest."""
    if not found.explanations:
        return []
    certain = [each for each in found.explanations if each.explains]
    if not certain and found.exit_code > 1:  # to other rays, it may be; nothing is known of them
        return []
    if not certain:
        nearest = max(found.explanations, key=lambda each: each.share)
        return ["none of the usual mistakes explains the answers", *([_line(nearest)] if nearest.share > 0 else [])]
    return [_line(each) for each in certain]


def _line(each: Explanation) -> str:
    return f"{each.mistake}: {each.text} ({each.share:.1%} of the answers where it shows)"


def grade(each: Figures) -> str:
    """ "exact", "fair" or "wrong"."""
    return "wrong" if each.wrong else "exact" if each.limit == each.rays else "fair"


# Terminal ----------------------------------------------------------------------------------------------------------


def table(found: Findings) -> RenderableType:
    """Regimes, then what is wrong with the set, then the diagnosis and the sentence; for rich's console."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    rows = Table("", "regime", *HEAD, box=None, pad_edge=False)
    for column in rows.columns[2:]:
        column.justify = "right"
    for each in found.regimes:
        rows.add_row(Text(grade(each), style=STYLES[grade(each)]), each.regime, *_cells(each, found.ulp).values())
    notes = [*map(counted, found.problems), telling(found), *explained(found)]
    return Group(*([rows] if found.regimes else []), *(Text(printable(note)) for note in notes), Text(sentence(found)))


def _cells(each: Figures, ulp: float) -> dict[str, str]:
    """The numbers of a regime as text; "–" where no direction was compared."""
    ulps = {f"{name} / ulp": getattr(each, name) / ulp for name in ("worst", "p99", "mean")}
    shown = {name: compact(x) if each.judged else "–" for name, x in ({"worst / rad": each.worst} | ulps).items()}
    return {
        "rays": str(each.rays),
        **shown,
        "misjudged": str(each.misjudged),
        "beyond doubt": str(each.far),
        "length": compact(each.norm) if each.judged else "–",
        "of the budget": compact(each.share),
        "exact": f"{each.limit / each.rays:.1%}",
        "wrong": str(each.wrong),
    }


# Files -------------------------------------------------------------------------------------------------------------


def as_data(found: Findings) -> dict[str, Any]:
    """`{"schema": 1, "exit_code", "sentence", "precision", …, "regimes": [...], "explanations": [...]}`."""
    diagnosis = found.diagnosis
    regimes = [dataclasses.asdict(each) | {"worst_ulps": each.worst / found.ulp} for each in found.regimes]
    return {
        "schema": SCHEMA,
        "exit_code": found.exit_code,
        "sentence": sentence(found),
        "precision": found.precision,
        "ulp": found.ulp,
        "budget": found.budget,
        "total_internal_reflection": {"told_by": found.tir, "detected": not found.told},
        "answered": found.answered,
        "wrong": found.wrong,
        "problems": [dataclasses.asdict(each) for each in found.problems],
        "regimes": regimes,
        "diagnosis": diagnosis.mistake if diagnosis else None,
        "explanations": [dataclasses.asdict(each) for each in found.explanations],
        "rays": found.header,
    }


def write_json(path: str | Path, found: Findings) -> None:
    """Write `as_data` as strict JSON: NaN and the infinities become words. OSError."""
    write_atomically(path, json.dumps(strict(as_data(found)), indent=1, allow_nan=False) + "\n")


def write_junit(path: str | Path, found: Findings, name: str) -> None:
    """One case a regime and one for the set of answers, which is an error where they are not those to the rays."""
    from xml.etree import ElementTree as xml

    root = xml.Element("testsuites", name="mi-refract rays")
    suite = xml.SubElement(root, "testsuite", name=printable(name))
    case = xml.SubElement(suite, "testcase", classname="answers", name="complete and understood")
    if found.problems or found.tir == UNCLEAR or not found.answered:
        _complain(case, "error" if found.exit_code == 2 else "failure", [*map(counted, found.problems), telling(found)])
    for each in found.regimes:
        case = xml.SubElement(suite, "testcase", classname="rays", name=printable(each.regime))
        if each.wrong:
            numbers = [f"{key} {text}" for key, text in _cells(each, found.ulp).items()]
            wrong = f"{each.wrong} of {each.rays} answers are wrong"
            _complain(case, "failure", [wrong, *explained(found), *numbers, json.dumps(strict(each.replay))])
    tags = [child.tag for case in suite for child in case]
    tally = {"tests": len(suite), "failures": tags.count("failure"), "errors": tags.count("error"), "skipped": 0}
    for element in (root, suite):
        element.attrib.update({key: str(count) for key, count in tally.items()})
    xml.indent(root)
    write_atomically(path, xml.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _complain(case: Any, tag: str, lines: list[str]) -> None:
    from xml.etree import ElementTree as xml

    xml.SubElement(case, tag, message=printable(lines[0])).text = "\n".join(map(printable, lines))


def write_html(path: str | Path, found: Findings, context: Mapping[str, Any], replay: str = "") -> None:
    """Write the page; `context` is shown on top, `replay` is the command that repeats the check. OSError."""
    texts = {name: regime.text for name, regime in REGIMES.items()}
    rows = [
        {
            "name": each.regime,
            "text": texts.get(each.regime, ""),
            "wrong": each.wrong,
            "far": each.far,
            "grade": grade(each),
            "over": each.share > 1,
            "cells": _cells(each, found.ulp),
            "replay": json.dumps(strict(each.replay), indent=1),
        }
        for each in found.regimes
    ]
    content = {
        "title": "mi-refract rays",
        "sentence": sentence(found),
        "state": "fail" if found.exit_code else "pass",
        "counts": [("pass", "right", found.answered - found.wrong), ("fail", "wrong", found.wrong)],
        "context": {"precision": found.precision, "measure": found.budget, **context},
        "problems": [counted(each) for each in found.problems],
        "telling": telling(found),
        "unclear": found.tir == UNCLEAR,
        "explained": explained(found),
        "explanations": found.explanations,
        "head": HEAD,
        "rows": rows,
        "terms": TERMS,
        "pi": math.pi,
        "command": replay,
    }
    write_page(path, "rays.html.j2", content, EmbeddedImages())
