"""Reports of a check of answers: text for a terminal, JSON for scripts, JUnit XML, and an HTML page."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from mi_refract.io.text import compact, printable
from mi_refract.regimes import REGIMES
from mi_refract.report import documents
from mi_refract.report.documents import write_page
from mi_refract.report.embedded_images import EmbeddedImages
from mi_refract.report.row import strict, write_strict_json

from .check_answers import Findings, Problem, RegimeErrors
from .diagnosis import Explanation
from .judged_answers import RIGHT
from .tir_signal import NONE, UNCLEAR

if TYPE_CHECKING:
    from rich.console import RenderableType

    from mi_refract.io.reference_pack import Origin

SCHEMA = 1
STYLES = {"wrong": "bold red", "within bound": "yellow", "right": "", "exact": "green"}
MEANING = (
    f"right: backward error m ≤ {RIGHT:g} u (direction and length are exact for inputs perturbed by at most {RIGHT:g} "
    "roundings)"
)
_SIGNALLED = "total internal reflection is signalled by"
SIGNALS = {
    "zero": f"{_SIGNALLED} the zero vector",
    "nan": f"{_SIGNALLED} NaN",
    "reflected": f"{_SIGNALLED} the mirror direction",
    "tangent": f"{_SIGNALLED} a vector along the surface",
    "flag": f"{_SIGNALLED} transmitted = 0",
    NONE: "no answer signals total internal reflection",
    UNCLEAR: "the signal of total internal reflection is unknown or inconsistent; expected the zero vector, NaN, the "
    "mirror direction, a vector along the surface, or a column `transmitted`",
}
PROBLEM_TEXTS = {
    "missing": "{} without an answer",
    "duplicate": "{} answered more than once",
    "unknown": "{} answers to rays that are not in the set",
    "non-finite": "{} answers are NaN or infinite, which is not the signal of total internal reflection",
    "zero": "{} answers are the zero vector, which is not the signal of total internal reflection",
    "impossible": "{} answers are directions that the rounding of no documented formula explains, such as outside the "
    "plane of incidence, or on the wrong side of the surface",
    "index": "{} answers used a different ratio of indices (n_ratio)",
}


def sentence(findings: Findings) -> str:
    """The result in one line, such as "200 of 13000 answers are wrong: eta inverted"."""
    answers = f"{findings.answered} answers"
    if not findings.answered:
        text = "no ray was answered"
    elif findings.diagnosis:
        text = f"{findings.wrong} of {answers} are wrong: {findings.diagnosis.mistake}"
    elif findings.exit_code > 1:
        wrong = f"; {findings.wrong} of them are wrong" if findings.wrong else ""
        text = f"{answers}, but they do not match the rays{wrong}"
    elif findings.wrong or findings.tir == UNCLEAR:
        text = f"{findings.wrong} of {answers} are wrong"
    elif not findings.total("judged"):
        text = f"{answers}, none with a {'decidable ' if findings.total('compared') else ''}direction"
    elif findings.total("exact") == findings.answered:
        text = f"{answers}, all exact up to rounding"
    else:
        farthest = max(findings.regimes, key=lambda x: (x.compared > 0, x.worst))
        worst = f"the largest error is {compact(farthest.worst)} rad ({farthest.regime})"
        if findings.right == findings.answered:
            text = f"{answers}, all right; {worst}"
        else:
            text = f"{findings.right} of {answers} are right, {findings.answered - findings.right} only within the "
            text += f"error bound of the formula {findings.error_bound}; {worst}"
            if undecidable := findings.total("undecidable"):
                text += f"; {undecidable} rays are undecidable (error bound above 0.1 rad)"
    different = findings.problem_count("index")
    return text + (f"; {different} answers are for a different ratio of indices" if different else "")


def problem_text(problem: Problem) -> str:
    """A problem in one line, such as "3 without an answer: ids 1, 5, 8"."""
    return f"{PROBLEM_TEXTS[problem.kind].format(problem.count)}: {problem.text}"


def signal(findings: Findings) -> str:
    """The signal of total internal reflection in the answers, in one line."""
    return SIGNALS[findings.tir] + ("" if findings.tir_given or findings.tir in (NONE, UNCLEAR) else " (detected)")


def ratio(findings: Findings) -> list[str]:
    """A line on the difference between the ratio that the program used and that of the ray; [] without `n_ratio`."""
    if not findings.ratio:
        return []
    which = f"id {findings.ratio.id}" + (f", {findings.ratio.ray}" if findings.ratio.ray else "")
    text = f"n_ratio: the largest relative difference to n_from / n_to is {compact(findings.ratio.largest)} ({which})"
    return [f"{text}; up to {compact(findings.ratio.tolerance)} counts as equal. Directions are judged for n_ratio"]


def explained(findings: Findings) -> list[str]:
    """A line for each mistake that explains the answers; if none does, one line on the nearest mistake."""

    def line(mistake: Explanation) -> str:
        share = f"{mistake.share:.1%} of the answers on which it has an effect"
        return f"{mistake.mistake}: {mistake.text} ({share})"

    certain = [line(mistake) for mistake in findings.explanations if mistake.explains]
    # Answers that do not match the rays may belong to other rays: then no mistake is reported.
    if certain or not findings.explanations or findings.exit_code > 1:
        return certain
    nearest = max(findings.explanations, key=lambda mistake: mistake.share)
    none = "none of the common mistakes explains the answers"
    return [f"nearest of the common mistakes, no explanation: {line(nearest)}" if nearest.share > 0 else none]


def grade(errors: RegimeErrors) -> str:
    """The grade of a regime: "exact", "right", "within bound" or "wrong"."""
    if errors.wrong:
        return "wrong"
    if errors.right < errors.rays:
        return "within bound"
    return "exact" if errors.exact == errors.rays else "right"


def cells(errors: RegimeErrors, ulp: float) -> dict[str, str]:
    """The numbers of a regime as text, by column; "–" if no direction was compared."""

    def if_compared(x: float) -> str:
        return compact(x) if errors.compared else "–"

    def share(count: int) -> str:
        """Rounded down: 100 % are all answers."""
        return f"{1000 * count // errors.rays / 10:.1f}%"

    return {
        "rays": str(errors.rays),
        "undecidable": str(errors.undecidable),
        "worst / rad": if_compared(errors.worst),
        **{f"{name} / ulp": if_compared(getattr(errors, name) / ulp) for name in ("worst", "p99", "mean")},
        "TIR misclassified": str(errors.tir_misclassified),
        "TIR beyond bound": str(errors.tir_beyond_bound),
        "length error": if_compared(errors.length_error),
        "error / bound": compact(errors.error_over_bound),
        **{f"m, {name}": compact(getattr(errors, f"backward_{name}")) for name in ("median", "p99", "worst", "length")},
        "right": share(errors.right),
        "exact": share(errors.exact),
        "wrong": str(errors.wrong),
    }


def summary(findings: Findings) -> RenderableType:
    """The regimes by grade, the problems of the answers, the diagnosis and the result, for rich's console."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    grades = Table.grid(padding=(0, 2))
    for word, style in STYLES.items():
        if names := [errors.regime for errors in findings.regimes if grade(errors) == word]:
            every = 1 < len(names) == len(findings.regimes)
            grades.add_row(Text(word, style=style), Text("every regime" if every else printable("; ".join(names))))
    notes = [*map(problem_text, findings.problems), *ratio(findings), signal(findings), *explained(findings)]
    notes += [MEANING] if findings.right > 0 and not findings.wrong else []
    lines = [Text(printable(line)) for line in (*notes, sentence(findings))]
    return Group(grades, *lines) if findings.regimes else Group(*lines)  # an empty grid would be a blank line


