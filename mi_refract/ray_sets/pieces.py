"""Rays with their answers, a piece at a time: of arrays, or of sets that are kept outside of the memory."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .judged_parts import PIECE, Piece
from .ray_set import Answers, RaySet
from .stored_answers import BLOCK, StoredAnswers
from .stored_rays import StoredRays


class Pieces(Protocol):
    """Rays that have an answer, regime by regime."""

    @property
    def total(self) -> int:
        """How many there are."""

    @property
    def flagged(self) -> bool:
        """Whether there is the column `transmitted`."""

    def __iter__(self) -> Iterator[Piece]:
        """All of them in their order, up to PIECE of one regime at a time."""

    def sampled(self, index: np.ndarray) -> Piece:
        """Some of them by their places in that order."""


@dataclass(frozen=True)
class ArrayPieces:
    """Of arrays. `order`: (N,) for each ray the row of its answer, or −1."""

    rays: RaySet
    answers: Answers
    order: np.ndarray

    @property
    def total(self) -> int:
        """How many rays have an answer."""
        return int((self.order >= 0).sum())

    @property
    def flagged(self) -> bool:
        """Whether there is the column `transmitted`."""
        return self.answers.transmitted is not None

    @functools.cached_property
    def index(self) -> list[tuple[str, np.ndarray]]:
        """Of each piece its regime and its rays."""
        kept, found = np.flatnonzero(self.order >= 0), []
        names = self.rays.regime[kept]
        for name in self.rays.header["regimes"]:
            of_regime = kept[np.flatnonzero(names == name)]
            found += [(name, of_regime[i : i + PIECE]) for i in range(0, len(of_regime), PIECE)]
        return found

    def __iter__(self) -> Iterator[Piece]:
        """The pieces in their order."""
        for name, index in self.index:
            yield self._piece(name, index)

    def _piece(self, name: str, index: np.ndarray) -> Piece:
        rows = self.order[index]
        flag, ratio = (
            None if column is None else column[rows] for column in (self.answers.transmitted, self.answers.n_ratio)
        )
        return Piece(name, self.rays.rays[index], self.rays.ids[index], self.answers.b[rows], flag, ratio)

    def sampled(self, index: np.ndarray) -> Piece:
        """Some rays by their places in the order of the pieces."""
        ends = np.cumsum([len(each) for _, each in self.index])
        which = np.searchsorted(ends, index, side="right")
        found = [self.index[i][1][j - (ends[i] - len(self.index[i][1]))] for i, j in zip(which, index, strict=True)]
        return self._piece("", np.array(found, int))


@dataclass(frozen=True)
class StoredPieces:
    """Of stored sets, whose ids are the places of the rays, and whose regimes follow each other."""

    rays: StoredRays
    answers: StoredAnswers

    @property
    def total(self) -> int:
        """How many rays have an answer."""
        return int(self.answers.answered.sum())

    @property
    def flagged(self) -> bool:
        """Whether there is the column `transmitted`."""
        return self.answers.flagged

    def __iter__(self) -> Iterator[Piece]:
        """The pieces in their order."""
        for name, (first, last) in self.rays.header["regimes"].items():
            for start in range(first, last + 1, PIECE):
                stop = min(start + PIECE, last + 1)
                some = self.answers.which(start, stop)
                if some.any():
                    b, *columns = self.answers.read(start, stop)
                    flag, ratio = (None if column is None else column[some] for column in columns)
                    ids = np.arange(start, stop)[some]
                    yield Piece(name, self.rays.read(start, stop)[some], ids, b[some], flag, ratio)

    def sampled(self, index: np.ndarray) -> Piece:
        """Some rays by their places in the order of the pieces."""
        ids = self._ids(index)
        return Piece("", self.rays.take(ids), ids, *self.answers.take(ids))

    def _ids(self, index: np.ndarray) -> np.ndarray:
        ends = np.cumsum(self.answers.answered)
        blocks, found = np.searchsorted(ends, index, side="right"), np.empty(len(index), np.int64)
        for block in np.unique(blocks):
            mine, start = blocks == block, int(block) * BLOCK
            some = np.flatnonzero(self.answers.which(start, min(start + BLOCK, len(self.rays))))
            found[mine] = start + some[index[mine] - (ends[block] - len(some))]
        return found
