"""Dispersive optics with closed forms, traced in two dimensions in float64.

A prism at minimum deviation for the lines C, d and F: δ = 2 asin(n sin(A/2)) − A. The primary and the secondary rainbow
at four wavelengths: the deviation is stationary at cos² θ = (n² − 1)/(p(p + 2)), with p reflections. An achromat: the
focal distance of a ray near the axis, by wavelength, against thick-lens matrices. The same achromat through Mitsuba's
intersections, in float32: where a ray from the edge of a beam crosses the axis, by wavelength, against a trace in 80
decimals. Its bound adds all roundings at their worst.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mi_refract import media
from mi_refract.media import LINES
from mi_refract.planar import scene_file
from mi_refract.planar.path_tree import Branches, follow_scene
from mi_refract.plugins.refract import followed_context
from mi_refract.report.row import Row
from validation.limits import BOW_ANGLE, FOCAL_DISTANCE, LENS_TRACE, PRISM_ANGLE
from validation.reference import closed_forms as closed
from validation.reference.exact_lens import ACHROMAT, START, Lens, Rounding, bound, crossing, on_axis
from validation.run.bsdf_sampling import along_the_ray
from validation.run.context import SCENES, Context
from validation.run.metrics import ERROR_OVER_BOUND
from validation.run.render_methods import under
from validation.study import Study, Task, about

NAME = "dispersive optics"
FOLDER = SCENES / "planar"
BOWS = (450.0, 520.0, 580.0, 650.0)  # nm
HEIGHT, MARGIN = 1e-3, 10.0  # distances from the axis: of a ray near it, and of one at the edge
# Centre, radius and point are rounded to float32, and the point is projected onto the sphere along its normalised
# normal: 8u. The local frame, the direction in it and the transformation back rotate a ray by up to 12u.
MITSUBA = Rounding(sine=1.0, normal=8.0, turn=12.0, bend=(1.0, 1.0, 1.0), height=8.0, depth=8.0, centres=True)
SPECTRAL = "llvm_ad_spectral"
TERMS = {
    "error": "largest angle between the traced direction and the closed form, in radians, over all wavelengths",
    "off": "largest error of the point where a ray crosses the axis, at 103 units from the lens",
    ERROR_OVER_BOUND: "the same over its bound",
    "off / chromatic shift": "the same over the largest distance between the points of two wavelengths",
    "distance": "largest relative error of the focal distance over all wavelengths",
}


def traced(scene: scene_file.PlanarScene, origin: Any, direction: Any) -> Branches:
    """Trace one ray and return its branches."""
    o, d = np.array([origin], float), np.array([direction], float)
    (branches,) = follow_scene(replace(scene, origins=o, directions=d, beams=np.zeros(1, int)))
    return branches


def angle(branches: Branches, turn: float, bits: int = 0) -> float:
    """Return the angle, in radians, between the path with these reflections and a direction `turn` clockwise from x."""
    (number,) = np.flatnonzero(branches.reflect == bits)
    (x, y), (a, b) = branches.paths.directions[number], (math.cos(turn), -math.sin(turn))
    return abs(math.atan2(x * b - y * a, x * a + y * b))


def prism_row() -> Row:
    """Return the row of one ray per line, at its angle of minimum deviation; inside, it is parallel to the base."""
    apex, errors = math.radians(60.0), []
    for line in "CdF":
        scene = scene_file.load(FOLDER / "spectrum.toml", [LINES[line]])
        half = float(closed.least_deviated(apex, scene.regions[0].indices[0])) - apex / 2
        along = np.array([math.cos(half), math.sin(half)])
        face = np.array([-15.0, 34.64101615137755 * 2 / 3 - 15.0 * math.sqrt(3)])  # on the left face
        errors.append(angle(traced(scene, face - 20 * along, along), half))
    return Row(NAME, "prism", "minimum deviation", "float64", {"error": float(np.max(errors))}, {"error": PRISM_ANGLE})


def bow_row(reflections: int) -> Row:
    """Return the row of one ray per wavelength, at the height that the bow comes from."""
    case, bits, errors = *{1: ("primary bow", 2), 2: ("secondary bow", 6)}[reflections], []
    for wavelength in BOWS:
        scene = scene_file.load(FOLDER / "double_rainbow.toml", [wavelength])
        n = media.index("MATERIAL:water", wavelength) / media.LABORATORY_AIR.index(wavelength)
        incidence = closed.rainbow_incidence(n, reflections)
        turn = float(closed.deflection(incidence, n, reflections))  # clockwise, for a ray above the axis
        errors.append(angle(traced(scene, [-16.0, math.sin(incidence)], [1.0, 0.0]), turn, bits))
    return Row(NAME, "drop", case, "float64", {"error": float(np.max(errors))}, {"error": BOW_ANGLE})


def achromat_row() -> Row:
    """Return the row of a ray HEIGHT above the axis, against the paraxial back focal distance."""
    scene, errors, focal = scene_file.load(FOLDER / "achromat.toml"), [], {}
    for i, wavelength in enumerate(scene.light.wavelengths):
        n = [region.indices[i] for region in scene.regions]
        expected = ACHROMAT.vertices[-1] + back_focal_distance(ACHROMAT, (1.0, *n, 1.0))
        ray = traced(replace(scene, segments=scene.segments[i : i + 1]), [START, HEIGHT], [1.0, 0.0])
        focal[wavelength] = float(on_axis(np.concatenate([ray.tips, ray.paths.directions], axis=1))[0])
        errors.append(abs(focal[wavelength] / expected - 1))
    values = {"distance": float(np.max(errors)), f"at {LINES['d']:g} nm": focal[LINES["d"]]}
    values |= {f"shift at {w:g} nm": x - focal[LINES["d"]] for w, x in focal.items() if w != LINES["d"]}
    return Row(NAME, "achromat", "focal distance", "float64", values, {"distance": FOCAL_DISTANCE})


def back_focal_distance(lens: Lens, n: Sequence[float]) -> float:
    """Return the paraxial back focal distance, from the last surface, by n' u' = n u − y c (n' − n)."""
    y, u = 1.0, 0.0
    for i, (c, thickness) in enumerate(zip(lens.curvatures, (*lens.thicknesses, 0.0), strict=True)):
        u = (n[i] * u - y * c * (n[i + 1] - n[i])) / n[i + 1]
        y += thickness * u
    return -y / u


def mitsuba_row(context: Context) -> Row:
    """Return the row of Mitsuba's intersections with three spheres, whose caps are the surfaces of the lens.

    A ray at MARGIN meets these caps first; it is followed up to the last one.
    """
    import drjit as dr
    import mitsuba as mi

    case = "through Mitsuba's intersections"
    if reason := context.variants.get(SPECTRAL, "not in this wheel"):
        return Row(NAME, "achromat", case, SPECTRAL, reason=reason)
    plane = scene_file.load(FOLDER / "achromat.toml")
    indices = np.array([region.indices for region in plane.regions]).T.tolist()
    exact = [crossing(ACHROMAT, (1.0, *n, 1.0), MARGIN, START) for n in indices]
    expected = np.array([float(x.place) for x in exact])
    table = tomllib.loads((FOLDER / "achromat.toml").read_text())
    glasses, parts = [1.0, *(shape["n"] for shape in table["shape"]), 1.0], {}
    with under(SPECTRAL):
        for i, (curvature, vertex) in enumerate(zip(ACHROMAT.curvatures, ACHROMAT.vertices, strict=True)):
            sides = glasses[i : i + 2] if curvature < 0 else glasses[i : i + 2][::-1]
            bsdf = {"type": "refract", "int_ior": sides[0], "ext_ior": sides[1]}
            centre = [vertex + 1 / curvature, 0.0, 0.0]
            parts[f"surface_{i}"] = {"type": "sphere", "center": centre, "radius": abs(1 / curvature), "bsdf": bsdf}
        scene: Any = mi.load_dict({"type": "scene"} | parts)
        bsdf_context = followed_context()
        bsdf_context.component = 1
        ray: Any = mi.Ray3f(mi.Point3f(START, MARGIN, 0), mi.Vector3f(1, 0, 0))
        ray.wavelengths = type(ray.wavelengths)(mi.Float(plane.light.wavelengths))
        for _ in parts:
            si = scene.ray_intersect(ray)
            bs, _ = si.bsdf().sample(bsdf_context, si, 0.5, [0.5, 0.5])
            wavelengths, ray = ray.wavelengths, along_the_ray(si, si.to_world(bs.wo))
            ray.wavelengths = wavelengths
        dr.eval(ray)
        off = np.abs(np.array(si.p.x - si.p.y * ray.d.x / ray.d.y, float) - expected)
    share = np.max([x / bound(ACHROMAT, e, MITSUBA, 2.0**-24) for x, e in zip(off, exact, strict=True)])
    values = {"off": float(off.max()), "off / chromatic shift": float(off.max() / np.ptp(expected))}
    values, budgets = values | {ERROR_OVER_BOUND: float(share)}, {ERROR_OVER_BOUND: LENS_TRACE}
    return Row(NAME, "achromat", case, SPECTRAL, values, budgets, replay={"height": MARGIN})


def tasks(context: Context) -> list[Task]:
    """Return the one task of the study."""
    return [Task(NAME, lambda: [prism_row(), bow_row(1), bow_row(2), achromat_row(), mitsuba_row(context)])]


STUDY = Study(NAME, "Dispersive optics", about(__doc__), TERMS, tasks)
