"""How each image is compared: layers of settings, merged once.

The layers are the file's `[defaults]`, then the command line, then every `[[image]]` table whose name matches, in their
order. Each is one mapping of the same keys. A later layer replaces the keys that it sets and inherits the others; where
it changes the method, the options that the new method does not have are dropped.
"""

from __future__ import annotations

import functools
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mi_refract.io.image_file import MAX_VALUES

from .channels import Names
from .masks import Rectangle
from .methods import AUTO, METHODS, options_of_auto
from .name_patterns import matches

FILE = "mi-refract.toml"
DEFAULTS, COMMAND_LINE = "defaults", "command line"
SYSTEMS = {"linux": "linux", "darwin": "macos", "win32": "windows"}  # by sys.platform
PROCESSORS = {"x86_64": "x86_64", "amd64": "x86_64", "arm64": "arm64", "aarch64": "arm64"}  # by platform.machine()


@dataclass(frozen=True)
class ComparisonSpec:
    """How one image is compared: the method, the options that are set, and the `reason` from a settings file.

    `max_values`: width × height × channels of an image, at most. `skip`: not compared at all. `accept`: templates of
    other references, each as good as the first. `mask`, `ignore`: pixels that do not count, as a template of an image
    and as rectangles. `variance`: a template of the image that holds the variance of one sample of each pixel.
    `channels`: those that are compared, by their names in the reference and in the new image; none: all.
    `entries`: the tables of the settings file that apply. `error`: why the settings cannot be applied.
    """

    method: str = AUTO
    options: Mapping[str, Any] = field(default_factory=dict)
    reason: str = ""
    max_values: int = MAX_VALUES
    skip: bool = False
    accept: tuple[str, ...] = ()
    mask: str = ""
    ignore: tuple[Rectangle, ...] = ()
    variance: str = ""
    channels: Names = ()
    entries: tuple[str, ...] = ()
    error: str = ""

    @property
    def reads_variance(self) -> bool:
        """Whether the method is one that uses the variance."""
        return bool(self.variance) and self.method in (AUTO, "welch")


@dataclass(frozen=True)
class Entry:
    """One layer of settings.

    `pattern`: of the names of its images; "" for `[defaults]` and the command line, which are for all. `values`: of
    `method`, `reason`, `skip`, `accept`, `mask`, `ignore`, `variance`, `channels`, `allow_nonfinite` and the options
    of methods. `where`: its name in messages. `when`: platforms, one of which must be this one; none: all.
    `error`: what is wrong with it.
    """

    pattern: str
    values: Mapping[str, Any]
    where: str = "image[0]"
    when: tuple[str, ...] = ()
    error: str = ""

    @property
    def here(self) -> bool:
        """Whether it is for this platform."""
        return not self.when or any(set(words.split()) <= this_platform() for words in self.when)


@dataclass(frozen=True)
class Map:
    """Which reference belongs to which new image: templates of both paths, with the same fields."""

    reference: str
    test: str


@dataclass(frozen=True)
class Settings:
    """The layers in their order, and what holds for the whole comparison.

    `maps`: which reference belongs to which new image; none: the one of the same path. `max_values`: of each image.
    `flags`: the words of the command line that set the same.
    """

    rules: tuple[Entry, ...] = ()
    maps: tuple[Map, ...] = ()
    max_values: int = MAX_VALUES
    flags: tuple[str, ...] = ()

    @classmethod
    def for_all(cls, **values: Any) -> Settings:
        """These values, such as `method="tolerance", fail=0.1`, for all images."""
        return cls((Entry("", values, COMMAND_LINE),))

    def of(self, name: str) -> ComparisonSpec:
        """How the image of this name is compared; what is wrong with the settings is the `error`."""
        layers = [rule for rule in self.rules if rule.here and (not rule.pattern or matches(rule.pattern, name))]
        reasons = dict.fromkeys(layer.values["reason"] for layer in layers if "reason" in layer.values)
        entries = tuple(x.where for x in layers if x.where != COMMAND_LINE and (x.values or x.error))
        spec = ComparisonSpec(reason="; ".join(reasons), max_values=self.max_values, entries=entries)
        try:
            return replace(spec, **_merged(layers))
        except ValueError as error:
            return replace(spec, error=str(error))

    def unused(self, names: Sequence[str]) -> list[str]:
        """The patterns for this platform that match none of these names."""
        patterns = [rule.pattern for rule in self.rules if rule.here and rule.pattern]
        return [pattern for pattern in patterns if not any(matches(pattern, name) for name in names)]


def _merged(layers: Sequence[Entry]) -> dict[str, Any]:
    """The fields of `ComparisonSpec` that the layers set.

    ValueError for a layer with an error, for two tables of the same pattern that contradict each other, and for an
    option that the method does not have.
    """
    merged: dict[str, Any] = {"method": AUTO}
    set_by: dict[str, str] = {}
    tables: dict[tuple[str, str], Entry] = {}
    for layer in layers:
        if layer.error:
            raise ValueError(layer.error)
        for key, value in layer.values.items():
            other = tables.setdefault((layer.pattern, key), layer)
            if layer.pattern and key != "reason" and other.values[key] != value:
                raise ValueError(
                    f"{layer.where}: {key}: {value!r}, but {other.values[key]!r} in {other.where} for the same name "
                    f"{layer.pattern!r}; expected one of them"
                )
            set_by[key] = layer.where
        method = layer.values.get("method", merged["method"])
        if method != merged["method"]:
            merged = {k: v for k, v in merged.items() if k not in options_of(None) or k in options_of(method)}
        merged |= layer.values
    method = merged["method"]
    options = {key: merged.pop(key) for key in list(merged) if key in options_of(None)}
    for name in options.keys() - options_of(method):
        expected = ", ".join(sorted(options_of(method) - {"allow_nonfinite"})) or "none"
        raise ValueError(f"{set_by[name]}: {name}: not an option of {method}; expected {expected}")
    merged.pop("reason", None)
    return merged | {"options": options}


@functools.cache
def options_of(method: str | None) -> frozenset[str]:
    """The names of the options that a method takes, or of all methods, with what is set in the same way."""
    if method is None:
        return frozenset().union(*map(options_of, METHODS))
    names = options_of_auto() if method == AUTO else METHODS[method].options
    return frozenset(names) | {"allow_nonfinite"}


def written(channels: Names) -> str:
    """The channels as `--set channels=` takes them."""
    return ",".join(one if one == two else f"{one}={two}" for one, two in channels)


def this_platform() -> frozenset[str]:
    """The words that `when` may hold and that are true here: the system and the processor."""
    words = SYSTEMS.get(sys.platform), PROCESSORS.get(platform.machine().lower())
    return frozenset(word for word in words if word)
