"""The results of `diff` as text: for the terminal, and in Markdown for the summary of a GitHub job.

File names and error messages may contain any character. Each format escapes those with a special meaning.
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

FEW = 20  # equal images that are listed by name
SUMMARY_ROWS = 500  # GitHub cuts a summary at 1 MiB
WORDS = {
    Status.ERROR: "could not be compared",
    Status.DIFFERENT: "different",
    Status.INCONCLUSIVE: "inconclusive",
    Status.EQUAL: "equal",
    Status.SKIPPED: "skipped",
}
RED = dict.fromkeys(("different", "added", "removed"), "bold red")
STYLES = RED | {"inconclusive": "yellow", "equal": "green", "skipped": "dim"}  # rich's styles, by the first cell
Rows = list[tuple[str, ...]]  # rows of a table; the first has the names of the columns


# Terminal -----------------------------------------------------------------------------------------------------------


def print_results(results: Results) -> None:
    """Print the table and `sentence` on stdout, and errors and unused patterns of the settings on stderr."""
    print_errors(results)
    for pattern in results.unused:
        print(f"mi-refract: {printable(pattern)}: matches no image", file=sys.stderr)
    if len(results.results) > len(results.of(Status.ERROR)):
        equal = [result for result in results.of(Status.EQUAL) if not result.warning]
        failed = results.of(Status.DIFFERENT, Status.INCONCLUSIVE)
        rows: Rows = [("verdict", "image", "method", "why")]
        for result in [*failed, *_equal_with_warning(results), *equal[:FEW], *results.of(Status.SKIPPED)]:
            rows.append((result.word, result.name, result.method_in_words, why(result)))
        print_table(rows, STYLES)
        if len(equal) > FEW:
            print(f"… and {len(equal) - FEW} more that are equal")
        print(sentence(results))


def print_errors(results: Results) -> None:
    """Print a line on stderr for each image that could not be compared, and if all are skipped."""
    for error in [result.error for result in results.of(Status.ERROR)] + [results.error] * bool(results.error):
        print(f"mi-refract: {printable(error)}", file=sys.stderr)


def print_table(rows: Rows, styles: Mapping[str, str] | None = None) -> None:
    """Print a table on stdout, without control characters. `styles`: rich's styles, by the first cell of a row."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(*rows[0], box=None, pad_edge=False)
    for row in rows[1:]:
        first, *others = map(printable, row)
        table.add_row(Text(first, style=(styles or {}).get(first, "")), *map(Text, others))
    console = Console(width=None if sys.stdout.isatty() else 100_000)  # lines of a log are not wrapped
    with console.capture() as capture:
        console.print(table)
    print("\n".join(map(str.rstrip, capture.get().splitlines())))


def sentence(results: Results) -> str:
    """Return all verdicts in one line: "12 images: 1 different, 2 added, 9 equal"."""
    one_sided = {Category.ADDED: "added", Category.REMOVED: "removed"}
    counts = Counter(one_sided.get(result.category, WORDS[result.status]) for result in results.results)
    order = dict.fromkeys([WORDS[Status.ERROR], WORDS[Status.DIFFERENT], *one_sided.values(), *WORDS.values()])
    text = ", ".join(f"{counts[word]} {word}" for word in order if counts[word])
    if warnings := sum(bool(result.warning) for result in results.results):
        text += f", {warnings} with a warning"
    if variants := len({path for result in results.results for path in result.variants}):
        text += f"; {variants} further reference{'s' if variants > 1 else ''}"
    number = len(results.results)
    return f"{number} image{'' if number == 1 else 's'}: {text}"


def settings_table(pairs: Sequence[Result]) -> Rows:
    """Return a table of the settings of each image, and the tables of the settings file that give them."""
    rows: Rows = [("image", "compared by", "from", "why")]
    for pair in pairs:
        how, words = pair.how, ["skipped"]
        if not how.skip:
            words = [how.method, *(f"{name}={value}" for name, value in how.options.items())]
            variants = ", ".join(path.relative_to(pair.target.parent).as_posix() for path in pair.variants)
            channels = ",".join(old if old == new else f"{old}={new}" for old, new in how.channels)
            others = {"or": variants, "mask": how.mask, "variance": how.variance, "channels": channels}
            words += [f"{name} {value}" for name, value in others.items() if value]
            words += [f"without {list(rectangle)}" for rectangle in how.ignore]
        rows.append((pair.name, ", ".join(words), ", ".join(how.entries) or "–", how.reason))
    return rows


def why(result: Result) -> str:
    """Return the reason of the verdict, the warning if any, and in brackets the reason in the settings if any."""
    warning = f"; warning: {result.warning}" if result.warning else ""
    return result.reason + warning + (f" [{result.how.reason}]" if result.how.reason else "")


def _equal_with_warning(results: Results) -> list[Result]:
    return [result for result in results.of(Status.EQUAL) if result.warning]


# GitHub's summary --------------------------------------------------------------------------------------------------


def markdown(results: Results, report: str = "", url: str = "") -> str:
    """Return a heading with the sentence, a link to the report, and a table of images that differ or have a warning.

    A summary can neither show an image from an artefact nor link to it. So a `report` without a `url` is only named.
    """
    failed = [*results.of(*FAILED), *_equal_with_warning(results)]
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
    """Return the text with a link to a URL; the URL is escaped, so that it cannot end the link."""
    return f"[{_literal(text)}]({quote(printable(url), safe=':/?#&=%@+,;~$!*[]-._')})"


def _literal(text: str) -> str:
    """Return Markdown that shows the text unchanged."""
    return re.sub(r"[!-,/:-@\[-`{-~]", lambda match: f"&#{ord(match[0])};", printable(text))
