"""`Vector3Refract` of raylib's raymath, in float32, by the bindings for Python."""

from importlib.metadata import version

import numpy as np
import raylib
import table

rays = table.Rays("float32")
b = np.empty_like(rays.a)
for i, (a, n, k) in enumerate(zip(rays.a.tolist(), rays.n.tolist(), rays.k.tolist(), strict=True)):
    direction = raylib.Vector3Refract(a, n, k)
    b[i] = direction.x, direction.y, direction.z
table.write(rays, b, f"raylib {version('raylib')}")
