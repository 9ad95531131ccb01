"""The driver's own `refract()` in a compute shader, through EGL, for float32 or with the argument `float64`."""

import sys

import opengl
import table

precision = sys.argv[1] if len(sys.argv) > 1 else "float32"
rays = table.Rays(precision)
b, renderer, version = opengl.refract(rays, precision, "b = refract(a, n, ray[7 * i + 6])")
table.write(rays, b, f"{renderer}, {version}, {precision}")
