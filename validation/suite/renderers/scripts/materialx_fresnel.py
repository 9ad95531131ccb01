"""MaterialX's `mx_fresnel_dielectric_polarized`, and phases by its `mx_fresnel_conductor_phase_polarized` with κ = 0.

Both are from its library of GLSL, run in a compute shader of float32 through EGL. Its phase of the s wave is that of
−r_s.
"""

import re
from importlib.metadata import version
from pathlib import Path

import MaterialX as mx
import numpy as np
import opengl
import table

POWERS, PHASES = "mx_fresnel_dielectric_polarized", "mx_fresnel_conductor_phase_polarized"
library = Path(mx.getDefaultDataSearchPath().asString()) / "libraries/pbrlib/genglsl/lib/mx_microfacet_specular.glsl"
text = library.read_text()
parts = ["#define mx_atan atan\nfloat mx_square(float x) { return x * x; }\nvec3 mx_square(vec3 x) { return x * x; }"]
parts += [re.search(rf"^\w+ {name}\(.*?^\}}", text, re.DOTALL | re.MULTILINE).group() for name in (POWERS, PHASES)]
rays = table.Rays("float32")
eta = "1.0 / ray[7 * i + 6]"
call = f"""vec3 p, s; {PHASES}(-dot(a, n), 1.0, vec3({eta}), vec3(0.0), p, s);
    b = vec3({POWERS}(-dot(a, n), {eta}), p.x - s.x)"""
b, renderer, _ = opengl.refract(rays, "float32", call, "\n".join(parts))
phase = np.angle(-np.exp(1j * b[:, 2].astype(float)))
table.write_fresnel(f"MaterialX {version('MaterialX')}, GLSL by {renderer}", s=b[:, 1], p=b[:, 0], phase=phase)
