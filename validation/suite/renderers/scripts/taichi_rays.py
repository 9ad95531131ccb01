"""`taichi.math.refract` on Taichi's CPU backend with its default fast_math: float32, or with `float64` that."""

import contextlib
import sys

import numpy as np
import table

with contextlib.redirect_stdout(sys.stderr):  # where it says which version it is
    import taichi as ti

    precision = sys.argv[1] if len(sys.argv) > 1 else "float32"
    real = {"float32": ti.f32, "float64": ti.f64}[precision]
    ti.init(arch=ti.cpu, default_fp=real, offline_cache=False)
vector = ti.types.vector(3, real)


@ti.kernel
def refract(
    a: ti.types.ndarray(vector, ndim=1),
    n: ti.types.ndarray(vector, ndim=1),
    k: ti.types.ndarray(real, ndim=1),
    b: ti.types.ndarray(vector, ndim=1),
):
    for i in b:
        b[i] = ti.math.refract(a[i], n[i], k[i])


rays = table.Rays(precision)
b = np.zeros_like(rays.a)
refract(rays.a, rays.n, rays.k, b)
table.write(rays, b, f"Taichi {'.'.join(map(str, ti.__version__))}, CPU, {precision}")
