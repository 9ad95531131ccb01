"""`glm.refract` in float32, or float64 with that argument.

Components are passed one by one, because PyGLM 2.8.3 converts those of a list to float32, for `dvec3` too.
"""

import sys
from importlib.metadata import version

import glm
import table

precision = sys.argv[1] if len(sys.argv) > 1 else "float32"
vector = {"float32": glm.vec3, "float64": glm.dvec3}[precision]
rays = table.Rays(precision)
rows = zip(rays.a.tolist(), rays.n.tolist(), rays.k.tolist(), strict=True)
b = [tuple(glm.refract(vector(*a), vector(*n), k)) for a, n, k in rows]
table.write(rays, b, f"PyGLM {version('PyGLM')}, {precision}")
