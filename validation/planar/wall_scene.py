"""Planar scenes extruded: segments as upright walls in Mitsuba, and their view from above."""

from __future__ import annotations

from typing import Any

import numpy as np

from mi_refract.planar import Segments, curves
from mi_refract.plugins import PLUGIN
from validation.reference.planar_retrace import Array

Z = -1.0, 2.0  # a ray at z = 0 does not meet the triangles' common edge in the middle of a wall


def facets(segments: Segments, count: int) -> Segments:
    """Each arc as `count` chords; straight segments as they are."""
    if segments.control is None:
        return segments
    straight = (segments.control == (segments.start + segments.end) / 2).all(1)
    along = curves.points(segments, count)[~straight]
    pieces = (segments.start[straight], along[:, :-1]), (segments.end[straight], along[:, 1:])
    start, end = (np.concatenate([x, y.reshape(-1, 2)]) for x, y in pieces)
    media = [np.append(n[straight], np.repeat(n[~straight], count)) for n in (segments.n_left, segments.n_right)]
    return Segments(start, end, *media)


def extrude(segments: Segments) -> Any:
    """A Mitsuba scene of walls, their normals to the left. Faces carry the number of their segment."""
    import mitsuba as mi

    media = np.stack([segments.n_left, segments.n_right], 1)
    pairs, which = np.unique(media, axis=0, return_inverse=True)
    meshes = {f"walls_{k}": _mesh(segments, np.flatnonzero(which.ravel() == k)) for k in range(len(pairs))}
    return mi.load_dict({"type": "scene", **meshes})


def _mesh(segments: Segments, chosen: Array) -> Any:
    """Of the segments `chosen`, which part the same two media."""
    import mitsuba as mi

    count = len(chosen)
    ends = [np.asarray(x)[chosen] for x in (segments.start, segments.end)]
    corners = [np.column_stack([end, np.full(count, z)]) for z in Z for end in ends]
    # Start, end, start above, end above; seen from the left of the segment, counter-clockwise.
    faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 3, 1], [0, 2, 3]])
    ior = {"ext_ior": float(segments.n_left[chosen[0]]), "int_ior": float(segments.n_right[chosen[0]])}
    properties = mi.Properties()
    properties["face_normals"] = True
    properties["glass"] = mi.load_dict({"type": PLUGIN, **ior})
    mesh = mi.Mesh("walls", 4 * count, 2 * count, props=properties)
    parameters = mi.traverse(mesh)
    for key, values in (("positions", np.stack(corners, 1).astype(np.float32)), ("faces", faces.astype(np.uint32))):
        name = next(name for name in parameters.keys() if name.endswith(key))  # noqa: SIM118  no dictionary
        parameters[name] = type(parameters[name])(values.ravel())
    mesh.add_attribute("face_segment", 1, np.repeat(chosen, 2).astype(float).tolist())
    parameters.update()
    return mesh


class Plan:
    """The plane z = 0 of an extruded scene from above, `middle` ± `half`: media by index, as rays along x find them."""

    def __init__(self, scene: Any, segments: Segments, size: int) -> None:
        """`size`: pixels on a side."""
        import mitsuba as mi

        corners = np.concatenate([segments.start, segments.end])
        self.middle, self.half = (corners.min(0) + corners.max(0)) / 2, 0.75 * float(np.ptp(corners, axis=0).max())
        down, right = (2 * np.mgrid[0.5:size, 0.5:size] / size - 1).reshape(2, -1)
        x, y = self.middle[:, None] + self.half * np.stack([right, -down])
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 0), mi.Vector3f(1, 0, 0)))
        segment = np.array(si.shape.eval_attribute_1("face_segment", si, si.is_valid())).astype(int)
        # A ray starts on the right of a wall whose normal, which points to the left, is along it.
        index = np.where(np.array(si.n.x) > 0, segments.n_right[segment], segments.n_left[segment])
        least, most = (f(segments.n_left, segments.n_right) for f in (np.minimum, np.maximum))
        index = np.where(np.array(si.is_valid()), index, least.min())
        share = (index - least.min()) / max(most.max() - least.min(), 1e-9)
        self.image = (0.02 + 0.25 * share.reshape(size, size, 1)) * np.array([0.4, 0.7, 1.0])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Where points (N × 3) are on the image, from 0 to 1, y downward."""
        seen = (points[:, :2] - self.middle) / self.half
        return 0.5 + 0.5 * seen * [1, -1]
