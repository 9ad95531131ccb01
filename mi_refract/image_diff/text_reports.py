"""The results of `diff` as text: for a terminal, for scripts (JSON), test runners (JUnit) and GitHub.

Names of files and messages of errors may hold any character: each format escapes what would be read as more than text.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import quote

from mi_refract.io.atomic import write_atomically
from mi_refract.io.sanitise import printable
from mi_refract.report.number_text import compact, distinguishable
from mi_refract.report.row import strict
from mi_refract.report.text_table import Group, Table, Text

from . import idiff_flags
from .comparison import Metric
from .pairing import Pair
from .results import FAILED, Result, Results, Status
from .settings import ComparisonSpec, written

if TYPE_CHECKING:
    from mi_refract.report import junit

SCHEMA = 1
FEW = 20  # equal images that are listed one by one
SUMMARY_ROWS = 500  # GitHub cuts a summary at 1 MiB
WORDS = {
    Status.ERROR: "could not be compared",
    Status.DIFFERENT: "different",
    Status.INCONCLUSIVE: "inconclusive",
    Status.EQUAL: "equal",
    Status.SKIPPED: "skipped",
}
STYLES = {
    Status.ERROR: "bold red",
    Status.DIFFERENT: "bold red",
    Status.INCONCLUSIVE: "yellow",
    Status.EQUAL: "green",
    Status.SKIPPED: "dim",
}


def sentence(results: Results) -> str:
    """All statuses in one line: "12 images: 1 different, 11 equal"."""
    counts = Counter(result.status for result in results.results)
    counted = ", ".join(f"{counts[status]} {WORDS[status]}" for status in Status if counts[status])
    number, warnings = len(results.results), sum(bool(result.warning) for result in results.results)
    warned = f", {warnings} with a warning" if warnings else ""
    further = len({path for result in results.results for path in result.variants})
    also = f"; {further} further reference{'s' if further > 1 else ''}" if further else ""
    return f"{number} image{'' if number == 1 else 's'}: {counted}{warned}{also}"


def table(results: Results) -> Group:
    """Failures first, then equal images with a warning, FEW others, and the sentence."""
    failed = [*results.of(Status.DIFFERENT, Status.INCONCLUSIVE), *_warned(results)]
    equal = [result for result in results.of(Status.EQUAL) if not result.warning]
    skipped = results.of(Status.SKIPPED)
    rows = Table(("verdict", "image", "method", "why"))
    for result in [*failed, *equal[:FEW], *skipped]:
        status = Text(_word(result), style=STYLES[result.status])
        rows.add_row(status, *(Text(printable(text)) for text in (result.name, _method_in_words(result), why(result))))
    more = [Text(f"… and {len(equal) - FEW} more that are equal", style="dim")] if len(equal) > FEW else []
    return Group((*([rows] if rows.rows else []), *more, Text(sentence(results))))


def settings_table(pairs: Sequence[Pair]) -> Table:
    """How each image would be compared, and the tables of the settings file that say so."""
    rows = Table(("image", "compared by", "from", "why"))
    for pair in pairs:
        how = pair.how
        options = [f"{name}={value}" for name, value in how.options.items()]
        names = ", ".join(path.relative_to(pair.target.parent).as_posix() for path in pair.variants)
        others = [f"or {names}"] if names else []
        parts = ["skipped"] if how.skip else [how.method, *options, *others, *_pixels(how)]
        cells = pair.name, ", ".join(parts), ", ".join(how.entries) or "–", how.reason
        rows.add_row(*(Text(printable(cell)) for cell in cells))
    return rows


def _pixels(how: ComparisonSpec) -> list[str]:
    given = {"mask": how.mask, "variance": how.variance, "channels": written(how.channels)}
    return [
        *(f"{name} {each}" for name, each in given.items() if each),
        *(f"without {list(each)}" for each in how.ignore),
    ]


def _warned(results: Results) -> list[Result]:
    return [result for result in results.of(Status.EQUAL) if result.warning]


def without_effect(results: Results) -> list[str]:
    """A line for each set of `idiff`'s flags with some that are taken and do nothing."""
    given = {result.how.idiff for result in results.results} - {None}
    ignored = (idiff_flags.parse(flags or "").ignored for flags in sorted(given, key=str))
    return [f"idiff {' '.join(flags)}: no effect; --report OUT.html shows the difference" for flags in ignored if flags]


