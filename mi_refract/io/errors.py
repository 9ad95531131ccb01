"""Errors that callers catch by their cause, and how a command reports any error: one line and exit code 2.

Each class also derives from the built-in error for its cause. Causes that no caller distinguishes have no class: they
raise ValueError, OSError, ImportError and so on. All messages are one line: what is wrong, where, and what was
expected.
"""

from __future__ import annotations

import contextlib
import functools
import io
import os
import sys
import traceback
from collections.abc import Callable
from typing import Any

from .text import printable

MISUSE, INTERRUPTED = 2, 130
TRACEBACK = "MI_REFRACT_TRACEBACK"  # environment variable: with "1" the traceback is printed as well


class MiRefractError(Exception):
    """Base of the errors below; their messages are written for users."""


class UsageError(MiRefractError, ValueError):
    """Options or arguments do not exist, or exclude each other."""


class MissingExtraError(MiRefractError, ImportError):
    """A package of an optional extra is not installed."""


class ImageError(MiRefractError, ValueError):
    """A file is not a readable image, or is larger than allowed."""


class CheckpointError(MiRefractError, ValueError):
    """A checkpoint is damaged, or belongs to a different render."""


class ExportError(MiRefractError, ValueError):
    """A scene has content that an export does not support, or that the format of its target cannot hold."""


class TooMuchOutputError(MiRefractError, ValueError):
    """Another program printed more than allowed."""


class LostSchedulerError(MiRefractError, ConnectionError):
    """The Dask scheduler has ended or cannot be reached any more."""


class NoWorkersError(MiRefractError, ConnectionError):
    """The scheduler has no worker that can be used, or none is left."""


def exit_code(
    name: str, body: Callable[[], int | None], interruptions: tuple[type[BaseException], ...] = (KeyboardInterrupt,)
) -> int:
    """Return the exit code of `body()`, 0 for None; 2 after any exception, 130 after Ctrl-C or one of `interruptions`.

    An exception is printed in one line on stderr, `name: …`. The output is flushed; an error of writing stdout counts
    as an exception. A closed pipe, as of `| head`, is no error: further output is dropped. A standard stream that is
    closed is replaced by the null device, so that no file that the body opens gets its number.
    """
    for number, (stream, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, stream) is None:
            try:
                os.fstat(number)
            except OSError:
                if (null := os.open(os.devnull, os.O_RDWR)) != number:
                    os.dup2(null, number)
                    os.close(null)
            setattr(sys, stream, open(number, mode, closefd=False))  # noqa: SIM115 (stays open until the process ends)
    for stream in ("stdout", "stderr"):
        output = getattr(sys, stream)
        buffer = getattr(output, "buffer", None)
        if isinstance(raw := getattr(buffer, "raw", buffer), io.FileIO):
            raw.write = functools.partial(_write_named, type(raw).write, raw, stream)  # type: ignore[method-assign]
        if hasattr(output, "reconfigure") and output.errors in ("strict", "surrogateescape"):
            output.reconfigure(errors="backslashreplace")  # every character can be printed
    try:
        code = body() or 0
        sys.stdout.flush()
    except interruptions:
        return INTERRUPTED
    except SystemExit as error:
        if isinstance(error.code, int | None):
            return error.code or 0
        return _report(name, ValueError(error.code))
    except Exception as error:
        return _report(name, error)
    return code


def describe(error: BaseException) -> str:
    """Return an error in one line: its message if that was written for users, else with its type."""
    if isinstance(error, MiRefractError):
        text = str(error)
    elif hasattr(error, "format_message"):  # typer's errors, whose classes depend on its version
        text = error.format_message()
    elif isinstance(error, OSError) and error.errno and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    elif isinstance(error, MemoryError):
        text = f"out of memory{f': {error}' if str(error) else ''}"
    elif isinstance(error, ModuleNotFoundError) and error.name in ("mitsuba", "drjit"):
        text = f"{error}; only commands that compare images work without it: pip install mi-refract"
    elif isinstance(error, ValueError | OSError | ImportError) and str(error):
        text = str(error)
    else:
        text = f"internal error: {type(error).__name__}: {error} ({TRACEBACK}=1 shows where)"
    return printable(" ".join(text.split()))


def print_traceback(error: BaseException) -> None:
    """Print the traceback on stderr if the environment variable TRACEBACK is "1"."""
    if os.environ.get(TRACEBACK) == "1":
        with contextlib.suppress(OSError, ValueError):
            traceback.print_exception(error)


def _write_named(write: Callable[[Any, Any], int | None], stream: Any, name: str, content: Any) -> int | None:
    """Call `write`, and add the name of the stream to its errors; output to a closed pipe is dropped."""
    try:
        return write(stream, content)
    except BrokenPipeError:
        return len(content)
    except OSError as error:
        error.filename = name
        raise


def _report(name: str, error: BaseException) -> int:
    """Print the error on stderr, if that can be written, and return the exit code MISUSE."""
    with contextlib.suppress(OSError, ValueError):
        print_traceback(error)
        print(f"{name}: {describe(error)}", file=sys.stderr, flush=True)
    for output in (sys.stdout, sys.stderr):
        try:
            output.flush()
        except (OSError, ValueError):
            # Otherwise Python would try again to write the rest when it ends, and exit with code 120.
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), output.fileno())
    return MISUSE
