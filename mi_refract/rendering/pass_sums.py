"""Sums over passes in float64, in an order that depends on their numbers alone.

Passes are summed in a tree: each ARITY nodes in a row, from the first on, make one of the next level, and within it
they are added from the left. Whoever adds which nodes where, the bits of the result are the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .pass_plan import FEW

ARITY = 8
ARRAYS = ("total", "between", "within", "weights")  # of `PassSums`
_PIECE = 2**15  # values that are added at a time: what is needed of them stays in the cache
Doubles = NDArray[np.float64]


@dataclass
class PassSums:
    """Sums over some passes in a row, H × W × C each. A pixel's mean is Σ w v / Σ w over the samples v that reach it.

    `total`: Σ w v. `weights`: Σ w, H × W × 1, in units in which `spp` of it are expected; None: it is `spp`.
    `between`: one less than passes, estimates of a sample's variance, summed: Σ nᵢ (xᵢ − x)² without weights.
    `within`: Σ of (w (v − xᵢ))² over the samples of every pass, where xᵢ is the pass's mean; None where unknown, or
    where FEW passes make it needless.
    `contrasts`: these estimates once more, each as its mean over all pixels, in the first `colours` channels.
    """

    spp: int
    passes: int
    total: Doubles
    between: Doubles
    within: Doubles | None = None
    weights: Doubles | None = None
    contrasts: list[float] = field(default_factory=list)
    colours: int = 3

    def copy(self) -> PassSums:
        """The same, in memory of its own."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in ARRAYS}
        arrays = {name: None if array is None else array.copy() for name, array in arrays.items()}
        return replace(self, contrasts=list(self.contrasts), **arrays)

    def check(self, shape: tuple[int, ...], passes: int, spp: int) -> None:
        """ValueError unless these are sums of so many passes, of `spp` samples per pixel each, over H × W × C."""
        counts, expected = (self.passes, self.spp, len(self.contrasts)), (passes, passes * spp, passes - 1)
        shapes = {name: np.shape(array) for name in ARRAYS if (array := getattr(self, name)) is not None}
        wanted = {name: (*shape[:2], 1) if name == "weights" else shape for name in shapes}
        if counts != expected or shapes != wanted:
            text = f"{self.passes} passes of {self.spp} samples per pixel in all over {shapes.get('total')}"
            raise ValueError(f"sums of {text}; expected {passes} of {passes * spp} over {shape}")
        known = np.isfinite(self.total)
        for squares in (x for x in (self.between, self.within) if x is not None):
            if not ((squares >= 0) & (squares < np.inf) | ~known).all():
                raise ValueError("sums of squares that are negative or not finite")
        if self.weights is not None and not np.isfinite(self.weights).all():
            raise ValueError("weights that are not finite")

    @property
    def mean(self) -> Doubles:
        """The image; 0 where no sample has reached a pixel."""
        if self.weights is None:
            return np.asarray(self.total / self.spp)
        return np.divide(self.total, self.weights, out=np.zeros_like(self.total), where=self.weights != 0)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of `variance`; 0 where nothing is known of it."""
        return self.spp - 1 if self.within is not None else self.passes - 1

    @property
    def variance(self) -> Doubles | None:
        """`spp` times that of the mean, from the samples or from the spread of passes; None where unknown."""
        if not self.freedom:
            return None
        variance = (self.between if self.within is None else self.within + self.between) / self.freedom
        if self.weights is not None:
            share = np.divide(self.spp, self.weights, out=np.zeros_like(self.weights), where=self.weights != 0)
            variance *= np.square(share)
        return np.asarray(variance)

    def add(self, other: PassSums) -> None:
        """Take in the sums of the passes that follow: m + n samples per pixel then, with totals a, c and weights u, v.

        The next estimate of a sample's variance is  (av − cu)²/(u + v)² (m + n)/(mn) , the squared difference of the
        totals less the part that their weights explain. Without weights it is (x − y)² mn/(m + n), of the means x and y
        (Chan et al. 1979), and exactly 0 where all samples are equal.
        """
        channels, count = self.total.shape[-1], 1 / self.spp + 1 / other.spp
        a, b, c, d = (x.reshape(-1, channels) for x in (self.total, self.between, other.total, other.between))
        growth, known, rows = 0.0, 0, max(1, _PIECE // channels)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            for i in range(0, len(a), rows):
                piece = slice(i, i + rows)
                u, v = self._weights_of(piece), other._weights_of(piece)
                both: Any = u + v
                if isinstance(both, np.ndarray):
                    both[both == 0] = 1  # no sample has reached such a pixel, and its totals are 0 as well
                apart = a[piece] * v
                apart -= c[piece] * u
                apart /= both
                apart *= apart
                apart *= count
                b[piece] += d[piece]
                b[piece] += apart
                a[piece] += c[piece]
                colours = apart[:, : self.colours]
                if not np.isfinite(total := float(colours.sum())):
                    colours = colours[np.isfinite(colours)]
                    total = float(colours.sum())
                growth, known = growth + total, known + colours.size
        self.contrasts = [*self.contrasts, *other.contrasts, growth / known if known else np.nan]
        if self.weights is not None or other.weights is not None:  # one of them may come from a finished image
            ours, theirs = (x.spp if x.weights is None else x.weights for x in (self, other))
            self.weights = np.asarray(ours + theirs)
        self.passes += other.passes
        self.spp += other.spp
        if self.within is None or other.within is None or self.passes >= FEW:
            self.within = None
        else:
            self.within = self.within + other.within

    def _weights_of(self, piece: slice) -> Any:
        """The weights of some pixels, once for each channel; one number where it is that of all."""
        if self.weights is None:
            return float(self.spp)
        return np.repeat(self.weights.reshape(-1, 1)[piece], self.total.shape[-1], 1)


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
            raise ValueError(f"{node.passes} passes after {self.passes}; expected {ARITY**level}, where they begin")
        self.passes += node.passes
        while True:
            while len(self.levels) <= level:
                self.levels.append(None)
                self.counts.append(0)
            if (sums := self.levels[level]) is not None:
                sums.add(node)
                node = sums
            self.counts[level] += 1
            if self.counts[level] < ARITY:
                self.levels[level] = node
                return
            self.levels[level], self.counts[level] = None, 0
            level += 1

    def sums(self) -> PassSums | None:
        """The sums of all passes, in memory of their own; None without passes."""
        total: PassSums | None = None
        for sums in reversed(self.levels):
            if sums is not None and total is not None:
                total.add(sums)
            elif sums is not None:
                total = sums.copy()
        return total


def aligned_nodes(first: int, stop: int, largest: int) -> list[tuple[int, int]]:
    """Nodes that make up the passes from `first` to `stop`: level, up to `largest`, and number of the first pass."""
    nodes = []
    while first < stop:
        level = 0
        while level < largest and first % ARITY ** (level + 1) == 0 and first + ARITY ** (level + 1) <= stop:
            level += 1
        nodes.append((level, first))
        first += ARITY**level
    return nodes
