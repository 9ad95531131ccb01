"""The commands `mi-refract diff` and `mi-refract accept`: their options, and their output.

What only some calls need is imported there: of a comparison that takes a third of a second the imports are the most.
"""

from __future__ import annotations

import contextlib
import enum
import importlib.util
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mi_refract.image_diff import accept as accepting
from mi_refract.image_diff import folders, pairing, settings_file, text_reports
from mi_refract.image_diff.methods import AUTO
from mi_refract.image_diff.results import Results, Status, as_word
from mi_refract.image_diff.settings import Settings
from mi_refract.io.atomic import writable
from mi_refract.io.exit_code import MISUSE, describe
from mi_refract.io.image_file import MAX_VALUES
from mi_refract.io.outside_text import printable
from mi_refract.report.text_table import Plain

if TYPE_CHECKING:
    from rich.console import RenderableType

    from mi_refract.image_diff.html_report import Page
    from mi_refract.image_diff.report_folder import Folder as ReportFolder

NotAlways = Annotated[
    Path | None, typer.Argument(metavar="REFERENCE", help="An image, or a folder of them; optional with --self-test.")
]
NotWithSelfTest = Annotated[Path | None, typer.Argument(metavar="TEST", help="The image or folder to compare with it.")]
Names = Annotated[
    list[str] | None, typer.Argument(metavar="[NAME]...", help="Only these images: paths in the folders, * and ?.")
]
Method = Annotated[str, typer.Option(help=f"How: {'|'.join(settings_file.ACCEPTED)}; see --methods.")]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="An option of the method.")]
Idiff = Annotated[
    str | None,
    typer.Option("--idiff", metavar="FLAGS", help="Flags of OpenImageIO's idiff: --method tolerance with them."),
]
File = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.toml", help=f"Settings of single images; by default {settings_file.FILE} beside the references."
    ),
]
Nonfinite = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="An image (or pattern of names) where both sides may have the same NaN or Inf."),
]
Variance = Annotated[
    str, typer.Option(metavar="TEMPLATE", help='Images of the variance of a sample beside both: "{stem}_var.exr".')
]
Channels = Annotated[
    str, typer.Option(metavar="NAMES", help='Those that are compared: "X,Y,Z"; "nested.X=X" if names differ.')
]
MaxValues = Annotated[
    int, typer.Option("--max-values", metavar="N", min=1, help="Width × height × channels of an image, at most.")
]
SCENE = ".xml"
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


# Of `diff` alone.
Renders = Annotated[bool, typer.Option("--renders", help="Each folder holds several renders of one image.")]
OldRenders = Annotated[bool, typer.Option("--samples", hidden=True)]
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
SelfTest = Annotated[
    bool,
    typer.Option(
        "--self-test", help="Plant defects in REFERENCE (an image, a folder of renders, a scene); which are seen?"
    ),
]

AllowPlugins = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Run this plugin, which the scene of --self-test brings, too."),
]

# Of `accept` alone.
NotWithFrom = Annotated[
    Path | None, typer.Argument(help="As of diff; with --from optional: by default the paths that were compared.")
]
From = Annotated[
    Path | None,
    typer.Option("--from", metavar="OUT.json", help="What diff --json wrote: exactly the images that it compared."),
]
AsVariant = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="Keep the references: the new images become further ones, named by `accept` of the settings.",
    ),
]


