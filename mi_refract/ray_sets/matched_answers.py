"""Rays with their answers: which answer is whose, and which rays or answers have no counterpart."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mi_refract.regimes import Array, Rays

from .header import Ids
from .ray_set import Answers, RaySet

PIECE = 2**14  # rays that are certified or judged at once: about half a second


@dataclass(frozen=True)
class Piece:
    """Rays (N), their ids (N,), the answers b (N, 3), and the columns `transmitted` and `n_ratio` (N,), if given."""

    rays: Rays
    ids: Ids
    b: Array
    transmitted: NDArray[np.bool_] | None
    n_ratio: Array | None

    @property
    def used(self) -> Rays:
        """The rays as the program took them: with the ratio of the indices that it used, where it says so."""
        if self.n_ratio is None:
            return self.rays
        return Rays(self.rays.a.astype(np.float64), self.rays.n.astype(np.float64), self.n_ratio)


@dataclass(frozen=True)
class MatchedAnswers:
    """The rays that have an answer, by their rows (N,) in the set, and the rows (N,) of their answers."""

    rays: RaySet
    answers: Answers
    rows: NDArray[np.intp]
    answer_rows: NDArray[np.intp]

    @property
    def ids(self) -> Ids:
        """(N,) of the rays."""
        return self.rays.ids[self.rows]

    def take(self, index: NDArray[np.intp] | slice) -> Piece:
        """Some of them."""
        some, rows, answers = self.rows[index], self.answer_rows[index], self.answers
        flags = None if answers.transmitted is None else answers.transmitted[rows]
        ratios = None if answers.n_ratio is None else answers.n_ratio[rows]
        return Piece(self.rays.rays[some], self.rays.ids[some], answers.b[rows], flags, ratios)

    def pieces(self) -> Iterator[Piece]:
        """All of them, PIECE at a time."""
        for start in range(0, len(self.rows), PIECE):
            yield self.take(slice(start, start + PIECE))

    def ratio_differences(self) -> Array:
        """(N,) of the ratio of indices that was used, relative to that of the ray. Precondition: answers say it."""
        assert self.answers.n_ratio is not None
        k = self.rays.rays.k[self.rows].astype(np.float64)
        difference: Array = np.abs(self.answers.n_ratio[self.answer_rows] - k) / k
        return difference


def match(rays: RaySet, answers: Answers) -> tuple[MatchedAnswers, dict[str, Ids]]:
    """The first answer to each ray counts. Also "missing", "duplicate" and "unknown" ids, each once, in order."""
    ids, first, counts = np.unique(answers.ids, return_index=True, return_counts=True)
    place = np.searchsorted(ids, rays.ids).clip(max=max(len(ids) - 1, 0))
    answered = ids[place] == rays.ids if len(ids) else np.zeros(len(rays), bool)
    mismatches = {
        "missing": np.sort(rays.ids[~answered]),
        "duplicate": ids[counts > 1],
        "unknown": np.setdiff1d(ids, rays.ids, assume_unique=True),
    }
    rows = np.flatnonzero(answered)
    return MatchedAnswers(rays, answers, rows, first[place[rows]]), mismatches
