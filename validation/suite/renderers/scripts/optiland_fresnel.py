"""optiland's `JonesFresnel` in double precision: its matrix has the p wave with the opposite sign."""

from importlib.metadata import version

import numpy as np
import table
from optiland.jones import JonesFresnel
from optiland.materials import IdealMaterial
from optiland.rays import RealRays

rays = table.Rays("float64")
angles, amplitudes = np.arccos(-(rays.a * rays.n).sum(1)), np.empty((2, len(rays)), complex)
for pair in set(zip(rays.n_from.tolist(), rays.n_to.tolist(), strict=True)):
    of_pair = (rays.n_from == pair[0]) & (rays.n_to == pair[1])
    zero = np.zeros(of_pair.sum())
    bundle = RealRays(zero, zero, zero, zero, zero, zero + 1, intensity=zero + 1, wavelength=zero + 0.5)
    matrix = JonesFresnel(*map(IdealMaterial, pair)).calculate_matrix(bundle, reflect=True, aoi=angles[of_pair])
    amplitudes[:, of_pair] = matrix[:, 0, 0], -matrix[:, 1, 1]
s, p = amplitudes
table.write_fresnel(f"optiland {version('optiland')}", s=np.abs(s) ** 2, p=np.abs(p) ** 2, phase=np.angle(p / s))
