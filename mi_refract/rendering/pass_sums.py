"""Sums over passes in float64, in an order that depends only on the numbers of the passes.

Passes are summed in a tree: every ARITY consecutive nodes, from the first on, are added from left to right and make one
node of the next level. So the bits of the result do not depend on where and when nodes are added.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .pass_plan import FEW

ARITY = 8
ARRAYS = ("total", "between", "within", "weights")  # of `PassSums`
_PIECE = 2**15  # values that are added at a time, so that they stay in the cache
Doubles = NDArray[np.float64]


@dataclass
class PassSums:
    """Sums over consecutive passes, H × W × C each. A pixel's mean is Σ w v / Σ w over the samples v that reach it.

    `total`: Σ w v. `weights`: Σ w, H × W × 1, in units in which `spp` is expected; None: `spp` in every pixel.
    `between`: the sum of `passes` − 1 estimates of a sample's variance; Σ nᵢ (xᵢ − x)² without weights. `within`: Σ of
    (w (v − xᵢ))² over the samples of every pass, where xᵢ is the pass's mean; None if unknown, and for FEW passes or
    more, which do not need it. `contrasts`: the same estimates as in `between`, each averaged over all pixels and the
    first `colours` channels.
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
        """Return a copy that shares no memory."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in ARRAYS}
        arrays = {name: None if array is None else array.copy() for name, array in arrays.items()}
        return replace(self, contrasts=list(self.contrasts), **arrays)

    def check(self, shape: tuple[int, ...], passes: int, spp: int) -> None:
        """Raise ValueError unless these are sums of `passes` of `spp` samples per pixel each, over H × W × C."""
        counts, expected_counts = (self.passes, self.spp, len(self.contrasts)), (passes, passes * spp, passes - 1)
        arrays = {name: getattr(self, name) for name in ARRAYS}
        shapes = {name: np.shape(array) for name, array in arrays.items() if array is not None}
        expected_shapes = {name: (*shape[:2], 1) if name == "weights" else shape for name in shapes}
        if counts != expected_counts or shapes != expected_shapes:
            text = f"{self.passes} passes of {self.spp} samples per pixel in all over {shapes.get('total')}"
            raise ValueError(f"sums of {text}; expected {passes} of {passes * spp} over {shape}")
        finite = np.isfinite(self.total)
        for squares in (self.between, self.within):
            if squares is not None and not ((squares >= 0) & (squares < np.inf) | ~finite).all():
                raise ValueError("sums of squares that are negative or not finite")
        if self.weights is not None and not np.isfinite(self.weights).all():
            raise ValueError("weights that are not finite")

    @property
    def mean(self) -> Doubles:
        """The image; 0 in pixels that no sample has reached."""
        if self.weights is None:
            return np.asarray(self.total / self.spp)
        return np.divide(self.total, self.weights, out=np.zeros_like(self.total), where=self.weights != 0)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of `variance`; 0 if it is unknown."""
        return self.spp - 1 if self.within is not None else self.passes - 1

    @property
    def variance(self) -> Doubles | None:
        """The variance of the mean times `spp`, from the samples or from the spread of passes; None if unknown."""
        if not self.freedom:
            return None
        variance = (self.between if self.within is None else self.within + self.between) / self.freedom
        if self.weights is not None:
            share = np.divide(self.spp, self.weights, out=np.zeros_like(self.weights), where=self.weights != 0)
            variance *= np.square(share)
        return np.asarray(variance)

    def add(self, other: PassSums) -> None:
        """Add the sums of the passes that follow. Let m and n be both `spp`, a and c both totals, u and v both weights.

        The new estimate of a sample's variance is  (av − cu)²/(u + v)² (m + n)/(mn) , the squared difference of the
        totals without the part that their weights explain. Without weights it is (x − y)² mn/(m + n), with the means x
        and y (Chan et al. 1979), and exactly 0 where all samples are equal.
        """
        channels, count = self.total.shape[-1], 1 / self.spp + 1 / other.spp
        a, b, c, d = (x.reshape(-1, channels) for x in (self.total, self.between, other.total, other.between))
        contrast, values, rows = 0.0, 0, max(1, _PIECE // channels)
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            for i in range(0, len(a), rows):
                piece = slice(i, i + rows)
                u, v = self._weights_of(piece), other._weights_of(piece)
                weights: Any = u + v
                if isinstance(weights, np.ndarray):
                    weights[weights == 0] = 1  # no sample has reached such a pixel, so its totals are 0, too
                estimate = a[piece] * v
                estimate -= c[piece] * u
                estimate /= weights
                estimate *= estimate
                estimate *= count
                b[piece] += d[piece]
                b[piece] += estimate
                a[piece] += c[piece]
                colours = estimate[:, : self.colours]
                total = float(colours.sum())
                if not np.isfinite(total):
                    colours = colours[np.isfinite(colours)]
                    total = float(colours.sum())
                contrast, values = contrast + total, values + colours.size
        self.contrasts = [*self.contrasts, *other.contrasts, contrast / values if values else np.nan]
        if self.weights is not None or other.weights is not None:  # one of them may come from a finished image
            w1, w2 = (x.spp if x.weights is None else x.weights for x in (self, other))
            self.weights = np.asarray(w1 + w2)
        self.passes += other.passes
        self.spp += other.spp
        if self.within is None or other.within is None or self.passes >= FEW:
            self.within = None
        else:
            self.within = self.within + other.within

    def _weights_of(self, piece: slice) -> Any:
        """Return the weights of some pixels, repeated for each channel; one number if all weights are equal."""
        if self.weights is None:
            return float(self.spp)
        return np.repeat(self.weights.reshape(-1, 1)[piece], self.total.shape[-1], 1)


class PassTree:
    """The sums of all passes so far: for each level, of the nodes that do not yet make one of the next level."""

    def __init__(self) -> None:
        """Create a tree without passes."""
        self.levels: list[PassSums | None] = []
        self.counts: list[int] = []  # number of nodes in the sum of each level, fewer than ARITY
        self.passes = 0

    def add(self, node: PassSums, level: int = 0) -> None:
        """Add a node of ARITY**level passes that follow those of the tree. The tree may change the node later."""
        if any(self.counts[:level]) or node.passes != ARITY**level:
            expected = f"expected {ARITY**level} after a multiple of {ARITY**level}"
            raise ValueError(f"{node.passes} passes after {self.passes}; {expected}")
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
        """Return the sums of all passes, which share no memory with the tree; None without passes."""
        return added(reversed(self.levels))


def added(nodes: Iterable[PassSums | None]) -> PassSums | None:
    """Return the sums of consecutive nodes, which share no memory with them; None without a node."""
    total: PassSums | None = None
    for sums in nodes:
        if sums is not None and total is not None:
            total.add(sums)
        elif sums is not None:
            total = sums.copy()
    return total


def aligned_nodes(first: int, stop: int, largest: int) -> list[tuple[int, int]]:
    """Return the nodes that make up the passes from `first` to `stop`: level, at most `largest`, and first pass."""
    nodes = []
    while first < stop:
        level = 0
        while level < largest and first % ARITY ** (level + 1) == 0 and first + ARITY ** (level + 1) <= stop:
            level += 1
        nodes.append((level, first))
        first += ARITY**level
    return nodes