def why(result: Result) -> str:
    """The reason of the verdict, the warning, and the settings' reason where the image has settings of its own."""
    warned = f"; warning: {result.warning}" if result.warning else ""
    return result.reason + warned + (f" [{result.how.reason}]" if result.how.reason else "")


def _word(result: Result) -> str:
    return str(result.category) if None in (result.reference, result.test) else str(result.status)


def _method(result: Result) -> str:
    return result.comparison.method if result.comparison else result.how.method


def _method_in_words(result: Result) -> str:
    return result.comparison.method_in_words if result.comparison else result.how.method


def write_json(path: str | Path, results: Results) -> None:
    """Write `as_data` as strict JSON: NaN and the infinities become words. OSError."""
    write_atomically(path, json.dumps(strict(as_data(results)), indent=1, allow_nan=False) + "\n")


def as_data(results: Results) -> dict[str, Any]:
    """`{"schema": 1, "exit_code", "sentence", "reference", "test", "counts", "results": [...]}`."""
    counts = Counter(result.status for result in results.results)
    return {
        "schema": SCHEMA,
        "exit_code": results.exit_code,
        "sentence": sentence(results),
        "reference": results.reference,
        "test": results.test,
        "renders": results.renders,
        "counts": {str(status): counts[status] for status in Status},
        "results": [_entry(results, result) for result in results.results],
    }


def _entry(results: Results, result: Result) -> dict[str, Any]:
    found = result.comparison
    return {
        "name": result.name,
        "status": str(result.status),
        "category": str(result.category),
        "reason": result.reason,
        "warning": result.warning,
        "error": result.error,
        "reference": result.reference,
        "test": result.test,
        "target": result.target,
        "digests": _digests(result),
        "method": _method(result),
        "method_why": found.chosen if found else "",
        "options": dict(result.how.options),
        "idiff": result.how.idiff,
        "channels": [list(pair) for pair in result.how.channels],
        "variance": result.how.variance if result.how.reads_variance else "",
        "mask": result.how.mask,
        "ignore": [list(each) for each in result.how.ignore],
        "why_so": result.how.reason,
        "entries": list(result.how.entries),
        "matched": result.matched,
        "variants": list(result.variants),
        "metrics": [{"name": m.name, "value": m.value, "bound": m.bound} for m in (found.metrics if found else ())],
        "minimum_detectable_difference": found.minimum_detectable if found else math.nan,
        "reproduce": results.reproduce(result),
        "accept": results.accept(result),
    }


def _digests(result: Result) -> dict[str, Any] | None:
    """The SHA-256 of the files of an image that is not equal, as they were compared; "" where there is no file."""
    if result.digests is None or result.status not in FAILED:
        return None
    sides = {"reference": result.reference, "test": result.test}
    of = {role: result.digests[path] if path else "" for role, path in sides.items()}
    return of | {"variants": [result.digests[path] for path in result.variants]}


def write_junit(path: str | Path, results: Results) -> None:
    """One case for each image: "different" is a failure, "inconclusive" too unless it is to pass, no verdict an error.

    Errors: OSError.
    """
    from mi_refract.report import junit

    cases = [_case(results, result) for result in results.results]
    junit.write_junit(path, "mi-refract diff", {str(results.test): cases})


def _case(results: Results, result: Result) -> junit.Case:
    from mi_refract.report import junit

    kind = _kind(results, result)
    if result.status is Status.SKIPPED:
        return junit.Case(_method(result), result.name, "skipped", why(result))
    if not kind:
        warned = [f"warning: {result.warning}"] if result.warning else []
        return junit.Case(_method(result), result.name, details=warned)
    return junit.Case(_method(result), result.name, kind, why(result), _details(results, result), _word(result))


def _kind(results: Results, result: Result) -> Literal["", "failure", "error"]:
    """ "error", "failure", or "" for what does not fail the run."""
    if result.status is Status.ERROR:
        return "error"
    passes = result.status in (Status.EQUAL, Status.SKIPPED) or (
        result.status is Status.INCONCLUSIVE and results.inconclusive == "pass"
    )
    return "" if passes else "failure"


