"""The progress of a render, and its checkpoint: a file beside the output from which the same command resumes.

The file begins with a SHA-256 of all the rest, which is written last and checked first. The rest is a line of JSON,
what is rendered and how far, and the sums of every level of the tree of passes as float64. A resumed render has the
same bits as one without interruption.
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

from .pass_sums import ARITY, ARRAYS, Doubles, PassSums, PassTree
from .render_settings import AUTO

Identity = dict[str, Any]  # everything that the bits of a render depend on, by name
FORMAT = 3
_DIGEST = hashlib.sha256().digest_size  # at the start of the file, of all that follows
_HEADER = 2**24  # bytes of its line, at most
# Seconds from the state of one checkpoint to that of the next, unless a pass takes longer. A kill loses as many, and
# those in which the next one is written.
INTERVAL = 25.0
# In an identity:
PASS = "samples of a pass"  # a finished image may be refined with passes of another size
SETTINGS, PILOT = "settings", "pilot"  # the settings, and where a pilot has chosen them its figures


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

    def rebase(self, pass_spp: int) -> None:
        """Make all passes the base; those that follow have so many samples per pixel."""
        base = self.sums()
        with self.lock:
            self.base, self.tree, self.rest = base, PassTree(), None
            self.identity[PASS] = pass_spp

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
    """The progress that a file holds, of an image of H × W × C.

    CheckpointError for a damaged file, for one of a render of another identity, and for what is no file. OSError where
    the file cannot be opened.
    """
    different = ""
    try:
        with opened(path, sys.maxsize) as file:
            digest = file.read(_DIGEST)
            if hashlib.file_digest(file, "sha256").digest() != digest:
                raise ValueError("its digest is another")
            file.seek(_DIGEST)
            header = json.loads(file.readline(_HEADER))
            if header["format"] != FORMAT:
                raise ValueError(f"format {header['format']}")
            different = changes(header["identity"], identity)
            if not different:
                return _progress(file, header, shape)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        text = f"{path}: damaged checkpoint ({type(error).__name__}: {error})"
        raise CheckpointError(f"{text}; pass --restart to start over") from None
    raise CheckpointError(f"{path}: belongs to a different render: {different}; pass --restart to start over")


def _progress(file: BufferedReader, header: dict[str, Any], shape: tuple[int, int, int]) -> Progress:
    """What follows the header. ValueError where it is not what the header and the shape of the image say."""
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
        right = all(type(count) is int for count in (passes, spp, pass_spp)) and 1 <= passes <= spp
        if name in expected:
            right = passes == expected[name] and spp == passes * pass_spp
        elif name == "rest":
            right = passes == 1 <= spp < pass_spp
        if not right:
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
    """What differs between two identities, but for the size of passes, by name; "" where nothing does.

    Settings that a pilot has chosen are those that AUTO asks for.
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
    """Writes a render's progress to its checkpoint, while `active`: as long as the render holds its output's lock."""

    def __init__(self, output: Path, progress: Progress, warnings: list[str]) -> None:
        """A checkpoint that cannot be written is a warning."""
        self.path, self.progress, self.warnings = path_of(output), progress, warnings
        self.active, self.interval = False, INTERVAL
        self._last, self._passes_before = time.monotonic(), progress.passes
        self._thread: threading.Thread | None = None

    def write(self) -> None:
        """Write what is new, if anything is."""
        with self.progress.lock:
            if not self.active or self.progress.passes == self._passes_before:
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
        """Wait until no checkpoint is being written."""
        if self._thread is not None:
            self._thread.join()
            self._thread = None
