"""MaterialX's `mx_fresnel_dielectric_polarized`, of its library of GLSL, in a compute shader of float32 through EGL."""

import re
from importlib.metadata import version
from pathlib import Path

import MaterialX as mx
import opengl
import table

NAME = "mx_fresnel_dielectric_polarized"
library = Path(mx.getDefaultDataSearchPath().asString()) / "libraries/pbrlib/genglsl/lib/mx_microfacet_specular.glsl"
square = "float mx_square(float x) { return x * x; }"
function = re.search(rf"^vec2 {NAME}\(.*?^\}}", library.read_text(), re.DOTALL | re.MULTILINE).group()
rays = table.Rays("float32")
call = f"b = vec3({NAME}(-dot(a, n), 1.0 / ray[7 * i + 6]), 0.0)"
powers, renderer, _ = opengl.refract(rays, "float32", call, f"{square}\n{function}")
table.write_fresnel(f"MaterialX {version('MaterialX')}, GLSL by {renderer}", s=powers[:, 1], p=powers[:, 0])
