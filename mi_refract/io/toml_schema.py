"""Tables of TOML files: which keys one may hold, what each accepts, and how that reads in errors and documentation."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Table = dict[str, Any]  # as tomllib reads it, or parsed: values by key
Parser = Callable[[Any], Any]  # the value as the code wants it; None where it is not accepted

REQUIRED = object()  # the default of a key that has none
SHOWN = 60  # characters of a value in an error


# Types of values --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Type:
    """A type of value: `accepted` says in words what it may be, `parse` returns None for anything else."""

    accepted: str
    parse: Parser


def number(value: Any) -> float | None:
    """A finite float. None for anything else: bool, NaN, ±inf, an integer beyond the range of float64."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None


def positive(value: Any) -> float | None:
    """A finite float above 0."""
    found: float | None = only_if(lambda x: x > 0, number)(value)
    return found


def text(value: Any) -> str | None:
    """A string that is more than white space."""
    return value if isinstance(value, str) and value.strip() else None


def table(value: Any) -> Table | None:
    """A table."""
    return value if isinstance(value, dict) else None


def list_of(parse: Parser, least: int = 1, most: float = math.inf) -> Parser:
    """Parser of a list of `least` to `most` items that `parse` accepts."""

    def parse_list(value: Any) -> list[Any] | None:
        items = [parse(item) for item in value] if isinstance(value, list) and least <= len(value) <= most else [None]
        return None if any(item is None for item in items) else items

    return parse_list


def first_of(*parsers: Parser) -> Parser:
    """Parser of whatever one of `parsers` accepts; the first of them counts."""
    return lambda value: next((parsed for parse in parsers if (parsed := parse(value)) is not None), None)


def only_if(test: Callable[[Any], bool], parse: Parser) -> Parser:
    """Parser of what `parse` accepts and of which `test` holds."""

    def parse_if(value: Any) -> Any:
        parsed = parse(value)
        return parsed if parsed is not None and test(parsed) else None

    return parse_if


def whole(least: int, most: int) -> Type:
    """The whole numbers from `least` to `most`."""
    return Type(
        f"a whole number, {least} to {most}",
        lambda value: value if type(value) is int and least <= value <= most else None,
    )


TEXT = Type("a text", text)
TEXTS = Type("a list of texts", list_of(text))
NUMBER = Type("a number", number)
NUMBERS = Type("a list of numbers", list_of(number))
POSITIVE = Type("a number above 0", positive)
TABLES = Type("a table or more, in double brackets", list_of(table))


# Keys -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Key:
    """A key of a table: its type, what it means, and its value where it is left out (None: no value)."""

    type: Type
    meaning: str
    default: Any = REQUIRED


def read(table: Table, keys: dict[str, Key], where: str = "") -> Table:
    """The values of `keys`, parsed. ValueError names `where` and the key that is unknown, missing or not accepted."""
    for name in table:
        if name not in keys:
            raise ValueError(f"{where}{_shown_key(name)}: unknown; expected {', '.join(keys)}")
    return {name: _value(table, name, key, where) for name, key in keys.items()}


def _value(table: Table, name: str, key: Key, where: str) -> Any:
    if name not in table and key.default is not REQUIRED:
        return key.default
    value = key.type.parse(table[name]) if name in table else None
    if value is None:
        found = shown(table[name]) if name in table else "missing"
        raise ValueError(f"{where}{name}: {found}; expected {key.type.accepted}")
    return value


def shown(value: Any) -> str:
    """A value as TOML writes it, cut to one line of SHOWN characters."""
    written = str(value).lower() if isinstance(value, bool) else repr(value)
    return written if len(written) <= SHOWN else f"{written[: SHOWN - 3]}..."


def _shown_key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else shown(name)


# Documentation ----------------------------------------------------------------------------------------------------


def key_table(title: str, keys: dict[str, Key]) -> str:
    """A Markdown table of `keys`: name, accepted values, meaning and default. `title` heads the first column."""
    rows = [f"| `{name}` | {key.type.accepted} | {key.meaning}{shown_default(key)} |" for name, key in keys.items()]
    return "\n".join([f"| {title} | value | meaning |", "|---|---|---|", *rows])


def shown_default(key: Key) -> str:
    """The default as the end of a table cell; empty where the key has none, or None."""
    if key.default is REQUIRED or key.default is None:
        return ""
    default = key.default if isinstance(key.default, list) else [key.default]
    written = ", ".join(x if isinstance(x, str) else f"{x:g}" for x in default)
    return f", default {written if len(default) == 1 else f'[{written}]'}"
