"""The reference pack that `python -m validation pack` writes: its index, and the check that its files are unchanged.

An unpacked pack is a folder with the file INDEX, which contains the SHA-256 of every other file except SUMS. SUMS
contains the same digests for `sha256sum --check`, and that of INDEX, which identifies the pack.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from mi_refract import __version__

from . import safe_files
from .typed_table import convert, doc

INDEX, SUMS = "mi-refract-pack.json", "SHA256SUMS"
FORMAT: Literal["mi_refract pack 1"] = "mi_refract pack 1"
MOST = 2**24  # bytes of INDEX and of SUMS
EXPECTED = "expected the pack as it was published"

Digest = Annotated[str, Meta(pattern="^[0-9a-f]{64}$", description="SHA-256")]


class PackedFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file of a pack."""

    sha256: Digest
    content: Annotated[str, doc("description of the content")]
    schema: Annotated[str, doc("for a JSON file: the file with its JSON Schema")] = ""


class PackIndex(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of INDEX."""

    format: Annotated[Literal["mi_refract pack 1"], doc("the format, and its version")]
    version: Annotated[str, doc("version of mi_refract that wrote the pack")]
    quick: Annotated[bool, doc("made with --quick: few rays, small images")]
    made_with: Annotated[dict[str, str], doc("versions and settings that the bytes depend on, by name")]
    files: Annotated[dict[str, PackedFile], doc("all other files except SHA256SUMS, by path with slashes")]


class PackReference(msgspec.Struct, frozen=True):
    """The pack of the references, as results name it."""

    version: Annotated[str, doc("version of mi_refract that wrote the pack")]
    sha256: Annotated[Digest, doc(f"SHA-256 of the pack's {INDEX}, which contains that of every file")]
    path: Annotated[str, doc("path of the references in the pack")]


class Origin(msgspec.Struct, frozen=True, kw_only=True):
    """The origin of a file of results, so that a published result can be repeated."""

    version: Annotated[str, doc("version of mi_refract that wrote this")]
    command: Annotated[str, doc("the command line that wrote this")]
    pack: Annotated[PackReference | None, doc("the pack that contains the references; null: none")]


def origin(words: Sequence[str], pack: PackReference | None) -> Origin:
    """Return the origin of results that this version of `mi-refract` writes with these arguments."""
    return Origin(version=__version__, command=shlex.join(["mi-refract", *words]), pack=pack)


def sums(index: bytes, files: dict[str, PackedFile]) -> str:
    """Return the text of SUMS for an index with these bytes and files."""
    digests = {name: file.sha256 for name, file in files.items()} | {INDEX: hashlib.sha256(index).hexdigest()}
    return "".join(f"{digest}  {name}\n" for name, digest in sorted(digests.items()))


def of_references(reference: Path, answers: Path | None = None) -> PackReference | None:
    """Return the pack that contains a file or folder of references; None if no pack does.

    Every file of the pack is read. ValueError, one line, if a file is missing, damaged or edited, if the pack has
    another format, if a reference is not a file of the pack, or if `answers` are in a folder with the INDEX of another
    pack. OSError if a file cannot be read.
    """
    # A link inside a pack is a file of that pack. A path with `..` is only where it leads.
    places = [place for place in (reference.absolute(), reference.resolve()) if ".." not in place.parts]
    packs = ((place, folder) for place in places for folder in (place, *place.parents) if _is_pack(folder))
    place, root = next(packs, (None, None))
    if place is None or root is None:
        return None
    path = root / INDEX
    if not path.is_file():
        raise ValueError(f"{path}: missing, or not a file; {EXPECTED}")
    text = safe_files.read_bytes(path, MOST)
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError(f"{path}: damaged: not JSON; {EXPECTED}") from None
    format_name = data.get("format") if isinstance(data, dict) else None
    if format_name != FORMAT:
        raise ValueError(f"{path}: a pack of another version: format {str(format_name)[:60]!r}; expected {FORMAT!r}")
    index = convert(data, PackIndex, str(path))
    for name, file in index.files.items():
        if not (root / name).is_file():
            raise ValueError(f"{root / name}: missing, or not a file; {EXPECTED}")
        if safe_files.digest(root / name) != file.sha256:
            raise ValueError(f"{root / name}: damaged or edited: its SHA-256 is not that of {INDEX}; {EXPECTED}")
    if safe_files.read_bytes(root / SUMS, MOST) != sums(text, index.files).encode():
        raise ValueError(f"{root / SUMS}: not the digests of {INDEX}: one of the two was edited; {EXPECTED}")
    for entry in [place] if place.is_file() else sorted(place.rglob("*")):
        name = entry.relative_to(root).as_posix()
        if entry.is_file() and name not in {*index.files, INDEX, SUMS}:
            raise ValueError(f"{entry}: not a file of the pack {root}; expected answers in another folder")
    for folder in (answers.resolve(), *answers.resolve().parents) if answers else ():
        if (folder / INDEX).is_file():
            if safe_files.read_bytes(folder / INDEX, MOST) != text:
                raise ValueError(f"{answers}: answers to another pack: {folder / INDEX} differs from {path}")
            break
    return PackReference(index.version, hashlib.sha256(text).hexdigest(), place.relative_to(root).as_posix())


def _is_pack(folder: Path) -> bool:
    """Return whether the folder has SUMS that name an INDEX. An INDEX alone is beside answers to that pack."""
    if not (folder / SUMS).is_file():
        return False
    with (folder / SUMS).open("rb") as file:
        return INDEX.encode() in file.read(MOST)
