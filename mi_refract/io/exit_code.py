"""The exit code of a command: its own verdict, or 2 with one line on stderr for everything else that may happen."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Callable

from .errors import MiRefractError
from .sanitise import printable

MISUSE, INTERRUPTED = 2, 130
TRACEBACK = "MI_REFRACT_TRACEBACK"  # environment variable: with "1" the traceback is printed as well


def exit_code(
    name: str,
    body: Callable[[], int | None],
    interruptions: tuple[type[BaseException], ...] = (KeyboardInterrupt,),
) -> int:
    """What `body()` returns, None as 0; 2 after any exception, and 130 after Ctrl-C or one of `interruptions`.

    The exception is one line on stderr, `name: …`. What the body printed is on its way when this returns: a stdout
    that cannot be written is an exception as well. A standard stream that is closed is replaced by the null device, so
    that no file of ours takes its number.
    """
    _open_streams()
    try:
        code = body() or 0
        sys.stdout.flush()
    except interruptions:
        return INTERRUPTED
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):  # rich ends the process with 1, as if that were a verdict
            return _failed(name, ended.__context__)
        if isinstance(ended.code, int | None):
            return ended.code or 0
        return _failed(name, ValueError(ended.code))
    except Exception as error:
        return _failed(name, error)
    return code


def describe(error: BaseException) -> str:
    """An error in one line: its own words where it was raised for a reader, else its type as well."""
    if isinstance(error, MiRefractError):
        text = str(error)
    elif hasattr(error, "format_message"):  # typer's own errors, whose classes depend on its version
        text = error.format_message()
    elif isinstance(error, OSError) and error.errno and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    elif isinstance(error, MemoryError):
        text = f"out of memory{f': {error}' if str(error) else ''}"
    elif isinstance(error, ValueError | OSError | ImportError) and str(error):
        text = str(error)
    else:
        text = f"internal error: {type(error).__name__}: {error} ({TRACEBACK}=1 shows where)"
    return printable(" ".join(text.split()))


def print_traceback(error: BaseException) -> None:
    """The traceback on stderr, where the environment variable asks for it."""
    if os.environ.get(TRACEBACK) == "1":
        with contextlib.suppress(OSError, ValueError):
            traceback.print_exception(error)


def _failed(name: str, error: BaseException) -> int:
    with contextlib.suppress(OSError, ValueError):  # a stderr that cannot be written says nothing
        print_traceback(error)
        print(f"{name}: {describe(error)}", file=sys.stderr, flush=True)
    for output in (sys.stdout, sys.stderr):
        try:
            output.flush()
        except (OSError, ValueError):
            # What is left would be tried again when Python ends, and change the exit code to 120.
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), output.fileno())
    return MISUSE


def _open_streams() -> None:
    """Open what is closed of stdin, stdout and stderr, and let no character be one that stdout cannot print."""
    for number, (stream, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, stream) is None:
            _occupy(number)
            setattr(sys, stream, open(number, mode, closefd=False))  # noqa: SIM115 (it lasts as long as the process)
    for output in (sys.stdout, sys.stderr):
        if hasattr(output, "reconfigure") and output.errors in ("strict", "surrogateescape"):
            output.reconfigure(errors="backslashreplace")


def _occupy(number: int) -> None:
    try:
        os.fstat(number)
    except OSError:
        null = os.open(os.devnull, os.O_RDWR)
        if null != number:
            os.dup2(null, number)
            os.close(null)
