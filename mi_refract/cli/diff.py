"""The commands `mi-refract diff` and `mi-refract accept`. Words in, words out, as in `cli.py`."""

from __future__ import annotations

import contextlib
import enum
import importlib.util
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress

from mi_refract.image_diff import folders as engine
from mi_refract.image_diff import html_report
from mi_refract.image_diff import self_test as gate
from mi_refract.image_diff import settings as diff_settings
from mi_refract.image_diff import text_reports as output
from mi_refract.image_diff.folders import Results, Status
from mi_refract.io.atomic import writable
from mi_refract.io.provenance import provenance
from mi_refract.report.junit import printable

Folder = Annotated[Path, typer.Argument(metavar="REFERENCE", help="An image, or a folder of them.")]
Other = Annotated[Path, typer.Argument(metavar="TEST", help="What is compared with it, of the same kind.")]
NotAlways = Annotated[
    Path | None, typer.Argument(metavar="REFERENCE", help="An image, or a folder of them; no need for --self-test.")
]
NotWithSelfTest = Annotated[Path | None, typer.Argument(metavar="TEST", help="What is compared with it.")]
Method = Annotated[str, typer.Option(help=f"{'|'.join(diff_settings.ACCEPTED)}; see --methods.")]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="An option of the method.")]
File = Annotated[
    Path | None,
    typer.Option(metavar="FILE.toml", help=f"Rules for single images; REFERENCE's {diff_settings.FILE} by default."),
]
Nonfinite = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="An image (or pattern) where both sides may have the same NaN or Inf."),
]
OUTPUTS = ((".html", ".htm"), (".xml",), (".json",))  # of --report, --junit, --json
SELF_TEST_RENDERS, SELF_TEST_SPP = 8, 16


class Inconclusive(enum.StrEnum):
    """What an inconclusive comparison counts as."""

    PASS = "pass"
    FAIL = "fail"


def _print_methods(asked: bool) -> None:
    if asked:
        print(diff_settings.reference())
        raise typer.Exit


def diff(
    reference: NotAlways = None,
    test: NotWithSelfTest = None,
    method: Method = diff_settings.AUTO,
    options: Set = None,
    samples: Annotated[bool, typer.Option("--samples", help="Both folders hold renders of one image.")] = False,
    settings: File = None,
    allow_nonfinite: Nonfinite = None,
    inconclusive: Annotated[Inconclusive | None, typer.Option(help="What it counts as; else exit code 3.")] = None,
    report: Annotated[Path | None, typer.Option(metavar="OUT.html", help="Write a page to look at.")] = None,
    junit: Annotated[Path | None, typer.Option(metavar="OUT.xml", help="Write JUnit's XML.")] = None,
    json: Annotated[Path | None, typer.Option(metavar="OUT.json", help="Write JSON.")] = None,
    github: Annotated[bool, typer.Option("--github", help="Print annotations, write the job's summary.")] = False,
    methods: Annotated[
        bool, typer.Option("--methods", is_eager=True, callback=_print_methods, help="Print the methods' options.")
    ] = False,
    self_test: Annotated[
        bool,
        typer.Option("--self-test", help="Which defects planted in REFERENCE are seen? An image, renders, a scene."),
    ] = False,
) -> None:
    """Compare images with their references. Exit code 0: equal, 1: different, 2: not comparable, 3: inconclusive."""
    _require_extra("scipy", *(("jinja2", "matplotlib") if report else ()))
    if self_test:
        others = (options, samples, settings, allow_nonfinite, inconclusive, report, junit, json, github)
        if any(others) or method != diff_settings.AUTO:
            raise ValueError("--self-test asks every method and prints; accepted: no other option")
        raise typer.Exit(_self_test(reference, test))
    if reference is None or test is None:
        raise ValueError("two paths are needed; accepted: mi-refract diff REFERENCE TEST")
    for path, suffixes in zip((report, junit, json), OUTPUTS, strict=True):
        if path:
            writable(path, suffixes)
    chosen = _settings(reference, method, options, settings, allow_nonfinite)
    with _progress() as tell:
        found = engine.diff(
            reference, test, chosen, samples=samples, inconclusive=inconclusive or "", maps=bool(report), tell=tell
        )
    _say(found)
    if report:
        flags = chosen.default.flags + _flags("--allow-nonfinite", chosen.allow_nonfinite)
        flags += _flags("--settings", [settings] if settings else []) + ["--samples"] * samples
        replay = shlex.join(["mi-refract", "diff", engine.as_word(reference), engine.as_word(test), *flags])
        software = {key.rpartition(":")[2]: value for key, value in provenance().items() if ":" in key}
        html_report.write(report, found, software, replay)
    if junit:
        output.write_junit(junit, found)
    if json:
        output.write_json(json, found)
    if github:
        for line in output.workflow_commands(found):
            print(line)
        output.append_summary(found)
    raise typer.Exit(found.exit_code)


