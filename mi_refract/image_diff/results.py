"""What a comparison of files or folders found: a result for each image, and what they mean together."""

from __future__ import annotations

import enum
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mi_refract.io.image_file import Image

from .comparison import Comparison, Verdict
from .settings import ComparisonSpec


class Status(enum.StrEnum):
    """A verdict; ERROR where there is none, SKIPPED where the settings ask for none. The most important first."""

    ERROR = "error"
    DIFFERENT = "different"
    INCONCLUSIVE = "inconclusive"
    EQUAL = "equal"
    SKIPPED = "skipped"


class Category(enum.StrEnum):
    """What happened to an image between the two folders; UNKNOWN without a verdict."""

    ADDED = "added"
    REMOVED = "removed"
    CHANGED = "changed"
    UNCHANGED = "unchanged"
    UNKNOWN = "unknown"


STATUSES = {Verdict.EQUAL: Status.EQUAL, Verdict.DIFFERENT: Status.DIFFERENT, Verdict.INCONCLUSIVE: Status.INCONCLUSIVE}
FAILED = (Status.ERROR, Status.DIFFERENT, Status.INCONCLUSIVE)
CATEGORIES = {Status.EQUAL: Category.UNCHANGED, Status.DIFFERENT: Category.CHANGED}
INCONCLUSIVE = {"": 3, "pass": 0, "fail": 1}  # exit codes by what the user wants of it


@dataclass(frozen=True)
class Result:
    """One image: its name, and what was found. `error` is the line that says why there is no verdict.

    `reference`, `test`: its files, or with renders its folders; None where that side has none. `how`: what was asked.
    `images`: both sides as they were read, of several renders the mean; empty where they were not kept. `digests`: of
    its files, variants too, when they were compared; None where that was not asked, or a file is unreadable.
    `target`: where the reference is, or would be. `variants`: other references that the settings accept; `matched`: the
    one of them that the new image is equal to. `warnings`: of its mask.
    """

    name: str
    status: Status
    reference: Path | None
    test: Path | None
    how: ComparisonSpec = field(default_factory=ComparisonSpec)
    comparison: Comparison | None = None
    error: str = ""
    images: tuple[Image, ...] = ()
    digests: Mapping[Path, str] | None = None
    target: Path | None = None
    variants: tuple[Path, ...] = ()
    matched: Path | None = None
    warnings: tuple[str, ...] = ()

    @property
    def category(self) -> Category:
        """What happened to the image between the two folders."""
        if self.status in (Status.ERROR, Status.SKIPPED):
            return Category.UNKNOWN
        if self.reference is None or self.test is None:
            return Category.ADDED if self.reference is None else Category.REMOVED
        return CATEGORIES.get(self.status, Category.UNKNOWN)

    @property
    def warning(self) -> str:
        """What does not change the verdict, but is to be looked at; "" for nothing."""
        return "; ".join([*self.warnings, *filter(None, [self.comparison.warning if self.comparison else ""])])

    @property
    def reason(self) -> str:
        """The reason for the status in one sentence."""
        if self.comparison:
            return self.comparison.reason + self._of_variants
        if self.status is Status.SKIPPED:
            return "skipped by the settings"
        sides = {Category.ADDED: "only among the new images", Category.REMOVED: "only among the references"}
        return self.error or sides[self.category]

    @property
    def _of_variants(self) -> str:
        if self.matched:
            return f"; matches {self.matched.name}"
        count = len(self.variants)
        return f"; nor is it {'its variant' if count == 1 else f'one of its {count} variants'}" if self._unequal else ""

    @property
    def _unequal(self) -> bool:
        return bool(self.variants) and self.status is not Status.EQUAL


@dataclass(frozen=True)
class Results:
    """What `diff` found, failures first.

    `reference`, `test`: the paths as given; `renders`: each of them holds renders of one image. `inconclusive`: what
    that counts as ("pass", "fail", or "" for an exit code of its own). `unused`: patterns of the settings that matched
    no image. `flags`: of the command line, as given for all images; `by_file`: whether the settings map names.
    """

    reference: Path
    test: Path
    results: tuple[Result, ...]
    renders: bool = False
    inconclusive: str = ""
    unused: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
    by_file: bool = False

    def of(self, *statuses: Status) -> list[Result]:
        """The results with one of these statuses."""
        return [result for result in self.results if result.status in statuses]

    @property
    def exit_code(self) -> int:
        """2: something could not be compared, or nothing was; 1: different; 3: inconclusive; 0: all equal."""
        if self.of(Status.ERROR) or len(self.of(Status.SKIPPED)) == len(self.results):
            return 2
        if self.of(Status.DIFFERENT):
            return 1
        return INCONCLUSIVE[self.inconclusive] if self.of(Status.INCONCLUSIVE) else 0

    def reproduce(self, result: Result) -> str:
        """The command that compares this image again; "" where one side has none."""
        if result.how.needs_file or self.by_file:
            return self._by_name("diff", result)
        flags = (["--renders"] if self.renders else []) + result.how.flags
        return _line("diff", result.reference, result.test, flags) if result.reference else ""

    def accept(self, result: Result) -> str:
        """The command that makes the new image the reference; "" where there is none, or no need."""
        if result.status is Status.EQUAL:
            return ""
        if result.how.needs_file or self.by_file:
            return self._by_name("accept", result)
        flags = [] if self.renders else result.how.flags
        return _line("accept", result.target or self.reference, result.test, flags)

    def _by_name(self, verb: str, result: Result) -> str:
        """The command of both folders for this image alone: the settings file says the rest."""
        names = [result.name] if self.reference.is_dir() else []
        return _line(verb, self.reference, self.test, [*names, *self.flags]) if result.test else ""


def _line(verb: str, reference: Path, test: Path | None, flags: Sequence[str]) -> str:
    return shlex.join(["mi-refract", verb, as_word(reference), as_word(test), *flags]) if test else ""


def as_word(path: Path) -> str:
    """The path as a word of a command line, with ./ before a name that would be read as an option."""
    return f"./{path}" if str(path).startswith("-") else str(path)
