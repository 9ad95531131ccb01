"""Names of images: patterns that match them, and templates that make the name of one file from another's.

In a pattern `*` stands for any characters, `/` included, and `?` for one; all else is itself, brackets too. A backslash
before `*`, `?` or another backslash makes it stand for itself.

A template is a relative path in which fields stand for parts of an image's path: of "glass/ball.exr" {dir} is "glass",
{name} "ball.exr", {stem} "ball" and {suffix} ".exr".
"""

from __future__ import annotations

import fnmatch
import glob
import re
from collections.abc import Collection, Mapping
from pathlib import PurePosixPath

FIELDS = {"dir": ".+", "name": "[^/]+", "stem": "[^/]+", "suffix": r"\.[^./]+"}
_FIELD = re.compile(r"\{([^{}]*)\}(/?)")  # with the slash behind it


def matches(pattern: str, name: str) -> bool:
    """Whether the whole name matches the pattern."""
    return fnmatch.fnmatchcase(name, _for_fnmatch(pattern))


def _for_fnmatch(pattern: str) -> str:
    """The same pattern for `fnmatch`, where brackets are wild and keep a star from being so."""
    parts = re.findall(r"\\[*?\\]|.", pattern, re.DOTALL)
    return "".join(part if part in "*?" else glob.escape(part[-1]) for part in parts)


def literal(name: str) -> str:
    """The pattern that matches this name alone."""
    return re.sub(r"[*?\\]", r"\\\g<0>", name)


def is_template(text: str, names: Collection[str] = FIELDS) -> bool:
    """Whether it is a relative path that stays in its folder, with no other fields than these."""
    inside = not {"", ".."} & set(text.split("/"))  # an empty part would begin a path at the root
    rest = _FIELD.sub("", text)
    return bool(text.strip()) and inside and fields_of(text) <= set(names) and not set("{}") & set(rest)


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
    parts = re.split(r"(\{[^{}]*\}/?)", template)
    pattern = "".join(glob.escape(filled(x, values)) if x.startswith("{") else _for_fnmatch(x) for x in parts)
    return [name for name in names if fnmatch.fnmatchcase(name, pattern)]


def parsed(template: str, name: str) -> dict[str, str] | None:
    """The values of the template's fields for which it is `name`; None where there are none."""
    text, at, seen = "", 0, set[str]()
    for part in _FIELD.finditer(template):
        field, slash = part.groups()
        group = f"(?P={field})" if field in seen else f"(?P<{field}>{FIELDS[field]})"
        text += re.escape(template[at : part.start()])
        text += f"(?:{group}/)?" if field == "dir" and slash else group + slash
        at = part.end()
        seen.add(field)
    match = re.fullmatch(text + re.escape(template[at:]), name)
    return match and {field: value or "" for field, value in match.groupdict().items()}
