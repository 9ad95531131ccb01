"""How each image is compared: what the command line says for all of them, and a settings file for some.

Three layers: the file's `[defaults]`, then the command line, then every `[[image]]` of the file whose name matches, in
their order. A later layer replaces the keys that it gives, and inherits the others. Where it changes the method, the
options of the method before it are dropped.
"""

from __future__ import annotations

import functools
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mi_refract.io.image_file import MAX_VALUES

from . import idiff_flags
from .channels import Names
from .masks import Rectangle
from .methods import AUTO, METHODS, options_of_auto
from .name_patterns import fields_of, matches

SYSTEMS = {"linux": "linux", "darwin": "macos", "win32": "windows"}  # by sys.platform
PROCESSORS = {"x86_64": "x86_64", "amd64": "x86_64", "arm64": "arm64", "aarch64": "arm64"}  # by platform.machine()
TOLERANCE = "tolerance"  # the method that the flags of idiff are for
FILE_ONLY = ("accept", "mask", "ignore")  # keys of `ComparisonSpec` that no option of the command line says
OF_BOTH = ("variance", "channels")  # those that one of the file's tables and an option of its own say


@dataclass(frozen=True)
class ComparisonSpec:
    """A method, those of its options that are given, and the `reason` from a settings file.

    `max_values`: width × height × channels of an image, at most. `skip`: not compared at all. `accept`: templates of
    other references, each as good as the first. `mask`, `ignore`: pixels that do not count, as a template of an image
    and as rectangles. `idiff`: the flags of `idiff` that the options come from. `variance`: a template of the image
    that holds the variance of one sample of each pixel. `channels`: those that are compared, by their names in the
    reference and in the new image; none: all. `entries`: the tables of the settings file that say so. `error`: why they
    cannot be followed.
    """

    method: str = AUTO
    options: Mapping[str, Any] = field(default_factory=dict)
    reason: str = ""
    max_values: int = MAX_VALUES
    skip: bool = False
    accept: tuple[str, ...] = ()
    mask: str = ""
    ignore: tuple[Rectangle, ...] = ()
    idiff: str | None = None
    variance: str = ""
    channels: Names = ()
    entries: tuple[str, ...] = ()
    error: str = ""

    @property
    def flags(self) -> list[str]:
        """The command line's options that say the same, but for what FILE_ONLY names."""
        words = [] if self.method == AUTO else ["--method", self.method]
        given: Mapping[str, Any] = {}
        if self.idiff is not None:
            words, given = ["--idiff", self.idiff], idiff_flags.parse(self.idiff).options
        for name, value in self.options.items():
            if name in given and given[name] == value:
                continue
            if name != "allow_nonfinite":
                words += ["--set", f"{name}={value}"]
            elif value:
                words += ["--allow-nonfinite", "*"]
        words += ["--variance", self.variance] if self.variance else []
        words += ["--channels", written(self.channels)] if self.channels else []
        return words + ([] if self.max_values == MAX_VALUES else ["--max-values", str(self.max_values)])

    @property
    def reads_variance(self) -> bool:
        """Whether the method is one that knows what to do with the variance."""
        return bool(self.variance) and self.method in (AUTO, "welch")

    @property
    def needs_file(self) -> bool:
        """Whether the command line alone cannot say the same of two files."""
        in_folder = bool({"root", "dir"} & fields_of(self.variance))
        return in_folder or any(getattr(self, name) for name in FILE_ONLY)


@dataclass(frozen=True)
class Entry:
    """An `[[image]]` table, or `[defaults]`: a pattern of names, and the keys that it gives.

    `values`: of `method`, `reason`, `skip`, `accept`, `mask`, `ignore`, `variance`, `channels`, `allow_nonfinite` and
    the options of methods. `when`: platforms, one of which must be this one; none: all. `error`: what is wrong with it.
    """

    pattern: str
    values: Mapping[str, Any]
    where: str = "image[0]"
    when: tuple[str, ...] = ()
    error: str = ""

    @property
    def here(self) -> bool:
        """Whether it is for this platform."""
        return not self.when or any(set(each.split()) <= this_platform() for each in self.when)


@dataclass(frozen=True)
class Map:
    """Which reference belongs to which new image: templates of both paths, with the same fields."""

    reference: str
    test: str


