"""The header of a file of rays: its keys, and what each of them may be."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Ids = NDArray[np.int64]
Header = dict[str, Any]  # the `# key: value` lines of a file

FORMAT = "mi_refract rays 1"
PRECISIONS: dict[str, type[np.floating]] = {"f32": np.float32, "f64": np.float64}
LARGEST_WAVELENGTH = 1e9  # nm
LONGEST = 200  # characters of a text
MOST_MEDIA, LONGEST_MEDIUM = 64, 512  # media, and wavelengths; characters
AIR = "air"
_CHECKSUM = re.compile("sha256:[0-9a-f]{64}")


def as_json(text: str) -> Any:
    """The value of JSON text. ValueError for any other text, also where it is nested too deep for the parser."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deep; expected JSON") from None


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


def _is_medium(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= LONGEST_MEDIUM and value.isprintable()


def _is_media(value: Any) -> bool:
    """Whether it is [[medium, air], [air, medium], …], each medium once."""
    if not isinstance(value, list) or not 0 < len(value) <= 2 * MOST_MEDIA or len(value) % 2:
        return False
    if not all(isinstance(pair, list) and len(pair) == 2 and all(map(_is_medium, pair)) for pair in value):
        return False
    names = [pair[0] for pair in value[::2]]
    return len(set(names)) == len(names) and value == [p for name in names for p in ([name, AIR], [AIR, name])]


def _is_wavelengths(value: Any) -> bool:
    if not isinstance(value, list) or not 0 < len(value) <= MOST_MEDIA:
        return False
    return all(type(each) is float and 0 < each < LARGEST_WAVELENGTH for each in value)


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
MEDIA: dict[str, Rule] = {  # all of them, or none
    "wavelength, medium": (lambda value: isinstance(value, str) and 0 < len(value) <= LONGEST_MEDIUM, "text"),
    "media": (_is_media, f"[[medium, {AIR!r}], [{AIR!r}, medium], …], each medium once, up to {MOST_MEDIA}"),
    "wavelengths": (_is_wavelengths, f"[nm, …], each once, up to {MOST_MEDIA}"),
}


def check_media(header: Mapping[str, Any], precision: str) -> None:
    """ValueError, one line, for keys of MEDIA whose values have the wrong form."""
    _check_rules(header, MEDIA)
    with np.errstate(under="ignore"):
        rounded = np.array(header["wavelengths"]).astype(PRECISIONS[precision])
    if len(np.unique(rounded)) < len(rounded) or not rounded.all():
        found = f"the wavelengths {shown(header['wavelengths'])} are not all different in {precision}"
        raise ValueError(f"{found}; expected each once")


def _check_rules(header: Mapping[str, Any], rules: Mapping[str, Rule]) -> None:
    for key, (accepts, words) in rules.items():
        if key not in header:
            raise ValueError(f"the header has no {key}; expected {words}")
        if not accepts(header[key]):
            raise ValueError(f"the header's {key} is {shown(header[key])}; expected {words}")


def check(header: Mapping[str, Any], rays: int) -> None:
    """ValueError, one line, for a header that `make` does not write for so many rays.

    Each regime has `count` rays, one after the other: no ray is without a regime, and none is in two.
    """
    if unknown := sorted(header.keys() - SCHEMA.keys() - MEDIA.keys()):
        raise ValueError(f"the header has {shown(unknown[0])}; expected {', '.join((*SCHEMA, *MEDIA))}")
    _check_rules(header, SCHEMA)
    if header.keys() & MEDIA.keys():
        check_media(header, header["precision"])
    count, regimes = header["count"], header["regimes"]
    if count * len(regimes) != rays or not rays:
        found = f"the header is of {len(regimes)} × {count} rays, the file has {rays}"
        raise ValueError(f"{found}; expected `count` rays of each regime")
    for i, (name, ends) in enumerate(regimes.items()):
        if ends != [i * count, (i + 1) * count - 1]:
            found = f"the header's regime {shown(name)} has the ids {shown(ends)}"
            raise ValueError(f"{found}; expected {[i * count, (i + 1) * count - 1]}")


def shown(value: Any) -> str:
    """Any value of a header in an error: quoted, and not long."""
    try:
        text = ascii(value)
    except (RecursionError, ValueError):  # a number of thousands of digits
        text = type(value).__name__
    return text if len(text) <= 60 else f"{text[:60]}…"
