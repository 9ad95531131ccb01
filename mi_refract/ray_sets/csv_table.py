"""Tables of numbers as CSV text with `# key: value` lines on top."""

from __future__ import annotations

import io
import itertools
import json
import re
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np

from mi_refract.regimes import Array

from .header import Header, as_json

# Visual C++ and others print a NaN as nan(ind) or the like; C has letters, digits and _ between the brackets.
_NAN = re.compile(r"nan\([A-Za-z0-9_]{0,32}\)", re.IGNORECASE)
_LONGEST = 2**20  # characters of a line
_SHOWN = 60  # characters of a wrong line that an error quotes


def with_header(header: Mapping[str, Any], columns: Sequence[str], numbers: Array, whole: Collection[str] = ()) -> str:
    """CSV text of `numbers` (N, columns); the first column, and those in `whole`, hold whole numbers.

    Each number is the shortest decimal that reads back, in float64, as exactly that number.
    """
    top = [f"# {key}: {value if value == _value(value) else json.dumps(value)}" for key, value in header.items()]
    row = ",".join(["%d", *("%d" if name in whole else "%r" for name in columns[1:])])
    return "\n".join([*top, ",".join(columns), *(row % tuple(each) for each in numbers.tolist()), ""])


def read_table(
    name: str, stream: BinaryIO, columns: Sequence[str], optional: Sequence[str], most: int
) -> tuple[Header, Array, tuple[str, ...]]:
    """(header, (N, columns) float64, their names) of CSV text. Each of the `optional` may follow, in their order: a
    column, or several with commas between them.

    ValueError, one line that begins with `name`: bytes that are not text, a wrong line of column names, a row that is
    too short, too long, or not of numbers, or more than `most` rows.
    """
    subsets = (some for count in range(len(optional) + 1) for some in itertools.combinations(optional, count))
    expected = [(*columns, *flat(some)) for some in subsets]
    try:
        with io.TextIOWrapper(stream, "utf-8-sig") as text:
            lines = _Lines(text)
            header, names = _top(lines)
            if names not in expected:
                found = f"the first row is {','.join(names)[:_SHOWN]!r}" if names else "the table is empty"
                raise ValueError(f"{found}; expected, in this order: {' or '.join(map(','.join, expected))}")
            return header, _numbers(lines, len(names), most), names
    except UnicodeDecodeError:
        raise ValueError(f"{name}: not text; expected CSV in UTF-8") from None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def flat(optional: Iterable[str]) -> list[str]:
    """The names of optional columns, one by one."""
    return [name for names in optional for name in names.split(",")]


class TableError(ValueError):
    """A line or a table that is too long."""


class _Lines:
    """The lines of a text, and the number and the text of the latest."""

    def __init__(self, text: io.TextIOWrapper) -> None:
        self._text, self.number, self.latest = text, 0, ""

    def __iter__(self) -> Iterator[str]:
        while line := self._text.readline(_LONGEST + 1):
            self.number, self.latest = self.number + 1, line.rstrip("\r\n")
            if len(line) > _LONGEST:
                raise TableError(f"line {self.number} is longer than {_LONGEST} characters; expected shorter lines")
            yield _NAN.sub("nan", line) if "(" in line else line


def _top(lines: _Lines) -> tuple[Header, tuple[str, ...]]:
    """The header, and the names of the columns; () where there is no more."""
    header: Header = {}
    for line in lines:
        if line.startswith("#"):
            key, _, value = line[1:].partition(":")
            header[key.strip()] = _value(value.strip())
        elif line.strip():
            return header, tuple(each.strip() for each in line.split(","))
    return header, ()


def _numbers(lines: _Lines, width: int, most: int) -> Array:
    """(N, width) of the lines that are left."""

    def rows() -> Iterator[str]:
        count = 0
        for line in lines:
            if line.strip() and not line.startswith("#"):
                count += 1
                if count > most:
                    raise TableError(f"more than {most} rows; expected up to {most}")
                yield line

    with warnings.catch_warnings(action="ignore", category=UserWarning):  # of a table without rows
        try:
            numbers = np.loadtxt(rows(), delimiter=",", ndmin=2)
        except (TableError, UnicodeDecodeError):
            raise
        except ValueError:
            numbers = None
    if numbers is not None and not numbers.size:
        return np.empty((0, width))
    if numbers is None or numbers.shape[1] != width:
        raise ValueError(f"line {lines.number} is {lines.latest[:_SHOWN]!r}; expected {width} numbers")
    return numbers


def _value(text: Any) -> Any:
    """The value of JSON text, any other text unchanged, None for anything but text."""
    try:
        return as_json(text)
    except ValueError:
        return text
    except TypeError:
        return None
