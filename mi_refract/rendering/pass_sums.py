"""Sums over passes in float64, in an order that depends on their numbers alone.

Passes are summed in a tree: each ARITY nodes in a row, from the first on, make one of the next level, and within it
they are added from the left. Whoever adds which nodes where, the bits of the result are the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .pass_plan import FEW

ARITY = 8
_PIECE = 2**15  # values that are added at a time: what is needed of them stays in the cache
Doubles = NDArray[np.float64]


@dataclass
class PassSums:
    """Sums over some passes in a row, H × W × C each.

    `total`: Σ nᵢ xᵢ, for passes of nᵢ samples per pixel and mean xᵢ. `between`: Σ nᵢ (xᵢ − x)², their spread.
    `within`: Σ of (v − xᵢ)² over the samples v of every pass; None where unknown, or where FEW passes make it needless.
    `contrasts`: one less than passes, independent estimates of a sample's variance, each a mean over all pixels: that
    of what `between` grew by, in the first `colours` channels.
    """

    spp: int
    passes: int
    total: Doubles
    between: Doubles
    within: Doubles | None = None
    contrasts: list[float] = field(default_factory=list)
    colours: int = 3

    def copy(self) -> PassSums:
        """The same, in memory of its own."""
        within = None if self.within is None else self.within.copy()
        return replace(
            self, total=self.total.copy(), between=self.between.copy(), within=within, contrasts=list(self.contrasts)
        )

    @property
    def mean(self) -> Doubles:
        """The image."""
        return np.asarray(self.total / self.spp)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of `variance`; 0 where nothing is known of it."""
        return self.spp - 1 if self.within is not None else self.passes - 1

    @property
    def variance(self) -> Doubles | None:
        """The variance of one sample per pixel, from the samples or from the spread of passes; None where unknown."""
        if not self.freedom:
            return None
        if self.within is not None:
            return np.asarray((self.within + self.between) / self.freedom)
        return self.between / self.freedom

    def add(self, other: PassSums) -> None:
        """Take in the sums of the passes that follow.

        With m and n samples per pixel and means x and y the spread grows by (x − y)² mn/(m + n) (Chan et al. 1979),
        which is exactly 0 where all samples are equal.
        """
        m, n = self.spp, other.spp
        factor, channels = m * n / (m + n), self.total.shape[-1]
        a, b, c, d = (each.reshape(-1, channels) for each in (self.total, self.between, other.total, other.between))
        sums, count, rows = 0.0, 0, max(1, _PIECE // channels)
        with np.errstate(invalid="ignore", over="ignore"):
            for i in range(0, len(a), rows):
                piece = slice(i, i + rows)
                apart = a[piece] / m
                apart -= c[piece] / n
                apart *= apart
                apart *= factor
                b[piece] += d[piece]
                b[piece] += apart
                a[piece] += c[piece]
                known = np.isfinite(colours := apart[:, : self.colours])
                sums, count = sums + float(colours[known].sum()), count + int(known.sum())
        self.contrasts = [*self.contrasts, *other.contrasts, sums / count if count else np.nan]
        self.passes += other.passes
        self.spp += n
        if self.within is None or other.within is None or self.passes >= FEW:
            self.within = None
        else:
            self.within = self.within + other.within


class PassTree:
    """The sums of all passes so far: of every level the nodes that do not yet make one of the next."""

    def __init__(self) -> None:
        """Without a pass."""
        self.levels: list[PassSums | None] = []
        self.counts: list[int] = []  # nodes in each level's sum, fewer than ARITY
        self.passes = 0

    def add(self, node: PassSums, level: int = 0) -> None:
        """Add a node of ARITY**level passes, which begins where the last one ended. The tree owns it from here on."""
        if any(self.counts[:level]) or node.passes != ARITY**level:
            raise ValueError(f"{node.passes} passes after {self.passes}: accepted: {ARITY**level}, where they begin")
        self.passes += node.passes
        while True:
            while len(self.levels) <= level:
                self.levels.append(None)
                self.counts.append(0)
            if (sums := self.levels[level]) is None:
                self.levels[level] = node
            else:
                sums.add(node)
            self.counts[level] += 1
            if self.counts[level] < ARITY:
                return
            node, self.levels[level], self.counts[level] = self._taken(level), None, 0
            level += 1

    def _taken(self, level: int) -> PassSums:
        sums = self.levels[level]
        assert sums is not None
        return sums

    def sums(self) -> PassSums | None:
        """The sums of all passes, in memory of their own; None without passes."""
        found: PassSums | None = None
        for sums in reversed(self.levels):
            if sums is not None:
                if found is None:
                    found = sums.copy()
                else:
                    found.add(sums)
        return found


def aligned_nodes(first: int, stop: int, largest: int) -> list[tuple[int, int]]:
    """Nodes that make up the passes from `first` to `stop`: level, up to `largest`, and number of the first pass."""
    found = []
    while first < stop:
        level = 0
        while level < largest and first % ARITY ** (level + 1) == 0 and first + ARITY ** (level + 1) <= stop:
            level += 1
        found.append((level, first))
        first += ARITY**level
    return found
