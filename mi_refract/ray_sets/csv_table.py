"""Tables of numbers as CSV text with `# key: value` lines on top."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .header import as_json

# Visual C++ and others print a NaN as nan(ind) or the like; C has letters, digits and _ between the brackets.
_NAN = re.compile(r"nan\([A-Za-z0-9_]{0,32}\)", re.IGNORECASE)
_SHOWN = 60  # characters of a wrong line that an error quotes


def with_header(header: Mapping[str, Any], columns: Sequence[str], numbers: np.ndarray) -> str:
    """CSV text of `numbers` (N, columns); the first column holds whole numbers.

    Each number is the shortest decimal that reads back, in float64, as exactly that number.
    """
    top = [f"# {key}: {value if value == _value(value) else json.dumps(value)}" for key, value in header.items()]
    row = ",".join(["%d", *["%r"] * (len(columns) - 1)])
    return "\n".join([*top, ",".join(columns), *(row % tuple(each) for each in numbers.tolist()), ""])


def parse_table(
    name: str, content: str | bytes, columns: Sequence[str], *optional: str
) -> tuple[dict[str, Any], np.ndarray]:
    """(header, (N, columns) float64) of CSV text. All of the `optional` columns may follow, or none of them.

    ValueError, one line that begins with `name`: bytes that are not text, a wrong line of column names, rows that are
    too short, too long, or not numbers.
    """
    text = _decoded(name, content)
    header: dict[str, Any] = {}
    lines = enumerate(text.splitlines(), 1)
    names: tuple[str, ...] = ()
    for _, line in lines:
        if line.startswith("#"):
            key, _, value = line[1:].partition(":")
            header[key.strip()] = _value(value.strip())
        elif line.strip():
            names = tuple(each.strip() for each in line.split(","))
            break
    accepted = [tuple(columns), *([(*columns, *optional)] if optional else [])]
    if names not in accepted:
        found = f"the first row is {','.join(names)[:_SHOWN]!r}" if names else "the table is empty"
        raise ValueError(f"{name}: {found}; accepted, in this order: {' or '.join(map(','.join, accepted))}")
    return header, _numbers(name, list(lines), len(names))


def _numbers(name: str, lines: list[tuple[int, str]], width: int) -> np.ndarray:
    """(N, width) of numbered lines."""
    rows = [line for _, line in lines]
    if not any(line.strip() and not line.startswith("#") for line in rows):
        return np.empty((0, width))
    with contextlib.suppress(ValueError):
        numbers = np.loadtxt(rows, delimiter=",", ndmin=2)
        if numbers.shape[1] == width:
            return numbers
    wrong = [(number, line) for number, line in lines if not _is_row(line, width)]
    found = f"{len(wrong)} wrong rows"
    if wrong:
        found += f", the first is line {wrong[0][0]}, {wrong[0][1][:_SHOWN]!r}"
    raise ValueError(f"{name}: {found}; accepted: {width} numbers a row")


def _is_row(line: str, width: int) -> bool:
    """Whether a line holds `width` numbers, or nothing but a comment."""
    line = line.partition("#")[0].strip()
    if not line:
        return True
    cells = line.split(",")
    if not line.isascii() or "_" in line:  # numbers in Python only
        return False
    try:
        return len([float(cell) for cell in cells]) == width
    except ValueError:
        return False


def _decoded(name: str, content: str | bytes) -> str:
    try:
        text = content if isinstance(content, str) else content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{name}: not text; accepted: CSV in UTF-8") from None
    return _NAN.sub("nan", text) if "(" in text else text


def _value(text: Any) -> Any:
    """The value of JSON text, any other text unchanged, None for anything but text."""
    try:
        return as_json(text)
    except ValueError:
        return text
    except TypeError:
        return None