def diff(
    reference: NotAlways = None,
    test: NotWithSelfTest = None,
    names: Names = None,
    method: Method = AUTO,
    options: Set = None,
    renders: Renders = False,
    samples: OldRenders = False,
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
    self_test: SelfTest = False,
    allow_plugins: AllowPlugins = None,
    check_settings: CheckSettings = False,
) -> None:
    """Compare images with their references. Exit code 0: equal, 1: different, 2: not comparable, 3: inconclusive."""
    _require_extra("scipy", *(("jinja2", "matplotlib") if report else ()))
    renders = renders or samples
    if allow_plugins and not (self_test and reference and reference.suffix == SCENE):
        raise ValueError("--allow-plugins: only a scene brings plugins; accepted: with --self-test SCENE.xml")
    if self_test:
        others = (
            options,
            idiff is not None,
            renders,
            settings,
            allow_nonfinite,
            inconclusive,
            report,
            junit,
            json,
            github,
            variance,
            channels,
        )
        if any(others) or method != AUTO:
            accepted = "no other option but --max-values, --allow-plugins"
            raise ValueError(f"--self-test asks every method and prints; accepted: {accepted}")
        raise typer.Exit(_self_test(reference, test, max_values, allow_plugins or []))
    if check_settings and reference:
        chosen = _settings(reference, method, options, idiff, settings, allow_nonfinite, max_values, variance, channels)
        raise typer.Exit(_check_settings(reference, test, names or [], chosen))
    if reference is None or test is None:
        raise ValueError("two paths are needed; accepted: mi-refract diff REFERENCE TEST")
    for path, suffixes in zip((junit, json), OUTPUTS, strict=True):
        if path:
            writable(path, suffixes)
    chosen = _settings(reference, method, options, idiff, settings, allow_nonfinite, max_values, variance, channels)
    wanted = inconclusive or ""
    with _reporting(report, reference, test) as page:
        with _progress() as tell:
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
        _say(found)
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


