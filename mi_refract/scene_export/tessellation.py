"""Tessellation of Mitsuba's shapes: flat triangles in the shape's coordinates, counterclockwise as seen from outside.

"Outside" is the side of the normal. The vertices of a curved shape lie on its surface. Each `level` halves the length
of the edges.
"""

from __future__ import annotations

import functools
import itertools

import numpy as np
from numpy.typing import NDArray

Vertices = NDArray[np.float64]  # (V, 3)
Faces = NDArray[np.int64]  # (F, 3)
Triangles = tuple[Vertices, Faces]

GOLDEN = (1 + 5**0.5) / 2


@functools.cache
def sphere(level: int) -> Triangles:
    """Return the unit sphere: an icosahedron with each face divided into 4^level triangles."""
    corners = np.array([[-1, GOLDEN, 0], [1, GOLDEN, 0], [-1, -GOLDEN, 0], [1, -GOLDEN, 0]])
    corners = np.concatenate([np.roll(corners, shift, axis=1) for shift in (0, 1, 2)])
    near = np.isclose(np.linalg.norm(corners[:, None] - corners, axis=-1), 2)
    triples = itertools.combinations(range(12), 3)
    faces = [(i, j, k) for i, j, k in triples if near[i, j] and near[j, k] and near[k, i]]
    triangles = corners[np.array(faces)] / np.hypot(1, GOLDEN)
    inward = np.linalg.det(triangles) < 0
    triangles[inward] = triangles[inward, ::-1]
    for _ in range(level):
        a, b, c = triangles.swapaxes(0, 1)
        ab, bc, ca = ((p + q) / np.linalg.norm(p + q, axis=-1, keepdims=True) for p, q in ((a, b), (b, c), (c, a)))
        quarters = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        triangles = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
    vertices, order = welded(triangles)
    vertices.flags.writeable = order.flags.writeable = False  # the cache shares these arrays
    return vertices, order


def welded(triangles: NDArray[np.float64]) -> Triangles:
    """Return the vertices and faces of triangles (F, 3, 3). Corners with the same position become one vertex."""
    vertices, index = np.unique(triangles.reshape(-1, 3) + 0.0, axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3).astype(np.int64)


