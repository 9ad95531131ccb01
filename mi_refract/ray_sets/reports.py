"""Reports of a check of answers: text for a terminal, JSON for scripts, JUnit for test runners, and an HTML page."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refract.io.atomic import write_atomically
from mi_refract.io.sanitise import printable
from mi_refract.regimes import REGIMES
from mi_refract.report import junit
from mi_refract.report.embedded_images import EmbeddedImages
from mi_refract.report.html_page import write_page
from mi_refract.report.number_text import compact
from mi_refract.report.row import strict

from .check_answers import Findings, Problem, RegimeErrors
from .diagnosis import Explanation
from .judged_answers import RIGHT
from .tir_signal import NONE, UNCLEAR

if TYPE_CHECKING:
    from rich.console import RenderableType

SCHEMA = 1
COLUMNS = (
    "rays",
    "undecidable",
    "worst / rad",
    "worst / ulp",
    "p99 / ulp",
    "mean / ulp",
    "TIR misclassified",
    "TIR beyond bound",
    "length error",
    "error / bound",
    "m, median",
    "m, p99",
    "m, worst",
    "right",
    "exact",
    "wrong",
)
STYLES = {"wrong": "bold red", "within bound": "yellow", "right": "", "exact": "green"}
TERMS = {
    "ulp": "the spacing of numbers at 1: 2⁻²³ in f32, 2⁻⁵² in f64",
    "worst, p99, mean": "angles to the certified direction, over the rays whose total internal reflection was "
    "classified correctly; rounding the exact answer costs up to 0.43 ulp",
    "undecidable": "rays whose error bound is above 0.1 rad, where a direction within it shows little: all that "
    "is judged there is the plane of incidence, the side of the surface, and what is forward",
    "TIR misclassified": "rays that were called transmitted and are totally reflected, or the reverse",
    "TIR beyond bound": "those of them that are farther from the critical angle than rounding can explain",
    "length error": "the difference between the length of an answer and 1, or the length of a where that is nearer",
    "error / bound": "the largest ratio of an error to the a-priori bound of the chosen formula for that ray",
    "m": "backward error of all answers: each is the exact refraction of inputs a, n and k that are off by m u, "
    "relative to their lengths; u is half an ulp. Of a wrong decision on TIR: of inputs beyond the critical angle",
    "right": f"answers that are not wrong, with m up to {RIGHT:g}; the others are only as good as the error bound",
    "exact": "answers that are the certified direction, rounded: no formula can do better",
    "wrong": "answers whose error is beyond the bound, whose TIR is misclassified beyond it, or that are no direction",
}
MEANING = f"right: backward error m ≤ {RIGHT:g} u (exact for inputs perturbed by at most {RIGHT:g} roundings)"
SIGNALS = {
    "zero": "total internal reflection is signalled by the zero vector",
    "nan": "total internal reflection is signalled by NaN",
    "reflected": "total internal reflection is signalled by the mirror direction",
    "tangent": "total internal reflection is signalled by a vector along the surface",
    "flag": "total internal reflection is signalled by transmitted = 0",
    NONE: "no ray is totally reflected",
    UNCLEAR: "total internal reflection is signalled in no known way; expected the zero vector, NaN, the mirror "
    "direction, a vector along the surface, or a column `transmitted`",
}
PROBLEM_TEXTS = {
    "missing": "{} without an answer",
    "duplicate": "{} answered more than once",
    "unknown": "{} answers to rays that are not in the set",
    "non-finite": "{} answers are NaN or infinite where that is no signal",
    "zero": "{} answers are the zero vector where that is no signal",
    "impossible": "{} answers are outside the plane of incidence, or on the wrong side of the surface, by more than "
    "the rounding of any documented formula explains",
    "index": "{} answers used another ratio of indices, n_ratio",
}


def sentence(found: Findings) -> str:
    """The result in one line, such as "200 of 13000 answers are wrong: eta inverted"."""
    others = sum(each.count for each in found.problems if each.kind == "index")
    return _directions(found) + (f"; {others} answers are for another ratio of indices" if others else "")


def _directions(found: Findings) -> str:
    if not found.answered:
        return "no ray was answered"
    answers = f"{found.answered} answers"
    if found.diagnosis:
        return f"{found.wrong} of {answers} are wrong: {found.diagnosis.mistake}"
    if found.exit_code > 1:
        wrong = f"; {found.wrong} of them are wrong" if found.wrong else ""
        return f"{answers}, but they do not match the rays{wrong}"
    if found.wrong or found.tir == UNCLEAR:
        return f"{found.wrong} of {answers} are wrong"
    if not found.total("judged"):
        return f"{answers}, none of them a direction{' that shows anything' if found.total('compared') else ''}"
    if found.total("exact") == found.answered:
        return f"{answers}, all exact up to rounding"
    worst = f"the largest error is {compact(found.farthest.worst)} rad ({found.farthest.regime})"
    wide = found.total("undecidable")
    open_ = f"; {wide} rays are undecidable (error bound above 0.1 rad)" if wide else ""
    if found.right == found.answered:
        return f"{answers}, all right; {worst}"
    others = f"the others are within the error bound of the formula {found.error_bound}"
    return f"{found.right} of {answers} are right, {others}; {worst}{open_}"


def problem_text(problem: Problem) -> str:
    """A problem in one line, such as "3 without an answer: ids 1, 5, 8"."""
    return f"{PROBLEM_TEXTS[problem.kind].format(problem.count)}: {problem.text}"


def signal(found: Findings) -> str:
    """How the answers signal total internal reflection, in one line."""
    return SIGNALS[found.tir] + ("" if found.tir_given or found.tir in (NONE, UNCLEAR) else " (detected)")


def ratio(found: Findings) -> list[str]:
    """A line: how far the ratio that the program used is from that of the ray. None where it does not say."""
    if not found.ratio:
        return []
    which = f"id {found.ratio.id}" + (f", {found.ratio.ray}" if found.ratio.ray else "")
    text = f"n_ratio: the largest relative difference to n_from / n_to is {compact(found.ratio.largest)} ({which})"
    return [f"{text}; up to {compact(found.ratio.accepted)} is none. Directions are judged for n_ratio"]


def explained(found: Findings) -> list[str]:
    """The mistakes that explain the answers, a line each; where none does, a line that says so, and the nearest one."""
    if not found.explanations:
        return []
    certain = [each for each in found.explanations if each.explains]
    if not certain and found.exit_code > 1:  # possibly answers to other rays: no mistake can be named
        return []
    if not certain:
        nearest = max(found.explanations, key=lambda each: each.share)
        return ["none of the usual mistakes explains the answers", *([_line(nearest)] if nearest.share > 0 else [])]
    return [_line(each) for each in certain]


def _line(each: Explanation) -> str:
    return f"{each.mistake}: {each.text} ({each.share:.1%} of the answers on which it has an effect)"


def grade(each: RegimeErrors) -> str:
    """ "exact", "right", "within bound" or "wrong"."""
    if each.wrong:
        return "wrong"
    if each.right < each.rays:
        return "within bound"
    return "exact" if each.exact == each.rays else "right"


# Terminal ----------------------------------------------------------------------------------------------------------


def table(found: Findings) -> RenderableType:
    """The regimes, the problems of the set, the diagnosis and the sentence, for rich's console."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    rows = Table("", "regime", *COLUMNS, box=None, pad_edge=False)
    for column in rows.columns[2:]:
        column.justify = "right"
    for each in found.regimes:
        rows.add_row(
            Text(grade(each), style=STYLES[grade(each)]),
            Text(printable(each.regime)),
            *_cells(each, found.ulp).values(),
        )
    notes = [*map(problem_text, found.problems), *ratio(found), signal(found), *explained(found)]
    notes += [MEANING] if found.right > 0 and not found.wrong else []
    return Group(*([rows] if found.regimes else []), *(Text(printable(line)) for line in (*notes, sentence(found))))


