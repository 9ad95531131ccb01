"""What a comparison of files or folders found: a result for each image, and what they mean together."""

from __future__ import annotations

import enum
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mi_refract.io.image_file import Image

from .comparison import Comparison, Metric
from .name_patterns import literal
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


FAILED = (Status.ERROR, Status.DIFFERENT, Status.INCONCLUSIVE)
CATEGORIES = {Status.EQUAL: Category.UNCHANGED, Status.DIFFERENT: Category.CHANGED}
INCONCLUSIVE = {"": 3, "pass": 0, "fail": 1}  # exit codes by what the user wants of it


@dataclass(frozen=True)
class Result:
    """One image, and the outcome: DIFFERENT until it is compared. `error`: why there is no verdict.

    `name`: the path of the new image in its folder, or what it would be. `reference`, `test`: its files, or with
    renders its folders; None where that side has none. `how`: the settings. `images`: the sides that the comparison is
    about, or that could be read, by role, of several renders the mean; empty where they were not kept; `unread`: why
    others are missing. `digests`: of its files, variants too, when they were compared; None where that was not asked,
    or a file is unreadable. `target`: where the reference is, or would be. `variants`: other references that the
    settings accept; `matched`: the one of them that the new image is equal to. `warnings`: of its mask.
    """

    name: str
    status: Status
    reference: Path | None
    test: Path | None
    how: ComparisonSpec = field(default_factory=ComparisonSpec)
    comparison: Comparison | None = None
    error: str = ""
    images: Mapping[str, Image] = field(default_factory=dict)
    unread: str = ""
    digests: Mapping[Path, str] | None = None
    target: Path = Path()
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
    def word(self) -> str:
        """The verdict in a word: of an image that only one side has, what happened to it."""
        return str(self.category if None in (self.reference, self.test) else self.status)

    @property
    def worst(self) -> tuple[float, Metric | None]:
        """The number that is the most times its bound, and how many times; NaN and what may be none are ∞ times it."""
        beyond = [metric for metric in self.comparison.metrics if not metric.holds] if self.comparison else []
        times = [m.value / m.bound if m.bound and not math.isnan(m.value) else math.inf for m in beyond]
        return (max(times), beyond[times.index(max(times))]) if beyond else (0.0, None)

    @property
    def order(self) -> tuple[float | str, ...]:
        """The key to sort by: status, then the worst first, then name and target."""
        lone = None in (self.reference, self.test)
        times, metric = self.worst if self.status in FAILED else (0.0, None)
        value = metric.value if metric and not math.isnan(metric.value) else math.inf if metric else 0.0
        return [*Status].index(self.status), lone, -times, -value, self.name, str(self.target)

    @property
    def warning(self) -> str:
        """What does not change the verdict, but is to be looked at; "" for nothing."""
        return "; ".join(filter(None, [*self.warnings, self.comparison.warning if self.comparison else ""]))

    @property
    def method(self) -> str:
        """The method that was applied, or is to be."""
        return self.comparison.method if self.comparison else self.how.method

    @property
    def method_in_words(self) -> str:
        """The method, and why it is this one."""
        return self.comparison.method_in_words if self.comparison else self.how.method

    @property
    def reason(self) -> str:
        """The reason for the status in one sentence."""
        if self.comparison:
            count = len(self.variants)
            differ = "its variant differs" if count == 1 else f"its {count} variants differ"
            also = f"; {differ}, too" if count and self.status is not Status.EQUAL else ""
            return self.comparison.reason + (f"; matches {self.matched.name}" if self.matched else also)
        if self.status is Status.SKIPPED:
            return "skipped by the settings" if self.how.entries else "skipped"
        sides = {Category.ADDED: "only among the new images", Category.REMOVED: "only among the references"}
        return self.error or sides[self.category]


@dataclass(frozen=True)
class Results:
    """The outcome of `diff`, failures first.

    `reference`, `test`: the paths; `renders`: each of them holds renders of one image. `inconclusive`: what that counts
    as ("pass", "fail", or "" for an exit code of its own). `unused`: patterns of the settings that matched no image.
    `flags`: the words of the command line that set the same for all images.
    """

    reference: Path
    test: Path
    results: tuple[Result, ...]
    renders: bool = False
    inconclusive: str = ""
    unused: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()

    @property
    def roots(self) -> tuple[Path, Path]:
        """The folders of both sides."""
        folders = self.test.is_dir()  # then the reference is one, if only later
        return (self.reference, self.test) if folders else (self.reference.parent, self.test.parent)

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

    def command(self, verb: str, *names: str, flags: Sequence[str] | None = None) -> str:
        """The command line of `diff` or `accept` for the whole comparison, or for the images of these names alone."""
        # A name that begins with a dash would be read as an option.
        words = [f"./{path}" if str(path).startswith("-") else str(path) for path in (self.reference, self.test)]
        words += self.flags if flags is None else flags
        words += ["--renders"] * (self.renders and verb == "diff")
        return shlex.join(["mi-refract", verb, *words, *["--"] * any(x.startswith("-") for x in names), *names])

    def reproduce(self, result: Result) -> str:
        """The command that compares this image again; "" where one side has none."""
        if result.reference is None or result.test is None:
            return ""
        return self.command("diff", *self._names(result))

    def accept(self, result: Result) -> str:
        """The command that makes the new image the reference; "" where there is none, or no need."""
        if result.test is None or result.status is Status.EQUAL:
            return ""
        return self.command("accept", *self._names(result), flags=[] if self.renders else None)

    def _names(self, result: Result) -> list[str]:
        return [literal(result.name)] if self.test.is_dir() and not self.renders else []
