"""Names of images: patterns that match names, and templates that form the path of one file from that of another.

In a pattern, `*` matches any characters, `/` included, and `?` matches one character; all others match themselves,
brackets too. A backslash before `*`, `?` or a backslash makes that character literal.

A template is a relative path with fields for parts of an image's path: for "glass/ball.exr", {dir} is "glass", {name}
is "ball.exr", {stem} is "ball" and {suffix} is ".exr".
"""

from __future__ import annotations

import fnmatch
import glob
import re
from collections.abc import Collection, Mapping
from pathlib import PurePosixPath

FIELDS = {"dir": ".+", "name": "[^/]+", "stem": "[^/]+", "suffix": r"\.[^./]+"}
_FIELD = re.compile(r"\{([^{}]*)\}(/?)")  # with the slash after it


def matches(pattern: str, name: str) -> bool:
    """Return whether the whole name matches the pattern."""
    return fnmatch.fnmatchcase(name, _for_fnmatch(pattern))


def _for_fnmatch(pattern: str) -> str:
    """Return the same pattern for `fnmatch`, in which brackets are special and no backslash escapes."""
    parts = re.findall(r"\\[*?\\]|.", pattern, re.DOTALL)
    return "".join(part if part in "*?" else glob.escape(part[-1]) for part in parts)


def literal(name: str) -> str:
    """Return the pattern that matches this name only."""
    return re.sub(r"[*?\\]", r"\\\g<0>", name)


def is_template(text: str, names: Collection[str] = FIELDS) -> bool:
    """Return whether the text is a relative path inside its folder, with fields of these names only."""
    is_inside = not {"", ".."} & set(text.split("/"))  # an empty first part would be an absolute path
    rest = _FIELD.sub("", text)
    return bool(text.strip()) and is_inside and fields_of(text) <= set(names) and not set("{}") & set(rest)


def fields(name: str) -> dict[str, str]:
    """Return the values of all fields for an image's path; {dir} is empty for an image that is in no subfolder."""
    path = PurePosixPath(name)
    folder = path.parent.as_posix()
    return {"dir": "" if folder == "." else folder, "name": path.name, "stem": path.stem, "suffix": path.suffix}


def fields_of(template: str) -> frozenset[str]:
    """Return the names of the fields in a template."""
    return frozenset(field for field, _ in _FIELD.findall(template))


def filled(template: str, values: Mapping[str, str]) -> str:
    """Return the template with the values in place of its fields; an empty value also removes the slash after it."""

    def value_and_slash(match: re.Match[str]) -> str:
        value, slash = values[match[1]], match[2]
        return value + slash if value else ""

    return _FIELD.sub(value_and_slash, template)


def expanded(template: str, values: Mapping[str, str], names: list[str]) -> list[str]:
    """Return the names that match the filled template; `*` and `?` are special in the template, not in the values.

    They match no `/`, other than in `matches`.
    """
    parts = re.split(r"(\{[^{}]*\}/?)", template)
    pattern = "".join(glob.escape(filled(x, values)) if x.startswith("{") else _for_fnmatch(x) for x in parts)
    in_its_folder = [name for name in names if name.count("/") == pattern.count("/")]
    return [name for name in in_its_folder if fnmatch.fnmatchcase(name, pattern)]


def parsed(template: str, name: str) -> dict[str, str] | None:
    """Return the values of the template's fields for which the filled template is `name`; None if there are none."""
    pattern, end, earlier = "", 0, set[str]()
    for part in _FIELD.finditer(template):
        field, slash = part.groups()
        group = f"(?P<{field}>{FIELDS[field]})"
        pattern += re.escape(template[end : part.start()])
        if field in earlier:  # the same value; none if the first is empty
            pattern += f"(?({field})(?P={field}){slash})"
        else:
            pattern += f"(?:{group}/)?" if field == "dir" and slash else group + slash
        end = part.end()
        earlier.add(field)
    match = re.fullmatch(pattern + re.escape(template[end:]), name)
    return match and {field: value or "" for field, value in match.groupdict().items()}
