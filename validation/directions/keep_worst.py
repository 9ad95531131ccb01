"""`python -m validation.directions.keep_worst [FORMULA …]`: searches by hand, and keeps the worst rays for the tests.

Exit code 0; 2 for misuse; 130 where it was interrupted.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from mi_refract import backend
from mi_refract.formulas import FORMULAS
from validation.run import command_line
from validation.run.array_settings import Setting, settings
from validation.run.context import PROFILES, Context

from . import search, worst_rays

NAME = "validation.directions.keep_worst"
app = command_line.application()


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, or `arguments`; the exit code."""
    return command_line.exit_code(app, NAME, sys.argv[1:] if arguments is None else arguments)


@app.command()
def _command(
    formulas: Annotated[list[str] | None, typer.Argument(metavar="[FORMULA]…", help="Default: all.")] = None,
    generations: Annotated[int, typer.Option(min=1, help="Steps of the search.")] = PROFILES["full"].generations,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the ray generator.")] = search.SEED,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what is found and keep nothing.")] = False,
) -> int:
    """Search for the rays with the largest errors of each formula, and add them to the rays that the tests replay."""
    if unknown := [name for name in formulas or () if name not in FORMULAS]:
        return command_line.misuse(NAME, f"unknown formula {unknown[0]!r}; expected {', '.join(FORMULAS)}")
    variant = backend.activate(may_restart=True)
    context = Context(PROFILES["full"], Path(), variant, backend.detect(), backend.usable_variants())
    for setting in settings(context):
        if setting.is_scalar or setting.vector is None:
            continue
        for name in formulas or FORMULAS:
            _search(name, setting, generations, seed, not dry_run)
    return 0


def _search(name: str, setting: Setting, generations: int, seed: int, keep: bool) -> None:
    domain = search.domain(name, setting)
    herd = search.climb(name, FORMULAS[name], domain, setting, generations, seed, search.LARGEST_SAMPLE)
    found = search.certify(name, FORMULAS[name], herd, setting)
    broken = sum(f.share > 1 if f.line.objective == "chord" else f.share > 0 for f in found)
    print(f"{setting.label}, {name}: {max(f.share for f in found):.3g} of its bound, {broken} rays over it")
    if keep:
        lines = [*search.rescored(name, setting), *search.worth_keeping(found)]
        print(f"  {worst_rays.keep(lines)} new lines in {worst_rays.PATH}")


if __name__ == "__main__":
    sys.exit(main())
