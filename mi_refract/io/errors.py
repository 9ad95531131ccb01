"""Errors that code catches by their cause, and what becomes of any error in a command: one line and exit code 2.

Each class is also the built-in error that Python's users expect for that cause. Every other error is a plain
ValueError, OSError, ImportError …: nobody needs to tell it apart. The message of all of them is one line: what is
wrong, where, and what was expected.
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
    """Base of the errors below; the message is written for a reader."""


class UsageError(MiRefractError, ValueError):
    """Options or arguments that do not exist, or that exclude each other."""


class MissingExtraError(MiRefractError, ImportError):
    """A package of an optional extra is not installed."""


class ImageError(MiRefractError, ValueError):
    """A file that is not a readable image, or larger than allowed."""


class CheckpointError(MiRefractError, ValueError):
    """A checkpoint that is damaged, or that belongs to a different render."""


class TooMuchOutputError(MiRefractError, ValueError):
    """Another program printed more than it may."""


class LostSchedulerError(MiRefractError, ConnectionError):
    """The Dask scheduler has ended or cannot be reached any more."""


class NoWorkersError(MiRefractError, ConnectionError):
    """No worker of the scheduler may be given work, or none is left."""


def exit_code(
    name: str, body: Callable[[], int | None], interruptions: tuple[type[BaseException], ...] = (KeyboardInterrupt,)
) -> int:
    """What `body()` returns, None as 0; 2 after any exception, and 130 after Ctrl-C or one of `interruptions`.

    The exception is one line on stderr, `name: …`. What the body printed is on its way when this returns: a stdout
    that cannot be written is an exception as well. A pipe that nobody reads any more, as before `| head`, is none: what
    is still printed is dropped. A standard stream that is closed is replaced by the null device, so that no file of
    ours takes its number.
    """
    for number, (stream, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, stream) is None:
            try:
                os.fstat(number)
            except OSError:
                if (null := os.open(os.devnull, os.O_RDWR)) != number:
                    os.dup2(null, number)
                    os.close(null)
            setattr(sys, stream, open(number, mode, closefd=False))  # noqa: SIM115 (it lasts as long as the process)
    for known_as in ("stdout", "stderr"):
        output = getattr(sys, known_as)
        buffer = getattr(output, "buffer", None)
        if isinstance(raw := getattr(buffer, "raw", buffer), io.FileIO):
            raw.write = functools.partial(_write_named, type(raw).write, raw, known_as)  # type: ignore[method-assign]
        if hasattr(output, "reconfigure") and output.errors in ("strict", "surrogateescape"):
            output.reconfigure(errors="backslashreplace")  # no character is one that it cannot print
    try:
        code = body() or 0
        sys.stdout.flush()
    except interruptions:
        return INTERRUPTED
    except SystemExit as ended:
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
    elif isinstance(error, ModuleNotFoundError) and error.name in ("mitsuba", "drjit"):
        text = f"{error}; only commands that compare images work without it: pip install mi-refract"
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


def _write_named(write: Callable[[Any, Any], int | None], stream: Any, name: str, content: Any) -> int | None:
    """`write`, whose errors name what could not be written; what no reader of a pipe is left for is dropped."""
    try:
        return write(stream, content)
    except BrokenPipeError:
        return len(content)
    except OSError as error:
        error.filename = name
        raise


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
