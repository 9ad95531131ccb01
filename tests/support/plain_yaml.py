"""The YAML of this project's CI files: mappings, lists, texts, `|` blocks. What it does not know is an error."""

from __future__ import annotations

import re
from typing import Any

Lines = list[tuple[int, str]]  # indentation, and what follows it


def loads(text: str) -> Any:
    """The document; every scalar is a text. ValueError for what this reader does not know."""
    lines: Lines = [(len(line) - len(line.lstrip()), line.strip()) for line in text.splitlines()]
    value, rest = _value(lines, -1)
    if _next(rest):
        raise ValueError(f"not read: {_next(rest)[0]}")
    return value


def _next(lines: Lines) -> Lines:
    """Without empty lines and comments at the beginning."""
    while lines and (not lines[0][1] or lines[0][1].startswith("#")):
        lines = lines[1:]
    return lines


def _value(lines: Lines, above: int) -> tuple[Any, Lines]:
    """The mapping or list that is indented further than `above`, and the lines after it; None where there is none."""
    lines = _next(lines)
    if not lines or lines[0][0] <= above:
        return None, lines
    indent, first = lines[0]
    found: Any = [] if first.startswith("- ") else {}
    while (lines := _next(lines)) and lines[0][0] == indent:
        text = lines[0][1]
        if isinstance(found, list):
            inner: Lines = [(indent + 2, text[2:].strip()), *lines[1:]]
            mapping = re.match(r"[\w-]+:( |$)", inner[0][1])
            value, lines = _value(inner, indent) if mapping else (_scalar(inner[0][1]), lines[1:])
            found.append(value)
            continue
        key, colon, rest = text.partition(":")
        if not colon or not re.fullmatch(r"[\w-]+", key) or key in found:
            raise ValueError(f"no key: {text}")
        found[key], lines = _after(rest.strip(), lines[1:], indent)
    if lines and lines[0][0] > above and lines[0][0] != indent:
        raise ValueError(f"indented otherwise: {lines[0][1]}")
    return found, lines


def _after(text: str, lines: Lines, indent: int) -> tuple[Any, Lines]:
    """What stands after a colon, or in the lines below it."""
    if text == "|":
        return _block(lines, indent)
    if not text:
        value, rest = _value(lines, indent)
        return "" if value is None else value, rest
    return _scalar(text), lines


def _block(lines: Lines, indent: int) -> tuple[str, Lines]:
    count = next((i for i, (column, text) in enumerate(lines) if text and column <= indent), len(lines))
    left = min(column for column, text in lines[:count] if text)
    block = "\n".join(" " * (column - left) + text if text else "" for column, text in lines[:count])
    return block.rstrip("\n") + "\n", lines[count:]


def _scalar(text: str) -> Any:
    if text.startswith("["):
        return [_scalar(each.strip()) for each in text.removeprefix("[").removesuffix("]").split(",")]
    if text.startswith("{"):
        pairs = (each.partition(":") for each in text.removeprefix("{").removesuffix("}").split(","))
        return {key.strip(): _scalar(value.strip()) for key, _, value in pairs}
    if text[0] in "'\"":
        return re.sub(r"^(['\"])(.*)\1$", r"\2", text)
    if text[0] in "&*!>%@`":
        raise ValueError(f"not read: {text}")
    return text.partition(" #")[0].strip()
