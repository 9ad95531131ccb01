"""Settings of the comparison of each image, from `mi-refract.toml` and the command line.

The layers are the `[defaults]` of `mi-refract.toml`, then the command line, then every `[[image]]` table whose name
matches, in their order. All have the same keys. A later layer replaces the keys that it sets and inherits the others.
If it changes the method, options that the new method does not have are dropped.
"""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import sys
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from mi_refract.io.image_file import MAX_VALUES
from mi_refract.io.safe_files import read_bytes
from mi_refract.io.typed_table import convert, doc, key_table, parse_toml

from . import name_patterns
from .channels import Names
from .methods import AUTO, METHODS, Option, options_of_auto
from .name_patterns import matches

FILE = "mi-refract.toml"
MOST = 2**22  # bytes of the file
DEFAULTS, COMMAND_LINE = "defaults", "command line"
ACCEPTED = (AUTO, *METHODS)
SYSTEMS = {"linux": "linux", "darwin": "macos", "win32": "windows"}  # by sys.platform
PROCESSORS = {"x86_64": "x86_64", "amd64": "x86_64", "arm64": "arm64", "aarch64": "arm64"}  # by platform.machine()
WORDS = tuple(dict.fromkeys((*SYSTEMS.values(), *PROCESSORS.values())))
BESIDE = ("stem", "name", "suffix")  # fields of a template of a file beside the reference
ANYWHERE = ("root", *name_patterns.FIELDS)  # fields of a template of a file in any folder

COMMON_OPTIONS = frozenset(("allow_nonfinite", "ignore_metadata"))  # options of every method

Text = Annotated[str, Meta(min_length=1)]
Length = Annotated[int, Meta(ge=1)]
Rectangle = tuple[int, int, Length, Length]  # x, y, width and height in pixels, with x and y as in messages
Rectangles = Annotated[tuple[Rectangle, ...], Meta(min_length=1)]


# Layers -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ComparisonSpec:
    """The settings of one image: the method, the options that are set, and the `reason` from a settings file.

    - `max_values`: largest width × height × channels of an image. `skip`: do not compare the image.
    - `accept`: templates of variants, which are further references.
    - `mask`, `ignore`: pixels that are not compared, as a template of an image and as rectangles.
    - `variance`: template of the image that contains the variance of one sample of each pixel.
    - `channels`: channels to compare, as pairs of names in the reference and the new image; empty: all.
    - `fields`: values of the fields of the map that pairs the image with its reference, for `accept`.
    - `entries`: the tables of the settings file that apply. `above`: see `Settings`.
    - `error`: why the settings cannot be applied.
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
    fields: Mapping[str, str] = field(default_factory=dict)
    entries: tuple[str, ...] = ()
    above: Path = Path()
    error: str = ""

    @property
    def reads_variance(self) -> bool:
        """Whether a variance is set and the method uses it."""
        return bool(self.variance) and self.method in (AUTO, "welch")


@dataclass(frozen=True)
class Entry:
    """One layer of settings.

    `pattern`: pattern of image names; "" for `[defaults]` and the command line, which apply to all images. `values`:
    values by key: `method`, `reason`, `skip`, `accept`, `mask`, `ignore`, `variance`, `channels`, options of methods
    and COMMON_OPTIONS. `where`: the name of the layer in messages. `error`: why the layer is invalid.
    """

    pattern: str
    values: Mapping[str, Any]
    where: str = "image[0]"
    error: str = ""


class Map(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A rule that pairs references with new images: templates of both paths, with the same fields."""

    reference: str
    test: str

    def __post_init__(self) -> None:
        """Raise ValueError unless both templates have the same fields, and no `*`."""
        for key in ("reference", "test"):
            _check_template(key, getattr(self, key), name_patterns.FIELDS)
        fields, test_fields = map(name_patterns.fields_of, (self.reference, self.test))
        if fields != test_fields or not fields or "*" in self.reference + self.test:
            raise ValueError("expected the same fields in `reference` and `test`, and no `*`")


