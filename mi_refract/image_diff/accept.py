"""Accepting: new images become the references. The only part of the comparison that writes images."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refract.io import image_file, safe_files
from mi_refract.io.errors import describe

from . import pairing
from .folders import digest
from .results import FAILED, Result, Results

FEW = 10  # names in a message


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

    Those that have been made already, by a call that was interrupted, are left out. `variant`: the copies become other
    references beside the old ones, of that name; see `pairing.variant`. ValueError or OSError for a new image that can
    be no reference: UnreadableImage, or one with values that are not finite, or of another format than the reference's
    name says, or where the reference would be outside of its folder.
    """
    taken = {result.target for result in results.results} if variant else set()
    for result in results.of(*FAILED):
        if result.error and (result.test is None or result.digests is None):
            raise UnreadableImage(result, result.error)
        if result.test is None:
            continue
        if result.digests is None:
            raise ValueError(f"{result.test}: compared without digests; expected results of diff(to_accept=True)")
        target, compared = result.target, result.digests[result.test]
        if variant:
            if result.reference is None:
                raise ValueError(f"{result.test}: has no reference yet; accept it without --as-variant first")
            target = pairing.variant(target, result.how, variant)
        there = digest(target)
        if target in taken or (variant and there not in ("", compared) and target not in result.variants):
            raise ValueError(f"{target}: also the reference of another image; expected a reference of its own")
        taken.add(target)
        decoded: dict[Path, str] = {}
        try:
            images = image_file.read_parts(result.test, result.how.max_values, decoded)
        except (ValueError, OSError) as error:
            raise UnreadableImage(result, describe(error)) from error
        if decoded[result.test] != compared:
            raise _changed(result.test)
        if not result.how.options.get("allow_nonfinite") and not all(np.isfinite(x.pixels).all() for x in images):
            raise ValueError(
                f"{result.test}: values that are not finite; to accept them, compare with --set allow_nonfinite=true"
            )
        if target.suffix.lower() != result.test.suffix.lower():
            raise ValueError(f"{target}: expected a name that ends in {result.test.suffix}, as {result.test} does")
        copies = [Copy(result.test, target, compared, result.digests.get(target, ""))]
        if result.how.reads_variance:  # it goes with the image, and before it: the image is still to be accepted then
            how, beside = result.how, zip((result.test, target), reversed(results.roots), strict=True)
            source, to = (pairing.beside(how.variance, path, root, how.above) for path, root in beside)
            if source.exists():
                copies.insert(0, Copy(source, to, result.digests.get(source, ""), result.digests.get(to, "")))
            elif to.exists():
                raise ValueError(f"{source}: no such file, and {to} belongs to a different render; expected a variance")
        for copy in copies:
            for path, root in zip((copy.reference, copy.new), results.roots, strict=True):
                if not pairing.is_inside(path, root):
                    raise ValueError(f"{path}: outside of {root}, by a link or a template; expected a path inside")
            if digest(copy.reference) != copy.compared:
                yield copy


class Acceptance:
    """Copies new images over their references: exactly the bytes that were compared, if the references are those, too.

    Every copy is complete, in a hidden file, before the first of them takes its name. Then they do so in their order.
    """

    def __init__(self, copies: Sequence[Copy]) -> None:
        """`copies`: of `changes`."""
        self.copies = copies
        self._replaced = 0
        self._replacing = threading.Lock()

    def run(self) -> None:
        """Accept all. OSError or ValueError where a file has changed, or cannot be written.

        Then no reference is replaced, or the error says which are.
        """
        self._require_unchanged()
        with contextlib.ExitStack() as hidden:
            parts: list[Path] = []
            for copy in self.copies:
                copy.reference.parent.mkdir(parents=True, exist_ok=True)
                part = hidden.enter_context(safe_files.beside(copy.reference))
                if safe_files.copy(copy.new, part) != copy.compared:
                    raise _changed(copy.new)
                safe_files.sync(part)
                parts.append(part)
            self._require_unchanged()
            try:
                for copy, part in zip(self.copies, parts, strict=True):
                    with self._replacing:
                        safe_files.move_into_place(part, copy.reference)
                        self._replaced += 1
            except OSError as error:
                raise OSError(f"{describe(error)}; {self._state()}") from error

    def stop(self) -> str:
        """Replace no more references, from another thread, and return which are replaced. `run` never returns then."""
        self._replacing.acquire()
        return self._state()

    def _state(self) -> str:
        names = [str(copy.reference) for copy in self.copies]
        done, left = names[: self._replaced], names[self._replaced :]
        if not (done and left):
            return "all references are replaced" if done else "no reference is replaced"
        return f"replaced: {_listed(done)}; not replaced: {_listed(left)}; the same command again accepts these"

    def _require_unchanged(self) -> None:
        for copy in self.copies:
            for path, before in ((copy.new, copy.compared), (copy.reference, copy.replaced)):
                if digest(path) != before:
                    raise _changed(path)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= FEW else f"{names[0]} … {names[-1]} ({len(names)} in the order above)"


def _changed(path: Path) -> OSError:
    return OSError(f"{path}: changed since it was compared")
