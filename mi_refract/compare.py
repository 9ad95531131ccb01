"""Are two pictures the same? Gates first, then one of five methods; each gives a verdict with its numbers.

Fails closed: what cannot be compared is an error, a value that is not finite equals nothing, and a method that could
not have seen a difference says "inconclusive".
"""

from __future__ import annotations

import enum
import inspect
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from .images import Image

Maps = dict[str, np.ndarray]


class Verdict(enum.StrEnum):
    EQUAL = "equal"
    DIFFERENT = "different"
    INCONCLUSIVE = "inconclusive"


@dataclass(frozen=True)
class Figure:
    """A number of a judgement; where it has a threshold, `value <= bound` holds for equal pictures."""

    name: str
    value: float
    bound: float | None = None


@dataclass(frozen=True)
class Comparison:
    """What a method found. `detectable`: the smallest relative difference that it would have seen, NaN if unknown.

    `maps`: H × W or H × W × C float32 by name, of the pictures' size.
    """

    method: str
    verdict: Verdict
    reason: str
    figures: tuple[Figure, ...] = ()
    detectable: float = np.nan
    maps: Maps = field(default_factory=dict)


def gates(reference: Image, test: Image, allow_nonfinite: bool = False) -> str | None:
    """Why the two differ before any method is asked: the first values that are not finite; None if there are none.

    ValueError, in one line, where they cannot be compared: other size, channels (by name), or data window.
    With `allow_nonfinite` such a value is allowed where the other picture has the same one: NaN, Inf or -Inf.
    """
    raise NotImplementedError


def exact(reference: Image, test: Image, *, allow_nonfinite: bool = False) -> Comparison:
    """Every value is the same."""
    raise NotImplementedError


def tolerance(
    reference: Image,
    test: Image,
    *,
    allow_nonfinite: bool = False,
    fail: Annotated[float, "a value may differ by this much"] = 0.004,
    fail_relative: Annotated[float, "or by this share of the mean of both"] = 0.001,
    fail_percent: Annotated[float, "of the pixels, this many percent may differ by more"] = 0.02,
    hard_fail: Annotated[float, "no value may differ by more than this"] = np.inf,
    warn: Annotated[float, "a difference worth a warning"] = np.inf,
    warn_relative: Annotated[float, "or this share of the mean of both"] = 0.0,
    warn_percent: Annotated[float, "of the pixels, this many percent may differ so without one"] = 0.0,
    hard_warn: Annotated[float, "any value that differs by more is worth one"] = np.inf,
) -> Comparison:
    """Differences within absolute and relative thresholds, but for a share of the pixels: the meaning of `idiff`."""
    raise NotImplementedError


def paired_images(
    reference: Image,
    test: Image,
    *,
    allow_nonfinite: bool = False,
    threshold: Annotated[float, "a pixel is changed where a channel differs by more"] = 1e-4,
    changed: Annotated[float, "share of the pixels that may be changed"] = 0.001,
    largest: Annotated[float, "largest change that is allowed"] = np.inf,
) -> Comparison:
    """Renders of the same random numbers: the share of changed pixels and the largest change."""
    raise NotImplementedError


def welch_images(
    reference: Sequence[Image],
    test: Sequence[Image],
    *,
    allow_nonfinite: bool = False,
    tile: Annotated[int, "side of a tile in pixels"] = 16,
    family_error: Annotated[float, "probability that equal pictures are called different"] = 0.001,
    correction: Annotated[str, "for the number of tiles: sidak or holm"] = "sidak",
    margin: Annotated[float, "relative difference of a tile that is as good as none"] = 0.001,
    resolution: Annotated[float, "relative difference that must have been seen, or the verdict is inconclusive"] = 0.05,
    spp: Annotated[int, "samples per pixel of pictures with variance channels; 0: as their headers say"] = 0,
) -> Comparison:
    """Independent renders: Welch's t-test on the means of tiles and channels.

    Two or more renders a side, or one a side with the variance or second moment of every channel.
    """
    raise NotImplementedError


def flip(
    reference: Image,
    test: Image,
    *,
    allow_nonfinite: bool = False,
    mean: Annotated[float, "mean FLIP error that is allowed, 0 to 1"] = 0.01,
    largest: Annotated[float, "FLIP error that no pixel may exceed, 0 to 1"] = 1.0,
    hdr: Annotated[str, "auto (by the file's format), yes or no"] = "auto",
    ppd: Annotated[float, "pixels per degree of the viewer's field"] = 67.0,
) -> Comparison:
    """What a person who flips between the two would see: FLIP, for LDR and HDR pictures."""
    raise NotImplementedError


@dataclass(frozen=True)
class Option:
    name: str
    type: type
    default: Any
    help: str


@dataclass(frozen=True)
class Method:
    """`samples`: takes a sequence of independent renders on either side instead of one picture."""

    function: Callable[..., Comparison]
    samples: bool = False

    @property
    def summary(self) -> str:
        return (self.function.__doc__ or "").partition("\n")[0]

    @property
    def options(self) -> dict[str, Option]:
        """The keyword arguments but `allow_nonfinite`, which every method has."""
        hints = typing.get_type_hints(self.function, include_extras=True)
        given = inspect.signature(self.function).parameters
        return {
            name: Option(name, typing.get_args(hint)[0], given[name].default, hint.__metadata__[0])
            for name, hint in hints.items()
            if typing.get_origin(hint) is Annotated
        }


