"""A set of rays outside of the memory, for as many as a file may hold: read from a file, or made, a piece at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mi_refract.io.scratch import Table
from mi_refract.regimes import Rays

from . import ray_set
from .header import PRECISIONS, Header

STEP = 2**16  # rays that are in memory at once


@dataclass(frozen=True)
class StoredRays:
    """Rays (N) with the ids 0 … N − 1, regime after regime, and the header of the file.

    `vectors`: (N, 7), a, n and k in the precision of the set.
    """

    header: Header
    vectors: Table

    def __len__(self) -> int:
        """The number of rays."""
        return len(self.vectors)

    @property
    def precision(self) -> str:
        """ "f32" or "f64"."""
        return str(self.header["precision"])

    def read(self, start: int, stop: int) -> Rays:
        """Those from `start` on, before `stop`."""
        return _rays(self.vectors.read(start, stop))

    def take(self, ids: np.ndarray) -> Rays:
        """Those of these ids."""
        return _rays(self.vectors.take(ids))


def _rays(vectors: np.ndarray) -> Rays:
    return Rays(*map(np.ascontiguousarray, (vectors[:, :3], vectors[:, 3:6], vectors[:, 6])))


class RayStore:
    """A set that is filled with its rays, in their order and in its precision."""

    def __init__(self, header: Header) -> None:
        """Nothing is there yet. OSError, one line, where there is no room for the rays of this header."""
        total = header["count"] * len(header["regimes"])
        self.rays = StoredRays(header, Table((total, 7), PRECISIONS[header["precision"]]))
        self.filled, self._digest = 0, ray_set.Checksum(header)

    def add(self, part: Rays) -> np.ndarray:
        """The numbers of these rays, as a file holds them: see `ray_set.numbers_of`."""
        numbers = ray_set.numbers_of(np.arange(self.filled, self.filled + len(part)), part, self.rays.header)
        self._digest.add_numbers(numbers)
        self.rays.vectors.write(self.filled, np.column_stack([part.a, part.n, part.k]))
        self.filled += len(part)
        return numbers

    @property
    def checksum(self) -> str:
        """That of the header and of the rays so far."""
        return self._digest.text


def make(
    names: Iterable[str] | None = None,
    count: int = ray_set.COUNT,
    precision: str = ray_set.PRECISION,
    seed: int = 0,
    *,
    two_sided: bool = False,
    media: Sequence[str] = (),
    wavelengths: Sequence[float] = (),
) -> StoredRays:
    """The set that `ray_set.make` makes. One regime is in memory at a time, whole: its rays are drawn together."""
    header = ray_set.header_of(names, count, precision, seed, two_sided, media, wavelengths)
    kept = RayStore(header)
    for rays in _drawn(header):
        kept.add(rays)
    return StoredRays(header | {"checksum": kept.checksum}, kept.rays.vectors)


def _drawn(header: Header) -> Iterator[Rays]:
    for name in header["regimes"]:
        rays = ray_set.of_regime(name, header)
        for start in range(0, len(rays), STEP):
            yield rays[start : start + STEP]
