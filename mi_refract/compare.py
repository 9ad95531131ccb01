"""Comparing pictures: same-seed differences, Welch's t-test on tiles, relMSE. Pictures are (height, width, channels).

Fails closed: pictures of different shapes are an error, and a pixel that is not finite equals nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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
