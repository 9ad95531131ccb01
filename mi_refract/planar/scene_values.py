"""Types of values that only planar scene files have: indices per colour, points, directions, kinds of shapes, beams."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.io.toml_schema import (
    Key,
    Parser,
    Table,
    Type,
    first_of,
    list_of,
    number,
    only_if,
    positive,
    read,
    shown,
    shown_default,
    text,
    whole,
)

from .curves import unit
from .light import MOST, POWERS, Light

Indices = tuple[float, ...]  # refractive indices of a medium, one per colour


def _single(parse: Parser) -> Parser:
    return lambda value: None if (parsed := parse(value)) is None else [parsed]


def _direction(value: Any) -> NDArray[np.float64] | None:
    """A vector of length 1, from degrees or [x, y]."""
    if (degrees := number(value)) is not None:
        return np.array(unit(degrees))
    vector = _pair(value)
    # First by the larger component: a square may be out of range.
    size = max(map(abs, vector)) if vector else 0.0
    if not size:
        return None
    scaled = np.array(vector) / size
    return scaled / math.hypot(*scaled)


_pair = list_of(number, 2, 2)
_factor = only_if(lambda v: 1e-100 <= abs(v) <= 1e100, number)
_index = first_of(list_of(positive), _single(positive), text)
INDEX = Type('a number above 0, a list of one for each colour, or a material, as "SCHOTT:N-BK7"', _index)
WAVELENGTHS = Type(
    f"a number from 2 to {MOST}, or a list of wavelengths in nm",
    first_of(only_if(lambda v: 2 <= v <= MOST, whole(2, MOST).parse), list_of(positive, 1, MOST)),
)
POWER = Type(" or ".join(f'"{name}"' for name in POWERS), only_if(lambda v: v in POWERS, text))
POSITIVES = Type("two numbers above 0", list_of(positive, 2, 2))
PAIR = Type("two numbers", _pair)
POINT = Type("[x, y]", _pair)
POINTS = Type("a list of [x, y]", list_of(_pair))
DIRECTION = Type("degrees, or [x, y] that is not [0, 0]", _direction)
DIRECTIONS = Type("a list of degrees or of [x, y] that are not [0, 0]", list_of(_direction))
SCALE = Type("a number of size 1e-100 to 1e100, or two of them", first_of(_factor, list_of(_factor, 2, 2)))
BOX = Type("[x0, x1, y0, y1], x0 < x1, y0 < y1", only_if(lambda v: v[0] < v[1] and v[2] < v[3], list_of(number, 4, 4)))
APEX = Type("degrees, above 0 and below 180", only_if(lambda v: v < 180, positive))
RAYS = whole(1, 1_000_000)


@dataclass(frozen=True)
class Kind:
    """A kind of shape or beam: a description, its own keys, and the function that builds it from their values.

    Of a shape: `build(values)` gives its parts, around its own origin; `values` has `n` and `outside`, per colour.
    Of a beam: origins and directions, N × 2.
    """

    meaning: str
    keys: dict[str, Key]
    build: Callable[[Table], Any]


def read_kind(table: Table, kinds: dict[str, Kind], where: str, light: Light) -> tuple[Kind, Table]:
    """The kind of a shape or a beam, and its values; indices per colour. ValueError as for `toml_schema.read`."""
    name = table.get("kind")
    if not isinstance(name, str) or name not in kinds:
        found = shown(name) if "kind" in table else "missing"
        raise ValueError(f"{where}kind: {found}; expected {', '.join(kinds)}")
    keys = kinds[name].keys
    values = read({key: value for key, value in table.items() if key != "kind"}, keys, where)
    return kinds[name], per_colour(values, keys, where, light)


def per_colour(values: Table, keys: dict[str, Key], where: str, light: Light) -> Table:
    """`values` with every index as a tuple of one per colour.

    ValueError for a list of another length, and for a material as of `Light.indices`.
    """
    colours = len(light)
    found = {name: values[name] for name, key in keys.items() if key.type is INDEX and values[name] is not None}
    for name, indices in found.items():
        if isinstance(indices, str):
            found[name] = light.indices(indices, f"{where}{name}")
        elif len(indices) not in (1, colours):
            raise ValueError(f"{where}{name}: {len(indices)} numbers; expected 1 for all or each of {colours} colours")
    return values | {name: tuple(n) * (colours // len(n)) for name, n in found.items()}


def kind_table(title: str, kinds: dict[str, Kind], shared: dict[str, Key]) -> str:
    """A Markdown table of `kinds`: name, what it is, and the keys that it does not have from `shared`."""
    rows = [f"| `{name}` | {kind.meaning} | {_own_keys(kind, shared)} |" for name, kind in kinds.items()]
    return "\n".join([f"| {title} | what it is | its keys |", "|---|---|---|", *rows])


def _own_keys(kind: Kind, shared: dict[str, Key]) -> str:
    own = {name: key for name, key in kind.keys.items() if shared.get(name) is not key}
    texts = (f"`{name}` ({key.type.accepted}) {key.meaning}{shown_default(key)}" for name, key in own.items())
    return "; ".join(text.rstrip() for text in texts)
