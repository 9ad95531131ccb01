"""Mitsuba's `mi.fresnel_polarized` in float32: reflectances and phases from its amplitudes."""

import mitsuba as mi
import numpy as np
import table

mi.set_variant("scalar_rgb")
rays = table.Rays("float32")
cosines = -(rays.a * rays.n).sum(1)
pairs = [mi.fresnel_polarized(float(c), 1 / float(k))[:2] for c, k in zip(cosines, rays.k, strict=True)]
s, p = np.array([[complex(x.real, x.imag) for x in amplitudes] for amplitudes in pairs]).T
table.write_fresnel(
    f"Mitsuba {mi.__version__}, {mi.variant()}", s=np.abs(s) ** 2, p=np.abs(p) ** 2, phase=np.angle(p / s)
)
