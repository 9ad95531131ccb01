"""Tables of numbers as CSV with `# key: value` lines on top, and back. Knows nothing of rays."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

# Visual C++ and others say more of a NaN than that it is one: -nan(ind).
_NAN = re.compile(r"nan\([^),\n]*\)", re.IGNORECASE)
_SHOWN = 60


def with_header(header: Mapping[str, Any], columns: Sequence[str], numbers: np.ndarray) -> str:
    """`numbers`: (N, columns), whole ones in the first. Each as the shortest decimal that float64 reads as itself."""
    top = [f"# {key}: {value if value == _value(value) else json.dumps(value)}" for key, value in header.items()]
    row = ",".join(["%d", *["%r"] * (len(columns) - 1)])
    return "\n".join([*top, ",".join(columns), *(row % tuple(each) for each in numbers.tolist()), ""])


def table(name: str, content: str | bytes, columns: Sequence[str], *more: str) -> tuple[dict[str, Any], np.ndarray]:
    """(header, (N, columns) float64); `more` are columns that may follow.

    ValueError, one line that begins with `name`: no text, another line of names, rows that are no numbers or too short.
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
    accepted = [tuple(columns), *([(*columns, *more)] if more else [])]
    if names not in accepted:
        found = f"header line {','.join(names)[:_SHOWN]!r}" if names else "nothing in it"
        raise ValueError(f"{name}: {found}; accepted, in this order: {' or '.join(map(','.join, accepted))}")
    return header, _numbers(name, list(lines), len(names))


def _numbers(name: str, lines: list[tuple[int, str]], width: int) -> np.ndarray:
    rows = [line for _, line in lines]
    if not any(line.strip() and not line.startswith("#") for line in rows):
        return np.empty((0, width))
    with contextlib.suppress(ValueError):
        numbers = np.loadtxt(rows, delimiter=",", ndmin=2)
        if numbers.shape[1] == width:
            return numbers
    wrong = [(number, line) for number, line in lines if not _is_row(line, width)]
    first, line = wrong[0] if wrong else (0, "")
    raise ValueError(
        f"{name}: {len(wrong)} lines are no row, first line {first}, {line[:_SHOWN]!r}; accepted: {width} numbers"
    )


def _is_row(line: str, width: int) -> bool:
    line = line.partition("#")[0].strip()
    if not line:
        return True
    cells = line.split(",")
    try:
        return len([float(cell) for cell in cells]) == width
    except ValueError:
        return False


def _decoded(name: str, content: str | bytes) -> str:
    try:
        text = content if isinstance(content, str) else content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(f"{name}: no text; accepted: CSV in UTF-8") from None
    return _NAN.sub("nan", text) if "(" in text else text


def _value(text: Any) -> Any:
    """What JSON understands as such, any other text as it is; None for what is no text."""
    try:
        return json.loads(text)
    except ValueError:
        return text
    except TypeError:
        return None
