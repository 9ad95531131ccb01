"""Closed forms of refraction by simple bodies. Angles are in radians; `index` is that of the body over that outside.

Sources: Born and Wolf, Principles of Optics, 4.7.2 (prism); Descartes, Les Météores, 1637 (rainbow). The slab follows
from plane trigonometry.
"""

from __future__ import annotations

from typing import Any

import numpy as np

HALF_TURN = np.arccos(np.longdouble(-1))


def refracted(incidence: Any, index: Any) -> Any:
    """r = asin(sin i / n)."""
    return np.arcsin(np.sin(incidence) / index)


def lateral_shift(incidence: Any, index: Any) -> Any:
    """By how much of its thickness a plane-parallel slab moves a ray aside: sin(i − r)/cos r."""
    within = refracted(incidence, index)
    return np.sin(incidence - within) / np.cos(within)


def deviation(incidence: Any, apex: Any, index: Any) -> Any:
    """Of a ray in the principal section of a prism: i + asin(n sin(A − r)) − A."""
    return incidence + np.arcsin(index * np.sin(apex - refracted(incidence, index))) - apex


def least_deviated(apex: Any, index: Any) -> Any:
    """The incidence of least deviation, asin(n sin(A/2)); the deviation there is 2i − A."""
    return np.arcsin(index * np.sin(apex / 2))


def deflection(incidence: Any, index: Any, order: Any) -> Any:
    """Of a ray through a ball with m reflections within: mπ + 2i − 2(m + 1) r."""
    return order * HALF_TURN + 2 * incidence - 2 * (order + 1) * refracted(incidence, index)


def rainbow_incidence(index: Any, order: Any) -> Any:
    """Where that is stationary: cos i = √((n² − 1)/((m + 1)² − 1))."""
    return np.arccos(np.sqrt((index - 1) * (index + 1) / (order * (order + 2))))
