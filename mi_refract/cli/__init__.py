"""The command `mi-refract`: one module per command; `app` puts them together and turns errors into one line.

In: the arguments of a command line. Out: text on stdout, the files asked for, and an exit code. The commands only read
options, call the rooms below, and print; everything they do can be done from Python without this room.
"""

import sys

from mi_refract import __version__
from mi_refract.io.exit_code import exit_code

__all__ = ["app", "main"]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, or `arguments`; the exit code."""
    return exit_code("mi-refract", lambda: _run(sys.argv[1:] if arguments is None else arguments))


def _run(arguments: list[str]) -> int:
    if arguments == ["--version"]:  # importing the parser takes ten times as long as all the rest of this
        print(__version__)
        return 0
    from .app import main

    return main(arguments)
