"""The command `mi-refract diff`: its options, and its output."""

from __future__ import annotations

import contextlib
import enum
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mi_refract.image_diff import folders, pairing, settings_file, text_reports
from mi_refract.image_diff.methods import AUTO
from mi_refract.image_diff.results import Results, as_word
from mi_refract.image_diff.settings import Settings
from mi_refract.io.atomic import writable
from mi_refract.io.image_file import MAX_VALUES
from mi_refract.io.sanitise import printable

from .comparing import (
    Channels,
    File,
    Idiff,
    MaxValues,
    Method,
    Names,
    Nonfinite,
    Set,
    Variance,
    print_table,
    progress,
    require_extra,
    say,
    settings_of,
)

if TYPE_CHECKING:
    from mi_refract.image_diff.html_report import Page
    from mi_refract.image_diff.report_folder import Folder as ReportFolder

Reference = Annotated[Path, typer.Argument(metavar="REFERENCE", help="An image, or a folder of them.")]
Test = Annotated[
    Path | None,
    typer.Argument(metavar="TEST", help="The image or folder to compare with it; optional with --check-settings."),
]
OUTPUTS = ((".xml",), (".json",))  # of --junit, --json
PAGES = (".html", ".htm")


class Inconclusive(enum.StrEnum):
    """What an inconclusive image counts as."""

    PASS = "pass"
    FAIL = "fail"


def _print_methods(asked: bool) -> None:
    if asked:
        text = settings_file.reference()
        if sys.stdout.isatty():
            from rich.console import Console
            from rich.markdown import Markdown

            Console().print(Markdown(text))
        else:
            print(text)
        raise typer.Exit


Renders = Annotated[bool, typer.Option("--renders", help="Each folder holds several renders of one image.")]
CountsAs = Annotated[
    Inconclusive | None, typer.Option(help="What an inconclusive image counts as; exit code 3 by default.")
]
Report = Annotated[
    str,
    typer.Option(
        metavar="OUT.html|FOLDER/", help="Write an HTML page with the images; a folder has them all, one page a pair."
    ),
]
ReportUrl = Annotated[
    str,
    typer.Option(
        metavar="URL",
        envvar="MI_REFRACT_REPORT_URL",
        help="Where the report will be found, for the job's summary; below URL/ every page is linked.",
    ),
]
JUnit = Annotated[Path | None, typer.Option(metavar="OUT.xml", help="Write JUnit XML.")]
Json = Annotated[Path | None, typer.Option(metavar="OUT.json", help="Write JSON.")]
GitHub = Annotated[bool, typer.Option("--github", help="Print GitHub annotations, write the job's summary.")]
Methods = Annotated[
    bool, typer.Option("--methods", is_eager=True, callback=_print_methods, help="Print the methods and their options.")
]
CheckSettings = Annotated[
    bool, typer.Option("--check-settings", help="Print how each image would be compared, and which settings say so.")
]


def diff(
    reference: Reference,
    test: Test = None,
    names: Names = None,
    method: Method = AUTO,
    options: Set = None,
    renders: Renders = False,
    idiff: Idiff = None,
    settings: File = None,
    allow_nonfinite: Nonfinite = None,
    variance: Variance = "",
    channels: Channels = "",
    max_values: MaxValues = MAX_VALUES,
    inconclusive: CountsAs = None,
    report: Report = "",
    report_url: ReportUrl = "",
    junit: JUnit = None,
    json: Json = None,
    github: GitHub = False,
    methods: Methods = False,
    check_settings: CheckSettings = False,
) -> None:
    """Compare images with their references. Exit code 0: equal, 1: different, 2: not comparable, 3: inconclusive."""
    require_extra("scipy", *(("jinja2", "matplotlib") if report else ()))
    if test is None and not check_settings:
        raise ValueError("two paths are needed; expected mi-refract diff REFERENCE TEST")
    chosen = settings_of(reference, method, options, idiff, settings, allow_nonfinite, max_values, variance, channels)
    if check_settings or test is None:
        raise typer.Exit(_check_settings(reference, test, names or [], chosen))
    for path, suffixes in zip((junit, json), OUTPUTS, strict=True):
        if path:
            writable(path, suffixes)
    wanted = inconclusive or ""
    with _reporting(report, reference, test) as page:
        with progress() as tell:
            found = folders.diff(
                reference,
                test,
                chosen,
                names=names or [],
                renders=renders,
                inconclusive=wanted,
                view=page.view if page else None,
                digests=bool(json),
                tell=tell,
            )
        say(found)
        if page:
            from mi_refract.io.provenance import provenance

            software = {key.rpartition(":")[2]: value for key, value in provenance().items() if ":" in key}
            page.write(found, software, _replay(found, names or []), str(json or ""))
    _write(found, junit, json, _pages(report, report_url) if github else None, github)
    raise typer.Exit(found.exit_code)


@contextlib.contextmanager
def _reporting(report: str, *sides: Path) -> Iterator[Page | ReportFolder | None]:
    """What writes the report that was asked for. ValueError or OSError where that cannot be written."""
    if not report:
        yield None
        return
    from mi_refract.image_diff import html_report, report_folder

    if _is_folder(report):
        report_folder.require_free(Path(report), *sides)
        with report_folder.writing(Path(report)) as folder:
            yield folder
    else:
        yield html_report.Page(writable(report, PAGES))


def _is_folder(report: str) -> bool:
    """Whether the report is a folder: it ends in /, has no ending, or is one already."""
    path = Path(report)
    return report.endswith(("/", os.sep)) or (path.suffix.lower() not in PAGES and (not path.suffix or path.is_dir()))


def _pages(report: str, url: str) -> text_reports.Pages | None:
    if not report:
        return None
    from mi_refract.image_diff import report_rows

    page = report_rows.page_of if _is_folder(report) else lambda result: ""
    return text_reports.Pages(report, page, url)


def _write(
    found: Results, junit: Path | None, json: Path | None, pages: text_reports.Pages | None, github: bool
) -> None:
    """Write the JSON and JUnit files, and the GitHub annotations, that were asked for."""
    if junit:
        text_reports.write_junit(junit, found)
    if json:
        text_reports.write_json(json, found)
    if github:
        for line in text_reports.workflow_commands(found):
            print(line)
        text_reports.append_summary(found, pages)


def _replay(found: Results, names: Sequence[str]) -> str:
    """The command that repeats the whole comparison."""
    sides = (as_word(path) for path in (found.reference, found.test))
    return shlex.join(["mi-refract", "diff", *sides, *names, *found.flags, *["--renders"] * found.renders])


def _check_settings(reference: Path, test: Path | None, names: Sequence[str], chosen: Settings) -> int:
    """Print how each image would be compared, and which entries say so; 2 where that is wrong for one."""
    every = pairing.pairs(reference, test or reference, chosen)
    pairs = pairing.named(every, names)
    print_table(text_reports.settings_table(pairs))
    for pattern in chosen.unused([pair.name for pair in pairs]):
        print(f"mi-refract: {printable(pattern)}: matches no image", file=sys.stderr)
    wrong = {pair.name: pairing.error_of(pair, reference) for pair in (*pairs, *pairing.wrong_entries(chosen, every))}
    for name, error in wrong.items():
        if error:
            print(f"mi-refract: {printable(name)}: {printable(error)}", file=sys.stderr)
    return 2 if any(wrong.values()) else 0
