"""`python -m validation renderers [--list | --install NAME,…]`: lists and installs the other renderers.

Exit code 0; 1 where an installation failed, with a line on stderr for each; 2 for misuse.
"""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from validation.run import command_line

from . import environments
from .system import System
from .table import SYSTEMS

NAME = "validation renderers"
app = command_line.application()


def main(arguments: list[str]) -> int:
    """Run the command line; the exit code."""
    return command_line.exit_code(app, NAME, arguments)


@app.command()
def _command(
    listed: Annotated[
        bool, typer.Option("--list", help="Print what there is, and whether it is installed (default).")
    ] = False,
    install: Annotated[str, typer.Option(metavar="NAME,…", help=f"Install some of {', '.join(SYSTEMS)}.")] = "",
) -> int:
    """List or install the other renderers and libraries that can be run here."""
    wanted = [name.strip() for name in install.split(",") if name.strip()]
    if unknown := [name for name in wanted if name not in SYSTEMS]:
        return command_line.misuse(NAME, f"unknown system {unknown[0]!r}; accepted: {', '.join(SYSTEMS)}")
    if listed and wanted:
        return command_line.misuse(NAME, "--list with --install; accepted: one of them")
    if not wanted:
        print("\n".join(_line(system) for system in SYSTEMS.values()))
    return max([_install(SYSTEMS[name]) for name in wanted], default=0)


def _install(system: System) -> int:
    print(f"{system.name}: {system.source}", file=sys.stderr)
    try:
        environments.install(system)
    except OSError as error:
        command_line.misuse(NAME, str(error))
        return 1
    return 0


def _line(system: System) -> str:
    does = " and ".join(
        word for word, able in (("rays", system.calls), ("images", system.draws), ("lenses", system.lens)) if able
    )
    state = "absent" if environments.absent(system) else "here"
    return f"{system.name:10} {state:7} {does:16} {system.megabytes:5} MB  {system.source}  [{system.licence}]"
