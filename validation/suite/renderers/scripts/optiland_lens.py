"""optiland's sequential trace of a centred lens, with given indices and with those of its own materials.

In and out: JSON, see `validation.suite.lenses`. The materials come from optiland's copy of refractiveindex.info.
"""

import contextlib
import json
import sys
from importlib.metadata import version

import numpy as np
from optiland.materials import IdealMaterial, Material
from optiland.optic import Optic
from optiland.rays import RealRays


def traced(lens, materials, wavelength):
    """Return [z, y, dz, dy] after the last surface for a ray at each height, with z from the first vertex."""
    optic = Optic()
    optic.surfaces.add(index=0, thickness=-lens["start"])
    steps = [*lens["thicknesses"], 100.0]
    for i, (c, step, material) in enumerate(zip(lens["curvatures"], steps, [*materials, "air"], strict=True), 1):
        optic.surfaces.add(index=i, radius=1 / c, thickness=step, material=material, is_stop=i == 1)
    optic.surfaces.add(index=len(steps) + 1)
    y = np.array(lens["heights"])
    zero, one = np.zeros_like(y), np.ones_like(y)
    rays = RealRays(zero, y, zero + lens["start"], zero, zero, one, one, zero + wavelength / 1000)
    optic.surfaces.trace(rays, skip=1)
    last = optic.surfaces[len(steps)]
    return np.stack([last.z, last.y, last.N, last.M], axis=1).tolist()


lens = json.load(sys.stdin)
with contextlib.redirect_stdout(sys.stderr):
    glasses = [Material(name, catalog=catalog.lower(), match_policy="strict") for catalog, name in lens["glasses"]]
    own = [[float(np.ravel(glass.n(w / 1000))[0]) for w in lens["wavelengths"]] for glass in glasses]
    given = [
        traced(lens, [IdealMaterial(n) for n in indices], w)
        for w, indices in zip(lens["wavelengths"], zip(*lens["indices"], strict=True), strict=True)
    ]
    rays = {"given": given, "own": [traced(lens, glasses, w) for w in lens["wavelengths"]]}
json.dump({"system": f"optiland {version('optiland')}", "indices": own, "rays": rays}, sys.stdout)
