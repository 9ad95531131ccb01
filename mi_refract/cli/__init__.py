"""The command `mi-refract`: one module per command; `app` puts them together and turns errors into one line.

In: the arguments of a command line. Out: text on stdout, the files asked for, and an exit code. The commands only read
options, call the rooms below, and print; everything they do can be done from Python without this room.
"""

import sys

__all__ = ["app", "main"]


def main(arguments: list[str] | None = None) -> int:
    """Run `arguments`, or the command line of this process, which Ctrl-C then ends at once; the exit code."""
    # Imported no sooner than needed: until SIGINT is blocked, Ctrl-C interrupts an import, with a traceback.
    if arguments is None:
        from .interrupts import end_at_once

        arguments = sys.argv[1:]
        # Mitsuba heeds SIGINT also where it is ignored, so a rendering in the background ends, too.
        rendering = arguments[:1] == ["render"]
        end_at_once(even_if_ignored=rendering)
    from mi_refract.io.errors import exit_code

    return exit_code("mi-refract", lambda: _run(arguments))


def _run(arguments: list[str]) -> int:
    if arguments == ["--version"]:  # importing the parser takes ten times as long as all the rest of this
        from mi_refract import __version__

        print(__version__)
        return 0
    from .app import main

    return main(arguments)
