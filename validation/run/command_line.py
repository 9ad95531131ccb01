"""Shared code of the two command lines of the validation: errors are one line on stderr, with exit code 2."""

from __future__ import annotations

import functools
import sys

import typer

from mi_refract.io import errors
from mi_refract.io.text import printable


def application() -> typer.Typer:
    """Return an empty typer application, without completion and without typer's own tracebacks."""
    return typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def exit_code(app: typer.Typer, name: str, arguments: list[str]) -> int:
    """Run the command and return its exit code: 2 after an error, 130 after an interruption."""
    run = functools.partial(app, arguments, prog_name=f"python -m {name}", standalone_mode=False)
    return errors.exit_code(name, run, (KeyboardInterrupt, typer.Abort))


def misuse(name: str, message: str) -> int:
    """Print the error in one line on stderr, and return the exit code 2."""
    print(printable(f"{name}: {' '.join(message.split())}"), file=sys.stderr)
    return 2