def _cells(each: RegimeErrors, ulp: float) -> dict[str, str]:
    """The numbers of a regime as text; "–" where no direction was compared."""
    ulps = {f"{name} / ulp": getattr(each, name) / ulp for name in ("worst", "p99", "mean")}
    shown = {name: compact(x) if each.compared else "–" for name, x in ({"worst / rad": each.worst} | ulps).items()}
    return {
        "rays": str(each.rays),
        "undecidable": str(each.undecidable),
        **shown,
        "TIR misclassified": str(each.tir_misclassified),
        "TIR beyond bound": str(each.tir_beyond_bound),
        "length error": compact(each.length_error) if each.compared else "–",
        "error / bound": compact(each.error_over_bound),
        **{f"m, {name}": compact(getattr(each, f"backward_{name}")) for name in ("median", "p99", "worst")},
        "right": f"{each.right / each.rays:.1%}",
        "exact": f"{each.exact / each.rays:.1%}",
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
        "error_bound": found.error_bound,
        "total_internal_reflection": {"signal": found.tir, "detected": not found.tir_given},
        "answered": found.answered,
        "wrong": found.wrong,
        "right": found.right,
        "problems": [dataclasses.asdict(each) for each in found.problems],
        "regimes": regimes,
        "diagnosis": diagnosis.mistake if diagnosis else None,
        "explanations": [dataclasses.asdict(each) for each in found.explanations],
        "rays": found.header,
        **({"n_ratio": dataclasses.asdict(found.ratio)} if found.ratio else {}),
    }