def is_closed(faces: Faces) -> bool:
    """Return whether each edge borders two faces, once in either direction. Precondition: the vertices are welded."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = faces.max(initial=0) + 1
    forward, backward = (np.sort(edges @ np.array(digits)) for digits in ((count, 1), (1, count)))
    return bool((np.diff(forward) > 0).all() and (forward == backward).all())


def turns(triangles: NDArray[np.float64], point: Vertices) -> float:
    """Return how often closed triangles (F, 3, 3) surround a point (3), by the sum of solid angles.

    A body that faces outward counts 1 inside, one that faces inward −1.
    """
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    x, y, z = (np.linalg.norm(p, axis=1) for p in (a, b, c))
    ab, bc, ca = ((p * q).sum(1) for p, q in ((a, b), (b, c), (c, a)))
    halves = np.arctan2(np.linalg.det(np.stack([a, b, c], 1)), x * y * z + ab * z + bc * x + ca * y)
    return float(halves.sum() / (2 * np.pi))


def encloses(triangles: NDArray[np.float64], point: Vertices) -> bool:
    """Return whether closed triangles (F, 3, 3) that face outward enclose a point (3)."""
    return turns(triangles, point) > 0.5


def bodies(faces: Faces) -> Faces:
    """Return for each face the first vertex of its body (F); faces that share a vertex belong to one body."""
    first = np.arange(faces.max(initial=-1) + 1)
    while True:
        earlier = first.copy()
        np.minimum.at(earlier, faces, first[faces].min(axis=1, keepdims=True))
        earlier = earlier[earlier]
        if (earlier == first).all():
            return first[faces[:, 0]]
        first = earlier


def has_body_inside_out(vertices: Vertices, faces: Faces, eye: Vertices) -> bool:
    """Return whether a point `eye` (3) outside a body that faces inward may see it. Precondition: all are closed.

    It does not if the others surround that body in another way than `eye`: as a solid its cavity, or a room `eye`.
    """
    body, triangles = bodies(faces), vertices[faces]
    volumes = np.bincount(body, np.linalg.det(triangles - vertices[body][:, None]))
    around_eye = turns(triangles, eye)
    for number in np.flatnonzero(volumes < 0):
        own, others = triangles[body == number], triangles[body != number]
        corners = own.reshape(-1, 3)
        ends = corners[[*corners.argmin(axis=0), *corners.argmax(axis=0)]]  # not all in contact with another body
        if turns(own, eye) > -0.5 and any(abs(turns(others, end) - around_eye) < 0.25 for end in ends):
            return True
    return False


def basis(axis: Vertices) -> Vertices:
    """Return an orthonormal right-handed basis (3, 3) whose last column is `axis`, of length 1.

    The basis of (0, 0, 1) is the identity.

    Source: Duff et al. 2017, Building an Orthonormal Basis, Revisited.
    """
    x, y, z = axis
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    return np.stack([[1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y], axis], axis=1)


def grid(u: NDArray[np.float64], v: NDArray[np.float64], chosen: NDArray[np.bool_]) -> Triangles:
    """Return two triangles for each chosen cell [i, j] between u[i], u[i + 1], v[j], v[j + 1] in the plane z = 0."""
    vertices = np.stack([*np.meshgrid(u, v, indexing="ij"), np.zeros((len(u), len(v)))], axis=-1)
    a, b, c, d = vertices[:-1, :-1], vertices[1:, :-1], vertices[1:, 1:], vertices[:-1, 1:]
    triangles = np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)], axis=2)
    return welded(triangles[chosen].reshape(-1, 3, 3))


def rectangle() -> Triangles:
    """Return the square [−1, 1]² in the plane z = 0."""
    ends = np.array([-1.0, 1.0])
    return grid(ends, ends, np.ones((1, 1), bool))


def checkerboard(scale_u: float, scale_v: float) -> tuple[Triangles, Triangles]:
    """Return the parts of the rectangle in `color0` and in `color1`, for a checkerboard with these scales of uv."""
    # 0, the borders between cells, 1: a cell is half a unit of the scaled coordinate.
    u, v = (np.array([0, *np.arange(1, np.ceil(2 * scale)) / (2 * scale), 1.0]) for scale in (scale_u, scale_v))
    # The middle of a cell, in half units of the scaled coordinate, is odd if Mitsuba's fraction is above one half.
    odd_u, odd_v = (np.floor((x[:-1] + x[1:]) * scale) % 2 == 1 for x, scale in ((u, scale_u), (v, scale_v)))
    same = odd_u[:, None] == odd_v
    return grid(2 * u - 1, 2 * v - 1, same), grid(2 * u - 1, 2 * v - 1, ~same)


def cube() -> Triangles:
    """Return the cube [−1, 1]³."""
    face, order = rectangle()
    face = face + np.array([0.0, 0.0, 1.0])
    turns = [np.roll(face, shift, axis=1) for shift in (0, 1, 2)]
    # A half turn keeps the orientation, and moves each of the three faces to the opposite one.
    turns += [turn * mirror for turn, mirror in zip(turns, ([1, -1, -1], [-1, 1, -1], [-1, -1, 1]), strict=True)]
    return welded(np.concatenate([turn[order] for turn in turns]))


def disk(level: int) -> Triangles:
    """Return the unit disk in the plane z = 0."""
    rim = _circle(level)
    i = np.arange(len(rim))
    faces = np.stack([i, (i + 1) % len(rim), np.full(len(rim), len(rim))], axis=1)
    return np.concatenate([rim, np.zeros((1, 3))]), faces


def cylinder(level: int) -> Triangles:
    """Return the open cylinder of radius 1 from z = 0 to z = 1."""
    rim = _circle(level)
    count = len(rim)
    i, j = np.arange(count), (np.arange(count) + 1) % count
    faces = np.concatenate([np.stack([i, j, j + count], axis=1), np.stack([i, j + count, i + count], axis=1)])
    return np.concatenate([rim, rim + np.array([0.0, 0.0, 1.0])]), faces


def _circle(level: int) -> Vertices:
    """Return 8 · 2^level vertices of the unit circle, (V, 3)."""
    segments = 8 << level
    angle = 2 * np.pi * np.arange(segments) / segments
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(segments)], axis=1)
