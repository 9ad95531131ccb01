"""Typed values of TOML tables: what is accepted, in words, for reading, for error messages and for documentation."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_refract.planar.curves import unit
from mi_refract.planar.tracer import Array

Values = dict[str, Any]
REQUIRED = object()


# Types of values --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Type:
    """What a value may be, in words, and `parse`: the value as the code wants it, None where it is something else."""

    accepted: str
    parse: Callable[[Any], Any]


def _number(value: Any) -> float | None:
    """A finite float. Neither a bool nor an integer that has none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None


def _positive(value: Any) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None


def list_of(parse: Callable[[Any], Any], least: int = 1, most: float = math.inf) -> Callable[[Any], Any]:
    """A parser of lists of `least` to `most` items, each of which `parse` accepts."""

    def parse_list(value: Any) -> Any:
        items = [parse(item) for item in value] if isinstance(value, list) and least <= len(value) <= most else [None]
        return None if any(item is None for item in items) else items

    return parse_list


def _single(parse: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: None if (parsed := parse(value)) is None else [parsed]


def _first(*parsers: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: next((parsed for parse in parsers if (parsed := parse(value)) is not None), None)


def _if(test: Callable[[Any], bool], parse: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def parse_if(value: Any) -> Any:
        parsed = parse(value)
        return parsed if parsed is not None and test(parsed) else None

    return parse_if


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) and value.strip() else None


def whole(least: int, most: int) -> Type:
    """The type of the whole numbers from `least` to `most`."""

    def parse(value: Any) -> int | None:
        return value if type(value) is int and least <= value <= most else None

    return Type(f"a whole number, {least} to {most}", parse)


def _direction(value: Any) -> Array | None:
    """From degrees or [x, y], of length 1."""
    if (degrees := _number(value)) is not None:
        return np.array(unit(degrees))
    vector = _pair(value)
    # First by the larger component: a square may be out of range.
    size = max(map(abs, vector)) if vector else 0.0
    if not size:
        return None
    scaled = np.array(vector) / size
    return scaled / math.hypot(*scaled)


_pair = list_of(_number, 2, 2)
TEXT = Type("a text", _text)
TEXTS = Type("a list of texts", list_of(_text))
NUMBER = Type("a number", _number)
POSITIVE = Type("a number above 0", _positive)
NUMBERS = Type("a list of numbers", list_of(_number))
INDEX = Type("a number above 0, or a list of one for each colour", _first(list_of(_positive), _single(_positive)))
POSITIVES = Type("two numbers above 0", list_of(_positive, 2, 2))
POINT = Type("[x, y]", _pair)
POINTS = Type("a list of [x, y]", list_of(_pair))
PAIR = Type("two numbers", _pair)
DIRECTION = Type("degrees, or [x, y] that is not [0, 0]", _direction)
DIRECTIONS = Type("a list of degrees or of [x, y] that are not [0, 0]", list_of(_direction))
_factor = _if(lambda v: 1e-100 <= abs(v) <= 1e100, _number)
SCALE = Type("a number of size 1e-100 to 1e100, or two of them", _first(_factor, list_of(_factor, 2, 2)))
BOX = Type("[x0, x1, y0, y1], x0 < x1, y0 < y1", _if(lambda v: v[0] < v[1] and v[2] < v[3], list_of(_number, 4, 4)))
APEX = Type("degrees, above 0 and below 180", _if(lambda v: v < 180, _positive))
TABLES = Type("a table or more, in double brackets", list_of(lambda value: value if isinstance(value, dict) else None))
RAYS = whole(1, 1_000_000)


# Keys -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Key:
    """A key of a table: its type, what it means, and what it is where it is left out (None: nothing)."""

    type: Type
    meaning: str
    default: Any = REQUIRED


@dataclass(frozen=True)
class Kind:
    """A kind of shape or beam: what it is, its own keys, and what is built of their values.

    Of a shape: `build(values)` gives its parts, around its own origin; `values` has `n` and `outside`, per colour.
    Of a beam: origins and directions, N × 2.
    """

    meaning: str
    keys: dict[str, Key]
    build: Callable[[Values], Any]


def read(table: Values, keys: dict[str, Key], where: str = "") -> Values:
    """The values of `keys`, parsed. ValueError names `where` and the key that is unknown, missing or refused."""
    for name in table:
        if name not in keys:
            raise ValueError(f"{where}{_shown_key(name)}: unknown; accepted: {', '.join(keys)}")
    return {name: _value(table, name, key, where) for name, key in keys.items()}


def _value(table: Values, name: str, key: Key, where: str) -> Any:
    if name not in table and key.default is not REQUIRED:
        return key.default
    value = key.type.parse(table[name]) if name in table else None
    if value is None:
        found = shown(table[name]) if name in table else "missing"
        raise ValueError(f"{where}{name}: {found}; accepted: {key.type.accepted}")
    return value


def read_kind(table: Values, kinds: dict[str, Kind], where: str, colours: int) -> tuple[Kind, Values]:
    """The kind of a shape or a beam, and its values; indices per colour. ValueError as for `read`."""
    name = table.get("kind")
    if not isinstance(name, str) or name not in kinds:
        found = shown(name) if "kind" in table else "missing"
        raise ValueError(f"{where}kind: {found}; accepted: {', '.join(kinds)}")
    keys = kinds[name].keys
    values = read({key: value for key, value in table.items() if key != "kind"}, keys, where)
    return kinds[name], per_colour(values, keys, where, colours)


def per_colour(values: Values, keys: dict[str, Key], where: str, colours: int) -> Values:
    """`values` with every index as a tuple of one per colour; ValueError for a list of another length."""
    found = {name: values[name] for name, key in keys.items() if key.type is INDEX and values[name] is not None}
    for name, indices in found.items():
        if len(indices) not in (1, colours):
            raise ValueError(f"{where}{name}: {len(indices)} numbers; accepted: 1 for all or each of {colours} colours")
    return values | {name: tuple(n) * (colours // len(n)) for name, n in found.items()}


def shown(value: Any) -> str:
    """A value as in TOML, shortened to a line."""
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _shown_key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else shown(name)


# Tables in Markdown -----------------------------------------------------------------------------------------------


def key_table(title: str, keys: dict[str, Key]) -> str:
    """Of `title`, accepted value and meaning."""
    rows = [f"| `{name}` | {key.type.accepted} | {key.meaning}{_default(key)} |" for name, key in keys.items()]
    return "\n".join([f"| {title} | value | meaning |", "|---|---|---|", *rows])


def kind_table(title: str, kinds: dict[str, Kind], shared: dict[str, Key]) -> str:
    """Of `title`, what it is, and its own keys, not the shared ones."""
    rows = [f"| `{name}` | {kind.meaning} | {_own_keys(kind, shared)} |" for name, kind in kinds.items()]
    return "\n".join([f"| {title} | what it is | its keys |", "|---|---|---|", *rows])


def _own_keys(kind: Kind, shared: dict[str, Key]) -> str:
    own = {name: key for name, key in kind.keys.items() if shared.get(name) is not key}
    texts = (f"`{name}` ({key.type.accepted}) {key.meaning}{_default(key)}" for name, key in own.items())
    return "; ".join(text.rstrip() for text in texts)


def _default(key: Key) -> str:
    if key.default is REQUIRED or key.default is None:
        return ""
    default = key.default if isinstance(key.default, list) else [key.default]
    text = ", ".join(x if isinstance(x, str) else f"{x:g}" for x in default)
    return f", default {text if len(default) == 1 else f'[{text}]'}"