def table(findings: Findings) -> RenderableType:
    """A line per regime with all its numbers, for rich's console."""
    from rich.table import Table
    from rich.text import Text

    head = cells(findings.regimes[0], findings.ulp) if findings.regimes else ()
    rows = Table("", "regime", *head, box=None, pad_edge=False)
    for column in rows.columns[2:]:
        column.justify = "right"
    for errors in findings.regimes:
        word = Text(grade(errors), style=STYLES[grade(errors)])
        rows.add_row(word, Text(printable(errors.regime)), *cells(errors, findings.ulp).values())
    return rows


# Files -------------------------------------------------------------------------------------------------------------


def as_data(findings: Findings) -> dict[str, Any]:
    """The findings as JSON: `{"exit_code", "sentence", "precision", …, "regimes": [...], "explanations": [...]}`."""
    diagnosis = findings.diagnosis
    regimes = [dataclasses.asdict(x) | {"worst_ulps": x.worst / findings.ulp} for x in findings.regimes]
    return {
        "exit_code": findings.exit_code,
        "sentence": sentence(findings),
        "precision": findings.precision,
        "ulp": findings.ulp,
        "error_bound": findings.error_bound,
        "backward_error_limit": findings.most_backward if math.isfinite(findings.most_backward) else None,
        "total_internal_reflection": {"signal": findings.tir, "detected": not findings.tir_given},
        "answers_sha256": findings.digest,
        "answered": findings.answered,
        "wrong": findings.wrong,
        "right": findings.right,
        "problems": [dataclasses.asdict(x) for x in findings.problems],
        "regimes": regimes,
        "diagnosis": diagnosis.mistake if diagnosis else None,
        "explanations": [dataclasses.asdict(x) for x in findings.explanations],
        "rays": findings.header,
        **({"n_ratio": dataclasses.asdict(findings.ratio)} if findings.ratio else {}),
    }