def accept(
    reference: NotWithFrom = None,
    test: NotWithFrom = None,
    names: Names = None,
    method: Method = AUTO,
    options: Set = None,
    idiff: Idiff = None,
    settings: File = None,
    allow_nonfinite: Nonfinite = None,
    variance: Variance = "",
    channels: Channels = "",
    max_values: MaxValues = MAX_VALUES,
    source: From = None,
    as_variant: AsVariant = "",
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Show which images are not equal to their references, ask, and copy them over. Nothing is deleted."""
    _require_extra("scipy")
    if source:
        if options or allow_nonfinite or method != AUTO or idiff is not None or variance or channels:
            raise ValueError("--from takes what was compared; accepted: no option that says how")
        found = _read_results(source, reference, test, names or [], settings, max_values)
    elif reference is None or test is None:
        raise ValueError("two paths are needed; accepted: mi-refract accept REFERENCE TEST, or --from OUT.json")
    else:
        chosen = _settings(reference, method, options, idiff, settings, allow_nonfinite, max_values, variance, channels)
        with _progress() as tell:
            found = folders.diff(reference, test, chosen, names=names or [], to_accept=True, tell=tell)
        _say(found)
    _copy(_changes(found, as_variant), yes)


def _read_results(
    source: Path, reference: Path | None, test: Path | None, names: Sequence[str], file: Path | None, most: int
) -> Results:
    """The results in a file, with the settings as they are now."""
    from mi_refract.image_diff import results_file

    found = results_file.read(source, reference, test)
    found = replace(found, results=tuple(pairing.named(found.results, names)))
    return results_file.with_settings(found, _settings(found.reference, AUTO, None, None, file, None, most, "", ""))


def _copy(copies: Sequence[accepting.Copy], yes: bool) -> None:
    for copy in copies:
        print(printable(f"{copy.new} → {copy.reference}{'' if copy.replaced else ' (new)'}"))
    if not copies:
        print("nothing to accept")
    elif yes or _agreed(len(copies)):
        accepting.accept(copies)
        print(f"{len(copies)} accepted")
    else:
        print("nothing accepted")
        raise typer.Exit(1)


def _changes(found: Results, variant: str) -> list[accepting.Copy]:
    """What is to be copied. Where an image can be no reference, `_say` may have said so already."""
    try:
        return list(accepting.changes(found, variant))
    except (ValueError, OSError) as error:
        if describe(error) in {printable(result.error) for result in found.of(Status.ERROR)}:
            raise typer.Exit(MISUSE) from None
        raise


def _require_extra(*packages: str) -> None:
    """ValueError, before anything is compared, where a package is not installed."""
    if not all(map(importlib.util.find_spec, packages)):
        raise ValueError("comparing needs the extra `diff`: pip install 'mi-refract[diff]'")


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    """A function to call with the numbers of images done and of all; a progress bar on a terminal."""
    if not sys.stderr.isatty():
        yield lambda done, of: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("comparing", total=None)
        yield lambda done, of: progress.update(task, completed=done, total=of)


def _agreed(count: int) -> bool:
    if not sys.stdin.isatty():
        raise ValueError("accept asks on a terminal only; accepted elsewhere: --yes")
    return typer.confirm(f"Accept {count} as the reference{'' if count == 1 else 's'}?")


def _replay(found: Results, names: Sequence[str]) -> str:
    """The command that repeats the whole comparison."""
    sides = (as_word(path) for path in (found.reference, found.test))
    return shlex.join(["mi-refract", "diff", *sides, *names, *found.flags, *["--renders"] * found.renders])


def _self_test(path: Path | None, other: Path | None, max_values: int, allow_plugins: Sequence[str]) -> int:
    """Print which defects are seen; 1 where one that was due is not."""
    from mi_refract.image_diff import self_test as self_tests

    from . import self_test_scenes

    if other:
        raise ValueError(f"{other}: --self-test takes one path; accepted: an image, a folder of renders, a scene")
    if path is None:
        renders = self_test_scenes.glass_ball()
    elif path.suffix == SCENE:
        renders = self_test_scenes.of_file(path, allow_plugins)
    else:
        renders = self_tests.read_images(path, max_values)
    rows = self_tests.examine(renders, str(path or "a glass ball"))
    _print(self_tests.table(rows))
    return int(self_tests.failed(rows))


def _settings(
    reference: Path,
    method: str,
    words: list[str] | None,
    idiff: str | None,
    file: Path | None,
    nonfinite: list[str] | None,
    max_values: int,
    variance: str,
    channels: str,
) -> Settings:
    default = replace(
        settings_file.from_words(method, words or [], idiff),
        max_values=max_values,
        variance=settings_file.variance_from(variance) if variance else "",
        channels=settings_file.channels_from(channels) if channels else (),
    )
    beside = (reference if reference.is_dir() else reference.parent) / settings_file.FILE
    path = file or (beside if beside.exists() else None)
    if path is None:
        return Settings(default, allow_nonfinite=tuple(nonfinite or ()))
    return replace(settings_file.load(path, default, nonfinite or ()), path=str(file or ""))


def _check_settings(reference: Path, test: Path | None, names: Sequence[str], chosen: Settings) -> int:
    """Print how each image would be compared, and which entries say so; 2 where that is wrong for one."""
    pairs = pairing.named(pairing.pairs(reference, test or reference, chosen), names)
    _print(text_reports.settings_table(pairs))
    for pattern in chosen.unused([pair.name for pair in pairs]):
        print(f"mi-refract: {printable(pattern)}: matches no image", file=sys.stderr)
    wrong = [pair for pair in pairs if pair.error or pair.how.error]
    for pair in wrong:
        print(f"mi-refract: {printable(pair.name)}: {printable(pair.error or pair.how.error)}", file=sys.stderr)
    return 2 if wrong else 0


def _say(found: Results) -> None:
    """The table on stdout, what could not be compared on stderr, a line each."""
    for result in found.of(Status.ERROR):
        print(f"mi-refract: {printable(result.error)}", file=sys.stderr)
    for flags in text_reports.without_effect(found):
        print(f"mi-refract: {printable(flags)}", file=sys.stderr)
    for pattern in found.unused:
        print(f"mi-refract: {printable(pattern)}: matches no image", file=sys.stderr)
    if len(found.results) > len(found.of(Status.ERROR)):
        _print(text_reports.table(found))


def _print(table: Plain | RenderableType) -> None:
    if isinstance(table, Plain) and not (sys.stdout.isatty() or os.environ.get("FORCE_COLOR")):
        print(table)
        return
    from rich.console import Console

    # As wide as it must be where nobody looks on: no line of a log is a wrapped one.
    console = Console() if sys.stdout.isatty() else Console(width=10_000)
    console.print(table, highlight=False)
