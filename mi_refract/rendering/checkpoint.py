"""What a render has so far, in a file beside its output: a render that was ended goes on from it, with the same bits.

The file is an uncompressed `.npz`, whose checksums tell a truncated or damaged one. It holds the sums of every level of
the tree of passes, and as JSON what is rendered.
"""

from __future__ import annotations

import json
import struct
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io.atomic import replacing
from mi_refract.io.errors import CheckpointError

from .identity import apart_from_passes, changed
from .pass_sums import ARRAYS, PassSums, PassTree

FORMAT = 2
# What NumPy, zipfile and json raise for a file with wrong bits; OSError: a seek to where it has nothing.
_OF_PYTHON = (ValueError, LookupError, TypeError, AttributeError, RuntimeError, EOFError, OSError)
_DAMAGE = (*_OF_PYTHON, zipfile.BadZipFile, zlib.error, struct.error)


@dataclass
class Progress:
    """A render so far: `base` is an older image that it goes on from; `passes` counts the base's as well."""

    identity: dict[str, Any]
    tree: PassTree = field(default_factory=PassTree)
    base: PassSums | None = None
    rest: PassSums | None = None  # the last pass, where it has fewer samples than the others
    seconds: float = 0.0
    machines: list[str] = field(default_factory=list)
    base_ended_by: str = ""  # what ended the render of the base

    @property
    def first(self) -> int:
        """The number of the first pass of the tree."""
        return self.base.passes if self.base else 0

    @property
    def passes(self) -> int:
        """Passes that are done."""
        return self.first + self.tree.passes + (self.rest is not None)

    @property
    def done(self) -> int:
        """Samples per pixel that are done."""
        return sum(each.spp for each in (self.base, *self.tree.levels, self.rest) if each is not None)

    def sums(self) -> PassSums | None:
        """The sums of all that is done; None where that is nothing."""
        found = self.base.copy() if self.base else None
        for each in (self.tree.sums(), self.rest):
            if each is not None and found is not None:
                found.add(each)
            elif each is not None:
                found = each.copy()
        return found


def path_of(output: Path) -> Path:
    """The checkpoint of a render into this file."""
    return output.with_name(f"{output.name}.checkpoint")


def write(path: Path, progress: Progress) -> None:
    """Replace the file, complete or not at all. OSError as the system raises it; the old one stays then."""
    nodes = {"base": progress.base, "rest": progress.rest} | {
        f"level{i}": sums for i, sums in enumerate(progress.tree.levels)
    }
    header = {
        "format": FORMAT,
        "identity": progress.identity,
        "passes": progress.tree.passes,
        "counts": progress.tree.counts,
        "seconds": progress.seconds,
        "machines": progress.machines,
        "nodes": {name: _figures(sums) for name, sums in nodes.items() if sums is not None},
    }
    arrays = {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    for name, sums in nodes.items():
        for kind in ARRAYS if sums is not None else ():
            if (array := getattr(sums, kind)) is not None:
                arrays[f"{name}.{kind}"] = array
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _figures(sums: PassSums) -> dict[str, Any]:
    return {"spp": sums.spp, "passes": sums.passes, "contrasts": sums.contrasts, "colours": sums.colours}


def read(path: Path, identity: dict[str, Any]) -> Progress:
    """The render that a file holds. ValueError, one line, for a damaged file, and for one of another render."""
    path.stat()  # whatever fails below, the file is there
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            header = json.loads(bytes(file["header"]))
            if header["format"] != FORMAT:
                raise ValueError(f"format {header['format']}")
            different = changed(apart_from_passes(header["identity"]), identity)
            nodes = {
                name: PassSums(**figures, **{k: file[f"{name}.{k}"] for k in ARRAYS if f"{name}.{k}" in file})
                for name, figures in header["nodes"].items()
            }
            tree = PassTree()
            tree.passes, tree.counts = header["passes"], header["counts"]
            tree.levels = [nodes.get(f"level{i}") for i in range(len(tree.counts))]
            found = Progress(
                header["identity"],
                tree,
                nodes.get("base"),
                nodes.get("rest"),
                float(header["seconds"]),
                [str(m) for m in header["machines"]],
            )
    except _DAMAGE as error:
        what = f"{path}: is no complete checkpoint ({type(error).__name__})"
        raise CheckpointError(f"{what}; expected one that is, or --restart to start over") from None
    if different:
        raise CheckpointError(f"{path}: belongs to a different render: {different}; pass --restart to start over")
    return found
