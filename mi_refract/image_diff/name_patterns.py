"""Names of images: patterns that match them, and templates that make the name of one file from another's.

In a pattern `*` stands for any characters, `/` included, and `?` for one; all else is itself, brackets too.

A template is a relative path in which fields stand for parts of an image's path: of "glass/ball.exr" {dir} is "glass",
{name} "ball.exr", {stem} "ball" and {suffix} ".exr".
"""

from __future__ import annotations

import fnmatch
import functools
import re
from collections.abc import Collection, Mapping
from pathlib import PurePosixPath

FIELDS = {"dir": ".+", "name": "[^/]+", "stem": "[^/]+", "suffix": r"\.[^./]+"}
_FIELD = re.compile(r"\{([^{}]*)\}(/?)")  # with the slash behind it


def matches(pattern: str, name: str) -> bool:
    """Whether the whole name matches the pattern."""
    return fnmatch.fnmatchcase(name, _without_classes(pattern))


def _without_classes(pattern: str) -> str:
    """For `fnmatch`, to which brackets mean a class of characters."""
    return pattern.replace("[", "[[]")


def is_template(text: str, names: Collection[str] = FIELDS) -> bool:
    """Whether it is a relative path that stays in its folder, with no other fields than these."""
    inside = not text.startswith("/") and ".." not in text.split("/")
    rest = _FIELD.sub("", text)
    known = all(field in names for field, _ in _FIELD.findall(text))
    return bool(text.strip()) and inside and known and not set("{}") & set(rest)


def fields(name: str) -> dict[str, str]:
    """The fields of an image's path; {dir} is empty for one that lies in no folder."""
    path = PurePosixPath(name)
    folder = path.parent.as_posix()
    return {"dir": "" if folder == "." else folder, "name": path.name, "stem": path.stem, "suffix": path.suffix}


def fields_of(template: str) -> frozenset[str]:
    """The names of the fields in a template."""
    return frozenset(field for field, _ in _FIELD.findall(template))


def filled(template: str, values: Mapping[str, str]) -> str:
    """The template with the values in place of its fields; an empty {dir} goes with the slash behind it."""
    return _FIELD.sub(lambda match: values[match[1]] and values[match[1]] + match[2], template)


def expanded(template: str, values: Mapping[str, str], names: list[str]) -> list[str]:
    """The names that match the filled template: its `*` and `?` are wild, those in the values are not."""
    literal = {field: re.sub(r"([*?[])", r"[\1]", value) for field, value in values.items()}
    parts = (filled(part, literal) if part.startswith("{") else _without_classes(part) for part in _split(template))
    pattern = "".join(parts)
    return [name for name in names if fnmatch.fnmatchcase(name, pattern)]


def _split(template: str) -> list[str]:
    """Its fields, each with the slash behind it, and what is between them."""
    return re.split(r"(\{[^{}]*\}/?)", template)


def parsed(template: str, name: str) -> dict[str, str] | None:
    """The values of the template's fields for which it is `name`; None where there are none."""
    match = _parser(template).fullmatch(name)
    return match and {field: value or "" for field, value in match.groupdict().items()}


@functools.lru_cache(64)
def _parser(template: str) -> re.Pattern[str]:
    text, fields = "", set[str]()
    for part in _split(template):
        if not (match := _FIELD.fullmatch(part)):
            text += re.escape(part)
            continue
        field, slash = match.groups()
        group = f"(?P={field})" if field in fields else f"(?P<{field}>{FIELDS[field]})"
        text += f"(?:{group}/)?" if field == "dir" and slash else group + slash
        fields.add(field)
    return re.compile(text)
