"""Accepting: replace references by new images. The only module of the comparison that writes images."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refract.io import image_file, safe_files
from mi_refract.io.errors import describe
from mi_refract.io.safe_files import digest

from . import pairing
from .results import FAILED, Result, Results, Status

FEW = 10  # names in a message


class UnreadableImage(ValueError):
    """Error: a new image cannot be read, so it cannot become a reference; `result`: its comparison."""

    def __init__(self, result: Result, text: str) -> None:
        """`text`: the message."""
        super().__init__(text)
        self.result = result


@dataclass(frozen=True)
class Copy:
    """A file to copy over a reference; `compared`, `replaced`: the SHA-256 of both files when they were compared."""

    new: Path
    reference: Path
    compared: str
    replaced: str


def changes(results: Results, variant: str = "") -> Iterator[Copy]:
    """Yield a copy for each new image that differs from its reference, or has none.

    `results`: returned by `diff(to_accept=True)`. Copies that an interrupted call has made already are skipped.
    `variant`: keep the old references, and add the new images as variants of this name, see `pairing.variant`.

    Errors, for a new image that cannot become a reference: UnreadableImage; ValueError or OSError if it has values that
    are not finite, if its format differs from the suffix of the reference, or if the reference would be outside of its
    folder.
    """
    equal = [result for result in results.of(Status.EQUAL) if not result.matched]
    targets = {result.target for result in (results.results if variant else equal)}
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
        existing = digest(target)
        if target in targets or (variant and existing not in ("", compared) and target not in result.variants):
            raise ValueError(f"{target}: also the reference of another image; expected a reference of its own")
        targets.add(target)
        decoded: dict[Path, str] = {}
        try:
            images = image_file.read_parts(result.test, result.how.max_values, decoded)
        except (ValueError, OSError) as error:
            raise UnreadableImage(result, describe(error)) from error
        if decoded[result.test] != compared:
            raise _changed_error(result.test)
        if not result.how.options.get("allow_nonfinite") and not all(np.isfinite(x.pixels).all() for x in images):
            advice = "to accept them, compare with --set allow_nonfinite=true"
            raise ValueError(f"{result.test}: values that are not finite; {advice}")
        if target.suffix.lower() != result.test.suffix.lower():
            raise ValueError(f"{target}: expected a name that ends in {result.test.suffix}, as {result.test} does")
        copies = [Copy(result.test, target, compared, result.digests.get(target, ""))]
        if result.how.variance:  # copied before the image, so that an interrupted call can be repeated
            how, sides = result.how, zip((result.test, target), reversed(results.roots), strict=True)
            source, old = (pairing.beside(how.variance, path, root, how.above) for path, root in sides)
            if source.exists():
                copies.insert(0, Copy(source, old, result.digests.get(source, ""), result.digests.get(old, "")))
            elif old.exists():
                text = f"{source}: no such file, and {old} belongs to a different render"
                raise ValueError(f"{text}; expected a variance")
        for copy in copies:
            for path, root in zip((copy.reference, copy.new), results.roots, strict=True):
                if not pairing.is_inside(path, root):
                    raise ValueError(f"{path}: outside of {root}, by a link or a template; expected a path inside")
            if digest(copy.reference) != copy.compared:
                yield copy


class Acceptance:
    """Copies new images over their references, if no file has changed since the comparison.

    All copies are written to hidden files first; then these are renamed in the order of `copies`.
    """

    def __init__(self, copies: Sequence[Copy]) -> None:
        """`copies`: from `changes`."""
        self.copies = copies
        self._replaced = 0
        self._replacing = threading.Lock()

    def run(self) -> None:
        """Copy all files. OSError or ValueError if a file has changed or cannot be written.

        After an error no reference is replaced, or the message lists those that are.
        """
        self._require_unchanged()
        with contextlib.ExitStack() as stack:
            hidden_files: list[Path] = []
            for copy in self.copies:
                copy.reference.parent.mkdir(parents=True, exist_ok=True)
                hidden_file = stack.enter_context(safe_files.beside(copy.reference))
                if safe_files.copy(copy.new, hidden_file) != copy.compared:
                    raise _changed_error(copy.new)
                safe_files.sync(hidden_file)
                hidden_files.append(hidden_file)
            self._require_unchanged()
            try:
                for copy, hidden_file in zip(self.copies, hidden_files, strict=True):
                    with self._replacing:
                        safe_files.move_into_place(hidden_file, copy.reference)
                        self._replaced += 1
            except OSError as error:
                raise OSError(f"{describe(error)}; {self._state()}") from error

    def stop(self) -> str:
        """Stop replacing references, and return which are replaced. Call it from another thread; `run` then hangs."""
        self._replacing.acquire()
        return self._state()

    def _state(self) -> str:
        names = [str(copy.reference) for copy in self.copies]
        done, rest = names[: self._replaced], names[self._replaced :]
        if not (done and rest):
            return "all references are replaced" if done else "no reference is replaced"
        return f"replaced: {_listed(done)}; not replaced: {_listed(rest)}; run the same command again to accept these"

    def _require_unchanged(self) -> None:
        for copy in self.copies:
            for path, before in ((copy.new, copy.compared), (copy.reference, copy.replaced)):
                if digest(path) != before:
                    raise _changed_error(path)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= FEW else f"{names[0]} … {names[-1]} ({len(names)} in the order above)"


def _changed_error(path: Path) -> OSError:
    return OSError(f"{path}: changed since it was compared")
