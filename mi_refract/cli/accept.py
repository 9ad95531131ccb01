"""The command `mi-refract accept`: new images become references."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from mi_refract.image_diff import accept as accepting
from mi_refract.image_diff import folders, pairing
from mi_refract.image_diff.methods import AUTO
from mi_refract.image_diff.results import Results, Status
from mi_refract.io.exit_code import MISUSE, describe
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
    progress,
    require_extra,
    say,
    settings_of,
)

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
    require_extra("scipy")
    if source:
        if (reference is None) != (test is None):
            raise ValueError(f"{reference}: one path; accepted with --from: both folders before any names, or none")
        if options or allow_nonfinite or method != AUTO or idiff is not None or variance or channels:
            raise ValueError("--from takes what was compared; expected no option that says how")
        found = _read_results(source, reference, test, names or [], settings, max_values)
    elif reference is None or test is None:
        raise ValueError("two paths are needed; expected mi-refract accept REFERENCE TEST, or --from OUT.json")
    else:
        chosen = settings_of(
            reference, method, options, idiff, settings, allow_nonfinite, max_values, variance, channels
        )
        with progress() as tell:
            found = folders.diff(reference, test, chosen, names=names or [], to_accept=True, tell=tell)
        say(found)
    _copy(_changes(found, as_variant), yes)


def _read_results(
    source: Path, reference: Path | None, test: Path | None, names: Sequence[str], file: Path | None, most: int
) -> Results:
    """The results in a file, with the settings as they are now."""
    from mi_refract.image_diff import results_file

    found = results_file.read(source, reference, test)
    found = replace(found, results=tuple(pairing.named(found.results, names)))
    return results_file.with_settings(found, settings_of(found.reference, AUTO, None, None, file, None, most, "", ""))


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
    """What is to be copied. Where an image can be no reference, `say` may have said so already."""
    try:
        return list(accepting.changes(found, variant))
    except (ValueError, OSError) as error:
        if describe(error) in {printable(result.error) for result in found.of(Status.ERROR)}:
            raise typer.Exit(MISUSE) from None
        raise


def _agreed(count: int) -> bool:
    if not sys.stdin.isatty():
        raise ValueError("accept asks on a terminal only; elsewhere expected --yes")
    return typer.confirm(f"Accept {count} as the reference{'' if count == 1 else 's'}?")
