"""Results of a comparison of files or folders: a result for each image, and the summary of all."""

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
    """The verdict on an image; ERROR if it could not be compared, SKIPPED by the settings. The most important first."""

    ERROR = "error"
    DIFFERENT = "different"
    INCONCLUSIVE = "inconclusive"
    EQUAL = "equal"
    SKIPPED = "skipped"


class Category(enum.StrEnum):
    """The change of an image between the two folders; UNKNOWN without a verdict."""

    ADDED = "added"
    REMOVED = "removed"
    CHANGED = "changed"
    UNCHANGED = "unchanged"
    UNKNOWN = "unknown"


FAILED = (Status.ERROR, Status.DIFFERENT, Status.INCONCLUSIVE)
CATEGORIES = {Status.EQUAL: Category.UNCHANGED, Status.DIFFERENT: Category.CHANGED}
INCONCLUSIVE = {"": 3, "pass": 0, "fail": 1}  # exit codes by the option --inconclusive


@dataclass(frozen=True)
class Result:
    """The result of one image. Before the comparison the status is DIFFERENT.

    - `name`: the path of the new image in its folder, or the path that it would have.
    - `reference`, `test`: its files, or with renders its folders; None if that side has none. `target`: the path of the
      reference, which may not exist yet.
    - `how`: the settings. `error`: why there is no verdict. `warnings`: about its mask.
    - `images`: the two compared images by role ("reference", "test"), for several renders their mean; empty if they
      were not kept. `unread`: why one of them is missing.
    - `digests`: SHA-256 of its files and variants when they were compared; None if not requested, or if a file is
      unreadable.
    - `variants`: further references that the settings accept; `matched`: the variant that the new image is equal to.
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
        """The change of the image between the two folders."""
        if self.status in (Status.ERROR, Status.SKIPPED):
            return Category.UNKNOWN
        if self.reference is None or self.test is None:
            return Category.ADDED if self.reference is None else Category.REMOVED
        return CATEGORIES.get(self.status, Category.UNKNOWN)

    @property
    def word(self) -> str:
        """The verdict in a word; "added" or "removed" for an image that only one side has."""
        return str(self.category if None in (self.reference, self.test) else self.status)

    @property
    def worst(self) -> tuple[float, Metric | None]:
        """The largest ratio of a metric beyond its bound to that bound, and the metric; (0, None) if all bounds hold.

        The ratio is ∞ for NaN, and if the bound is 0.
        """
        beyond = [metric for metric in self.comparison.metrics if not metric.holds] if self.comparison else []
        ratios = [m.value / m.bound if m.bound and not math.isnan(m.value) else math.inf for m in beyond]
        return (max(ratios), beyond[ratios.index(max(ratios))]) if beyond else (0.0, None)

    @property
    def order(self) -> tuple[float | str, ...]:
        """The sort key: by status, images of one side last, largest ratio of `worst`, largest value, name, target."""
        one_sided = None in (self.reference, self.test)
        ratio, metric = self.worst if self.status in FAILED else (0.0, None)
        value = 0.0
        if metric:
            value = math.inf if math.isnan(metric.value) else metric.value
        return [*Status].index(self.status), one_sided, -ratio, -value, self.name, str(self.target)

    @property
    def warning(self) -> str:
        """Remarks that do not change the verdict, but that a person should read; "" for none."""
        return "; ".join(filter(None, [*self.warnings, self.comparison.warning if self.comparison else ""]))

    @property
    def method(self) -> str:
        """The method that was applied, or that the settings choose."""
        return self.comparison.method if self.comparison else self.how.method

    @property
    def method_in_words(self) -> str:
        """The method, and why `auto` chose it."""
        return self.comparison.method_in_words if self.comparison else self.how.method

    @property
    def reason(self) -> str:
        """The reason for the status in one sentence."""
        if self.comparison:
            count = len(self.variants)
            differ = "its variant differs" if count == 1 else f"its {count} variants differ"
            of_variants = f"; {differ}, too" if count and self.status is not Status.EQUAL else ""
            return self.comparison.reason + (f"; matches {self.matched.name}" if self.matched else of_variants)
        if self.status is Status.SKIPPED:
            return "skipped by the settings" if self.how.entries else "skipped"
        reasons = {Category.ADDED: "only among the new images", Category.REMOVED: "only among the references"}
        return self.error or reasons[self.category]


@dataclass(frozen=True)
class Results:
    """The results of `diff`, failures first.

    `reference`, `test`: the paths; `renders`: each of them contains renders of one image. `inconclusive`: what
    inconclusive images count as ("pass", "fail", or "" for exit code 3). `unused`: patterns of the settings that
    matched no image. `flags`: the options of the command line that give the same settings.
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
        are_folders = self.test.is_dir()  # the reference may not exist yet
        return (self.reference, self.test) if are_folders else (self.reference.parent, self.test.parent)

    def of(self, *statuses: Status) -> list[Result]:
        """Return the results with one of these statuses."""
        return [result for result in self.results if result.status in statuses]

    @property
    def error(self) -> str:
        """Why nothing was compared; "" if anything was, or could not be."""
        all_skipped = len(self.of(Status.SKIPPED)) == len(self.results)
        return "all images are skipped; expected at least one to compare" if all_skipped else ""

    @property
    def exit_code(self) -> int:
        """2: an image could not be compared, or all were skipped; 1: different; 3: inconclusive; 0: all equal."""
        if self.of(Status.ERROR) or self.error:
            return 2
        if self.of(Status.DIFFERENT):
            return 1
        return INCONCLUSIVE[self.inconclusive] if self.of(Status.INCONCLUSIVE) else 0

    def command(self, verb: str, *names: str, flags: Sequence[str] | None = None) -> str:
        """Return the command line of `diff` or `accept` for the whole comparison, or for the images of these names."""
        # A path that begins with a dash would be read as an option.
        words = [f"./{path}" if str(path).startswith("-") else str(path) for path in (self.reference, self.test)]
        words += self.flags if flags is None else flags
        words += ["--renders"] * (self.renders and verb == "diff")
        return shlex.join(["mi-refract", verb, *words, *["--"] * any(x.startswith("-") for x in names), *names])

    def word(self, name: str) -> str:
        """Return the argument of a command that selects the image of this name only. Subclasses override it."""
        return literal(name)

    def reproduce(self, result: Result) -> str:
        """Return the command that compares this image again; "" if one side has none."""
        if result.reference is None or result.test is None:
            return ""
        return self.command("diff", *self._names(result))

    def accept(self, result: Result) -> str:
        """Return the command that makes the new image the reference; "" without a new image, or if it is equal."""
        if result.test is None or result.status is Status.EQUAL:
            return ""
        return self.command("accept", *self._names(result), flags=[] if self.renders else None)

    def _names(self, result: Result) -> list[str]:
        return [self.word(result.name)] if self.test.is_dir() and not self.renders else []
