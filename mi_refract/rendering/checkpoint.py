"""The progress of a render, and its checkpoint: a file beside the output from which the same command resumes.

The file is an uncompressed `.npz`, whose checksums reveal truncation and damage. It holds the sums of every level of
the tree of passes, and as JSON what is rendered. A resumed render has the same bits as one without interruption.
"""

from __future__ import annotations

import json
import struct
import threading
import time
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io.errors import CheckpointError
from mi_refract.io.safe_files import replacing

from .pass_sums import ARRAYS, PassSums, PassTree

Identity = dict[str, Any]  # everything that the bits of a render depend on, by name
FORMAT = 2
# Seconds from the state of one checkpoint to that of the next, unless a pass takes longer. A kill loses as many, and
# those in which the next one is written.
INTERVAL = 25.0
PASS = "samples of a pass"  # in an identity: a finished image may be refined with passes of another size
# What NumPy, zipfile and json raise for a file with wrong bits; OSError: a seek beyond its end.
_DAMAGE = (
    *(ValueError, LookupError, TypeError, AttributeError, RuntimeError, EOFError, OSError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)


@dataclass
class Progress:
    """What a render has: `base`, an older image that it refines, the `tree` of its passes, and `rest`.

    `identity`: everything that the bits depend on. `rest`: the last pass, where it has fewer samples than the others.
    `seconds`: of rendering; `machines`: where. `lock` is held where any of it changes or is written.
    """

    identity: Identity
    tree: PassTree = field(default_factory=PassTree)
    base: PassSums | None = None
    rest: PassSums | None = None
    seconds: float = 0.0
    machines: set[str] = field(default_factory=set)
    lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @property
    def first(self) -> int:
        """The number of the first pass of the tree: how many passes the base has."""
        return self.base.passes if self.base else 0

    @property
    def passes(self) -> int:
        """Passes that are done, those of the base included."""
        return self.first + self.tree.passes + (self.rest is not None)

    @property
    def done(self) -> int:
        """Samples per pixel that are done."""
        return sum(sums.spp for sums in (self.base, *self.tree.levels, self.rest) if sums is not None)

    def add(self, level: int, sums: PassSums, machines: str, seconds: float, *, rest: bool) -> None:
        """Add a node of passes, rendered on `machines` ("a, b"); `rest`: it is the last pass, of fewer samples."""
        with self.lock:
            if rest:
                self.rest = sums
            else:
                self.tree.add(sums, level)
            self.seconds += seconds
            self.machines.update(machines.split(", "))

    def sums(self) -> PassSums | None:
        """The sums of all passes, in memory of their own; None before the first pass."""
        with self.lock:
            total = self.base.copy() if self.base else None
            for sums in (self.tree.sums(), self.rest):
                if total is not None and sums is not None:
                    total.add(sums)
                elif sums is not None:
                    total = sums.copy()
            return total


def path_of(output: Path) -> Path:
    """The checkpoint of a render into this file."""
    return output.with_name(f"{output.name}.checkpoint")


def write(path: Path, progress: Progress) -> None:
    """Replace the file, complete or not at all. OSError as the system raises it; the old file stays then."""
    named = {"base": progress.base, "rest": progress.rest}
    named |= {f"level{i}": sums for i, sums in enumerate(progress.tree.levels)}
    nodes = {name: sums for name, sums in named.items() if sums is not None}
    scalars = ("spp", "passes", "contrasts", "colours")
    header = {
        "format": FORMAT,
        "identity": progress.identity,
        "passes": progress.tree.passes,
        "counts": progress.tree.counts,
        "seconds": progress.seconds,
        "machines": sorted(progress.machines),
        "nodes": {name: {key: getattr(sums, key) for key in scalars} for name, sums in nodes.items()},
    }
    arrays: dict[str, Any] = {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    for name, sums in nodes.items():
        arrays |= {f"{name}.{kind}": array for kind in ARRAYS if (array := getattr(sums, kind)) is not None}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def read(path: Path, identity: Identity) -> Progress:
    """The progress that a file holds. CheckpointError for a damaged file, and for one of a render of another identity.

    OSError where the file cannot be opened.
    """
    path.stat()
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            header = json.loads(bytes(file["header"]))
            if header["format"] != FORMAT:
                raise ValueError(f"format {header['format']}")
            different = changes(header["identity"], identity)
            nodes = {
                name: PassSums(**scalars, **{k: file[f"{name}.{k}"] for k in ARRAYS if f"{name}.{k}" in file})
                for name, scalars in header["nodes"].items()
            }
            tree = PassTree()
            tree.passes, tree.counts = header["passes"], header["counts"]
            tree.levels = [nodes.get(f"level{i}") for i in range(len(tree.counts))]
            progress = Progress(header["identity"], tree, nodes.get("base"), nodes.get("rest"))
            progress.seconds, progress.machines = float(header["seconds"]), {str(m) for m in header["machines"]}
    except _DAMAGE as error:
        raise CheckpointError(
            f"{path}: damaged checkpoint ({type(error).__name__}); pass --restart to start over"
        ) from None
    if different:
        raise CheckpointError(f"{path}: belongs to a different render: {different}; pass --restart to start over")
    return progress


def changes(before: Identity, now: Identity) -> str:
    """What differs between two identities, but for the size of passes, by name; "" where nothing does."""
    texts = []
    for name in {**before, **now}.keys() - {PASS}:
        if before.get(name) != now.get(name):
            changed = f"{name} was {before.get(name)}, is {now.get(name)}"
            texts.append("the scene has changed" if name == "scene" else changed)
    return ", ".join(sorted(texts))


class CheckpointWriter:
    """Writes a render's progress to its checkpoint, while `active`: as long as the render holds its output's lock."""

    def __init__(self, output: Path, progress: Progress, warnings: list[str]) -> None:
        """A checkpoint that cannot be written is a warning."""
        self.path, self.progress, self.warnings = path_of(output), progress, warnings
        self.active, self.interval = False, INTERVAL
        self._last = time.monotonic()
        self._thread: threading.Thread | None = None

    def write(self) -> None:
        """Write what is new, if anything is."""
        with self.progress.lock:
            if not self.active or not (self.progress.tree.passes or self.progress.rest):
                return
            try:
                write(self.path, self.progress)
            except OSError as error:
                reason = error.strerror or error
                self.warnings.append(f"{self.path}: checkpoint not written: {reason}; will be tried again")

    def write_when_due(self, took: float) -> None:
        """Write beside the next pass, if the last checkpoint would be too old after it. `took`: seconds of a pass."""
        self.wait()
        if time.monotonic() - self._last + took > self.interval:
            self._last = time.monotonic()
            self._thread = threading.Thread(target=self.write, name="checkpoint")
            self._thread.start()

    def wait(self) -> None:
        """Until no checkpoint is being written."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
