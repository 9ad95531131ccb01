"""How each image is compared: what the command line says for all of them, and `mi-refract.toml` for some.

The file holds `[[image]]` tables. Of the tables that match an image's name the last one counts, and it goes before the
command line:

    [[image]]
    name = "glass/caustic*.exr"
    method = "tolerance"
    fail = 0.02
    reason = "single-precision caustic: last bits differ between processors"
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from mi_refract.io.image_file import MAX_VALUES
from mi_refract.io.toml_schema import TABLES, TEXT, Key, Type, key_table, read

from . import idiff_flags
from .methods import AUTO, METHODS

FILE = "mi-refract.toml"
TOLERANCE = "tolerance"
ACCEPTED = (AUTO, *METHODS)
BOOL = Type("true or false", lambda value: value if isinstance(value, bool) else None)
METHOD = Type(", ".join(ACCEPTED), lambda value: value if isinstance(value, str) and value in ACCEPTED else None)
COMMON = {
    "name": Key(TEXT, "the image's path inside its folder; `*` stands for anything, `/` included"),
    "reason": Key(TEXT, "why this image is not compared like the others"),
    "method": Key(METHOD, "the method; that of the command line by default", None),
    "allow_nonfinite": Key(BOOL, "whether NaN or Inf is allowed where the other image has the same", None),
}


WORDS = Type("a text", lambda value: value if isinstance(value, str) else None)
IDIFF = {"idiff": Key(WORDS, "flags of OpenImageIO's `idiff`, as they stand; the method is `tolerance`", None)}


def _finite_or_inf(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if value == value else None
    except OverflowError:
        return None


TYPES: dict[type, Type] = {
    float: Type("a number or inf", _finite_or_inf),
    int: Type("a whole number", lambda value: value if type(value) is int else None),
    str: TEXT,
}


@dataclass(frozen=True)
class How:
    """A method, those of its options that are given, and the `reason` from a settings file.

    `max_values`: width × height × channels of an image, at most. `idiff`: the flags of `idiff` that the options come
    from; `error`: why the entry of the settings file cannot be used.
    """

    method: str = AUTO
    options: Mapping[str, Any] = field(default_factory=dict)
    reason: str = ""
    max_values: int = MAX_VALUES
    idiff: str | None = None
    error: str = ""

    @property
    def flags(self) -> list[str]:
        """The command line's options that say the same."""
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
        return words + ([] if self.max_values == MAX_VALUES else ["--max-values", str(self.max_values)])


@dataclass(frozen=True)
class Settings:
    """`default` for all images, `rules` by pattern of names, and the patterns whose values need not be finite."""

    default: How = How()
    rules: tuple[tuple[str, How], ...] = ()
    allow_nonfinite: tuple[str, ...] = ()

    def of(self, name: str) -> How:
        """How the image of this name is compared."""
        how = next((how for pattern, how in reversed(self.rules) if fnmatchcase(name, pattern)), self.default)
        if how.method in (AUTO, self.default.method):
            how = replace(how, method=self.default.method, options={**self.default.options, **how.options})
            how = replace(how, idiff=self.default.idiff if how.idiff is None else how.idiff)
        if any(fnmatchcase(name, pattern) for pattern in self.allow_nonfinite):
            how = replace(how, options={"allow_nonfinite": True, **how.options})
        return replace(how, max_values=self.default.max_values)

    def unused(self, names: Sequence[str]) -> list[str]:
        """The patterns that match none of these names."""
        patterns = [*(pattern for pattern, _ in self.rules), *self.allow_nonfinite]
        return [pattern for pattern in patterns if not any(fnmatchcase(name, pattern) for name in names)]


def load(path: str | Path) -> tuple[tuple[str, How], ...]:
    """The rules of a settings file: pattern of names, and how such images are compared.

    ValueError names the file and the key, whose images count from 0; OSError as the system raises it.
    """
    path = Path(path)
    try:
        table = tomllib.loads(path.read_bytes().decode())
        images = read(table, {"image": Key(TABLES, "", [])})["image"]
        return tuple(_rule(image, f"image[{i}].", path) for i, image in enumerate(images))
    except (ValueError, RecursionError) as error:
        text = str(error) if isinstance(error, ValueError) else "brackets nested too deeply; accepted: TOML"
        raise ValueError(" ".join(f"{path}: {text}".split())) from None


def _rule(table: dict[str, Any], where: str, path: Path) -> tuple[str, How]:
    if "idiff" in table and table.get("method", AUTO) == AUTO:
        table = {**table, "method": TOLERANCE}
    method = read({k: v for k, v in table.items() if k == "method"}, {"method": COMMON["method"]}, where)["method"]
    keys = COMMON | (IDIFF if method == TOLERANCE else {}) | keys_of(method or AUTO)
    values = read(table, keys, where)
    options = {name: values[name] for name in table if name not in ("name", "reason", "method", "idiff")}
    how = How(method or AUTO, options, values["reason"])
    if "idiff" not in table:
        return values["name"], how
    try:
        return values["name"], with_idiff(how, values["idiff"])
    except ValueError as error:  # of this entry's images; the others are compared
        return values["name"], replace(how, error=f"{path}: {where}idiff: {error}")


def with_idiff(how: How, flags: str) -> How:
    """The same with the thresholds of `idiff`'s flags where `how` gives none of its own. ValueError for bad flags."""
    options = {**idiff_flags.parse(flags).options, **how.options}
    return replace(how, method=TOLERANCE, options=options, idiff=flags)


def keys_of(method: str) -> dict[str, Key]:
    """The options of a method as keys; none for "auto", which chooses by the images."""
    options = METHODS[method].options if method != AUTO else {}
    return {name: Key(TYPES[option.type], option.help, option.default) for name, option in options.items()}


def from_words(method: str, words: Sequence[str], idiff: str | None = None) -> How:
    """The method and its options from the command line's `NAME=VALUE` and `--idiff`. ValueError for anything else."""
    if method not in ACCEPTED:
        raise ValueError(f"--method {method}: accepted: {METHOD.accepted}")
    if idiff is not None:
        return _from_idiff(method, words, idiff)
    if words and method == AUTO:
        raise ValueError(f"--set {words[0]}: the options of which method? accepted: after --method {'|'.join(METHODS)}")
    keys = keys_of(method)
    table: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or name in table:
            raise ValueError(f"--set {word}: accepted: NAME=VALUE, each name once")
        table[name] = _value(text, keys[name].type) if name in keys else text
    values = read(table, keys, "--set ")
    return How(method, {name: values[name] for name in table})


def _from_idiff(method: str, words: Sequence[str], flags: str) -> How:
    if method not in (AUTO, TOLERANCE):
        raise ValueError(f"--idiff with --method {method}; accepted with --method {TOLERANCE}, or alone")
    how = from_words(TOLERANCE, words)
    try:
        return with_idiff(how, flags)
    except ValueError as error:
        raise ValueError(f"--idiff: {error}") from None


def _value(text: str, kind: Type) -> Any:
    """A number where the option is one; the text itself where that fails, for `read` to refuse."""
    for numeric in (int, float) if kind is not TEXT else ():
        try:
            return numeric(text)
        except ValueError:
            continue
    return text


def reference() -> str:
    """What a settings file may hold, and the options of each method, in Markdown."""
    parts = [key_table("`[[image]]`", COMMON | IDIFF)]
    for name, method in METHODS.items():
        parts.append(f"`{name}`: {method.summary}")
        parts += [key_table("option", keys_of(name))] if keys_of(name) else []
    return "\n\n".join(parts)
