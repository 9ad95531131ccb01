"""Rays for which rounding decides what they meet: at a vertex, where they touch a curve, and at the critical angle."""

from __future__ import annotations

import numpy as np

from mi_refract.planar import Paths, Segments
from validation.reference.planar_retrace import Array, Curves, Retraced


def undecided(exact: Retraced, paths: Paths, segments: Segments, points: Array, directions: Array) -> Array:
    """Which rays (N) may take a wrong path, by the bounds of the errors of their points and directions.

    A ray meets a curve between h and −h from its top where its cosine is less than √(2 |κ| h); by φ off, it is
    refracted or not where |1 − k² sin²θ| is less than 2 k φ.
    """
    h, kappa = points[:, 1:], np.abs(exact.curvatures)
    k = exact.indices[:, :-1] / _far(exact, segments)
    sine = np.abs(_cross(exact.normals, exact.legs[:, :-1]))
    cos2 = (exact.legs[:, :-1] * exact.normals).sum(2) ** 2
    with np.errstate(invalid="ignore"):
        at = clearance(exact, segments) <= h
        at |= cos2 <= 2 * kappa * h
        at |= np.abs(1 - (k * sine) ** 2) <= 2 * k * (directions[:, :-1] + kappa * h)
    return at.any(1) | _touches(exact, paths, segments, points, directions)


def clearance(exact: Retraced, segments: Segments) -> Array:
    """How far each point is from the nearer end of its boundary (N × D), NaN after the end."""
    ends = [np.asarray(x)[exact.hits] for x in (segments.start, segments.end)]
    distance = np.min([np.hypot(*(exact.points[:, 1:] - end).transpose(2, 0, 1)) for end in ends], axis=0)
    return np.where(exact.hits >= 0, distance, np.nan)


def _far(exact: Retraced, segments: Segments) -> Array:
    """The index behind each boundary."""
    media = [np.asarray(x)[exact.hits] for x in (segments.n_left, segments.n_right)]
    leftward = (exact.legs[:, :-1] * exact.normals).sum(2) > 0
    return np.where(leftward, *media)


def _touches(exact: Retraced, paths: Paths, segments: Segments, points: Array, directions: Array) -> Array:
    """Where a path first meets another boundary than it should, and only just."""
    rays = np.flatnonzero((paths.hits != exact.hits).any(1))
    first = (paths.hits != exact.hits)[rays].argmax(1)
    met = paths.hits[rays, first] >= 0
    rays, first = rays[met], first[met]
    place, d = paths.points[rays, first + 1], exact.legs[rays, first]
    way = place - exact.points[rays, first]
    normal, kappa = Curves(segments).normal(place.astype(np.longdouble), paths.hits[rays, first])
    h = points[rays, first] + np.hypot(*way.T) * directions[rays, first]
    found = np.zeros(len(paths.hits), bool)
    found[rays] = ((d * normal).sum(1) ** 2 <= 2 * np.abs(kappa) * h) & (np.abs(_cross(d, way)) <= h)
    return found


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
