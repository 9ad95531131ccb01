"""Shared code of the command lines of the validation: errors are one line on stderr, with exit code 2."""

from __future__ import annotations

import functools

import typer

from mi_refract.io import errors


def application() -> typer.Typer:
    """Return an empty typer application, without completion and without typer's own tracebacks."""
    return typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def exit_code(app: typer.Typer, name: str, arguments: list[str]) -> int:
    """Run the command and return its exit code: 2 after an error, 130 after an interruption."""
    run = functools.partial(app, arguments, prog_name=f"python -m {name}", standalone_mode=False)
    return errors.exit_code(name, run, (KeyboardInterrupt, typer.Abort))
