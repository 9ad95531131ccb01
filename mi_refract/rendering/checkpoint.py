"""The progress of a render, and its checkpoint: a file beside the output from which the same command resumes.

The file contains, in this order: the SHA-256 of all that follows, which is written last and checked first; a line of
JSON with the render's identity and progress; the sums of every level of the tree of passes as float64. A resumed render
has the same bits as one without interruption.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
import threading
import time
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np

from mi_refract.io.errors import CheckpointError
from mi_refract.io.safe_files import opened, replacing

from .pass_sums import ARITY, ARRAYS, Doubles, PassSums, PassTree, added
from .render_settings import AUTO

Identity = dict[str, Any]  # everything that the bits of a render depend on, by name
FORMAT = 3
_DIGEST = hashlib.sha256().digest_size  # bytes at the start of the file
_HEADER = 2**24  # bytes of the line of JSON, at most
# Seconds from the state of one checkpoint to that of the next, unless a pass takes longer. A kill loses at most this
# time and that of writing the next checkpoint.
INTERVAL = 25.0
# Names in an identity:
PASS = "samples of a pass"  # a finished image may be refined with passes of another size
SETTINGS, PILOT = "settings", "pilot"  # the settings, and the figures of the pilot if one has chosen them


@dataclass
class Progress:
    """The passes that a render has finished.

    `identity`: everything that the bits depend on. `base`: sums of a finished image that the render refines. `tree`:
    sums of the passes after it. `rest`: the last pass, if it has fewer samples than the others. `seconds`: time of
    rendering. `machines`: where the passes were rendered. `lock` is held while any of these changes or is written.
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
        """The number of the first pass of the tree, which is the number of passes in the base."""
        return self.base.passes if self.base else 0

    @property
    def passes(self) -> int:
        """Number of finished passes, including those of the base."""
        return self.first + self.tree.passes + (self.rest is not None)

    @property
    def done(self) -> int:
        """Samples per pixel of all finished passes."""
        return sum(sums.spp for sums in (self.base, *self.tree.levels, self.rest) if sums is not None)

    def add(self, level: int, sums: PassSums, machines: str, seconds: float, *, rest: bool) -> None:
        """Add a node of passes, rendered on `machines` ("a, b"). `rest`: it is the last pass, of fewer samples."""
        with self.lock:
            if rest:
                self.rest = sums
            else:
                self.tree.add(sums, level)
            self.seconds += seconds
            self.machines.update(machines.split(", "))

    def rebase(self, pass_spp: int) -> None:
        """Move all passes to the base. The next passes have `pass_spp` samples per pixel each."""
        base = self.sums()
        with self.lock:
            self.base, self.tree, self.rest = base, PassTree(), None
            self.identity[PASS] = pass_spp

    def sums(self) -> PassSums | None:
        """Return the sums of all passes, which share no memory with this object; None before the first pass."""
        with self.lock:
            return added((self.base, self.tree.sums(), self.rest))


def path_of(output: Path) -> Path:
    """Return the path of the checkpoint of a render into this file."""
    return output.with_name(f"{output.name}.checkpoint")


def write(path: Path, progress: Progress) -> None:
    """Replace the file by a complete one. On an OSError the old file stays."""
    all_nodes = {"base": progress.base, "rest": progress.rest}
    all_nodes |= {f"level{i}": sums for i, sums in enumerate(progress.tree.levels)}
    nodes = {name: sums for name, sums in all_nodes.items() if sums is not None}
    header = {
        "format": FORMAT,
        "identity": progress.identity,
        "counts": progress.tree.counts,
        "seconds": progress.seconds,
        "machines": sorted(progress.machines),
        "nodes": {
            name: [sums.spp, sums.passes, [kind for kind in ARRAYS if getattr(sums, kind) is not None]]
            for name, sums in nodes.items()
        },
    }
    with replacing(path) as temporary, temporary.open("w+b") as file:
        file.write(bytes(_DIGEST) + json.dumps(header).encode() + b"\n")
        for sums in nodes.values():
            for array in (*(getattr(sums, kind) for kind in ARRAYS), sums.contrasts):
                if array is not None:
                    file.write(np.ascontiguousarray(array, np.float64).data)
        file.seek(_DIGEST)
        digest = hashlib.file_digest(file, "sha256").digest()
        file.seek(0)
        file.write(digest)


