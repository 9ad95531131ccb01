"""The command `mi-refract`: one module per command; `app` puts them together and turns errors into one line.

In: the arguments of a command line. Out: text on stdout, the files asked for, and an exit code. The commands only read
options, call the rooms below, and print; everything they do can be done from Python without this room.
"""

import sys

from mi_refract import __version__

__all__ = ["app", "main"]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line, or `arguments`; the exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    if words == ["--version"]:  # importing the parser takes ten times as long as all the rest of this
        print(__version__)
        return 0
    from .app import main

    return main(arguments)
