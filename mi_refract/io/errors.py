"""Errors that code catches by their cause. Each is also the built-in error that Python's users expect for that cause.

Every other error is a plain ValueError, OSError, ImportError …: nobody needs to tell it apart. The message of all of
them is one line: what is wrong, where, and what was expected.
"""

from __future__ import annotations


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
