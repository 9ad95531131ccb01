"""The settings file `mi-refract.toml`, and the command line's `--set KEY=VALUE`, as layers of the same keys.

[defaults]
method = "tolerance"
accept = ["{stem}-*.exr"]

[[image]]
name = "glass/caustic*.exr"
fail = 0.02
reason = "single-precision caustic: last bits differ between processors"
"""

from __future__ import annotations

import contextlib
import tomllib
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from mi_refract.io.image_file import MAX_VALUES
from mi_refract.io.typed_table import convert, key_table, parse_toml

from . import name_patterns
from .methods import AUTO, METHODS, options_of_auto
from .settings import COMMAND_LINE, DEFAULTS, PROCESSORS, SYSTEMS, Entry, Map, Settings

ACCEPTED = (AUTO, *METHODS)
WORDS = tuple(dict.fromkeys((*SYSTEMS.values(), *PROCESSORS.values())))
BESIDE = ("stem", "name", "suffix")  # fields of a template of a file beside the reference
ANYWHERE = ("root", *name_patterns.FIELDS)

Text = Annotated[str, Meta(min_length=1)]
Length = Annotated[int, Meta(ge=1)]


class MapKeys(msgspec.Struct, forbid_unknown_fields=True):
    """`map` of `[defaults]`."""

    reference: str
    test: str

    def __post_init__(self) -> None:
        """ValueError unless both have the same fields, and no `*`."""
        for key in ("reference", "test"):
            _check_template(key, getattr(self, key), name_patterns.FIELDS)
        one, two = map(name_patterns.fields_of, (self.reference, self.test))
        if one != two or not one or "*" in self.reference + self.test:
            raise ValueError("expected the same fields in `reference` and `test`, and no `*`")


