"""How far rounding errors move a path, and the rays for which rounding decides what they meet.

Let a ray be displaced by h across itself (to its left) and turned by φ. Behind a boundary, and L farther on, it is
displaced and turned by

    h' = h d'_n/d_n + L φ',    φ' = g φ − (1 − g) κ h/d_n,    g = n d_n/(n' d'_n)

where d and d' are its directions before and behind, the index n marks normal components, κ is the curvature, and g = −1
for a reflection. Each boundary adds, in units of ROUNDINGS · u,

    to h: S (1 + |d'_n/d_n| + |d × d'|/|d_n|)          to φ: 1 + |g| + 1/|d'_n| + |1 − g| S/ℓ

S is the largest coordinate so far, of the path and of the segments it met: coordinates are rounded to u S. So are the
ends of a segment of length ℓ, which turns it by S/ℓ. 1/|d'_n| comes from a cosine computed as √(1 − X²). The sum of the
magnitudes is a bound as long as the path meets the right boundaries.
"""

from __future__ import annotations

import numpy as np

from mi_refract.planar import Paths, Segments
from validation.reference.planar_retrace import Array, Curves, Retraced

ROUNDINGS = 2  # of the operands, and of the result


def growth(path: Retraced, segments: Segments, offset: float = 0.0) -> tuple[Array, Array]:
    """Bounds of the errors of points and of the legs' directions (N × (D+1) each), over u; NaN after the end.

    `offset`: how far rays are moved along the normal behind a boundary, over u (1 + max |p|).
    """
    g, h_factor, phi_factor = (x.astype(float) for x in transfer(path))
    unit, size = float(ROUNDINGS), _sizes(path, segments)
    before, behind = path.legs[:, :-1], path.legs[:, 1:]
    cos, cos_behind = (np.abs((d * path.normals).sum(2)) for d in (before, behind))
    length = np.hypot(*(np.asarray(segments.end) - segments.start).T)[path.hits]
    added_h = (size[:, 1:] * (1 + (cos_behind + np.abs(_cross(before, behind))) / cos)).astype(float)
    added_phi = (1 + np.abs(g) + 1 / cos_behind + np.abs(1 - g) * size[:, 1:] / length).astype(float)
    cos = cos.astype(float)
    shift = (1 + np.abs(path.points[:, 1:]).max(2)) * np.abs(_cross(path.normals, path.legs[:, 1:]))
    added_h = unit * added_h + offset * shift.astype(float)
    leg = np.hypot(*np.diff(path.points, axis=1).transpose(2, 0, 1)).astype(float)
    points, directions = np.full((2, *path.points.shape[:2]), np.nan)
    points[:, 0], directions[:, 0] = unit * size[:, 0], unit
    none = np.zeros(len(points))
    # One column per rounding so far: what it has become.
    h, phi = np.stack([points[:, 0], none], 1), np.stack([none, directions[:, 0]], 1)
    for j, met in enumerate((path.hits >= 0).T):
        if not met.any():
            break
        h = h + leg[:, j, None] * phi
        reach = (np.abs(h).sum(1) + unit * size[:, j + 1] * (1 + cos[:, j])) / cos[:, j]
        points[:, j + 1] = np.where(met, reach, np.nan)
        phi = g[:, j, None] * phi + phi_factor[:, j, None] * h
        h = np.column_stack([h_factor[:, j, None] * h, added_h[:, j], none])
        phi = np.column_stack([phi, none, unit * added_phi[:, j]])
        directions[:, j + 1] = np.where(met, np.abs(phi).sum(1), np.nan)
    return points, directions


def transfer(path: Retraced) -> tuple[Array, Array, Array]:
    """g, and what h and φ take from h (N × D each)."""
    before, behind = ((legs * path.normals).sum(2) for legs in (path.legs[:, :-1], path.legs[:, 1:]))
    # A ray that ends where it is contradicted goes on as it came.
    g = np.nan_to_num(path.indices[:, :-1] * before / (path.indices[:, 1:] * behind), nan=1)
    return g, behind / before, (g - 1) * path.curvatures / before


def _sizes(path: Retraced, segments: Segments) -> Array:
    """The largest coordinate so far, N × (D+1); of the path and of the segments it met."""
    largest = np.max([np.abs(x).max(1) for x in (segments.start, segments.end, segments.control)], axis=0)
    own = np.abs(path.points).max(2)
    own[:, 1:] = np.maximum(own[:, 1:], np.where(path.hits >= 0, largest[path.hits], np.nan))
    return np.maximum.accumulate(own, axis=1).astype(float)


def undecided(exact: Retraced, paths: Paths, segments: Segments, points: Array, directions: Array) -> Array:
    """Which rays (N) may take a wrong path, by the bounds of the errors of their points and directions.

    At a vertex, where they touch a curve, and at the critical angle. A ray meets a curve between h and −h from its top
    where its cosine is less than √(2 |κ| h); by φ off, it is refracted or not where |1 − k² sin²θ| is less than 2 k φ.
    """
    h, kappa = points[:, 1:], np.abs(exact.curvatures)
    cos = (exact.legs[:, :-1] * exact.normals).sum(2)
    behind = np.where(cos > 0, *(np.asarray(n)[exact.hits] for n in (segments.n_left, segments.n_right)))
    k, sine = exact.indices[:, :-1] / behind, np.abs(_cross(exact.normals, exact.legs[:, :-1]))
    ends = [np.asarray(x)[exact.hits] for x in (segments.start, segments.end)]
    clearance = np.min([np.hypot(*(exact.points[:, 1:] - end).transpose(2, 0, 1)) for end in ends], axis=0)
    with np.errstate(invalid="ignore"):
        at = np.where(exact.hits >= 0, clearance, np.nan) <= h
        at |= cos**2 <= 2 * kappa * h
        at |= np.abs(1 - (k * sine) ** 2) <= 2 * k * (directions[:, :-1] + kappa * h)
    # Where a path first meets another boundary than it should, and only just.
    other = paths.hits != exact.hits
    rays = np.flatnonzero(other.any(1))
    first = other[rays].argmax(1)
    met = paths.hits[rays, first] >= 0
    rays, first = rays[met], first[met]
    place, d = paths.points[rays, first + 1], exact.legs[rays, first]
    way = place - exact.points[rays, first]
    normal, curvature = Curves(segments).normal(place.astype(np.longdouble), paths.hits[rays, first])
    near = points[rays, first] + np.hypot(*way.T) * directions[rays, first]
    touching = np.zeros(len(paths.hits), bool)
    touching[rays] = ((d * normal).sum(1) ** 2 <= 2 * np.abs(curvature) * near) & (np.abs(_cross(d, way)) <= near)
    return at.any(1) | touching


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
