"""Answers outside of the memory, each in the place of its ray, and which of them match no ray."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from mi_refract.io.scratch import Log, Table

from .header import Header

BLOCK = 2**14  # rays whose answers are counted together
_ANSWERED, _AGAIN, _TRANSMITTED = 1, 2, 4  # bits of a state
LISTED_IDS = 5
_DISTINCT = 2**22  # ids that are sorted at once
_STEP = 2**16
_SPREADER = 0x9E3779B97F4A7C15  # odd: no ids are made one by the multiplication
Listed = tuple[int, list[int]]  # how many, and the first ids
Columns = tuple[np.ndarray, np.ndarray | None, np.ndarray | None]  # b (n, 3), transmitted (n,), n_ratio (n,)


@dataclass(frozen=True)
class StoredAnswers:
    """`b`: (N, 3) float64, the first answer to each of N rays. `states`: (N,) bits. `answered`: rays of each BLOCK.

    `flagged`: whether there is the column `transmitted`. `mismatches`: as of `match`. `ratios`: (N,) float64, the
    column `n_ratio`, if there is one.
    """

    header: Header
    b: Table
    states: Table
    answered: np.ndarray
    flagged: bool
    mismatches: dict[str, Listed]
    ratios: Table | None = None

    def which(self, start: int, stop: int) -> np.ndarray:
        """(stop − start,) the rays that have an answer."""
        return self.states.read(start, stop) & _ANSWERED > 0

    def read(self, start: int, stop: int) -> Columns:
        """b and the columns `transmitted` and `n_ratio` of some rays in their order."""
        ratios = self.ratios.read(start, stop) if self.ratios is not None else None
        return self.b.read(start, stop), self._flag(self.states.read(start, stop)), ratios

    def take(self, ids: np.ndarray) -> Columns:
        """The same of these rays."""
        ratios = self.ratios.take(ids) if self.ratios is not None else None
        return self.b.take(ids), self._flag(self.states.take(ids)), ratios

    def _flag(self, states: np.ndarray) -> np.ndarray | None:
        return states & _TRANSMITTED > 0 if self.flagged else None


# ids (n,) int64, b (n, 3), transmitted (n,), n_ratio (n,)
Rows = tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]


def match(header: Header, rows: Iterable[Rows], rays: int, flagged: bool, with_ratio: bool = False) -> StoredAnswers:
    """Answers to rays with the ids 0 … `rays` − 1, in any order; the first answer to a ray counts.

    Mismatches are "missing", "duplicate" and "unknown" ids, as far as there are any.
    """
    b, states, unknown = Table((rays, 3), np.float64), Table((rays,), np.uint8), Log(np.int64)
    ratios = Table((rays,), np.float64) if with_ratio else None
    for some in rows:
        _put(b, states, ratios, unknown, some, rays)
    answered = [int((part & _ANSWERED > 0).sum()) for part in _parts(states, BLOCK)]
    missing, twice = (_listed(states, bit, wanted) for bit, wanted in ((_ANSWERED, False), (_AGAIN, True)))
    strange, strange_twice = _distinct(unknown)
    found = {"missing": missing, "duplicate": _both(twice, strange_twice), "unknown": strange}
    mismatches = {kind: each for kind, each in found.items() if each[0]}
    return StoredAnswers(header, b, states, np.array(answered), flagged, mismatches, ratios)


def _put(b: Table, states: Table, ratios: Table | None, unknown: Log, rows: Rows, rays: int) -> None:
    ids, given, flags, n_ratio = rows
    known = (ids >= 0) & (ids < rays)
    unknown.append(ids[~known])
    places = np.flatnonzero(known)
    to, first, counts = np.unique(ids[places], return_index=True, return_counts=True)
    old = states.take(to)
    new, row = old == 0, places[first]
    b.put(to[new], given[row[new]])
    if ratios is not None and n_ratio is not None:
        ratios.put(to[new], n_ratio[row[new]])
    fresh = _ANSWERED if flags is None else _ANSWERED + _TRANSMITTED * flags[row]
    again = (counts > 1) | ~new
    states.put(to, np.where(new, fresh, old) | _AGAIN * again)


def _parts(states: Table, step: int) -> Iterator[np.ndarray]:
    for start in range(0, len(states), step):
        yield states.read(start, min(start + step, len(states)))


def _listed(states: Table, bit: int, wanted: bool) -> Listed:
    """The ids that have the bit, or have it not."""
    count, first = 0, list[int]()
    for i, part in enumerate(_parts(states, _STEP)):
        found = np.flatnonzero((part & bit > 0) == wanted)
        count += len(found)
        first += (i * _STEP + found[: LISTED_IDS - len(first)]).tolist()
    return count, first


def _distinct(ids: Log) -> tuple[Listed, Listed]:
    """The different ones of any ids, and those that are there more than once."""
    once: Listed = 0, []
    twice: Listed = 0, []
    shares = -(-ids.rows // _DISTINCT)
    for share in range(shares):
        kept = [np.empty(0, np.int64)]
        for piece in ids.pieces(_STEP):
            mine = piece[_share(piece, shares) == share]
            unique, counts = np.unique(mine, return_counts=True)
            kept.append(np.repeat(unique, np.minimum(counts, 2)))
        unique, counts = np.unique(np.concatenate(kept), return_counts=True)
        once, twice = _both(once, _as_listed(unique)), _both(twice, _as_listed(unique[counts > 1]))
    return once, twice


def _share(ids: np.ndarray, shares: int) -> np.ndarray:
    """Which of the shares an id is in: about as many in each, whatever the ids are."""
    return (ids.astype(np.uint64) * np.uint64(_SPREADER) >> np.uint64(32)) % np.uint64(shares)


def _as_listed(ids: np.ndarray) -> Listed:
    return len(ids), ids[:LISTED_IDS].tolist()


def _both(one: Listed, other: Listed) -> Listed:
    return one[0] + other[0], sorted(one[1] + other[1])[:LISTED_IDS]
