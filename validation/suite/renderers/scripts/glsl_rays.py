"""The OpenGL driver's `refract()` in a compute shader, through EGL, in float32, or float64 with that argument."""

import sys

import opengl
import table

precision = sys.argv[1] if len(sys.argv) > 1 else "float32"
rays = table.Rays(precision)
b, renderer, version = opengl.refract(rays, precision, "b = refract(a, n, ray[7 * i + 6])")
table.write(rays, b, f"{renderer}, {version}, {precision}")
