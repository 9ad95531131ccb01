"""Names of images: patterns that match them, and templates that make the name of one file from another's.

In a pattern `*` stands for any characters, `/` included, and `?` for one; all else is itself, brackets too.

A template is a relative path in which fields stand for parts of an image's path: of "glass/ball.exr" {dir} is "glass",
{name} "ball.exr", {stem} "ball" and {suffix} ".exr".
"""

from __future__ import annotations

import functools
import re
from collections.abc import Collection
from pathlib import PurePosixPath

FIELDS = {"dir": ".+", "name": "[^/]+", "stem": "[^/]+", "suffix": r"\.[^./]+"}
WILD = {"*": ".*", "?": "."}
_PARTS = re.compile(r"(\{[^{}]*\}/?|[*?])")  # fields, with the slash behind them, and wild cards


def matches(pattern: str, name: str) -> bool:
    """Whether the whole name is one of the pattern."""
    return _pattern(pattern).fullmatch(name) is not None


@functools.lru_cache(1024)
def _pattern(pattern: str) -> re.Pattern[str]:
    return re.compile("".join(WILD.get(part, re.escape(part)) for part in re.split(r"([*?])", pattern)), re.DOTALL)


def is_template(text: str, names: Collection[str] = FIELDS) -> bool:
    """Whether it is a relative path that stays in its folder, with no other fields than these."""
    rest = re.sub(r"\{[^{}]*\}", "", text)
    inside = not text.startswith("/") and ".." not in text.split("/")
    return bool(text.strip()) and inside and not set("{}") & set(rest) and fields_of(text) <= set(names)


def fields(name: str) -> dict[str, str]:
    """The fields of an image's path; {dir} is empty for one that lies in no folder."""
    path = PurePosixPath(name)
    folder = path.parent.as_posix()
    return {"dir": "" if folder == "." else folder, "name": path.name, "stem": path.stem, "suffix": path.suffix}


def fields_of(template: str) -> frozenset[str]:
    """The names of the fields in a template."""
    return frozenset(part.rstrip("/")[1:-1] for part in _PARTS.findall(template) if part.startswith("{"))


def filled(template: str, values: dict[str, str]) -> str:
    """The template with the values in place of its fields; an empty {dir} goes with the slash behind it."""
    return "".join(_filled(part, values) for part in _PARTS.split(template))


def _filled(part: str, values: dict[str, str]) -> str:
    if not part.startswith("{"):
        return part
    value = values[part.rstrip("/")[1:-1]]
    return value + "/" * part.endswith("/") if value else ""


def expanded(template: str, values: dict[str, str], names: list[str]) -> list[str]:
    """Those of `names` that the filled template means: its `*` and `?` are wild, the values of its fields are not."""
    wanted = re.compile("".join(WILD.get(part) or re.escape(_filled(part, values)) for part in _PARTS.split(template)))
    return [name for name in names if wanted.fullmatch(name)]


def parsed(template: str, name: str) -> dict[str, str] | None:
    """The values of the template's fields for which it is `name`; None where there are none."""
    found = _parser(template).fullmatch(name)
    return None if found is None else {field: value or "" for field, value in found.groupdict().items()}


@functools.lru_cache(64)
def _parser(template: str) -> re.Pattern[str]:
    text, seen = "", set[str]()
    for part in _PARTS.split(template):
        field = part.rstrip("/")[1:-1] if part.startswith("{") else ""
        if not field:
            text += WILD.get(part) or re.escape(part)
            continue
        group = f"(?P={field})" if field in seen else f"(?P<{field}>{FIELDS[field]})"
        text += f"(?:{group}/)?" if part == "{dir}/" else group + "/" * part.endswith("/")
        seen.add(field)
    return re.compile(text)
