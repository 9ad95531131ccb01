"""What `mi-refract diff` and `mi-refract accept` share: options that say how images are compared, and what is printed.

What only some calls need is imported there: of a comparison that takes a third of a second the imports are the most.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mi_refract.image_diff import settings_file, text_reports
from mi_refract.image_diff.results import Results, Status
from mi_refract.image_diff.settings import Settings
from mi_refract.io.sanitise import printable
from mi_refract.report.text_table import Plain

if TYPE_CHECKING:
    from rich.console import RenderableType

Names = Annotated[
    list[str] | None, typer.Argument(metavar="NAME", help="Only these images: paths in the folders, * and ?.")
]
Method = Annotated[str, typer.Option(help=f"Comparison method: {'|'.join(settings_file.ACCEPTED)}; see --methods.")]
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
    str, typer.Option(metavar="NAMES", help='Channels to compare: "X,Y,Z"; "nested.X=X" if names differ.')
]
MaxValues = Annotated[
    int, typer.Option("--max-values", metavar="N", min=1, help="Width × height × channels of an image, at most.")
]


def require_extra(*packages: str) -> None:
    """ValueError, before anything is compared, where a package is not installed."""
    if not all(map(importlib.util.find_spec, packages)):
        raise ValueError("comparing needs the extra `diff`: pip install 'mi-refract[diff]'")


@contextlib.contextmanager
def progress() -> Iterator[Callable[[int, int], None]]:
    """A function to call with the numbers of images done and of all; a progress bar on a terminal."""
    if not sys.stderr.isatty():
        yield lambda done, of: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("comparing", total=None)
        yield lambda done, of: bar.update(task, completed=done, total=of)


def settings_of(
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
    """What the options and the settings file say. ValueError or OSError for what they cannot mean."""
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


def say(found: Results) -> None:
    """The table on stdout, what could not be compared on stderr, a line each."""
    for result in found.of(Status.ERROR):
        print(f"mi-refract: {printable(result.error)}", file=sys.stderr)
    for flags in text_reports.without_effect(found):
        print(f"mi-refract: {printable(flags)}", file=sys.stderr)
    for pattern in found.unused:
        print(f"mi-refract: {printable(pattern)}: matches no image", file=sys.stderr)
    if len(found.results) > len(found.of(Status.ERROR)):
        print_table(text_reports.table(found))


def print_table(table: Plain | RenderableType) -> None:
    """Print it on stdout, as plain text where nobody looks on."""
    if isinstance(table, Plain) and not (sys.stdout.isatty() or os.environ.get("FORCE_COLOR")):
        print(table)
        return
    from rich.console import Console

    # As wide as it must be where nobody looks on: no line of a log is a wrapped one.
    console = Console() if sys.stdout.isatty() else Console(width=10_000)
    console.print(table, highlight=False)