@dataclass(frozen=True)
class Settings:
    """The layers in their order, and settings of the whole comparison.

    `maps`: rules that pair references with new images; empty: those of the same path. `max_values`: see
    `ComparisonSpec`. `flags`: the options of the command line that give the same settings. `above`: the path of the
    compared folder relative to that of the settings file; names of images in the file begin with it.
    """

    rules: tuple[Entry, ...] = ()
    maps: tuple[Map, ...] = ()
    max_values: int = MAX_VALUES
    flags: tuple[str, ...] = ()
    above: Path = Path()

    @classmethod
    def for_all(cls, **values: Any) -> Settings:
        """Return settings with these values for all images, such as `method="tolerance", fail=0.1`.

        The keys are those of `Keys` and the options of all methods. ValueError for an unknown key, and for an invalid
        value of a key; invalid options are errors of the images.
        """
        options = {key: values.pop(key) for key in [*values] if key in _options(None)}
        return cls((Entry("", _checked_values(values, Keys, "settings") | options, COMMAND_LINE),))

    def of(self, name: str) -> ComparisonSpec:
        """Return the settings of the image of this name, from all layers that match it; a later layer wins.

        `error` is set if a layer is invalid, if two tables with the same pattern contradict each other, if the method
        does not have an option, or if its value is out of range.
        """
        path = (self.above / name).as_posix()
        layers = [rule for rule in self.rules if not rule.pattern or matches(rule.pattern, path)]
        reasons = dict.fromkeys(layer.values["reason"] for layer in layers if "reason" in layer.values)
        entries = tuple(x.where for x in layers if x.where != COMMAND_LINE and (x.values or x.error))
        reason = "; ".join(reasons)
        spec = ComparisonSpec(reason=reason, max_values=self.max_values, entries=entries, above=self.above)
        merged: dict[str, Any] = {"method": AUTO}
        set_by: dict[str, str] = {}
        first_tables: dict[tuple[str, str], Entry] = {}  # the first table that sets a key, by pattern and key
        for layer in layers:
            if layer.error:
                return replace(spec, error=layer.error)
            for key, value in layer.values.items():
                other = first_tables.setdefault((layer.pattern, key), layer)
                if layer.pattern and key != "reason" and other.values[key] != value:
                    error = f"{layer.where}: {key}: {value!r}, but {other.values[key]!r} in {other.where} for the same"
                    return replace(spec, error=f"{error} name {layer.pattern!r}; expected one of them")
                set_by[key] = layer.where
            method = layer.values.get("method", merged["method"])
            if method != merged["method"]:
                merged = {k: v for k, v in merged.items() if k not in options_of(None) or k in options_of(method)}
            merged |= layer.values
        method = merged["method"]
        options = {key: merged.pop(key) for key in list(merged) if key in options_of(None)}
        for option in options.keys() - options_of(method):
            expected = ", ".join(sorted(options_of(method) - COMMON_OPTIONS)) or "none"
            error = f"{set_by[option]}: {option}: not an option of {method}; expected {expected}"
            return replace(spec, error=error)
        try:
            for option in sorted(options.keys() - COMMON_OPTIONS):
                _options(method)[option].checked(method, options[option])
        except ValueError as wrong:
            return replace(spec, error=f"{set_by[option]}: {wrong}")
        merged.pop("reason", None)
        return replace(spec, **merged, options=options)

    def unused(self, names: Sequence[str]) -> list[str]:
        """Return the patterns that match none of these names; none if the settings are those of a parent folder."""
        patterns = [rule.pattern for rule in self.rules if rule.pattern and self.above == Path()]
        return [pattern for pattern in patterns if not any(matches(pattern, name) for name in names)]


@functools.cache
def options_of(method: str | None) -> frozenset[str]:
    """Return the names of the options that a method takes, or for None those of all methods."""
    return frozenset(_options(method)) | COMMON_OPTIONS


def _options(method: str | None) -> dict[str, Option]:
    """Return the options of a method, or of those that "auto" chooses from, or for None of all methods."""
    if method == AUTO:
        return options_of_auto()
    methods = [METHODS[method]] if method else METHODS.values()
    return {name: option for method in methods for name, option in method.options.items()}


def this_platform() -> frozenset[str]:
    """Return the words of `when` that apply here: the system and the processor."""
    words = SYSTEMS.get(sys.platform), PROCESSORS.get(platform.machine().lower())
    return frozenset(word for word in words if word)


# The file -----------------------------------------------------------------------------------------------------------


