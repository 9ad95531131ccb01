"""The results of `diff` as text for people: printed, and in Markdown for the summary of a GitHub job.

Names of files and messages of errors may hold any character: each format escapes what would be read as more than text.
"""

from __future__ import annotations

import os
import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from urllib.parse import quote

from mi_refract.io.text import printable

from .results import FAILED, Category, Result, Results, Status

FEW = 20  # equal images that are listed one by one
SUMMARY_ROWS = 500  # GitHub cuts a summary at 1 MiB
WORDS = {
    Status.ERROR: "could not be compared",
    Status.DIFFERENT: "different",
    Status.INCONCLUSIVE: "inconclusive",
    Status.EQUAL: "equal",
    Status.SKIPPED: "skipped",
}
RED = dict.fromkeys(("different", "added", "removed"), "bold red")
STYLES = RED | {"inconclusive": "yellow", "equal": "green", "skipped": "dim"}  # of rich, by the first word of a row
Rows = list[tuple[str, ...]]  # of a table; the first holds the names of the columns


# Terminal -----------------------------------------------------------------------------------------------------------


def print_results(results: Results) -> None:
    """Print the table on stdout, and on stderr a line for each image that could not be compared, and for warnings."""
    print_errors(results)
    for pattern in results.unused:
        print(f"mi-refract: {printable(pattern)}: matches no image", file=sys.stderr)
    if len(results.results) > len(results.of(Status.ERROR)):
        equal = [result for result in results.of(Status.EQUAL) if not result.warning]
        failed = results.of(Status.DIFFERENT, Status.INCONCLUSIVE)
        rows: Rows = [("verdict", "image", "method", "why")]
        for result in [*failed, *_warned(results), *equal[:FEW], *results.of(Status.SKIPPED)]:
            rows.append((result.word, result.name, result.method_in_words, why(result)))
        print_table(rows, STYLES)
        if len(equal) > FEW:
            print(f"… and {len(equal) - FEW} more that are equal")
        print(sentence(results))


def print_errors(results: Results) -> None:
    """Print a line on stderr for each image that could not be compared."""
    for result in results.of(Status.ERROR):
        print(f"mi-refract: {printable(result.error)}", file=sys.stderr)


def print_table(rows: Rows, styles: Mapping[str, str] | None = None) -> None:
    """Print it on stdout, made printable. `styles`: of rich, by the first cell of a row."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    shown = Table(*rows[0], box=None, pad_edge=False)
    for row in rows[1:]:
        first, *others = map(printable, row)
        shown.add_row(Text(first, style=(styles or {}).get(first, "")), *map(Text, others))
    # In a file it is as wide as it must be: no line of a log is a wrapped one.
    console = Console(width=None if sys.stdout.isatty() else 100_000)
    with console.capture() as capture:
        console.print(shown, highlight=False)
    print("\n".join(map(str.rstrip, capture.get().splitlines())))


def sentence(results: Results) -> str:
    """All verdicts in one line: "12 images: 1 different, 2 added, 9 equal"."""
    lone = {Category.ADDED: "added", Category.REMOVED: "removed"}
    counts = Counter(lone.get(result.category, WORDS[result.status]) for result in results.results)
    order = dict.fromkeys([WORDS[Status.ERROR], WORDS[Status.DIFFERENT], *lone.values(), *WORDS.values()])
    counted = ", ".join(f"{counts[word]} {word}" for word in order if counts[word])
    number, warnings = len(results.results), sum(bool(result.warning) for result in results.results)
    warned = f", {warnings} with a warning" if warnings else ""
    further = len({path for result in results.results for path in result.variants})
    also = f"; {further} further reference{'s' if further > 1 else ''}" if further else ""
    return f"{number} image{'' if number == 1 else 's'}: {counted}{warned}{also}"


def settings_table(pairs: Sequence[Result]) -> Rows:
    """How each image would be compared, and the tables of the settings file that say so."""
    rows: Rows = [("image", "compared by", "from", "why")]
    for pair in pairs:
        how, parts = pair.how, ["skipped"]
        if not how.skip:
            parts = [how.method, *(f"{name}={value}" for name, value in how.options.items())]
            variants = ", ".join(path.relative_to(pair.target.parent).as_posix() for path in pair.variants)
            named = ",".join(one if one == two else f"{one}={two}" for one, two in how.channels)
            others = {"or": variants, "mask": how.mask, "variance": how.variance, "channels": named}
            parts += [f"{name} {value}" for name, value in others.items() if value]
            parts += [f"without {list(rectangle)}" for rectangle in how.ignore]
        rows.append((pair.name, ", ".join(parts), ", ".join(how.entries) or "–", how.reason))
    return rows


def why(result: Result) -> str:
    """The reason of the verdict, the warning, and the settings' reason where the image has settings of its own."""
    warned = f"; warning: {result.warning}" if result.warning else ""
    return result.reason + warned + (f" [{result.how.reason}]" if result.how.reason else "")


def _warned(results: Results) -> list[Result]:
    return [result for result in results.of(Status.EQUAL) if result.warning]


# GitHub's summary --------------------------------------------------------------------------------------------------


def markdown(results: Results, report: str = "", url: str = "") -> str:
    """A heading with the sentence, where the report is, and a table of what is not equal or has a warning.

    No summary can show an image of an artefact, nor link into one. So a report without a `url` is only named.
    """
    failed = [*results.of(*FAILED), *_warned(results)]
    lines = [f"### mi-refract diff: {sentence(results)}", ""]
    run = [os.environ.get(f"GITHUB_{name}", "") for name in ("SERVER_URL", "REPOSITORY", "RUN_ID")]
    if report and url:
        lines += [f"Report: {_link(report, url)}", ""]
    elif report:
        artefacts = _link("artefacts of this run", f"{run[0]}/{run[1]}/actions/runs/{run[2]}#artifacts")
        among = f", where it is uploaded among the {artefacts}" if all(run) else ""
        lines += [f"Report: {_literal(report)}{among}", ""]
    if failed:
        lines += ["| verdict | image | method | why |", "|---|---|---|---|"]
    for result in failed[:SUMMARY_ROWS]:
        words = (result.word, result.name, result.method_in_words, why(result))
        lines.append(f"| {' | '.join(map(_literal, words))} |")
    if len(failed) > SUMMARY_ROWS:
        lines += ["", f"… and {len(failed) - SUMMARY_ROWS} more"]
    return "\n".join(lines) + "\n\n"


def _link(text: str, url: str) -> str:
    """The text with a link to a URL, which is escaped so that it ends where the link does."""
    return f"[{_literal(text)}]({quote(printable(url), safe=':/?#&=%@+,;~$!*[]-._')})"


def _literal(text: str) -> str:
    """Markdown that shows the text as it is."""
    return re.sub(r"[!-,/:-@\[-`{-~]", lambda match: f"&#{ord(match[0])};", printable(text))
