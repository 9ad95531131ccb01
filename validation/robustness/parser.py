"""What a parser of ours is to the fuzzer."""

from __future__ import annotations

import io
import random
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .mutate import mutated, mutated_xml


@dataclass(frozen=True)
class Parser:
    """A good input, and `read`: of a bad one it raises one line, or returns what is wrong with accepting it, or ""."""

    suffix: str
    good: tuple[bytes, ...]
    read: Callable[[Path], str]
    head: int | None = None

    def mutation(self, rng: random.Random) -> bytes:
        """A bad input."""
        good = rng.choice(self.good)
        if self.suffix == ".npz" and rng.random() < 0.7:  # past the checksums of the archive
            return _mutated_member(good, rng)
        if self.suffix == ".xml" and rng.random() < 0.7:  # past the syntax
            return mutated_xml(good, rng)
        return mutated(good, rng, self.head)


def _mutated_member(good: bytes, rng: random.Random) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(good)) as old, zipfile.ZipFile(buffer, "w") as new:
        names = old.namelist()
        chosen = rng.choice(names)
        for name in names:
            content = old.read(name)
            new.writestr(name, mutated(content, rng, rng.choice((128, None))) if name == chosen else content)
    return buffer.getvalue()