@dataclass(frozen=True)
class Settings:
    """`default` for all images, `rules` by pattern of names, and the patterns whose values need not be finite.

    `defaults`: what the settings file says of all images; `default`, the command line's, goes before it.
    """

    default: ComparisonSpec = ComparisonSpec()
    rules: tuple[Entry, ...] = ()
    allow_nonfinite: tuple[str, ...] = ()
    defaults: Entry = Entry("*", {}, "defaults")
    maps: tuple[Map, ...] = ()
    path: str = ""

    def of(self, name: str) -> ComparisonSpec:
        """How the image of this name is compared. Entries that cannot be followed are the `error` of what is found."""
        entries = [each for each in self.rules if each.here and matches(each.pattern, name)]
        reasons = [str(each.values["reason"]) for each in entries if "reason" in each.values]
        how = replace(
            self.default,
            options={},
            entries=tuple(each.where for each in (self.defaults, *entries) if each.values or each.error),
            reason="; ".join(dict.fromkeys(reasons)),
        )
        if error := next((each.error for each in entries if each.error), "") or _conflict(entries):
            return replace(how, error=error)
        try:
            method, options = _method(
                [("[defaults]", self.defaults.values), *self._command_line(name), *_layers(entries)]
            )
        except ValueError as error:
            return replace(how, error=str(error))
        given = {key: value for key in OF_BOTH if (value := getattr(self.default, key))}
        of_entries = {key: value for each in entries for key, value in each.values.items()}
        others = {**self.defaults.values, **given, **of_entries}
        kept = {key: others[key] for key in ("skip", *FILE_ONLY, *OF_BOTH) if key in others}
        flags = of_entries.get("idiff", self.default.idiff)
        flags = (self.defaults.values.get("idiff") if flags is None else flags) if method == TOLERANCE else None
        return replace(how, method=method, options=options, idiff=flags, **kept)

    def _command_line(self, name: str) -> list[tuple[str, Mapping[str, Any]]]:
        given = dict(self.default.options) | ({} if self.default.method == AUTO else {"method": self.default.method})
        if any(matches(pattern, name) for pattern in self.allow_nonfinite):
            given["allow_nonfinite"] = True
        return [("the command line", given)]

    @property
    def of_file(self) -> bool:
        """Whether a settings file says anything."""
        return bool(self.rules or self.maps or self.defaults.values)

    @property
    def flags(self) -> list[str]:
        """The command line's options that say the same; `path`: the settings file, where it was named there."""
        nonfinite = [word for name in self.allow_nonfinite for word in ("--allow-nonfinite", name)]
        return [*self.default.flags, *nonfinite, *(["--settings", self.path] if self.path else [])]

    def unused(self, names: Sequence[str]) -> list[str]:
        """The patterns for this platform that match none of these names."""
        patterns = [*(each.pattern for each in self.rules if each.here), *self.allow_nonfinite]
        return [pattern for pattern in patterns if not any(matches(pattern, name) for name in names)]


def written(channels: Names) -> str:
    """The channels as `--channels` takes them."""
    return ",".join(one if one == two else f"{one}={two}" for one, two in channels)


def this_platform() -> frozenset[str]:
    """The words that `when` may hold and that are true here: the system and the processor."""
    words = SYSTEMS.get(sys.platform), PROCESSORS.get(platform.machine().lower())
    return frozenset(word for word in words if word)


def _layers(entries: Sequence[Entry]) -> list[tuple[str, Mapping[str, Any]]]:
    return [(each.where, each.values) for each in entries]


def _method(layers: Sequence[tuple[str, Mapping[str, Any]]]) -> tuple[str, dict[str, Any]]:
    """The method and its options. ValueError for an option that the method does not have."""
    method, options, given_by = AUTO, dict[str, Any](), dict[str, str]()
    for where, values in layers:
        if values.get("method", method) != method:
            method = values["method"]
            options = {name: value for name, value in options.items() if name in options_of(method)}
        for name in values:
            if name == "allow_nonfinite" or name in all_options():
                options[name], given_by[name] = values[name], where
    for name in options:
        if name not in options_of(method):
            accepted = ", ".join(sorted(options_of(method) - {"allow_nonfinite"})) or "none"
            raise ValueError(f"{given_by[name]}.{name}: not an option of {method}; expected {accepted}")
    return method, options


@functools.cache
def all_options() -> frozenset[str]:
    """The names of the options of all methods."""
    return frozenset(name for method in METHODS.values() for name in method.options)


def options_of(method: str) -> frozenset[str]:
    """The names of the options that a method takes, `allow_nonfinite` among them."""
    names = options_of_auto() if method == AUTO else METHODS[method].options
    return frozenset(names) | {"allow_nonfinite"}


def _conflict(entries: Sequence[Entry]) -> str:
    """Two entries of the same pattern that give the same key other values; "" where there are none."""
    for i, one in enumerate(entries):
        for other in entries[i + 1 :]:
            both = [key for key in one.values if key in other.values and key != "reason"]
            for key in both if one.pattern == other.pattern else []:
                if one.values[key] != other.values[key]:
                    return (
                        f"{other.where}.{key}: {other.values[key]!r}, but {one.values[key]!r} in {one.where} for the "
                        f"same name {one.pattern!r}; expected one of them"
                    )
    return ""
