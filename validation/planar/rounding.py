"""Bounds on the rounding errors of a path, and the rays for which rounding decides which boundary they meet.

Let a ray be displaced by h across itself (to its left) and rotated by φ. Behind a boundary, and L farther on, it is
displaced and rotated by

    h' = h d'_n/d_n + L φ',    φ' = g φ − (1 − g) κ h/d_n,    g = n d_n/(n' d'_n)

where d and d' are its directions before and behind, the index n marks normal components, κ is the curvature, and g = −1
for a reflection. Each boundary adds, in units of ROUNDINGS · u,

    to h: S (1 + |d'_n/d_n| + |d × d'|/|d_n|)          to φ: 1 + |g| + 1/|d'_n| + |1 − g| S/ℓ

S is the largest coordinate so far, of the path and of the segments on it: coordinates have rounding errors of u S. The
rounded ends of a segment of length ℓ rotate it by S/ℓ. 1/|d'_n| comes from a cosine computed as √(1 − X²). The sum of
the magnitudes is a bound as long as the path meets the right boundaries.
"""

from __future__ import annotations

import numpy as np

from mi_refract.planar import Paths, Segments
from validation.reference.planar_retrace import Array, Curves, Retraced, cross

ROUNDINGS = 2  # of the operands, and of the result


def growth(path: Retraced, segments: Segments, offset: float = 0.0) -> tuple[Array, Array]:
    """Return bounds on the errors of points and of the legs' directions in units of u, N × (D+1); NaN after the end.

    `offset`: the shift of rays along the normal behind a boundary, in units of u (1 + max |p|).
    """
    g, h_factor, phi_factor = (x.astype(float) for x in transfer(path))
    unit, size = float(ROUNDINGS), _sizes(path, segments)
    before, behind = path.legs[:, :-1], path.legs[:, 1:]
    cos, cos_behind = (np.abs((d * path.normals).sum(2)) for d in (before, behind))
    length = np.hypot(*(np.asarray(segments.end) - segments.start).T)[path.hits]
    added_h = (size[:, 1:] * (1 + (cos_behind + np.abs(cross(before, behind))) / cos)).astype(float)
    added_phi = (1 + np.abs(g) + 1 / cos_behind + np.abs(1 - g) * size[:, 1:] / length).astype(float)
    cos = cos.astype(float)
    shift = (1 + np.abs(path.points[:, 1:]).max(2)) * np.abs(cross(path.normals, path.legs[:, 1:]))
    added_h = unit * added_h + offset * shift.astype(float)
    leg = np.hypot(*np.diff(path.points, axis=1).transpose(2, 0, 1)).astype(float)
    points, directions = np.full((2, *path.points.shape[:2]), np.nan)
    points[:, 0], directions[:, 0] = unit * size[:, 0], unit
    zero = np.zeros(len(points))
    # One column per rounding so far: its propagated effect.
    h, phi = np.stack([points[:, 0], zero], 1), np.stack([zero, directions[:, 0]], 1)
    for j, has_hit in enumerate((path.hits >= 0).T):
        if not has_hit.any():
            break
        h = h + leg[:, j, None] * phi
        reach = (np.abs(h).sum(1) + unit * size[:, j + 1] * (1 + cos[:, j])) / cos[:, j]
        points[:, j + 1] = np.where(has_hit, reach, np.nan)
        phi = g[:, j, None] * phi + phi_factor[:, j, None] * h
        h = np.column_stack([h_factor[:, j, None] * h, added_h[:, j], zero])
        phi = np.column_stack([phi, zero, unit * added_phi[:, j]])
        directions[:, j + 1] = np.where(has_hit, np.abs(phi).sum(1), np.nan)
    return points, directions


def transfer(path: Retraced) -> tuple[Array, Array, Array]:
    """Return g, and the factors with which h enters h' and φ' (N × D each)."""
    before, behind = ((legs * path.normals).sum(2) for legs in (path.legs[:, :-1], path.legs[:, 1:]))
    # A ray that ends at a medium mismatch counts as unchanged there.
    g = np.nan_to_num(path.indices[:, :-1] * before / (path.indices[:, 1:] * behind), nan=1)
    return g, behind / before, (g - 1) * path.curvatures / before


def _sizes(path: Retraced, segments: Segments) -> Array:
    """Return the largest coordinate so far, N × (D+1), of the path and of the segments on it."""
    largest = np.max([np.abs(x).max(1) for x in (segments.start, segments.end, segments.control)], axis=0)
    own = np.abs(path.points).max(2)
    own[:, 1:] = np.maximum(own[:, 1:], np.where(path.hits >= 0, largest[path.hits], np.nan))
    return np.maximum.accumulate(own, axis=1).astype(float)


def undecided(exact: Retraced, paths: Paths, segments: Segments, points: Array, directions: Array) -> Array:
    """Return which wrong paths (N) rounding may cause, from the error bounds of the exact points and directions.

    Their rays meet a vertex where the first boundary or event differs; or they touch a curve or are at the critical
    angle, there or before: both may turn a ray by more than its bound. What happens at the critical angle cannot change
    which boundary was met there. A ray within h of a curve's top has a cosine below √(2 |κ| h); an error of φ changes
    the decision on refraction if |1 − k² sin²θ| is below 2 k φ.
    """
    other_hit = paths.hits != exact.hits
    differs = paths.events != exact.events
    differs[:, :-1] |= other_hit
    first = differs.argmax(1)
    since = np.arange(other_hit.shape[1]) - first[:, None]  # number of boundaries since the first difference
    h, kappa = points[:, 1:], np.abs(exact.curvatures)
    cos = (exact.legs[:, :-1] * exact.normals).sum(2)
    behind = np.where(cos > 0, *(np.asarray(n)[exact.hits] for n in (segments.n_left, segments.n_right)))
    k, sine = exact.indices[:, :-1] / behind, np.abs(cross(exact.normals, exact.legs[:, :-1]))
    ends = [np.asarray(x)[exact.hits] for x in (segments.start, segments.end)]
    clearance = np.min([np.hypot(*(exact.points[:, 1:] - end).transpose(2, 0, 1)) for end in ends], axis=0)
    with np.errstate(invalid="ignore"):
        at = (np.where(exact.hits >= 0, clearance, np.nan) <= h) & (since == 0)
        at |= (cos**2 <= 2 * kappa * h) & (since <= 0)
        critical = np.abs(1 - (k * sine) ** 2) <= 2 * k * (directions[:, :-1] + kappa * h)
        at |= critical & (since <= 0) & ~other_hit
    # Paths whose first wrong boundary is a curve that they only touch, or a segment past whose end the exact ray runs.
    rays = np.flatnonzero(((since == 0) & other_hit & (paths.hits >= 0)).any(1))
    first = first[rays]
    point, d = paths.points[rays, first + 1], exact.legs[rays, first]
    leg = point - exact.points[rays, first]
    normal, curvature = Curves(segments).normal(point.astype(np.longdouble), paths.hits[rays, first])
    near = points[rays, first] + np.hypot(*leg.T) * directions[rays, first]
    passed = (d * normal).sum(1) ** 2 <= 2 * np.abs(curvature) * near
    for vertices in (segments.start, segments.end):
        to = np.asarray(vertices)[paths.hits[rays, first]] - exact.points[rays, first]
        passed |= np.abs(cross(d, to)) <= points[rays, first] + np.hypot(*to.T) * directions[rays, first]
    result: Array = np.any(at, axis=1)
    result[rays] |= passed & (np.abs(cross(d, leg)) <= near)
    return result
