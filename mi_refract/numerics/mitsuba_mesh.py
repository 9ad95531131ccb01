"""Convert between Mitsuba's meshes and arrays; only this file depends on the layout and the names of their buffers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from types import ModuleType

    import numpy as np
    from numpy.typing import NDArray

MOST_FACES = 2**14  # of a mesh that `sliver_length` reads


def arrays(mesh: Any) -> tuple[NDArray[Any], NDArray[np.uint32]]:
    """The vertices (V, 3) of a mesh in Mitsuba's precision, and its faces (F, 3) as numbers of vertices."""
    import numpy as np

    return np.array(mesh.vertex_positions_buffer()).reshape(-1, 3), np.array(mesh.faces_buffer()).reshape(-1, 3)


def bounding_box(shape: Any) -> Any:
    """The bounding box of a shape. Mitsuba's box of a mesh that it has merged from several shapes omits rectangles."""
    import numpy as np

    box = shape.bbox()
    if shape.class_name() != "Mesh":
        return box
    vertices = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)
    if not len(vertices):
        return type(box)()  # which is not valid
    return type(box)(*([*map(float, ends(0))] for ends in (vertices.min, vertices.max)))


def sliver_length(mesh: Any) -> float:
    """The length L²/h that is exceeded on a thousandth of the surface; L: longest edge of a face, h: its height on it.

    The error of the distance at which a ray hits a face grows with it. Of a large mesh some faces stand for all.
    """
    import numpy as np

    vertices, faces = arrays(mesh)
    faces = faces[:: len(faces) // MOST_FACES + 1]
    p, q, r = (vertices[faces[:, i]].astype(float) for i in range(3))
    longest = np.max([np.linalg.norm(edge, axis=1) for edge in (q - p, r - q, p - r)], axis=0)
    areas = np.linalg.norm(np.cross(q - p, r - p), axis=1)
    hit = areas > 0
    lengths, areas = longest[hit] ** 3 / areas[hit], areas[hit]
    order = np.argsort(-lengths)
    exceeding = np.cumsum(areas[order])
    return float(lengths[order][np.searchsorted(exceeding, 1e-3 * exceeding[-1])]) if len(order) else 0.0


def has_normals(mesh: Any) -> bool:
    """Whether the mesh has vertex normals, which it interpolates."""
    return bool(mesh.has_vertex_normals())


def is_smooth(mesh: Any) -> bool:
    """Whether vertex normals differ from those of the faces by more than 1e-3."""
    import numpy as np

    if not has_normals(mesh):
        return False
    vertices, faces = arrays(mesh)
    p, q, r = (vertices[faces[:, i]].astype(float) for i in range(3))
    face = np.cross(q - p, r - p)
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), np.finfo(float).tiny)
    normals = np.array(mesh.vertex_normals_buffer()).reshape(-1, 3)[faces]
    return bool((np.linalg.norm(np.cross(normals, face[:, None]), axis=-1) > 1e-3).any())


def make(
    v: ModuleType,
    vertices: NDArray[Any],
    faces: NDArray[Any],
    normals: NDArray[Any] | None = None,
    *,
    properties: Any = None,
) -> Any:
    """A mesh of the Mitsuba variant `v` from vertices (V, 3), faces (F, 3) and vertex normals (V, 3) or None.

    `properties`: Mitsuba's `Properties` with its BSDF, emitter and flags.
    """
    import mitsuba as mi
    import numpy as np

    smooth, more = normals is not None, {} if properties is None else {"props": properties}
    mesh = v.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=smooth, **more)
    parameters = mi.traverse(mesh)
    parts = {"vertex_positions": vertices, "faces": faces} | ({"vertex_normals": normals} if smooth else {})
    for name, values in parts.items():
        number = np.uint32 if name == "faces" else np.float32
        parameters[name] = type(parameters[name])(np.asarray(values, number).ravel())
    parameters.update()
    return mesh
