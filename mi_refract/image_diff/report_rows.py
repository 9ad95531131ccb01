"""The text of a result on a page: numbers, cause, commands, and the word by which it is ticked."""

from __future__ import annotations

import hashlib
import math
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from mi_refract.io.sanitise import printable
from mi_refract.report.number_text import compact, distinguishable

from .comparison import Metric
from .panes import Shown
from .results import FAILED, Result, Results, Status, as_word
from .text_reports import WORDS, sentence

SHORT = 60  # characters of an image's name in the name of its page


def page_of(result: Result) -> str:
    """The page of an image in a folder's report, relative to it: named after the image, whatever the other images."""
    short = re.sub(r"[^A-Za-z0-9._]+", "-", result.name)[-SHORT:].lstrip(".-")
    return f"pairs/{short}-{hashlib.sha256(result.name.encode('utf-8', 'surrogateescape')).hexdigest()[:10]}.html"


def head(results: Results, context: Mapping[str, Any], replay: str) -> dict[str, Any]:
    """The top of a page: sentence, causes, and what was asked."""
    causes = Counter(cause(result) for result in results.of(*FAILED))
    return {
        "title": "mi-refract diff",
        "sentence": sentence(results),
        "state": {0: "pass", 3: "empty"}.get(results.exit_code, "fail"),
        "causes": causes.most_common(),
        "context": {"reference": str(results.reference), "test": str(results.test)} | dict(context),
        "unused": results.unused,
        "command": replay,
    }


def ticked(results: Results, source: str = "") -> str:
    """The command that accepts the images whose names follow it; "" where names mean nothing.

    `source`: the JSON of the comparison, where one is written: by it, only what was compared is accepted.
    """
    if results.renders or not results.test.is_dir():
        return ""
    sides = [as_word(path) for path in (results.reference, results.test)]
    flags = ["--from", source] if source else results.flags
    return shlex.join(["mi-refract", "accept", *sides, *flags])


def line(result: Result) -> dict[str, Any]:
    """An image that has no place of its own: a row of a table."""
    found = result.comparison
    words = (result.name, result.status, result.category, cause(result))
    return {
        "name": result.name,
        "status": str(result.status),
        "category": str(result.category),
        "method": found.method_in_words if found else "",
        "reason": result.reason,
        "asked": result.how.reason,
        "warnings": [result.warning] if result.warning else [],
        "metrics": [_metric(metric) for metric in found.metrics] if found else [],
        "text": " ".join(words).lower(),
    }


def failure(result: Result, results: Results, shown: Shown) -> dict[str, Any]:
    """An image that is not equal, with what is shown of it."""
    found = result.comparison
    one_size = len({(pane["width"], pane["height"]) for pane in shown.panes[:2]}) == 1
    commands = {"reproduce": results.reproduce(result), "accept": results.accept(result)}
    return line(result) | {
        "minimum_detectable": found.minimum_detectable if found and math.isfinite(found.minimum_detectable) else None,
        "panes": shown.panes,
        "paired": one_size and len(shown.panes) > 1,
        "note": shown.note,
        "histogram": shown.histogram,
        "word": word(result),
        "commands": [(verb, command) for verb, command in commands.items() if command],
    }


def row(result: Result, thumbs: Sequence[str]) -> dict[str, Any]:
    """An image that is not equal, in a list that leads to its page."""
    times, metric = excess(result)
    beyond = f"{compact(times)} ×" if math.isfinite(times) else "∞"
    folder = PurePosixPath(result.name).parent.as_posix()
    return line(result) | {
        "href": page_of(result),
        "folder": "" if folder == "." else folder,
        "thumbs": thumbs,
        "word": word(result),
        "excess": f"{times:.9g}" if metric and math.isfinite(times) else "Infinity" if metric else "",
        "excess_text": beyond if metric else "",
        "excess_of": metric.name if metric else "",
    }


def word(result: Result) -> str:
    """The name as a word of a shell; "" where there is nothing to accept, or where it cannot be shown as it is."""
    acceptable = result.test is not None and result.status in FAILED and printable(result.name) == result.name
    return shlex.quote(result.name) if acceptable else ""


def excess(result: Result) -> tuple[float, Metric | None]:
    """How many times its bound the number is that is furthest beyond it; None where none is."""
    found = result.comparison
    beyond = [(_times(metric), metric) for metric in (found.metrics if found else ()) if not metric.holds]
    return max(beyond, key=lambda each: each[0]) if beyond else (0.0, None)


def _times(metric: Metric) -> float:
    times = metric.value / metric.bound if metric.bound else math.inf
    return math.inf if math.isnan(times) else times


def cause(result: Result) -> str:
    """Why an image failed, in few words that others have in common; "" of those that did not."""
    if result.status not in FAILED:
        return ""
    if result.status in (Status.ERROR, Status.INCONCLUSIVE):
        return WORDS[result.status]
    if None in (result.reference, result.test):
        return str(result.category)
    metric = excess(result)[1]
    return metric.name if metric else str(result.status)


def _metric(metric: Metric) -> dict[str, str]:
    value, bound = metric.value, metric.bound
    if bound is None or value <= bound == math.inf:
        return {"name": metric.name, "text": compact(value), "limit": "", "state": "info"}
    text, limit = distinguishable(value, bound)
    state, sign = ("pass", "≤") if value <= bound else ("fail", ">" if value > bound else "≰")
    return {"name": metric.name, "text": text, "limit": f"{sign} {limit}", "state": state}
