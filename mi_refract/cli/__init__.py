"""The command `mi-refract`: one module per command; `app` lists them and prints errors as one line.

In: the arguments of a command line. Out: text on stdout, the requested files, and an exit code. The commands only read
options, call the packages below, and print; everything that they do can be done from Python without this package.
"""

import sys

__all__ = ["app", "main"]


def main(arguments: list[str] | None = None) -> int:
    """Run `arguments` and return the exit code.

    Without `arguments`, run the command line of this process; Ctrl-C then ends the process at once.
    """
    # SIGINT is blocked before anything else is imported: Ctrl-C during an import prints a traceback.
    if arguments is None:
        from .interrupts import end_at_once

        arguments = sys.argv[1:]
        # Mitsuba reacts to SIGINT even where the caller ignores it, so a render in the background ends, too.
        end_at_once(even_if_ignored=arguments[:1] == ["render"])
    from mi_refract.io.errors import exit_code

    return exit_code("mi-refract", lambda: _run(arguments))


def _run(arguments: list[str]) -> int:
    if arguments == ["--version"]:  # importing the parser would take ten times as long as everything else here
        from mi_refract import __version__

        print(__version__)
        return 0
    from .app import main

    return main(arguments)