METHODS = {
    "exact": Method(exact),
    "tolerance": Method(tolerance),
    "paired": Method(paired_images),
    "welch": Method(welch_images, samples=True),
    "flip": Method(flip),
}


def compare(
    method: str, reference: Image | Sequence[Image], test: Image | Sequence[Image], **options: Any
) -> Comparison:
    """One comparison by the table; "auto" is welch where it can be, else tolerance.

    ValueError for an unknown method or option, an option of another type or out of its range, several renders for a
    method that takes one, and pictures that cannot be compared.
    """
    raise NotImplementedError


@dataclass(frozen=True)
class Paired:
    """Two pictures of the same random numbers: share of changed pixels, largest change, RMSE, ratio of the means."""

    changed: float
    largest: float
    rmse: float
    mean_ratio: float


def paired(reference: np.ndarray, test: np.ndarray, threshold: float) -> Paired:
    """A pixel is changed where any channel differs by more than `threshold`, or is not finite."""
    _same_shape(reference, test)
    with np.errstate(invalid="ignore"):
        difference = np.abs(test - reference).max(-1)
    finite = np.isfinite(test).all(-1) & np.isfinite(reference).all(-1)
    changed = float((~(difference <= threshold) | ~finite).mean())
    if not finite.all():
        return Paired(changed, np.inf, np.inf, np.nan)
    return Paired(changed, float(difference.max()), float(np.sqrt(np.square(test - reference).mean())),
                  float(test.mean() / reference.mean()) if reference.any() else 1.0 + float(test.mean()))  # fmt: skip


@dataclass(frozen=True)
class Welch:
    """`alarms`: tiles and channels that differ, at the given probability of any alarm between equal pictures.

    `smallest_p` is Šidák-adjusted; `detectable` the median over tiles of the smallest relative difference of means
    that would have been an alarm; `certain` counts tiles without any variance, which a t-test knows nothing of:
    they are alarms where the means differ beyond the margin.
    """

    alarms: int
    smallest_p: float
    detectable: float
    certain: int


def welch(reference: np.ndarray, test: np.ndarray, tile: int, family_error: float, margin: float = 0.0) -> Welch:
    """Welch's t-test on tile means of two stacks of independent renders, (renders, height, width, channels).

    Means that differ by no more than `margin`, relative to the tile's or to a thousandth of the picture's, are equal
    for all practical purposes: the test asks whether they differ by more. It keeps noise-free tiles from turning last
    bits into certainties.

    The variance of a tile mean is the sum of its pixels' variances over the renders, and its degrees of freedom
    follow Satterthwaite: pixels are independent under a box filter. ValueError for fewer than 2 renders a side.
    """
    from scipy import stats

    _same_shape(reference[0], test[0])
    if min(len(reference), len(test)) < 2:
        raise ValueError(f"welch: {len(reference)} and {len(test)} renders: at least 2 a side are needed")
    with np.errstate(invalid="ignore"):
        m1, v1, d1 = _tile_moments(reference, tile)
        m2, v2, d2 = _tile_moments(test, tile)
    variance = v1 + v2
    certain = variance == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        allowed = margin * np.maximum(np.abs(m1), 1e-3 * np.abs(m1).mean())
        freedom = np.where(certain, 1.0, variance**2 / (d1 + d2))
        beyond = np.maximum(np.abs(m1 - m2) - allowed, 0)
        t = np.where(certain, np.where(beyond == 0, 0.0, np.inf), beyond / np.sqrt(variance))
    p = np.where(np.isfinite(m1) & np.isfinite(m2), 2 * stats.t.sf(t, freedom), 0.0)
    threshold = -np.expm1(np.log1p(-family_error) / p.size)  # Šidák
    critical = stats.t.isf(threshold / 2, freedom[~certain])
    lit = np.abs(m1[~certain]) > 0
    detectable = critical[lit] * np.sqrt(variance[~certain][lit]) / np.abs(m1[~certain][lit])
    return Welch(
        int((p <= threshold).sum()),
        float(-np.expm1(p.size * np.log1p(-min(float(p.min()), 1 - 1e-16)))),
        float(np.median(detectable)) if detectable.size else 0.0,
        int(certain.sum()),
    )


def _tile_moments(stack: np.ndarray, tile: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per tile and channel: the mean, its variance, and Satterthwaite's denominator Σ v_i²/(n − 1).

    Tiles at the right and lower edge are as large as what is left.
    """
    count, height, width = stack.shape[:3]
    rows, columns = np.arange(0, height, tile), np.arange(0, width, tile)
    area = np.outer(np.diff(rows, append=height), np.diff(columns, append=width))[..., None]

    def total(x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(np.add.reduceat(x, rows, 0), columns, 1)

    variance = stack.var(0, ddof=1) / count
    mean = total(stack.mean(0)) / area
    return mean, total(variance) / area**2, total(variance**2) / area**4 / (count - 1)


def relative_mse(picture: np.ndarray, references: np.ndarray, epsilon: float = 0.01) -> float:
    """mean((x − r)²/(r² + ε)) against the mean r of a stack of independent renders, less what r's own noise adds."""
    r = references.mean(0)
    _same_shape(r, picture)
    own = references.var(0, ddof=1) / len(references)
    return float(((np.square(picture - r) - own) / (np.square(r) + epsilon)).mean())


def _same_shape(reference: np.ndarray, test: np.ndarray) -> None:
    if reference.shape != test.shape:
        raise ValueError(f"pictures of different shapes: reference {reference.shape}, test {test.shape}")