def accept(
    reference: Folder,
    test: Other,
    method: Method = diff_settings.AUTO,
    options: Set = None,
    settings: File = None,
    allow_nonfinite: Nonfinite = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Copy the images that are not equal over their references, after showing them. Nothing is deleted."""
    _require_extra("scipy")
    chosen = _settings(reference, method, options, settings, allow_nonfinite)
    with _progress() as tell:
        found = engine.diff(reference, test, chosen, new=True, tell=tell)
    _say(found)
    copies = list(engine.changes(found))
    for new, old in copies:
        print(printable(f"{new} → {old}{'' if old.exists() else ' (new)'}"))
    if not copies:
        print("nothing to accept")
    elif yes or _agreed(len(copies)):
        engine.accept(copies, found.began)
        print(f"{len(copies)} accepted")
    else:
        print("nothing accepted")
        raise typer.Exit(1)


def _require_extra(*packages: str) -> None:
    """ValueError where one that methods or report use is not installed: before anything is compared."""
    if not all(map(importlib.util.find_spec, packages)):
        raise ValueError("comparing needs the extra `diff`: pip install 'mi-refract[diff]'")


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    """What to call with the numbers of images done and in all; shown on a terminal, and gone at the end."""
    with Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("comparing", total=None)
        yield lambda done, of: progress.update(task, completed=done, total=of)


def _agreed(count: int) -> bool:
    if not sys.stdin.isatty():
        raise ValueError("accept asks on a terminal only; accepted elsewhere: --yes")
    return typer.confirm(f"Accept {count} as the reference{'' if count == 1 else 's'}?")


def _flags(name: str, values: Sequence[Any]) -> list[str]:
    return [word for value in values for word in (name, str(value))]


def _self_test(path: Path | None, other: Path | None) -> int:
    """Prints what is seen of the defects; 1 where one that was due is not."""
    if other:
        raise ValueError(f"{other}: --self-test takes one path; accepted: an image, a folder of renders, a scene")
    return gate.self_test(path)


def _settings(
    reference: Path, method: str, words: list[str] | None, file: Path | None, nonfinite: list[str] | None
) -> diff_settings.Settings:
    default = diff_settings.from_words(method, words or [])
    beside = (reference if reference.is_dir() else reference.parent) / diff_settings.FILE
    path = file or (beside if beside.exists() else None)
    rules = diff_settings.load(path) if path else ()
    return diff_settings.Settings(default, rules, tuple(nonfinite or ()))


def _say(found: Results) -> None:
    """The table on stdout, what could not be compared on stderr, a line each."""
    for result in found.of(Status.ERROR):
        print(f"mi-refract: {printable(result.error)}", file=sys.stderr)
    for pattern in found.unused:
        print(f"mi-refract: {printable(pattern)}: matches no image", file=sys.stderr)
    if len(found.results) > len(found.of(Status.ERROR)):
        # As wide as it must be where nobody looks on: no line of a log is a wrapped one.
        console = Console() if sys.stdout.isatty() else Console(width=10_000)
        console.print(output.table(found), highlight=False)
