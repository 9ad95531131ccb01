"""rayoptics' sequential trace of a centred lens, with given indices and with those of its own glasses.

In and out: JSON, see `validation.suite.lenses`. The glasses come from opticalglass, which rayoptics uses.
"""

import json
import sys
from importlib.metadata import version

import numpy as np
from opticalglass.glassfactory import create_glass
from rayoptics.elem.profiles import Spherical
from rayoptics.elem.surface import Surface
from rayoptics.raytr.raytrace import trace_raw

AXIS = np.array([0.0, 0.0, 1.0])


def traced(lens, indices, height, wavelength):
    """Return [z, y, dz, dy] after the last surface, with z from the first vertex."""
    object_plane = Surface("Obj", interact_mode="dummy")
    surfaces = [object_plane, *(Surface(profile=Spherical(c=c)) for c in lens["curvatures"])]
    steps = [-lens["start"], *lens["thicknesses"], 0.0]
    path = [
        (surface, None, (np.eye(3), step * AXIS), n, 1)
        for surface, step, n in zip(surfaces, steps, [1.0, *indices, 1.0], strict=True)
    ]
    ray, _, _ = trace_raw(iter(path), np.array([0.0, height, 0.0]), AXIS, wavelength)
    point, direction = ray[-1][:2]
    return [float(x) for x in (point[2] + sum(lens["thicknesses"]), point[1], direction[2], direction[1])]


lens = json.load(sys.stdin)
glasses = [create_glass(name, catalog) for catalog, name in lens["glasses"]]
own = [[float(glass.rindex(w)) for w in lens["wavelengths"]] for glass in glasses]
rays = {
    name: [
        [traced(lens, n, height, w) for height in lens["heights"]]
        for w, n in zip(lens["wavelengths"], zip(*indices, strict=True), strict=True)
    ]
    for name, indices in (("given", lens["indices"]), ("own", own))
}
system = f"rayoptics {version('rayoptics')}, opticalglass {version('opticalglass')}"
json.dump({"system": system, "indices": own, "rays": rays}, sys.stdout)