class Keys(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The keys of `[defaults]`, of `[[image]]` and of `--set`."""

    method: Annotated[str, Meta(description=f"the method: {', '.join(ACCEPTED)}")] = AUTO
    allow_nonfinite: Annotated[bool, Meta(description="allow NaN or Inf where the other image has the same")] = False
    accept: Annotated[
        list[str] | None, Meta(description="further references beside the first: templates, `*` and `?` allowed")
    ] = None
    mask: Annotated[
        str | None,
        Meta(description="an image beside the reference: white pixels count, black do not; {root}: the top folder"),
    ] = None
    ignore: Annotated[
        list[tuple[int, int, Length, Length]] | None,
        Meta(description="rectangles of pixels that do not count: x, y, width, height"),
    ] = None
    variance: Annotated[
        str | None,
        Meta(description="an image with the variance of one sample of each pixel, beside the image of each side"),
    ] = None
    channels: Annotated[
        list[Text] | dict[Text, Text] | None,
        Meta(description="the channels to compare: names, or { <of the reference> = <of the new image>, … }"),
    ] = None

    def __post_init__(self) -> None:
        """ValueError for a method, a template or channels that do not exist."""
        if self.method not in ACCEPTED:
            raise ValueError(f"method: {self.method!r}; expected {', '.join(ACCEPTED)}")
        for template in self.accept or ():
            _check_template("accept", template, BESIDE)
        for key, path in (("mask", self.mask), ("variance", self.variance)):
            if path is not None:
                _check_template(key, path, ANYWHERE)
        if self.accept == [] or self.ignore == []:
            raise ValueError(f"{'accept' if self.accept == [] else 'ignore'}: []; expected at least one")
        if self.channels is not None:
            names = list(self.channels.values()) if isinstance(self.channels, dict) else self.channels
            if not names or len(set(names)) < len(names):
                raise ValueError(f"channels: {names}; expected distinct names")


class DefaultsKeys(Keys, forbid_unknown_fields=True, kw_only=True):
    """The keys of `[defaults]`."""

    map: Annotated[
        MapKeys | list[MapKeys] | None,
        Meta(description="templates { reference = …, test = … } of paths; without it, both sides have the same path"),
    ] = None


class ImageKeys(Keys, forbid_unknown_fields=True, kw_only=True):
    """The keys of an `[[image]]` table."""

    name: Annotated[Text, Meta(description="the image's path; `*` matches anything, `/` included, `?` one character")]
    reason: Annotated[Text, Meta(description="why this image is not compared like the others")]
    when: Annotated[
        str | list[str] | None, Meta(description=f"the platforms, all by default: one or two of {', '.join(WORDS)}")
    ] = None
    skip: Annotated[bool, Meta(description="do not compare it")] = False

    def __post_init__(self) -> None:
        """ValueError for a blank reason and a platform that cannot exist, too."""
        super().__post_init__()
        if not self.reason.strip():
            raise ValueError(f"reason: {self.reason!r}; expected text")
        for platform in _listed(self.when):
            words = set(platform.split())
            kinds = [len(words & set(kind.values())) for kind in (SYSTEMS, PROCESSORS)]
            if not words or not words <= set(WORDS) or max(kinds) > 1:
                raise ValueError(f"when: {platform!r}; expected one or two of {', '.join(WORDS)}")


class Document(msgspec.Struct, forbid_unknown_fields=True):
    """The file. An `[[image]]` table is checked on its own: what is wrong with it concerns its images alone."""

    defaults: dict[str, Any] = {}
    image: list[dict[str, Any]] = []


class NameKey(msgspec.Struct):
    """What an `[[image]]` table must have, whatever is wrong with the rest."""

    name: Text


def _check_template(key: str, text: str, names: Collection[str]) -> None:
    if not name_patterns.is_template(text, names):
        fields = ", ".join(f"{{{name}}}" for name in names)
        raise ValueError(f"{key}: {text!r}; expected a relative path inside the folder that may hold {fields}")


def load(path: str | Path, command_line: Entry | None = None, max_values: int = MAX_VALUES) -> Settings:
    """The settings of a file, with the layer of the command line.

    A table with a name that is wrong in anything else is kept with its error: its images cannot be compared, the others
    can. ValueError names the file and the key for whatever else is wrong; OSError as the system raises it.
    """
    path = Path(path)
    document = parse_toml(path.read_bytes(), Document, str(path), infinite=True)
    defaults = _values(document.defaults, DefaultsKeys, f"{path}: {DEFAULTS}")
    maps = tuple(Map(each.reference, each.test) for each in _listed(defaults.pop("map", None)))
    rules = [Entry("", defaults, DEFAULTS), *([command_line] if command_line else [])]
    for number, table in enumerate(document.image):
        where = f"image[{number}]"
        name = convert({"name": table["name"]} if "name" in table else {}, NameKey, f"{path}: {where}").name
        try:
            values = _values(table, ImageKeys, f"{path}: {where}")
        except ValueError as error:
            rules.append(Entry(name, {}, where, error=str(error)))
            continue
        when = tuple(_listed(values.pop("when", None)))
        del values["name"]
        rules.append(Entry(name, values, where, when))
    return Settings(tuple(rules), maps, max_values)


def from_words(method: str, words: Sequence[str]) -> Entry:
    """The layer of the command line: `--method`, `--set KEY=VALUE`. ValueError for anything else."""
    if method not in ACCEPTED:
        raise ValueError(f"--method {method}; expected {', '.join(ACCEPTED)}")
    table: dict[str, Any] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or key in table:
            raise ValueError(f"--set {word}; expected KEY=VALUE, each key once")
        table[key] = _value(key, value)
    if method != AUTO and "method" in table:
        raise ValueError(f"--set method={table['method']} with --method; expected one of them")
    values = _values(table, Keys, "--set", method)
    return Entry("", values if method == AUTO else {"method": method, **values}, COMMAND_LINE)


def _value(key: str, text: str) -> Any:
    """A value as the command line writes it: TOML in brackets, channels between commas, a number, a flag, or text."""
    if text[:1] in ("[", "{"):
        with contextlib.suppress(ValueError):  # it may be a template
            return tomllib.loads(f"value = {text}")["value"]
    if key == "channels":
        parts = [part.partition("=") for part in text.split(",")]
        pairs = [(one.strip(), (two if equals else one).strip()) for one, equals, two in parts]
        return dict(pairs) if len(dict(pairs)) == len(pairs) else [one for one, _ in pairs]
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(text)
    return {"true": True, "false": False}.get(text, text)


def _values(table: dict[str, Any], kind: type[Keys], where: str, method: str | None = None) -> dict[str, Any]:
    """The checked values of the keys that are set. Options are those of the method, or of any where none is set."""
    method = table.get("method", method)
    fields = _options(method if method in ACCEPTED else None)
    struct: Any = msgspec.defstruct(kind.__name__, fields, bases=(kind,), forbid_unknown_fields=True, kw_only=True)
    checked = convert(table, struct, where, infinite=True)
    values = {key: getattr(checked, key) for key in table}
    for key in {"accept", "ignore"} & values.keys():
        values[key] = tuple(values[key])
    if "channels" in values:
        named = values["channels"]
        values["channels"] = tuple(named.items()) if isinstance(named, dict) else tuple(zip(named, named, strict=True))
    return values


def _options(method: str | None) -> list[tuple[str, Any, Any]]:
    """Name, type and default of the options of a method, of those that "auto" chooses from, or for None of all."""
    options = options_of_auto() if method == AUTO else METHODS[method].options if method else {}
    if method is None:
        options = {name: option for each in METHODS.values() for name, option in each.options.items()}
    return [
        (name, Annotated[option.type, Meta(description=option.help)], option.default)
        for name, option in options.items()
    ]


def _listed(value: Any) -> list[Any]:
    """A list as it is, None as an empty one, anything else as a list of it."""
    return value if isinstance(value, list) else [] if value is None else [value]


def reference() -> str:
    """The keys of a settings file, and the options of each method, in Markdown."""
    parts = [key_table("`[defaults]`", DefaultsKeys), key_table("`[[image]]`", ImageKeys)]
    for name, method in METHODS.items():
        parts.append(f"`{name}`: {method.summary}")
        parts += [key_table("option", msgspec.defstruct(name, fields))] if (fields := _options(name)) else []
    return "\n\n".join(parts)
