"""Limits of a scene's XML, checked before Mitsuba's parser sees it, and of the nodes that the parser makes of it.

Mitsuba's parser calls itself for each element inside another one: 10,000 of them end the process, and so do long chains
of references. Each of two references to a BSDF doubles the lobes of what holds them.
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
FILES = 1000  # XML files, counted so, too
ELEMENTS = 2**20  # XML elements, counted so, too: seconds for Mitsuba
PARAMETERS = 4096  # Mitsuba's time grows as their square: 34,000 take 8 s
FOLDERS = 100  # of <path> elements: each file that a scene names is looked for in every one
DEPTH = 32  # of elements in elements, and of nodes that refer to nodes; scenes have up to 10
INCLUDES = 14  # of files in files; Mitsuba's own limit
VALUE = 4096  # characters of the value of a <default>
VALUES = 2**29  # of an image that a scene names: 16384 × 8192 × 4
# More values than these and DENSEST for each byte of the file are no picture: deflate packs up to 1032 bytes into one.
FEW_VALUES, DENSEST = 2**24, 1032
LOBES = 2**16  # of a BSDF, if every BSDF in it were two-sided

_ELEMENT = re.compile(rb"""<(/?)([^\s<>"'/]*+)((?:[^"'>]++|"[^"]*+"|'[^']*+')*+)>""")
_ATTRIBUTE = re.compile(rb"""(?<![\w:.-])([\w:.-]++)\s*+=\s*+("[^"]*+"|'[^']*+')""")
_PARAMETER = re.compile(r"(?<!\\)\$(\w{1,64})")
_SKIPPED = {b"<!--": b"-->", b"<![CDATA[": b"]]>", b"<?": b"?>"}
_OPENED = {b"include", b"spectrum"}  # elements that name a file which the parser opens


@dataclass
class Walk:
    """What was seen of a scene so far. `parameters`: what Mitsuba replaces, by name; the first value counts.

    `xml`: the files, the scene's own first; `opened`: files that the parser opens besides, by their names in the scene;
    `searched`: the folders of <path> elements.
    """

    parameters: dict[str, str]
    xml: list[Path] = field(default_factory=list)
    opened: dict[str, Path] = field(default_factory=dict)
    searched: list[Path] = field(default_factory=list)
    size: int = 0
    files: int = 0
    elements: int = 0
    folders: int = 0
    dollars: int = 0


def check_files(path: Path, folders: Iterable[Path], defines: Mapping[str, str]) -> Walk:
    """What was seen of a scene file and of those that it includes.

    ValueError where one is not a regular file, too large, or nested too deeply. `folders`: where Mitsuba looks for what
    a scene names. OSError for a file that cannot be read. A file that is no XML may pass: Mitsuba says better what is
    wrong with it.
    """
    walk = Walk(dict(defines))
    _walk_file(path, list(folders), walk, 0)
    longest = max(map(len, walk.parameters.values()), default=0)
    if walk.dollars * max(longest, len(walk.parameters)) > SIZE:  # Mitsuba tries each parameter at each place
        raise ValueError(f"{path}: parameters expand to more than {SIZE} bytes")
    return walk


def _refuse_more(path: Path, count: int, limit: int, what: str) -> None:
    if count > limit:
        raise ValueError(f"{path}: more than {limit} {what}")


def _walk_file(path: Path, folders: list[Path], walk: Walk, depth: int) -> None:
    walk.files += 1
    walk.xml.append(path)
    _refuse_more(path, walk.files, FILES, "files included")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; expected a scene file")
    content = regular_file.read_bytes(path, SIZE - walk.size)
    walk.size += len(content)
    walk.dollars += content.count(b"$")
    if b"\0" in content:
        raise ValueError(f"{path}: zero bytes; expected XML in UTF-8")
    for name, text in _elements(path, content):
        walk.elements += 1
        _refuse_more(path, walk.elements, ELEMENTS, "XML elements")
        if name in (b"default", b"path", *_OPENED):
            _follow(name, _attributes(text, walk.parameters), path, folders, walk, depth)


def _follow(name: bytes, values: Mapping[str, str], path: Path, folders: list[Path], walk: Walk, depth: int) -> None:
    """Do what Mitsuba does at a <default>, <path>, <include> or <spectrum>."""
    if name == b"default":
        value = values.get("value", "")
        if len(value) > VALUE:
            raise ValueError(f"{path}: <default>: a value of {len(value)} characters; expected up to {VALUE}")
        walk.parameters.setdefault(values.get("name", ""), value)
        _refuse_more(path, len(walk.parameters), PARAMETERS, "parameters")
    elif name == b"path":
        walk.folders += 1
        _refuse_more(path, walk.folders, FOLDERS, "<path> elements")
        walk.searched.append(resolved(values.get("value", ""), [path.parent, *folders]))
        folders.insert(0, walk.searched[-1])
    elif name == b"spectrum" and re.fullmatch(r"[^\s,:]+:[^\s,:]+", values.get("value", "").strip()):
        accepted = "a number, or two pairs and more of a wavelength in nm and a value"
        raise ValueError(f"{path}: {values.get('name')} = {values['value']!r}; expected {accepted}")
    elif values.get("filename"):
        found = resolved(values["filename"], [path.parent, *folders])
        refuse_special(found)
        if name == b"spectrum":
            walk.opened[values["filename"]] = found
        elif found.is_file():
            _refuse_more(path, depth + 1, INCLUDES, "files, each included by the one before")
            _walk_file(found, [path.parent, *folders], walk, depth + 1)


def refuse_special(path: Path) -> None:
    """ValueError for a pipe or a device, which may never end. Whether the path exists at all is left to others."""
    if path.exists() and not path.is_dir():
        with regular_file.opened(path, sys.maxsize):
            pass


def resolved(name: str, folders: Iterable[Path]) -> Path:
    """The file that a scene names, in the first of the folders that has one; the name itself where none has."""
    try:
        return next((folder / name for folder in folders if (folder / name).exists()), Path(name))
    except (OSError, ValueError):  # a name that no file can have
        return Path()


def _attributes(text: bytes, parameters: Mapping[str, str]) -> dict[str, str]:
    """The attributes of an element; parameters replaced, the longest name that fits, as Mitsuba does."""

    def value(match: re.Match[str]) -> str:
        names = (match[1][:length] for length in range(len(match[1]), 0, -1))
        name = next((name for name in names if name in parameters), None)
        return match[0] if name is None else parameters[name] + match[1][len(name) :]

    pairs = ((name.decode(), unescape(text[1:-1].decode(errors="replace"))) for name, text in _ATTRIBUTE.findall(text))
    return {name: _PARAMETER.sub(value, text).replace("\\$", "$") for name, text in pairs}


def _elements(path: Path, content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Name and attributes of each element that begins; up to the first place that is no XML.

    Mitsuba's XML parser is lenient (two hyphens in a comment, for one), so that a strict one cannot take its place.
    """
    depth, place = 0, content.find(b"<")
    while place >= 0:
        if content.startswith(b"<!DOCTYPE", place):
            raise ValueError(f"{path}: DOCTYPE declarations are not allowed")
        begin = next((begin for begin in _SKIPPED if content.startswith(begin, place)), None)
        if begin:
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
