"""Accepting: new images become the references. The only part of the comparison that writes images."""

from __future__ import annotations

import contextlib
import hashlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refract.io import image_file, safe_files
from mi_refract.io.errors import describe
from mi_refract.io.safe_files import replacing

from . import pairing
from .folders import digest
from .results import FAILED, Result, Results

BLOCK = 2**20  # bytes that are copied at once


class UnreadableImage(ValueError):
    """A new image that cannot be read, and so can be no reference; `result` is its comparison."""

    def __init__(self, result: Result, text: str) -> None:
        """`text`: what the error says."""
        super().__init__(text)
        self.result = result


@dataclass(frozen=True)
class Copy:
    """A new image that is to become the reference, and the digests of both when they were compared."""

    new: Path
    reference: Path
    compared: str
    replaced: str


def changes(results: Results, variant: str = "") -> Iterator[Copy]:
    """A copy for each image that is not equal to its reference, or has none. `results`: of a `diff(to_accept=True)`.

    `variant`: the copies become other references beside the old ones, of that name; see `pairing.variant`.
    ValueError or OSError for a new image that can be no reference: UnreadableImage, or one with values that are not
    finite, or of another format than the reference's name says.
    """
    taken = {result.target for result in results.results} if variant else set()
    for result in results.of(*FAILED):
        if result.error and (result.test is None or result.digests is None):
            raise UnreadableImage(result, result.error)
        if result.test is None:
            continue
        if result.digests is None:
            raise ValueError(f"{result.test}: compared without digests; expected results of diff(to_accept=True)")
        target = result.target
        if variant:
            if result.reference is None:
                raise ValueError(f"{result.test}: has no reference yet; accept it without --as-variant first")
            target = pairing.variant(target, result.how, variant)
        if target in taken or (variant and target.exists() and target not in result.variants):
            raise ValueError(f"{target}: also the reference of another image; expected a reference of its own")
        taken.add(target)
        try:
            images = image_file.read_parts(result.test, result.how.max_values)
        except (ValueError, OSError) as error:
            raise UnreadableImage(result, describe(error)) from error
        finite = all(np.isfinite(image.pixels).all() for image in images)
        if not result.how.options.get("allow_nonfinite") and not finite:
            raise ValueError(
                f"{result.test}: values that are not finite; to accept them, pass --set allow_nonfinite=true"
            )
        if target.suffix.lower() != result.test.suffix.lower():
            raise ValueError(f"{target}: expected a name that ends in {result.test.suffix}, as {result.test} does")
        yield Copy(result.test, target, result.digests[result.test], result.digests.get(target, ""))
        if result.how.reads_variance:  # it goes with the image
            references, tests = results.roots
            source = pairing.beside(result.how.variance, result.test, tests)
            to = pairing.beside(result.how.variance, target, references)
            if source.exists():
                yield Copy(source, to, result.digests.get(source, ""), result.digests.get(to, ""))
            elif to.exists():
                raise ValueError(f"{source}: no such file, and {to} belongs to a different render; expected a variance")


def accept(copies: Sequence[Copy]) -> None:
    """Copy each new image over its reference: exactly the bytes that were compared, over those they were compared with.

    OSError or ValueError where either has changed, or a copy cannot be written: then no reference is replaced. Every
    copy is complete before the first of them takes its name.
    """
    _require_unchanged(copies)
    with contextlib.ExitStack() as unfinished:
        for copy in copies:
            copy.reference.parent.mkdir(parents=True, exist_ok=True)
            temporary, copied = unfinished.enter_context(replacing(copy.reference)), hashlib.sha256()
            with safe_files.opened(copy.new, sys.maxsize) as file, temporary.open("wb") as target:
                while block := file.read(BLOCK):
                    copied.update(block)
                    target.write(block)
            if copied.hexdigest() != copy.compared:
                raise _changed(copy.new)
        _require_unchanged(copies)


def _require_unchanged(copies: Sequence[Copy]) -> None:
    for copy in copies:
        for path, before in ((copy.new, copy.compared), (copy.reference, copy.replaced)):
            if digest(path) != before:
                raise _changed(path)


def _changed(path: Path) -> OSError:
    return OSError(f"{path}: changed since it was compared")
