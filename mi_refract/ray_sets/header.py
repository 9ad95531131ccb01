"""The header of a file of rays: its keys, and what each of them may be."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Header = dict[str, Any]  # the `# key: value` lines of a file

FORMAT = "mi_refract rays 1"
PRECISIONS: dict[str, type[np.floating]] = {"f32": np.float32, "f64": np.float64}
LONGEST = 200  # characters of a text
_CHECKSUM = re.compile("sha256:[0-9a-f]{64}")


def as_json(text: str) -> Any:
    """The value of JSON text. ValueError for any other text, also where it is nested too deep for the parser."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deep; accepted: JSON") from None


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= LONGEST


def _is_whole(value: Any, least: int) -> bool:
    return type(value) is int and least <= value < 2**63


def _is_ranges(value: Any) -> bool:
    """Whether it is {name: [first id, last id]} of regimes."""
    return isinstance(value, dict) and all(
        _is_text(name) and isinstance(ends, list) and len(ends) == 2 and all(_is_whole(id_, 0) for id_ in ends)
        for name, ends in value.items()
    )


Rule = tuple[Callable[[Any], bool], str]  # and what it accepts, in words
_TEXT: Rule = (_is_text, f"text of up to {LONGEST} characters")
SCHEMA: dict[str, Rule] = {
    "format": (lambda value: value == FORMAT, FORMAT),
    "version": _TEXT,
    "precision": (lambda value: isinstance(value, str) and value in PRECISIONS, " or ".join(PRECISIONS)),
    "seed": (lambda value: _is_whole(value, 0), "a whole number from 0"),
    "count": (lambda value: _is_whole(value, 1), "a whole number from 1"),
    "two_sided": (lambda value: isinstance(value, bool), "true or false"),
    "a": _TEXT,
    "n": _TEXT,
    "n_from, n_to": _TEXT,
    "answer": _TEXT,
    "regimes": (_is_ranges, "{name: [first id, last id]} of each regime"),
    "checksum": (lambda value: isinstance(value, str) and bool(_CHECKSUM.fullmatch(value)), "sha256: and 64 digits"),
}


def check(header: Mapping[str, Any], rays: int) -> None:
    """ValueError, one line, for a header that `make` does not write for so many rays.

    Each regime has `count` rays, one after the other: no ray is without a regime, and none is in two.
    """
    if unknown := sorted(header.keys() - SCHEMA.keys()):
        raise ValueError(f"the header has {shown(unknown[0])}; accepted: {', '.join(SCHEMA)}")
    for key, (accepts, words) in SCHEMA.items():
        if key not in header:
            raise ValueError(f"the header has no {key}; accepted: {words}")
        if not accepts(header[key]):
            raise ValueError(f"the header's {key} is {shown(header[key])}; accepted: {words}")
    count, regimes = header["count"], header["regimes"]
    if count * len(regimes) != rays or not rays:
        found = f"the header is of {len(regimes)} × {count} rays, the file has {rays}"
        raise ValueError(f"{found}; accepted: `count` rays of each regime")
    for i, (name, ends) in enumerate(regimes.items()):
        if ends != [i * count, (i + 1) * count - 1]:
            found = f"the header's regime {shown(name)} has the ids {shown(ends)}"
            raise ValueError(f"{found}; accepted: {[i * count, (i + 1) * count - 1]}")


def shown(value: Any) -> str:
    """Any value of a header in an error: quoted, and not long."""
    try:
        text = ascii(value)
    except (RecursionError, ValueError):  # a number of thousands of digits
        text = type(value).__name__
    return text if len(text) <= 60 else f"{text[:60]}…"
