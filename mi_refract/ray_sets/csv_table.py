"""Tables of numbers as CSV text with `# key: value` lines on top."""

from __future__ import annotations

import codecs
import contextlib
import itertools
import json
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np

from mi_refract.io.scratch import Log

from .header import as_json

# Visual C++ and others print a NaN as nan(ind) or the like; C has letters, digits and _ between the brackets.
_NAN = re.compile(r"nan\([A-Za-z0-9_]{0,32}\)", re.IGNORECASE)
_LINES, _BYTES = 2**16, 2**22  # that are read at once
LONGEST = 2**26  # characters of a line in a file
_SHOWN = 60  # characters of a wrong line that an error quotes


def with_header(
    header: Mapping[str, Any], columns: Sequence[str], numbers: np.ndarray, whole: Collection[str] = ()
) -> str:
    """CSV text of `numbers` (N, columns); the first column, and those in `whole`, hold whole numbers.

    Each number is the shortest decimal that reads back, in float64, as exactly that number.
    """
    top = [f"# {key}: {value if value == _value(value) else json.dumps(value)}" for key, value in header.items()]
    row = ",".join(["%d", *("%d" if name in whole else "%r" for name in columns[1:])])
    return "\n".join([*top, ",".join(columns), *(row % tuple(each) for each in numbers.tolist()), ""])


def parse_table(
    name: str, content: str | bytes, columns: Sequence[str], *optional: str
) -> tuple[dict[str, Any], np.ndarray, tuple[str, ...]]:
    """(header, (N, columns) float64, their names) of CSV text. Each of the `optional` may follow, in their order: a
    column, or several with commas between them.

    ValueError, one line that begins with `name`: bytes that are not text, a wrong line of column names, rows that are
    too short, too long, or not numbers.
    """
    lines = _decoded(name, content).splitlines()
    header, numbers, names = _parsed(name, lambda: iter([lines]), columns, optional, len(lines))
    return header, np.concatenate([np.empty((0, numbers.width)), *numbers.pieces(max(1, numbers.rows))]), names


def flat(optional: Iterable[str]) -> list[str]:
    """The names of optional columns, one by one."""
    return [name for names in optional for name in names.split(",")]


def read_table(
    name: str, stream: BinaryIO, columns: Sequence[str], optional: Sequence[str], most: int, limit: int
) -> tuple[dict[str, Any], Log, tuple[str, ...]]:
    """As `parse_table`, of a file, which is read more than once; its numbers are kept outside of the memory.

    ValueError also for more than `most` rows, and for a file that has grown to more than `limit` bytes.
    """

    def lines() -> Iterator[list[str]]:
        for text in whole_lines(_texts(stream, limit)):
            yield (_NAN.sub("nan", text) if "(" in text else text).splitlines()

    try:
        for _ in whole_lines(_texts(stream, limit)):  # what is no text at all, to its end, comes first
            pass
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    return _parsed(name, lines, columns, optional, most)


def _parsed(
    name: str, lines: Callable[[], Iterator[list[str]]], columns: Sequence[str], optional: Sequence[str], most: int
) -> tuple[dict[str, Any], Log, tuple[str, ...]]:
    """`lines`: those of the table from its first one on, some at a time."""
    header, names, top, rest = _top(lines())
    subsets = (some for count in range(len(optional) + 1) for some in itertools.combinations(optional, count))
    accepted = [(*columns, *flat(some)) for some in subsets]
    if names not in accepted:
        found = f"the first row is {','.join(names)[:_SHOWN]!r}" if names else "the table is empty"
        raise ValueError(f"{name}: {found}; accepted, in this order: {' or '.join(map(','.join, accepted))}")
    numbers, count, width = Log(np.float64, len(names)), 0, len(names)
    for some in itertools.chain.from_iterable(map(_few, rest)):
        if (read := _numbers(some, width)) is None:
            raise ValueError(f"{name}: {_wrong_rows(lines(), top, width)}; accepted: {width} numbers a row")
        count += len(read)
        if count <= most:
            numbers.append(read)
    if count > most:
        raise ValueError(f"{name}: {count} rows; accepted: up to {most}")
    return header, numbers, names


def _few(lines: list[str]) -> Iterator[list[str]]:
    for i in range(0, len(lines), _LINES):
        yield lines[i : i + _LINES]


def _top(lines: Iterator[list[str]]) -> tuple[dict[str, Any], tuple[str, ...], int, Iterator[list[str]]]:
    """The header, the names of the columns, the number of their line, and the lines that follow."""
    header: dict[str, Any] = {}
    number = 0
    for some in lines:
        for i, line in enumerate(some, 1):
            number += 1
            if line.startswith("#"):
                key, _, value = line[1:].partition(":")
                header[key.strip()] = _value(value.strip())
            elif line.strip():
                names = tuple(each.strip() for each in line.split(","))
                return header, names, number, itertools.chain([some[i:]], lines)
    return header, (), number, iter(())


def _numbers(rows: list[str], width: int) -> np.ndarray | None:
    """(N, width) of lines; None where one of them is wrong."""
    if not any(line.strip() and not line.startswith("#") for line in rows):
        return np.empty((0, width))
    with contextlib.suppress(ValueError):
        numbers = np.loadtxt(rows, delimiter=",", ndmin=2)
        if numbers.shape[1] == width:
            return numbers
    return None


def _wrong_rows(lines: Iterator[list[str]], top: int, width: int) -> str:
    """In words, those after the first `top` lines: how many, and the first."""
    count, first = 0, ""
    for number, line in enumerate(itertools.chain.from_iterable(lines), 1):
        if number > top and not _is_row(line, width):
            count += 1
            first = first or f", the first is line {number}, {line[:_SHOWN]!r}"
    return f"{count} wrong rows{first}"


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


def _texts(stream: BinaryIO, limit: int) -> Iterator[str]:
    """The text of a file from its beginning, some at a time."""
    stream.seek(0)
    decoder = codecs.getincrementaldecoder("utf-8-sig")()
    while True:
        data = stream.read(_BYTES)
        if stream.tell() > limit:
            raise ValueError(f"more than {limit} bytes; accepted: up to {limit}")
        try:
            yield decoder.decode(data, final=not data)
        except UnicodeDecodeError:
            raise ValueError("not text; accepted: CSV in UTF-8") from None
        if not data:
            return


def whole_lines(texts: Iterable[str]) -> Iterator[str]:
    """The same text, cut after line ends only. ValueError where there is none in LONGEST characters."""
    kept: list[str] = []
    for text in texts:
        cut = max(text.rfind("\n"), text.rfind("\r", 0, max(0, len(text) - 1))) + 1  # not between \r and \n
        if cut:
            yield "".join([*kept, text[:cut]])
            kept = []
        kept.append(text[cut:])
        if sum(map(len, kept)) > LONGEST:
            raise ValueError(f"a line has more than {LONGEST} characters; accepted: a table of numbers")
    yield "".join(kept)


def _value(text: Any) -> Any:
    """The value of JSON text, any other text unchanged, None for anything but text."""
    try:
        return as_json(text)
    except ValueError:
        return text
    except TypeError:
        return None
