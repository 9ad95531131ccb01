"""Scenes of caustics: glass, water or a mirror over a matt floor with one lamp, and a disk below glass on an axis.

Bodies are about 1 in size. The floor is y = 0, and the lamp is at DISTANCE from the point of the floor below the body.
All lamps have the same irradiance there, 1 W/m², so that images of different lamps are comparable.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mi_refract.numerics import mitsuba_mesh
from validation.reference import caustic_energy
from validation.reference.caustic_energy import ON_AXIS, PARALLEL, POINT, REFLECTANCE, SPOT, TOP
from validation.run.context import SCENES
from validation.run.render_methods import sensor

Nodes = dict[str, Any]  # for `mi.load_dict`
Array = NDArray[np.float64]

# Lamps ---------------------------------------------------------------------------------------------------------

DISTANCE = 6.0
TOWARDS = np.array([2.0, 6.0, -1.0]) / math.sqrt(41)  # from the floor below the body to the lamp
SMALL = 0.05  # largest side of a small lamp, over the distance
SIDES = (0.01, 0.05, 0.2, 0.7)  # of square lamps, over the distance


def square(side: float) -> Nodes:
    """Return a square lamp that faces the body; `side`: over the distance."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().look_at([*(DISTANCE * TOWARDS)], [0, 0, 0], [0, 0, 1]).scale(side * DISTANCE / 2)
    emitter = {"type": "area", "radiance": 1 / side**2}
    return {"type": "rectangle", "to_world": place, "emitter": emitter}


def spot() -> Nodes:
    """Return a spot lamp around the body."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().look_at([*(DISTANCE * TOWARDS)], [0, 0, 0], [0, 0, 1])
    return {"type": "spot", "to_world": place, "intensity": DISTANCE**2, "cutoff_angle": 25.0, "beam_width": 20.0}


ZERO_SIZE: dict[str, Callable[[], Nodes]] = {
    POINT: lambda: {"type": "point", "position": [*(DISTANCE * TOWARDS)], "intensity": DISTANCE**2},
    SPOT: spot,
    PARALLEL: lambda: {"type": "directional", "direction": [*-TOWARDS], "irradiance": 1.0},
}


def side_of(lamp: str) -> float:
    """Return a lamp's side over its distance; 0 for lamps without size."""
    return 0.0 if lamp in ZERO_SIZE else float(lamp.split()[-1])


LAMPS = (*(f"square {side}" for side in SIDES), *ZERO_SIZE)


def lamp_of(name: str) -> Nodes:
    """Return the lamp of this name."""
    return ZERO_SIZE[name]() if name in ZERO_SIZE else square(side_of(name))


# Meshes --------------------------------------------------------------------------------------------------------


def grid_mesh(points: Array, bsdf: Nodes, normals: Array | None = None) -> Any:
    """Return a mesh of rows × columns points (… × 3), without triangles of zero area.

    A face normal is (step to the next column) × (step to the next row).
    """
    import mitsuba as mi

    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = points.reshape(-1, 3)
    p, q, r = (vertices[faces[:, i]] for i in range(3))
    faces = faces[np.linalg.norm(np.cross(q - p, r - p), axis=1) > 1e-12]
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    if normals is None:
        properties["face_normals"] = True
    normals = None if normals is None else normals.reshape(-1, 3)
    return mitsuba_mesh.make(mi, vertices, faces.astype(np.uint32), normals, properties=properties)


def revolved(profile: Array, bsdf: Nodes, turns: int, normals: Array | None = None) -> Any:
    """Return the surface of revolution of a profile (N × 2: distance from the y axis, y), with glass on its right."""
    angle = np.linspace(0, 2 * np.pi, turns + 1)
    angle[-1] = 0

    def around(x: Array) -> Array:
        return np.stack(np.broadcast_arrays(x[:, :1] * np.cos(angle), x[:, 1:], x[:, :1] * np.sin(angle)), -1)

    return grid_mesh(around(profile), bsdf, None if normals is None else around(normals))


# Bodies --------------------------------------------------------------------------------------------------------


BLACK = "diffuse"  # in place of the plugin of glass: the body is black and casts a shadow


def surface(bsdf: str, **boundary: Any) -> Nodes:
    """Return a boundary of a plugin with these parameters, or a black surface."""
    return {"type": BLACK, "reflectance": 0.0} if bsdf == BLACK else {"type": bsdf} | boundary


def glass(bsdf: str, int_ior: float = 1.5, ext_ior: float = 1.0) -> Nodes:
    """Return a boundary of two media by a plugin."""
    return surface(bsdf, int_ior=int_ior, ext_ior=ext_ior)


def ball(bsdf: str) -> Nodes:
    """Return a glass ball over the floor."""
    return {"ball": {"type": "sphere", "center": [0, 1.2, 0], "bsdf": glass(bsdf)}}


def lens(bsdf: str) -> Nodes:
    """Return a plano-convex lens over the floor; its focus is below the floor."""
    return {"lens": revolved(caustic_energy.lens_profile(24, 1.2, scale=1.8), glass(bsdf), 72)}


