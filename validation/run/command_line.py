"""What the two command lines of the validation share: errors are one line on stderr, with exit code 2."""

from __future__ import annotations

import sys

import typer


def application() -> typer.Typer:
    """An empty one, without completion and without typer's own tracebacks."""
    return typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def exit_code(app: typer.Typer, name: str, arguments: list[str]) -> int:
    """Run the command; its exit code, 2 after a usage error, 130 after an interruption."""
    try:
        return app(arguments, prog_name=f"python -m {name}", standalone_mode=False) or 0
    except Exception as error:
        # Typer's parser raises errors of its own, in a module whose name depends on its version.
        if type(error).__name__ == "Abort":
            return 130
        if not hasattr(error, "format_message"):
            raise
        return misuse(name, error.format_message())


def misuse(name: str, message: str) -> int:
    """Print the error in one line on stderr; 2, the exit code."""
    print(f"{name}: {' '.join(message.split())}", file=sys.stderr)
    return 2