class Keys(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The keys of `[defaults]`, of `[[image]]` and of `--set`."""

    method: Annotated[str, doc(f"the method: {', '.join(ACCEPTED)}")] = AUTO
    allow_nonfinite: Annotated[bool, doc("allow NaN or Inf where the other image has the same")] = False
    ignore_metadata: Annotated[
        tuple[Text, ...], doc("names of metadata that may differ, such as view; `*` and `?` allowed")
    ] = ()
    accept: Annotated[
        tuple[str, ...], Meta(min_length=1), doc("further references beside the first: templates, `*` and `?` allowed")
    ] = ()
    mask: Annotated[
        str | None,
        doc(
            "an image beside the reference: pixels are compared where a colour of it is at least 0.5, "
            "alpha not counted; {root}: the top folder"
        ),
    ] = None
    ignore: Annotated[Rectangles, doc("rectangles of pixels that are not compared: x, y, width, height")] = ()
    variance: Annotated[
        str | None,
        doc("an image with the variance of one sample of each pixel, beside the image of each side"),
    ] = None
    channels: Annotated[
        list[Text] | dict[Text, Text] | None,
        doc('the channels to compare: names, or { "in the reference" = "in the new image", … }'),
    ] = None

    def __post_init__(self) -> None:
        """Raise ValueError for an unknown method, an invalid template, and channels that are empty or not distinct."""
        if self.method not in ACCEPTED:
            raise ValueError(f"method: {self.method!r}; expected {', '.join(ACCEPTED)}")
        for template in self.accept:
            _check_template("accept", template, BESIDE)
        for key, path in (("mask", self.mask), ("variance", self.variance)):
            if path is not None:
                _check_template(key, path, ANYWHERE)
        if self.channels is not None:
            names = list(self.channels.values()) if isinstance(self.channels, dict) else self.channels
            if not names or len(set(names)) < len(names):
                raise ValueError(f"channels: {names}; expected distinct names")


class DefaultsKeys(Keys, forbid_unknown_fields=True, kw_only=True):
    """The keys of `[defaults]`."""

    map: Annotated[
        Map | list[Map] | None,
        doc("templates { reference = …, test = … } of paths; without it, both sides have the same path"),
    ] = None


class ImageKeys(Keys, forbid_unknown_fields=True, kw_only=True):
    """The keys of an `[[image]]` table."""

    name: Annotated[Text, doc("the image's path; `*` matches anything, `/` included, `?` one character")]
    reason: Annotated[Text, doc("why this image is not compared like the others")]
    when: Annotated[str | list[str] | None, doc(f"the platforms, all by default: one or two of {', '.join(WORDS)}")] = (
        None
    )
    skip: Annotated[bool, doc("do not compare it")] = False

    def __post_init__(self) -> None:
        """Raise ValueError also for a blank reason and for platforms that do not exist."""
        super().__post_init__()
        if not self.reason.strip():
            raise ValueError(f"reason: {self.reason!r}; expected text")
        for words in map(str.split, _listed(self.when)):
            kinds = [len(set(words) & set(kind.values())) for kind in (SYSTEMS, PROCESSORS)]
            if not words or not set(words) <= set(WORDS) or max(kinds) > 1:
                raise ValueError(f"when: {' '.join(words)!r}; expected one or two of {', '.join(WORDS)}")


class Document(msgspec.Struct, forbid_unknown_fields=True):
    """The file. Each `[[image]]` table is checked separately, because an invalid one affects only its images."""

    defaults: dict[str, Any] = {}
    image: list[dict[str, Any]] = []


class NameKey(msgspec.Struct):
    """The key that an `[[image]]` table must have even if others are invalid."""

    name: Text


def nearest(folder: Path) -> Path | None:
    """Return the settings file of a folder of references: in the folder, or in a git repository in the nearest parent.

    The search ends at the folder that contains `.git`; without one, only `folder` is searched. None if there is no
    file.
    """
    folders = [folder, *folder.resolve().parents]
    repository = next((i for i, parent in enumerate(folders) if os.path.lexists(parent / ".git")), 0)
    files = [parent / FILE for parent in folders[: repository + 1]]
    return next((file for file in files if os.path.lexists(file)), None)


def load(path: str | Path, command_line: Entry | None = None, max_values: int = MAX_VALUES) -> Settings:
    """Return the settings of a file for this platform, with the layer of the command line.

    An `[[image]]` table with a valid name but an error elsewhere becomes a layer with that error: only its images
    cannot be compared. ValueError, with the file and the key, for other errors; OSError if the file cannot be read.
    """
    path = Path(path)
    document = parse_toml(read_bytes(path, MOST), Document, str(path), infinite=True)
    defaults = _checked_values(document.defaults, DefaultsKeys, f"{path}: {DEFAULTS}")
    maps = tuple(_listed(defaults.pop("map", None)))
    rules = [Entry("", defaults, DEFAULTS), *([command_line] if command_line else [])]
    for number, table in enumerate(document.image):
        where = f"image[{number}]"
        name = convert({key: table[key] for key in table if key == "name"}, NameKey, f"{path}: {where}").name
        try:
            values = _checked_values(table, ImageKeys, f"{path}: {where}")
        except ValueError as error:
            rules.append(Entry(name, {}, where, error=str(error)))
            continue
        del values["name"]
        platforms = _listed(values.pop("when", None))
        if not platforms or any(set(words.split()) <= this_platform() for words in platforms):
            rules.append(Entry(name, values, where))
    return Settings(tuple(rules), maps, max_values)


def from_words(method: str, words: Sequence[str]) -> Entry:
    """Return the layer of the command line, from `--method` ("": not given) and each `--set KEY=VALUE`.

    ValueError if invalid.
    """
    if method and method not in ACCEPTED:
        raise ValueError(f"--method {method}; expected {', '.join(ACCEPTED)}")
    table: dict[str, Any] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or key in table:
            raise ValueError(f"--set {word}; expected KEY=VALUE, each key once")
        table[key] = _parsed_value(key, value)
    if method and "method" in table:
        raise ValueError(f"--set method={table['method']} with --method; expected one of them")
    values = _checked_values(table, Keys, "--set", method)
    return Entry("", {"method": method, **values} if method else values, COMMAND_LINE)


def _parsed_value(key: str, text: str) -> Any:
    """Parse a value of the command line: TOML in brackets, channels separated by commas, a number, a flag, or text."""
    if text[:1] in ("[", "{"):
        with contextlib.suppress(ValueError):  # a template also begins with a brace
            return tomllib.loads(f"value = {text}")["value"]
    if key == "channels":
        parts = [part.partition("=") for part in text.split(",")]
        pairs = [(old.strip(), (new if equals else old).strip()) for old, equals, new in parts]
        return dict(pairs) if len(dict(pairs)) == len(pairs) else [old for old, _ in pairs]
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(text)
    return {"true": True, "false": False}.get(text, text)


def _checked_values(table: dict[str, Any], kind: type[Keys], where: str, method: str | None = None) -> dict[str, Any]:
    """Return the checked values of the keys that are set. Options are those of the method, or without one of any."""
    method = table.get("method", method)
    checked = convert(table, _struct(kind, kind.__name__, method if method in ACCEPTED else None), where, infinite=True)
    values = {key: getattr(checked, key) for key in table}
    if "channels" in values:
        names = values["channels"]
        values["channels"] = tuple(names.items()) if isinstance(names, dict) else tuple(zip(names, names, strict=True))
    return values


def _struct(kind: type[msgspec.Struct], name: str, method: str | None) -> Any:
    """Return the struct `kind` with the options of a method added."""
    fields = [(x.name, Annotated[x.type, doc(x.help)], x.default) for x in _options(method).values()]
    return msgspec.defstruct(name, fields, bases=(kind,), forbid_unknown_fields=True, kw_only=True)


def _check_template(key: str, text: str, names: Collection[str]) -> None:
    if not name_patterns.is_template(text, names):
        fields = ", ".join(f"{{{name}}}" for name in names)
        raise ValueError(f"{key}: {text!r}; expected a relative path inside the folder that may hold {fields}")


def _listed(value: Any) -> list[Any]:
    """Return a list unchanged, an empty list for None, and a list of the value for anything else."""
    return value if isinstance(value, list) else [] if value is None else [value]


def key_tables() -> str:
    """Return tables of the keys of a settings file and of the options of each method, in Markdown."""
    parts = [key_table("`[defaults]` and `[[image]]`", Keys)]
    parts += [key_table("`[defaults]` only", DefaultsKeys, Keys), key_table("`[[image]]` only", ImageKeys, Keys)]
    for name, method in METHODS.items():
        parts.append(f"`{name}`: {method.summary}")
        parts += [key_table("option", _struct(msgspec.Struct, name, name))] if method.options else []
    return "\n\n".join(parts)
