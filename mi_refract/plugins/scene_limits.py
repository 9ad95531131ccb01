"""Limits of a scene's XML, checked before Mitsuba's parser reads it.

Mitsuba's parser is recursive: 10,000 nested elements end the process. Here each file is scanned by a regular expression
whose time is linear in the file's size.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from html import unescape
from pathlib import Path

from mi_refract.io import regular_file

SIZE = 2**26  # bytes of all XML files of a scene, each counted as often as it is included
FILES = 1000  # XML files, counted in the same way
ELEMENTS = 2**20  # XML elements, counted in the same way: seconds for Mitsuba
PARAMETERS = 4096  # Mitsuba's time is quadratic in their number: 34,000 take 8 s
FOLDERS = 100  # of <path> elements: each file that a scene names is looked up in every one
DEPTH = 32  # of nested elements; scenes have up to 10
INCLUDES = 14  # of nested files; Mitsuba's own limit
VALUE = 4096  # characters of the value of a <default>

_ELEMENT = re.compile(rb"""<(/?)([^\s<>"'/]*+)((?:[^"'>]++|"[^"]*+"|'[^']*+')*+)>""")
_ATTRIBUTE = re.compile(rb"""(?<![\w:.-])([\w:.-]++)\s*+=\s*+("[^"]*+"|'[^']*+')""")
_PARAMETER = re.compile(r"(?<!\\)\$(\w{1,64})")
_SKIPPED = {b"<!--": b"-->", b"<![CDATA[": b"]]>", b"<?": b"?>"}


@dataclass
class SceneText:
    """The XML of a scene as Mitsuba's parser will read it: its files, and what they name."""

    parameters: dict[str, str]  # what Mitsuba replaces, by name; the first value counts
    xml: list[Path] = field(default_factory=list)  # the scene's own file first, each as often as it is included
    opened: dict[str, Path] = field(default_factory=dict)  # other files that the parser opens, by their names
    searched: list[Path] = field(default_factory=list)  # the folders of <path> elements
    size: int = 0
    elements: int = 0
    dollars: int = 0  # places where a parameter may be replaced


def check_files(path: Path, folders: Iterable[Path], defines: Mapping[str, str]) -> SceneText:
    """Read a scene file and the files that it includes. A file that is not XML may pass: Mitsuba's error says why.

    Args:
        path: the scene file.
        folders: where Mitsuba looks for the files that a scene names.
        defines: values that replace those of `<default>` elements.

    Raises:
        ValueError: for pipes and devices, and beyond a limit of this module.
        OSError: for a file that cannot be read.
    """
    text = SceneText(dict(defines))
    _read(path, list(folders), text, 0)
    longest = max(map(len, text.parameters.values()), default=0)
    if text.dollars * max(longest, len(text.parameters)) > SIZE:  # Mitsuba tries each parameter at each place
        raise ValueError(f"{path}: parameters expand to more than {SIZE} bytes")
    return text


def _limit(path: Path, count: int, limit: int, what: str) -> None:
    if count > limit:
        raise ValueError(f"{path}: more than {limit} {what}")


def _read(path: Path, folders: list[Path], text: SceneText, depth: int) -> None:
    """Add a file that is included `depth` files deep. `folders`: extended by the file's <path> elements."""
    text.xml.append(path)
    _limit(path, len(text.xml), FILES, "files included")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; expected a scene file")
    content = regular_file.read_bytes(path, SIZE - text.size)
    text.size += len(content)
    text.dollars += content.count(b"$")
    if b"\0" in content:
        raise ValueError(f"{path}: zero bytes; expected XML in UTF-8")
    for element, attributes in _elements(path, content):
        text.elements += 1
        _limit(path, text.elements, ELEMENTS, "XML elements")
        if element not in (b"default", b"path", b"include", b"spectrum"):
            continue
        values = _attributes(attributes, text.parameters)
        places = [path.parent, *folders]
        if element == b"default":
            value = values.get("value", "")
            if len(value) > VALUE:
                raise ValueError(f"{path}: <default>: a value of {len(value)} characters; expected up to {VALUE}")
            text.parameters.setdefault(values.get("name", ""), value)
            _limit(path, len(text.parameters), PARAMETERS, "parameters")
        elif element == b"path":
            text.searched.append(resolved(values.get("value", ""), places))
            folders.insert(0, text.searched[-1])
            _limit(path, len(text.searched), FOLDERS, "<path> elements")
        elif element == b"spectrum" and re.fullmatch(r"[^\s,:]+:[^\s,:]+", values.get("value", "").strip()):
            expected = "a number, or at least two pairs of a wavelength in nm and a value"
            raise ValueError(f"{path}: {values.get('name')} = {values['value']!r}; expected {expected}")
        elif name := values.get("filename"):
            # Mitsuba looks for an included file beside the file that includes it, for a spectrum in <path>s first.
            file = resolved(name, places if element == b"include" else folders)
            refuse_special(file)
            if element == b"spectrum":
                text.opened[name] = file
            elif file.is_file():
                _limit(path, depth + 1, INCLUDES, "files, each included by the one before")
                _read(file, places, text, depth + 1)


def refuse_special(path: Path) -> None:
    """ValueError for a pipe or a device, which may never end. A path that does not exist passes."""
    if path.exists() and not path.is_dir():
        with regular_file.opened(path, sys.maxsize):
            pass


def resolved(name: str, folders: Iterable[Path]) -> Path:
    """The file that a scene names, in the first of the folders that has it; else the name itself."""
    try:
        return next((folder / name for folder in folders if (folder / name).exists()), Path(name))
    except (OSError, ValueError):  # a name that no file can have
        return Path()


def _attributes(text: bytes, parameters: Mapping[str, str]) -> dict[str, str]:
    """The attributes of an element. Of `$name` the longest prefix that is a parameter is replaced, as Mitsuba does."""

    def replace(match: re.Match[str]) -> str:
        names = (match[1][:length] for length in range(len(match[1]), 0, -1))
        name = next((name for name in names if name in parameters), None)
        return match[0] if name is None else parameters[name] + match[1][len(name) :]

    pairs = (
        (name.decode(), unescape(value[1:-1].decode(errors="replace"))) for name, value in _ATTRIBUTE.findall(text)
    )
    return {name: _PARAMETER.sub(replace, value).replace("\\$", "$") for name, value in pairs}


def _elements(path: Path, content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Name and attributes of each element that begins, up to the first place that is not XML.

    Mitsuba's XML parser is lenient (it accepts two hyphens in a comment), so a strict parser cannot be used here.
    """
    depth, place = 0, content.find(b"<")
    while place >= 0:
        if content.startswith(b"<!DOCTYPE", place):
            raise ValueError(f"{path}: DOCTYPE declarations are not allowed")
        if begin := next((begin for begin in _SKIPPED if content.startswith(begin, place)), None):
            end = content.find(_SKIPPED[begin], place + len(begin))
            if end < 0:
                return
        else:
            tag = _ELEMENT.match(content, place)
            if not tag:
                return
            end = tag.end()
            if tag[1]:
                depth -= 1
            else:
                yield tag[2], tag[3]
                depth += not tag[3].endswith(b"/")
            if depth > DEPTH:
                raise ValueError(f"{path}: elements nested more than {DEPTH} deep")
        place = content.find(b"<", end)