def water_glass(bsdf: str) -> Nodes:
    """Return a tumbler of water: boundaries of glass and air, glass and water, water and air."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([0, 0.01, 0]).scale(1 / 45)
    media = {"tumbler_air": (1.5168, 1.0), "tumbler_wet": (1.5168, 1.333), "water_top": (1.333, 1.0)}
    return {name: ply(name, place, glass(bsdf, *indices)) for name, indices in media.items()}


def diamond(bsdf: str) -> Nodes:
    """Return a round brilliant that stands on its tip."""
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate([0, 0.9, 0]).scale(1 / 50)
    return {"brilliant": ply("diamond", place, glass(bsdf, 2.419))}


def ply(name: str, place: Any, bsdf: Nodes) -> Nodes:
    """Return a mesh of the scene files, with flat facets."""
    filename = str(SCENES / "meshes" / f"{name}.ply")
    return {"type": "ply", "filename": filename, "face_normals": True, "to_world": place, "bsdf": bsdf}


def ring(bsdf: str) -> Nodes:
    """Return a polished ring of gold on the floor; its caustic is of reflected light only."""
    angle = np.linspace(0, -2 * np.pi, 49)
    normals = np.stack([np.cos(angle), np.sin(angle)], 1)
    band = np.array([[1.0, 0.26]]) + np.array([[0.06, 0.25]]) * normals
    normals = normals / [[0.06, 0.25]]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return {"ring": revolved(band, surface(bsdf if bsdf == BLACK else "conductor", material="Au"), 96, normals)}


def pool(bsdf: str) -> Nodes:
    """Return a water surface with waves and their normals; the camera is below it."""
    side, height, waves = np.linspace(-8, 8, 161), 2.6, ((1.1, 0.7, 0.3), (-0.6, 1.5, 1.9), (2.1, -1.2, 4.0))
    z, x = np.meshgrid(side, side, indexing="ij")
    y, slope_x, slope_z = np.full_like(x, height), np.zeros_like(x), np.zeros_like(x)
    for a, b, phase in waves:
        size = 0.3 / math.hypot(a, b)
        y += size * np.sin(a * x + b * z + phase)
        slope_x += size * a * np.cos(a * x + b * z + phase)
        slope_z += size * b * np.cos(a * x + b * z + phase)
    normals = np.stack([-slope_x, np.ones_like(x), -slope_z], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    points = np.stack([x, y, z], -1)[::-1]  # triangles face up
    return {"water": grid_mesh(points, glass(bsdf, 1.333), normals[::-1])}


BODIES: dict[str, Callable[[str], Nodes]] = {
    "ball": ball,
    "lens": lens,
    "glass of water": water_glass,
    "diamond": diamond,
    "ring": ring,
    "pool": pool,
}
CAMERA, BELOW_WATER = [0.0, 5.0, 8.0], [0.0, 1.9, 4.5]
FLOOR = 0.5  # reflectance


def scene(body: str, lamp: str, bsdf: str, resolution: int, floor: float = FLOOR) -> Any:
    """Load a body and a lamp by name. `bsdf`: the plugin of the glass; `floor`: reflectance of the floor."""
    import mitsuba as mi

    view = sensor(resolution, *((70, BELOW_WATER) if body == "pool" else (24, CAMERA)), target=(0.0, 0.4, 0.0))
    flat = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(6)
    below = {"type": "rectangle", "to_world": flat, "bsdf": {"type": "diffuse", "reflectance": floor}}
    parts = {"sensor": view, "floor": below, "lamp": lamp_of(lamp)} | BODIES[body](bsdf)
    return mi.load_dict({"type": "scene"} | parts, parallel=False, optimize=False)


# A disk below a body, on the axis of a lamp --------------------------------------------------------------------


def disk_scene(body: str, lamp: str, bsdf: str, resolution: int) -> tuple[Any, Array]:
    """Load a body over its disk; return the scene and, per pixel, power on the disk over radiance, in m² sr."""
    import mitsuba as mi

    setup, radius = ON_AXIS[body, lamp]
    solid: Any = {"type": "sphere", "center": [0, caustic_energy.BALL_HEIGHT, 0], "bsdf": glass(bsdf)}
    if body == "lens":
        solid = revolved(caustic_energy.lens_profile(128), glass(bsdf), 384)
    beam = math.degrees(setup.widest) + 1
    down = mi.ScalarTransform4f().look_at([0, TOP, 0], [0, 0, 0], [1, 0, 0])
    lamps = {
        POINT: {"type": "point", "position": [0, TOP, 0], "intensity": 1.0},
        SPOT: {"type": "spot", "to_world": down, "intensity": 1.0, "beam_width": beam, "cutoff_angle": beam + 1},
        PARALLEL: {"type": "directional", "direction": [0, -1, 0], "irradiance": 1.0},
    }
    flat = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(radius)
    disk = {"type": "disk", "to_world": flat, "bsdf": {"type": "diffuse", "reflectance": REFLECTANCE}}
    view = sensor(resolution, caustic_energy.FIELD, [*caustic_energy.VIEWPOINT])
    parts = {"sensor": view, "disk": disk, "body": solid, "lamp": lamps[lamp]}
    return mi.load_dict({"type": "scene"} | parts), caustic_energy.power_by_radiance(resolution)