def write_json(path: str | Path, checks: Mapping[str, Findings], origin: Origin) -> None:
    """Write `{"schema": 1, "exit_code", …, "functions": [{"title", …}, …]}` as strict JSON; see `as_data`.

    `checks`: findings by the title of the function; the exit code of the file is the largest of theirs. The keys of
    `origin` are added at the top level. NaN and the infinities become strings. OSError if the file cannot be written.
    """
    functions = [{"title": title} | as_data(findings) for title, findings in checks.items()]
    exit_code = max(findings.exit_code for findings in checks.values())
    provenance = msgspec.to_builtins(origin)
    write_strict_json(path, {"schema": SCHEMA, "exit_code": exit_code} | provenance | {"functions": functions})


def write_junit(path: str | Path, checks: Mapping[str, Findings]) -> None:
    """Write a suite per function: a case per regime, and one for the answers: an error unless they match the rays.

    The case of the answers also fails if no direction was judged.
    """
    documents.write_junit(path, "mi-refract rays", {title: _cases(findings) for title, findings in checks.items()})


def _cases(findings: Findings) -> list[documents.Case]:
    answers = documents.Case("answers", "complete and understood")
    undecided = [] if findings.total("judged") else [sentence(findings)]
    if undecided or findings.problems or findings.tir == UNCLEAR:
        lines = [*map(problem_text, findings.problems), *undecided, *ratio(findings), signal(findings)]
        outcome: Literal["error", "failure"] = "error" if findings.exit_code == 2 else "failure"
        answers = documents.Case(answers.group, answers.name, outcome, lines[0], lines)
    cases = [answers]
    for errors in findings.regimes:
        case = documents.Case("rays", errors.regime)
        if errors.wrong:
            wrong = f"{errors.wrong} of {errors.rays} answers are wrong"
            numbers = [f"{key} {text}" for key, text in cells(errors, findings.ulp).items()]
            lines = [wrong, *explained(findings), *numbers, json.dumps(strict(errors.replay))]
            case = documents.Case("rays", errors.regime, "failure", wrong, lines)
        cases.append(case)
    return cases


def write_html(
    path: str | Path, checks: Mapping[str, Findings], context: Mapping[str, Any] | None = None, replay: str = ""
) -> None:
    """Write the HTML page.

    `checks`: findings by the title of the function. `context`: shown at the top of each. `replay`: the command that
    repeats the checks. OSError if the file cannot be written.
    """
    content = {
        "title": "mi-refract rays",
        "sentence": "; ".join(map(sentence, checks.values())),
        "checks": [_section(title, findings, context or {}) for title, findings in checks.items()],
        "most_right": f"{RIGHT:g}",
        "pi": math.pi,
        "command": replay,
    }
    write_page(path, "rays.html.j2", content, EmbeddedImages())


def _section(title: str, findings: Findings, context: Mapping[str, Any]) -> dict[str, Any]:
    rows = []
    for errors in findings.regimes:
        shown = cells(errors, findings.ulp)
        failing = {"wrong": errors.wrong, "TIR beyond bound": errors.tir_beyond_bound}
        failing["error / bound"] = errors.error_over_bound > 1
        states = {name: "fail" for name, fails in failing.items() if fails}
        states |= {"exact": "pass"} if grade(errors) == "exact" else {}
        rows.append(
            {
                "name": errors.regime,
                "text": REGIMES[errors.regime].text if errors.regime in REGIMES else "",
                "cells": [(text, states.get(name, "")) for name, text in shown.items()],
                "replay": json.dumps(strict(errors.replay), indent=1),
            }
        )
    about = {"answers": title, "precision": findings.precision, "error bound": findings.error_bound}
    about |= {key: findings.header[key] for key in ("seed", "checksum") if key in findings.header}
    return {
        "name": title,
        "sentence": sentence(findings),
        "state": "fail" if findings.exit_code else "pass",
        "counts": [
            ("pass", "right", findings.right),
            ("info", "within the error bound only", findings.answered - findings.right - findings.wrong),
            ("fail", "wrong", findings.wrong),
        ],
        "context": about | dict(context) | dict(zip(["ratio of indices"], ratio(findings), strict=False)),
        "problems": [problem_text(x) for x in findings.problems],
        "signal": signal(findings),
        "unclear": findings.tir == UNCLEAR,
        "explained": explained(findings),
        "explanations": findings.explanations,
        "head": list(cells(findings.regimes[0], findings.ulp)) if findings.regimes else [],
        "rows": rows,
    }