def _details(results: Results, result: Result) -> list[str]:
    metrics = [metric_text(metric) for metric in (result.comparison.metrics if result.comparison else ())]
    commands = {"reproduce": results.reproduce(result), "accept": results.accept(result)}
    return [*metrics, *(f"{verb}: {line}" for verb, line in commands.items() if line)]


def metric_text(metric: Metric) -> str:
    """ "largest change 0.12 (allowed 0.1)"."""
    if metric.bound is None:
        return f"{metric.name} {compact(metric.value)}"
    value, bound = distinguishable(metric.value, metric.bound)
    return f"{metric.name} {value} (allowed {bound})"


# GitHub -----------------------------------------------------------------------------------------------------------


def workflow_commands(results: Results) -> list[str]:
    """A workflow command for each image that is not equal, or has a warning."""
    lines = []
    for result in results.results:
        if result.warning or result.status not in (Status.EQUAL, Status.SKIPPED):
            level = "error" if _kind(results, result) else "warning"
            file = _property(result.test or result.reference or result.name)
            title = _property(f"{result.name}: {_word(result)}")
            lines.append(f"::{level} file={file},title={title}::{_message(why(result))}")
    return lines


def _message(text: Any) -> str:
    return printable(text).replace("%", "%25")


def _property(text: Any) -> str:
    return _message(text).replace(":", "%3A").replace(",", "%2C")


@dataclass(frozen=True)
class Pages:
    """Where a report is, for links: `name`, and `page` of each result ("" in one file). `url`: where it is published.

    Below a URL that ends in / every page has its own; another one is that of an archive, in which none has.
    """

    name: str
    page: Callable[[Result], str]
    url: str = ""


def append_summary(results: Results, pages: Pages | None = None) -> None:
    """Append the Markdown to the file that GitHub names in $GITHUB_STEP_SUMMARY, where it does. OSError."""
    if path := os.environ.get("GITHUB_STEP_SUMMARY"):
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(markdown(results, pages))


def markdown(results: Results, pages: Pages | None = None) -> str:
    """A heading with the sentence, where the report is, and a table of what is not equal or has a warning."""
    failed = [*results.of(*FAILED), *_warned(results)]
    lines = [f"### mi-refract diff: {sentence(results)}", "", *(_where(pages) if pages else [])]
    paged = pages is not None and any(map(pages.page, failed[:1]))
    if failed:
        lines += ["| verdict | image | method | why |" + " page |" * paged, "|---|---|---|---|" + "---|" * paged]
    for result in failed[:SUMMARY_ROWS]:
        cells = [_literal(cell) for cell in (_word(result), result.name, _method_in_words(result), why(result))]
        cells += [_linked(pages, pages.page(result))] if pages and paged else []
        lines.append(f"| {' | '.join(cells)} |")
    if len(failed) > SUMMARY_ROWS:
        lines += ["", f"… and {len(failed) - SUMMARY_ROWS} more"]
    return "\n".join(lines) + "\n\n"


def _where(pages: Pages) -> list[str]:
    """Where a reader finds the report: no summary can show an image of an artefact, nor link into one."""
    if pages.url:
        first = "index.html" if pages.url.endswith("/") else ""
        return [f"Report: [{_literal(pages.name)}]({_address(pages.url + first)})", ""]
    run = [os.environ.get(f"GITHUB_{name}", "") for name in ("SERVER_URL", "REPOSITORY", "RUN_ID")]
    if not all(run):
        return [f"Report: {_literal(pages.name)}", ""]
    artefacts = _address(f"{run[0]}/{run[1]}/actions/runs/{run[2]}#artifacts")
    return [f"Report: {_literal(pages.name)}, where it is uploaded among the [artefacts of this run]({artefacts})", ""]


def _linked(pages: Pages, page: str) -> str:
    url = pages.url + page if pages.url.endswith("/") else ""
    return f"[{_literal(page)}]({_address(url)})" if url else _literal(page)


def _address(url: str) -> str:
    """A URL that ends where the link does."""
    return quote(printable(url), safe=":/?#&=%@+,;~$!*[]-._")


def _literal(text: str) -> str:
    """Markdown that shows the text as it is."""
    return re.sub(r"[!-,/:-@\[-`{-~]", lambda match: f"&#{ord(match[0])};", printable(text))