def read(path: Path, identity: Identity, shape: tuple[int, int, int]) -> Progress:
    """Return the progress in a checkpoint of an image of H × W × C.

    CheckpointError for a damaged file, for a render of another identity, and for a path that is no file. OSError if the
    file cannot be opened.
    """
    try:
        with opened(path, sys.maxsize) as file:
            digest = file.read(_DIGEST)
            if hashlib.file_digest(file, "sha256").digest() != digest:
                raise ValueError("its digest does not match")
            file.seek(_DIGEST)
            header = json.loads(file.readline(_HEADER))
            if header["format"] != FORMAT:
                raise ValueError(f"format {header['format']}")
            if not (differences := changes(header["identity"], identity)):
                return _progress(file, header, shape)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        text = f"{path}: damaged checkpoint ({type(error).__name__}: {error})"
        raise CheckpointError(f"{text}; pass --restart to start over") from None
    raise CheckpointError(f"{path}: belongs to a different render: {differences}; pass --restart to start over")


def _progress(file: BufferedReader, header: dict[str, Any], shape: tuple[int, int, int]) -> Progress:
    """Read and return what follows the header. ValueError if it does not match the header or the image's shape."""
    identity, counts, nodes = header["identity"], header["counts"], header["nodes"]
    progress = Progress(identity, seconds=float(header["seconds"]), machines={str(name) for name in header["machines"]})
    size, pass_spp = os.fstat(file.fileno()).st_size, identity[PASS]
    expected = {f"level{i}": count * ARITY**i for i, count in enumerate(counts) if count}
    if set(nodes) - {"base", "rest"} != set(expected) or not all(0 <= count < ARITY for count in counts):
        raise ValueError(f"sums of {', '.join(nodes)}; expected {', '.join(expected)}")

    def doubles(*shape: int) -> Doubles:
        if 8 * math.prod(shape) > size - file.tell():
            raise ValueError(f"{size} bytes; expected more")
        array = np.empty(shape)
        file.readinto(array.data.cast("B"))
        return array

    sums: dict[str, PassSums] = {}
    for name, (spp, passes, kinds) in nodes.items():
        valid = all(type(count) is int for count in (passes, spp, pass_spp)) and 1 <= passes <= spp
        if name in expected:
            valid = passes == expected[name] and spp == passes * pass_spp
        elif name == "rest":
            valid = passes == 1 <= spp < pass_spp
        if not valid:
            raise ValueError(f"{name}: {passes} passes of {spp} samples per pixel")
        arrays = {kind: doubles(*shape[:2], 1 if kind == "weights" else shape[2]) for kind in ARRAYS if kind in kinds}
        contrasts = doubles(passes - 1).tolist()
        sums[name] = PassSums(spp, passes, **arrays, contrasts=contrasts, colours=identity["colours"])
    if file.tell() != size:
        raise ValueError(f"{size} bytes; expected {file.tell()}")
    progress.base, progress.rest = sums.get("base"), sums.get("rest")
    tree = progress.tree
    tree.counts, tree.passes = counts, sum(expected.values())
    tree.levels = [sums.get(f"level{i}") for i in range(len(counts))]
    return progress


def changes(before: Identity, now: Identity) -> str:
    """Return the differences between two identities, except the size of passes; "" if there are none.

    AUTO equals settings that a pilot has chosen.
    """
    texts = []
    if now.get(SETTINGS) == AUTO and PILOT in before:
        now = {**now, SETTINGS: before[SETTINGS]}
    for name in {**before, **now}.keys() - {PASS, PILOT}:
        if before.get(name) != now.get(name):
            changed = f"{name} was {before.get(name)}, is {now.get(name)}"
            texts.append("the scene has changed" if name == "scene" else changed)
    return ", ".join(sorted(texts))


class CheckpointWriter:
    """Writes a render's progress to its checkpoint while `active`, which is as long as the render holds its lock."""

    def __init__(self, output: Path, progress: Progress, warnings: list[str]) -> None:
        """`output`: of the render. `warnings`: receives a line whenever a checkpoint cannot be written."""
        self.path, self.progress, self.warnings = path_of(output), progress, warnings
        self.active, self.interval = False, INTERVAL
        self._last, self._passes_written = time.monotonic(), progress.passes
        self._thread: threading.Thread | None = None

    def write(self) -> None:
        """Write the checkpoint if there are new passes."""
        with self.progress.lock:
            if not self.active or self.progress.passes == self._passes_written:
                return
            try:
                write(self.path, self.progress)
                self._passes_written = self.progress.passes
            except OSError as error:
                reason = error.strerror or error
                self.warnings.append(f"{self.path}: checkpoint not written: {reason}; will be tried again")

    def write_when_due(self, took: float) -> None:
        """Write in a thread if the last checkpoint would be too old after the next pass. `took`: seconds of a pass."""
        self.wait()
        if time.monotonic() - self._last + took > self.interval:
            self._last = time.monotonic()
            self._thread = threading.Thread(target=self.write, name="checkpoint")
            self._thread.start()

    def wait(self) -> None:
        """Wait until no checkpoint is being written."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