def write_json(path: str | Path, found: Findings) -> None:
    """Write `as_data` as strict JSON: NaN and the infinities become words. OSError where that fails."""
    write_atomically(path, json.dumps(strict(as_data(found)), indent=1, allow_nan=False) + "\n")


def write_junit(path: str | Path, found: Findings, name: str) -> None:
    """One test case per regime, and one for the set of answers: an error where they do not match the rays."""
    suites = {name: [_answers_case(found), *(_regime_case(found, each) for each in found.regimes)]}
    junit.write_junit(path, "mi-refract rays", suites)


def _answers_case(found: Findings) -> junit.Case:
    group, name = "answers", "complete and understood"
    if found.answered and not found.problems and found.tir != UNCLEAR:
        return junit.Case(group, name)
    lines = [*map(problem_text, found.problems), *ratio(found), signal(found)]
    return junit.Case(group, name, "error" if found.exit_code == 2 else "failure", lines[0], lines)


def _regime_case(found: Findings, each: RegimeErrors) -> junit.Case:
    if not each.wrong:
        return junit.Case("rays", each.regime)
    numbers = [f"{key} {text}" for key, text in _cells(each, found.ulp).items()]
    wrong = f"{each.wrong} of {each.rays} answers are wrong"
    lines = [wrong, *explained(found), *numbers, json.dumps(strict(each.replay))]
    return junit.Case("rays", each.regime, "failure", wrong, lines)


def write_html(path: str | Path, found: Findings, context: Mapping[str, Any], replay: str = "") -> None:
    """Write the HTML page. `context` is shown on top; `replay` is the command that repeats the check. OSError."""
    texts = {name: regime.text for name, regime in REGIMES.items()}
    rows = [
        {
            "name": each.regime,
            "text": texts.get(each.regime, ""),
            "cells": [(text, _state(name, each)) for name, text in _cells(each, found.ulp).items()],
            "replay": json.dumps(strict(each.replay), indent=1),
        }
        for each in found.regimes
    ]
    noted = dict(zip(["ratio of indices"], ratio(found), strict=False))
    content = {
        "title": "mi-refract rays",
        "sentence": sentence(found),
        "state": "fail" if found.exit_code else "pass",
        "counts": [
            ("pass", "right", found.right),
            ("info", "within the error bound only", found.answered - found.right - found.wrong),
            ("fail", "wrong", found.wrong),
        ],
        "context": {"precision": found.precision, "error bound": found.error_bound, **context, **noted},
        "problems": [problem_text(each) for each in found.problems],
        "signal": signal(found),
        "unclear": found.tir == UNCLEAR,
        "explained": explained(found),
        "explanations": found.explanations,
        "head": COLUMNS,
        "rows": rows,
        "terms": TERMS,
        "pi": math.pi,
        "command": replay,
    }
    write_page(path, "rays.html.j2", content, EmbeddedImages())


def _state(column: str, each: RegimeErrors) -> str:
    """The class of a cell: "fail", "pass" or none."""
    failing = {
        "wrong": each.wrong > 0,
        "TIR beyond bound": each.tir_beyond_bound > 0,
        "error / bound": each.error_over_bound > 1,
    }
    if failing.get(column):
        return "fail"
    return "pass" if column == "exact" and grade(each) == "exact" else ""
